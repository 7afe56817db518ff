"""Control points on the canvas: where nona really puts them, and which of them are guides."""

from __future__ import annotations

import logging
import os
from dataclasses import replace

import numpy as np
import pytest
import tifffile
from conftest import age, remap

from hugin_abflow import cli, merge, pto
from hugin_abflow.guides import Guide
from hugin_abflow.images import read_layers
from hugin_abflow.layer import Layer
from hugin_abflow.pano_trafo import images_of, read_guides
from hugin_abflow.project import Plan, read_plan

PLACES = {0: 0, 1: 1, 2: 2}
# Places in photos of 203x151, whole and part pixels; the last one crosses the canvas's border.
MARKS = [(0, 40.0, 30.0), (0, 180.25, 120.5), (1, 60.0, 75.0), (1, 101.0, 12.75), (2, 150.5, 100.0)]
C_LINES = [
    "c n0 N1 x150 y70 X40 Y72 t0",
    "c n0 N1 x150 y70 X40 Y72 t1",  # a vertical line
    "c n0 N0 x10 y10 X150 Y12 t2",  # a horizontal line in one photo
    "c n0 N1 x150 y70 X40 Y72 t3",  # a straight line
    "c n1 N1 x10 y10 X60 Y60 t0",  # within one photo
    "c n2 N0 x9 y8 X100 Y90 t0",
    "c n0 N1 x0 y0 X202 Y150",  # corners; without a type, as panotools write it
]


def with_points(make_project, *lines: str, **options) -> Plan:
    return read_plan(make_project(extra="".join(f"{line}\n" for line in lines), **options))


PROJECTS = {
    "equirectangular": {},
    "cropped": {"panorama": 'f2 w802 h401 v360 S31,700,101,333 n"TIFF_m c:LZW r:CROP"'},
    "odd canvas": {"panorama": 'f2 w801 h403 v360 n"TIFF_m c:LZW r:CROP"'},
    "rectilinear": {"panorama": 'f0 w501 h301 v110 n"TIFF_m r:CROP"', "yaws": (-20, 5, 30)},
    "cylindrical": {"panorama": 'f1 w801 h203 v360 n"TIFF_m r:CROP"'},
    "unicode and spaces": {"folder": "Räume mit Blick", "stem": "mein 'Päno'"},
}


@pytest.mark.parametrize("kind", PROJECTS)
def test_points_are_where_nona_puts_a_mark(make_project, nona, pano_trafo, kind) -> None:
    """A spot painted there in the photo; its centre of mass in nona's layer: half a pixel would show."""
    others = [(k, (index + 1) % 3) for k, (index, _, _) in enumerate(MARKS)]
    lines = [f"c n{MARKS[k][0]} N{n} x{MARKS[k][1]} y{MARKS[k][2]} X100 Y75 t0" for k, n in others]
    plan = with_points(make_project, *lines, **PROJECTS[kind])
    guides = read_guides(plan, PLACES)
    rows, columns = np.mgrid[:151, :203]
    checked = 0
    for (index, x, y), line in zip(MARKS, lines, strict=True):
        found = [g for g in guides if f"line {plan.file.read_text().splitlines().index(line) + 1} " in g.name]
        for image in plan.images:
            spot = np.exp(-0.5 * ((columns - x) ** 2 + (rows - y) ** 2) / 1.5**2) * (image.index == index)
            photo = np.rint(60000 * np.repeat(spot[..., None], 3, 2)).astype(np.uint16)
            tifffile.imwrite(image.photo, photo, photometric="rgb")
        remap(plan, "mark")
        page = read_layers(plan.folder / f"mark{index:04d}.tif")[0]
        pixels, box = page.read(0, page.box.height)[..., 1].astype(float), page.box
        if not found or pixels.max() < 50000:
            continue  # cut off by the crop, or the other end is
        v, u = np.mgrid[: box.height, : box.width] + 0.5
        mass = pixels**2
        if box.width == plan.canvas.width:  # the layer crosses the border: count from the spot on
            peak = u.flat[pixels.argmax()]
            u = peak + (u - peak + box.width / 2) % box.width - box.width / 2
        centre = (u * mass).sum() / mass.sum() + box.left, (v * mass).sum() / mass.sum() + box.top
        off = np.array(centre) - found[0].at_a
        if plan.canvas.wraps:
            off[0] = (off[0] + plan.canvas.width / 2) % plan.canvas.width - plan.canvas.width / 2
        assert np.abs(off).max() < 0.15, (index, x, y)
        checked += 1
    assert checked >= 3


def test_only_points_between_two_photos_are_guides(make_project, pano_trafo) -> None:
    plan = with_points(make_project, *C_LINES)
    before = {path: path.read_bytes() for path in plan.folder.iterdir()}
    guides = read_guides(plan, PLACES)
    assert [(g.a, g.b) for g in guides] == [(0, 1), (2, 0), (0, 1)]
    first = plan.file.read_text().splitlines().index(C_LINES[0]) + 1
    assert guides[0].name == f"control point 0 of images 0 and 1 (line {first} of pano.pto)"
    assert guides[1].name == f"control point 5 of images 2 and 0 (line {first + 5} of pano.pto)"
    assert {path: path.read_bytes() for path in plan.folder.iterdir()} == before


def test_layers_that_are_not_merged_have_no_guides(make_project, pano_trafo) -> None:
    """Numbers of layers are not those of images."""
    plan = with_points(make_project, *C_LINES)
    assert [(g.a, g.b) for g in read_guides(plan, {0: 1, 2: 0})] == [(0, 1)]
    assert read_guides(plan, {0: 0}) == []


def test_photos_need_not_be_there(make_project, pano_trafo) -> None:
    plan = with_points(make_project, *C_LINES)
    guides = read_guides(plan, PLACES)
    for image in plan.images:
        image.photo.unlink()
    assert read_guides(plan, PLACES) == guides


def test_places_outside_the_canvas_are_no_guides(make_project, pano_trafo, caplog) -> None:
    """Behind a rectilinear canvas, or beside it."""
    panorama = 'f0 w501 h301 v70 n"TIFF_m r:CROP"'
    lines = ["c n0 N1 x100 y75 X101 Y75 t0", "c n0 N2 x100 y75 X101 Y75 t0", "c n0 N1 x2 y75 X101 Y75 t0"]
    plan = with_points(make_project, *lines, panorama=panorama, yaws=(0, 10, 170))
    with caplog.at_level(logging.INFO, "hugin_abflow"):
        assert [(g.a, g.b) for g in read_guides(plan, PLACES)] == [(0, 1)]
    assert sum("is not on the canvas" in message for message in caplog.messages) == 2


def test_without_pano_trafo_there_are_no_guides(make_project, monkeypatch, tmp_path, caplog) -> None:
    """Said with -v only: nobody asked for them."""
    plan = with_points(make_project, *C_LINES)
    monkeypatch.setenv("PATH", str(tmp_path / "nothing here"))
    with caplog.at_level(logging.INFO, "hugin_abflow"):
        assert read_guides(plan, PLACES) == []
    assert any("pano_trafo (of Hugin's tools) is not in PATH" in message for message in caplog.messages)
    assert all(record.levelno == logging.INFO for record in caplog.records)


@pytest.mark.parametrize("script", ["echo it broke >&2; exit 3", "echo 1 2", "echo not a number"])
def test_pano_trafo_that_fails_is_reported_and_done_without(
    make_project, monkeypatch, tmp_path, caplog, script
) -> None:
    if os.name == "nt":
        pytest.skip("a shell script")  # Windows runs none in place of a program
    program = tmp_path / "bin" / "pano_trafo"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")
    assert read_guides(with_points(make_project, *C_LINES), PLACES) == []
    (record,) = [record for record in caplog.records if record.levelno == logging.WARNING]
    assert "pano_trafo failed" in record.message


# On the way through the program


@pytest.fixture
def asked(monkeypatch) -> list[list[Guide]]:
    """The guides that each merge is given."""
    seen: list[list[Guide]] = []
    original = merge.joint.merge

    def watch(device, layers, canvas, settings, progress, guides):
        seen.append(list(guides))
        return original(device, layers, canvas, settings, progress, guides)

    monkeypatch.setattr(merge.joint, "merge", watch)
    return seen


@pytest.mark.parametrize("option", ["auto", "off"])
def test_guides_option(make_project, nona, pano_trafo, asked, option) -> None:
    plan = with_points(make_project, *C_LINES)
    assert cli.main(["-q", "--guides", option, str(plan.file)]) == 0
    assert [len(guides) for guides in asked] == [3 if option == "auto" else 0]


@pytest.mark.parametrize("missing", [(), (0,)])
def test_guides_find_their_layers(make_project, nona, pano_trafo, asked, missing) -> None:
    """By the numbers in the layers' names, also when one is not there."""
    plan = with_points(make_project, *C_LINES, disabled=missing)
    assert cli.main(["-q", str(plan.file)]) == 0
    assert [(g.a, g.b) for g in asked[0]] == ([] if missing else [(0, 1), (2, 0), (0, 1)])


def test_images_of_layers(make_project) -> None:
    """From files' names; from their number where names tell nothing; not at all where both fail."""
    plan = read_plan(make_project(disabled=(1,), yaws=(0, 30, 60, 100)))

    def images(*names: str) -> list[int | None]:
        layer = Layer.from_array("layer", np.zeros((3, 5, 4), np.uint8))
        return images_of(plan, [replace(layer, file=plan.folder / name) for name in names])

    assert images("pano0000.tif", "pano0002.tif", "pano0003.tif") == [0, 2, 3]
    assert images("pano0003.tif", "pano0000.tif") == [3, 0]
    assert images("pano0002.tif", "a.tif", "b.tif") == images(*["pages.tif"] * 3) == [0, 2, 3]
    assert images("a.tif", "b.tif") == images("a0001.tif", "a0000.tif") == [None, None]


def test_a_project_may_be_edited_between_two_runs(make_project, nona, pano_trafo, asked) -> None:
    """Points added in Hugin count at once, although the layers are still those made before."""
    plan = with_points(make_project, C_LINES[0])
    assert cli.main(["-q", "--keep-layers", str(plan.file)]) == 0
    project = pto.load(plan.file)
    plan.file.write_bytes(pto.dumps(project) + C_LINES[5].encode() + b"\n")
    age(plan.file, 60)
    assert cli.main(["-q", str(plan.file)]) == 0
    assert [len(guides) for guides in asked] == [1, 2]

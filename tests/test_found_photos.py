"""Files that are named as layers would be, and are none: photos, layers of another canvas, edited ones."""

from __future__ import annotations

import os
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
import tifffile
from conftest import age, photo_pixels, remap, to_make
from layer_files import write_layer

from hugin_abflow.errors import LayersMismatchError, LayersMissingError, OutputError
from hugin_abflow.found import candidates, layers_by_prefix
from hugin_abflow.images import write_image
from hugin_abflow.merge import default_target
from hugin_abflow.project import Plan, read_plan
from hugin_abflow.supply import open_layers
from hugin_abflow.tifftags import ASCII, EXIF, MAIN, RATIONAL, UNDEFINED, Value, add_directories, is_edited

pytestmark = pytest.mark.usefixtures("temporary")


@pytest.fixture
def developed(make_project, tmp_path) -> Path:
    """A project pano.pto of photos pano0000.tif ..., with alpha: nothing tells them from layers."""
    project = make_project(photo="pano{:04d}.tif")
    for index in range(3):
        pixels = photo_pixels(index)
        opaque = np.concatenate([pixels, np.full_like(pixels[..., :1], 255)], axis=2)
        file = project.parent / f"pano{index:04d}.tif"
        tifffile.imwrite(file, opaque, photometric="rgb", extrasamples=["unassalpha"])
    return project


@pytest.mark.skipif(os.name == "nt", reason="links need rights there")
@pytest.mark.parametrize("way", ["..", "link", "absolute"])
def test_photos_are_no_layers_whatever_leads_to_them(developed, tmp_path, way):
    prefix = {"..": "../project/", "link": f"{tmp_path}/linked/", "absolute": f"{tmp_path}/project/"}[way]
    (tmp_path / "linked").symlink_to("project")
    developed.write_text(developed.read_text().replace('n"pano0', f'n"{prefix}pano0'))
    plan = read_plan(tmp_path / "linked" / "pano.pto" if way == "absolute" else developed)
    assert candidates(plan) == []
    assert to_make(plan) == (None, [0, 1, 2])


@pytest.mark.parametrize("prefix", ["pano", "project/pano"])
def test_a_prefix_that_photos_have_is_told(developed, tmp_path, monkeypatch, prefix):
    """Their files are there: it is no help to say that there are none of such names."""
    monkeypatch.chdir(tmp_path)
    said = r"pano0000\.tif is a photo of the project, and no layer; .* leave it out"
    with pytest.raises(LayersMissingError, match=said), open_layers(read_plan(developed), prefix=prefix):
        pass
    for index in range(3):
        (developed.parent / f"pano{index:04d}.tif").unlink()
    with pytest.raises(LayersMissingError, match=r"no layer .*pano0000\.tif"):
        layers_by_prefix(read_plan(developed), prefix)


@pytest.mark.parametrize(
    ("ending", "make", "other"),
    [
        (".tif", shutil.copy2, "pano0000.pto"),
        (".exr", shutil.copy2, "pano0000.pto"),
        (".tif", shutil.copy2, "pano0000.PTO"),
        (".tif", os.symlink, "pano0000.pto"),
    ],
)
def test_what_is_named_after_another_project_is_no_layer(make_project, caplog, ending, make, other):
    """Its panorama, pano0000.tif, has alpha and the canvas's size: nothing else tells it from a layer. Nor is
    it replaced by one.
    """
    plan = read_plan(make_project())
    pixels = np.full((401, 802, 4), 255, np.uint8 if ending == ".tif" else np.float32)
    files = [plan.folder / f"pano000{index}{ending}" for index in (0, 1)]
    for file in files:
        write_image(file, pixels)
    make(plan.file, plan.folder / other)
    kept = open_layers(plan, keep_layers=True)
    with pytest.raises(OutputError, match=r"another project's panorama, pano0000\.pto"), kept:
        pass
    [found] = candidates(plan)
    assert found.in_order() == files[1:] and to_make(plan) == ("pano", [0, 2])
    assert layers_by_prefix(plan, "pano").in_order() == files[1:]
    assert "no layer of image 0 (photo 0.tif) under pano" in caplog.text
    files[1].unlink()
    assert candidates(plan) == [] and default_target(plan) == plan.folder / "pano.tif"
    with pytest.raises(LayersMissingError, match=r"pano0000\.\w+ is named after pano0000\.pto, another proj"):
        layers_by_prefix(plan, "pano")


def test_a_photo_of_pages_is_no_file_of_layers(developed):
    """Scanners write such ones."""
    photo = developed.parent / "pano.tif"
    tifffile.imwrite(photo, photo_pixels(0), photometric="rgb", subfiletype=2)
    (developed.parent / "pano0001.tif").unlink()
    developed.write_text(developed.read_text().replace("pano0001", "pano"))
    assert candidates(read_plan(developed)) == []


def test_a_layer_is_not_kept_in_the_place_of_a_photo(developed, nona, tmp_path):
    text = developed.read_text()
    developed.write_text(text.replace('n"pano0', 'n"../project/pano0'))
    with (
        pytest.raises(OutputError, match=r"pano0000\.tif is a photo"),
        open_layers(read_plan(developed), remap="always", keep_layers=True),
    ):
        pass


# ------------------------------------------------------------------------------------ unusable layers


def spoil(plan, how: str) -> None:
    """Put what cannot be used in the place of the second of three layers; it is as new as the others."""
    canvas = (600, 300) if how == "canvas" else (plan.canvas.width, plan.canvas.height)
    left = 700 if how == "outside" else 0
    for index in range(3):
        pixels = np.full((100, 200, 4), 255, np.uint8)
        file = plan.folder / f"pano{index:04d}.tif"
        fine = index != 1
        write_layer(file, pixels, 0 if fine else left, 0, None if fine else canvas, fine or how != "alpha")


UNUSABLE = [("alpha", "has no alpha"), ("canvas", "made for a canvas of 600x300"), ("outside", "700 to 900")]


@pytest.mark.parametrize("how, said", UNUSABLE)
def test_what_cannot_be_a_layer_is_made_again(make_project, nona, temporary, caplog, how, said):
    """As developed photos beside those that the project names; or layers of when its canvas was another."""
    plan = read_plan(make_project())
    spoil(plan, how)
    before = (plan.folder / "pano0001.tif").read_bytes()
    assert to_make(plan) == (None, [0, 1, 2])
    with open_layers(plan) as layers:
        assert all(temporary in layer.file.parents for layer in layers)
    assert "pano0001.tif" in caplog.text and said in caplog.text and "are made again" in caplog.text
    assert (plan.folder / "pano0001.tif").read_bytes() == before


@pytest.mark.parametrize("how, said", UNUSABLE)
@pytest.mark.parametrize("request_", [{"prefix": "pano"}, {"remap": "never"}])
def test_what_cannot_be_a_layer_and_was_asked_for_is_told(
    make_project, nona, how, said, request_, monkeypatch
):
    plan = read_plan(make_project())
    spoil(plan, how)
    remedy = r"--remap always, without --prefix and --layers," if "prefix" in request_ else "--remap always"
    with (
        pytest.raises(LayersMismatchError, match=rf"pano0001\.tif .*{said}.*{remedy} makes all"),
        open_layers(plan, **request_),
    ):
        pass
    monkeypatch.setenv("PATH", "")  # no nona: nothing to advise
    with pytest.raises(LayersMismatchError) as error, open_layers(plan, **request_):
        pass
    assert "--remap" not in str(error.value)


def test_a_picture_is_not_replaced_by_a_layer_that_is_kept(make_project, nona):
    plan = read_plan(make_project())
    spoil(plan, "alpha")
    before = {path.name: path.read_bytes() for path in plan.folder.iterdir()}
    with (
        pytest.raises(OutputError, match=r"pano0001\.tif has no alpha channel: it is no layer"),
        open_layers(plan, keep_layers=True),
    ):
        pass
    assert {path.name: path.read_bytes() for path in plan.folder.iterdir()} == before


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_is_not_replaced_by_a_layer_that_is_kept(make_project, nona, monkeypatch):
    """Nor is it opened, which waits for ever."""
    plan = read_plan(make_project())
    os.mkfifo(plan.folder / "pano0001.tif")
    monkeypatch.setattr("hugin_abflow.supply.is_edited", lambda file: file.name == "pano0001.tif")
    with (
        pytest.raises(OutputError, match=r"pano0001\.tif is a pipe or a device"),
        open_layers(plan, keep_layers=True),
    ):
        pass


# ------------------------------------------------------------------------------------ edited layers


@pytest.fixture
def edited(make_project) -> Plan:
    """A project that was saved since nona made its three layers, of which an editor wrote the second."""
    plan = read_plan(make_project())
    remap(plan, "pano")
    add_directories(plan.folder / "pano0001.tif", {MAIN: {305: Value(ASCII, b"GIMP 2.10\0")}})
    for index in range(3):
        age(plan.folder / f"pano{index:04d}.tif", 60)
    return plan


@pytest.mark.parametrize("request_", [{}, {"remap": "always"}])
def test_an_edited_layer_is_not_replaced_by_one_that_is_kept(edited, nona, request_):
    """Whoever painted its alpha would lose that."""
    before = {path.name: path.read_bytes() for path in edited.folder.iterdir()}
    with (
        pytest.raises(OutputError, match=r"pano0001\.tif was changed by another program"),
        open_layers(edited, keep_layers=True, **request_),
    ):
        pass
    assert {path.name: path.read_bytes() for path in edited.folder.iterdir()} == before


def test_it_is_told_if_it_is_not_used(edited, nona, temporary, caplog):
    with open_layers(edited) as layers:
        assert all(temporary in layer.file.parents for layer in layers)
    assert "pano0001.tif was changed by another program" in caplog.text
    caplog.clear()
    with open_layers(edited, remap="never") as layers:
        assert all(layer.file.parent == edited.folder for layer in layers)
    assert "another program" not in caplog.text


def test_others_are_made_beside_it(edited, nona):
    (edited.folder / "pano0002.tif").unlink()
    for path in (edited.file, *(image.photo for image in edited.images)):
        age(path, 120)
    with open_layers(edited, keep_layers=True) as layers:
        assert all(layer.file.parent == edited.folder for layer in layers)
    assert is_edited(edited.folder / "pano0001.tif")


def test_what_nona_writes_was_not_edited(edited, tmp_path):
    files = [edited.folder / f"pano{index:04d}.tif" for index in range(3)]
    assert [is_edited(file) for file in files] == [False, True, False]
    add_directories(files[0], {EXIF: {36864: Value(UNDEFINED, b"0230")}})
    assert is_edited(files[0])
    add_directories(files[2], {MAIN: {318: Value(RATIONAL, struct.pack("<4I", 3127, 10000, 3290, 10000))}})
    assert is_edited(files[2])  # by ImageMagick
    for data in (b"", b"II*\0", b"no TIFF at all"):
        (tmp_path / "x").write_bytes(data)
        assert not is_edited(tmp_path / "x")
    assert not is_edited(tmp_path / "none")

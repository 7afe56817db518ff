"""Of a view in several exposures one is shown."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from conftest import ProjectMaker, photo_pixels, whole
from layer_files import write_layer

from hugin_abflow import brackets
from hugin_abflow.layer import Layer
from hugin_abflow.merge import merge_project
from hugin_abflow.project import read_plan
from hugin_abflow.supply import open_layers

VIEWS = (0, 0, 0, 60, 60, 60, 170)  # the last one was not taken in several exposures
CANVAS = 'f2 w802 h401 v360 E{} n"TIFF_m c:LZW r:CROP"'


def bracketed(
    make_project: ProjectMaker,
    exposures: tuple[float, ...] = (0, -2, 2, 0.1, -1.9, 2.1, 5),
    wanted: float = 0.0,
    extra: str = "",
    photo: str = "photo {}.tif",
) -> Path:
    """A project of photos that look at VIEWS and have exposures; the panorama has the `wanted` one."""
    yaws = VIEWS[: len(exposures)]
    project = make_project(yaws=yaws, panorama=CANVAS.format(wanted), extra=extra, photo=photo)
    values = iter(exposures)
    text = re.sub(r" p\d+ ", " p0 ", project.read_text())
    project.write_text(re.sub(r" Eev0 ", lambda _: f" Eev{next(values)} ", text))
    return project


def layer_of(left: int = 0, **hidden: slice) -> Layer:
    """All of it shows something, but for some rows, of some columns."""
    pixels = np.full((131, 5, 4), 255, np.uint8)
    if hidden:
        pixels[hidden["rows"], hidden["columns"], 3] = 127
    return Layer.from_array("layer", pixels, left)


def shown(project: Path, *names: str) -> list[str]:
    """The names of the layers of one exposure, of those with some names."""
    plan = read_plan(project)
    layers = [replace(layer_of(), file=plan.folder / name, name=name) for name in names]
    return [one.name for one in brackets.of_one_exposure(plan, layers)]


def names(*numbers: int) -> list[str]:
    return [f"pano{number:04d}.tif" for number in numbers]


@pytest.mark.parametrize(
    ("wanted", "kept"),
    [(0, (0, 3, 6)), (-1.9, (1, 4, 6)), (-30, (1, 4, 6)), (1.3, (2, 5, 6)), (1.0, (2, 5, 6)), (9, (2, 5, 6))],
)
def test_the_nearest_exposure_is_shown(make_project: ProjectMaker, wanted: float, kept: tuple) -> None:
    """Of two about as near (at E1: stops -1 and 1; -.9 and 1.1) that with less light, of all views."""
    assert shown(bracketed(make_project, wanted=wanted), *names(*range(7))) == names(*kept)


def test_what_is_not_there_is_not_shown_instead(make_project: ProjectMaker) -> None:
    assert shown(bracketed(make_project), *names(1, 2, 4, 6)) == names(2, 4, 6)


def test_all_of_one_exposure_are_shown(make_project: ProjectMaker) -> None:
    """Less than half a stop is none."""
    project = bracketed(make_project, (0, 0.4, -0.4, 0, 0, 0, 0))
    assert shown(project, *names(*range(7))) == names(*range(7))


@pytest.mark.parametrize(
    "change",
    [
        (" y0 ", " y0.5 "),  # handheld: each covers something else
        (" v80 ", " v81 "),
        (" TrX0 ", " TrX0.1 "),
        ("\n\n", "\n#hugin_outputHDRBlended true\n#hugin_outputLDRBlended false\n"),
    ],
)
def test_what_does_not_look_at_the_same_is_shown(make_project: ProjectMaker, change: tuple[str, str]) -> None:
    """And all of HDR."""
    project = bracketed(make_project, (0, 2), extra="\n")
    assert shown(project, *names(0, 1)) == names(0)
    text = project.read_text()
    assert change[0] in text
    project.write_text(text.replace(*change, 1))
    assert shown(project, *names(0, 1)) == names(0, 1)


SOME = {"rows": slice(100, 131), "columns": slice(2, 5)}
LESS = {"rows": slice(101, 130), "columns": slice(3, 4)}


@pytest.mark.parametrize(
    ("kept", "other", "covers"),
    [
        (layer_of(), layer_of(**SOME), True),
        (layer_of(**SOME), layer_of(), False),  # a mask, or a transparent photo
        (layer_of(**SOME), layer_of(**SOME), True),
        (layer_of(**SOME), layer_of(**LESS), False),
        (layer_of(), layer_of(1), False),  # another view's, as of photos that were fused
    ],
)
def test_only_what_is_covered_is_left_out(
    make_project: ProjectMaker, kept: Layer, other: Layer, covers: bool
) -> None:
    plan = read_plan(bracketed(make_project, (0, 2)))
    layers = [
        replace(one, file=plan.folder / name) for one, name in zip((kept, other), names(0, 1), strict=True)
    ]
    assert len(brackets.of_one_exposure(plan, layers)) == (1 if covers else 2)


def test_photos_are_named_whose_layers_are_left_out(
    make_project: ProjectMaker, caplog: pytest.LogCaptureFixture
) -> None:
    """Not layers that nona made for this run alone, which nobody finds."""
    plan = read_plan(bracketed(make_project, (0, -2)))
    layers = [replace(layer_of(), name=name, photo=f"IMG_{name}") for name in names(0, 1)]
    with caplog.at_level("INFO"):
        assert brackets.of_one_exposure(plan, layers) == layers[:1]
    assert caplog.messages == [f"IMG_{names(1)[0]} shows a view in another exposure; it is left out"]


def test_layers_of_which_nobody_knows_the_photo_are_shown(make_project: ProjectMaker) -> None:
    project = bracketed(make_project, (0, 2))
    assert shown(project, "pages", "pages", "pages") == ["pages"] * 3
    assert shown(project, "one", "two") == ["one"]  # as many as there are photos: in their order


def test_the_panorama_is_that_exposure(make_project: ProjectMaker) -> None:
    """Unless somebody names the layers."""
    project, folder = bracketed(make_project, (0, -2, 2)), make_project(folder="layers").parent
    rng = np.random.default_rng(1)
    for number, level in enumerate((100, 60, 200)):
        pixels = rng.integers(level, level + 40, (401, 802, 4)).astype(np.uint8)
        pixels[..., 3] = 255
        write_layer(folder / f"a{number:04d}.tif", pixels, canvas=(802, 401))
    merge_project(project, prefix=folder / "a", output=folder / "panorama.tif")
    first = tifffile.imread(folder / "a0000.tif")
    assert np.array_equal(tifffile.imread(folder / "panorama.tif"), first)
    merge_project(project, layers=[folder / "a0001.tif"], output=folder / "other.tif")
    assert not np.array_equal(tifffile.imread(folder / "other.tif"), first)


JPEG = "photo {}.jpg"
HDR = "#hugin_outputHDRBlended true\n"


@pytest.mark.parametrize(
    ("wanted", "photo", "extra", "made"),
    [
        (0, JPEG, "", (0, 3, 6)),
        (-30, "photo {}.JPEG", "", (1, 4, 6)),
        (0, "photo {}.tif", "", range(7)),  # may be transparent somewhere
        (0, JPEG, 'k i1 t0 p"0 0 9 0 9 9"\n', range(7)),
        (0, JPEG, HDR, range(7)),
    ],
)
def test_no_layer_is_made_for_nothing(
    make_project: ProjectMaker, wanted: float, photo: str, extra: str, made: Iterable[int]
) -> None:
    plan = read_plan(bracketed(make_project, wanted=wanted, photo=photo, extra=extra))
    assert [image.index for image in brackets.to_be_made(plan)] == list(made)


def test_all_layers_are_made_of_scripts_by_other_programs(make_project: ProjectMaker) -> None:
    """In them no photo can be left out, as nona asks Hugin's lines for that."""
    project = bracketed(make_project, (0, 2), photo=JPEG)
    project.write_text(re.sub(r"#-hugin.*\n", "", project.read_text()))
    plan = read_plan(project)
    assert brackets.to_be_made(plan) == plan.images


@pytest.mark.usefixtures("nona", "temporary")
def test_nona_makes_the_layers_that_are_needed(make_project: ProjectMaker) -> None:
    """The same as it makes of all photos, if one of the others is not there, too; and all that are kept."""
    plan = read_plan(bracketed(make_project, photo=JPEG))
    for image in plan.images:
        cv2.imwrite(str(image.photo), photo_pixels(image.index, np.uint8, 3))
    with open_layers(plan) as layers:
        pixels = [whole(layer) for layer in layers]
        assert len(layers) == 7
    plan.images[1].photo.rename(plan.folder / "elsewhere")
    with open_layers(plan, images=brackets.to_be_made(plan)) as layers:
        assert [one.name for one in layers] == names(0, 3, 6)
        for one, number in zip(layers, (0, 3, 6), strict=True):  # nona dithers, each time otherwise
            assert np.abs(whole(one).astype(int) - pixels[number]).max() <= 1
        assert brackets.of_one_exposure(plan, layers) == layers
    (plan.folder / "elsewhere").rename(plan.images[1].photo)
    with open_layers(plan, images=brackets.to_be_made(plan), keep_layers=True) as layers:
        assert len(layers) == 7
    (plan.folder / names(3)[0]).unlink()
    (plan.folder / names(4)[0]).unlink()
    with open_layers(plan, images=brackets.to_be_made(plan)) as layers:
        assert [one.name for one in layers] == names(0, 1, 2, 3, 5, 6)


@pytest.mark.usefixtures("nona", "temporary")
def test_a_panorama_has_its_layers_made_only_once_for_each_view(
    make_project: ProjectMaker, caplog: pytest.LogCaptureFixture
) -> None:
    project = bracketed(make_project, (0, -2, 2), photo=JPEG)
    for number in range(3):
        cv2.imwrite(str(project.with_name(JPEG.format(number))), photo_pixels(number, np.uint8, 3))
    with caplog.at_level("INFO"):
        merge_project(project)
    said = [record.getMessage() for record in caplog.records]
    assert [line for line in said if "another exposure" in line] == [
        f"{JPEG.format(k)} shows a view in another exposure; no layer of it is needed" for k in (1, 2)
    ]
    assert "layers: 1, RGB, uint8" in said and project.with_suffix(".tif").is_file()

"""Masks painted in Hugin are obeyed exactly: what they hide is in no pixel of the panorama."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile
from conftest import ProjectMaker, require_program
from pictures import one_device
from scipy import ndimage

from hugin_abflow import rim
from hugin_abflow.images import read_layer
from hugin_abflow.merge import merge_project
from hugin_abflow.settings import Settings

pytestmark = pytest.mark.usefixtures("temporary", one_device.__name__)

WIDTH, HEIGHT = 203, 151  # px of the photos, which are 80 degrees wide and 30 apart
MARKER = (255, 0, 255)  # what the masks hide: nothing else is anywhere near magenta

# Corners in photo 0 and 1. `hidden` is left out of photo 0 by a negative mask; `chosen` is a positive mask of
# photo 0, so photo 1 is left out there. Both are wholly in the overlap.
HIDDEN = (105, 90, 135, 125)
CHOSEN = (125, 20, 195, 80)
MASKS = {"negative": ("k i0 t0", HIDDEN), "positive": ("k i0 t1", CHOSEN)}
# Where the markers are painted: so far inside that no interpolation of nona's reaches them.
MARKED = {"negative": (0, (110, 95, 130, 120)), "positive": (1, (72, 40, 102, 60))}


def line(start: str, box: tuple[int, int, int, int]) -> str:
    left, top, right, bottom = box
    return f'{start} p"{left} {top} {right} {top} {right} {bottom} {left} {bottom}"\n'


def paint(photo: Path, box: tuple[int, int, int, int]) -> None:
    """The marker, in a photo."""
    pixels = tifffile.imread(photo)
    left, top, right, bottom = box
    pixels[top:bottom, left:right] = MARKER
    tifffile.imwrite(photo, pixels, photometric="rgb")


def magenta(pixels: np.ndarray) -> np.ndarray:
    """How much of the marker is in each pixel, in levels: 255 where it is pure, below 0 in the green rest."""
    colours = pixels[..., :3].astype(int)
    return colours[..., [0, 2]].min(-1) - colours[..., 1]


@pytest.fixture
def project(make_project: ProjectMaker) -> Path:
    """Photos of a green pattern, 30 degrees apart, which parallax moves by some pixels."""
    require_program("nona")
    file = make_project(yaws=(0, 30))
    random = np.random.default_rng(3).normal(size=(HEIGHT, WIDTH + 60))
    waves = ndimage.gaussian_filter(random, 4)
    for index in (0, 1):
        part = waves[:, 30 - 4 * index :][:, :WIDTH]
        level = np.clip(120 + 60 * part / waves.std(), 20, 230)
        photo = np.stack([0.4 * level, level, 0.4 * level], -1).astype(np.uint8)
        tifffile.imwrite(file.with_name(f"photo {index}.tif"), photo, photometric="rgb")
    return file


def merged(project: Path, **settings) -> tuple[np.ndarray, list[np.ndarray]]:
    """The panorama, and the layers that nona made for it, on the whole canvas."""
    output = merge_project(project, Settings(**settings), keep_layers=True, remap="always")
    layers = []
    for index in (0, 1):
        layer = read_layer(project.with_name(f"pano{index:04d}.tif"))
        whole = np.zeros((401, 802, 4), np.uint8)
        box = layer.box
        whole[box.top : box.bottom, box.left : box.right] = layer.read(0, box.height)
        layers.append(whole)
    return read_layer(output).read(0, 401), layers


@pytest.mark.parametrize("kind", MASKS)
@pytest.mark.parametrize("settings", [{}, {"flow": False}, {"seam": False}], ids=str)
def test_what_a_mask_hides_is_nowhere(project: Path, kind: str, settings: dict) -> None:
    index, box = MARKED[kind]
    paint(project.with_name(f"photo {index}.tif"), box)
    project.write_text(project.read_text() + line(*MASKS[kind]))
    result, layers = merged(project, **settings)
    alphas = [layer[..., 3] > 0 for layer in layers]
    assert magenta(layers[index])[alphas[index]].max() < 0  # nona left it out
    np.testing.assert_array_equal(result[..., 3] > 0, alphas[0] | alphas[1])
    assert magenta(result).max() <= 0


@pytest.mark.parametrize("kind", MASKS)
def test_without_the_mask_it_would_show(project: Path, kind: str) -> None:
    index, box = MARKED[kind]
    paint(project.with_name(f"photo {index}.tif"), box)
    result, _ = merged(project, seam=False)
    assert magenta(result).max() > 60


@pytest.mark.parametrize("kind", MASKS)
def test_where_the_others_are_masked_a_photo_is_copied(project: Path, kind: str) -> None:
    """Up to the mask's border, to the bit; but for the rim, where the geometry goes on (rim.py)."""
    project.write_text(project.read_text() + line(*MASKS[kind]))
    result, layers = merged(project, exposure=False)
    alphas = [layer[..., 3] > 0 for layer in layers]
    inside = ndimage.distance_transform_edt(np.pad(alphas[0] | alphas[1], 1))[1:-1, 1:-1]
    inside = inside > rim._THICK * min(inside.shape) + 3
    for layer, alpha, other in zip(layers, alphas, alphas[::-1], strict=True):
        alone = alpha & ~other & inside
        assert alone.sum() > 5000
        np.testing.assert_array_equal(result[alone], layer[alone])


def test_a_hole_between_masks_that_contradict_each_other_is_told(
    project: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Each of two photos includes what the other one does: nona leaves it out of both."""
    text = project.read_text("utf-8")
    for box, told in (((150, 90, 190, 130), False), ((60, 30, 110, 70), True)):
        project.write_text(text + line("k i0 t1", CHOSEN) + line("k i1 t1", box), "utf-8")
        result, _ = merged(project, flow=False)
        shown = result[..., 3] > 0
        assert ((ndimage.binary_fill_holes(shown) & ~shown).sum() > 500) == told
        assert ("the panorama has a hole of about" in caplog.text) is told

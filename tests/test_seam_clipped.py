"""What a layer shows clipped, and wide things: whole, from one layer, or absent."""

from __future__ import annotations

import numpy as np
import pytest
from grids import plane
from pictures import masked, merged, one_device
from test_seam_panoramas import CANVASES, DISC, RADIUS, distance, fields_of, halves, off, prepared, wall

from hugin_abflow.gains import Difference
from hugin_abflow.layer import Canvas
from hugin_abflow.opencl import Device


@pytest.mark.parametrize(
    ("light", "other", "tells"),
    [(1.0, 0.85, True), (1.0, 0.95, False), (0.5, 0.6, False), (0.5, 0.3, True), (2.0, 0.95, False)],
)
def test_what_is_clipped_tells_where_the_other_is_darker_for_certain(
    device: Device, light: float, other: float, tells: bool
) -> None:
    """A layer with half the light shows half of white, or more, where the other one just clips."""
    grid, box = plane(16, 16), (0, 0, 16, 16)
    gain = np.log(light / (2 - light)) if light < 2 else 2.0  # of a grey's odds
    for turned in (1, -1):
        sides: list = []
        for value, raised in ((1.0, 0.0), (other, -gain))[::turned]:
            pixels = np.full((16, 16, 4), value, np.float32)
            pixels[..., 3] = 1
            field = np.zeros((16, 16, 4), np.float32)
            sides += [pixels, field, box, np.full((1, 1, 4), raised, np.float32)]
        out, square, texture = device.empty((1, 1, 4)), device.empty((1, 1)), device.empty((1, 1, 8))
        uploaded = [device.upload(one) if isinstance(one, np.ndarray) else one for one in sides]
        device.run(
            "seam", "seam_difference", (1, 1), *uploaded, grid.border, grid.lonlat, *[(1, 1, 0, 0)] * 2,
            (0, 0, 1, 1), 1.0, (0.98,) * 4, (0.98,) * 4, 0.1, out, square, texture,
        )  # fmt: skip
        assert (out.get()[0, 0, 3] > 0) == tells


@pytest.mark.parametrize("clips", [0.3, 0.7])
def test_exposures_are_known_where_most_cells_tell(clips: float) -> None:
    """Where one layer is white nearly all over nobody knows how much lighter it is."""
    values, beyond = np.zeros((2, 10, 10, 4))
    white = np.arange(100).reshape(10, 10) < 100 * clips
    values[~white, 3], beyond[white, 3] = 1, -1
    none = np.zeros((10, 10))
    assert Difference(0, 1, values, beyond, none, none).known == (clips < 0.5)


def test_what_is_clipped_in_one_layer_changes_over_as_ever(device: Device) -> None:
    """A bright ceiling that the lighter layer burns out is no thing that only one of them shows."""
    canvas, x, _ = CANVASES["plane"]
    layers = []
    for mask, its in zip(halves(canvas, x), (1.0, 0.6), strict=True):
        picture = wall(canvas).astype(float)
        picture[..., :3] *= its
        picture[: canvas.height // 2, :, :3] = min(330 * its, 255)
        layers.append(masked(picture.astype(np.uint8), mask))
    with_, without = (fields_of(prepared(device, layers, canvas, seam=s)) for s in (True, False))
    assert all(np.array_equal(*pair) for pair in zip(with_, without, strict=True))


@pytest.mark.usefixtures(one_device.__name__)
@pytest.mark.parametrize("name", ["plane", "across the border", "sphere"])
@pytest.mark.parametrize("who", [0, 1])
@pytest.mark.parametrize("light", [1.0, 0.7])
def test_something_white_is_whole_or_absent(name: str, who: int, light: float) -> None:
    """It may be any brighter, but what the other layer shows is darker for certain."""
    canvas, x, y = CANVASES[name]
    away, plain, layers = distance(canvas, x, y), wall(canvas), []
    for index, (mask, its) in enumerate(zip(halves(canvas, x), (1.0, light), strict=True)):
        picture = plain.copy()
        picture[..., :3] = np.rint(picture[..., :3] * its)
        if index == who:
            picture[away < RADIUS, :3] = 255
        layers.append(masked(picture, mask))
    result = merged(layers, canvas, seam=True)
    assert (result[away < RADIUS - 2, 1] >= 250).mean() in (0, 1)
    beside = result[(away >= RADIUS + 2) & (away < 2 * RADIUS), 1].astype(float)
    ratio = beside / plain[(away >= RADIUS + 2) & (away < 2 * RADIUS), 1]
    assert ratio.std() < 0.07 and light * 0.95 < ratio.mean() < 1.05


@pytest.mark.usefixtures(one_device.__name__)
@pytest.mark.parametrize("who", [0, 1])
def test_a_wide_thing_across_the_middle_is_whole_or_absent(who: int) -> None:
    """It fills most of the overlap, and is as dark as what is behind it bright."""
    canvas, ends = Canvas.plane(1000, 304), (650, 350)
    columns = np.arange(canvas.width) * np.ones((canvas.height, 1), int)
    snow = wall(canvas)
    snow[..., :3] = 180 + snow[..., :3] // 4
    thing, layers = np.s_[112:192, 375:625], []
    for index, mask in enumerate((columns < ends[0], columns >= ends[1])):
        picture = snow.copy()
        if index == who:
            picture[(*thing, slice(3))] = DISC
        layers.append(masked(picture, mask))
    result = merged(layers, canvas, seam=True)[thing]
    assert (off(result, DISC)[2:-2, 2:-2] <= 32).mean() in (0, 1)

"""Exposure: measured differences against their twin, the solver against dense least squares."""

from __future__ import annotations

import math

import numpy as np
import pytest
from grids import GRIDS, on_device, patches, plane, random_layer, sphere
from reference import common
from reference.colour import colour_difference
from scipy import ndimage
from tolerances import POSITION, assert_close

from hugin_abflow import colour
from hugin_abflow.chart import pair_chart
from hugin_abflow.coefficient import on_cells
from hugin_abflow.geometry import PairFlow
from hugin_abflow.opencl import Device
from hugin_abflow.settings import Settings
from hugin_abflow.working import Grid, WorkingLayer

CLIPPED, SPREAD = 0.9, 0.15


def smooth_layer(seed: int, width: int, height: int, share: float = 0.85) -> np.ndarray:
    """Working pixels that can be sampled between pixels, some clipped, with a ragged mask."""
    pixels = ndimage.gaussian_filter(random_layer(seed, width, height, 1.0), (1.5, 1.5, 0))
    colours = pixels[..., :3]
    pixels[..., :3] = (colours - colours.min()) / np.ptp(colours)
    pixels[..., 3] = 1
    return (pixels * patches(seed, width, height, share, 9)[..., None]).astype(np.float32)


def displacement(seed: int, box: tuple[int, int, int, int], grid: Grid) -> np.ndarray:
    random = np.random.default_rng(seed)
    field = ndimage.gaussian_filter(random.normal(size=(box[3], box[2], 4)), (4, 4, 0))
    field *= 2 * (grid.lens[1] or 1) / np.abs(field).max()
    if not grid.lens[1]:
        field[..., 2] = 0
    field[: box[3] // 3, :, :3] = 0
    return field.astype(np.float32)


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize("integer", [0, 1])
def test_difference_equals_its_twin(device: Device, name: str, integer: int) -> None:
    grid = GRIDS[name]
    cells = grid.resized(7, 3)
    boxes = ((0, 0, 60, grid.height), (9, 1, grid.width - 9, grid.height - 1))
    layers = [smooth_layer(3 * i, b[2], b[3]) for i, b in enumerate(boxes)]
    fields = [displacement(7 + i, b, grid) for i, b in enumerate(boxes)]
    clipped = CLIPPED if integer else 1e30
    result = device.empty((3, 7, 4))
    device.run(
        "colour", "colour_difference", (7, 3),
        device.upload(layers[0]), device.upload(fields[0]), boxes[0],
        device.upload(layers[1]), device.upload(fields[1]), boxes[1],
        grid.border, grid.lens, cells.border, integer, clipped, SPREAD, result,
    )  # fmt: skip
    expected = colour_difference(
        layers[0], fields[0], boxes[0], layers[1], fields[1], boxes[1],
        grid.border, grid.lens, cells.border, integer, clipped, SPREAD,
    )  # fmt: skip
    assert (expected[..., 3] > 0.01).mean() > 0.4
    # a pixel more or less at a mask's rim is one of some 30 of a cell
    assert_close(result.get(), expected, 10 * POSITION, decisions=0.05)
    assert np.abs(result.get() - expected).max() < 0.1


def share(c: np.ndarray, integer: int) -> np.ndarray:
    """How much of a small shift of colours c the exposure scale shows: its slope over the shift's own.

    The shift keeps black and white, the scale has a floor under both: dark and nearly white pixels show less
    of a gain than they get, so that their noise is no gain.
    """
    floor = common.EXPOSURE_FLOOR
    if integer:
        return c * (1 - c) * (1 / (c + floor) + 1 / (1 - c + floor))
    return c / (c + floor)


@pytest.mark.parametrize("integer", [0, 1])
def test_twin_of_difference_measures_a_gain(integer: int) -> None:
    """Layers that differ by a shift: that shift less what the floor hides, trusted by usable pixels."""
    grid = plane()
    a = smooth_layer(20, 77, 53).astype(np.float64)
    gains = np.array([0.3, -0.1, 0.2])
    b, middle = a.copy(), a.copy()
    b[..., :3] = common.exposure_shift(a[..., :3], -gains, integer)
    middle[..., :3] = common.exposure_shift(a[..., :3], -gains / 2, integer)
    still = np.zeros_like(a)
    box = (0, 0, 77, 53)
    result = colour_difference(
        a, still, box, b, still, box, grid.border, grid.lens, (7, 3, 0, 0), integer, 9, SPREAD
    )
    known = result[..., 3] > 0
    assert known.mean() > 0.8
    for j, i in np.argwhere(known):
        cell = np.s_[j * 53 // 3 : (j + 1) * 53 // 3 : 2, i * 11 : (i + 1) * 11 : 2]
        used = a[cell][..., 3] > 0
        shown = share(middle[cell][used][:, :3], integer).mean(0)
        assert (shown > 0.8).all()
        # the slope in the middle of the way stands for all of it: good to the third order of the gain
        assert np.allclose(result[j, i, :3], shown * gains, atol=2e-3)
        assert result[j, i, 3] == pytest.approx(used.mean(), abs=0.1)


def test_twins_of_the_exposure_scale(monkeypatch: pytest.MonkeyPatch) -> None:
    """A shift keeps black, white and colours' order; on the scale, but for its floor, it is one."""
    c = np.linspace(0.0, 1.0, 101)
    for integer in (0, 1):
        for gain in (-0.7, 0.4):
            moved = common.exposure_shift(c, np.full_like(c, gain), integer)
            assert moved[0] == 0 and (np.diff(moved) > 0).all()
            if integer:
                assert moved[-1] == 1
            known = moved <= 1
            scales = [common.exposure_scale(v[known], integer) for v in (c, moved)]
            seen = (scales[1] - scales[0]) / gain
            # as the slope nowhere between c and moved is beyond these, the difference is not either
            slopes = share(np.linspace(c, moved, 201)[:, known], integer)
            assert (seen >= slopes.min(0) - 1e-9).all() and (seen <= slopes.max(0) + 1e-9).all()
            back = common.exposure_shift(moved, np.full_like(c, -gain), integer)
            assert np.allclose(back[known], c[known])
        assert np.array_equal(common.exposure_shift(c, np.zeros_like(c), integer), c)
    monkeypatch.setattr(common, "EXPOSURE_FLOOR", 0.0)
    c = c[1:-1]
    for integer in (0, 1):
        moved = common.exposure_shift(c, np.full_like(c, 0.4), integer)
        known = moved < 1
        scales = [common.exposure_scale(v[known], integer) for v in (c, moved)]
        assert np.allclose(scales[1] - scales[0], 0.4)


def dense_gains(measured: list, inside: np.ndarray, cells: Grid, rounds: tuple) -> np.ndarray:
    """The minimum of the sum in colour.py, by least squares over all cells of all layers."""
    _, height, width = inside.shape
    index = np.arange(inside.size).reshape(inside.shape)
    latitude = cells.lens[2] - (np.arange(height) + 0.5) * cells.lens[3]
    area = np.maximum(np.cos(latitude), 0.02) if cells.lens[1] else np.ones(height)
    circle = 2 * math.pi / cells.lens[1] if cells.lens[1] else width
    solution = np.zeros((*inside.shape, 3))
    for data, limit in rounds:
        last = rounds is colour._ROUNDS or (data, limit) == rounds[-1]
        fade = max(1.0, (colour._FADE if last else colour._TREND_FADE) * circle)
        rows, targets = [], []

        def term(weight: float, entries: dict[int, float], target: np.ndarray, rows=rows, targets=targets):
            row = np.zeros(inside.size)
            for at, value in entries.items():
                row[at] = value * math.sqrt(weight)
            rows.append(row)
            targets.append(target * math.sqrt(weight))

        nothing = np.zeros(3)
        for k, y, x in np.argwhere(inside):
            term(area[y] / fade**2, {index[k, y, x]: 1}, nothing)
            right = (x + 1) % width
            if (right > x or cells.wraps) and inside[k, y, right]:
                term(1 / area[y], {index[k, y, x]: 1, index[k, y, right]: -1}, nothing)
            if y + 1 < height and inside[k, y + 1, x]:
                term(math.sqrt(area[y] * area[y + 1]), {index[k, y, x]: 1, index[k, y + 1, x]: -1}, nothing)
        for a, b, d in measured:
            for y, x in np.argwhere(d[..., 3] > 0):
                off = solution[a, y, x] - solution[b, y, x] + d[y, x, :3]
                distance = np.linalg.norm(off) if solution.any() else 0.0
                trust = (1 - (distance / limit) ** 2) ** 2 if distance < limit else 0.0
                weight = data * area[y] * d[y, x, 3] * trust
                term(weight, {index[a, y, x]: 1, index[b, y, x]: -1}, -d[y, x, :3])
        solution = np.linalg.lstsq(np.array(rows), np.array(targets), rcond=None)[0].reshape(*inside.shape, 3)
    return solution


def overlapping(seed: int, cells: Grid) -> tuple[list, np.ndarray]:
    """Measured differences of three layers, and which cells each covers."""
    random = np.random.default_rng(seed)
    inside = np.zeros((3, cells.height, cells.width), bool)
    inside[0, :, :6], inside[1, :, 4:], inside[2, 1:3, :3] = True, True, True
    inside[2, 1:3, -2:] = True
    measured = []
    for a, b in ((0, 1), (0, 2), (1, 2)):
        d = random.normal(size=(cells.height, cells.width, 4)) * 0.1 + [0.3, -0.2, 0.1, 0]
        d[..., 3] = random.random(d.shape[:2]) * (inside[a] & inside[b])
        d[0, 4, :3] += 2  # somebody who moved
        measured.append((a, b, d))
    return measured, inside


CELLS = {
    "plane": plane(110, 70).resized(9, 5),
    "cylinder": plane(110, 70, wraps=True).resized(9, 5),
    "sphere": sphere(110, 55).resized(9, 5),
}


@pytest.mark.parametrize("rounds", [colour._ROUNDS, colour._STRICT], ids=["normal", "strict"])
@pytest.mark.parametrize("name", list(CELLS))
def test_solve_is_dense_least_squares(name: str, rounds: tuple[tuple[float, float], ...]) -> None:
    cells = CELLS[name]
    measured, inside = overlapping(0, cells)
    gains = colour.solve(measured, inside, cells, rounds)
    expected = dense_gains(measured, inside, cells, rounds)
    assert np.abs(expected).max() > 0.05
    assert np.allclose(gains, expected, atol=1e-7)
    assert not gains[~inside].any()


def test_cells_grow_where_many_layers_lie_on_each_other() -> None:
    """Up to four layers change nothing; with twice as many, cells are twice as wide."""
    for layers, cells in ((1, 10), (4, 10), (8, 5)):
        assert colour.colour_grid(plane(160, 160), np.ones((layers, 53, 77), bool)).shape == (cells, cells)


@pytest.mark.parametrize("shift", [1, 4])
def test_turning_a_panorama_turns_its_gains(shift: int) -> None:
    measured, inside = overlapping(2, CELLS["sphere"])
    gains = colour.solve(measured, inside, CELLS["sphere"])
    turned = [(a, b, np.roll(d, shift, 1)) for a, b, d in measured]
    again = colour.solve(turned, np.roll(inside, shift, 2), CELLS["sphere"])
    assert np.allclose(np.roll(gains, shift, 2), again, atol=1e-6)


def test_no_difference_is_exactly_no_gain() -> None:
    measured, inside = overlapping(3, CELLS["plane"])
    for _, _, d in measured:
        d[..., :3] = 0
    assert not colour.solve(measured, inside, CELLS["plane"]).any()


def test_gains_reach_two_cells_beyond_a_layer() -> None:
    """A layer's border lies inside a cell; interpolation there must not find zeros."""
    mask = np.zeros((5, 9), bool)
    mask[1:3, 6:] = True
    gain = np.full((5, 9, 3), 0.4) * mask[..., None]
    for wraps in (False, True):
        extended = colour._extend(gain, mask, wraps)
        filled = extended[..., 0] > 0
        expected = ndimage.binary_dilation(np.tile(mask, 3), np.ones((3, 3)), 2)[:, 9:18]
        if not wraps:
            expected[:, :2] = False
        assert np.array_equal(filled, expected)
        assert np.allclose(extended[filled], 0.4)


def test_cells_that_a_layer_reaches_into() -> None:
    covered = np.zeros((2, 53, 77), bool)
    covered[0, 12, 20] = covered[1, 52, 76] = True
    inside = on_cells(covered, CELLS["plane"], np.logical_or)
    assert inside.sum((1, 2)).tolist() == [1, 1]
    assert inside[0, 1, 2]
    assert inside[1, 4, 8]


def scene_of(gain: float, integer: int) -> np.ndarray:
    """A smooth scene, (208, 768, 3), moved by `gain` on the exposure scale."""
    x, y = common.pixels(768, 208)
    grey = 0.5 + 0.25 * np.sin(x / 9 + y / 17) + 0.1 * np.cos(y / 5)
    colours = np.stack([grey, 0.9 * grey, 0.8 * grey], -1)
    return common.exposure_shift(colours, np.full_like(colours, gain), integer)


def exposed(device: Device, gain: float, dtype: type = np.uint8) -> tuple[list[WorkingLayer], Grid]:
    """Two views of one smooth scene; the second is moved by `gain` on the exposure scale."""
    opaque = np.ones((208, 768, 1))
    integer = int(np.dtype(dtype).kind == "u")
    left, right = (np.concatenate([scene_of(g, integer), opaque], 2) for g in (0.0, gain))
    layers = [(left[:, :448], 0), (right[:, 320:], 320)]
    return [on_device(device, pixels, x, 0, dtype) for pixels, x in layers], plane(768, 208)


def corrected(
    device: Device,
    layers: list[WorkingLayer],
    grid: Grid,
    settings: Settings,
    ignored: np.ndarray | None = None,
) -> colour.Correction:
    covered = np.zeros((2, 208, 768), bool)
    covered[0, :, :448] = covered[1, :, 320:] = True
    found = pair_chart(covered.all(0), grid, grid)
    zero = device.zeros((found.height, found.width, 2))
    fields = [device.zeros(layer.pixels.shape) for layer in layers]
    flows = [PairFlow(0, 1, found, zero, zero)]
    measured = colour.differences(device, layers, fields, flows, grid, covered)
    return colour.correction(device, measured, grid, covered, settings, ignored)


@pytest.mark.parametrize(("gain", "dtype"), [(0.5, np.uint8), (-0.3, np.uint16), (0.7, np.float32)])
def test_overlaps_agree_after_correction(device: Device, gain: float, dtype: type) -> None:
    """Each layer gives way by half; the correction fades with the distance from the overlap."""
    layers, grid = exposed(device, gain, dtype)
    result = corrected(device, layers, grid, Settings())
    a, b = (one.get()[..., :3] if one else None for one in result.gains)
    assert result.grid.shape == (13, 48)
    integer = int(np.dtype(dtype).kind == "u")
    overlap = np.s_[:, 336:432]  # columns 21 to 26 of the cells, which both layers fill
    shown = share(scene_of(gain / 2, integer)[overlap], integer).reshape(13, 16, 6, 16, 3).mean((1, 3))
    assert np.allclose((a - b)[:, 21:27] / gain, shown, atol=0.03)
    views = scene_of(0.0, integer)[overlap], scene_of(gain, integer)[overlap]
    finer = (np.kron(g[:, 21:27], np.ones((16, 16, 1))) for g in (a, b))
    matched = [common.exposure_shift(v, g, integer) for v, g in zip(views, finer, strict=True)]
    # what the floor of the scale hides, a twentieth, is left
    assert np.abs(matched[0] - matched[1]).mean() < 0.07 * np.abs(views[0] - views[1]).mean()
    assert np.allclose(a[:, 24] / gain, 0.5, atol=0.1)
    away = np.abs(a[:, :20].mean((0, 2)))
    assert (np.diff(away) > 0).all()
    assert away[0] < 0.2 * away[-1]


def test_equal_layers_are_not_corrected(device: Device) -> None:
    layers, grid = exposed(device, 0.0)
    assert corrected(device, layers, grid, Settings()).gains == (None, None)


def test_exposure_off_is_off(device: Device) -> None:
    layers, grid = exposed(device, 0.5)
    assert corrected(device, layers, grid, Settings(exposure=False)).gains == (None, None)


def test_what_is_ignored_is_no_evidence(device: Device) -> None:
    """The same gains whatever lies there; a cell of which any of it is ignored counts for nothing."""
    gains, ignored = [], np.zeros((104, 384), bool)
    ignored[30:51, 175:190] = True
    for shown in (0.1, 0.9, None):
        layers, grid = exposed(device, 0.5)
        pixels = layers[1].pixels.get()
        if shown is not None:
            pixels[60:102, 30:60, :3] = shown  # at column 320 of the canvas
        layers[1].pixels.set(pixels)
        result = corrected(device, layers, grid, Settings(), None if shown is None else ignored)
        gains.append(np.stack([gain.get() for gain in result.gains]))
        if shown is not None:
            seen = np.stack([g.get() for g in corrected(device, layers, grid, Settings()).gains])
            assert np.abs(seen - gains[-1]).max() > 0.02
    assert np.array_equal(gains[0], gains[1])
    assert np.abs(gains[0] - gains[2]).max() < 0.03  # beside 0.25 each

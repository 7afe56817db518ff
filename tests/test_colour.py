"""Exposure: measured differences against their twin, and what they correct."""

from __future__ import annotations

import numpy as np
import pytest
from grids import GRIDS, on_device, patches, plane, random_layer
from reference import common
from reference.colour import colour_difference, colour_misfit
from scipy import ndimage
from tolerances import POSITION, assert_close

from hugin_abflow import colour
from hugin_abflow.chart import pair_chart
from hugin_abflow.gains import Difference, Measured
from hugin_abflow.geometry import PairFlow
from hugin_abflow.grid import Grid, on_cells
from hugin_abflow.opencl import Device
from hugin_abflow.settings import Settings
from hugin_abflow.working import WorkingLayer

PART, OF_PART = (1, 1, 5, 2), np.s_[1:3, 1:6]
CLIPPED, NEVER, SPREAD = ((0.93, 0.9, 0.95, 1.0), (0.9, 0.95, 0.92, 1.0)), ((1e30,) * 4,) * 2, 0.15


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
    field *= 2 * (grid.lonlat[1] or 1) / np.abs(field).max()
    if not grid.lonlat[1]:
        field[..., 2] = 0
    field[: box[3] // 3, :, :3] = 0
    return field.astype(np.float32)


def two_sides(name: str, lamps: bool = False) -> list:
    """Two layers that overlap, as kernels take them; lamps: each is bright on one side."""
    grid = GRIDS[name]
    sides: list = []
    for i, box in enumerate(((0, 0, 60, grid.height), (9, 1, grid.width - 9, grid.height - 1))):
        pixels = smooth_layer(3 * i, box[2], box[3])
        if lamps:
            bright = np.s_[:, 21:] if i else np.s_[:, :30]
            pixels[bright][..., :3] = 0.95 * (pixels[bright][..., 3:] > 0)
        sides += [pixels, displacement(7 + i, box, grid), box]
    return sides


def uploaded(device: Device, sides: list) -> list:
    return [device.upload(one) if isinstance(one, np.ndarray) else one for one in sides]


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize(("shoulder", "lamps"), [(0.0, False), (0.5, False), (1.0, False), (1.0, True)])
def test_difference_equals_its_twin(device: Device, name: str, shoulder: float, lamps: bool) -> None:
    grid = GRIDS[name]
    cells = grid.resized(7, 3)
    sides = two_sides(name, lamps)
    if not lamps:  # dark ones tell less
        sides[0][..., :3] *= 0.5
        sides[3][..., :3] *= 0.35
    clipped = CLIPPED if shoulder else NEVER
    results = [device.empty(shape) for shape in ((2, 5, 4), (2, 5, 4), (2, 5), (2, 5))]
    device.run(
        "colour", "colour_difference", (5, 2), *uploaded(device, sides),
        grid.border, grid.lonlat, cells.border, PART, shoulder, *clipped, SPREAD, *results,
    )  # fmt: skip
    expected = colour_difference(*sides, grid.border, grid.lonlat, cells.border, shoulder, *clipped, SPREAD)
    if lamps:
        assert set(np.sign(expected[1][..., 3]).ravel()) >= {-1, 1}
    else:
        assert (expected[0][..., 3] > 0.01).mean() > 0.4
    for result, twin in zip(results, expected, strict=True):
        # a pixel more or less at a mask's rim is one of some 30 of a cell
        assert_close(result.get(), twin[OF_PART], 10 * POSITION, decisions=0.05)
        assert np.abs(result.get() - twin[OF_PART]).max() < 0.1


@pytest.mark.parametrize("name", list(GRIDS))
def test_misfit_equals_its_twin(device: Device, name: str) -> None:
    grid, sides, shoulders = GRIDS[name], two_sides(name), (1.0, 0.75, 0.5, 0.25)
    cells = grid.resized(7, 3)
    result = device.empty((2, 5, 4))
    device.run(
        "colour", "colour_misfit", (5, 2), *uploaded(device, sides),
        grid.border, grid.lonlat, cells.border, PART, shoulders, *CLIPPED, result,
    )  # fmt: skip
    expected = colour_misfit(*sides, grid.border, grid.lonlat, cells.border, shoulders, *CLIPPED)
    assert (expected > 1e-3).mean() > 0.4
    assert_close(result.get(), expected[OF_PART], 10 * POSITION, decisions=0.1)


def share(c: np.ndarray, shoulder: float) -> np.ndarray:
    """How much of a small shift of colours c the exposure scale shows: its slope over the shift's own.

    The shift keeps black and white, the scale has a floor under both: dark and nearly white pixels show less
    of a gain than they get, so that their noise is no gain.
    """
    floor = common.EXPOSURE_FLOOR
    rest = 1 - shoulder * c
    return c * rest * (1 / (c + floor) + shoulder / (rest + floor))


def test_twins_of_the_exposure_scale(monkeypatch: pytest.MonkeyPatch) -> None:
    """A shift keeps black, white and colours' order; on the scale, but for its floor, it is one."""
    c = np.linspace(0.0, 1.0, 101)
    for shoulder in (0.0, 0.5, 1.0):
        for gain in (-0.7, 0.4):
            moved = common.exposure_shift(c, np.full_like(c, gain), shoulder)
            known = moved < 1 if 0 < shoulder < 1 else moved <= 1
            assert moved[0] == 0 and (np.diff(moved[known]) > 0).all()
            if shoulder:
                assert moved.max() <= 1
            if shoulder == 1:
                assert moved[-1] == 1
            scales = [common.exposure_scale(v[known], shoulder) for v in (c, moved)]
            seen = (scales[1] - scales[0]) / gain
            # as the slope nowhere between c and moved is beyond these, the difference is not either
            slopes = share(np.linspace(c, moved, 201)[:, known], shoulder)
            assert (seen >= slopes.min(0) - 1e-9).all() and (seen <= slopes.max(0) + 1e-9).all()
            back = common.exposure_shift(moved, np.full_like(c, -gain), shoulder)
            assert np.allclose(back[known], c[known])
        assert np.array_equal(common.exposure_shift(c, np.zeros_like(c), shoulder), c)
    monkeypatch.setattr(common, "EXPOSURE_FLOOR", 0.0)
    c = c[1:-1]
    for shoulder in (0.0, 0.5, 1.0):
        moved = common.exposure_shift(c, np.full_like(c, 0.4), shoulder)
        known = moved < 1
        scales = [common.exposure_scale(v[known], shoulder) for v in (c, moved)]
        assert np.allclose(scales[1] - scales[0], 0.4)


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
    inside = on_cells(covered, plane(110, 70).resized(9, 5), np.logical_or)
    assert inside.sum((1, 2)).tolist() == [1, 1]
    assert inside[0, 1, 2]
    assert inside[1, 4, 8]


def scene_of(gain: float, shoulder: float) -> np.ndarray:
    """A smooth scene, (208, 768, 3), moved by `gain` on the exposure scale."""
    x, y = common.pixels(768, 208)
    grey = 0.5 + 0.25 * np.sin(x / 9 + y / 17) + 0.1 * np.cos(y / 5)
    colours = np.stack([grey, 0.9 * grey, 0.8 * grey], -1)
    return common.exposure_shift(colours, np.full_like(colours, gain), shoulder)


def exposed(device: Device, gain: float, dtype: type = np.uint8) -> tuple[list[WorkingLayer], Grid]:
    """Two views of one smooth scene; the second is moved by `gain` on the exposure scale."""
    opaque = np.ones((208, 768, 1))
    shoulder = float(np.dtype(dtype).kind == "u")
    left, right = (np.concatenate([scene_of(g, shoulder), opaque], 2) for g in (0.0, gain))
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
    still = [np.zeros(layer.pixels.shape, np.float32) + np.float32([0, 0, 0, 1]) for layer in layers]
    fields = [device.upload(field) for field in still]
    flows = [PairFlow(0, 1, found, zero, zero)]
    measured = colour.measure(device, layers, fields, flows, grid, covered)
    return colour.correction(device, measured, settings, ignored)


@pytest.mark.parametrize(("gain", "dtype"), [(0.5, np.uint8), (-0.3, np.uint16), (0.7, np.float32)])
def test_overlaps_agree_after_correction(device: Device, gain: float, dtype: type) -> None:
    """Each layer gives way by half; the correction fades with the distance from the overlap."""
    layers, grid = exposed(device, gain, dtype)
    result = corrected(device, layers, grid, Settings())
    a, b = (one.get()[..., :3] if one else None for one in result.gains)
    assert result.grid.shape == (13, 48)
    shoulder = float(np.dtype(dtype).kind == "u")
    overlap = np.s_[:, 336:432]  # columns 21 to 26 of the cells, which both layers fill
    shown = share(scene_of(gain / 2, shoulder)[overlap], shoulder).reshape(13, 16, 6, 16, 3).mean((1, 3))
    assert np.allclose((a - b)[:, 21:27] / gain, shown, atol=0.03)
    views = scene_of(0.0, shoulder)[overlap], scene_of(gain, shoulder)[overlap]
    finer = (np.kron(g[:, 21:27], np.ones((16, 16, 1))) for g in (a, b))
    matched = [common.exposure_shift(v, g, shoulder) for v, g in zip(views, finer, strict=True)]
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


def test_cells_grow_where_many_layers_lie_on_each_other() -> None:
    """Up to four layers change nothing; with twice as many, cells are twice as wide."""
    for layers, cells in ((1, 10), (4, 10), (8, 5)):
        assert colour.colour_grid(plane(160, 160), np.ones((layers, 53, 77), bool)).shape == (cells, cells)


def test_layers_agree_where_they_are_mixed(device: Device) -> None:
    """What is seen of one layer alone has little to say."""
    cells, inside = GRIDS["plane"].resized(40, 5), np.ones((2, 5, 40), bool)
    values = np.full((5, 40, 4), 1.0)
    values[:, 16:24, :3] = 0.4
    found = []
    for everywhere in (True, False):
        mixing = np.full((5, 40), float(everywhere))
        mixing[:, 16:24] = 1
        difference = Difference(0, 1, values, np.zeros((5, 40, 4)), mixing, mixing)
        measured = Measured(cells, inside, 1.0, (difference,))
        a, b = (gain.get()[..., 0] for gain in colour.correction(device, measured, Settings()).gains)
        found.append(b - a)
    assert np.allclose([one[:, 18:22] for one in found], 0.4, atol=0.01)
    assert (found[0][:, 12:15] > 0.9).all()
    assert (found[1][:, 12:15] < found[0][:, 12:15] - 0.1).all()


@pytest.mark.parametrize("strict", [False, True], ids=["normal", "strict"])
def test_a_difference_goes_on_where_nothing_tells_of_it(device: Device, strict: bool) -> None:
    """As behind somebody who fills an overlap: gains fade out beside it, their difference does not."""
    cells, inside = plane(640, 480).resized(40, 30), np.zeros((2, 30, 40), bool)
    inside[0, :, :23], inside[1, :, 17:] = True, True
    wanted = np.broadcast_to(np.linspace(0.4, 0.7, 30)[:, None, None], (30, 40, 3))
    values = np.concatenate([wanted, inside.all(0)[..., None]], 2)
    somebody = np.zeros((30, 40), bool)
    somebody[10:20] = True
    values[somebody, :3] = -1
    measured = Measured(
        cells, inside, 1.0, (Difference(0, 1, values, np.zeros_like(values), *np.ones((2, 30, 40))),)
    )
    found = colour.correction(device, measured, Settings(), somebody, strict).gains
    one, other = (gain.get()[..., :3] for gain in found)
    off = np.abs(other - one - wanted)[:, 17:23].max((1, 2))
    assert off[somebody[:, 0]].max() < 0.05 and off[~somebody[:, 0]].max() < 0.005
    assert np.abs(one[:, 0]).max() < 0.5 * np.abs(one[:, 20]).max()


@pytest.mark.parametrize(("columns", "counts"), [(1, True), (2, True), (3, False), (6, False)])
def test_what_is_ignored_counts_in_narrow_overlaps(device: Device, columns: int, counts: bool) -> None:
    """Part of which differs by more: that is exposure, not somebody, of whom there would be more beside."""
    cells, inside = plane(640, 480).resized(40, 30), np.zeros((2, 30, 40), bool)
    inside[0, :, : 20 + columns], inside[1, :, 20:] = True, True
    values = np.full((30, 40, 4), 0.2)
    unknown = np.zeros((30, 40), bool)
    unknown[10:20] = True
    values[unknown, :3] = 0.8
    values[..., 3] = inside.all(0)
    measured = Measured(
        cells, inside, 1.0, (Difference(0, 1, values, np.zeros_like(values), *np.ones((2, 30, 40))),)
    )
    found = colour.correction(device, measured, Settings(), unknown).gains
    one, other = (gain.get()[..., 0] for gain in found)
    at = (other - one)[13:17, 20 : 20 + columns]
    assert (at > 0.75).all() if counts else (at < 0.3).all()

"""Filling of flow: kernels against twins, twins against SciPy, flows that are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from grids import patches, plane, sphere, whole_chart
from reference import common
from reference import consistency as twin
from scipy import ndimage
from tolerances import SUM, assert_close

from hugin_abflow import consistency
from hugin_abflow.cells import CELL, SingleSource
from hugin_abflow.chart import Chart
from hugin_abflow.flow import FlowParameters
from hugin_abflow.geometry import PairFlow
from hugin_abflow.grid import Grid
from hugin_abflow.opencl import Device
from hugin_abflow.pyramid import Level

SIZES = [(77, 53), (64, 31), (5, 3), (1, 7), (1, 1)]
WRAPS = [False, True]


def random_trusted(seed: int, width: int, height: int) -> np.ndarray:
    """Flow, trust 0..1 with patches of none, and brightness with steps and patches that tell nothing."""
    random = np.random.default_rng(seed)
    trusted = random.normal(size=(height, width, 4)).astype(np.float32) * 3
    trusted[..., 2] = random.random((height, width)) * patches(seed, width, height, 0.6)
    trusted[..., 3] = random.normal(size=(height, width)) * 0.05 + patches(seed + 1, width, height, 0.5) * 0.7
    trusted[patches(seed + 2, width, height, 0.15) > 0, 3] = twin.EXCLUDED
    return trusted


def random_filled(seed: int, width: int, height: int) -> np.ndarray:
    """Flow without holes."""
    return np.random.default_rng(seed).normal(size=(height, width, 2)).astype(np.float32) * 3


def on_tiles(values: np.ndarray, wraps: bool, by: int = 8) -> np.ndarray:
    """What lies around: another turn, or the border's own value."""
    values = np.pad(values, ((by, by), (0, 0)), mode="edge")
    return np.pad(values, ((0, 0), (by, by)), mode="wrap" if wraps else "edge")


def read_at(values: np.ndarray, x: np.ndarray, y: np.ndarray, wraps: bool, by: int = 8) -> np.ndarray:
    """SciPy's linear interpolation at positions whose pixel centres are at n + 0.5, up to `by` px outside."""
    return ndimage.map_coordinates(on_tiles(values, wraps, by), [y - 0.5 + by, x - 0.5 + by], order=1)


@pytest.mark.parametrize("wraps", WRAPS)
@pytest.mark.parametrize("width", [76, 77])
def test_twin_of_push_is_a_weighted_mean(wraps: bool, width: int) -> None:
    """Every output by hand: taps (1 3 3 1) / 8 in x and y of what lies on the grid."""
    trusted = random_trusted(4, width, 11).astype(np.float64)
    trusted[:6, 10:20, 2] = 0
    small = twin.consistency_push(trusted, (width, 11, int(wraps), 0))
    taps = [1 / 8, 3 / 8, 3 / 8, 1 / 8]
    assert small.shape == (6, (width + 1) // 2, 4)
    for row, column in np.ndindex(small.shape[:2]):
        flows, trusts, bright, weights, told = [], [], [], [], []
        for j in range(4):
            for i in range(4):
                x, y = 2 * column - 1 + i, 2 * row - 1 + j
                if 0 <= y < 11 and (wraps or 0 <= x < width):
                    own = trusted[y, x % width]
                    flows.append(own[:2])
                    trusts.append(own[2])
                    bright.append(own[3])
                    weights.append(taps[i] * taps[j])
                    told.append(weights[-1] * (own[3] < twin.EXCLUDED))
        assert small[row, column, 2] == pytest.approx(np.average(trusts, weights=weights))
        expected = np.average(bright, weights=told) if sum(told) else twin.EXCLUDED
        assert small[row, column, 3] == pytest.approx(expected)
        counted = np.multiply(weights, trusts)
        mean = counted @ np.array(flows) / counted.sum() if counted.sum() else np.zeros(2)
        assert np.allclose(small[row, column, :2], mean)
    assert (small[..., 2] == 0).any()
    assert (small[..., 2] > 0.3).any()
    assert (small[..., 3] == twin.EXCLUDED).any()


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("wraps", WRAPS)
def test_push_equals_its_twin(device: Device, size: tuple[int, int], wraps: bool) -> None:
    trusted = random_trusted(5, *size)
    half = ((size[0] + 1) // 2, (size[1] + 1) // 2)
    small, fine = device.empty((*half[::-1], 4)), (*size, int(wraps), 0)
    device.run("consistency", "consistency_push", half, device.upload(trusted), fine, small, half)
    assert_close(small.get(), twin.consistency_push(trusted, fine), 10 * SUM)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("wraps", WRAPS)
def test_support_equals_its_twin(device: Device, size: tuple[int, int], wraps: bool) -> None:
    small = ((size[0] + 3) // 4, (size[1] + 3) // 4)
    trusted, coarse = random_trusted(15, *size), random_trusted(16, *small)
    level, given = device.upload(trusted), ((*small, int(wraps), 0), 4.0, 0.6)
    fine = (*size, int(wraps), 0)
    device.run("consistency", "consistency_support", size, device.upload(coarse), *given, level, fine)
    assert_close(level.get(), twin.consistency_support(coarse, *given, trusted, fine), 10 * SUM)
    assert np.array_equal(level.get()[..., [0, 1, 3]], trusted[..., [0, 1, 3]])


@pytest.mark.parametrize("wraps", WRAPS)
@pytest.mark.parametrize("width", [76, 77])
def test_twin_of_pull_mixes_with_scipys_zoom(width: int, wraps: bool) -> None:
    trusted, coarse = random_trusted(6, width, 11), random_filled(7, (width + 1) // 2, 6)
    grids = (width, 11, int(wraps), 0), ((width + 1) // 2, 6, int(wraps), 0)
    pulled = twin.consistency_pull(trusted, grids[0], coarse, grids[1])
    columns, rows = common.pixels(width, 11)
    for k in (0, 1):
        below = read_at(coarse[..., k].astype(np.float64), (columns + 0.5) / 2, (rows + 0.5) / 2, wraps)
        expected = below + trusted[..., 2] * (trusted[..., k] - below)
        assert np.allclose(pulled[..., k], expected, atol=1e-5)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("wraps", WRAPS)
def test_pull_equals_its_twin(device: Device, size: tuple[int, int], wraps: bool) -> None:
    half = ((size[0] + 1) // 2, (size[1] + 1) // 2)
    trusted, coarse = random_trusted(8, *size), random_filled(9, *half)
    filled, grids = device.empty((*size[::-1], 2)), ((*size, int(wraps), 0), (*half, int(wraps), 0))
    given = device.upload(trusted), grids[0], device.upload(coarse), grids[1]
    device.run("consistency", "consistency_pull", size, *given, filled)
    assert_close(filled.get(), twin.consistency_pull(trusted, grids[0], coarse, grids[1]), 10 * SUM)


@pytest.mark.parametrize("wraps", WRAPS)
@pytest.mark.parametrize("width", [12, 13])
def test_twin_of_sweeps_ends_at_the_systems_solution(wraps: bool, width: int) -> None:
    """Each pixel is drawn to its own flow and to its neighbours, less across edges."""
    height, own, edge = 7, 16.0, 0.08
    trusted = random_trusted(11, width, height).astype(np.float64)
    counts = own * (trusted[..., 2] / (1.001 - trusted[..., 2])).ravel()
    number = np.arange(width * height).reshape(height, width)
    joints = [(number[:, :-1], number[:, 1:]), (number[:-1], number[1:])]
    if wraps and width % 2 == 0:
        joints.append((number[:, -1:], number[:, :1]))
    matrix = np.diag(counts)
    for one, other in joints:
        for i, j in zip(one.ravel(), other.ravel(), strict=True):
            ends = trusted[..., 3].ravel()[[i, j]]
            difference = 0 if twin.EXCLUDED in ends else ends[0] - ends[1]
            carried = edge**2 / (edge**2 + difference**2)
            matrix[[i, j, i, j], [i, j, j, i]] += np.array([1, 1, -1, -1]) * carried
    expected = np.linalg.solve(matrix, counts[:, None] * trusted[..., :2].reshape(-1, 2))
    filled = random_filled(12, width, height).astype(np.float64)
    for sweep in range(1200):
        filled = twin.consistency_relax(
            trusted, (width, height, int(wraps), 0), own, edge, sweep % 2, 1.5, filled
        )
    assert np.allclose(filled.reshape(-1, 2), expected, atol=1e-6)
    assert np.abs(expected).max() > 1


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("wraps", WRAPS)
@pytest.mark.parametrize("colour", [0, 1])
def test_sweep_equals_its_twin(device: Device, size: tuple[int, int], wraps: bool, colour: int) -> None:
    trusted, filled = random_trusted(13, *size), random_filled(14, *size)
    how = (*size, int(wraps), 0), 16.0, 0.08, colour, 1.5
    level, result = device.upload(trusted), device.upload(filled)
    device.run("consistency", "consistency_relax", (-(-size[0] // 2), size[1]), level, *how, result)
    expected = twin.consistency_relax(trusted, *how, filled)
    assert_close(result.get(), expected, 10 * SUM)
    rest = np.add(*common.pixels(*size)) % 2 != colour
    assert np.array_equal(result.get()[rest], filled[rest])
    assert size == (1, 1) or (result.get() != filled).any()


def test_mix_equals_its_twin(device: Device) -> None:
    trusted, (wide, filled) = random_trusted(10, 77, 53), (random_filled(k, 77, 53) for k in (11, 12))
    level, other, result = (device.upload(values) for values in (trusted, wide, filled))
    device.run("consistency", "consistency_mix", (77, 53), level, (77, 53, 0, 0), other, result)
    assert_close(result.get(), twin.consistency_mix(trusted, wide, filled), SUM)


def test_flow_equals_its_twin(device: Device) -> None:
    trusted, flow = random_trusted(10, 77, 53), device.empty((53, 77, 2))
    device.run("consistency", "consistency_flow", (77, 53), device.upload(trusted), (77, 53, 0, 0), flow)
    assert np.array_equal(flow.get(), twin.consistency_flow(trusted))


# The module


def mended(
    device: Device,
    grid: Grid,
    forward: np.ndarray,
    backward: np.ndarray,
    moved: SingleSource | None = None,
    images: tuple[np.ndarray | None, np.ndarray | None] = (None, None),
    shows: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Both flows mended; images: what the layers show, on the chart; None: nothing. shows: whether that tells
    how flow fits.
    """
    flows = [device.upload(flow.astype(np.float32)) for flow in (forward, backward)]
    pair = PairFlow(0, 1, whole_chart(grid), *flows)
    nothing = np.zeros(forward.shape[:2])
    shown = [device.upload((nothing if one is None else one).astype(np.float32)) for one in images]
    mask = device.upload(np.full(nothing.shape, shows, np.float32))
    levels = [Level(one, mask, pair.chart.wraps) for one in shown]
    result = consistency.fill(device, consistency.weigh(device, pair, levels, FlowParameters(), moved))
    assert (result.a, result.b, result.chart) == (0, 1, pair.chart)
    return result.forward.get(), result.backward.get()


def still(found: Chart) -> np.ndarray:
    return np.zeros((found.height, found.width, 2))


CANVASES = {"plane": plane(97, 61), "cylinder": plane(128, 61, wraps=True), "sphere": sphere(130, 65)}


@pytest.mark.parametrize("name", list(CANVASES))
def test_no_flow_stays_exactly_none(device: Device, name: str) -> None:
    grid = CANVASES[name]
    nothing = still(whole_chart(grid))
    for flow in mended(device, grid, nothing, nothing):
        assert not flow.any()


@pytest.mark.parametrize("name", ["cylinder", "sphere"])
def test_a_flow_that_leads_back_exactly_stays_to_the_bit(device: Device, name: str) -> None:
    there = np.add(still(whole_chart(CANVASES[name])), [2.5, -1.25])
    forward, backward = mended(device, CANVASES[name], there, -there)
    assert np.array_equal(forward, there)
    assert np.array_equal(backward, -there)


@pytest.mark.parametrize("name", list(CANVASES))
def test_consistent_flows_come_out_unchanged(device: Device, name: str) -> None:
    """Of a smooth field, whose inverse is found by iteration: nearly within the interpolation's own error,
    though pixels of it become a quarter smaller."""
    found = whole_chart(CANVASES[name])
    columns, rows = common.pixels(found.width, found.height)
    turn = 4 * math.pi / found.width
    forward = 2 * np.stack([np.sin(turn * columns + rows / 27), np.cos(rows / 21 - turn * columns)], -1)
    backward = np.zeros_like(forward)
    for _ in range(30):  # F_ba(q) = -F_ab(q + F_ba(q))
        x, y = columns + 0.5 + backward[..., 0], rows + 0.5 + backward[..., 1]
        x = x if found.wraps else np.clip(x, 0.5, found.width - 0.5)
        y = np.clip(y, 0.5, found.height - 0.5)
        backward = -np.stack([read_at(forward[..., k], x, y, found.wraps) for k in (0, 1)], -1)
    inner = np.s_[4:-4, 4:-4]  # at the rim flow leads out
    for result, flow in zip(
        mended(device, CANVASES[name], forward, backward), (forward, backward), strict=True
    ):
        assert np.abs(flow[inner]).max() > 1.9
        assert np.abs(result - flow)[inner].max() < 0.01


@pytest.mark.parametrize(("hidden", "expected"), [(False, 0.0), (True, 6.0)])
def test_what_lies_still_beside_a_thing_that_went_is_told_by_what_it_shows(
    device: Device, hidden: bool, expected: float
) -> None:
    """A strip as bright as the thing is filled with the thing's flow, over an edge of what lies still, unless
    it shows the same in both photos: there it lies still as well.
    """
    grid, random = plane(97, 61), np.random.default_rng(4)
    texture = ndimage.gaussian_filter(random.normal(size=(2, 61, 97)), (0, 1, 1))
    texture *= 0.1 / texture.std()
    strip, thing = np.s_[:, 40:55], np.s_[:, 55:]
    a = texture[0] + 1.0
    a[:, 40:] += 2
    b = a.copy()
    b[:, 61:] = a[:, 55:91]
    b[:, 55:61] = texture[1][:, 55:61] + 3
    forward, backward = np.zeros((61, 97, 2)), np.zeros((61, 97, 2))
    forward[thing], backward[:, 61:] = (6, 0), (-6, 0)
    forward[strip], backward[:, 40:61] = (2, 7), (-9, 3)
    if hidden:
        b[strip] = texture[1][strip] + 3
    result, _ = mended(device, grid, forward, backward, images=(a, b), shows=True)
    off = np.abs(result[20:40, 43:52] - [expected, 0])
    assert (np.median(off) < 0.5) if hidden else (off.max() < 0.1)


# Wrong flow is 4 to 9 px off; what is left of that after the mending, in px.
LEFT = 0.15


@pytest.mark.parametrize("centre", [(60, 30), (0, 30)])
def test_a_patch_of_wrong_flow_is_filled_from_around(device: Device, centre: tuple[int, int]) -> None:
    """In one direction only, as behind somebody; in a field that changes slowly; also across the border."""
    columns, rows = common.pixels(128, 61)
    angle = columns * (2 * math.pi / 128)
    forward = np.stack([2 + np.sin(angle), 0.5 * np.cos(angle)], -1)
    # F_ba at the place where F_ab leads; its slope is small
    backward = -np.stack([2 + np.sin(angle - 2 * math.pi / 64), 0.5 * np.cos(angle - 2 * math.pi / 64)], -1)
    away = np.abs(columns - centre[0])
    disc = np.hypot(np.minimum(away, 128 - away), rows - centre[1]) < 9
    wrong = forward + disc[..., None] * [8.0, -3.0]
    results = mended(device, CANVASES["cylinder"], wrong, backward)
    assert np.abs(results[0] - forward)[disc].max() < LEFT
    assert np.abs(results[0] - forward)[~disc].max() < LEFT
    assert np.abs(results[1] - backward).max() < LEFT


@pytest.mark.parametrize("name", ["cylinder", "sphere"])
@pytest.mark.parametrize("column", [0, 15])
def test_flow_of_what_moved_is_filled_from_around(device: Device, name: str, column: int) -> None:
    """It leads there and back exactly, each way from the place where that photo shows it, across the border
    too; what is around stands still."""
    found = whole_chart(CANVASES[name])
    places, flows = [], []
    for at, way in ((column, 7 * CELL), (column + 7, -7 * CELL)):
        cells = np.zeros((found.height // CELL, found.width // CELL), bool)
        cells[4:9, np.arange(at - 2, at + 3) % cells.shape[1]] = True
        there = np.zeros((found.height, found.width, 2))
        there[: CELL * cells.shape[0]][np.kron(cells, np.ones((CELL, CELL), bool))] = way, 0
        places.append(cells)
        flows.append(there)
    filled = mended(device, CANVASES[name], *flows, SingleSource(*places))
    assert max(np.abs(flow).max() for flow in filled) < LEFT
    for kept, flow in zip(mended(device, CANVASES[name], *flows), flows, strict=True):
        # at its outline what is before and what is behind are told apart by brightness, and here is none
        inner = ndimage.binary_erosion(flow[..., 0] != 0, iterations=1)
        assert np.array_equal(kept[inner], flow[inner])


def test_near_flow_counts_before_far(device: Device) -> None:
    """Between two motions a gap takes each side's own near that side."""
    grid = plane(97, 61)
    forward = np.zeros((61, 97, 2))
    forward[:, 50:, 0] = 6.0
    backward = -forward
    backward[:, 53:59] = -6.0
    gap = np.s_[:, 44:56]
    forward[gap] = [-9.0, 30.0]
    result, _ = mended(device, grid, forward, backward)
    assert np.abs(result[:, 44:46]).max() < 1.5
    assert np.abs(result[:, 54:56] - [6.0, 0.0]).max() < 1.5
    middle = result[30, 44:56, 0]
    assert (np.diff(middle) > -0.2).all()


@pytest.mark.parametrize("who", [0, 1])
def test_a_thing_keeps_its_motion_up_to_its_outline(device: Device, who: int) -> None:
    """A band of no trust goes across a bright thing and what is behind it: each is filled with its own flow,
    where that starts on the layer that shows them."""
    grid = plane(97, 61)
    columns, rows = common.pixels(97, 61)
    thing = np.abs(rows - 30 - (columns - 48) / 6) < 9
    outline = ndimage.binary_dilation(thing, iterations=2) & ~ndimage.binary_erosion(thing, iterations=2)
    right = np.where(thing[..., None], [6.0, -2.0], [1.0, 0.5])
    gap = np.abs(columns - 40) < 12
    flows = [np.where(gap[..., None], wrong, right) for wrong in ([-9.0, 30.0], [5.0, 5.0])]
    bright = np.where(thing, 0.0, -1.0)
    images = (bright, None) if who == 0 else (None, bright)
    found = mended(device, grid, flows[0], -flows[1], images=images)
    shown, blind = (np.abs(found[way] * (1 - 2 * way) - right).max(-1) for way in (who, 1 - who))
    assert shown[gap].mean() < 0.7
    for place in (gap, gap & outline):
        assert shown[place].mean() < 0.6 * blind[place].mean()


def test_what_a_near_thing_hides_moves_as_what_is_beside_it(device: Device) -> None:
    """The thing, bright, goes 8 px over what is behind it, which stands still. The flow that was found
    squeezes what is hidden, and more on both sides, and leads back."""
    grid = plane(97, 61)
    columns, _ = common.pixels(97, 61)
    forward, backward = np.zeros((2, 61, 97, 2))
    forward[..., 0] = np.interp(columns + 0.5, [40, 61], [8, 0])
    backward[..., 0] = np.interp(columns + 0.5, [48, 61], [-8, 0])
    right = np.where(columns < 50, 8.0, 0.0)
    images = (np.where(columns < 50, 0.0, -1.0), None)
    result = mended(device, grid, forward, backward, images=images)[0]
    hidden = (columns >= 50) & (columns < 58)
    before, after = (np.abs(flow[..., 0] - right)[hidden].mean() for flow in (forward, result))
    assert after < 0.5 * before
    assert np.abs(result[..., 0] - right).max() < 2  # at the outline, where it was 4


def test_a_line_on_which_wrong_flows_lead_back_counts_little(device: Device) -> None:
    """As between two matches of what repeats: flow of a patch is wrong, and its way back, but for a line."""
    columns, rows = common.pixels(97, 61)
    patch = np.hypot(columns - 45, rows - 30) < 16
    forward = np.where(patch[..., None], [-9.0, 0], [4.0, 0])
    backward = np.full_like(forward, [-4.0, 0])
    backward[30] = [10.0, 0.0]
    result = mended(device, plane(97, 61), forward, backward)[0]
    assert np.abs(result[..., 0] - 4)[patch & (rows != 30)].mean() < 3


def moved_place(grid: Grid) -> tuple[SingleSource, np.ndarray]:
    """Cells that moved, and their pixels."""
    found = whole_chart(grid)
    cells = np.zeros((found.height // CELL, found.width // CELL), bool)
    cells[5:11, 2:8] = True
    place = np.zeros((found.height, found.width), bool)
    place[: CELL * cells.shape[0], : CELL * cells.shape[1]] = np.kron(cells, np.ones((CELL, CELL), bool))
    return SingleSource(cells, cells), place


def test_place_of_what_moved_gets_all_of_the_motion_around(device: Device) -> None:
    """Also where little of the chart is trusted."""
    grid = plane(128, 64)
    moved, place = moved_place(grid)
    forward = np.broadcast_to([10.0, -4.0], (*place.shape, 2))
    backward = np.array(-forward)
    backward[:, 40:] = 30.0
    result, _ = mended(device, grid, forward, backward, moved)
    assert np.abs(result[place] - [10.0, -4.0]).max() < LEFT


def test_place_of_what_moved_does_not_get_what_touches_it(device: Device) -> None:
    """A ring around it was matched with it: there and back again, but wrong."""
    grid = plane(128, 64)
    moved, place = moved_place(grid)
    ring = ndimage.binary_dilation(place, iterations=2) & ~place
    forward = np.where(ring[..., None], [10.0, 6.0], [2.0, -1.0])
    result, _ = mended(device, grid, forward, -forward, moved)
    assert np.abs(result[place] - [2.0, -1.0]).mean() < 2


def disc(grid: Grid, x: float, y: float, radius: float) -> np.ndarray:
    """Pixels within a radius (columns) of a place, on the sphere by angle."""
    columns, rows = common.pixels(grid.width, grid.height)
    points = common.canvas_point(columns + 0.5, rows + 0.5, grid.lonlat)
    middle = common.canvas_point(np.array(x), np.array(y), grid.lonlat)
    if grid.lonlat[1]:
        return np.arccos(np.clip(points @ middle, -1, 1)) < radius * grid.lonlat[1]
    away = np.abs(points[..., 0] - x)
    return np.hypot(np.minimum(away, grid.width - away) if grid.wraps else away, points[..., 1] - y) < radius

"""Flow as it passes between two layers: kernels against twins, and what is to be seen where it passes."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from grids import GRIDS, patches, plane, whole, whole_chart
from reference import common
from reference import intermediate as twin
from tolerances import DECISIONS, POSITION, SUM, assert_close

from hugin_abflow import geometry, intermediate
from hugin_abflow.chart import Chart, pair_chart
from hugin_abflow.geometry import PairFlow
from hugin_abflow.grid import Grid
from hugin_abflow.opencl import Device
from hugin_abflow.settings import Settings

WIDTH, HEIGHT = 61, 43
WAY, AROUND = np.array([7.25, -3.5]), np.array([-2.5, 0.75])


def grid_of(wraps: bool) -> tuple[int, int, int, int]:
    return WIDTH, HEIGHT, int(wraps), 0


def eighths(values: np.ndarray) -> np.ndarray:
    """Numbers with which float32 calculates what these kernels do without rounding."""
    return (np.round(values * 8) / 8).astype(np.float32)


def scene(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Flow from a to b and back, of things before a background, wrong in places; and shares."""
    random = np.random.default_rng(seed)
    things = patches(seed, WIDTH, HEIGHT, 0.3) > 0
    moved = np.roll(things, (-4, 7), (0, 1))
    flow = np.where(things[..., None], WAY, AROUND)
    back = -np.where(moved[..., None], WAY, AROUND)
    for one in (flow, back):
        one += 0.5 * random.normal(size=one.shape)
        one[patches(seed + 1, WIDTH, HEIGHT, 0.1) > 0] *= -1
    share = np.linspace(0.1, 0.9, WIDTH) + 0.1 * random.random((HEIGHT, WIDTH))
    return eighths(flow), eighths(back), eighths(share)


@pytest.mark.parametrize("name", list(GRIDS))
def test_share_equals_its_twin(device: Device, name: str) -> None:
    """On a chart of its own axis, for boxes that overlap in part."""
    grid = GRIDS[name]
    overlap = np.zeros(grid.shape, bool)
    overlap[: grid.height // 2, 20:40] = True
    found = pair_chart(overlap, grid, grid)
    box_a, box_b = (5, 0, 40, 19), (17, 2, 35, 20)
    random = np.random.default_rng(1)
    blend_a, blend_b = (
        (random.random(box[:1:-1]) * patches(2, *box[2:], 0.8)).astype(np.float32) for box in (box_a, box_b)
    )
    out = device.empty((found.height, found.width)).fill(np.nan)
    device.run(
        "intermediate", "intermediate_share", (-(-found.width // 4), found.height),
        device.upload(blend_a), box_a, device.upload(blend_b), box_b, grid.border, grid.lonlat, found.border,
        found.transform, out,
    )  # fmt: skip
    expected = twin.intermediate_share(
        blend_a, box_a, blend_b, box_b, grid.border, grid.lonlat, found.border, found.transform
    )
    assert 0.1 < (expected == 0.5).mean() < 0.9
    u, v = common.pixels(found.width, found.height)
    x, y = common.canvas_position(common.chart_point(u + 0.5, v + 0.5, found.transform), grid.lonlat)
    within = (np.abs(x - np.rint(x)) > POSITION) & (np.abs(y - np.rint(y)) > POSITION)
    assert within.mean() > 0.8  # of the others rounding tells in which pixel they lie
    assert_close(out.get()[within], expected[within], SUM)


@pytest.mark.parametrize("wraps", [False, True])
@pytest.mark.parametrize("seed", [0, 1])
def test_kernels_equal_their_twins(device: Device, wraps: bool, seed: int) -> None:
    """Each on what the twin of the one before makes."""
    grid = grid_of(wraps)
    flow, back, share = scene(seed)
    ways = device.upload(flow), device.upload(back)
    shares = device.upload(share)
    size = grid[:2]

    through = device.empty((HEIGHT, WIDTH, 2))
    device.run("intermediate", "intermediate_direct", size, *ways, grid, shares, through)
    direct = twin.intermediate_direct(flow, back, grid, share)
    assert_close(through.get(), direct, 10 * SUM, decisions=DECISIONS)

    direct = eighths(direct)
    through.set(direct)
    furthest, source = (device.zeros((HEIGHT, WIDTH), np.uint32) for _ in range(2))
    places = device.empty((2, HEIGHT, WIDTH), np.int32)
    device.run("intermediate", "intermediate_follow", (*size, 2), *ways, grid, shares, places)
    corners = twin.intermediate_follow((flow, back), grid, share)
    told = np.where(corners[..., 1] < -1, -1, (corners + 1) @ [1, WIDTH + 1])
    assert 0.1 < (told < 0).mean() < 0.9
    assert (places.get() != told).mean() <= DECISIONS

    places.set(told.astype(np.int32))
    for named in (0, 1):
        device.run(
            "intermediate", "intermediate_pass", (*size, 2), *ways, grid, places, through, named,
            furthest, source,
        )  # fmt: skip
    apart, sources = twin.intermediate_pass((flow, back), grid, corners, direct)
    assert 0.1 < (sources > 0).mean() < 0.9 and (sources > WIDTH * HEIGHT).any()
    assert_close(furthest.get().view(np.float32), apart, SUM, decisions=DECISIONS)
    assert (source.get() != sources).mean() <= DECISIONS

    sources[0, :2] = WIDTH * HEIGHT + 1, WIDTH * HEIGHT  # the first pixel of b, the last one of a
    source.set(sources.astype(np.uint32))
    seen = device.zeros((HEIGHT, WIDTH), np.uint8)
    device.run("intermediate", "intermediate_choose", size, *ways, grid, shares, source, through, seen)
    passing, visible = twin.intermediate_choose(flow, back, grid, share, sources, direct)
    assert 0.02 < visible.mean() < 0.5
    assert_close(through.get(), passing, SUM, decisions=DECISIONS)
    assert (seen.get() != visible).mean() <= DECISIONS

    visible[:2, :2], passing[:2, :2] = True, 9  # the corner counts as well
    passing = passing.astype(np.float32)
    through.set(passing)
    seen.set(visible.astype(np.uint8))
    kept = device.empty((HEIGHT, WIDTH), np.uint8)
    device.run("intermediate", "intermediate_keep", size, through, seen, grid, kept)
    held = twin.intermediate_keep(passing, visible, grid)
    assert held[0, 0] and 0 < held.sum() < visible.sum()
    assert np.array_equal(kept.get(), held)

    ends = device.empty((HEIGHT, WIDTH, 2)), device.empty((HEIGHT, WIDTH, 2))
    device.run("intermediate", "intermediate_fill", size, device.upload(direct), through, kept, grid, *ends)
    replaced = twin.intermediate_fill(direct, passing, held, grid)
    assert_close(ends[0].get(), replaced, SUM)
    assert np.array_equal(ends[1].get(), -ends[0].get())


def replaced(
    device: Device, grid: Grid, found: Chart, ways: Sequence[np.ndarray], share: float
) -> tuple[np.ndarray, np.ndarray]:
    """Intermediate flows between two layers of which the second has `share` everywhere."""
    parts = [whole(device, grid, blend) for blend in (1 - share, share)]
    flows = [PairFlow(0, 1, found, *(device.upload(way.astype(np.float32)) for way in ways))]
    intermediate.replace_flows(device, [p[0] for p in parts], [p[1] for p in parts], flows, grid, Settings())
    return flows[0].forward.get(), flows[0].backward.get()


@pytest.mark.parametrize(("width", "wraps"), [(64, False), (61, False), (128, True)])
def test_settling_is_what_the_twins_do(device: Device, width: int, wraps: bool) -> None:
    """One after the other, of flow that is wrong in places, from both layers."""
    chart = whole_chart(plane(width, HEIGHT, wraps=wraps))
    flow, back = (np.tile(one, (1, 3, 1))[:, :width] for one in scene(3)[:2])
    share, border = np.full((HEIGHT, width), 0.375), chart.border
    direct = twin.intermediate_direct(flow, back, border, share)
    passing, seen = direct, np.zeros((HEIGHT, width), bool)
    corners = twin.intermediate_follow((flow, back), border, share)
    for _ in range(2):
        _, sources = twin.intermediate_pass((flow, back), border, corners, passing)
        passing, its = twin.intermediate_choose(flow, back, border, share, sources, passing)
        seen = seen | its
    kept = twin.intermediate_keep(passing, seen, border)
    expected = twin.intermediate_fill(direct, passing, kept, border)
    assert kept.mean() > 0.02
    found, opposite = replaced(device, plane(width, HEIGHT, wraps=wraps), chart, (flow, back), 0.375)
    assert (np.abs(found - expected).max(-1) > 1e-3).mean() < 1e-3
    assert np.array_equal(opposite, -found)


def bar(left: float, width: int, way: float, around: float) -> tuple[np.ndarray, np.ndarray]:
    """Flows (height, width, 2) of an upright bar that is at `left` in a, and of what is around it."""
    columns, _ = common.pixels(120, 31)
    flow, back = np.zeros((31, 120, 2)), np.zeros((31, 120, 2))
    flow[..., 0] = np.where((columns >= left) & (columns < left + width), way, around)
    back[..., 0] = -np.where((columns >= left + way) & (columns < left + way + width), way, around)
    return flow, back


PLANE = plane(120, 31)
ALL = whole_chart(PLANE)


@pytest.mark.parametrize("share", [0.25, 0.5, 0.8])
@pytest.mark.parametrize("way", [14.0, -14.0])
def test_a_bar_narrower_than_its_way_is_seen_once_between_its_places(
    device: Device, share: float, way: float
) -> None:
    """No flow that starts there knows of it."""
    forward, backward = replaced(device, PLANE, ALL, bar(50, 5, way, 0.0), share)
    first = 50 + share * way
    inside = np.s_[2:-2, math.ceil(first) : math.floor(first + 5)]
    assert np.allclose(forward[inside][..., 0], way, atol=0.1)
    assert np.array_equal(backward, -forward)
    beside = np.ones(120, bool)
    beside[math.floor(first) - 1 : math.ceil(first + 5) + 1] = False
    its = np.abs(forward[2:-2][:, beside][..., 0] - way) < 2
    places = np.flatnonzero(beside)[its.any(0)]
    # but where a photo has it, and what it hides there the other one shows, that is not sure
    ends = [(50 <= x < 55) or (50 + way <= x < 55 + way) for x in places]
    assert all(ends)


def wrong(forward: np.ndarray, left: float, width: int, way: float, around: float, share: float) -> float:
    """The share of a bar's pixels, where it is to be seen, whose flow is not the bar's."""
    columns = np.arange(120) + 0.5 - share * way
    its = (columns >= left) & (columns < left + width)
    off = np.abs(forward[4:-4, :, 0] - np.where(its, way, around)) > 2
    return float(off[:, its].mean())


@pytest.mark.parametrize(("width", "way", "around"), [(8, 4, 20), (8, -4, -20), (6, 4, 16), (6, -3, 14)])
@pytest.mark.parametrize("share", [0.35, 0.5, 0.65])
def test_a_bar_hides_what_moves_further(
    device: Device, width: int, way: float, around: float, share: float
) -> None:
    """What is behind differs more from what both flows tell there, and is the same at its ends, too."""
    forward, _ = replaced(device, PLANE, ALL, bar(50, width, way, around), share)
    assert wrong(forward, 50, width, way, around, share) == 0


def test_single_pixels_that_lead_back_by_chance_change_nothing(device: Device) -> None:
    flow, back = np.zeros((31, 120, 2)), np.zeros((31, 120, 2))
    random = np.random.default_rng(5)
    for x, y in zip(range(10, 90, 9), random.permutation(9) * 3 + 2, strict=True):
        way = random.integers(4, 12)
        flow[y, x, 0], back[y, x + way, 0] = way, -way
    forward, _ = replaced(device, PLANE, ALL, (flow, back), 0.5)
    assert (np.abs(forward[..., 0]) < 1e-3).mean() > 0.98


def test_layers_may_come_in_any_order(device: Device) -> None:
    """Of a bar whose own place in one of them is beside the chart's border as well."""
    for left in (50, 20, 1):
        flow, back = bar(left, 5, 14.0, -2.0)
        forward, _ = replaced(device, PLANE, ALL, (flow, back), 0.5)
        swapped, _ = replaced(device, PLANE, ALL, (back, flow), 0.5)
        assert np.allclose(forward, -swapped, atol=1e-5)


@pytest.mark.parametrize("columns", [5, 23])
def test_where_it_begins_does_not_matter_on_a_cylinder(device: Device, columns: int) -> None:
    grid = plane(128, 31, wraps=True)
    found = whole_chart(grid)
    assert found.wraps and found.width == 128
    flow, back = (np.zeros((31, 128, 2)) for _ in range(2))
    flow[:, 60:65, 0], back[:, 74:79, 0] = 14, -14
    first, _ = replaced(device, grid, found, (flow, back), 0.5)
    flow, back = (np.roll(one, 60 + columns, 1) for one in (flow, back))
    rolled, _ = replaced(device, grid, found, (flow, back), 0.5)
    assert (np.abs(first[4:-4, 68:71, 0] - 14) < 1).all()
    assert np.allclose(np.roll(first, 60 + columns, 1), rolled, atol=1e-4)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3e9, -1e30])
def test_what_is_no_flow_does_not_spread(device: Device, value: float) -> None:
    flow, back = bar(50, 5, 14.0, 0.0)
    flow[15, 20] = value
    forward, _ = replaced(device, PLANE, ALL, (flow, back), 0.5)
    near = forward[4:-4, 57:62][..., 0]
    assert (np.abs(near - 14) < 1)[:, 1:4].all()


@pytest.mark.parametrize("share", [0.3, 0.5])
def test_a_bar_that_stands_still_hides_what_passes_behind_it(device: Device, share: float) -> None:
    forward, _ = replaced(device, PLANE, ALL, bar(50, 5, 0.0, 12.0), share)
    assert not forward[2:-2, 50:55].any()
    assert np.allclose(forward[2:-2, 20:36, 0], 12) and np.allclose(forward[2:-2, 70:100, 0], 12)


def test_what_the_other_layer_hides_is_not_seen_through_it(device: Device) -> None:
    """In b it is behind something that stands still."""
    flow, back = bar(50, 5, 14.0, 0.0)
    back[:] = 0
    forward, _ = replaced(device, PLANE, ALL, (flow, back), 0.5)
    assert not forward[2:-2, 57:62].any()


def test_flows_that_undo_each_other_are_met_on_their_way(device: Device) -> None:
    """With F_ab and F_ba inverse to each other, but not constant, x_b = x_a + F_ab(x_a); p is between."""
    grid = plane(120, 90)
    found = whole_chart(grid)
    x, y = common.pixels(120, 90)
    bend, offset = np.array([0.001, -0.001]), np.array([1.0, 2.0])
    place = np.stack([x, y], -1) + 0.5

    def forward_at(at: np.ndarray) -> np.ndarray:
        return offset + bend * at**2

    backward = (-1 + np.sqrt(1 - 4 * bend * (offset - place))) / (2 * bend) - place
    parts = [whole(device, grid, blend) for blend in (0.4, 0.6)]
    layers, coefficients = [p[0] for p in parts], [p[1] for p in parts]
    ways = [device.upload(way.astype(np.float32)) for way in (forward_at(place), backward)]
    apart, beside = [], []
    for between in (False, True):
        flows = [PairFlow(0, 1, found, *ways)]
        intermediate.replace_flows(device, layers, coefficients, flows, grid, Settings(intermediate=between))
        a, b = geometry.fields(device, layers, coefficients, flows, grid, Settings())
        at_a, at_b = (place + one.get()[..., :2] for one in (a, b))
        inner = np.s_[20:-20, 20:-20]
        apart.append(np.abs(at_b - at_a - forward_at(at_a))[inner].max())
        beside.append(np.abs(at_a + 0.6 * forward_at(at_a) - place)[inner].max())
    assert beside[0] > 0.3 and beside[1] < beside[0] / 5
    assert apart[0] > 0.02 and apart[1] < 0.1


@pytest.mark.parametrize("share", [0.5, 0.8])
def test_a_near_things_outline_goes_with_the_thing(device: Device, share: float) -> None:
    """It ends at column 50 in a and, 8 px on, at 58 in b. Up to its place between, a flow of b tells of it,
    but not one of a: their mean would bend it."""
    columns, _ = common.pixels(120, 31)
    flow, back = np.zeros((31, 120, 2)), np.zeros((31, 120, 2))
    flow[..., 0], back[..., 0] = np.where(columns < 50, 8, 0), np.where(columns < 58, -8, 0)
    forward, _ = replaced(device, PLANE, ALL, (flow, back), share)
    between = forward[5:-5, 51 : math.floor(50 + 8 * share) - 1, 0]
    assert np.abs(between - 8).max() < 0.3
    for far, way in ((np.s_[:, 10:40], 8), (np.s_[:, 70:110], 0)):
        assert np.allclose(forward[far][..., 0], way)

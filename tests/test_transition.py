"""Coefficients of least strain: kernels against twins, and where and how quickly they change over."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from grids import GRIDS, on_device, patches, plane, random_layer, sphere, whole_chart
from reference import transition as twin
from reference.coefficient import coefficient_ratio
from scipy import ndimage
from tolerances import POSITION, SUM, TRIGONOMETRY, assert_close

from hugin_abflow import highlights, transition
from hugin_abflow.chart import pair_chart
from hugin_abflow.coefficient import Masks
from hugin_abflow.geometry import PairFlow
from hugin_abflow.grid import Grid
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.settings import Settings
from hugin_abflow.transition import Shares
from hugin_abflow.working import WorkingLayer

BOX = (9, 1, 60, 37)
STRAIN = Settings().transition_strain


def cells_of(grid: Grid, width: int, height: int) -> Grid:
    return grid.resized(width + width % 2 if grid.wraps else width, height)


def random_cover(seed: int, cells: Grid, layers: int = 3) -> np.ndarray:
    """Which layers have a share, (layers, height, width): any number of them."""
    return np.stack([patches(seed + k, cells.width, cells.height, 0.7, 3) > 0 for k in range(layers)])


def random_shares(seed: int, cover: np.ndarray) -> np.ndarray:
    """Shares (layers, height, width) that sum to 1 wherever a layer is."""
    values = np.random.default_rng(seed).random(cover.shape) * cover
    return (values / np.maximum(values.sum(0), 1e-9)).astype(np.float32)


def upload(device: Device, cells: Grid, cover: np.ndarray, values: np.ndarray) -> Shares:
    shares = Shares.equal(device, cells, cover)
    if cover.any():
        shares.share.set(np.ascontiguousarray(np.moveaxis(values, 0, -1)[np.moveaxis(cover, 0, -1)]))
    return shares


def fetch(shares: Shares, cover: np.ndarray) -> np.ndarray:
    """Shares as an array (layers, height, width)."""
    values = np.zeros((*cover.shape[1:], len(cover)), np.float32)
    where = np.moveaxis(cover, 0, -1)
    values[where] = shares.share.get()[: where.sum()]
    return np.moveaxis(values, -1, 0)


@pytest.mark.parametrize("name", list(GRIDS))
def test_parallax_equals_its_twin(device: Device, name: str) -> None:
    grid = GRIDS[name]
    cells, mask_grid = cells_of(grid, 19, 11), grid.resized(40, 21)
    masks = [patches(k, 40, 21, 0.7).astype(np.uint8) for k in (1, 2)]
    chart = pair_chart((masks[0] & masks[1]) > 0, mask_grid, grid)
    random = np.random.default_rng(3)
    flows = [
        ndimage.gaussian_filter(40 * random.normal(size=(chart.height, chart.width, 2)), (4, 4, 0)).astype(
            np.float32
        )
        for _ in range(2)
    ]
    before = [(most * random.random(cells.shape)).astype(np.float32) for most in (4, 0.5)]
    places = (0, 0, *cells.border[:2]), (3, 2, 12, 7)
    textures = [
        (0.05 * patches(5 + k, *its[2:], 0.35, 3) * random.random(its[:1:-1])).astype(np.float32)
        for k, its in enumerate(places)
    ]
    placed = list(zip(textures, places, strict=True))
    found = [device.upload(one) for one in before]
    chart_grid = (chart.width, chart.height, int(chart.wraps), 0)
    device.run(
        "transition", "transition_parallax", cells.border[:2], *(device.upload(one) for one in flows),
        chart_grid, chart.transform, *(device.upload(one) for one in masks), mask_grid.border,
        device.upload(textures[0]), places[0], device.upload(textures[1]), places[1],
        grid.border, grid.lonlat, cells.border, *found,
    )  # fmt: skip
    expected = twin.transition_parallax(
        flows, chart_grid, chart.transform, masks, placed, grid.border, grid.lonlat, cells.border, before
    )
    for its, was, result in zip(expected, before, found, strict=True):
        assert 0.2 < (its > was).mean() < 1
        assert_close(result.get(), its, 100 * POSITION)


@pytest.mark.parametrize("name", list(GRIDS))
def test_flow_that_is_everywhere_the_same_has_no_strain(device: Device, name: str) -> None:
    """Up to the borders of charts that are coarser than the grid."""
    grid = GRIDS[name]
    cells, everywhere = grid.coarser(4), np.ones((21, 40), np.uint8)
    mask_grid = grid.resized(40, 21)
    chart = pair_chart(everywhere > 0, mask_grid, grid, coarse=2)
    flow = device.upload(np.full((chart.height, chart.width, 2), 8, np.float32))
    mask, texture = device.upload(everywhere), device.upload(np.full(cells.shape, 0.05, np.float32))
    parallax, strain = (device.zeros(cells.shape) for _ in range(2))
    its = texture, (0, 0, *cells.border[:2])
    device.run(
        "transition", "transition_parallax", cells.border[:2], flow, flow, chart.border, chart.transform,
        mask, mask, mask_grid.border, *its, *its, grid.border, grid.lonlat, cells.border, parallax, strain,
    )  # fmt: skip
    assert (parallax.get() > 60).mean() > 0.9 and strain.get().max() < 1e-9


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize("whole", [False, True])
def test_texture_equals_its_twin(device: Device, name: str, whole: bool) -> None:
    """Also of a layer that goes all round, whose ends are beside each other."""
    grid = GRIDS[name]
    cells = cells_of(grid, 19, 11)
    box, place = (BOX, (2, 1, 15, 9)) if not whole else ((0, 0, *grid.border[:2]), (0, 0, *cells.border[:2]))
    layer, found = random_layer(4, *box[2:], 0.8), device.empty((place[3], place[2]))
    device.run(
        "transition", "transition_texture", place[2:], device.upload(layer), box, grid.border, cells.border,
        place, found,
    )  # fmt: skip
    expected = twin.transition_texture(layer, box, grid.border, cells.border, place)
    assert 0.2 < (expected > 0).mean() < 1
    assert_close(found.get(), expected, 10 * SUM)


@pytest.mark.parametrize("name", list(GRIDS))
def test_refining_equals_its_twin(device: Device, name: str) -> None:
    grid = GRIDS[name]
    coarse, fine = cells_of(grid, 7, 5), cells_of(grid, 15, 9)
    cover, fine_cover = random_cover(1, coarse), random_cover(5, fine)
    values = random_shares(2, cover)
    shares, result = upload(device, coarse, cover, values), Shares.equal(device, fine, fine_cover)
    device.run(
        "transition", "transition_refine", fine.border[:2], shares.share, shares.first, shares.owner,
        coarse.border, result.first, result.owner, fine.border, result.share,
    )  # fmt: skip
    expected = twin.transition_refine(values, coarse.border, fine_cover)
    assert_close(fetch(result, fine_cover), expected, 10 * SUM)


def random_system(seed: int, cover: np.ndarray, cells: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    price = 1 + 20 * random.random(cells.shape)
    east, south = transition.links(price, cover.any(0), cells)
    return east, south, (60 * random.random(cells.shape)).astype(np.float32)


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize("colour", [0, 1])
def test_a_step_equals_its_twin(device: Device, name: str, colour: int) -> None:
    cells = cells_of(GRIDS[name], 15, 9)
    cover = random_cover(1, cells, 4)
    values, system = random_shares(2, cover), random_system(3, cover, cells)
    shares = upload(device, cells, cover, values)
    device.run(
        "transition", "transition_relax", (-(-cells.width // 2), cells.height), shares.share, shares.first,
        shares.owner, cells.border, *map(device.upload, system), 0.7, colour, 1.6,
    )  # fmt: skip
    expected = twin.transition_relax(values, cover, *system, 0.7, colour, 1.6)
    assert (expected != values).mean() > 0.15
    assert_close(fetch(shares, cover), expected, 10 * SUM)


def test_shares_that_rounding_leaves_in_doubt_are_found(device: Device) -> None:
    """Where a share is all but 0, it may be above the threshold without it and below that with it."""
    cells = plane(1000, 50)
    cover = np.ones((3, 50, 1000), bool)
    random = np.random.default_rng(4)
    values = random.random(cover.shape).astype(np.float32)
    values[1] = ((values[0] - 1).view(np.int32) + random.integers(-2, 3, cells.shape, np.int32)).view(
        np.float32
    )
    values[2] = -5
    shares, one = upload(device, cells, cover, values), device.zeros(cells.shape).fill(1)
    for colour in (0, 1):
        device.run(
            "transition", "transition_relax", (500, 50), shares.share, shares.first, shares.owner,
            cells.border, one, one, device.zeros(cells.shape), 0.0, colour, 0.0,
        )  # fmt: skip
    found = fetch(shares, cover)
    assert found[0] == pytest.approx(1, abs=1e-6) and found[1:] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("name", list(GRIDS))
def test_expanding_equals_its_twins(device: Device, name: str) -> None:
    grid = GRIDS[name]
    box = (BOX[0], BOX[1], BOX[2], min(BOX[3], grid.height - 2))
    cells = cells_of(grid, 13, 7)
    cover = random_cover(1, cells)
    values = random_shares(2, cover)
    shares = upload(device, cells, cover, values)
    random = np.random.default_rng(3)
    blend = np.clip(1.4 * random.random((box[3], box[2])) - 0.2, 0, 1).astype(np.float32)
    total = random.random(grid.shape).astype(np.float32)
    expanded, sums = device.upload(blend), device.upload(total)
    device.run(
        "transition", "transition_expand", box[2:], expanded, box, grid.border,
        shares.share, shares.first, shares.owner, cells.border, 1, sums,
    )  # fmt: skip
    expected = twin.transition_expand(blend, box, grid.border, values[1], cells.border)
    assert 0.5 < ((blend > 0) & (blend < 1)).mean() < 1
    assert_close(expanded.get(), expected, 10 * SUM)
    expected_sums = total.astype(np.float64)
    expected_sums[box[1] : box[1] + box[3], box[0] : box[0] + box[2]] += expected
    assert_close(sums.get(), expected_sums, 10 * SUM)
    device.run("coefficient", "coefficient_ratio", box[2:], expanded, box, grid.border, sums)
    assert_close(expanded.get(), coefficient_ratio(expected, box, expected_sums), TRIGONOMETRY)


def test_shares_are_listed_by_cell_and_layer(device: Device) -> None:
    cells = plane(2, 1)
    cover = np.array([[[True, False]], [[True, False]], [[True, True]]])
    shares = Shares.equal(device, cells, cover)
    assert shares.first.get().tolist() == [0, 3, 4]
    assert shares.owner.get().tolist() == [0, 1, 2, 2]
    assert shares.share.get() == pytest.approx([1 / 3, 1 / 3, 1 / 3, 1])
    assert Shares.equal(device, cells, np.zeros((2, 1, 2), bool)).first.get().tolist() == [0, 0, 0]


def test_links_of_a_sphere_are_those_of_its_surface() -> None:
    """Between rows a border gets shorter towards the poles, and columns lie nearer to each other."""
    cells = sphere(40, 20)
    east, south = transition.links(np.full(cells.shape, 2.0), np.ones(cells.shape, bool), cells)
    latitudes = math.pi / 2 - (np.arange(20) + 0.5) * math.pi / 20
    assert east == pytest.approx(np.repeat(2 / np.cos(latitudes)[:, None], 40, 1), rel=1e-5)
    between = math.pi / 2 - (np.arange(19) + 1) * math.pi / 20
    assert south[:-1] == pytest.approx(np.repeat(2 * np.cos(between)[:, None], 40, 1), rel=1e-5)
    assert not south[-1].any()


def test_wells_are_as_large_as_their_cells() -> None:
    """On a plane all alike but where flow bends things, on a sphere less towards the poles, and none where
    layers are uneven.
    """
    calm, uneven = (np.zeros((2, 4), np.float32) for _ in range(2))
    uneven[1, 2] = 1
    flat = transition.wells(plane(8, 4), plane(80, 40), 0.5, calm, uneven)
    assert flat[:2] == pytest.approx(100) and flat[2:, :4] == pytest.approx(100)
    assert not flat[2:, 4:6].any() and flat[2:, 6:] == pytest.approx(100)
    coarse = transition.wells(plane(2, 1), plane(80, 40), 0.5, calm, uneven)
    # of all cells below, in equal parts
    assert coarse[0] == pytest.approx([1600, 1600 * 3 / 4])
    bent = np.zeros((4, 8))
    bent[1, 3] = 0.7
    flat = transition.wells(plane(8, 4), plane(80, 40), 0.5, bent, uneven)
    assert flat[1, 3] == pytest.approx(170) and flat[1, 2] == pytest.approx(100)
    assert not transition.wells(plane(8, 4), plane(80, 40), 0.5, bent, np.ones((1, 1))).any()
    curved = transition.wells(sphere(40, 20), sphere(400, 200), 0.5, *np.zeros((2, 1, 1)))
    latitudes = math.pi / 2 - (np.arange(20) + 0.5) * math.pi / 20
    assert curved == pytest.approx(np.repeat(100 * np.cos(latitudes)[:, None], 40, 1), rel=1e-5)


def test_cells_that_no_layer_covers_whole_are_shared_by_those_that_reach_into_them() -> None:
    masks = np.zeros((2, 8, 16), bool)
    masks[0, :, :6], masks[1, :, 6:] = True, True
    (cover,) = transition._covers(masks, [plane(4, 2)])
    assert cover[:, 0].tolist() == [[True, True, False, False], [False, True, True, True]]


def test_links_lead_along_the_union_alone() -> None:
    cells, union = plane(4, 3), np.ones((3, 4), bool)
    union[1, 2] = False
    price = np.ones((3, 4))
    price[0, 1] = 3.0
    east, south = transition.links(price, union, cells)
    assert east.tolist() == [[1.5, 1.5, 1, 0], [1, 0, 0, 0], [1, 1, 1, 0]]
    assert south.tolist() == [[1, 1.5, 0, 1], [1, 1, 0, 1], [0, 0, 0, 0]]
    around, _ = transition.links(price, union, plane(4, 3, wraps=True))
    assert around[:, 3].tolist() == [1, 1, 1]


Scene = tuple[list[WorkingLayer], list[Buffer], list[PairFlow], Masks]


def scene(device: Device, grid: Grid, covers: Sequence[np.ndarray], shift: np.ndarray) -> Scene:
    """Layers that cover parts of a plane, change over as published, and shift by `shift` px to the right from
    each to the next: (height, width).
    """
    everything = [
        random_layer(k, grid.width, grid.height, 1.0) * one[..., None] for k, one in enumerate(covers)
    ]
    distances = [ndimage.distance_transform_edt(np.pad(one, 1, mode="edge"))[1:-1, 1:-1] for one in covers]
    blends = np.stack(distances) / np.maximum(np.sum(distances, 0), 1e-9)
    coefficients = [device.upload(w.astype(np.float32)) for w in blends]
    masks = Masks(
        grid, tuple(device.upload(one.astype(np.uint8)) for one in covers), np.stack(covers).astype(bool)
    )
    flows = []
    for a in range(len(covers)):
        for b in range(a + 1, len(covers)):
            chart = whole_chart(grid)
            x = np.arange(chart.width) - chart.transform[11]
            y = np.arange(chart.height) - chart.transform[12]
            read = [np.clip(np.rint(n).astype(int), 0, m - 1) for n, m in ((y, grid.height), (x, grid.width))]
            field = np.zeros((chart.height, chart.width, 2), np.float32)
            field[..., 0] = (b - a) * shift[np.ix_(*read)]
            flows.append(PairFlow(a, b, chart, device.upload(field), device.upload(-field)))
    layers = [on_device(device, pixels) for pixels in everything]
    return layers, coefficients, flows, masks


def minimised(
    device: Device, grid: Grid, made: Scene, settings: Settings | None = None, uneven: float = 0.0
) -> list[np.ndarray]:
    layers, coefficients, flows, masks = made
    everywhere = np.full(highlights.highlights_grid(grid).shape, uneven, np.float32)
    transition.minimise_strain(
        device, layers, coefficients, flows, masks, grid, settings or Settings(), everywhere
    )
    return [one.get() for one in coefficients]


def left_and_right(grid: Grid, border: int) -> list[np.ndarray]:
    """Two masks that share all but `border` columns at each side."""
    columns = np.indices(grid.shape)[1]
    return [columns < grid.width - border, columns >= border]


WIDE = plane(301, 61)


@pytest.mark.parametrize("flow", [4.0, 8.0])
def test_a_transition_strains_as_wanted_in_a_wide_overlap(device: Device, flow: float) -> None:
    made = scene(device, WIDE, left_and_right(WIDE, 20), np.full(WIDE.shape, flow))
    first, second = minimised(device, WIDE, made)
    assert np.allclose(first + second, 1, atol=1e-6)
    assert (np.diff(second, axis=1) >= -1e-4).all()
    steepest = ndimage.gaussian_filter1d(second, 4, axis=1)
    parallax = math.hypot(flow, transition._LEAST_PARALLAX)
    assert parallax * np.diff(steepest, axis=1).max() == pytest.approx(STRAIN, rel=0.1)
    assert np.count_nonzero((second[30] > 0.01) & (second[30] < 0.99)) == pytest.approx(
        math.pi * parallax / (2 * STRAIN), rel=0.15
    )


@pytest.mark.parametrize("flow", [25.0, 100.0])
def test_a_transition_takes_the_overlap_if_that_is_narrow(device: Device, flow: float) -> None:
    made = scene(device, WIDE, left_and_right(WIDE, 130), np.full(WIDE.shape, flow))
    before = made[1][1].get()
    second = minimised(device, WIDE, made)[1]
    assert second == pytest.approx(before, abs=0.08)


def test_layers_that_are_not_alike_change_over_across_the_overlap(device: Device) -> None:
    made = scene(device, WIDE, left_and_right(WIDE, 20), np.full(WIDE.shape, 1.0))
    before = made[1][1].get()
    assert minimised(device, WIDE, made, uneven=1.0)[1] == pytest.approx(before, abs=0.03)


def test_a_near_thing_within_the_overlap_is_one_photo_s(device: Device) -> None:
    """A box that shifts by 20 px before a wall that does not: the transition runs beside it. As published, it
    would be shown halfway between its places.
    """
    shift = np.zeros(WIDE.shape)
    shift[20:, 120:200] = 20
    made = scene(device, WIDE, left_and_right(WIDE, 20), shift)
    assert (np.ptp(made[1][0].get()[25:, 120:200], axis=1) > 0.25).all()
    first = minimised(device, WIDE, made)[0][25:, 124:196]
    assert min(first.max(), (1 - first).max()) < 0.03


def test_a_transition_runs_where_nothing_is_to_be_seen(device: Device) -> None:
    """Of an overlap that shifts by 20 px all over, the left half shows something: it is one photo's."""
    made = scene(device, WIDE, left_and_right(WIDE, 20), np.full(WIDE.shape, 20.0))
    for layer in made[0]:
        pixels = layer.pixels.get()
        pixels[:, 200 - layer.box[0] :, :3] = 0.5
        layer.pixels.set(pixels)
    first = minimised(device, WIDE, made)[0]
    assert (first[:, 20:170] > 0.97).all()
    assert np.allclose(first[:, 190:].min(1), 0, atol=0.02)


def test_what_crosses_the_overlap_bends_little_more_than_wanted(device: Device) -> None:
    """Least far from its outline, where flow bends everything by itself: there the transition is narrower."""
    grid = plane(301, 241)
    shift = np.zeros(grid.shape)
    shift[60:] = 15
    second = minimised(device, grid, scene(device, grid, left_and_right(grid, 20), shift))[1]
    strain = 15 * np.diff(second, axis=1).max(1)
    assert strain[150:].min() > STRAIN and strain[150:].max() < 1.2 * STRAIN
    assert 1.5 * STRAIN < strain[64:].max() < 1.8 * STRAIN


def test_a_transition_avoids_where_flow_is_torn(device: Device) -> None:
    """An overlap shifts by 8 px all over, in one half now to the left and now to the right: the transition is
    in the other half.
    """
    shift = np.full(WIDE.shape, 8.0)
    shift[:, 20:150] *= np.repeat(np.random.default_rng(5).choice([-1, 1], (WIDE.height, 65)), 2, 1)
    covers = left_and_right(WIDE, 20)
    second = minimised(device, WIDE, scene(device, WIDE, covers, shift))[1]
    assert second[:, 20:130].max() < 0.05
    assert 8 * np.diff(second, axis=1).max() < 2 * STRAIN


def test_three_layers_share_what_all_of_them_cover(device: Device) -> None:
    """They sum to 1, each is 0 where it is not, and the transition does not depend on their order."""
    columns, rows = np.indices(WIDE.shape)[::-1]
    covers = [columns < 200, columns >= 90, (rows >= 25) & (columns > 60) & (columns < 240)]
    shift = np.full(WIDE.shape, 3.0)
    found = minimised(device, WIDE, scene(device, WIDE, covers, shift))
    assert np.allclose(np.sum(found, 0), 1, atol=1e-6)
    for one, cover in zip(found, covers, strict=True):
        assert not one[~cover].any() and (one >= 0).all()
    turned = minimised(device, WIDE, scene(device, WIDE, covers[::-1], shift))
    assert np.allclose(found, turned[::-1], atol=0.02)


def test_off_and_without_flow_nothing_is_wanted(device: Device) -> None:
    flows = scene(device, WIDE, left_and_right(WIDE, 20), np.ones(WIDE.shape))[2]
    assert transition.wanted(flows, Settings())
    assert not transition.wanted([], Settings())
    assert not transition.wanted(flows, Settings(transition_strain=0))


def test_more_sweeps_change_little(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    shift = np.zeros(WIDE.shape)
    shift[20:, 120:200] = 20
    few = minimised(device, WIDE, scene(device, WIDE, left_and_right(WIDE, 20), shift))[0]
    monkeypatch.setattr(transition, "_SWEEPS", 2000)
    many = minimised(device, WIDE, scene(device, WIDE, left_and_right(WIDE, 20), shift))[0]
    assert np.abs(few - many).mean() < 0.01

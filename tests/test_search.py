"""The search's kernels against twins, and twins against brute force."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from grids import patches
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import common
from reference import search as twin
from scipy import ndimage
from tolerances import DECISIONS, SUM, TRIGONOMETRY, assert_close

from hugin_abflow import search
from hugin_abflow.grid import Border
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.search import SearchParameters

GRIDS = {"plane": Border(37, 23, 0), "cylinder": Border(38, 23, 1), "odd cylinder": Border(37, 23, 1)}
REACH = (4, 3)


def noise(seed: int, grid: tuple[int, int, int, int], channels: int, sigma: float) -> np.ndarray:
    values = np.random.default_rng(seed).normal(size=(grid[1], grid[0], channels))
    values = ndimage.gaussian_filter(values, (sigma, sigma, 0), mode=["nearest", "wrap", "nearest"])
    return (values / values.std()).astype(np.float32)


def descriptors(seed: int, grid: tuple[int, int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """b is a, moved by (2, -1) and a little changed; each has a ragged mask of its own."""
    a = noise(seed, grid, 4, 1.0)
    b = np.roll(a, (-1, 2), (0, 1)) + 0.2 * noise(seed + 1, grid, 4, 1.0)
    for index, image in enumerate((a, b)):
        image[..., 3] = 1
        image *= patches(seed + 2 + index, grid[0], grid[1], 0.85, 6)[..., None]
    return a, b


def run(device: Device, name: str, grid: tuple[int, int, int, int], *arguments: object, channels: int = 2):
    """One output over the grid; arrays among the arguments are uploaded, each once."""
    arrays = {
        id(v): device.upload(v.astype(np.uint8 if v.dtype == bool else np.float32))
        for v in arguments
        if isinstance(v, np.ndarray)
    }
    sent = [arrays.get(id(v), v) for v in arguments]
    out = device.empty((grid[1], grid[0], channels))
    device.run("search", name, grid[:2], *sent, out)
    return out.get()


def planes(device: Device, descriptor: np.ndarray, grid: Border) -> Buffer:
    """Descriptors as kernels take them."""
    wide = search._pitch(grid.width) + 2 * search._MARGIN
    target = device.empty((grid[1], 4, wide))
    device.run(
        "search", "search_planes", (wide, grid[1]), device.upload(descriptor, np.float32), grid, wide, target
    )
    return target


def choose(
    device: Device, a: np.ndarray, b: np.ndarray, own: np.ndarray, other: np.ndarray,
    grid: tuple[int, int, int, int], *arguments: object,
) -> np.ndarray:  # fmt: skip
    """`search_choose` of descriptors (height, width, 4)."""
    both = [planes(device, image, grid) for image in (a, b)]
    return run(device, "search_choose", grid, *both, own, other, grid, both[0].shape[2], *arguments)


def descriptor(
    device: Device, feature: np.ndarray, grid: tuple[int, int, int, int], noise: float
) -> np.ndarray:
    """What `search_energy` and `search_descriptor` make of features."""
    energy = run(device, "search_energy", grid, feature, grid)
    return run(device, "search_descriptor", grid, feature, energy, grid, noise, channels=4)


@pytest.mark.parametrize("name", list(GRIDS))
def test_energy_equals_its_twin(device: Device, name: str) -> None:
    grid = GRIDS[name]
    feature, _ = descriptors(1, grid)
    found = run(device, "search_energy", grid, feature, grid)
    assert_close(found, twin.search_energy(feature, grid), SUM)


@pytest.mark.parametrize("name", list(GRIDS))
def test_descriptor_equals_its_twin(device: Device, name: str) -> None:
    grid = GRIDS[name]
    feature, _ = descriptors(1, grid)
    expected = twin.search_descriptor(feature, grid, 0.05)
    assert_close(descriptor(device, feature, grid, 0.05), expected, TRIGONOMETRY)


def test_descriptor_is_blind_to_contrast(device: Device) -> None:
    """But for the noise floor."""
    grid = GRIDS["plane"]
    feature, _ = descriptors(3, grid)
    strong = feature * np.float32([5, 5, 5, 1])
    both = [descriptor(device, one, grid, 0.0) for one in (feature, strong)]
    assert_close(both[0], both[1], TRIGONOMETRY)


@pytest.mark.parametrize("name", list(GRIDS))
def test_costs_equal_their_twin(device: Device, name: str) -> None:
    grid = GRIDS[name]
    a, b = descriptors(5, grid)
    sent = planes(device, a, grid), planes(device, b, grid)
    room = [device.empty((grid[1], 63, search._pitch(grid.width))) for _ in range(2)]
    cost = search.costs(device, *sent, grid, REACH, 0.5, room).get()
    assert_close(np.moveaxis(cost[..., : grid[0]], 1, 0), twin.costs(a, b, grid, REACH, 0.5), SUM)


@pytest.mark.parametrize("name", list(GRIDS))
def test_costs_of_pixels_reach_beyond_borders(device: Device, name: str) -> None:
    """By a column, as the mean of 3 x 3 pixels does."""
    grid = GRIDS[name]
    images = descriptors(5, grid)
    both = [planes(device, image, grid) for image in images]
    wide = both[0].shape[2]
    for image, found in zip(images, both, strict=True):
        assert_close(found.get(), twin.search_planes(image, grid, search._MARGIN, wide), 0)
    count = (2 * REACH[0] + 1) * (2 * REACH[1] + 1)
    cost = device.empty((grid[1], count, 48))
    device.run("search", "search_pixel_cost", (6 * count * grid[1],), *both, grid, REACH, wide, 0.5, 48, cost)
    expected = twin.search_pixel_cost(*images, grid, REACH, 0.5)
    mode = {"mode": "wrap"} if grid[2] else {"constant_values": -1}
    expected = np.pad(expected, ((0, 0), (0, 0), (1, 1)), **mode)
    assert_close(np.moveaxis(cost.get()[..., : grid[0] + 2], 1, 0), expected, SUM)


def volume(cost: np.ndarray) -> np.ndarray:
    """Costs (displacements, height, width) as kernels take them; the columns behind them tell nothing."""
    rows = np.moveaxis(cost, 0, 1)
    return np.pad(rows, ((0, 0), (0, 0), (0, 48 - cost.shape[2])), constant_values=np.nan)


def test_twin_of_cost_by_hand() -> None:
    grid = GRIDS["plane"]
    a, b = descriptors(7, grid)
    cost = twin.costs(a, b, grid, REACH, 0.5)
    for y, x, u, v in ((10, 12, 2, -1), (0, 0, -4, -3), (22, 36, 4, 3)):
        seen = []
        for q, p in np.ndindex(3, 3):
            at, to = (y + q - 1, x + p - 1), (y + q - 1 + v, x + p - 1 + u)
            if 0 <= at[0] < 23 and 0 <= at[1] < 37 and a[at][3]:
                inside = 0 <= to[0] < 23 and 0 <= to[1] < 37 and b[to][3] > 0
                e = float(((a[at][:3].astype(float) - b[to][:3]) ** 2).sum()) if inside else 0.0
                seen.append(e / (e + 0.5) if inside else 0.5)
        assert cost[(v + 3) * 9 + u + 4, y, x] == pytest.approx(np.mean(seen) if seen else 0.5)


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize("coupling", [0.0, 0.03])
def test_best_equals_its_twin(device: Device, name: str, coupling: float) -> None:
    grid = GRIDS[name]
    cost = twin.costs(*descriptors(9, grid), grid, REACH, 0.5).astype(np.float32)
    near = 2 * noise(13, grid, 2, 3)
    out = device.empty((grid[1], grid[0], 2))
    sent = device.upload(volume(cost), np.float32), device.upload(near, np.float32)
    device.run("search", "search_best", (5 * grid[1],), *sent, grid, REACH, coupling, 48, out)
    best = out.get()
    assert_close(best, twin.search_best(cost, near, REACH, coupling), 0, DECISIONS)
    assert (best == (2, -1)).all(-1).mean() > 0.3


@settings(max_examples=40)
@given(
    width=st.integers(1, 40), height=st.integers(1, 5), seed=st.integers(0, 2**32 - 1),
    reach=st.tuples(st.integers(0, 5), st.integers(0, 5)), coupling=st.sampled_from([0.001, 0.03, 0.3, 10.0]),
    spread=st.sampled_from([0.0, 0.3, 8.0]), zeros=st.sampled_from([0.0, 0.5, 1.0]),
)  # fmt: skip
def test_best_tries_all_that_could_be(
    device: Device, width: int, height: int, seed: int, reach: tuple[int, int], coupling: float,
    spread: float, zeros: float,
) -> None:  # fmt: skip
    """Wherever flow is, within reach or beyond, and however it differs among those that are tried together:
    what is found costs what the best of all does.
    """
    rng, grid = np.random.default_rng(seed), Border(width, height, 0)
    count = (2 * reach[0] + 1) * (2 * reach[1] + 1)
    cost = rng.random((count, height, width)) * (rng.random((count, height, width)) >= zeros)
    cost = cost.astype(np.float32)
    flow = rng.normal(0, 4, (1, 1, 2)) + rng.normal(0, 1, (height, width, 2)) * spread
    flow = flow.astype(np.float32)
    out = device.empty((height, width, 2))
    sent = device.upload(volume(cost), np.float32), device.upload(flow, np.float32)
    device.run("search", "search_best", (-(-width // 8) * height,), *sent, grid, reach, coupling, 48, out)
    found = out.get()
    index = ((found[..., 1] + reach[1]) * (2 * reach[0] + 1) + found[..., 0] + reach[0]).astype(int)
    total = cost + coupling * ((np.array(twin.displacements(reach))[:, None, None] - flow) ** 2).sum(-1)
    paid = np.take_along_axis(total, index[None], 0)[0]
    assert (np.abs(found) <= reach).all()
    assert_close(paid, total.min(0), 1e-5)


@pytest.mark.parametrize("name", list(GRIDS))
def test_found_is_the_same_whichever_image_comes_first(device: Device, name: str) -> None:
    """Up to the borders of ragged masks, and of the grid."""
    grid = GRIDS[name]
    images = descriptors(15, grid)
    a, b = (planes(device, one, grid) for one in images)
    starts = [0.3 * noise(seed, grid, 2, 3) + sign * np.float32([1, 0]) for seed, sign in ((27, 1), (29, -1))]
    flows = [device.upload(one) for one in starts]
    how = replace(SearchParameters(), distinct=0.05)
    there, back = (one.get() for one in search.exhaustive(device, a, b, flows, grid, 4, how))
    turned = [one.get() for one in search.exhaustive(device, b, a, flows[::-1], grid, 4, how)]
    assert np.array_equal(there, turned[1]) and np.array_equal(back, turned[0])
    for found, start, true, pair in (
        (there, starts[0], (2, -1), images), (back, starts[1], (-2, 1), images[::-1]),
    ):  # fmt: skip
        kept, right = (found == start).all(-1), (found == true).all(-1)
        assert 0.2 < right.mean() < 0.9 and kept.mean() > 0.05
        cost = twin.costs(*pair, grid, (4, 4), how.outside)
        distinct = twin.search_distinct(cost, np.where(kept[..., None], 0, found), (4, 4), how.distinct)
        assert distinct[~kept].mean() > 1 - DECISIONS


@pytest.mark.parametrize("name", list(GRIDS))
def test_mean_equals_its_twin_and_scipys(device: Device, name: str) -> None:
    grid = GRIDS[name]
    values = noise(17, grid, 2, 1)
    expected = twin.search_mean(values, grid)
    assert_close(run(device, "search_mean", grid, values, grid), expected, SUM)
    plain = ndimage.uniform_filter(values.astype(np.float64), (3, 3, 0), mode="wrap")
    assert np.allclose(expected[1:-1, 1:-1], plain[1:-1, 1:-1])
    assert np.allclose(expected[0, 0], values[np.ix_([0, 1], [-1, 0, 1] if grid[2] else [0, 1])].mean((0, 1)))


def distinct(
    device: Device, cost: np.ndarray, found: np.ndarray, grid: tuple[int, int, int, int]
) -> np.ndarray:
    """`search_distinct` of costs (displacements, height, width)."""
    out = device.empty((grid[1], grid[0]), np.uint8)
    sent = device.upload(volume(cost), np.float32), device.upload(found, np.float32)
    device.run("search", "search_distinct", grid[:2], *sent, grid, REACH, 0.05, 48, out)
    return out.get() == 1


@pytest.mark.parametrize("name", list(GRIDS))
def test_distinct_and_agree_equal_their_twins(device: Device, name: str) -> None:
    grid = GRIDS[name]
    a, b = descriptors(19, grid)
    costs = [twin.costs(*both, grid, REACH, 0.5).astype(np.float32) for both in ((a, b), (b, a))]
    zero = np.zeros((grid[1], grid[0], 2))
    there, back = (twin.search_best(cost, zero, REACH, 0.0) for cost in costs)
    alone = twin.search_distinct(costs[0], there, REACH, 0.05)
    assert 0.2 < alone.mean() < 0.9
    assert (distinct(device, costs[0], there, grid) != alone).mean() <= DECISIONS
    arguments = (there, back, alone, noise(23, grid, 2, 2), grid, 1.5)
    expected = twin.search_agree(*arguments)
    kept = (expected == there).all(-1)
    assert 0.2 < kept.mean() < 0.9 and (alone & ~kept).any()
    assert_close(run(device, "search_agree", grid, *arguments), expected, 1e-6, DECISIONS)


def test_agree_refuses_what_repeats(device: Device) -> None:
    """A pattern that repeats within reach says nothing: the flow before stays."""
    grid = Border(40, 24, 1)
    x, y = common.pixels(40, 24)
    waves = [np.sin(2 * np.pi * (x + shift) / 4) * np.cos(y / 2.0) for shift in (0, 1, 2)]
    image = np.stack([*waves, np.ones(x.shape)], -1).astype(np.float32)
    cost = twin.costs(image, image, grid, REACH, 0.5)
    zero, before = np.zeros((24, 40, 2)), np.full((24, 40, 2), 0.25, np.float32)
    alone = distinct(device, cost, zero, grid)
    assert not alone.any()
    assert np.array_equal(run(device, "search_agree", grid, zero, zero, alone, before, grid, 1.5), before)


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize(("step", "radius", "alone"), [(1, 2, False), (4, 2, True), (3, 4, False)])
def test_choose_equals_its_twin(device: Device, name: str, step: int, radius: int, alone: bool) -> None:
    """Alone: there is no other field."""
    grid = GRIDS[name]
    a, b = descriptors(125, grid)
    own = np.array([2, -1]) + 3 * noise(129, grid, 2, 2)
    other = own if alone else np.array([2, -1]) + 1.5 * noise(131, grid, 2, 2)
    arguments = (a, b, own, other, grid, step, radius, 2.0, (0.25, 0.75), 0.06)
    expected = twin.search_choose(*arguments)
    assert 0.2 < (expected != own).any(-1).mean() < 0.95
    assert_close(choose(device, *arguments), expected, 1e-6, 5 * DECISIONS)


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize(("step", "radius"), [(1, 2), (4, 4), (9, 4)])
def test_adopt_equals_its_twin(device: Device, name: str, step: int, radius: int) -> None:
    """Half of what is trusted is right, and stays as it is."""
    grid = GRIDS[name]
    a, b = descriptors(125, grid)
    trusted = np.dstack([np.array([2, -1]) + 3 * noise(129, grid, 2, 2), noise(131, grid, 2, 0)])
    trusted[..., 2] = np.clip(0.5 + trusted[..., 2], 0, 1)
    right = noise(133, grid, 1, 0)[..., 0] > 0
    trusted[right, :2] = 2, -1
    arguments = (step, radius, 2.0, (0.25, 0.75), 0.1, 0.4, 0.5)
    both = [planes(device, image, grid) for image in (a, b)]
    sent = (*both, trusted, grid, both[0].shape[2], *arguments)
    found = run(device, "search_adopt", grid, *sent, channels=4)
    expected = twin.search_adopt(a, b, trusted, grid, *arguments)
    changed = (expected[..., :3] != trusted[..., :3]).any(-1)
    assert 0.02 < changed.mean() < 0.5
    assert not (changed & (trusted[..., 2] >= 0.5)).any() and (expected[changed, 2] == 0.5).all()
    assert_close(found, expected, 1e-6, 5 * DECISIONS)


@pytest.mark.parametrize("by", [(0.5, 0.0), (0.0, 0.5), (-0.5, -0.5)])
def test_windows_end_where_the_images_do(device: Device, by: tuple[float, float]) -> None:
    """What lies beyond is not known, and no pixel of the next row."""
    grid = Border(37, 23, 0)
    a, b = descriptors(125, grid)
    a[..., 3] = b[..., 3] = 1
    b[:, :3], b[:3] = 9, -9  # what would be read for it
    for radius in (2, 4):
        own = np.full((23, 37, 2), 1.5)
        own[::2] = by  # offered to the rows beside
        arguments = (a, b, own, own, grid, 1, radius, 0.0, (0.25, 0.25), 0.0)
        expected = twin.search_choose(*arguments)
        assert 0.1 < (expected != own).any(-1).mean() < 0.9
        assert np.array_equal(choose(device, *arguments), expected)


@settings(max_examples=40)
@given(
    width=st.integers(1, 40), height=st.integers(1, 9), wraps=st.booleans(), radius=st.integers(0, 4),
    seed=st.integers(0, 2**32 - 1), far=st.sampled_from([1.0, 15.0, 90.0]), t=st.sampled_from([0.0, 0.3]),
)  # fmt: skip
def test_windows_lie_wherever_flow_leads(
    device: Device, width: int, height: int, wraps: bool, radius: int, seed: int, far: float, t: float
) -> None:
    """Half beyond a border, far beyond both margins, or several times around a cylinder."""
    rng, grid = np.random.default_rng(seed), Border(width, height, int(wraps))
    a, b = (rng.normal(size=(height, width, 4)).astype(np.float32) for _ in range(2))
    for image in (a, b):
        image[..., 3] = rng.random((height, width)) < 0.9
        image *= image[..., 3:]
    own, other = (np.round(rng.normal(0, far, (height, width, 2))).astype(np.float32) + t for _ in range(2))
    arguments = (a, b, own, other, grid, 1, radius, 1.0, (0.5, 0.5), 0.01)
    assert_close(choose(device, *arguments), twin.search_choose(*arguments), 1e-6, DECISIONS)


def test_twin_of_window_by_hand() -> None:
    """One pixel's window under a whole displacement, and under half a pixel."""
    grid = GRIDS["plane"]
    a, b = descriptors(33, grid)
    a[..., 3] = b[..., 3] = 1
    for f in ((2.0, -1.0), (0.5, 1.0)):
        total = weight = 0.0
        for dy, dx in np.ndindex(5, 5):
            own = a[10 + dy - 2, 15 + dx - 2].astype(float)
            row = b[10 + dy - 2 + int(f[1])].astype(float)
            left = 15 + dx - 2 + int(f[0])
            there = (1 - f[0] % 1) * row[left] + (f[0] % 1) * row[left + 1]
            e = float(((own - there)[:3] ** 2).sum())
            w = np.exp(-2 * abs(own[0] - float(a[10, 15, 0])))
            total, weight = total + w * e / (e + 0.5), weight + w
        found = twin.window_misfit(a, b, np.full((23, 37, 2), f), grid, 2, 2.0, 0.5)
        assert found[10, 15] == pytest.approx(total / weight)


def test_levels_of_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """The finest on which reach is at most 9 px, or the coarsest there is, and the one below it."""
    how, grid = search.SearchParameters(coarse=9.0, furthest=(10, 7)), Border(120, 90, 0)
    assert search.reaches(0, 6, grid, how) == {}
    assert search.reaches(9, 6, grid, how) == {0: 9}
    assert search.reaches(9.1, 6, grid, how) == {1: 5, 0: 7}
    assert search.reaches(70, 6, grid, how) == {3: 9, 2: 7}
    assert search.reaches(200, 3, grid, how) == {2: 10, 1: 7}
    assert search.reaches(18, 6, grid, how, finest=1) == {1: 9}
    assert search.reaches(3, 6, grid, how, finest=1) == {0: 3}
    monkeypatch.setattr(search, "_LEAST_ROOM", 0)  # as of charts that take more
    grid = Border(1200, 900, 0)
    assert search.reaches(9, 6, grid, how) == {2: 3}
    assert search.reaches(40, 6, grid, how) == {3: 5, 2: 7}
    assert search.reaches(200, 1, grid, how) == {0: 10}


@given(
    st.floats(0, 300), st.floats(0, 1), st.integers(1, 7), st.integers(24, 3000), st.integers(24, 3000),
    st.integers(0, 2),
)  # fmt: skip
def test_no_search_takes_more_room_than_is_reckoned(
    reach: float, part: float, levels: int, width: int, height: int, finest: int
) -> None:
    """However much less motion there is."""
    how, grid = search.SearchParameters(), Border(width, height, 0)
    tried = search.reaches(part * reach, levels, grid, how, finest)
    assert max(
        (search._room(level, most, grid) for level, most in tried.items()), default=0
    ) <= search.most_room(reach, levels, grid, how, finest)
    assert all(level >= min(finest, max(tried)) for level in tried)


def test_what_kernels_do_not_hold_is_refused() -> None:
    """A larger window, and displacements beyond the margin of descriptors."""
    with pytest.raises(ValueError, match="at most 4"):
        search.SearchParameters(radius=(2, 5))
    with pytest.raises(ValueError, match="margin of 16"):
        search.SearchParameters(furthest=(10, 16))

"""Flow's kernels against twins, twins against SciPy and dense algebra; its truth is in test_flow_truth.py."""

from __future__ import annotations

import math

import numpy as np
import pytest
from grids import patches
from reference import common
from reference import flow as twin
from scipy import ndimage
from tolerances import DECISIONS, SUM, TRIGONOMETRY, assert_close

from hugin_abflow import pyramid, search
from hugin_abflow.flow import Board
from hugin_abflow.grid import Border
from hugin_abflow.opencl import Device
from hugin_abflow.pyramid import Level
from hugin_abflow.settings import MOST_WORKING_PIXELS

GRIDS = {"plane": Border(77, 53, 0), "cylinder": Border(78, 53, 1), "odd cylinder": Border(77, 53, 1)}


def run_expand(device: Device, coarse: np.ndarray, wraps: int, size: tuple[int, int]) -> np.ndarray:
    height, width = coarse.shape[:2]
    fine = device.empty((2, size[1], size[0], 2))
    grid = Border(width, height, wraps)
    ways = device.upload(np.stack([0 * coarse, coarse]).astype(np.float32))
    device.run("flow", "flow_expand", (*size, 2), ways, grid, fine, size)
    assert not fine.get()[0].any()
    return fine.get()[1]


@pytest.mark.parametrize("wraps", [0, 1])
def test_linear_flow_is_reproduced_by_expanding(device: Device, wraps: int) -> None:
    """Coarse position = fine position / 2, and flow doubles: within 1e-3 px, odd sizes too."""
    size = (77, 53)
    v, u = 2 * (np.mgrid[0:27, 0:39] + 0.5)
    y, x = np.mgrid[0:53, 0:77] + 0.5
    coarse = np.stack([0.3 * u - 0.1 * v + 2, 0.05 * u + 0.2 * v - 7], -1) / 2
    expected = np.stack([0.3 * x - 0.1 * y + 2, 0.05 * x + 0.2 * y - 7], -1)
    fine = run_expand(device, coarse, wraps, size)
    assert np.abs(fine - expected)[1:-1, 1:-1].max() < 1e-3
    assert_close(fine, twin.flow_expand(coarse, (39, 27, wraps, 0), size), SUM, scale=30)


def test_twin_of_expand_is_scipys() -> None:
    coarse = np.random.default_rng(13).normal(size=(27, 39, 2))
    y, x = (np.mgrid[0:53, 0:77] + 0.5) / 2 - 0.5
    for i in (0, 1):
        expected = 2 * ndimage.map_coordinates(coarse[..., i], [y, x], order=1, mode="nearest")
        assert np.allclose(twin.flow_expand(coarse, (39, 27, 0, 0), (77, 53))[..., i], expected)


def smooth_noise(seed: int, grid: tuple[int, int, int, int], channels: int, sigma: float) -> np.ndarray:
    random = np.random.default_rng(seed)
    values = random.normal(size=(grid[1], grid[0], channels))
    values = ndimage.gaussian_filter(values, (sigma, sigma, 0), mode=["nearest", "wrap", "nearest"])
    return (values / np.abs(values).max()).astype(np.float32)


def make_feature(seed: int, grid: tuple[int, int, int, int], share: float = 0.85) -> np.ndarray:
    """A feature with a ragged mask; its slopes are not those of its first channel."""
    feature = smooth_noise(seed, grid, 4, 1.5)
    feature[..., 3] = 1
    return feature * patches(seed + 1, grid[0], grid[1], share, 7)[..., None]


# What a board holds, in the order of kernels/common.cl.
SOLVED, FLOW, FEATURE, WARPED = [0, 1, 2, 3, 4, 20, 21], [5, 6], [7, 8, 9, 10], [11, 12, 13, 14]
TENSOR, RIGHT = [15, 16, 17], [18, 19]


def board_of(
    device: Device, grid: tuple[int, int, int, int], values: dict[tuple[int, ...], np.ndarray]
) -> Board:
    """A board that holds some values, each (height, width, n), and 0 else."""
    board = Board.of(device, 1, grid)
    planes = board.planes.get()
    for places, value in values.items():
        planes[0][:, :, list(places)] = twin.flow_board(value, grid, board.pitch)
    board.planes.set(planes)
    return board


def on_board(board: Board, places: list[int]) -> np.ndarray:
    """What a board of one way holds, (height, width, n)."""
    return twin.flow_solution(board.planes.get()[0][:, :, places], board.grid)


def run(device: Device, name: str, board: Board, options: str, *arguments: float) -> None:
    """Run a kernel over both colours of a board."""
    size = (board.pitch, 2 * board.grid[1], board.ways)
    device.run(
        "flow", name, size, board.grid, board.pitch, *arguments, board.planes, options=options, group=64
    )


def specialised(grid: tuple[int, int, int, int]) -> list[str]:
    """Build options that leave the result as it is: none, and those that say whether the grid wraps."""
    return ["", f"-DWRAPS={grid[2]}"]


@pytest.mark.parametrize("name", list(GRIDS))
def test_feature_equals_its_twin(device: Device, name: str) -> None:
    grid = GRIDS[name]
    mask = patches(14, grid[0], grid[1], 0.7)
    image = smooth_noise(15, grid, 1, 1)[..., 0] * mask
    finest = Level(device.upload(image), device.upload(mask), bool(grid[2]))
    small = pyramid.reduce(device, finest)
    mean = pyramid.smooth(device, small, 3.0)
    features = device.zeros((2, grid[1], grid[0], 4))
    device.run(
        "flow", "flow_feature", grid[:2], device.upload(image), device.upload(mask), grid,
        mean.image, mean.mask, mean.grid, 1, features,
    )  # fmt: skip
    expected = twin.flow_feature(image, mask, grid, mean.image.get(), mean.mask.get(), mean.grid)
    assert_close(features.get()[1], expected, SUM)
    assert not features.get()[0].any()


def test_twin_of_feature_is_numpys_gradient() -> None:
    """With a whole mask, one-sided at the border; the mean is interpolated as SciPy does."""
    image = smooth_noise(16, (77, 53, 0, 0), 1, 1)[..., 0].astype(np.float64)
    mean = np.random.default_rng(17).normal(size=(27, 39))
    feature = twin.flow_feature(
        image, np.ones((53, 77)), (77, 53, 0, 0), mean, np.ones((27, 39)), (39, 27, 0, 0)
    )
    down, across = np.gradient(image)
    y, x = (np.mgrid[0:53, 0:77] + 0.5) / 2 - 0.5
    assert np.allclose(feature[..., 1], across)
    assert np.allclose(feature[..., 2], down)
    assert np.allclose(
        feature[..., 0], image - ndimage.map_coordinates(mean, [y, x], order=1, mode="nearest")
    )


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize("ways", [1, 2])
def test_board_and_warp_equal_their_twins(device: Device, name: str, ways: int) -> None:
    """Both ways at a time, or one after the other; beyond the rows' ends there is nothing."""
    grid = GRIDS[name]
    features = [make_feature(seed, grid) for seed in (18, 58)]
    flows = [9 * smooth_noise(seed, grid, 2, 4) for seed in (19, 59)]
    flows[0][:9] = np.rint(flows[0][:9])
    sent = [device.upload(np.stack(both)) for both in (features, flows)]
    for first in range(0, 2, ways):
        board = Board.of(device, ways, grid)
        size = (2 * board.pitch, grid[1], ways)
        device.run("flow", "flow_board", size, sent[0], grid, board.pitch, first, board.planes)
        device.run("flow", "flow_warp", size, *sent, grid, board.pitch, first, board.planes)
        for way, planes in enumerate(board.planes.get(), first):
            warped = twin.flow_warp(features[1 - way], flows[way], grid)
            assert 0.2 < warped[..., 3].mean() < 0.9
            copied = twin.flow_board(np.concatenate([flows[way], features[way]], -1), grid, board.pitch)
            assert np.array_equal(planes[:, :, FLOW + FEATURE], copied)
            expected = twin.flow_board(warped, grid, board.pitch)
            assert_close(planes[:, :, WARPED], expected, 1e-5, DECISIONS)
        back = device.zeros((2, grid[1], grid[0], 2))
        board.solution(device, back, first)
        assert np.array_equal(back.get()[first : first + ways], flows[first : first + ways])


@pytest.mark.parametrize("name", list(GRIDS))
def test_misfit_equals_its_twin(device: Device, name: str) -> None:
    grid = GRIDS[name]
    features = [make_feature(seed, grid) for seed in (24, 64)]
    flows = [9 * smooth_noise(seed, grid, 2, 4) for seed in (25, 65)]
    misfit = device.empty((2, grid[1], grid[0]))
    sent = [device.upload(np.stack(both)) for both in (features, flows)]
    device.run("flow", "flow_misfit", (*grid[:2], 2), *sent, grid, 0.1, misfit)
    for way, values in enumerate(misfit.get()):
        expected = twin.flow_misfit(features[way], features[1 - way], flows[way], grid, 0.1)
        assert (expected < 0).any()
        assert (expected == 0.1).any()
        assert ((expected > 0) & (expected < 0.1)).any()
        assert_close(values, expected, 1e-5, DECISIONS)


def test_twin_of_warp_is_scipys() -> None:
    grid = GRIDS["plane"]
    feature, moved = make_feature(20, grid, 1.0), 3 * smooth_noise(21, grid, 2, 4)
    y, x = np.mgrid[0:53, 0:77]
    there = [y + moved[..., 1], x + moved[..., 0]]
    warped = twin.flow_warp(feature, moved, grid)
    inside = (there[0] > 0) & (there[0] < 52) & (there[1] > 0) & (there[1] < 76)
    assert np.array_equal(warped[..., 3][inside] > 0, np.ones(inside.sum(), bool))
    for i in range(3):
        expected = ndimage.map_coordinates(feature[..., i].astype(np.float64), there, order=1)
        assert np.allclose(warped[..., i][inside], expected[inside], atol=1e-7)


@pytest.mark.parametrize("name", list(GRIDS))
def test_tensor_equals_its_twin(device: Device, name: str) -> None:
    grid = GRIDS[name]
    a, b = make_feature(22, grid), make_feature(24, grid)
    tensor, right = twin.flow_tensor(a, b, grid, 5.0, 10.0, 0.01)
    assert 0.3 < tensor[..., 3].mean() < 0.9
    for options in specialised(grid):
        board = board_of(device, grid, {tuple(FEATURE): a, tuple(WARPED): b})
        run(device, "flow_tensor", board, options, 5.0, 10.0, 0.01)
        for places, expected in ((TENSOR, tensor[..., :3]), (RIGHT, right)):
            # sums of squares of slopes with both signs: rounding is relative to the largest
            scale = float(np.abs(expected).max()) / 10
            assert_close(on_board(board, places), expected, TRIGONOMETRY, scale=scale)
        assert not board.planes.get()[..., TENSOR + RIGHT, (grid[0] + 1) // 2 :].any()


def test_twin_of_tensor_is_the_energys_curvature() -> None:
    """E(u) = sum of weighted squared constraints is a parabola: J and b from its values at six places."""
    grid = GRIDS["plane"]
    a, b = make_feature(26, grid), make_feature(28, grid)
    found = twin.constraints(a, b, grid, 5.0, 10.0, 0.01)

    def energy(u: float, v: float) -> np.ndarray:
        return sum(w * (d[..., 0] * u + d[..., 1] * v + t) ** 2 for w, d, t in found)

    tensor, right = twin.flow_tensor(a, b, grid, 5.0, 10.0, 0.01)
    flat = energy(0, 0)
    scale = np.abs(tensor).max()
    assert np.allclose((energy(1, 0) + energy(-1, 0)) / 2 - flat, tensor[..., 0], atol=1e-9 * scale)
    assert np.allclose((energy(0, 1) + energy(0, -1)) / 2 - flat, tensor[..., 2], atol=1e-9 * scale)
    assert np.allclose(
        (energy(1, 1) - energy(1, -1)) / 2 - 2 * right[..., 1], 2 * tensor[..., 1], atol=1e-8 * scale
    )
    assert np.allclose((energy(1, 0) - energy(-1, 0)) / 4, right[..., 0], atol=1e-9 * scale)
    # one pixel of the brightness term by hand: normalised by its slope, penalised like |t|
    y, x = np.argwhere((a[..., 3] > 0) & (b[..., 3] > 0))[100]
    slope = (a[y, x, 1:3] + b[y, x, 1:3]).astype(np.float64) / 2
    t, n = float(b[y, x, 0]) - float(a[y, x, 0]), 1 / (slope @ slope + 1e-4)
    assert found[0][0][y, x] == pytest.approx(5 * n / np.sqrt(t * t * n + 1e-6))


@pytest.mark.parametrize("wraps", [0, 1])
def test_twin_of_window_is_scipys(wraps: int) -> None:
    grid = Border(77, 53, wraps)
    values = np.random.default_rng(30).normal(size=(53, 77, 4))
    taps = np.outer([1, 2, 1], [1, 2, 1]) / 16
    window, right = twin.flow_window(values, values[..., :2], grid)
    for i in range(4):
        wide = np.pad(values[..., i], ((1, 1), (0, 0)))
        wide = np.pad(wide, ((0, 0), (1, 1)), mode="wrap" if wraps else "constant")
        assert np.allclose(window[..., i], ndimage.convolve(wide, taps)[1:-1, 1:-1])
    assert np.array_equal(right, window[..., :2])


def system_of(grid: tuple[int, int, int, int], seed: int) -> tuple[np.ndarray, ...]:
    """tensor, right, flow, feature: a positive definite system, empty where nothing is known."""
    a, b = make_feature(seed, grid, 0.7), make_feature(seed + 2, grid, 0.7)
    tensor, right = twin.flow_window(*twin.flow_tensor(a, b, grid, 5.0, 10.0, 0.05), grid)
    scale = np.abs(tensor).max()
    return (
        tensor / scale,
        right / scale,
        smooth_noise(seed + 5, grid, 2, 3),
        a,
    )


@pytest.mark.parametrize("name", list(GRIDS))
def test_system_equals_its_twin(device: Device, name: str) -> None:
    grid = GRIDS[name]
    tensor, right, moved, feature = (part.astype(np.float32) for part in system_of(grid, 31))
    window = twin.flow_window(tensor, right, grid)
    expected = twin.solving(*twin.flow_system(*window, moved, feature, grid, 12.0, 0.3), grid, moved)
    for options in specialised(grid):
        board = board_of(
            device, grid,
            {
                tuple(TENSOR): tensor[..., :3],
                tuple(RIGHT): right,
                tuple(FLOW): moved,
                tuple(FEATURE): feature,
            },
        )  # fmt: skip
        run(device, "flow_system", board, options, 12.0, 0.3)
        assert_close(on_board(board, SOLVED), expected, TRIGONOMETRY, scale=10)
        assert not board.planes.get()[..., SOLVED[2:], (grid[0] + 1) // 2 :].any()


def test_pixels_that_nothing_holds_stay(device: Device) -> None:
    """A single pixel without data."""
    board = board_of(device, Border(1, 1, 0), {tuple(FLOW): np.array([[[3.0, -4.0]]])})
    run(device, "flow_system", board, board.options, 12.0, 0.3)
    board.relax(device, 3, 1.85)
    assert np.array_equal(on_board(board, FLOW), [[[3, -4]]])


def test_twin_of_system_by_hand() -> None:
    """Smoothness towards the east neighbour: less across a contrast, total variation of the flow."""
    grid = GRIDS["plane"]
    tensor, right, moved, feature = system_of(grid, 37)
    left_side, right_side = twin.flow_system(tensor, right, moved, feature, grid, 12.0, 0.3)
    for y, x in ((10, 20), (30, 50), (52, 3)):
        step = float(((moved[y, x].astype(float) - moved[y, x + 1]) ** 2).sum())
        both = feature[y, x, 3] * feature[y, x + 1, 3]
        contrast = abs(float(feature[y, x, 0]) - float(feature[y, x + 1, 0])) / 0.3 * both
        assert left_side[y, x, 3] == pytest.approx(12 * np.exp(-contrast) / np.sqrt(step + 1e-4))
    assert not left_side[:, -1, 3].any()
    assert not right_side[-1, :, 2].any()
    j = tensor[10, 20]
    matrix = np.array([[j[0], j[1]], [j[1], j[2]]])
    assert np.allclose(right_side[10, 20, :2], matrix @ moved[10, 20] - right[10, 20])


def dense_solution(left_side: np.ndarray, right_side: np.ndarray, wraps: bool) -> np.ndarray:
    """The flow that solves the system: (J + graph Laplacian of the smoothness) flow = b."""
    height, width = left_side.shape[:2]
    index = np.arange(height * width).reshape(height, width)
    matrix = np.zeros((2 * index.size, 2 * index.size))
    for y, x in np.ndindex(height, width):
        at = index[y, x]
        j = left_side[y, x]
        matrix[2 * at : 2 * at + 2, 2 * at : 2 * at + 2] += [[j[0], j[1]], [j[1], j[2]]]
        for ty, tx, weight in ((y, x + 1, j[3]), (y + 1, x, right_side[y, x, 2])):
            if ty == height or (tx == width and not wraps):
                continue
            to = index[ty, tx % width]
            for i in (0, 1):
                matrix[2 * at + i, 2 * at + i] += weight
                matrix[2 * to + i, 2 * to + i] += weight
                matrix[2 * at + i, 2 * to + i] -= weight
                matrix[2 * to + i, 2 * at + i] -= weight
    return np.linalg.solve(matrix, right_side[..., :2].ravel()).reshape(height, width, 2)


@pytest.mark.parametrize("wraps", [0, 1])
def test_relaxation_solves_the_system(device: Device, wraps: int) -> None:
    """Twin and kernel, iterated, come to the solution of dense algebra."""
    grid = Border(18, 13, wraps)
    tensor, right, moved, feature = system_of(grid, 43)
    sides = twin.flow_system(tensor, right, moved, feature, grid, 0.02, 0.3)
    expected = dense_solution(*sides, bool(wraps))
    iterated = moved.astype(np.float64)
    board = board_of(device, grid, {tuple(SOLVED): twin.solving(*sides, grid, moved), tuple(FLOW): moved})
    for _ in range(300):
        for colour in (0, 1):
            iterated = twin.flow_relax(*sides, grid, colour, 1.8, iterated)
    board.relax(device, 300, 1.8)
    assert np.abs(expected).max() > 0.05
    assert np.allclose(iterated, expected, atol=1e-9)
    assert np.allclose(on_board(board, FLOW), expected, atol=1e-4)


@pytest.mark.parametrize("name", ["plane", "cylinder"])
@pytest.mark.parametrize("colour", [0, 1])
def test_relax_equals_its_twin(device: Device, name: str, colour: int) -> None:
    grid = GRIDS[name]
    tensor, right, moved, feature = system_of(grid, 49)
    sides = twin.flow_system(tensor, right, moved, feature, grid, 1.0, 0.3)
    expected = twin.flow_relax(*sides, grid, colour, 1.85, moved)
    x, y = common.pixels(grid[0], grid[1])
    for options in specialised(grid):
        board = board_of(device, grid, {tuple(SOLVED): twin.solving(*sides, grid, moved), tuple(FLOW): moved})
        device.run(
            "flow", "flow_relax", (board.pitch, grid[1], 1), grid, board.pitch, colour, 1.85, board.planes,
            options=options, group=64,
        )  # fmt: skip
        result = on_board(board, FLOW)
        assert np.array_equal(result[(x + y) % 2 != colour], moved[(x + y) % 2 != colour])
        assert_close(result, expected, TRIGONOMETRY)


@pytest.mark.parametrize("group", [(1, 1), (8, 3), (2, 32)])
@pytest.mark.parametrize("grid", [Border(77, 53, 0), Border(16, 5, 1), Border(129, 3, 0)])
def test_one_work_group_sweeps_as_its_twin(
    device: Device, grid: tuple[int, int, int, int], group: tuple[int, int]
) -> None:
    tensor, right, moved, feature = system_of(grid, 51)
    sides = twin.flow_system(tensor, right, moved, feature, grid, 1.0, 0.3)
    expected = twin.flow_relax_small(*sides, grid, 3, 1.85, moved)
    values = {tuple(SOLVED): twin.solving(*sides, grid, moved), tuple(FLOW): moved}
    way, both = board_of(device, grid, values).planes.get()[0], Board.of(device, 2, grid)
    both.planes.set(np.stack([0 * way, way]))
    device.run(
        "flow", "flow_relax_small", (*group, 2), grid, both.pitch, 3, 1.85, both.planes, options=both.options,
        group=group,
    )  # fmt: skip
    empty, swept = both.planes.get()
    assert not empty.any()
    assert not swept[..., (grid[0] + 1) // 2 :].any()
    assert np.abs(expected - moved).max() > 0.1
    assert_close(on_board(Board(device.upload(swept[None]), grid), FLOW), expected, TRIGONOMETRY)


@pytest.mark.parametrize("kind", ["CPU", "GPU"])
def test_graphics_cards_relax_small_boards_at_once(
    device: Device, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    started = list[str]()
    monkeypatch.setattr(Device, "kind", kind)
    monkeypatch.setattr(device, "repeat", lambda *args: started.append(args[1]))
    monkeypatch.setattr(device, "run", lambda *args, **_: started.append(args[1]))
    for width in (128, 129):
        Board.of(device, 1, Border(width, 128, 0)).relax(device, 2, 1.5)
    assert started == ["flow_relax_small" if kind == "GPU" else "flow_relax", "flow_relax"]


@pytest.mark.parametrize("height", [3000, 6708, 9487, 32_000])
def test_the_largest_board_is_counted_in_32_bits(
    device: Device, monkeypatch: pytest.MonkeyPatch, height: int
) -> None:
    """Its shape alone: nothing of it is made."""
    asked = list[tuple[int, ...]]()
    monkeypatch.setattr(device, "zeros", asked.append)
    Board.of(device, 1, Border(MOST_WORKING_PIXELS // height, height, 0))
    assert 1.9e9 < math.prod(asked[0]) <= np.iinfo(np.int32).max


@pytest.mark.parametrize("name", list(GRIDS))
def test_median_is_scipys(device: Device, name: str) -> None:
    """Kernel and twin; rows beyond the border are the pixel itself, which SciPy cannot do."""
    grid = GRIDS[name]
    moved = np.random.default_rng(55).normal(size=(53, grid[0], 2)).astype(np.float32)
    stacked = device.upload(np.stack([0 * moved, moved]))
    kernel = search.filtered(device, stacked, grid, device.zeros(stacked.shape), 1).get()[1]
    expected = twin.flow_median(moved, grid)
    for i in (0, 1):
        median = ndimage.median_filter(moved[..., i], 3, mode="wrap")
        columns = slice(None) if grid[2] else slice(1, -1)
        assert np.array_equal(expected[1:-1, columns, i], median[1:-1, columns])
    own = moved[0, 5]
    corner = np.concatenate([moved[:2, 4:7].reshape(-1, 2), [own] * 3])
    assert np.array_equal(expected[0, 5], np.median(corner, 0).astype(np.float32))
    assert np.array_equal(kernel, expected)

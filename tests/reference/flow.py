"""Twins of kernels/flow.cl. A feature is (h, dh/dx, dh/dy, valid); grid = (width, height, wraps, 0)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import Array, bilinear, on_grid, pixels

ROBUST = 1e-3  # of the data term's penaliser
TOTAL_VARIATION = 1e-4  # added to the square of a flow step under the root


def beside(values: Array, grid: Sequence[int], dx: int, dy: int) -> tuple[Array, Array]:
    """Every pixel's neighbour at (dx, dy), 0 beyond the border, and whether it exists."""
    x, y = pixels(grid[0], grid[1])
    return on_grid(values, grid, x + dx, y + dy)


def flow_feature(
    image: Array, mask: Array, grid: Sequence[int], mean: Array, weight: Array, coarse: Sequence[int]
) -> Array:
    """Image less its local mean on the next coarser level, and differences to the valid neighbours."""
    valid = mask != 0
    x, y = pixels(grid[0], grid[1])
    known = weight > 1e-6
    total, share = bilinear(np.stack([mean * known, known], -1), coarse, (x + 0.5) / 2, (y + 0.5) / 2)
    share = total[..., 1]
    local = np.where(share > 0, total[..., 0] / np.where(share > 0, share, 1), 0.0)
    slopes = []
    for dx, dy in ((1, 0), (0, 1)):
        steps, count = 0.0, 0.0
        for side in (-1, 1):
            there, _ = beside(np.stack([image, mask], -1), grid, side * dx, side * dy)
            usable = there[..., 1] != 0
            steps = steps + np.where(usable, side * (there[..., 0] - image), 0.0)
            count = count + usable
        slopes.append(steps / np.maximum(count, 1))
    return np.where(valid[..., None], np.stack([image - local, *slopes, np.ones(image.shape)], -1), 0.0)


def flow_warp(feature: Array, flow: Array, grid: Sequence[int]) -> Array:
    """The feature at q + flow(q); 0 unless all taps that count are valid."""
    x, y = pixels(grid[0], grid[1])
    flow = flow.astype(np.float64)
    total, _ = bilinear(feature, grid, x + 0.5 + flow[..., 0], y + 0.5 + flow[..., 1])
    whole = total[..., 3:] > 0.999
    return np.where(whole, total / np.where(whole, total[..., 3:], 1), 0.0)


def flow_misfit(own: Array, other: Array, flow: Array, grid: Sequence[int], most: float) -> Array:
    """How far gradients differ where the flow leads; -1 where not both images are."""
    there = flow_warp(other, flow, grid)
    off = np.hypot(*(own[..., i].astype(np.float64) - there[..., i] for i in (1, 2)))
    off = np.where(there[..., 3] > 0, np.minimum(off, most), most)
    return np.where((own[..., 3] > 0) & (other[..., 3] > 0), off, -1.0)


def constraints(
    feature: Array, warped: Array, grid: Sequence[int], brightness: float, gradient: float, noise: float
) -> list[tuple[Array, Array, Array]]:
    """Per constraint: weight w, direction d (..., 2) and difference t, as in w (d . u + t)^2."""
    difference, middle = warped.astype(np.float64) - feature, (warped.astype(np.float64) + feature) / 2
    both = (feature[..., 3] * warped[..., 3] > 0).astype(np.float64)
    slope = middle[..., 1:3]
    scale = 1 / ((slope**2).sum(-1) + noise**2)
    weight = both * brightness * scale / np.sqrt(difference[..., 0] ** 2 * scale + ROBUST**2)
    found = [(weight, slope, difference[..., 0])]
    seen = np.concatenate([middle[..., 1:3], both[..., None]], -1) * both[..., None]
    west, east, north, south = (beside(seen, grid, *d)[0] for d in ((-1, 0), (1, 0), (0, -1), (0, 1)))
    complete = both * west[..., 2] * east[..., 2] * north[..., 2] * south[..., 2]
    # rows: gradient component; columns: its derivative in x and y
    curvature = np.stack([(east - west)[..., :2] / 2, (south - north)[..., :2] / 2], -1)
    scales = 1 / ((curvature**2).sum(-1) + noise**2)
    shift = difference[..., 1:3]
    weight = complete * gradient / np.sqrt((shift**2 * scales).sum(-1) + ROBUST**2)
    return [*found, *((weight * scales[..., i], curvature[..., i, :], shift[..., i]) for i in (0, 1))]


def flow_tensor(
    feature: Array, warped: Array, grid: Sequence[int], brightness: float, gradient: float, noise: float
) -> tuple[Array, Array]:
    """J11, J12, J22, valid; and J13, J23."""
    tensor, right = np.zeros(feature.shape), np.zeros((*feature.shape[:2], 2))
    for weight, d, t in constraints(feature, warped, grid, brightness, gradient, noise):
        squares = np.stack([d[..., 0] ** 2, d[..., 0] * d[..., 1], d[..., 1] ** 2], -1)
        tensor[..., :3] += weight[..., None] * squares
        right += (weight * t)[..., None] * d
    tensor[..., 3] = feature[..., 3] * warped[..., 3] > 0
    return tensor, right


def flow_window(tensor: Array, right: Array, grid: Sequence[int]) -> tuple[Array, Array]:
    """Binomial sums over 3 x 3 pixels."""
    sums = []
    for values in (tensor, right):
        across = sum(tap * beside(values, grid, dx, 0)[0] for dx, tap in ((-1, 0.25), (0, 0.5), (1, 0.25)))
        sums.append(
            sum(tap * beside(across, grid, 0, dy)[0] for dy, tap in ((-1, 0.25), (0, 0.5), (1, 0.25)))
        )
    return sums[0], sums[1]


def edge(
    flow: Array, feature: Array, grid: Sequence[int], dx: int, dy: int, smoothness: float, contrast: float
) -> Array:
    """Smoothness weight towards the neighbour at (dx, dy)."""
    there, exists = beside(np.concatenate([flow, feature], -1), grid, dx, dy)
    step = ((there[..., :2] - flow) ** 2).sum(-1)
    both = feature[..., 3] * there[..., 5] > 0
    contrasts = np.where(both, np.abs(feature[..., 0] - there[..., 2]) / contrast, 0.0)
    return np.where(exists, smoothness * np.exp(-contrasts) / np.sqrt(step + TOTAL_VARIATION), 0.0)


def flow_system(
    tensor: Array,
    right: Array,
    flow: Array,
    feature: Array,
    grid: Sequence[int],
    smoothness: float,
    contrast: float,
) -> tuple[Array, Array]:
    """J11, J12, J22, weight to the east; b1, b2, weight to the south, 0. Constraints: of flow_window."""
    matrix = tensor[..., [0, 1, 1, 2]].reshape(*tensor.shape[:2], 2, 2).astype(np.float64)
    flow = flow.astype(np.float64)
    target = np.einsum("yxij,yxj->yxi", matrix, flow) - right
    east, south = (edge(flow, feature, grid, *d, smoothness, contrast)[..., None] for d in ((1, 0), (0, 1)))
    return np.concatenate([tensor[..., :3], east], -1), np.concatenate([target, south, 0 * south], -1)


def flow_board(values: Array, grid: Sequence[int], pitch: int) -> Array:
    """Values (height, width, n) on a board, (2, height, n, pitch): by colour, those of a row side by side."""
    board = np.zeros((2, grid[1], values.shape[-1], pitch))
    for y, x in np.ndindex(grid[1], grid[0]):
        board[(x + y) % 2, y, :, x // 2] = values[y, x]
    return board


def flow_solution(board: Array, grid: Sequence[int]) -> Array:
    """The opposite of flow_board: (height, width, n)."""
    x, y = pixels(grid[0], grid[1])
    return board[(x + y) % 2, y, :, x // 2]


def solving(left_side: Array, right_side: Array, grid: Sequence[int], flow: Array) -> Array:
    """(height, width, 7): a system as a board holds it to be solved: inverse diagonals, J12, weights to the
    east and south, b. What nothing holds stays as it is.
    """
    east, south = left_side[..., 3], right_side[..., 2]
    links = east + south + beside(east, grid, -1, 0)[0] + beside(south, grid, 0, -1)[0]
    diagonals = left_side[..., [0, 2]] + links[..., None]
    free = diagonals <= 0
    inverse = 1 / np.where(free, 1, diagonals)
    b = np.where(free, flow, right_side[..., :2])
    return np.concatenate([inverse, left_side[..., 1:2], east[..., None], south[..., None], b], -1)


def flow_relax(
    left_side: Array, right_side: Array, grid: Sequence[int], colour: int, relaxation: float, flow: Array
) -> Array:
    """One half-sweep; neighbours are of the other colour, but for the border of an odd width that wraps."""
    flow = flow.astype(np.float64)
    total, weight = np.zeros_like(flow), np.zeros(flow.shape[:2])
    east, south = left_side[..., 3].astype(np.float64), right_side[..., 2].astype(np.float64)
    for dx, dy in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        there, exists = beside(flow, grid, dx, dy)
        link = east if dx else south
        if dx + dy < 0:  # the neighbour holds the link
            link, _ = beside(link, grid, dx, dy)
        total += np.where(exists, link, 0)[..., None] * there
        weight += np.where(exists, link, 0)
    x, y = pixels(grid[0], grid[1])
    chosen = (x + y) % 2 == colour
    result = flow.copy()
    for i, (own, cross) in enumerate(((0, 1), (2, 1))):
        diagonal = left_side[..., own] + weight
        usable = chosen & (diagonal > 0)
        target = total[..., i] + right_side[..., i] - left_side[..., cross] * result[..., 1 - i]
        step = relaxation * (target / np.where(diagonal > 0, diagonal, 1) - result[..., i])
        result[..., i] += np.where(usable, step, 0)
    return result


def flow_relax_small(
    left_side: Array, right_side: Array, grid: Sequence[int], sweeps: int, relaxation: float, flow: Array
) -> Array:
    """Whole sweeps: half of one colour, half of the other."""
    for half_sweep in range(2 * sweeps):
        flow = flow_relax(left_side, right_side, grid, half_sweep % 2, relaxation, flow)
    return flow


def flow_median(flow: Array, grid: Sequence[int]) -> Array:
    """3 x 3 median of each component; beyond the border a pixel stands for its neighbour."""
    seen = []
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            there, exists = beside(flow, grid, dx, dy)
            seen.append(np.where(exists[..., None], there, flow))
    return np.median(seen, axis=0)


def flow_expand(coarse: Array, grid: Sequence[int], size: Sequence[int]) -> Array:
    """Twice as fine: bilinear from the pixels that exist, doubled."""
    x, y = pixels(size[0], size[1])
    total, share = bilinear(coarse, grid, (x + 0.5) / 2, (y + 0.5) / 2)
    return 2 * total / share[..., None]

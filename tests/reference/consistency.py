"""Twins of kernels/consistency.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import Array, bilinear, pixels

# Brightness of what tells nothing.
EXCLUDED = 1e3


def area_there(flow: Array, grid: Sequence[int]) -> Array:
    """The determinant of the gradient of q + F(q), by central differences, (height, width)."""
    padded = np.pad(flow.astype(np.float64), ((1, 1), (0, 0), (0, 0)), mode="edge")
    padded = np.pad(padded, ((0, 0), (1, 1), (0, 0)), mode="wrap" if grid[2] else "edge")
    across = (padded[1:-1, 2:] - padded[1:-1, :-2]) / 2 + [1, 0]
    down = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / 2 + [0, 1]
    return across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0]


def on_pixels(cells: Array, size: int, grid: Sequence[int]) -> Array:
    """A mask of cells of `size` px as one of pixels, (height, width); the last cells go on to the border."""
    under = np.kron(cells, np.ones((size, size)))
    beyond = [(0, max(0, wanted - there)) for wanted, there in zip(grid[1::-1], under.shape, strict=True)]
    return np.pad(under, beyond, mode="edge")[: grid[1], : grid[0]] > 0


def consistency_trust(
    flow: Array,
    back: Array,
    grid: Sequence[int],
    tolerance: float,
    squeezed: float,
    moved: Array,
    cells: Sequence[int],
    image: Array,
) -> Array:
    """Flow, how far going there and back again ends at the start, less where areas shrink, and the image,
    (height, width, 4); under cells that moved, the last of which go on to the border, nothing is believed
    and the image tells nothing.
    """
    columns, rows = pixels(grid[0], grid[1])
    x, y = columns + 0.5 + flow[..., 0], rows + 0.5 + flow[..., 1]
    y = np.clip(y, 0.5, grid[1] - 0.5)
    if not grid[2]:
        x = np.clip(x, 0.5, grid[0] - 0.5)
    returned, share = bilinear(back, grid, x, y)
    away = np.linalg.norm(flow + returned / share[..., None], axis=-1)
    trust = (1 + (away / tolerance) ** 2) ** -4
    trust = trust * np.clip((area_there(flow, grid) - squeezed) / (1 - squeezed), 0, 1)
    gone = on_pixels(moved, cells[2], grid)
    return np.dstack([flow, np.where(gone, 0, trust), np.where(gone, EXCLUDED, image)])


def _around(values: Array, fine: Sequence[int]) -> Array:
    """Three pixels more on each side: zeros, or left and right the other side where the grid wraps."""
    values = np.pad(values, ((3, 3), (0, 0), (0, 0)))
    return np.pad(values, ((0, 0), (3, 3), (0, 0)), mode="wrap" if fine[2] else "constant")


def consistency_push(trusted: Array, fine: Sequence[int]) -> Array:
    """Trust-weighted mean flow, mean trust and brightness, ((height + 1) // 2, (width + 1) // 2, 4)."""
    width, height = fine[:2]
    trust, bright = trusted[..., 2].astype(np.float64), trusted[..., 3]
    tells = bright < EXCLUDED
    parts = [trusted[..., 0] * trust, trusted[..., 1] * trust, trust, bright * tells, tells]
    padded, total = _around(np.dstack([*parts, np.ones_like(trust)]), fine), 0.0
    for (j, i), tap in np.ndenumerate(np.outer([1, 3, 3, 1], [1, 3, 3, 1]) / 64):
        total = total + tap * padded[2 + j : 2 + j + height : 2, 2 + i : 2 + i + width : 2]
    known, told = total[..., 2:3] > 0, total[..., 4] > 0
    mean = np.where(known, total[..., :2] / np.where(known, total[..., 2:3], 1), 0)
    brightness = np.where(told, total[..., 3] / np.where(told, total[..., 4], 1), EXCLUDED)
    return np.dstack([mean, total[..., 2] / total[..., 5], brightness])


def consistency_support(
    coarse: Array, size: Sequence[int], times: float, enough: float, trusted: Array, fine: Sequence[int]
) -> Array:
    """`trusted` with less trust where its mean around, bilinear from a coarser level, is not enough."""
    columns, rows = pixels(fine[0], fine[1])
    mean, share = bilinear(coarse[..., 2:3], size, (columns + 0.5) / times, (rows + 0.5) / times)
    result = trusted.astype(np.float64)
    result[..., 2] *= np.minimum(mean[..., 0] / share / enough, 1) ** 2
    return result


def consistency_flow(trusted: Array) -> Array:
    """The flow alone, (height, width, 2)."""
    return trusted[..., :2]


def consistency_pull(trusted: Array, fine: Sequence[int], coarse: Array, size: Sequence[int]) -> Array:
    """A level's flow mixed by trust with that of the coarser level, which is read bilinearly."""
    columns, rows = pixels(fine[0], fine[1])
    below, share = bilinear(coarse, size, (columns + 0.5) / 2, (rows + 0.5) / 2)
    trust = trusted[..., 2:3].astype(np.float64)
    return trust * trusted[..., :2] + (1 - trust) * below / share[..., None]


def consistency_relax(
    trusted: Array,
    grid: Sequence[int],
    own: float,
    edge: float,
    colour: int,
    relaxation: float,
    filled: Array,
) -> Array:
    """`filled` with the pixels of one colour moved to, and beyond, the mean of what they are drawn to."""
    width, height = grid[:2]
    columns, rows = pixels(width, height)
    trust = trusted[..., 2].astype(np.float64)
    weight = own * trust / (1.001 - trust)
    total = weight[..., None] * trusted[..., :2]
    joined = bool(grid[2]) and width % 2 == 0
    for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        x, y = columns + dx, rows + dy
        there = (y >= 0) & (y < height) & (joined | ((x >= 0) & (x < width)))
        x, y = np.where(there, x % width, columns), np.where(there, y, rows)
        told = np.maximum(trusted[y, x, 3], trusted[..., 3]) < EXCLUDED
        difference = told * (trusted[y, x, 3].astype(np.float64) - trusted[..., 3]) / edge
        carried = there / (1 + difference**2)
        total, weight = total + carried[..., None] * filled[y, x], weight + carried
    mean = np.where(weight[..., None] > 0, total / np.where(weight > 0, weight, 1)[..., None], filled)
    turn = ((columns + rows) % 2 == colour)[..., None]
    return np.where(turn, filled + relaxation * (mean - filled), filled)


def consistency_mix(trusted: Array, wide: Array, filled: Array) -> Array:
    """The flow as far as it is trusted, else what was filled in, `wide` where something moved; (height,
    width, 2).
    """
    trust = trusted[..., 2:3]
    return trust * trusted[..., :2] + (1 - trust) * np.where(trusted[..., 3:] < EXCLUDED, filled, wide)

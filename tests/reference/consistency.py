"""Twins of kernels/consistency.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import Array, bilinear, pixels


def consistency_trust(
    flow: Array, back: Array, grid: Sequence[int], tolerance: float, moved: Array, cells: Sequence[int]
) -> Array:
    """Flow, and how far going there and back again ends at the start, (height, width, 4); nothing of it is
    believed under cells that moved, the last of which go on to the border.
    """
    columns, rows = pixels(grid[0], grid[1])
    x, y = columns + 0.5 + flow[..., 0], rows + 0.5 + flow[..., 1]
    y = np.clip(y, 0.5, grid[1] - 0.5)
    if not grid[2]:
        x = np.clip(x, 0.5, grid[0] - 0.5)
    returned, share = bilinear(back, grid, x, y)
    away = np.linalg.norm(flow + returned / share[..., None], axis=-1)
    trust = (1 + (away / tolerance) ** 2) ** -2
    under = np.kron(moved, np.ones((cells[2], cells[2])))
    beyond = [(0, max(0, wanted - there)) for wanted, there in zip(grid[1::-1], under.shape, strict=True)]
    trust[np.pad(under, beyond, mode="edge")[: grid[1], : grid[0]] > 0] = 0
    return np.dstack([flow, trust, np.zeros_like(trust)])


def _around(values: Array, fine: Sequence[int]) -> Array:
    """Three pixels more on each side: zeros, or left and right the other side where the grid wraps."""
    values = np.pad(values, ((3, 3), (0, 0), (0, 0)))
    return np.pad(values, ((0, 0), (3, 3), (0, 0)), mode="wrap" if fine[2] else "constant")


def consistency_push(trusted: Array, fine: Sequence[int]) -> Array:
    """Trust-weighted mean flow and mean trust, ((height + 1) // 2, (width + 1) // 2, 4)."""
    width, height = fine[:2]
    trust = trusted[..., 2].astype(np.float64)
    summands = np.dstack([trusted[..., 0] * trust, trusted[..., 1] * trust, trust, np.ones_like(trust)])
    padded, total = _around(summands, fine), 0.0
    for (j, i), tap in np.ndenumerate(np.outer([1, 3, 3, 1], [1, 3, 3, 1]) / 64):
        total = total + tap * padded[2 + j : 2 + j + height : 2, 2 + i : 2 + i + width : 2]
    known = total[..., 2:3] > 0
    mean = np.where(known, total[..., :2] / np.where(known, total[..., 2:3], 1), 0)
    return np.dstack([mean, total[..., 2] / total[..., 3], np.zeros(known.shape[:2])])


def consistency_pull(trusted: Array, fine: Sequence[int], coarse: Array, size: Sequence[int]) -> Array:
    """The level with its flow mixed by trust with that of the coarser level, which is read bilinearly."""
    columns, rows = pixels(fine[0], fine[1])
    below, share = bilinear(coarse[..., :2], size, (columns + 0.5) / 2, (rows + 0.5) / 2)
    result, trust = trusted.astype(np.float64), trusted[..., 2:3]
    result[..., :2] = trust * trusted[..., :2] + (1 - trust) * below / share[..., None]
    return result


def consistency_flow(trusted: Array) -> Array:
    """The flow alone, (height, width, 2)."""
    return trusted[..., :2]

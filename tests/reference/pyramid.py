"""Twins of kernels/pyramid.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import Array


def _padded(values: Array, by: int, grid: Sequence[int]) -> Array:
    """Zeros above and below; left and right the other side where the grid wraps, else zeros."""
    values = np.pad(values.astype(np.float64), ((by, by), (0, 0)))
    return np.pad(values, ((0, 0), (by, by)), mode="wrap" if grid[2] else "constant")


def pyramid_reduce(image: Array, mask: Array, fine: Sequence[int]) -> tuple[Array, Array]:
    """Image and mask of the next coarser level, each ((height + 1) // 2, (width + 1) // 2)."""
    width, height = fine[:2]
    taps = np.outer([1, 3, 3, 1], [1, 3, 3, 1]) / 64
    weights, sums = _padded(mask, 3, fine), _padded(image * mask, 3, fine)
    total, weight = 0.0, 0.0
    for (j, i), tap in np.ndenumerate(taps):
        window = np.s_[2 + j : 2 + j + height : 2, 2 + i : 2 + i + width : 2]
        total, weight = total + tap * sums[window], weight + tap * weights[window]
    valid = weight >= 0.5
    return np.where(valid, total / np.where(valid, weight, 1), 0.0), valid.astype(np.float64)


def pyramid_smooth(
    image: Array,
    weight: Array,
    grid: Sequence[int],
    step: Sequence[int],
    taps: Array,
    normalise: int,
) -> tuple[Array, Array]:
    """One direction of a symmetric filter over image and weight; divided at the end if `normalise`.

    taps: the filter from its centre outwards.
    """
    width, height, radius = grid[0], grid[1], len(taps) - 1
    images, weights = _padded(image, radius, grid), _padded(weight, radius, grid)
    total, share = 0.0, 0.0
    for offset in range(-radius, radius + 1):
        x, y = radius + offset * step[0], radius + offset * step[1]
        tap = float(taps[abs(offset)])
        total = total + tap * images[y : y + height, x : x + width]
        share = share + tap * weights[y : y + height, x : x + width]
    if normalise:
        total = np.where(share > 1e-6, total / np.maximum(share, 1e-6), 0.0)
    return total, share

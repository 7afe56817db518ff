"""Twins of kernels/content.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import Array, bilinear, cell_parts, on_box
from reference.multiband import place

# The brightest channel of what may be anything, as dark as it is, and of what surely is something.
BLACK, SEEN = 0.03, 0.15
# Share of others of which nothing is told.
LITTLE = 1e-3


def content_same(
    difference: Array,
    share: Array,
    box: Sequence[int],
    grid: Sequence[int],
    mean: Array,
    moved: Array,
    unlike: Array,
    cells: Sequence[int],
    shoulder: float,
) -> Array:
    """How surely a layer on a box, with its share of the mean, shows the same as others, (height, width)."""
    there = mean[on_box(box)][..., :3].astype(np.float64)
    own = there + difference[..., :3]
    others = own - difference[..., :3] / np.maximum(1 - share.astype(np.float64), LITTLE)[..., None]
    darker = np.minimum(others.max(-1), own.max(-1))
    seen = np.clip((darker - BLACK) / (SEEN - BLACK), 0, 1) if shoulder else np.ones(darker.shape)
    read = []
    for values in (moved, unlike):
        value, weight = bilinear(values, cells, *place(box, grid, cells))
        read.append(value / weight)
    return 1 - np.maximum(read[0], seen * read[1])


def content_gather(
    difference: Array,
    share: Array,
    same: Array,
    box: Sequence[int],
    grid: Sequence[int],
    cells: Sequence[int],
) -> Array:
    """Means over all pixels of each cell of w d (1 - share) and w (1 - share)^2; 0 beside the layer.

    same: w, of `content_same`.
    """
    rest = 1 - share.astype(np.float64)
    part = np.concatenate([difference[..., :3], rest[..., None]], -1) * (same * rest)[..., None]
    sums = np.zeros((grid[1], grid[0], 4))
    sums[on_box(box)] = part * (difference[..., 3:] > 0)
    result = np.zeros((cells[1], cells[0], 4))
    for its, pixels in cell_parts(grid, cells):
        if sums[pixels].size:
            result[its] = sums[pixels].mean((0, 1))
    return result


def content_complete(
    difference: Array,
    share: Array,
    same: Array,
    box: Sequence[int],
    grid: Sequence[int],
    told: Array,
    cells: Sequence[int],
) -> Array:
    """What the cells tell, as far as that is sure, in place of a difference where layers do not show the
    same (`content_same`).
    """
    value, weight = bilinear(told, cells, *place(box, grid, cells))
    told = value / weight[..., None]
    result, part = difference.astype(np.float64), told[..., 3:] * (1 - same[..., None])
    result[..., :3] = (1 - part) * result[..., :3] + part * (1 - share[..., None]) * told[..., :3]
    return np.where(difference[..., 3:] > 0, result, difference)

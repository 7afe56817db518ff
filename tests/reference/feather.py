"""Twins of kernels/feather.cl, and what they are for by SciPy's distances."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from reference.coefficient import coefficient_ratio
from reference.common import Array, on_box


def feather_mark(mask: Array, box: Sequence[int], shown: Array) -> Array:
    """What any layer shows, with what one that shows `mask` on a box does."""
    shown = shown.copy()
    shown[on_box(box)] |= mask
    return shown


def feather_columns(mask: Array, box: Sequence[int], shown: Array, far: int) -> Array:
    """In each column the rows to the nearest pixel that is shown, but not by the layer."""
    rows, columns = np.nonzero(shown[on_box(box)] & ~mask)
    result = np.full(mask.shape, far)
    for row, column in zip(rows, columns, strict=True):
        off = np.abs(np.arange(mask.shape[0]) - row)
        result[:, column] = np.minimum(result[:, column], off)
    return result


def feather_distance(mask: Array, rows: Array, beyond: int) -> Array:
    """The least distance of any column's, also of those that a box is continued by; 0 beside the mask."""
    around = np.pad(rows, ((0, 0), (beyond, beyond)), "wrap")
    across = np.arange(around.shape[1]) - (np.arange(rows.shape[1]) + beyond)[:, None]
    squared = (across**2 + around[:, None] ** 2).min(-1)
    return np.sqrt(squared) * mask


def feathers(masks: Sequence[Array], boxes: Sequence[Sequence[int]], grid: Sequence[int]) -> list[Array]:
    """Shares of layers that show `masks` on boxes of a grid (width, height, wraps, poles)."""
    union, total = np.zeros((grid[1], grid[0]), bool), np.zeros((grid[1], grid[0]))
    for box, mask in zip(boxes, masks, strict=True):
        union[on_box(box)] |= mask
    distances = []
    for box, mask in zip(boxes, masks, strict=True):
        border = union[on_box(box)] & ~mask
        by = mask.shape[1] // 2 if grid[2] and mask.shape[1] == grid[0] else 0
        off = ndimage.distance_transform_edt(np.pad(~border, ((0, 0), (by, by)), "wrap"))
        off = off[:, by : by + mask.shape[1]] if border.any() else np.full(mask.shape, grid[0] + grid[1])
        distances.append(off * mask)
        total[on_box(box)] += distances[-1]
    return [coefficient_ratio(one, box, total) for one, box in zip(distances, boxes, strict=True)]

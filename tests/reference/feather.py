"""Twin of kernels/feather.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from reference.common import Array


def feathers(masks: Sequence[Array], boxes: Sequence[Sequence[int]], grid: Sequence[int]) -> list[Array]:
    """Shares of layers that show `masks` on boxes of a grid (width, height, wraps, poles)."""
    union, total = np.zeros((grid[1], grid[0]), bool), np.zeros((grid[1], grid[0]), np.float32)
    parts = [np.s_[top : top + height, left : left + width] for left, top, width, height in boxes]
    for part, mask in zip(parts, masks, strict=True):
        union[part] |= mask
    distances = []
    for part, mask in zip(parts, masks, strict=True):
        border = union[part] & ~mask
        by = mask.shape[1] // 2 if grid[2] and mask.shape[1] == grid[0] else 0
        off = ndimage.distance_transform_edt(np.pad(~border, ((0, 0), (by, by)), "wrap"))
        off = off[:, by : by + mask.shape[1]] if border.any() else np.full(mask.shape, grid[0] + grid[1])
        distances.append((off * mask).astype(np.float32))
        total[part] += distances[-1]
    return [
        one / np.where(total[part] > 0, total[part], 1) for one, part in zip(distances, parts, strict=True)
    ]

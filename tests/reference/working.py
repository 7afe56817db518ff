"""Twins of kernels/working.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import Array


def _overlap(first: int, count: int, full: int, small: int, start: int, size: int) -> Array:
    """(count, size): how much of each stored pixel lies under each working pixel, in 1 / small px.

    Working pixel i covers [i full / small, (i + 1) full / small); stored pixel k is full pixel start + k.
    """
    low = ((first + np.arange(count)) * full)[:, None]
    pixel = ((start + np.arange(size)) * small)[None, :]
    return np.clip(np.minimum(low + full, pixel + small) - np.maximum(low, pixel), 0, None)


def working_reduce(
    rows: Array,
    box: Sequence[int],
    ratio: Sequence[int],
    out_box: Sequence[int],
    first: int,
    size: Sequence[int],
    white: float,
) -> Array:
    """Rows first to first + size[1] of a layer on its box of the working grid: (size[1], size[0], 4)."""
    across = _overlap(out_box[0], size[0], ratio[0], ratio[1], box[0], box[2])
    down = _overlap(out_box[1] + first, size[1], ratio[2], ratio[3], box[1], box[3])
    opaque = rows[..., -1].astype(np.float64) >= 0.5 * white
    area = ratio[0] * ratio[2]
    valid = down @ opaque.astype(np.int64) @ across.T == area
    colours = rows[..., :3] if rows.shape[-1] == 4 else rows[..., [0, 0, 0]]
    mean = np.einsum("jy,yxc,ix->jic", down, colours.astype(np.float64), across, optimize=True) / area / white
    return np.where(valid[..., None], np.concatenate([mean, np.ones((*valid.shape, 1))], -1), 0.0)


def working_compare(a: Array, a_box: Sequence[int], b: Array, b_box: Sequence[int]) -> bool:
    """Whether the colours differ on a pixel that both cover."""
    left, top = max(a_box[0], b_box[0]), max(a_box[1], b_box[1])
    right, bottom = (
        min(a_box[0] + a_box[2], b_box[0] + b_box[2]),
        min(a_box[1] + a_box[3], b_box[1] + b_box[3]),
    )
    if right <= left or bottom <= top:
        return False
    common = [
        pixels[top - box[1] : bottom - box[1], left - box[0] : right - box[0]]
        for pixels, box in ((a, a_box), (b, b_box))
    ]
    both = (common[0][..., 3] != 0) & (common[1][..., 3] != 0)
    return bool(np.any(common[0][both][:, :3] != common[1][both][:, :3]))

"""Twins of kernels/transition.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import Array, Numbers, bilinear, pixels


def transition_strain(
    displacement: Array,
    blend: Array,
    layer: Array,
    box: Sequence[int],
    border: Sequence[int],
    lens: Numbers,
    every: int,
    cells: Sequence[int],
) -> Array:
    """Sums of w (1 - w) strain^4 and w (1 - w) in each cell, (height, width, 2).

    Of the layer's pixels every n-th column and row is read; `displacement` has no others.
    """
    left, top, _, height = box
    lens = np.asarray(lens, np.float64)
    w = blend.astype(np.float64)
    across = np.ones(height)
    unit = 1.0
    if lens[1]:
        across = np.maximum(np.cos(lens[2] - (np.arange(height) + top + 0.5) * lens[3]), 0.02)
        unit = 1 / lens[1]
    down, right = np.gradient(w)
    length = np.zeros(w.shape)
    length[::every, ::every] = unit * np.linalg.norm(displacement[..., :3].astype(np.float64), axis=-1)
    strain = np.hypot(right / across[:, None], down) * length / np.maximum(1 - w, 0.05)
    valid = layer[..., 3] != 0
    usable = valid & (w > 0) & (w < 1)
    for axis in (0, 1):
        for step in (-1, 1):
            usable &= np.roll(valid, step, axis)
    usable[[0, -1]] = usable[:, [0, -1]] = False
    result = np.zeros((cells[1], cells[0], 2))
    for j, i in np.ndindex(cells[1], cells[0]):
        first = [
            max(k * b // c - o, 1) for k, b, c, o in zip((i, j), border, cells, (left, top), strict=False)
        ]
        last = [(k + 1) * b // c - o for k, b, c, o in zip((i, j), border, cells, (left, top), strict=False)]
        start = [-(-at // every) * every for at in first]
        part = np.s_[start[1] : max(last[1], 0) : every, start[0] : max(last[0], 0) : every]
        weight = (w * (1 - w) * usable)[part]
        result[j, i] = (weight * strain[part] ** 4).sum(), weight.sum()
    return result


def transition_sharpen(
    blend: Array, box: Sequence[int], border: Sequence[int], power: Array, cells: Sequence[int]
) -> Array:
    """Coefficients to the power of the transition grid at their pixels."""
    columns, rows = pixels(box[2], box[3], box[0], box[1])
    x, y = (columns + 0.5) * cells[0] / border[0], (rows + 0.5) * cells[1] / border[1]
    total, share = bilinear(power, cells, x, y)
    w = blend.astype(np.float64)
    return np.where((w > 0) & (w < 1), w ** (total / share), w)


def transition_ratio(blend: Array, box: Sequence[int], total: Array) -> Array:
    """Coefficients over their total, a (height, width) array of the working grid."""
    left, top, width, height = box
    total = total[top : top + height, left : left + width].astype(np.float64)
    return np.where(total > 0, blend / np.where(total > 0, total, 1), blend)

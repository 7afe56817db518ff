"""Twins of kernels/membrane.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import Array, bilinear, cell_parts, on_box, pixels


def membrane_mean(
    layer: Array, field: Array, box: Sequence[int], border: Sequence[int], cells: Sequence[int]
) -> Array:
    """Mean displacement of the valid pixels of each cell, and 1; zeros where there are none."""
    valid = np.zeros((border[1], border[0], 4))
    known = layer[..., 3:] > 0
    valid[on_box(box)] = np.concatenate([field[..., :3], np.ones(known.shape)], -1) * known
    result = np.zeros((cells[1], cells[0], 4))
    for place, part in cell_parts(border, cells):
        total = valid[part].sum((0, 1))
        result[place] = total / total[3] if total[3] else 0
    return result


def membrane_stretch(
    field: Array, box: Sequence[int], border: Sequence[int], told: Array, cells: Sequence[int]
) -> Array:
    """The field with other displacements, as far as cells tell them."""
    x, y = pixels(box[2], box[3], box[0], box[1])
    value, weight = bilinear(told, cells, (x + 0.5) * cells[0] / border[0], (y + 0.5) * cells[1] / border[1])
    other = value / weight[..., None]
    result = field.astype(np.float64)
    result[..., :3] = (1 - other[..., 3:]) * result[..., :3] + other[..., :3]
    return result

"""Twins of kernels/colour.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import Array, Numbers, exposure_scale, layer_seen, pixels


def colour_difference(
    layer_a: Array,
    field_a: Array,
    box_a: Sequence[int],
    layer_b: Array,
    field_b: Array,
    box_b: Sequence[int],
    border: Sequence[int],
    lens: Numbers,
    cells: Sequence[int],
    integer: int,
    clipped: float,
    spread: float,
) -> Array:
    """Mean difference a - b of every cell's pixels, every other one in x and y, and its weight."""
    columns, rows = pixels(border[0], border[1])
    a = layer_seen(layer_a, field_a, box_a, columns, rows, border, lens)
    b = layer_seen(layer_b, field_b, box_b, columns, rows, border, lens)
    usable = (
        (a[..., 3] > 0) & (b[..., 3] > 0) & (a[..., :3].max(-1) <= clipped) & (b[..., :3].max(-1) <= clipped)
    )
    difference = exposure_scale(a[..., :3], integer) - exposure_scale(b[..., :3], integer)
    result = np.zeros((cells[1], cells[0], 4))
    for j, i in np.ndindex(cells[1], cells[0]):
        left, right = (k * border[0] // cells[0] for k in (i, i + 1))
        top, bottom = (k * border[1] // cells[1] for k in (j, j + 1))
        part = np.s_[top:bottom:2, left:right:2]
        values = difference[part][usable[part]]
        if len(values):
            variance = values.var(0).sum()
            trust = len(values) / usable[part].size / (1 + variance / spread**2)
            result[j, i] = [*values.mean(0), trust]
    return result

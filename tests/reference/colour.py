"""Twins of kernels/colour.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import (
    Array,
    Numbers,
    canvas_point,
    canvas_position,
    exposure_scale,
    four_taps,
    grid_border,
    pixels,
    take,
)


def _seen(
    layer: Array, field: Array, box: Sequence[int], x: Array, y: Array, border: Sequence[int], lens: Numbers
) -> Array:
    """What a layer shows for working pixels (x, y) after its displacement: r, g, b, valid."""
    way = take(field, box, x, y)[..., :3]
    own = take(layer, box, x, y)[..., 3] != 0
    px, py = canvas_position(canvas_point(x + 0.5, y + 0.5, lens) + way, lens)
    still = ~way.any(-1)
    px, py = np.where(still, x + 0.5, px), np.where(still, y + 0.5, py)
    total = 0.0
    for column, row, weight in four_taps(px, py):
        column, row, inside = grid_border(column, row, border)
        total = total + weight[..., None] * take(layer, box, column, row, inside)
    return np.where((own & (total[..., 3] > 0.999))[..., None], total, 0.0)


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
    a = _seen(layer_a, field_a, box_a, columns, rows, border, lens)
    b = _seen(layer_b, field_b, box_b, columns, rows, border, lens)
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

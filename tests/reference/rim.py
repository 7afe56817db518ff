"""Twins of kernels/rim.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import Array, Numbers, canvas_point, canvas_position, pixels

# Of a strip's thickness, how far displacements lead towards the rim at most.
FURTHEST = 0.75


def _cells(box: Sequence[int], border: Sequence[int], cells: Sequence[int]) -> tuple[Array, Array]:
    """Columns and rows of the cells that a box's pixels are in."""
    x, y = pixels(box[2], box[3], box[0], box[1])
    return (x * 2 + 1) * cells[0] // (2 * border[0]), (y * 2 + 1) * cells[1] // (2 * border[1])


def rim_fade(
    field: Array, box: Sequence[int], border: Sequence[int], left: Array, cells: Sequence[int]
) -> Array:
    """The field with less weight, by what cells say."""
    column, row = _cells(box, border, cells)
    result = field.copy()
    result[..., 3] *= left[row, column]
    return result


def rim_carry(
    field: Array,
    layer: Array,
    box: Sequence[int],
    border: Sequence[int],
    lonlat: Numbers,
    source: Array,
    outward: Array,
    cells: Sequence[int],
) -> Array:
    """The field with what the middles of other cells have where these are named, and the layer is there; less
    far towards the rim."""
    column, row = _cells(box, border, cells)
    result = field.astype(np.float64)
    for y, x in np.argwhere(source[row, column] >= 0):
        from_row, from_column = divmod(source[row[y, x], column[y, x]], cells[0])
        there_x = (2 * from_column + 1) * border[0] // (2 * cells[0]) - box[0]
        there_y = (2 * from_row + 1) * border[1] // (2 * cells[1]) - box[1]
        if not (0 <= there_x < box[2] and 0 <= there_y < box[3] and layer[there_y, there_x, 3] > 0):
            continue
        result[y, x] = field[there_y, there_x]
        q = np.array([x + box[0] + 0.5, y + box[1] + 0.5])
        point = canvas_point(*q, lonlat)
        there = np.array(canvas_position(point + result[y, x, :3], lonlat))
        if lonlat[1]:
            around = 2 * np.pi / lonlat[1]
            there[0] -= around * np.round((there[0] - q[0]) / around)
        way_x, way_y, share, thick = outward[row[y, x], column[y, x]]
        far = (there - q) @ [way_x, way_y]
        if far > 0:
            there -= (far - min(far, FURTHEST * thick) * share) * np.array([way_x, way_y])
            result[y, x, :3] = canvas_point(*there, lonlat) - point
    return result

"""Twins of kernels/seam.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import Array, Numbers, bilinear, cell_parts, exposure_shift, layer_seen, pixels


def seam_difference(
    layer_a: Array,
    field_a: Array,
    box_a: Sequence[int],
    gain_a: Array,
    layer_b: Array,
    field_b: Array,
    box_b: Sequence[int],
    gain_b: Array,
    border: Sequence[int],
    lens: Numbers,
    colours: Sequence[int],
    cells: Sequence[int],
    shoulder: float,
    clipped_a: Numbers,
    clipped_b: Numbers,
) -> tuple[Array, Array]:
    """Mean corrected difference a - b of every cell's pixels, every other one in x and y, with their share,
    and the largest channel's mean square; samples brighter than `clipped` of their layer are left out."""
    columns, rows = pixels(border[0], border[1])
    gain_row = (2 * np.arange(cells[1]) + 1) * colours[1] // (2 * cells[1])
    gain_column = (2 * np.arange(cells[0]) + 1) * colours[0] // (2 * cells[0])
    cell = [
        np.searchsorted(np.arange(1, c + 1) * b // c, np.arange(b), "right")
        for b, c in zip(border, cells, strict=False)
    ]
    looks = []
    usable = np.ones((border[1], border[0]), bool)
    sides = (layer_a, field_a, box_a, gain_a, clipped_a), (layer_b, field_b, box_b, gain_b, clipped_b)
    for layer, field, box, gain, clipped in sides:
        seen = layer_seen(layer, field, box, columns, rows, border, lens)
        usable &= (seen[..., 3] > 0) & (seen[..., :3] <= np.float32(clipped)[:3]).all(-1)
        here = gain[gain_row[cell[1]][:, None], gain_column[cell[0]][None], :3].astype(np.float64)
        shifted = exposure_shift(seen[..., :3], here, shoulder)
        looks.append(shifted if shoulder else np.sqrt(np.maximum(shifted, 0)))
    result, square = np.zeros((cells[1], cells[0], 4)), np.zeros((cells[1], cells[0]))
    for place, part in cell_parts(border, cells, 2):
        values = (looks[0] - looks[1])[part][usable[part]]
        if len(values):
            result[place] = [*values.mean(0), len(values) / usable[part].size]
            square[place] = (values**2).mean(0).max()
    return result, square


def seam_yield(
    field: Array,
    box: Sequence[int],
    border: Sequence[int],
    yields: Array,
    cells: Sequence[int],
    trace: float,
) -> Array:
    """The field (height, width, 4) with the weight of a layer that yields, all but a trace; `yields` is on
    the cells."""
    columns, rows = pixels(box[2], box[3], box[0], box[1])
    x, y = (columns + 0.5) * cells[0] / border[0], (rows + 0.5) * cells[1] / border[1]
    given, share = bilinear(yields, cells, x, y)
    result = field.astype(np.float64)
    result[..., 3] *= np.maximum((1 - given / share) ** 4, trace)
    return result

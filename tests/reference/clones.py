"""Twins of kernels/clones.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import Array, Numbers, cell_parts, layer_look


def clones_look(
    layer: Array,
    field: Array,
    box: Sequence[int],
    gain: Array,
    border: Sequence[int],
    lonlat: Numbers,
    colours: Sequence[int],
    cells: Sequence[int],
    shoulder: float,
) -> Array:
    """Mean corrected colour, as seen, of every cell's pixels, every other one in x and y, and their share."""
    seen, look = layer_look(layer, field, box, gain, border, lonlat, colours, cells, shoulder)
    shown = seen[..., 3] > 0
    result = np.zeros((cells[1], cells[0], 4))
    for place, part in cell_parts(border, cells, 2):
        values = look[part][shown[part]]
        if len(values):
            result[place] = [*values.mean(0), len(values) / shown[part].size]
    return result

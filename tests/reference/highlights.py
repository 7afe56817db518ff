"""Twins of kernels/highlights.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import Array, bilinear, cell_parts, on_box, pixels


def highlights_share(
    layer: Array,
    box: Sequence[int],
    border: Sequence[int],
    cells: Sequence[int],
    white: Sequence[float],
    nearly: float,
    surely: float,
) -> Array:
    """Mean over each cell's valid pixels of how surely they are clipped; 0 where none is valid."""
    whole = np.zeros((border[1], border[0], 4))
    whole[on_box(box)] = layer
    sure = np.clip(((whole / white)[..., :3].max(-1) - nearly) / (surely - nearly), 0, 1)
    result = np.zeros((cells[1], cells[0]))
    for place, part in cell_parts(border, cells):
        valid = whole[part][..., 3] > 0
        if valid.any():
            result[place] = sure[part][valid].mean()
    return result


def _on_pixels(values: Array, cells: Sequence[int], box: Sequence[int], border: Sequence[int]) -> Array:
    """What cells tell of a box's pixels, between the cells' centres."""
    x, y = pixels(box[2], box[3], box[0], box[1])
    total, share = bilinear(values, cells, (x + 0.5) * cells[0] / border[0], (y + 0.5) * cells[1] / border[1])
    return total / share


def highlights_reduce(
    field: Array,
    box: Sequence[int],
    border: Sequence[int],
    logarithms: Array,
    cells: Sequence[int],
) -> Array:
    """The weight times exp(-logarithm)."""
    result = field.astype(np.float64)
    result[..., 3] *= np.exp(-_on_pixels(logarithms, cells, box, border))
    return result


def highlights_restore(
    field: Array,
    box: Sequence[int],
    border: Sequence[int],
    logarithms: Array,
    cells: Sequence[int],
    part: Array,
    part_cells: Sequence[int],
) -> Array:
    """The weight times exp(part * logarithm)."""
    logarithm, share = (_on_pixels(v, on, box, border) for v, on in ((logarithms, cells), (part, part_cells)))
    result = field.astype(np.float64)
    result[..., 3] *= np.exp(share * logarithm)
    return result

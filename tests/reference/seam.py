"""Twins of kernels/seam.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import Array, bilinear, pixels


def seam_yield(
    field: Array, box: Sequence[int], border: Sequence[int], yields: Array, cells: Sequence[int]
) -> Array:
    """The field (height, width, 4) with the weight of a layer that yields; `yields` is on the cells."""
    columns, rows = pixels(box[2], box[3], box[0], box[1])
    x, y = (columns + 0.5) * cells[0] / border[0], (rows + 0.5) * cells[1] / border[1]
    given, share = bilinear(yields, cells, x, y)
    result = field.astype(np.float64)
    result[..., 3] *= np.maximum((1 - given / share) ** 4, 1e-12)
    return result

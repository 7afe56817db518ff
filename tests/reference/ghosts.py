"""Twin of kernels/ghosts.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import Array, bilinear, pixels

LEAST = 1.7e-38


def ghosts_sharpen(
    field: Array, box: Sequence[int], border: Sequence[int], power: Array, cells: Sequence[int]
) -> Array:
    """The field (height, width, 4) with weights raised to what is, on the cells, their power."""
    columns, rows = pixels(box[2], box[3], box[0], box[1])
    x, y = (columns + 0.5) * cells[0] / border[0], (rows + 0.5) * cells[1] / border[1]
    given, share = bilinear(power, cells, x, y)
    its = given / share
    result = field.astype(np.float64)
    changed = (result[..., 3] > 0) & (its > 1 + 1e-6)
    logarithms = its * np.log(np.maximum(result[..., 3], LEAST))
    result[..., 3] = np.where(changed, np.exp(np.maximum(logarithms, -87)), result[..., 3])
    return result

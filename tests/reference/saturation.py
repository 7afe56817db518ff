"""Twin of kernels/saturation.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import Array


def saturation_pick(layer: Array, box: Sequence[int], every: int, place: Sequence[int]) -> Array:
    """The layer's pixels in rows and columns of the grid that `every` divides."""
    whole = np.zeros((box[1] + box[3], box[0] + box[2], 4), np.float32)
    whole[box[1] :, box[0] :] = layer
    picked = whole[::every, ::every]
    return picked[place[1] : place[1] + place[3], place[0] : place[0] + place[2]]

"""Twin of kernels/unit.cl."""

from __future__ import annotations

import numpy as np

from reference.common import Array


def unit_scale(layer: Array, factor: float) -> Array:
    """A layer whose colours are multiplied."""
    return layer * np.float32([factor, factor, factor, 1])

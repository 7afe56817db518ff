"""Twin of kernels/unit.cl."""

from __future__ import annotations

import numpy as np

from reference.common import Array


def unit_code(layer: Array, root: float) -> Array:
    """A layer whose light is coded by its root."""
    return np.concatenate([root * np.sqrt(np.maximum(layer[..., :3], 0)), layer[..., 3:]], axis=-1)

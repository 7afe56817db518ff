"""Floats coded as photos are (kernels/unit.cl).

Of integers full scale is the unit; dark noise, and what slope is seen, are told by it. Floats are linear
light of whatever scale: a room may have a hundredth, of which half is as dark as noise, so that nothing is
matched and exposures are hardly brought together. So all layers alike are scaled until their middle is the
grey of a photo, and coded by their roots, nearly as photos are by sRGB's curve: all that sees far sees them
as it does photos. The full-resolution pass corrects their roots, and adds light.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from hugin_abflow.opencl import Device
from hugin_abflow.working import WorkingLayer

# Every so many-th working pixel is looked at.
_EVERY = 8
# What the median of the brightest channel becomes, of full scale, before it is coded: exposure meters' grey.
_MIDDLE = 0.18


def code_floats(device: Device, layers: Sequence[WorkingLayer]) -> float:
    """Code the pixels of float layers, in place, and leave those of integers.

    Returns the value of the layers' light that counts as full scale then.
    """
    floats = [one for one in layers if one.layer.dtype.kind == "f"]
    full = _full_scale([one.pixels.get()[::_EVERY, ::_EVERY].copy() for one in floats])  # the rest is freed
    for one in floats:
        size = one.box[2:]
        device.run("unit", "unit_code", size, one.pixels, size, 1 / math.sqrt(full))
    return full


def _full_scale(picked: Sequence[np.ndarray]) -> float:
    """What counts as full scale. picked: some of each layer's pixels, float32 (height, width, 4)."""
    brightest = [one[..., :3].max(-1)[one[..., 3] > 0] for one in picked]
    values = np.concatenate(brightest) if brightest else np.zeros(0, np.float32)
    values = values[(values > 0) & np.isfinite(values)]
    return float(np.median(values)) / _MIDDLE if values.size else 1.0

"""The unit of floats, whose full scale nobody knows (kernels/unit.cl).

Of integers full scale is the unit; dark noise, and what slope is seen, are told by it. Floats are linear
light of whatever scale: those of a room may be a hundredth, and count as noise, so that nothing is matched
and exposures are hardly brought together. So they are scaled, all layers alike, until their middle is that of
a photo. Gains are factors, and stay what they are.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hugin_abflow.opencl import Device
from hugin_abflow.working import WorkingLayer

# Every so many-th working pixel is looked at.
_EVERY = 8
# The median of the brightest channel is brought into this range, of full scale: 0.18 is the grey of exposure
# meters in linear light, 0.5 about that of what is coded as photos are.
_LEAST, _MOST = 0.18, 0.5


def scale_floats(device: Device, layers: Sequence[WorkingLayer]) -> float:
    """Scale the pixels of float layers by one factor, in place, and leave those of integers.

    Returns the value of the layers that counts as full scale then.
    """
    floats = [one for one in layers if one.layer.dtype.kind == "f"]
    factor = _factor([one.pixels.get()[::_EVERY, ::_EVERY] for one in floats])
    for one in floats if factor != 1 else ():
        device.run("unit", "unit_scale", one.box[2:], one.pixels, one.box[2:], factor)
    return 1 / factor


def _factor(picked: Sequence[np.ndarray]) -> float:
    """By what is multiplied. picked: some of each layer's pixels, float32 (height, width, 4)."""
    brightest = [one[..., :3].max(-1)[one[..., 3] > 0] for one in picked]
    values = np.concatenate(brightest) if brightest else np.zeros(0, np.float32)
    values = values[(values > 0) & np.isfinite(values)]
    if not values.size:
        return 1.0
    middle = float(np.median(values))
    return min(max(middle, _LEAST), _MOST) / middle

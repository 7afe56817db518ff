"""Floats, coded as photos are (kernels/unit.cl).

Thresholds for dark noise, and for slopes that are seen, are shares of full scale. That is the unit of
integers, but floats are linear light of any scale: a room may have values around 0.01, which would be taken
for noise, and nothing would be matched. So all layers are scaled alike, until the median is the grey of a
photo, and the root is taken, which is nearly the curve of sRGB. All steps at working resolution see floats
like that. The full-resolution pass corrects the roots, and blends light.
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

    Returns the light unit: the value of the layers' light that counts as full scale then; without floats 1.
    """
    floats = [one for one in layers if one.layer.dtype.kind == "f"]
    light_unit = _light_unit([one.pixels.get()[::_EVERY, ::_EVERY].copy() for one in floats])  # rest is freed
    for one in floats:
        code(device, one, light_unit)
    return light_unit


def code(device: Device, layer: WorkingLayer, light_unit: float) -> None:
    """Code the pixels of one, in place, if it is of floats, by a unit that is known."""
    if layer.layer.dtype.kind == "f":
        size = layer.box[2:]
        device.run("unit", "unit_code", size, layer.pixels, size, 1 / math.sqrt(light_unit))


def _light_unit(picked: Sequence[np.ndarray]) -> float:
    """Of floats alike. picked: some of each layer's pixels, float32 (height, width, 4)."""
    brightest = [one[..., :3].max(-1)[one[..., 3] > 0] for one in picked]
    values = np.concatenate(brightest) if brightest else np.zeros(0, np.float32)
    values = values[(values > 0) & np.isfinite(values)]
    return float(np.median(values)) / _MIDDLE if values.size else 1.0

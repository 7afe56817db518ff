"""The grey at which a photo is clipped (kernels/saturation.cl).

A photo is clipped at full scale. But if its exposure was corrected, as nona does where Hugin has found
exposures, what is clipped becomes some grey, and nothing in the layer is brighter. That grey is no true
colour: it tells nothing of exposure, and another photo that shows more of that place is the better one.

A flat lamp in a dark photo gives the same spike of brightest values. But another photo, compared by their
exposures, shows the lamp no brighter, while it shows more than what was clipped.

The same holds for floats that were made from clipped photos: their full scale is not known, and is found in
the same way, from what is brightest.

What was clipped in one channel only, or where vignetting was corrected as well, is not found.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from hugin_abflow.geometry import Pair
from hugin_abflow.layer import Box
from hugin_abflow.opencl import Device
from hugin_abflow.working import CLIPPED, WorkingLayer

Values = npt.NDArray[np.float32]
White = tuple[float, float, float]

# Working pixels from one that is looked at to the next.
_EVERY = 8
# The least number of such pixels that tells something.
_ENOUGH = 30
# Levels of 8 bits from the brightest down to white, at most: between is overshoot, of sampling.
_OVERSHOOT = 12
# Levels of 8 bits from white down to where there are clearly fewer pixels.
_APART = 6
# How many times as many pixels of white there have to be.
_DISTINCT = 3.0
# The least share of a layer that is white.
_SHARE = 0.003
# The part of what is white that may be brighter.
_BEYOND = 1 / 8
# Levels of 8 bits below white that are white.
_NEAR = 2.0
# Nothing darker is white: exposures are not corrected by so much.
_LEAST = 64
# What the floats that hardly any others exceed are taken for, of full scale: less than CLIPPED, as nobody
# knows that they are white.
_TOP = 0.95
# What floats are taken for at most, of full scale.
_MOST = 1.2
# What is darker than this, of full scale, is noise.
_DARK = 0.02
# How many times as bright another photo has to show what is clipped here.
_BRIGHTER = 1.1
# The part of it that has to be so.
_PART = 0.03


@dataclass(frozen=True)
class _Picked:
    """Some of a layer's pixels, (height, width, 4), and their place among those of the grid.

    unit    the layer's value of which each is a multiple.
    """

    place: Box
    pixels: Values
    unit: float = 1.0

    def at(self, place: Box) -> Values:
        """Those of a part of the place."""
        top, left = place.top - self.place.top, place.left - self.place.left
        return self.pixels[top : top + place.height, left : left + place.width]


def with_whites(device: Device, layers: Sequence[WorkingLayer], pairs: Sequence[Pair]) -> list[WorkingLayer]:
    """The same layers, with what they show white.

    pairs       layers that overlap.
    """
    if not pairs:
        return list(layers)
    picked = [_pick(device, layer) for layer in layers]
    whites = [_brightest(one.pixels) for one in picked]
    result = list(layers)
    for k, white in enumerate(whites):
        others = [pair.b if pair.a == k else pair.a for pair in pairs if k in (pair.a, pair.b)]
        if white is None or not others:
            continue
        brighter = np.concatenate([_brighter(*_common(picked[k], picked[j]), white) for j in others])
        if np.count_nonzero(brighter) >= max(_ENOUGH, _PART * brighter.size):
            red, green, blue = (picked[k].unit * channel for channel in white)
            result[k] = replace(layers[k], white=(red, green, blue))
    return result


def _pick(device: Device, layer: WorkingLayer) -> _Picked:
    """Every so many-th pixel of a layer."""
    left, top, width, height = layer.box
    place = Box(*(-(-edge // _EVERY) for edge in (left, top, left + width, top + height)))
    size = place.width, place.height
    pixels = device.empty((place.height, place.width, 4))
    device.run(
        "saturation", "saturation_pick", size,
        layer.pixels, layer.box, _EVERY, (place.left, place.top, *size), pixels,
    )  # fmt: skip
    picked = _Picked(place, pixels.get())
    return picked if layer.layer.dtype.kind == "u" else _to_scale(picked)


def _to_scale(floats: _Picked) -> _Picked:
    """The same with what may be full scale as 1: hardly any values are brighter."""
    values = floats.pixels[floats.pixels[..., 3] > 0][:, :3]
    brightest = float(np.quantile(values, 1 - _SHARE / 8)) if values.size else 0.0
    unit = brightest / _TOP if 0 < brightest < math.inf else 1.0
    colours = np.clip(floats.pixels[..., :3] / np.float32(unit), 0, _MOST)
    return _Picked(floats.place, np.dstack([colours, floats.pixels[..., 3]]), unit)


def _brightest(pixels: Values) -> White | None:
    """The grey of which there is much and nothing beyond, where it is not full white; None: there is none."""
    seen = pixels[pixels[..., 3] > 0][:, :3]
    if len(seen) < _ENOUGH:
        return None
    red, green, blue = (_spike(channel) for channel in seen.T)
    if red is None or green is None or blue is None or min(red, green, blue) > CLIPPED:
        return None  # of full scale: it is taken for clipped as it is
    return red, green, blue


def _spike(values: Values) -> float | None:
    """The brightness of which there are many values and hardly any that are brighter; None: there is none."""
    counts = np.bincount(np.rint(values * 255).astype(np.int64), minlength=256)
    around = np.convolve(counts, (1, 1, 1), "same")
    last = int(np.flatnonzero(counts[::-1].cumsum()[::-1] > _SHARE / 4 * values.size).max())
    low = max(last - _OVERSHOOT, _LEAST)
    if last < low:
        return None
    level = low + int(np.argmax(around[low : last + 2]))
    least = max(_SHARE * values.size, _DISTINCT * around[level - _APART])
    if around[level] < least or counts[level + 2 :].sum() > _BEYOND * around[level]:
        return None
    near = np.abs(values * 255 - level) < 1.5
    return float(np.mean(values[near], dtype=np.float64))


def _common(a: _Picked, b: _Picked) -> tuple[Values, Values]:
    """Pixels (n, 3) that two layers have in common."""
    place = a.place.intersect(b.place)
    of_a, of_b = a.at(place), b.at(place)
    both = (of_a[..., 3] > 0) & (of_b[..., 3] > 0)
    return of_a[both][:, :3], of_b[both][:, :3]


def _brighter(values: Values, others: Values, white: White) -> npt.NDArray[np.bool_]:
    """Whether the other layer's brightest are clearly brighter: as many values as are white here.

    values, others    of the same places, (n, 3).

    What is brightest in one layer is brightest in the other: sorted, they are compared without knowing where
    things are, of which near ones have moved. Exposures are compared by what is neither dark nor white.
    """
    here = np.asarray(white, np.float32)
    count = np.count_nonzero((values > here - _NEAR / 255).all(1))
    rest = len(values) - count
    if min(count, rest) < _ENOUGH:
        return np.zeros(0, bool)
    a, b = np.sort(values, axis=0), np.sort(others, axis=0)
    middle = slice(rest // 10, rest - rest // 10)
    ratios = np.maximum(b[middle], _DARK) / np.maximum(a[middle], _DARK)
    low, exposure, high = np.quantile(ratios, (0.15, 0.5, 0.85), axis=0)
    unsure = float(np.max((high - low) / exposure))
    return np.asarray((b[rest:] / (exposure * here)).mean(1) > _BRIGHTER + unsure / 2)

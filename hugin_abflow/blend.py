"""The full-resolution pass: band by band, every layer sampled once, softmax-weighted (kernels/blend.cl)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from hugin_abflow.layer import Box
from hugin_abflow.opencl import Buffer, Device, DeviceMemoryError
from hugin_abflow.progress import Advance
from hugin_abflow.settings import Settings
from hugin_abflow.working import Grid, WorkingLayer, device_rows, pixel_options

# Bands of about this many output pixels, where the settings leave the choice.
_BAND_PIXELS = 1 << 22
_LEAST_ROWS = 16


@dataclass(frozen=True)
class BlendLayer:
    """What the full-resolution pass knows of one layer.

    field   displacement and colour weight on the layer's box of the working grid.
    reach   per row of that box, the largest vertical displacement, working px.
    gain    on the exposure scale and the colour grid, float32 (height, width, 4); None: no correction.
    """

    working: WorkingLayer
    field: Buffer
    reach: Sequence[float]
    gain: Buffer | None


def _rows_needed(layer: BlendLayer, full: Grid, grid: Grid, top: int, bottom: int) -> tuple[int, int]:
    """Layer rows (from, to) that region rows [top, bottom) may sample; equal if none."""
    box, place = layer.working.layer.box, layer.working.box
    scale = full.height / grid.height
    first = max(0, math.floor(top / scale) - 1 - place[1])
    last = min(place[3], math.ceil(bottom / scale) + 2 - place[1])
    beyond = math.ceil(max(layer.reach[first:last], default=0.0) * scale) + 3  # 3: bicubic taps, rounding
    offset = box.top - full.region.top
    start, end = max(0, top - beyond - offset), min(box.height, bottom + beyond - offset)
    if bottom <= offset or top >= offset + box.height:
        return 0, 0
    return start, max(start, end)


def bands(
    device: Device,
    layers: Sequence[BlendLayer],
    full: Grid,
    grid: Grid,
    gain_grid: Grid,
    crop: Box,
    settings: Settings,
    advance: Advance,
) -> Iterator[npt.NDArray[Any]]:
    """Rows of the panorama, from the crop's top to its bottom: (rows, crop width, channels + 1) in the
    layers' dtype, alpha last. `crop` is in canvas pixels; `advance` counts rows.
    """
    first = layers[0].working.layer
    height = settings.band_rows or max(_LEAST_ROWS, _BAND_PIXELS // crop.width)
    top = crop.top
    while top < crop.bottom:
        part = Box(crop.left, top, crop.right, min(crop.bottom, top + height))
        try:
            out = _band(device, layers, full, grid, gain_grid, part, settings)
        except DeviceMemoryError:
            if height <= _LEAST_ROWS:
                raise
            height = max(_LEAST_ROWS, height // 2)  # the device is smaller than it says
            continue
        yield out.astype(first.dtype) if first.dtype == np.float16 else out
        advance(part.height)
        top = part.bottom


def _band(
    device: Device,
    layers: Sequence[BlendLayer],
    full: Grid,
    grid: Grid,
    gain_grid: Grid,
    part: Box,
    settings: Settings,
) -> npt.NDArray[Any]:
    region = full.region
    band = (part.left - region.left, part.top - region.top, part.width, part.height)
    size = band[2:]
    pixel, white = pixel_options(layers[0].working.layer)
    integer = int(layers[0].working.layer.dtype.kind == "u")
    options = f"{pixel} -DWHITE={white:.1f}f -DINTEGER={integer}"
    shape = (part.height, part.width)
    count = device.zeros(shape, np.uint8)
    reference, total = device.zeros((*shape, 4)), device.zeros((*shape, 4))
    stored: list[tuple[BlendLayer, Buffer, tuple[int, int, int, int]]] = []
    for layer in layers:
        start, end = _rows_needed(layer, full, grid, band[1], band[1] + band[3])
        if start == end:
            continue
        box = layer.working.layer.box
        rows = device.upload(device_rows(layer.working.layer, start, end))
        place = (box.left - region.left, box.top - region.top + start, box.width, end - start)
        device.run("blend", "blend_count", size, rows, place, band, count, options=options)
        stored.append((layer, rows, place))
    nothing = device.empty((1, 1, 4))
    for layer, rows, place in stored:
        device.run(
            "blend", "blend_add", size, rows, place, band, full.border, full.lens,
            layer.field, layer.working.box, grid.border,
            layer.gain or nothing, gain_grid.border, int(layer.gain is not None),
            int(settings.interpolation == "nearest"), count, reference, total, options=options,
        )  # fmt: skip
    samples = layers[0].working.layer.channels + 1
    dtype = np.float32 if layers[0].working.layer.dtype == np.float16 else layers[0].working.layer.dtype
    out = device.empty((*shape, samples), dtype)
    origin = (region.left, region.top)
    device.run("blend", "blend_finish", size, reference, total, band, origin, out, options=options)
    return out.get()

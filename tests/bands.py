"""Layers for tests of the full-resolution pass, and what it makes of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from grids import patches
from scipy import ndimage

from hugin_abflow import blend, geometry, working
from hugin_abflow.blend import BlendLayer, Prepared
from hugin_abflow.grid import Grid
from hugin_abflow.layer import Box, Layer, full_scale
from hugin_abflow.opencl import Device
from hugin_abflow.settings import Settings


def stored_pixels(seed: int, width: int, height: int, dtype: type, channels: int, share: float) -> np.ndarray:
    """Random samples, smooth enough to be sampled between pixels, with a ragged mask; not black outside."""
    random = np.random.default_rng(seed)
    values = ndimage.gaussian_filter(random.random((height, width, channels)), (1, 1, 0))
    values = (values - values.min()) / np.ptp(values)
    values = np.concatenate([values, patches(seed + 1, width, height, share)[..., None]], -1)
    return (values if dtype == np.float32 else np.rint(values * full_scale(dtype))).astype(dtype)


def field_of(seed: int, grid: Grid, box: Sequence[int], strength: float) -> np.ndarray:
    """Displacement up to `strength` working px (as points on a sphere) and a weight with some zeros."""
    random = np.random.default_rng(seed)
    noise = ndimage.gaussian_filter(random.normal(size=(box[3], box[2], 4)), (3, 3, 0))
    noise /= np.abs(noise).max((0, 1))
    field = noise * strength * (grid.lonlat[1] or 1)
    if not grid.lonlat[1]:
        field[..., 2] = 0
    field[:4, :, :3] = 0  # some do not move
    field[..., 3] = np.maximum(noise[..., 3] + 0.5, 0)
    return field.astype(np.float32)


def blend_layer(
    device: Device,
    pixels: np.ndarray,
    left: int,
    top: int,
    full: Grid,
    grid: Grid,
    field: np.ndarray | None = None,
    gain: np.ndarray | None = None,
    offset: np.ndarray | None = None,
) -> BlendLayer:
    """A layer as the pass takes it; without a field it does not move. gain, offset: on grids of `merged`."""
    layer = Layer.from_array("layer", pixels, left + full.region.left, top + full.region.top)
    reduced = working.reduce_layer(device, layer, grid, lambda units: None)
    if field is None:
        field = np.zeros((*reduced.pixels.shape[:2], 4), np.float32)
        field[..., 3] = 1
    else:
        field = field[: reduced.box[3], : reduced.box[2]]
    buffer = device.upload(field)
    reach = geometry.reach(device, reduced, buffer, grid)
    gains = None if gain is None else device.upload(gain)
    offsets = None if offset is None else ((0, 0, *offset.shape[1::-1]), device.upload(offset))
    return BlendLayer(layer, reduced.box, buffer, reach, gains, offsets)


def merged(
    device: Device, layers: list[BlendLayer], full: Grid, grid: Grid, crop: Box | None = None, rows: int = 0
) -> np.ndarray:
    shoulder = float(layers[0].layer.dtype.kind == "u")
    parts = blend.bands(
        device, Prepared(tuple(layers), full, grid, grid.resized(7, 5), grid.resized(24, 13), shoulder),
        crop or full.region, Settings(band_rows=rows), lambda units: None,
    )  # fmt: skip
    return np.concatenate(list(parts))

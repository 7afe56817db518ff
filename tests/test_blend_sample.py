"""Sampling in the full-resolution pass: several pixels at once are what each of them is alone."""

from __future__ import annotations

import numpy as np
import pytest
from bands import blend_layer, field_of, merged, stored_pixels
from grids import patches, plane, sphere, window

from hugin_abflow.layer import Box, full_scale
from hugin_abflow.opencl import Device

GRIDS = {
    "plane": plane(71, 43),
    "cylinder": plane(71, 43, wraps=True),
    "sphere": sphere(86, 43),
    "window": window(71, 43),
}


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("name", list(GRIDS))
def test_a_crop_elsewhere_takes_other_pixels_together(
    device: Device, name: str, dtype: type, channels: int
) -> None:
    """Pixels that are sampled at once for one crop, and each alone for another, are the same to the bit: also
    beside those that do not move, and beside taps that are not valid enough.
    """
    full = GRIDS[name]
    grid = full.resized(24, 15)
    layers = []
    for seed in (1, 2):
        pixels = stored_pixels(seed, full.width, full.height, dtype, channels, 0.95)
        faint = patches(seed + 5, full.width, full.height, 0.2, 3) > 0
        pixels[12:24, 20:40, :-1] = 0.02 * full_scale(dtype)  # beside this the cubic swings below it
        if dtype == np.float32:
            pixels[26:36, 10:50, :-1] -= 0.8
        pixels[faint, -1] = (0.3 * full_scale(dtype) * (pixels[faint, -1] > 0)).astype(dtype)
        field = field_of(seed + 10, grid, (0, 0, 24, 15), 0.7)
        field[:, 4:9, :3] = 0
        layers.append(blend_layer(device, pixels, 0, 0, full, grid, field=field))
    whole = merged(device, layers, full, grid)
    region = full.region
    for left in (1, 2, 3):
        crop = Box(region.left + left, region.top, region.right, region.bottom)
        assert np.array_equal(merged(device, layers, full, grid, crop), whole[:, left:])


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize(
    ("dtype", "lamp", "wall", "least"),
    [
        (np.float32, 50, 0.05, 0.0249),
        (np.float16, 65504, 0.05, 0.0249),
        (np.uint8, 255, 12, 8.9),
        (np.uint16, 65535, 3000, 2249),
    ],
)
@pytest.mark.parametrize("name", ["plane", "cylinder", "sphere"])
def test_no_light_is_taken_away_beside_a_lamp(
    device: Device, name: str, dtype: type, lamp: float, wall: float, least: float, channels: int
) -> None:
    """A lamp may be a thousand times as bright as the wall behind it, also at a border, and as bright as half
    floats can be; and white before a wall at night, which has no black rim.
    """
    full = GRIDS[name]
    grid = full.resized(24, 15)
    pixels = np.full((full.height, full.width, channels + 1), full_scale(dtype), np.float32)
    pixels[..., :-1] = wall
    pixels[9:12, 30:33, :-1] = pixels[25:35, :2, :-1] = pixels[:1, 50:, :-1] = lamp
    layer = blend_layer(
        device, pixels.astype(dtype), 0, 0, full, grid, field=field_of(3, grid, (0, 0, 24, 15), 0.7)
    )
    result = merged(device, [layer, layer], full, grid)
    assert least < result[..., :-1].min() < 0.98 * wall
    assert 0.98 * lamp < result[..., :-1].max() < np.inf

"""Sampling in the full-resolution pass: several pixels at once are what each of them is alone."""

from __future__ import annotations

import numpy as np
import pytest
from bands import blend_layer, field_of, merged, stored_pixels
from grids import plane, sphere

from hugin_abflow.layer import Box
from hugin_abflow.opencl import Device

GRIDS = {"plane": plane(71, 43), "cylinder": plane(71, 43, wraps=True), "sphere": sphere(86, 43)}


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("name", list(GRIDS))
def test_a_crop_elsewhere_takes_other_pixels_together(device: Device, name: str, dtype: type) -> None:
    """Pixels that are sampled at once for one crop, and each alone for another, are the same to the bit."""
    full = GRIDS[name]
    grid = full.resized(24, 15)
    box = (0, 0, 24, 15)
    layers = [
        blend_layer(
            device, stored_pixels(seed, full.width, full.height, dtype, 3, 0.95), 0, 0, full, grid,
            field=field_of(seed + 10, grid, box, 0.7),
        )
        for seed in (1, 2)
    ]  # fmt: skip
    whole = merged(device, layers, full, grid)
    region = full.region
    for left in (1, 2, 3):
        crop = Box(region.left + left, region.top, region.right, region.bottom)
        assert np.array_equal(merged(device, layers, full, grid, crop), whole[:, left:])

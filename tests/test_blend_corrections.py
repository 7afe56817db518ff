"""Gains and offsets in the full-resolution pass: what they make of stored pixels."""

from __future__ import annotations

import math

import numpy as np
import pytest
from bands import blend_layer, merged, stored_pixels
from grids import plane
from reference import common

from hugin_abflow.opencl import Device


def test_gains_of_floats_are_factors_and_none_is_exact(device: Device) -> None:
    """Of their roots, hence exp(2 g); where the gain is 0 pixels stay as they are."""
    full = plane()
    grid = full.resized(40, 27)
    pixels = stored_pixels(21, 77, 53, np.float32, 3, 1)
    gain = np.zeros((5, 7, 4), np.float32)
    gain[:, 4:, 1] = 0.5
    out = merged(device, [blend_layer(device, pixels, 0, 0, full, grid, gain=gain)], full, grid)
    assert np.array_equal(out[:, :38], pixels[:, :38])
    assert np.array_equal(out[..., [0, 2, 3]], pixels[..., [0, 2, 3]])
    right = out[:, 60:, 1]
    assert np.allclose(right, pixels[:, 60:, 1] * math.exp(1), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("channels", [1, 3])
def test_an_offset_raises_by_levels_and_none_is_exact(device: Device, channels: int) -> None:
    """By 25.5 of 255, which dither makes half 25 and half 26; where it is 0 pixels stay as they are."""
    full = plane()
    grid = full.resized(40, 27)
    pixels = stored_pixels(21, 77, 53, np.uint8, channels, 1)
    pixels[..., :-1] = pixels[..., :-1] // 2
    offset = np.zeros((13, 24, 4), np.float32)
    offset[:, 12:, :channels] = 0.1
    out = merged(device, [blend_layer(device, pixels, 0, 0, full, grid, offset=offset)], full, grid)
    assert np.array_equal(out[:, :37], pixels[:, :37])
    assert np.array_equal(out[..., -1], pixels[..., -1])
    raised = out[:, 42:, :-1].astype(int) - pixels[:, 42:, :-1]
    assert set(np.unique(raised)) == {25, 26}
    assert abs(raised.mean() - 25.5) < 0.05
    offset[...] = 0
    out = merged(device, [blend_layer(device, pixels, 0, 0, full, grid, offset=offset)], full, grid)
    assert np.array_equal(out, pixels)


def test_offsets_of_floats_are_factors(device: Device) -> None:
    """The root becomes (root + floor) exp(offset) - floor, not below 0; what is below 0 stays."""
    full = plane()
    grid = full.resized(40, 27)
    pixels = stored_pixels(21, 77, 53, np.float32, 3, 1)
    pixels[..., 0] -= 0.3
    for value in (0.5, -0.5):
        offset = np.zeros((13, 24, 4), np.float32)
        offset[:, :, :2] = value
        out = merged(device, [blend_layer(device, pixels, 0, 0, full, grid, offset=offset)], full, grid)
        for k in (0, 1):
            c = pixels[..., k].astype(float)
            root = np.sqrt(np.maximum(c, 0))
            raised = np.maximum(root + (root + common.EXPOSURE_FLOOR) * (math.exp(value) - 1), 0) ** 2
            expected = np.where(c >= 0, raised, c)
            assert np.allclose(out[..., k], expected, rtol=1e-5, atol=1e-6)
        assert (out[..., 0] < 0).any()
        assert np.array_equal(out[..., 2:], pixels[..., 2:])

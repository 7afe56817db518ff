"""Dither: no bands where a smooth gain is rounded, and nothing else changed."""

from __future__ import annotations

import numpy as np
import pytest
from bands import blend_layer, field_of, merged, stored_pixels
from grids import plane
from reference import blend as twin
from reference import common
from scipy import ndimage

from hugin_abflow.grid import Grid
from hugin_abflow.layer import Box
from hugin_abflow.opencl import Device


def test_twin_of_threshold_rounds_without_bias() -> None:
    """Each threshold is as likely as any, in every row's stretches too; rows and channels differ."""
    x, y = common.pixels(512, 60, 4099, 23)
    channels = np.stack([twin.threshold(x, y, k) for k in range(3)])
    assert channels.min() > 0 and channels.max() < 1
    shares = np.histogram(channels, 16, (0, 1))[0] / channels.size
    assert np.abs(shares - 1 / 16).max() < 0.002
    stretches = channels.reshape(3, 60, 16, 32)  # 32 px: a golden ratio's steps leave no gap above 3/32
    assert np.diff(np.sort(stretches, -1), axis=-1).max() < 3 / 32
    starts = channels[..., 0].ravel()
    assert len(np.unique(starts)) == 180  # no two rows begin alike
    assert np.abs(np.histogram(starts, 6, (0, 1))[0] - 30).max() < 16
    for channel in channels:  # nor does a row tell the next
        assert abs(np.corrcoef(channel[:-1].ravel(), channel[1:].ravel())[0, 1]) < 0.15


def test_twin_of_dither_moves_no_whole_number() -> None:
    """Neither down nor up, whatever the threshold; what float32 makes of a whole number included."""
    edges = np.array([0.5, 32767.5, 65535.5]) / 65536
    for white in (255.0, 65535.0):
        whole = np.arange(white + 1)
        for off in (0, 6e-8 * white, -6e-8 * white):
            for threshold in edges:
                np.testing.assert_array_equal(twin.dither(whole + off, threshold, white), whole)
        assert list(twin.dither(np.full(3, 7.4), np.array([0.1, 0.39, 0.41]), white)) == [8, 8, 7]


def rough_error(out: np.ndarray, exact: np.ndarray) -> float:
    """Largest difference that is left when six pixels around are averaged: what is seen as bands."""
    difference = out.astype(np.float64) - exact
    smooth = ndimage.gaussian_filter(difference, (6, 6, 0))
    return float(np.abs(smooth[16:-16, 16:-16]).max())


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("count", [1, 2])
def test_a_smooth_gain_on_a_smooth_sky_shows_no_bands(device: Device, channels: int, count: int) -> None:
    """Rounding alone makes steps 30 px and more apart; dither spreads them, by less than one level."""
    full = Grid(Box(0, 0, 401, 97), 401, 97, False, 0, (0.0, 0.0, 0.0, 0.0))
    grid = full.resized(201, 49)
    sky = np.full((97, 401, channels + 1), 120, np.uint8)
    sky[..., -1] = 255
    gain = np.zeros((5, 7, 4), np.float32)
    gain[..., :3] = np.linspace(0.01, 0.2, 7)[:, None]
    layer = blend_layer(device, sky, 0, 0, full, grid, gain=gain)
    out = merged(device, [layer] * count, full, grid)
    x, y = (places + 0.5 for places in common.pixels(401, 97))
    exposure = twin.read_field(gain, (0, 0, 7, 5), x * 7 / 401, y * 5 / 97, (7, 5, 0, 0))
    exact = twin.correct(sky[..., :-1].astype(float), exposure[..., :channels], np.zeros(1), 255.0, 1.0)
    assert 10 < np.ptp(exact) < 14
    assert rough_error(np.rint(exact), exact) > 0.3  # what the eye sees without
    assert rough_error(out[..., :-1], exact) < 0.1
    assert np.abs(out[..., :-1] - exact).max() < 1 and (out[..., -1] == 255).all()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_dither_touches_only_what_is_corrected(device: Device, dtype: type) -> None:
    """Copies stay copies, with another layer that is corrected beside them, under alpha and in a channel
    without gain; what is interpolated but not corrected is rounded to nearest."""
    full = plane()
    grid = full.resized(40, 27)
    pixels = [stored_pixels(30 + i, 77, 53, dtype, 3, 1) for i in (0, 1)]
    gain = np.zeros((5, 7, 4), np.float32)
    gain[:, 4:, 1] = 0.05
    field = field_of(32, grid, (0, 0, 40, 27), 1.5)
    gains = (None, gain)
    layers = [
        blend_layer(device, p, 0, 0, full, grid, field, gain=g) for p, g in zip(pixels, gains, strict=True)
    ]
    plain = [blend_layer(device, p, 0, 0, full, grid, field) for p in pixels]
    rounded, dithered = merged(device, plain, full, grid), merged(device, layers, full, grid)
    np.testing.assert_array_equal(dithered[:, :38], rounded[:, :38])
    assert (np.abs(dithered[:, 50:, [0, 2]].astype(int) - rounded[:, 50:, [0, 2]]) <= 1).all()
    assert (dithered[:, 50:, 1] != rounded[:, 50:, 1]).mean() > 0.3
    alone = merged(device, layers[1:], full, grid)
    np.testing.assert_array_equal(alone[..., [0, 2, 3]], pixels[1][..., [0, 2, 3]])
    assert (alone[:, 50:, 1] != pixels[1][:, 50:, 1]).mean() > 0.3


def test_dither_belongs_to_the_canvas(device: Device) -> None:
    """Not to the region that the layers cover, nor to bands: a lone layer may become one of many."""
    gain = np.full((5, 7, 4), 0.013, np.float32)
    results = []
    for left, top, width, height in ((30, 20, 77, 53), (11, 7, 101, 80)):
        full = Grid(Box(left, top, left + width, top + height), width, height, False, 0, (0.0, 0.0, 0.0, 0.0))
        grid = full.resized(width // 2, height // 2)
        sky = np.full((53, 77, 4), 200, np.uint8)
        sky[..., 3] = 255
        layer = blend_layer(device, sky, 30 - left, 20 - top, full, grid, gain=gain)
        results.append(merged(device, [layer], full, grid, Box(30, 20, 107, 73), rows=17))
    assert len(np.unique(results[0][..., 0])) == 2
    np.testing.assert_array_equal(*results)

"""Mask-normalised pyramids and smoothing: kernels against twins, twins against SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from reference.pyramid import pyramid_reduce, pyramid_smooth
from scipy import ndimage
from tolerances import SUM, TRIGONOMETRY, assert_close

from hugin_abflow import pyramid
from hugin_abflow.opencl import Device
from hugin_abflow.pyramid import Level

SIZES = [(77, 53), (64, 31), (5, 3), (1, 7)]


def masked(seed: int, width: int, height: int, share: float = 0.7) -> tuple[np.ndarray, np.ndarray]:
    """A random image and mask in patches, the image 0 outside it."""
    random = np.random.default_rng(seed)
    patches = random.random((height // 4 + 1, width // 4 + 1)) < share
    mask = np.kron(patches, np.ones((4, 4)))[:height, :width].astype(np.float32)
    image = (random.random((height, width)) * 3 - 1).astype(np.float32)
    return image * mask, mask


def smooth_twin(
    image: np.ndarray, mask: np.ndarray, grid: tuple[int, int, int, int], sigma: float
) -> tuple[np.ndarray, np.ndarray]:
    """Both directions, and the weight of the valid pixels."""
    taps = np.exp(-0.5 * (np.arange(max(1, round(2.5 * sigma)) + 1) / sigma) ** 2)
    across = pyramid_smooth(image, mask, grid, (1, 0), taps, 0)
    return pyramid_smooth(*across, grid, (0, 1), taps, 1)


def level(device: Device, image: np.ndarray, mask: np.ndarray, wraps: bool) -> Level:
    return Level(device.upload(image), device.upload(mask), wraps)


@pytest.mark.parametrize("wraps", [False, True])
def test_twin_of_reduce_is_normalised_convolution(wraps: bool) -> None:
    image, mask = masked(0, 77, 53)
    small, small_mask = pyramid_reduce(image, mask, (77, 53, int(wraps), 0))
    kernel = np.outer([1, 3, 3, 1], [1, 3, 3, 1]) / 64
    # zeros below; to the right another turn or zeros: the border rule of SciPy plays no part
    values = [np.pad(v.astype(np.float64), ((4, 4), (0, 0))) for v in (image * mask, mask)]
    total, weight = (np.pad(v, ((0, 0), (4, 4)), mode="wrap" if wraps else "constant") for v in values)
    # an even kernel is centred at n on the pixels n - 2 to n + 1; output n is for pixels 2 n - 1 to 2 n + 2
    total, weight = (ndimage.correlate(v, kernel)[5:-3:2, 5:-3:2] for v in (total, weight))
    valid = weight >= 0.5
    assert 0.3 < valid.mean() < 1
    assert np.array_equal(small_mask > 0, valid)
    assert np.allclose(small, np.where(valid, total / np.maximum(weight, 0.5), 0))


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("wraps", [False, True])
def test_reduce_equals_its_twin(device: Device, size: tuple[int, int], wraps: bool) -> None:
    image, mask = masked(1, *size)
    small = pyramid.reduce(device, level(device, image, mask, wraps))
    twin, twin_mask = pyramid_reduce(image, mask, (*size, int(wraps), 0))
    assert small.wraps == wraps
    assert small.image.shape == (-(-size[1] // 2), -(-size[0] // 2))
    assert np.array_equal(small.mask.get(), twin_mask)
    assert_close(small.image.get(), twin, SUM)


@pytest.mark.parametrize("wraps", [False, True])
def test_a_linear_image_is_reduced_without_shift(device: Device, wraps: bool) -> None:
    """Coarse position = fine position / 2: a ramp over pixel centres stays that ramp, odd sizes too."""
    y, x = np.mgrid[0:53, 0:77] + 0.5
    ramp = (0.3 * x - 0.2 * y).astype(np.float32)
    small = pyramid.reduce(device, level(device, ramp, np.ones_like(ramp), wraps)).image.get()
    y, x = 2 * (np.mgrid[0:27, 0:39] + 0.5)
    assert np.allclose(small[1:-1, 1:-1], (0.3 * x - 0.2 * y)[1:-1, 1:-1], atol=1e-5)


def test_what_lies_outside_the_mask_never_counts(device: Device) -> None:
    image, mask = masked(2, 77, 53)
    dirty = np.where(mask > 0, image, 1e6).astype(np.float32)
    clean = pyramid.reduce(device, level(device, image, mask, False)).image.get()
    assert np.array_equal(pyramid.reduce(device, level(device, dirty, mask, False)).image.get(), clean)


def test_build_halves_down_to_one_pixel(device: Device) -> None:
    image, mask = masked(3, 77, 53, 1.0)
    levels = pyramid.build(device, level(device, image, mask, False), 8)
    assert [one.image.shape for one in levels] == [
        (53, 77), (27, 39), (14, 20), (7, 10), (4, 5), (2, 3), (1, 2), (1, 1),
    ]  # fmt: skip


@pytest.mark.parametrize("wraps", [False, True])
@pytest.mark.parametrize("sigma", [0.8, 6.0])
def test_smooth_is_a_normalised_gaussian(wraps: bool, sigma: float) -> None:
    """The twin, both directions, against SciPy's Gaussian of image and mask."""
    image, mask = masked(4, 77, 53)
    grid, radius = (77, 53, int(wraps), 0), max(1, round(2.5 * sigma))
    twin, _ = smooth_twin(image, mask, grid, sigma)
    top, bottom = (
        np.pad(v.astype(np.float64), ((0, 0), (radius, radius)), mode="wrap" if wraps else "constant")
        for v in (image, mask)
    )
    top, bottom = (
        ndimage.gaussian_filter(v, sigma, mode="constant", radius=radius)[:, radius:-radius]
        for v in (top, bottom)
    )
    known = bottom > 1e-5
    assert known.mean() > 0.9
    assert np.allclose(twin[known], top[known] / bottom[known], atol=1e-9)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("wraps", [False, True])
def test_smooth_equals_its_twin(device: Device, size: tuple[int, int], wraps: bool) -> None:
    """Also where the Gaussian is wider than the image and goes around it more than once."""
    image, mask = masked(5, *size, 0.5)
    mask[-1, -1], image[-1, -1] = 1, 2
    twin, share = smooth_twin(image, mask, (*size, int(wraps), 0), 6.0)
    kernel = pyramid.smooth(device, level(device, image, mask, wraps), 6.0)
    assert_close(kernel.mask.get(), share, SUM, scale=10.0)
    kernel = kernel.image.get()
    safe = np.abs(share - 1e-6) > 1e-9
    assert_close(kernel[safe], twin[safe], TRIGONOMETRY)


def test_the_mean_of_a_constant_is_the_constant(device: Device) -> None:
    _, mask = masked(6, 77, 53)
    mean = pyramid.smooth(device, level(device, 0.7 * mask, mask, True), 6.0).image.get()
    assert mask.min() == 0
    assert np.allclose(mean, 0.7, atol=1e-6)

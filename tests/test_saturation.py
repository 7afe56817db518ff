"""What photos show white: the kernel against its twin, which greys are white, and the panorama."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from grids import on_device, random_layer
from hypothesis import given
from hypothesis import strategies as st
from pictures import merged, one_device
from reference.saturation import saturation_pick
from scipy import ndimage

from hugin_abflow import saturation
from hugin_abflow.geometry import Pair
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.opencl import Device
from hugin_abflow.working import WorkingLayer

__all__ = ["one_device"]

WIDTH, HEIGHT = 501, 303
BOTH = [Pair(0, 1)]


@pytest.mark.parametrize("box", [(0, 0, 77, 53), (9, 17, 61, 31), (8, 16, 1, 1), (3, 5, 4, 2)])
def test_pixels_are_those_of_the_twin(device: Device, box: tuple[int, int, int, int]) -> None:
    """Also where a layer has none of them."""
    layer = random_layer(1, box[2], box[3], 0.7)
    picked = saturation._pick(device, on_device(device, layer, *box[:2]))
    every, (height, width) = saturation._EVERY, picked.pixels.shape[:2]
    assert (height, width) == (
        len(range(-(-box[1] // every) * every, box[1] + box[3], every)),
        len(range(-(-box[0] // every) * every, box[0] + box[2], every)),
    )
    expected = saturation_pick(layer, box, every, (picked.left, picked.top, width, height))
    np.testing.assert_array_equal(picked.pixels, expected)


def scene(seed: int = 5) -> np.ndarray:
    """A wall in bright light (height, width, 3): smooth stains, from dark to too bright, and grain."""
    random = np.random.default_rng(seed)
    stains = ndimage.gaussian_filter(random.normal(size=(HEIGHT, WIDTH)), 12)
    grain = random.normal(scale=0.01, size=(HEIGHT, WIDTH, 3))
    return 0.6 + 0.25 * (stains / stains.std())[..., None] + grain


def photo(light: np.ndarray, exposure: float = 1.0, corrected: float | tuple[float, ...] = 1.0) -> np.ndarray:
    """A working layer's pixels: exposed, clipped, and corrected afterwards."""
    pixels = np.ones((*light.shape[:2], 4))
    pixels[..., :3] = np.clip(exposure * light, 0, 1) * np.float32(corrected)
    return np.rint(255 * np.clip(pixels, 0, 1)).astype(np.float32) / np.float32(255)


def whites(device: Device, *pixels: np.ndarray, shift: int = 0, dtype: type = np.uint8) -> list:
    layers = [on_device(device, one, k * shift, 0, dtype) for k, one in enumerate(pixels)]
    return [one.white for one in saturation.found(device, layers, BOTH)]


UNKNOWN = (1.0, 1.0, 1.0)


def test_what_is_clipped_and_then_darkened_is_white(device: Device) -> None:
    """Of each channel, and where near things have moved between the photos; the other is not clipped."""
    corrected = (0.6, 0.5, 0.55)
    clipped = photo(scene(), 1.5, corrected)
    assert (clipped[..., :3].max((0, 1)) < 0.61).all()
    found, other = whites(device, clipped, photo(scene(), 0.8), shift=5)
    assert found == pytest.approx(corrected, abs=1 / 255)
    assert other == UNKNOWN


@given(st.floats(0.35, 0.9), st.floats(0.4, 0.75))
def test_white_is_found_whatever_the_exposures(corrected: float, exposure: float) -> None:
    """By what sees nothing but the pixels: of one photo clipped and corrected, and a darker one."""
    light = scene()[::8, ::8]
    clipped, darker = photo(light, 1.5, corrected), photo(light, exposure)
    white = saturation._brightest(clipped)
    assert white == pytest.approx((corrected,) * 3, abs=1 / 255)
    told = saturation._brighter(clipped.reshape(-1, 4)[:, :3], darker.reshape(-1, 4)[:, :3], white)
    assert told.mean() > 0.5


def test_what_is_white_already_stays_as_it_is(device: Device) -> None:
    assert whites(device, photo(scene(), 1.5), photo(scene(), 0.8)) == [UNKNOWN] * 2


def test_a_flat_lamp_is_not_white(device: Device) -> None:
    """It is the brightest in a dark photo, and there is much of it; but others show it no brighter."""
    for wall in (0.7 * scene() / scene().max(), np.minimum(scene(), 0.7)):
        light = wall.copy()
        light[100:200, 150:300] = 0.8
        for exposure in (0.5, 1.0, 1.2, 1.6):
            assert whites(device, photo(light, 0.6), photo(light, exposure), shift=3) == [UNKNOWN] * 2
    dark = photo(light, 0.6)
    assert saturation._brightest(dark) is not None  # alone it looks as if


def test_what_nobody_shows_brighter_is_not_white(device: Device) -> None:
    """Both photos are clipped alike; and one alone tells nothing."""
    clipped = photo(scene(), 1.5, 0.6)
    assert whites(device, clipped, clipped.copy(), shift=3) == [UNKNOWN] * 2
    for layers, pairs in (([clipped], []), ([clipped] * 3, [Pair(0, 2)])):
        alone = [on_device(device, one) for one in layers]
        assert saturation.found(device, alone, pairs) == alone


def test_smooth_brightness_is_not_white(device: Device) -> None:
    """Nothing but a ramp: no grey is the brightest of which there is much."""
    light = np.broadcast_to(np.linspace(0.1, 0.6, WIDTH)[None, :, None], (HEIGHT, WIDTH, 3))
    assert whites(device, photo(light), photo(light, 1.5)) == [UNKNOWN] * 2


def test_floats_are_never_white(device: Device) -> None:
    pixels = photo(scene(), 1.5, 0.6), photo(scene(), 0.8)
    assert whites(device, *pixels, dtype=np.float32) == [UNKNOWN] * 2


def test_layers_apart_tell_nothing(device: Device) -> None:
    clipped, other = photo(scene(), 1.5, 0.6), photo(scene(), 0.8)
    assert whites(device, clipped, other, shift=WIDTH) == [UNKNOWN] * 2
    clipped[:, :-4, 3] = other[:, 4:, 3] = 0  # they touch, and have hardly a pixel in common
    assert whites(device, clipped, other, shift=WIDTH - 8) == [UNKNOWN] * 2


# The panorama


def as_layer(pixels: np.ndarray, left: int) -> Layer:
    return Layer.from_array(f"from {left}", np.rint(255 * pixels).astype(np.uint8), left)


@pytest.mark.usefixtures(one_device.__name__)
def test_grey_that_was_white_comes_from_the_darker_photo(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if it had not been corrected: stains that one photo shows grey are seen nearly up to the border of
    the one that has them."""
    light = scene()
    layers = [
        as_layer(photo(light[:, :340], 0.8), 0),
        as_layer(photo(light[:, 160:], 2.0, 0.4), 160),
    ]

    def likeness(result: np.ndarray) -> float:
        part = np.s_[:, 250:300]
        shown = np.clip(0.8 * light[part][..., 1], 0, 1)
        bright = shown > 0.45  # clipped in the other one
        return float(np.corrcoef(result[part][..., 1][bright], shown[bright])[0, 1])

    def unknown(_device: Device, found: list[WorkingLayer], _pairs: list[Pair]) -> list[WorkingLayer]:
        return [replace(one, white=UNKNOWN) for one in found]

    canvas = Canvas.plane(WIDTH, HEIGHT)
    assert likeness(merged(layers, canvas)) > 0.4
    monkeypatch.setattr(saturation, "found", unknown)
    assert likeness(merged(layers, canvas)) < 0.1

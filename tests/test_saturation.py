"""What photos show white: the kernel against its twin, which greys are white, and the panorama."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from grids import GRIDS, on_device, random_layer
from hypothesis import given
from hypothesis import strategies as st
from pictures import merged, one_device
from reference.saturation import saturation_pick
from scipy import ndimage

from hugin_abflow import colour, saturation, seam
from hugin_abflow.geometry import Pair
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.opencl import Device
from hugin_abflow.scene import Scene
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
    expected = saturation_pick(layer, box, every, (picked.place.left, picked.place.top, width, height))
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


def whites(
    device: Device,
    *pixels: np.ndarray,
    shift: int = 0,
    down: int = 0,
    pairs: list[Pair] = BOTH,
    dtype: type = np.uint8,
) -> list:
    layers = [on_device(device, one, k * shift, k * down, dtype) for k, one in enumerate(pixels)]
    return [one.white for one in saturation.with_whites(device, layers, pairs)]


UNKNOWN = None


def test_what_is_clipped_and_then_darkened_is_white(device: Device) -> None:
    """Of each channel, and where near things have moved between the photos; the other is not clipped."""
    corrected = (0.6, 0.5, 0.55)
    clipped = photo(scene(), 1.5, corrected)
    assert (clipped[..., :3].max((0, 1)) < 0.61).all()
    for down in (0, 9):
        found, other = whites(device, clipped, photo(scene(), 0.8), shift=5, down=down)
        assert found == pytest.approx(corrected, abs=1 / 255)
        assert other == UNKNOWN


def test_any_photo_beside_it_may_tell(device: Device) -> None:
    """But none that it does not overlap."""
    clipped, darker = photo(scene(), 1.5, 0.6), photo(scene(), 0.8)
    for pairs, known in (([(0, 1), (0, 2)], True), ([(1, 2), (0, 2)], True), ([(0, 1), (2, 1)], False)):
        found, *_ = whites(device, clipped, clipped, darker, pairs=[Pair(*pair) for pair in pairs])
        assert (found != UNKNOWN) == known


def test_where_a_photo_is_empty_it_tells_nothing(device: Device) -> None:
    """Nor do pixels that are not valid count as dark ones."""
    clipped, darker = photo(scene(), 1.5, 0.6), photo(scene(), 0.8)
    clipped[:, 250:] = darker[:, :250] = 0
    assert whites(device, clipped, darker) == [UNKNOWN] * 2
    darker[:, 100:250] = photo(scene(), 0.8)[:, 100:250]
    assert whites(device, clipped, darker)[0] == pytest.approx((0.6,) * 3, abs=1 / 255)


@given(
    st.lists(st.tuples(st.integers(0, 255), st.integers(1, 400)), min_size=1, max_size=6),
    st.sampled_from([1, 3, 9]),
)
def test_any_values_have_a_white_or_none(groups: list[tuple[int, int]], together: int) -> None:
    values = np.repeat([level for level, _ in groups], [count * together for _, count in groups])
    white = saturation._spike((values / 255).astype(np.float32))
    if white is not None:
        near = np.abs(values - 255 * white) < 2
        assert saturation._LEAST - 1.5 <= 255 * white <= 255.001
        assert near.mean() > 0.003
        assert (values > 255 * white + 3).sum() <= near.sum() / 8


@pytest.mark.parametrize("brightest", [0, 1, 3, 8, 40])
def test_dark_photos_have_none(device: Device, brightest: int) -> None:
    """All of them, and in one channel alone."""
    dark = photo(np.full((HEIGHT, WIDTH, 3), brightest / 255))
    assert whites(device, dark, photo(scene())) == [UNKNOWN] * 2
    red = photo(scene(), 1.5, (0.6, 0.6, brightest / 255))
    assert whites(device, red, photo(scene())) == [UNKNOWN] * 2


def test_noise_is_not_brighter(device: Device) -> None:
    light = 0.7 * scene() / scene().max()
    light[100:200, 150:300] = 0.75
    noisy = light + np.random.default_rng(2).normal(scale=0.02, size=light.shape)
    assert whites(device, photo(light, 0.8), photo(noisy, 0.8)) == [UNKNOWN] * 2


def test_where_exposures_cannot_be_compared_nothing_is_told(device: Device) -> None:
    """Photos of another contrast: what is brighter by a tenth says little then."""
    light = 0.7 * scene() / scene().max()
    light[100:200, 150:300] = 0.8
    dark = photo(light, 0.6)
    assert whites(device, dark, photo(dark[..., :3] ** 1.1)) == [UNKNOWN] * 2


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
        assert saturation.with_whites(device, alone, pairs) == alone


def test_smooth_brightness_is_not_white(device: Device) -> None:
    """Nothing but a ramp: no grey is the brightest of which there is much."""
    light = np.broadcast_to(np.linspace(0.1, 0.6, WIDTH)[None, :, None], (HEIGHT, WIDTH, 3))
    assert whites(device, photo(light), photo(light, 1.5)) == [UNKNOWN] * 2


@pytest.mark.parametrize("scale", [0.003, 1, 700])
@pytest.mark.parametrize("corrected", [0.6, 1])
def test_floats_are_clipped_wherever_their_scale_ends(device: Device, scale: float, corrected: float) -> None:
    """Each layer has a scale of its own; a few values beyond are overshoot, of sampling."""
    times = np.float32([scale] * 3 + [1])
    clipped, darker = photo(scene(), 1.5, corrected) * times, 5 * photo(scene(), 0.8) * times
    clipped[::50, ::50, :3] *= 1.05
    found, other = whites(device, clipped, darker, shift=3, dtype=np.float32)
    assert found == pytest.approx((corrected * scale,) * 3, rel=1 / 100)
    assert other == UNKNOWN


def test_floats_of_scenes_have_no_white(device: Device) -> None:
    """What is merged from exposures, with specular highlights; a flat lamp; nothing that is bright."""
    light = 0.7 * scene() / scene().max()
    shining = light * np.random.default_rng(3).lognormal(0, 1.5, light.shape)
    light[100:200, 150:300] = 0.8
    for seen in (shining, light, np.zeros_like(light), np.full_like(light, -1)):
        dark, bright = (np.dstack([k * seen, np.ones((HEIGHT, WIDTH))]).astype(np.float32) for k in (0.6, 1))
        assert whites(device, dark, bright, shift=3, dtype=np.float32) == [UNKNOWN] * 2


def test_layers_apart_tell_nothing(device: Device) -> None:
    clipped, other = photo(scene(), 1.5, 0.6), photo(scene(), 0.8)
    assert whites(device, clipped, other, shift=WIDTH) == [UNKNOWN] * 2
    clipped[:, :-4, 3] = other[:, 4:, 3] = 0  # they touch, and have hardly a pixel in common
    assert whites(device, clipped, other, shift=WIDTH - 8) == [UNKNOWN] * 2


# What is made of it


@pytest.mark.parametrize("clipped", [0, 1, None])
def test_each_layer_is_compared_up_to_its_own_white(device: Device, clipped: int | None) -> None:
    """One of two is clipped throughout, the darker or the brighter one: exposures differ by that at least,
    and nothing is left to be compared; else all is."""
    grid = GRIDS["plane"]
    random = np.random.default_rng(4).random((*grid.shape, 4)).astype(np.float32)
    colours = np.float32([1, 1, 1, 0]) * (0.3 + 0.1 * random) + np.float32([0, 0, 0, 1])
    layers = [on_device(device, colours * np.float32([k, k, k, 1])) for k in (1.0, 1.5)]
    if clipped is not None:
        layers[clipped] = replace(layers[clipped], white=(0.2, 1.0, 1.0))
    still = [device.zeros((*grid.shape, 4)) for _ in layers]
    cells = grid.resized(7, 3)
    overlap = colour._Overlap(device, layers, still, Pair(0, 1), grid, cells)
    found = overlap.difference(*overlap.start_difference(1.0))
    assert (found.values[..., 3] > 0).all() == (clipped is None)
    assert (np.sign(found.beyond[..., 3]) == {0: 1, 1: -1, None: 0}[clipped]).all()
    assert (overlap.start_misfit().get().max() > 0) == (clipped is None)
    none = colour.Correction(cells, 1.0, (None, None))
    residual = seam.residuals(Scene(device, layers, [Pair(0, 1)], still, None, grid), none)
    assert residual.measured.all() == (clipped is None) == residual.measured.any()


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
    monkeypatch.setattr(saturation, "with_whites", unknown)
    assert likeness(merged(layers, canvas)) < 0.1

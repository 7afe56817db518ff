"""Layers that show a scene from two places become one sharp picture, without a step in brightness."""

from __future__ import annotations

from functools import partial
from typing import get_args

import numpy as np
import pictures
import pytest
from pictures import masked, one_device, pixel_places, texture
from scipy import ndimage

from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.settings import FlowQuality

pytestmark = pytest.mark.usefixtures(one_device.__name__)

# as published: the geometry changes over the whole overlap
merged = partial(pictures.merged, transition_strain=0)

WIDTH, HEIGHT = 301, 131
LEFT, RIGHT = 90, 211  # columns [LEFT, RIGHT) are the overlap
PLANE = Canvas.plane(WIDTH, HEIGHT)

# Flow is within a twentieth of a pixel inside the overlap; near the upper and lower border, where windows are
# cut, and in flat places within a quarter. The texture's slope is at most 20 levels a pixel.
MEAN, SHARE, LARGE = 0.8, 0.99, 6.0  # levels of 8 bit: mean error; share of pixels within LARGE


def coefficient_right(canvas: Canvas = PLANE) -> np.ndarray:
    """w_R per column, by hand: D_L reaches to column RIGHT, D_R to column LEFT - 1."""
    x = np.arange(canvas.width)
    to_right_only, to_left_only = np.maximum(RIGHT - x, 0), np.maximum(x - LEFT + 1, 0)
    return to_left_only / (to_left_only + to_right_only)


def pair(dx: float, dy: float, dtype: type = np.uint8) -> list[Layer]:
    """L shows the texture, R shows it moved by (dx, dy): F_LR is (dx, dy) everywhere."""
    y, x = pixel_places(HEIGHT, WIDTH)
    left, right = texture(y, x, dtype), texture(y - dy, x - dx, dtype)
    return [masked(left, x < RIGHT, "left"), masked(right, x >= LEFT, "right")]


def blended(dx: float, dy: float) -> np.ndarray:
    """What comes out: x_L(p) = p + w_R F_RL = p - w_R (dx, dy): the geometry moves over linearly."""
    y, x = pixel_places(HEIGHT, WIDTH)
    w = coefficient_right()
    return texture(y - w * dy, x - w * dx, np.float32)[..., :3] * 255


def check(result: np.ndarray, truth: np.ndarray) -> None:
    off = np.abs(result[..., :3] - truth).max(-1)
    assert off.mean() <= MEAN
    assert (off <= LARGE).mean() >= SHARE


@pytest.mark.parametrize("motion", [(0.0, 0.0), (1.5, 0.0), (6.0, -2.0), (-9.0, 3.0)])
@pytest.mark.parametrize("intermediate", [False, True])
def test_geometry_moves_over_with_the_coefficient(motion, intermediate):
    result = merged(pair(*motion), PLANE, intermediate=intermediate)
    check(result, blended(*motion))


@pytest.mark.parametrize("working_pixels", [15_000, 9_000])
def test_also_at_a_lower_working_resolution(working_pixels):
    """Flow scales by the ratios of width and height, which differ."""
    result = merged(pair(6.0, -2.0), PLANE, working_pixels=working_pixels)
    check(result, blended(6.0, -2.0))


@pytest.mark.parametrize("quality", get_args(FlowQuality))
def test_in_every_quality(quality):
    result = merged(pair(6.0, -2.0), PLANE, flow_quality=quality)
    check(result, blended(6.0, -2.0))


def test_without_flow_the_picture_would_double(monkeypatch):
    """The checks above can fail: the same layers merely averaged."""
    from hugin_abflow import joint

    monkeypatch.setattr(joint.pairflow, "solve", lambda *arguments: ([], [], []))
    with pytest.raises(AssertionError):
        check(merged(pair(6.0, -2.0), PLANE), blended(6.0, -2.0))


def wrapped_pair(seam: int, dx: float) -> tuple[list[Layer], np.ndarray]:
    """On a cylinder of the same width, two halves that overlap at `seam` and opposite of it."""
    y, x = pixel_places(HEIGHT, WIDTH)
    around = (x - seam) % WIDTH
    left, right = texture(y, x, period=WIDTH), texture(y, x - dx, period=WIDTH)
    return [
        masked(left, (around < 41) | (around >= 130), "left"),
        masked(right, (around >= 0) & (around < 171), "right"),
    ], around[0]


@pytest.mark.parametrize("seam", [70, 280])  # 280: the overlap lies across the canvas's border
def test_geometry_moves_over_across_the_border(seam):
    layers, around = wrapped_pair(seam, 4.0)
    result = merged(layers, Canvas.plane(WIDTH, HEIGHT, wraps=True))
    y, x = pixel_places(HEIGHT, WIDTH)
    # D_R reaches to around = -1 or 171, D_L to 41 or 129
    d_right = np.where(around < 171, np.minimum(around + 1, 171 - around), 0)
    d_left = np.where(around < 41, 41 - around, np.where(around >= 130, around - 129, 0))
    w = d_right / (d_right + d_left)
    check(result, texture(y, x - 4.0 * w, np.float32, WIDTH)[..., :3] * 255)


def stop_darker(colours: np.ndarray) -> np.ndarray:
    """sRGB colours (0..1) of half the light."""
    light = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4) / 2
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)


def stop_pair(dx: float, dy: float, dtype: type) -> list[Layer]:
    """R has a stop less: floats are light, integers are encoded as sRGB. Mid tones, as of a wall: what
    happens to black and white depends on the camera's curve.
    """
    layers = []
    for layer in pair(dx, dy, np.float32):
        pixels = layer.read(0, HEIGHT).copy()
        colours = 0.25 + 0.3 * pixels[..., :3]
        if layer.name == "right":
            colours = colours / 2 if dtype == np.float32 else stop_darker(colours)
        pixels[..., :3] = colours
        stored = pixels if dtype == np.float32 else np.rint(pixels * 65535).astype(np.uint16)
        layers.append(Layer.from_array(layer.name, stored, layer.box.left))
    return layers


def detail(green: np.ndarray) -> np.ndarray:
    """Fine detail relative to its surroundings: standard deviation per block of 20 columns."""
    mean = ndimage.gaussian_filter(green, 3)
    fine = ((green - mean) / mean)[20:-20]
    return np.array([fine[:, x : x + 20].std() for x in range(0, WIDTH - 20, 20)])


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
@pytest.mark.parametrize("motion", [(0.0, 0.0), (4.0, -1.0)])
def test_stop_of_exposure_leaves_no_step_and_keeps_the_texture(motion, dtype):
    layers = stop_pair(*motion, dtype)
    white = 1.0 if dtype == np.float32 else 65535.0
    result = merged(layers, PLANE)[..., :3] / white
    truth = 0.25 + 0.3 * blended(*motion) / 255
    gain = np.log(result / truth).mean(-1)
    stop = 0.69 if dtype == np.float32 else 0.33  # log of half the light; as sRGB
    along = np.median(gain, axis=0)
    assert abs(along[:40]).max() < stop / 2 and along[-40:].max() < -stop / 3  # fades with the distance
    # the overlap is 121 px: were the change all there and linear, it would be 0.04 stops every 5 px
    change = np.abs(along[5:] - along[:-5]).max()
    # and no step hides in some of the rows
    blocks = gain[: HEIGHT // 10 * 10].reshape(HEIGHT // 10, 10, WIDTH).mean(1)
    anywhere = np.abs(blocks[:, 5:] - blocks[:, :-5]).max()
    kept = detail(result[..., 1]) / detail(truth[..., 1])
    assert change < 0.08 * stop
    assert anywhere < 0.25 * stop
    assert kept.min() > 0.9 and kept.max() < 1.15  # the eye sees less of more light


def test_the_step_would_be_seen():
    """The check above can fail: without correction the layers differ by more than it allows."""
    layers = stop_pair(0.0, 0.0, np.float32)
    result = merged(layers, PLANE, exposure=False)[..., :3]
    truth = 0.25 + 0.3 * blended(0.0, 0.0) / 255
    along = np.median(np.log(result / truth).mean(-1), axis=0)
    assert np.abs(along[5:] - along[:-5]).max() > 0.08 * 0.69


def test_without_exposure_the_stop_stays_where_one_layer_is():
    layers = stop_pair(0.0, 0.0, np.uint16)
    result = merged(layers, PLANE, exposure=False)
    np.testing.assert_array_equal(result[:, :LEFT], layers[0].read(0, HEIGHT)[:, :LEFT])
    np.testing.assert_array_equal(result[:, RIGHT:], layers[1].read(0, HEIGHT)[:, RIGHT - LEFT :])


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_floats_keep_their_range(dtype):
    """Twenty times brighter than white, with parallax: nothing is clipped."""
    layers = pair(3.0, 0.0, np.float32)
    bright = []
    for layer in layers:
        pixels = layer.read(0, HEIGHT).copy()
        pixels[..., :3] *= 20
        bright.append(Layer.from_array(layer.name, pixels.astype(dtype), layer.box.left))
    result = merged(bright, PLANE).astype(np.float32)
    check(result / 20 * 255, blended(3.0, 0.0))
    assert result[..., :3].max() > 15


def cable_pair(thick: float, way: float) -> list[Layer]:
    """A dark cable before a wall that stands still; R shows it `way` px lower."""
    y, x = pixel_places(HEIGHT, WIDTH)
    layers = []
    for name, down, where in (("left", 0.0, x < RIGHT), ("right", way, x >= LEFT)):
        pixels = 0.4 + 0.2 * texture(y, x, np.float32)
        cable = np.clip(thick / 2 + 0.5 - np.abs(y - down - 55.5), 0, 1)[..., None]
        pixels[..., :3] = pixels[..., :3] * (1 - cable) + 0.05 * cable
        pixels[..., 3] = 1
        layers.append(masked((pixels * 255).round().astype(np.uint8), where, name))
    return layers


@pytest.mark.parametrize(("thick", "way"), [(5, 10), (4, 8)])
def test_a_cable_thinner_than_its_way_goes_over_whole(thick, way):
    """Halfway no flow that starts at a place knows of it."""
    layers = cable_pair(thick, way)
    thinnest = {}
    for between in (False, True):
        result = merged(layers, PLANE, intermediate=between)
        thinnest[between] = (result[..., :3].mean(-1) < 70).sum(0).min()
    assert thinnest[False] == 0
    assert thinnest[True] >= 0.6 * thick

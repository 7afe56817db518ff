"""Layers that show a scene from two places become one sharp picture, without a step in brightness."""

from __future__ import annotations

import numpy as np
import pytest
from pictures import masked, merged, one_device, pixel_places, texture
from scipy import ndimage

from hugin_abflow.layer import Canvas, Layer

pytestmark = pytest.mark.usefixtures(one_device.__name__)

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


def pair(dx: float, dy: float, light: float = 1.0, dtype: type = np.uint8) -> list[Layer]:
    """L shows the texture, R shows it moved by (dx, dy): F_LR is (dx, dy) everywhere."""
    y, x = pixel_places(HEIGHT, WIDTH)
    left, right = texture(y, x, dtype), texture(y - dy, x - dx, dtype)
    right[..., :3] = (right[..., :3] * light).astype(dtype)
    return [masked(left, x < RIGHT, "left"), masked(right, x >= LEFT, "right")]


def blended(dx: float, dy: float) -> np.ndarray:
    """What comes out: x_L(p) = p + w_R F_RL = p - w_R (dx, dy), the texture's geometry moving over linearly."""
    y, x = pixel_places(HEIGHT, WIDTH)
    w = coefficient_right()
    return texture(y - w * dy, x - w * dx, np.float32)[..., :3] * 255


def check(result: np.ndarray, truth: np.ndarray) -> None:
    off = np.abs(result[..., :3] - truth).max(-1)
    assert off.mean() <= MEAN
    assert (off <= LARGE).mean() >= SHARE


@pytest.mark.parametrize("motion", [(0.0, 0.0), (1.5, 0.0), (6.0, -2.0), (-9.0, 3.0)])
@pytest.mark.parametrize("steps", [0, 2])
def test_geometry_moves_over_with_the_coefficient(motion, steps):
    result = merged(pair(*motion), PLANE, fixed_point_steps=steps)
    check(result, blended(*motion))


@pytest.mark.parametrize("working_pixels", [15_000, 9_000])
def test_also_at_a_lower_working_resolution(working_pixels):
    """Flow scales by the ratios of width and height, which differ."""
    result = merged(pair(6.0, -2.0), PLANE, working_pixels=working_pixels)
    check(result, blended(6.0, -2.0))


def test_without_flow_the_picture_would_double(monkeypatch):
    """The checks above can fail: the same layers merely averaged."""
    from hugin_abflow import joint

    monkeypatch.setattr(joint, "_flows", lambda *arguments: [])
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


def sharpness(picture: np.ndarray) -> np.ndarray:
    """Standard deviation of fine detail per column block of 20 px, relative to brightness."""
    green = picture[..., 1].astype(float)
    mean = ndimage.gaussian_filter(green, 3)
    fine = (green - mean) / mean
    return np.array([fine[20:-20, x : x + 20].std() for x in range(0, WIDTH - 20, 20)])


@pytest.mark.parametrize("motion", [(0.0, 0.0), (4.0, -1.0)])
def test_stop_of_exposure_leaves_no_step_and_keeps_the_texture(motion):
    result = merged(pair(*motion, light=0.5), PLANE)
    truth = blended(*motion)
    gain = np.log((result[..., :3] + 5.0) / (truth + 5.0)).mean(-1)
    along = np.median(gain, axis=0)
    assert -0.8 < along.min() and along.max() < 0.1  # between half and all of the brightness
    # a stop is 0.69; over the overlap of 121 px it may change by a few hundredths every 5 px
    assert np.abs(along[5:] - along[:-5]).max() < 0.06
    # and no step hides in some rows: 5 px averages of columns right and left of every place
    blocks = gain[: HEIGHT // 10 * 10].reshape(HEIGHT // 10, 10, WIDTH).mean(1)
    assert np.abs(blocks[:, 5:] - blocks[:, :-5]).max() < 0.2
    kept = sharpness(result) / sharpness(truth)
    assert kept.min() > 0.95 and kept.max() < 1.05


def test_without_exposure_the_stop_stays_where_one_layer_is():
    layers = pair(0.0, 0.0, light=0.5)
    result = merged(layers, PLANE, exposure=False)
    np.testing.assert_array_equal(result[:, :LEFT], layers[0].read(0, HEIGHT)[:, :LEFT])
    np.testing.assert_array_equal(result[:, RIGHT:], layers[1].read(0, HEIGHT)[:, RIGHT - LEFT :])


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_floats_keep_their_range(dtype):
    """Twenty times brighter than white, with parallax: nothing is clipped."""
    layers = pair(3.0, 0.0, dtype=np.float32)
    bright = []
    for layer in layers:
        pixels = layer.read(0, HEIGHT).copy()
        pixels[..., :3] *= 20
        bright.append(Layer.from_array(layer.name, pixels.astype(dtype), layer.box.left))
    result = merged(bright, PLANE).astype(np.float32)
    check(result / 20 * 255, blended(3.0, 0.0))
    assert result[..., :3].max() > 15

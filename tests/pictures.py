"""Small panoramas for tests of the whole pipeline: pictures, and layers that show them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from hugin_abflow import merge as pipeline
from hugin_abflow.layer import Box, Canvas, Layer, full_scale
from hugin_abflow.merge import merge_layers
from hugin_abflow.opencl import Device
from hugin_abflow.settings import Settings

DTYPES = [np.uint8, np.uint16, np.float16, np.float32]


@pytest.fixture
def one_device(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Merges share the session's device, whose kernels are built; else they would share one of their own."""
    monkeypatch.setattr(pipeline, "kept_device", lambda *wanted: device)


def noise(height: int, width: int, dtype: type = np.uint8, channels: int = 3, seed: int = 0) -> np.ndarray:
    """A picture that any wrong pixel shows in: random, opaque, (height, width, channels + 1). Floats go
    beyond the range of 0 to 1."""
    random = np.random.default_rng(seed)
    scale = full_scale(dtype)
    if np.dtype(dtype).kind == "u":
        pixels = random.integers(0, scale, (height, width, channels + 1), np.uint64, endpoint=True)
    else:
        pixels = np.exp(random.normal(-1, 2, (height, width, channels + 1)))
    pixels[..., -1] = scale
    return pixels.astype(dtype)


def texture(y: np.ndarray, x: np.ndarray, dtype: type = np.uint8, period: int = 0) -> np.ndarray:
    """Opaque colours (..., 4) at positions in pixels, smooth enough to be resampled, distinct everywhere.

    period: columns after which the picture repeats (a multiple of 1 px); 0: never.
    """
    y, x = np.broadcast_arrays(np.asarray(y, float), np.asarray(x, float))
    turn = 2 * np.pi / period if period else 2 * np.pi / 900
    channels = []
    for channel in range(3):
        value = np.zeros(x.shape)
        for wave in range(9):
            random = np.random.default_rng(100 * wave + 7)
            angle, phase = random.uniform(0, 2 * np.pi, 2)
            length = 9.0 * 1.35**wave  # px
            along = round(np.cos(angle) / length * 2 * np.pi / turn) * turn
            value += np.sin(along * x + np.sin(angle) * 2 * np.pi / length * y + phase + 0.5 * channel)
        channels.append(0.5 + 0.1 * value)
    scale = full_scale(dtype)
    colours = np.clip(np.stack([*channels, np.ones(x.shape)], -1), 0.02, 1) * scale
    return (np.rint(colours) if np.dtype(dtype).kind == "u" else colours).astype(dtype)


def pixel_places(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of all pixels."""
    y, x = np.mgrid[0:height, 0:width]
    return y, x


def masked(picture: np.ndarray, mask: np.ndarray, name: str = "layer", crop: bool = True) -> Layer:
    """The layer that shows `picture` where `mask` (height, width) is true; cropped as nona does, or not.

    Under alpha 0 are colours that must not come through.
    """
    pixels = picture.copy()
    pixels[~mask] = full_scale(picture.dtype) * np.array([*[0.9, 0.1, 0.8][: picture.shape[2] - 1], 0])
    if not crop:
        return Layer.from_array(name, pixels)
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    box = Box(columns[0], rows[0], columns[-1] + 1, rows[-1] + 1)
    return Layer.from_array(name, pixels[box.top : box.bottom, box.left : box.right], box.left, box.top)


def masks_of(layers: Sequence[Layer], canvas: Canvas) -> np.ndarray:
    """Which canvas pixels each layer covers: bool (layers, height, width)."""
    covered = np.zeros((len(layers), canvas.height, canvas.width), bool)
    for index, layer in enumerate(layers):
        box, pixels = layer.box, layer.read(0, layer.box.height)
        alpha = pixels[..., -1] >= 0.5 * full_scale(layer.dtype)
        covered[index, box.top : box.bottom, box.left : box.right] = alpha
    return covered


def merged(layers: Sequence[Layer], canvas: Canvas, **settings) -> np.ndarray:
    """`merge_layers` with settings by name."""
    return merge_layers(layers, canvas, Settings(**settings))


def expected_picture(picture: np.ndarray, union: np.ndarray) -> np.ndarray:
    """The picture where it is covered, transparent black elsewhere."""
    return np.where(union[..., None], picture, picture.dtype.type(0))

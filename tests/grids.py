"""Canvas grids and layers for tests of the kernels: odd sizes, wrapped and not, over poles and not."""

from __future__ import annotations

import math

import numpy as np

from hugin_abflow.chart import Chart, pair_chart
from hugin_abflow.grid import Grid
from hugin_abflow.layer import Box, Layer
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.working import WorkingLayer

WIDTH, HEIGHT = 77, 53


def plane(width: int = WIDTH, height: int = HEIGHT, wraps: bool = False) -> Grid:
    """A plane, or a cylinder unrolled."""
    return Grid(Box(0, 0, width, height), width, height, wraps, 0, (0.0, 0.0, 0.0, 0.0))


def sphere(width: int = 78, height: int = 39, rows: tuple[int, int] | None = None) -> Grid:
    """Rows of an equirectangular canvas of 360 x 180 degrees, with poles where the rows reach them."""
    top, bottom = rows or (0, height)
    step = 2 * math.pi / width, math.pi / height
    lonlat = (-math.pi, step[0], math.pi / 2 - top * step[1], step[1])
    poles = (int(top == 0) + 2 * int(bottom == height)) if width % 2 == 0 else 0
    return Grid(Box(0, top, width, bottom), width, bottom - top, True, poles, lonlat)


def window(width: int = WIDTH, height: int = HEIGHT) -> Grid:
    """A part of the sphere 100 degrees wide: no wrap, no pole."""
    step = math.radians(100) / width
    return Grid(Box(0, 0, width, height), width, height, False, 0, (-0.7, step, 0.5, step))


GRIDS = {
    "plane": plane(),
    "cylinder": plane(wraps=True),
    "sphere": sphere(),
    "odd sphere": sphere(77, 39),
    "northern half": sphere(78, 39, (0, 23)),
    "band": sphere(78, 39, (9, 30)),
    "window": window(),
}


def boxes(grid: Grid) -> list[tuple[int, int, int, int]]:
    """The whole grid; a part that lies at its right border; one inside."""
    w, h = grid.width, grid.height
    return [(0, 0, w, h), (9, 1, w - 9, h - 3), (5, h // 3, w // 2, h // 2)]


def patches(seed: int, width: int, height: int, share: float, size: int = 5) -> np.ndarray:
    """A random mask, float32 0 or 1, in patches."""
    random = np.random.default_rng(seed)
    coarse = random.random((height // size + 1, width // size + 1)) < share
    return np.kron(coarse, np.ones((size, size)))[:height, :width].astype(np.float32)


def random_layer(seed: int, width: int, height: int, share: float = 0.8) -> np.ndarray:
    """Working pixels (height, width, 4) with a random mask in patches; 0 outside it."""
    random = np.random.default_rng(seed)
    pixels = random.random((height, width, 4)).astype(np.float32)
    pixels[..., 3] = 1
    return pixels * patches(seed + 1, width, height, share)[..., None]


def on_device(
    device: Device, pixels: np.ndarray, left: int = 0, top: int = 0, dtype: type = np.uint8
) -> WorkingLayer:
    """A working layer from pixels float32 (height, width, 4)."""
    height, width = pixels.shape[:2]
    layer = Layer(
        "test", Box(left, top, left + width, top + height), np.dtype(dtype), 3, lambda a, b: np.zeros((0,))
    )
    box = (left, top, width, height)
    return WorkingLayer(layer, box, device.upload(pixels.astype(np.float32)), 0)


def whole(device: Device, grid: Grid, blend: float | np.ndarray) -> tuple[WorkingLayer, Buffer]:
    """A layer that covers the grid, with a coefficient."""
    layer = on_device(device, np.ones((*grid.shape, 4)))
    blends = np.broadcast_to(np.float32(blend), grid.shape)
    return layer, device.upload(blends)


def whole_chart(grid: Grid) -> Chart:
    """The chart of a pair that overlaps everywhere."""
    return pair_chart(np.ones(grid.shape, bool), grid, grid)

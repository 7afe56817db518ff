"""Mask-normalised pyramids and smoothing on the device (kernels/pyramid.cl).

Images are float32 (height, width); masks float32 of the same shape, 0 or 1. What lies outside a mask
never enters a sum. Coarse position = fine position / 2 for any size, odd ones too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from hugin_abflow.grid import Border
from hugin_abflow.opencl import Buffer, Device

_Value = TypeVar("_Value")


@dataclass(frozen=True)
class Level:
    """One level: image, mask and whether columns wrap."""

    image: Buffer
    mask: Buffer
    wraps: bool

    @property
    def grid(self) -> Border:
        """The grid as the kernels take it."""
        return Border.of(self.image.shape, self.wraps)


def reduce(device: Device, level: Level) -> Level:
    """The next coarser level; a pixel is valid where at least half of its weight is."""
    width, height = level.grid.size
    small = Level(
        device.empty(((height + 1) // 2, (width + 1) // 2)),
        device.empty(((height + 1) // 2, (width + 1) // 2)),
        level.wraps,
    )
    size = small.grid.size
    device.run(
        "pyramid", "pyramid_reduce", size, level.image, level.mask, level.grid, small.image, small.mask, size
    )
    return small


def build(device: Device, finest: Level, levels: int) -> list[Level]:
    """`levels` levels, finest first."""
    pyramid = [finest]
    while len(pyramid) < levels:
        pyramid.append(reduce(device, pyramid[-1]))
    return pyramid


def on_level(values: Sequence[_Value], level: int) -> _Value:
    """What holds on a level, of values from the finest on; the last holds for all coarser ones."""
    return values[min(level, len(values) - 1)]


def smooth(device: Device, level: Level, sigma: float) -> Level:
    """Gaussian mean of the valid pixels around each pixel, sigma in px; 0 where there are none.

    Expects an image that is 0 where its mask is. The result's mask is the weight of the valid pixels.
    """
    grid, radius = level.grid, max(1, round(2.5 * sigma))
    taps = device.upload(np.exp(-0.5 * (np.arange(radius + 1) / sigma) ** 2).astype(np.float32))
    rows, columns = (
        Level(device.empty(level.image.shape), device.empty(level.image.shape), level.wraps) for _ in range(2)
    )
    for source, step, normalise, target in ((level, (1, 0), 0, rows), (rows, (0, 1), 1, columns)):
        device.run(
            "pyramid", "pyramid_smooth", grid.size, source.image, source.mask, grid, step, taps, radius,
            normalise, target.image, target.mask,
        )  # fmt: skip
    return columns

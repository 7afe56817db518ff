"""Twins of kernels/chart.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import (
    Array,
    Numbers,
    canvas_position,
    chart_point,
    cubic_taps,
    grid_border,
    pixels,
    take,
)

# Fractions of a pixel closer to a whole pixel than this are taken for rounding.
SNAP = 0.0005


def tent(t: Array) -> Array:
    """Weights (4, ...) of taps -1, 0, 1, 2 around fraction t, which fall to 0 two pixels away."""
    distance = np.abs(np.asarray(t) - np.arange(-1, 3).reshape(4, *[1] * np.ndim(t)))
    return np.maximum(2 - distance, 0) / 4


def chart_sample(
    layer: Array,
    box: Sequence[int],
    border: Sequence[int],
    lonlat: Numbers,
    chart: Numbers,
    size: Sequence[int],
    floor_value: float,
    coarse: int = 1,
) -> tuple[Array, Array]:
    """Log brightness and mask (height, width) of a layer on a chart."""
    columns, rows = pixels(size[0], size[1])
    x, y = canvas_position(chart_point(columns + 0.5, rows + 0.5, chart), lonlat)
    whole, fraction = [], []
    for position in (x - 0.5, y - 0.5):
        nearest = np.rint(position)
        position = np.where(np.abs(position - nearest) < SNAP, nearest, position)
        whole.append(np.floor(position).astype(int))
        fraction.append(position - np.floor(position))
    cubic = [cubic_taps(t, -0.5) if coarse == 1 else tent(t) for t in fraction]
    linear = [np.stack([0 * t, 1 - t, t, 0 * t]) for t in fraction]
    sums = {"cubic": 0.0, "linear": 0.0}
    complete = {name: np.ones(x.shape, bool) for name in sums}
    for j in range(4):
        for i in range(4):
            column, row, inside = grid_border(whole[0] + i - 1, whole[1] + j - 1, border)
            colour = take(layer, box, column, row, inside)
            for name, weights in (("cubic", cubic), ("linear", linear)):
                weight = weights[0][i] * weights[1][j]
                sums[name] = sums[name] + weight[..., None] * colour
                complete[name] &= (weight == 0) | (colour[..., 3] != 0)
    colour = np.where(complete["cubic"][..., None], sums["cubic"], sums["linear"])[..., :3]
    brightness = np.maximum(colour, 0) @ [0.299, 0.587, 0.114]
    mask = complete["linear"]
    return np.where(mask, np.log(brightness + floor_value), 0.0), mask.astype(np.float64)

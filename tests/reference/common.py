"""Twins of kernels/common.cl: borders, canvas and chart transforms, layers sampled, bicubic weights.

Everything is float64; positions are arrays (x right, y down), points arrays (..., 3).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

Array = np.ndarray
Numbers = Sequence[float] | Array


def grid_border(x: Array, y: Array, grid: Sequence[int]) -> tuple[Array, Array, Array]:
    """Columns and rows after the border rules of (width, height, wraps, poles), and which lie inside."""
    width, height, wraps, poles = grid
    x, y = np.broadcast_arrays(x, y)
    north, south = (y < 0) & bool(poles & 1), (y >= height) & bool(poles & 2)
    x = np.where(north | south, x + width // 2, x)
    y = np.where(north, -1 - y, np.where(south, 2 * height - 1 - y, y))
    if wraps:
        x = np.mod(x, width)
    return x, y, (x >= 0) & (x < width) & (y >= 0) & (y < height)


def take(values: Array, box: Sequence[int], x: Array, y: Array, inside: Array | None = None) -> Array:
    """Values of an array that covers `box` at pixels (x, y); 0 outside, or where `inside` is false."""
    left, top, width, height = box
    x, y = np.asarray(x) - left, np.asarray(y) - top
    good = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    if inside is not None:
        good = good & inside
    found = values[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)].astype(np.float64)
    return np.where(good.reshape(good.shape + (1,) * (found.ndim - good.ndim)), found, 0.0)


def on_grid(values: Array, grid: Sequence[int], x: Array, y: Array) -> tuple[Array, Array]:
    """Values of an array that covers the whole grid, 0 outside its borders; and which lie inside."""
    x, y, inside = grid_border(x, y, grid)
    return take(values, (0, 0, grid[0], grid[1]), x, y, inside), inside


def four_taps(x: Array, y: Array) -> Iterator[tuple[Array, Array, Array]]:
    """(column, row, bilinear weight) of the pixels around positions whose pixel centres are at n + 0.5."""
    left, top = np.floor(x - 0.5).astype(int), np.floor(y - 0.5).astype(int)
    right_share, lower_share = x - 0.5 - left, y - 0.5 - top
    yield left, top, (1 - right_share) * (1 - lower_share)
    yield left + 1, top, right_share * (1 - lower_share)
    yield left, top + 1, (1 - right_share) * lower_share
    yield left + 1, top + 1, right_share * lower_share


def bilinear(values: Array, grid: Sequence[int], x: Array, y: Array) -> tuple[Array, Array]:
    """Weighted sum over the taps inside the grid, and their share of the weight."""
    total, share = 0.0, 0.0
    for column, row, weight in four_taps(x, y):
        found, inside = on_grid(values, grid, column, row)
        total = total + found * weight.reshape(weight.shape + (1,) * (found.ndim - weight.ndim))
        share = share + weight * inside
    return np.asarray(total), np.asarray(share)


def cubic_taps(t: Array, a: float) -> Array:
    """Weights (4, ...) of taps -1, 0, 1, 2: Keys' cubic, as a function of tap distance."""
    distance = np.abs(np.asarray(t) - np.arange(-1, 3).reshape(4, *[1] * np.ndim(t)))
    near = (a + 2) * distance**3 - (a + 3) * distance**2 + 1
    far = a * (distance**3 - 5 * distance**2 + 8 * distance - 4)
    return np.where(distance <= 1, near, np.where(distance < 2, far, 0.0))


def _direction(lon: Array, lat: Array) -> Array:
    return np.stack([np.cos(lat) * np.sin(lon), np.cos(lat) * np.cos(lon), np.sin(lat)], -1)


def canvas_point(x: Array, y: Array, lonlat: Numbers) -> Array:
    """Points in the scene of canvas positions."""
    lon0, across, lat0, down = np.asarray(lonlat, np.float64)
    if across == 0:
        return np.stack([x, y, np.zeros_like(x)], -1).astype(np.float64)
    return _direction(lon0 + x * across, lat0 - y * down)


def canvas_position(point: Array, lonlat: Numbers) -> tuple[Array, Array]:
    """Canvas positions of points, not necessarily of unit length."""
    lon0, across, lat0, down = np.asarray(lonlat, np.float64)
    if across == 0:
        return point[..., 0], point[..., 1]
    unit = point / np.linalg.norm(point, axis=-1, keepdims=True)
    lon, lat = np.arctan2(unit[..., 0], unit[..., 1]), np.arcsin(np.clip(unit[..., 2], -1, 1))
    return (lon - lon0) / across, (lat0 - lat) / down


def chart_point(u: Array, v: Array, chart: Numbers) -> Array:
    """Points in the scene of chart positions."""
    t = np.asarray(chart, np.float64)
    if t[13] == 0:
        return np.stack([(u - t[11]) / t[9], (v - t[12]) / t[10], np.zeros_like(u)], -1)
    return _direction((u - t[11]) / t[9], (t[12] - v) / t[10]) @ t[:9].reshape(3, 3)


def chart_position(point: Array, chart: Numbers) -> tuple[Array, Array]:
    """Chart positions of points; on a wrapped plane the copy within the first period of the chart."""
    t = np.asarray(chart, np.float64)
    if t[13] == 0:
        u = point[..., 0] * t[9] + t[11]
        return (np.mod(u, t[14] * t[9]) if t[14] > 0 else u), point[..., 1] * t[10] + t[12]
    turned = point @ t[:9].reshape(3, 3).T
    lon = np.arctan2(turned[..., 0], turned[..., 1])
    lat = np.arctan2(turned[..., 2], np.hypot(turned[..., 0], turned[..., 1]))
    return lon * t[9] + t[11], t[12] - lat * t[10]


def layer_seen(
    layer: Array, field: Array, box: Sequence[int], x: Array, y: Array, border: Sequence[int], lonlat: Numbers
) -> Array:
    """layer_sample at layer_position: what a layer shows for working pixels (x, y), r, g, b, valid."""
    way = take(field, box, x, y)[..., :3]
    own = take(layer, box, x, y)[..., 3] != 0
    px, py = canvas_position(canvas_point(x + 0.5, y + 0.5, lonlat) + way, lonlat)
    still = ~way.any(-1)
    px, py = np.where(still, x + 0.5, px), np.where(still, y + 0.5, py)
    total = 0.0
    for column, row, weight in four_taps(px, py):
        column, row, inside = grid_border(column, row, border)
        total = total + weight[..., None] * take(layer, box, column, row, inside)
    return np.where((own & (total[..., 3] > 0.999))[..., None], total, 0.0)


EXPOSURE_FLOOR = 0.02


def exposure_scale(c: Array, shoulder: float) -> Array:
    """Log odds of shoulder * c, c in 0..1 of full scale, on a floor."""
    return np.log((np.maximum(c, 0) + EXPOSURE_FLOOR) / (np.maximum(1 - shoulder * c, 0) + EXPOSURE_FLOOR))


def exposure_shift(c: Array, gain: Array, shoulder: float) -> Array:
    """Colours moved by `gain` on that scale; those of integer images not beyond white."""
    odds = np.minimum(c, 1) * shoulder
    moved = c * np.exp(gain) / (1 - odds + odds * np.exp(gain))
    if shoulder:
        moved = np.minimum(moved, np.maximum(c, 1))
    return np.where(gain == 0, c, moved)


def gains_at(gain: Array, border: Sequence[int], colours: Sequence[int], cells: Sequence[int]) -> Array:
    """The gain at the centre of each pixel's cell (height, width, 3)."""
    gain_row = (2 * np.arange(cells[1]) + 1) * colours[1] // (2 * cells[1])
    gain_column = (2 * np.arange(cells[0]) + 1) * colours[0] // (2 * cells[0])
    cell = [
        np.searchsorted(np.arange(1, c + 1) * b // c, np.arange(b), "right")
        for b, c in zip(border, cells, strict=False)
    ]
    return gain[gain_row[cell[1]][:, None], gain_column[cell[0]][None], :3].astype(np.float64)


def layer_look(
    layer: Array,
    field: Array,
    box: Sequence[int],
    gain: Array,
    border: Sequence[int],
    lonlat: Numbers,
    colours: Sequence[int],
    cells: Sequence[int],
    shoulder: float,
) -> tuple[Array, Array]:
    """What an aligned layer shows in all pixels of a grid (height, width, 4), and how it looks with the gain
    at the centre of each one's cell (height, width, 3)."""
    columns, rows = pixels(border[0], border[1])
    seen = layer_seen(layer, field, box, columns, rows, border, lonlat)
    here = gains_at(gain, border, colours, cells)
    return seen, np.maximum(exposure_shift(seen[..., :3], here, shoulder), 0)


def cell_parts(
    border: Sequence[int], cells: Sequence[int], every: int = 1
) -> Iterator[tuple[tuple[int, int], Any]]:
    """The place of each cell of a grid, and which pixels of another one are read for it."""
    for j, i in np.ndindex(cells[1], cells[0]):
        left, right = (k * border[0] // cells[0] for k in (i, i + 1))
        top, bottom = (k * border[1] // cells[1] for k in (j, j + 1))
        yield (j, i), np.s_[top:bottom:every, left:right:every]


def on_box(box: Sequence[int]) -> tuple[slice, slice]:
    """Rows and columns of a box (left, top, width, height)."""
    left, top, width, height = box
    return np.s_[top : top + height, left : left + width]


def pixels(width: int, height: int, left: int = 0, top: int = 0) -> tuple[Array, Array]:
    """Columns and rows of all pixels of a box, each (height, width)."""
    rows, columns = np.mgrid[top : top + height, left : left + width]
    return columns, rows

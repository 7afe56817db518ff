"""Twins of kernels/multiband.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import (
    Array,
    Numbers,
    bilinear,
    canvas_point,
    canvas_position,
    exposure_scale,
    exposure_shift,
    four_taps,
    grid_border,
    on_box,
    pixels,
    take,
)

# A grid that is none.
NONE = (0, 0, 0, 0)
# Weight of a sum that only pixels at the very end of their spline, by rounding, can be in.
NOTHING = 1e-4


def spline(t: Array) -> Array:
    """The quadratic B-spline: a box three times convolved with itself."""
    a = np.abs(t)
    return np.where(a < 0.5, 0.75 - a**2, np.where(a < 1.5, 0.5 * (1.5 - a) ** 2, 0.0))


def place(box: Sequence[int], grid: Sequence[int], to: Sequence[int]) -> tuple[Array, Array]:
    """Positions of a box's pixels of one grid on another one."""
    x, y = pixels(box[2], box[3], box[0], box[1])
    return (x + 0.5) * to[0] / grid[0], (y + 0.5) * to[1] / grid[1]


def expand(level: Array, box: Sequence[int], x: Array, y: Array, grid: Sequence[int]) -> Array:
    """The spline through a level's valid pixels at positions of its grid: colours, (..., 3)."""
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    total, weight = np.zeros((*x.shape, 3)), np.zeros(x.shape)
    for j in (-1, 0, 1):
        for i in (-1, 0, 1):
            found = take(level, box, *grid_border(left + i, top + j, grid))
            t = spline(left + i + 0.5 - x) * spline(top + j + 0.5 - y) * (found[..., 3] > 0)
            total, weight = total + t[..., None] * found[..., :3], weight + t
    return _mean(total, weight)[..., :3]


def multiband_weights(
    layer: Array, field: Array, box: Sequence[int], grid: Sequence[int], total: Array
) -> Array:
    """The total (grid) with the weights of a layer on its box where it is valid."""
    result = total.astype(np.float64)
    result[on_box(box)] += np.where(layer[..., 3] > 0, field[..., 3], 0)
    return result


def multiband_finest(
    layer: Array,
    field: Array,
    box: Sequence[int],
    border: Sequence[int],
    lonlat: Numbers,
    total: Array,
    gain: Array | None,
    colours: Sequence[int],
    shoulder: float,
    half_box: Sequence[int],
    half: Sequence[int],
) -> tuple[Array, Array]:
    """What the layer shows, aligned and corrected, and 1; share of all weight: on a box of half the grid."""
    x, y = place(half_box, half, border)
    everything = total[on_box(box)].astype(np.float64)
    some = (layer[..., 3] > 0) & (everything > 0)
    share = field[..., 3] / np.where(some, everything, 1)
    counted = np.where(some[..., None], np.concatenate([field[..., :3], share[..., None]], -1), 0.0)
    way = np.zeros((*x.shape, 4))
    for column, row, weight in four_taps(x, y):
        way += weight[..., None] * take(counted, box, *grid_border(column, row, border))
    there = canvas_position(canvas_point(x, y, lonlat) + way[..., :3], lonlat)
    moved = way[..., :3].any(-1)
    seen = np.zeros((*x.shape, 4))
    for column, row, weight in four_taps(
        *(np.where(moved, a, b) for a, b in zip(there, (x, y), strict=True))
    ):
        seen += weight[..., None] * take(layer, box, *grid_border(column, row, border))
    valid, colour = seen[..., 3] > 0.999, seen[..., :3]
    if gain is not None:
        value, known = bilinear(gain, colours, *place(half_box, half, colours))
        colour = exposure_shift(colour, value[..., :3] / known[..., None], shoulder)
    if shoulder == 0:
        colour = exposure_scale(colour, 0.0)
    return _mean(colour, valid * 1.0), np.where(valid, way[..., 3], 0.0)


def multiband_differ(level: Array, box: Sequence[int], mean: Array) -> Array:
    """How a level on a box differs from the mean (grid), and 1; zeros where one of them is not valid."""
    known = (level[..., 3] > 0) & (mean[on_box(box)][..., 3] > 0)
    there = mean[on_box(box)][..., :3].astype(np.float64)
    return _mean(level[..., :3] - there, known * 1.0)


def multiband_reduce(
    level: Array,
    share: Array,
    box: Sequence[int],
    fine: Sequence[int],
    smaller_box: Sequence[int],
    coarse: Sequence[int],
) -> tuple[Array, Array]:
    """Splines as wide as coarse pixels: colours over valid pixels, shares over all of the fine grid."""
    x, y = place(smaller_box, coarse, fine)
    ratios = fine[0] / coarse[0], fine[1] / coarse[1]
    across, down = (np.arange(-int(1.5 * ratio) - 2, int(1.5 * ratio) + 3) for ratio in ratios)
    values, total = _together(level, share), np.zeros((*x.shape, 6))
    for j in down:
        for i in across:
            column, row = np.floor(x).astype(int) + i, np.floor(y).astype(int) + j
            t = spline((column + 0.5 - x) / ratios[0]) * spline((row + 0.5 - y) / ratios[1])
            total += t[..., None] * _found(values, box, fine, column, row)
    return _apart(total)


def multiband_spread(
    level: Array, share: Array, box: Sequence[int], grid: Sequence[int], widths: Array
) -> tuple[Array, Array]:
    """Splines along rows, whose knots are so many columns apart, a number for each row of the grid."""
    x, y = pixels(box[2], box[3], box[0], box[1])
    wide = widths[y].astype(np.float64)
    values, total = _together(level, share), np.zeros((*x.shape, 6))
    reach = int(1.5 * wide.max())
    for i in range(-reach, reach + 1):
        total += spline(i / wide)[..., None] * _found(values, box, grid, x + i, y)
    return _apart(total)


def multiband_add(
    level: Array,
    share: Array,
    box: Sequence[int],
    grid: Sequence[int],
    smaller: Array,
    smaller_box: Sequence[int],
    coarse: Sequence[int],
    total: Array,
) -> Array:
    """The blend's level (grid) with what a layer's shows beyond the coarser one, and the layer's share."""
    detail = level[..., :3].astype(np.float64)
    if coarse[0]:
        detail = detail - expand(smaller, smaller_box, *place(box, grid, coarse), coarse)
    result = total.astype(np.float64)
    result[on_box(box)] += np.concatenate([detail, np.ones((*share.shape, 1))], -1) * share[..., None]
    return result


def multiband_join(total: Array, grid: Sequence[int], smaller: Array, coarse: Sequence[int]) -> Array:
    """Weighted mean of details, with the coarser level under them; colour and 1, or zeros."""
    result = _mean(total[..., :3].astype(np.float64), total[..., 3])
    if coarse[0]:
        under = expand(smaller, (0, 0, *coarse[:2]), *place((0, 0, *grid[:2]), grid, coarse), coarse)
        result[..., :3] += np.where(result[..., 3:] > 0, under, 0.0)
    return result


def multiband_offset(
    level: Array, box: Sequence[int], grid: Sequence[int], blend: Array, negligible: float
) -> Array:
    """The blend less the layer, shrunk towards 0; the mean of those around where the layer is not."""
    x, y = pixels(box[2], box[3], box[0], box[1])
    valid, there = level[..., 3] > 0, blend[on_box(box)]
    some = (valid & (there[..., 3] > 0))[..., None]
    raised = np.where(some, there[..., :3].astype(np.float64) - level[..., :3], 0.0)
    known = np.concatenate([raised, some * 1.0], -1)
    offset, found = raised, valid
    for reach in (1, 2):
        around = np.zeros_like(known)
        for j in range(-reach, reach + 1):
            for i in range(-reach, reach + 1):
                around += take(known, box, *grid_border(x + i, y + j, grid))
        offset = np.where(found[..., None], offset, _mean(around[..., :3], around[..., 3])[..., :3])
        found = found | (around[..., 3] > 0)
    result = np.zeros((*valid.shape, 4))
    result[..., :3] = np.sign(offset) * np.maximum(np.abs(offset) - negligible, 0)
    return result


def _mean(total: Array, weight: Array, nothing: float = 0.0) -> Array:
    """Weighted colours over the sum of their weights and 1; zeros where there is none."""
    some = weight > nothing
    mean = total / np.where(some, weight, 1)[..., None]
    return np.where(some[..., None], np.concatenate([mean, np.ones((*some.shape, 1))], -1), 0.0)


def _together(level: Array, share: Array) -> Array:
    """Colours of valid pixels, valid, share: (height, width, 5)."""
    valid = level[..., 3:].astype(np.float64)
    return np.concatenate([level[..., :3] * valid, valid, share[..., None]], -1)


def _found(values: Array, box: Sequence[int], grid: Sequence[int], x: Array, y: Array) -> Array:
    """Values on a box at pixels, 0 beside it, and whether these lie on the grid: (..., 6)."""
    column, row, inside = grid_border(x, y, grid)
    return np.concatenate([take(values, box, column, row, inside), inside[..., None]], -1)


def _apart(total: Array) -> tuple[Array, Array]:
    """A level and its share from sums of _found."""
    return _mean(total[..., :3], total[..., 3], NOTHING), total[..., 4] / total[..., 5]

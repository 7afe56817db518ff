"""Twins of kernels/blend.cl. `rows` are stored samples (height, width, 2 or 4), alpha last."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from reference.common import (
    EXPOSURE_FLOOR,
    Array,
    Numbers,
    canvas_point,
    canvas_position,
    cubic_taps,
    exposure_shift,
    four_taps,
    grid_border,
    pixels,
    take,
)

# Of the cubic that layers are sampled with.
SLOPE = -2 / 3
# Of the least tap, by how much floats and integers may be below it.
FLOAT_LIT, INTEGER_LIT = 0.5, 0.25


def opaque(rows: Array, white: float) -> Array:
    """(height, width, 4) float64: colour and 1 where a pixel is valid, else zeros."""
    colour = rows[..., :3] if rows.shape[-1] == 4 else rows[..., [0, 0, 0]]
    valid = rows[..., -1].astype(np.float64) >= 0.5 * white
    pixels_ = np.concatenate([colour.astype(np.float64), np.ones((*valid.shape, 1))], -1)
    return np.where(valid[..., None], pixels_, 0.0)


def sample(
    pixels_: Array,
    box: Sequence[int],
    x: Array,
    y: Array,
    border: Sequence[int],
    nearest: int,
    white: float,
) -> Array:
    """Colour at positions and how far it can be trusted (0..1): (..., 4)."""
    if nearest:
        column, row, inside = grid_border(np.floor(x).astype(int), np.floor(y).astype(int), border)
        return take(pixels_, box, column, row, inside)
    left, top = np.floor(x - 0.5).astype(int), np.floor(y - 0.5).astype(int)
    across, down = cubic_taps(x - 0.5 - left, SLOPE), cubic_taps(y - 0.5 - top, SLOPE)
    cubic, least, valid = 0.0, np.inf, True
    for j in range(4):
        for i in range(4):
            column, row, inside = grid_border(left + i - 1, top + j - 1, border)
            tap = take(pixels_, box, column, row, inside)
            cubic = cubic + (across[i] * down[j])[..., None] * tap
            least = np.minimum(least, tap)
            valid = valid & (tap[..., 3] != 0)
    cubic = np.maximum(cubic, least - (FLOAT_LIT if white == 1 else INTEGER_LIT) * np.abs(least))
    linear = 0.0
    for column, row, weight in four_taps(x, y):
        column, row, inside = grid_border(column, row, border)
        linear = linear + weight[..., None] * take(pixels_, box, column, row, inside)
    share = linear[..., 3:]
    mean = np.where(share > 0, linear / np.where(share > 0, share, 1), 0.0)
    return np.where(
        np.asarray(valid)[..., None],
        np.concatenate([cubic[..., :3], np.ones_like(share)], -1),
        np.concatenate([mean[..., :3], share], -1),
    )


def read_field(field: Array, box: Sequence[int], x: Array, y: Array, border: Sequence[int]) -> Array:
    """Bilinear reading of a field on `box` of a grid, which repeats its rim; one turn wide, it wraps."""
    left, top, width, height = box
    ring = bool(border[2]) and width == border[0]
    total = 0.0
    for column, row, weight in four_taps(x, y):
        column = (column - left) % width if ring else np.clip(column - left, 0, width - 1)
        total = total + weight[..., None] * field[np.clip(row - top, 0, height - 1), column]
    return total


def position(x: Array, y: Array, displacement: Array, scale: Numbers, lonlat: Numbers) -> tuple[Array, Array]:
    """Where a layer is sampled for full-resolution positions."""
    if not lonlat[1]:
        return x + displacement[..., 0] * scale[0], y + displacement[..., 1] * scale[1]
    there_x, there_y = canvas_position(canvas_point(x, y, lonlat) + displacement, lonlat)
    turn = 2 * np.pi / lonlat[1]  # the copy that is nearest
    return there_x - turn * np.rint((there_x - x) / turn), there_y


def correct(
    colour: Array, gain: Array, offset: Array, white: float, shoulder: float, unit: float = 1.0
) -> Array:
    """Stored colour with its exposure corrected, then raised; floats by the logarithms of their roots."""
    if white != 1:
        c = np.where(gain == 0, colour, exposure_shift(colour / white, gain, shoulder) * white)
        return c + white * offset
    v = np.sqrt(np.maximum(colour, 0) / unit) * np.exp(gain)
    raised = unit * np.maximum(v + (v + EXPOSURE_FLOOR) * (np.exp(offset) - 1), 0) ** 2
    return np.where((colour < 0) | ((gain == 0) & (offset == 0)), colour, raised)


def blend_mark(
    stored: Sequence[Array],
    places: Sequence[Sequence[int]],
    fields: Sequence[Array],
    boxes: Sequence[Sequence[int]],
    border: Sequence[int],
    field_border: Sequence[int],
    band: Sequence[int],
    block: int,
    white: float,
) -> Array:
    """Bits of layers that blocks of rows show, and of those with a positive weight among what is read there,
    or that read across the border or all round: integers (rows, blocks, 2, words).
    """
    left, top, width, height = band
    count = -(-width // block)
    marks = np.zeros((height, count, 2, max(1, -(-len(stored) // 32))), np.int64)
    for k, (rows, place, field, box) in enumerate(zip(stored, places, fields, boxes, strict=True)):
        valid = np.zeros((height, count * block), bool)
        columns, lines = pixels(width, height, left, top)
        valid[:, :width] = take(opaque(rows, white), place, columns, lines)[..., 3] > 0
        shown = valid.reshape(height, count, block).any(-1)
        for y, b in np.argwhere(shown):
            ends = np.array([b * block, min(width, (b + 1) * block) - 1]) + left + 0.5
            q = np.floor(ends * field_border[0] / border[0] - 0.5) - box[0] + [0, 1]
            all_round = q[1] - q[0] >= field_border[0]
            if field_border[2] and box[2] == field_border[0]:
                q %= box[2]
            first, last = np.clip(q, 0, box[2] - 1).astype(int)
            q = math.floor((y + top + 0.5) * field_border[1] / border[1] - 0.5) - box[1]
            upper, lower = (min(max(row, 0), box[3] - 1) for row in (q, q + 1))
            weighs = all_round or last < first or (field[[upper, lower], first : last + 1, 3] > 0).any()
            marks[y, b, :, k // 32] |= np.array([1, weighs]) << (k % 32)
    return marks


def blend_band(
    stored: Sequence[Array],
    places: Sequence[Sequence[int]],
    fields: Sequence[Array],
    boxes: Sequence[Sequence[int]],
    gains: Sequence[Array | None],
    offsets: Sequence[tuple[Sequence[int], Array] | None],
    border: Sequence[int],
    lonlat: Numbers,
    field_border: Sequence[int],
    gain_border: Sequence[int],
    offset_border: Sequence[int],
    band: Sequence[int],
    origin: Sequence[int],
    shoulder: float,
    unit: float,
    nearest: int,
    share: float,
    white: float,
    carried: Array,
) -> Array:
    """Samples of the band, float64 but rounded and within 0..white for integer layers.

    stored, places      rows of each layer and their box.
    fields, boxes       of `hidden_mark`, and their boxes on the working grid.
    gains               on the whole colour grid.
    offsets             and their boxes on their grid.
    carried             on any grid: where one layer alone is sampled as several are.
    """
    columns, rows = pixels(band[2], band[3], band[0], band[1])
    x, y = columns + 0.5, rows + 0.5
    scale = border[0] / field_border[0], border[1] / field_border[1]
    seen = []
    every = zip(stored, places, fields, boxes, gains, offsets, strict=True)

    def read(field: Array, box: Sequence[int], grid: Sequence[int]) -> Array:
        return read_field(field, box, x * grid[0] / border[0], y * grid[1] / border[1], grid)

    for pixels_, place, field, box, gain, offset in every:
        opaque_ = opaque(pixels_, white)
        f = read(field, box, field_border)
        exposure, raised = np.zeros((2, *x.shape, 3))
        if gain is not None:
            exposure = read(gain, (0, 0, *gain_border[:2]), gain_border)[..., :3]
        if offset is not None:
            raised = read(offset[1], offset[0], offset_border)[..., :3]
        own = take(opaque_, place, columns, rows)
        colour = sample(opaque_, place, *position(x, y, f[..., :3], scale, lonlat), border, nearest, white)
        colour = np.where(f[..., :3].any(-1, keepdims=True), colour, own)
        looks = [correct(c[..., :3], exposure, raised, white, shoulder, unit) for c in (own, colour)]
        some = ((exposure != 0) | (raised != 0)).any(-1)
        seen.append((own[..., 3] > 0, looks, f[..., 3], colour[..., 3], some))
    count = sum(layer[0].astype(int) for layer in seen)
    strips = carried.shape[0] / border[1], carried.shape[1] / border[0]
    several = (count > 1) | (carried[(y * strips[0]).astype(int), (x * strips[1]).astype(int)] > 0)
    own, corrected, known = np.zeros((*x.shape, 3)), np.zeros(x.shape, bool), np.zeros(x.shape, bool)
    for covered, looks, _, _, exposed in seen:
        fresh = covered & ~known
        own = np.where(fresh[..., None], looks[0], own)
        corrected, known = corrected | (fresh & exposed), known | covered

    def mean(hidden: Array) -> tuple[Array, Array, Array, Array]:
        total, weight, summed, touched = (np.zeros((*x.shape, n)) for n in (1, 1, 3, 1))
        for covered, looks, wanted, valid, exposed in seen:
            w = np.where(covered & several, np.maximum(wanted + hidden, 0), 0)[..., None]
            total, w = total + w, w * valid[..., None] ** 2
            weight, summed = weight + w, summed + looks[1] * w
            touched = touched + ((w > 0) & exposed[..., None])
        return total[..., 0], weight, summed, touched[..., 0] > 0

    total, weight, summed, touched = mean(np.zeros(x.shape))
    again = weight[..., 0] < 0.5 * total
    _, *second = mean(share * total)
    weight = np.where(again[..., None], second[0], weight)
    summed = np.where(again[..., None], second[1], summed)
    touched |= again & second[2]
    mixed = weight > 1e-12
    colour = np.where(mixed, summed / np.where(mixed, weight, 1), own)
    corrected = touched | (corrected & ~mixed[..., 0])
    alpha = np.where(known, white, 0.0)[..., None]
    out = np.concatenate([colour if stored[0].shape[-1] == 4 else colour[..., :1], alpha], -1)
    if white == 1:
        return out
    out = np.clip(out, 0, white)
    thresholds = [threshold(columns + origin[0], rows + origin[1], k) for k in range(out.shape[-1])]
    dithered = dither(out, np.stack(thresholds, -1), white)
    return np.where(corrected[..., None], dithered, np.rint(out))


def threshold(x: Array, y: Array, channel: int) -> Array:
    """The fraction above which a value is rounded up, per canvas pixel; the same bits as the kernel's."""
    h = (y.astype(np.uint32) * np.uint32(4)) + np.uint32(channel)
    h = (h ^ (h >> np.uint32(16))) * np.uint32(0x85EBCA6B)
    h = (h ^ (h >> np.uint32(13))) * np.uint32(0xC2B2AE35)
    h = (h ^ (h >> np.uint32(16))) + x.astype(np.uint32) * np.uint32(0x9E3779B9)
    return ((h >> np.uint32(16)) + 0.5) / 65536


def dither(values: Array, thresholds: Array, white: float) -> Array:
    """Whole numbers; those that are whole but for float32's rounding stay."""
    whole, below = np.rint(values), np.floor(values)
    up = below + (values - below > thresholds)
    return np.where(np.abs(values - whole) <= 2e-7 * white, whole, up)

"""Twins of kernels/blend.cl. `rows` are stored samples (height, width, 2 or 4), alpha last."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import (
    Array,
    Numbers,
    canvas_point,
    canvas_position,
    catmull_rom,
    exposure_shift,
    four_taps,
    grid_border,
    pixels,
    take,
)


def opaque(rows: Array, white: float) -> Array:
    """(height, width, 4) float64: colour and 1 where a pixel is valid, else zeros."""
    colour = rows[..., :3] if rows.shape[-1] == 4 else rows[..., [0, 0, 0]]
    valid = rows[..., -1].astype(np.float64) >= 0.5 * white
    pixels_ = np.concatenate([colour.astype(np.float64), np.ones((*valid.shape, 1))], -1)
    return np.where(valid[..., None], pixels_, 0.0)


def blend_count(rows: Array, box: Sequence[int], band: Sequence[int], count: Array, white: float) -> Array:
    """How many layers cover each pixel of the band, this one included."""
    x, y = pixels(band[2], band[3], band[0], band[1])
    return np.minimum(count + take(opaque(rows, white)[..., 3], box, x, y), 2).astype(np.uint8)


def sample(
    pixels_: Array, box: Sequence[int], x: Array, y: Array, border: Sequence[int], nearest: int
) -> Array:
    """Colour at positions and how far it can be trusted (0..1): (..., 4)."""
    if nearest:
        column, row, inside = grid_border(np.floor(x).astype(int), np.floor(y).astype(int), border)
        return take(pixels_, box, column, row, inside)
    left, top = np.floor(x - 0.5).astype(int), np.floor(y - 0.5).astype(int)
    across, down = catmull_rom(x - 0.5 - left), catmull_rom(y - 0.5 - top)
    cubic, valid = 0.0, True
    for j in range(4):
        for i in range(4):
            column, row, inside = grid_border(left + i - 1, top + j - 1, border)
            tap = take(pixels_, box, column, row, inside)
            cubic = cubic + (across[i] * down[j])[..., None] * tap
            valid = valid & (tap[..., 3] != 0)
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


def position(x: Array, y: Array, displacement: Array, scale: Numbers, lens: Numbers) -> tuple[Array, Array]:
    """Where a layer is sampled for full-resolution positions."""
    if not lens[1]:
        return x + displacement[..., 0] * scale[0], y + displacement[..., 1] * scale[1]
    there_x, there_y = canvas_position(canvas_point(x, y, lens) + displacement, lens)
    turn = 2 * np.pi / lens[1]  # the copy that is nearest
    return there_x - turn * np.rint((there_x - x) / turn), there_y


def correct(colour: Array, gain: Array, white: float) -> Array:
    """Colour in stored units with its exposure corrected; integer samples are told by their full scale."""
    return np.where(gain == 0, colour, exposure_shift(colour / white, gain, int(white > 1)) * white)


def blend_add(
    rows: Array,
    box: Sequence[int],
    band: Sequence[int],
    border: Sequence[int],
    lens: Numbers,
    field: Array,
    field_box: Sequence[int],
    field_border: Sequence[int],
    gain: Array | None,
    gain_border: Sequence[int],
    nearest: int,
    count: Array,
    reference: Array,
    total: Array,
    white: float,
) -> tuple[Array, Array]:
    """Reference and sum of the band with one layer added."""
    stored = opaque(rows, white)
    columns, lines = pixels(band[2], band[3], band[0], band[1])
    own = take(stored, box, columns, lines)
    covered = own[..., 3] != 0
    x, y = columns + 0.5, lines + 0.5
    exposure = np.zeros((*x.shape, 3))
    if gain is not None:
        place = x * gain_border[0] / border[0], y * gain_border[1] / border[1]
        exposure = read_field(gain, (0, 0, *gain_border[:2]), *place, gain_border)[..., :3]
    state = np.where((exposure != 0).any(-1), 2.0, 1.0)
    first = np.concatenate([correct(own[..., :3], exposure, white), state[..., None]], -1)
    fresh = covered & (reference[..., 3] == 0)
    reference = np.where(fresh[..., None], first, reference)
    scale = border[0] / field_border[0], border[1] / field_border[1]
    f = read_field(field, field_box, x / scale[0], y / scale[1], field_border)
    colour = sample(stored, box, *position(x, y, f[..., :3], scale, lens), border, nearest)
    weight = np.where(covered & (count >= 2), np.maximum(f[..., 3], 0) * colour[..., 3] ** 2, 0.0)
    difference = correct(colour[..., :3], exposure, white) - reference[..., :3]
    state = np.where(weight > 0, np.maximum(state, reference[..., 3]), reference[..., 3])
    reference = np.concatenate([reference[..., :3], state[..., None]], -1)
    return reference, total + np.concatenate([difference * weight[..., None], weight[..., None]], -1)


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


def blend_finish(
    reference: Array,
    total: Array,
    band: Sequence[int],
    origin: Sequence[int],
    samples: int,
    white: float,
    integer: int,
) -> Array:
    """Samples of the band, float64 but rounded and within 0..white for integer layers."""
    weight = total[..., 3:]
    known = weight > 1e-12
    colour = reference[..., :3] + np.where(known, total[..., :3] / np.where(known, weight, 1), 0.0)
    alpha = np.minimum(reference[..., 3:], 1) * white
    out = np.concatenate([colour if samples == 4 else colour[..., :1], alpha], -1)
    if not integer:
        return out
    x, y = pixels(band[2], band[3], band[0] + origin[0], band[1] + origin[1])
    dithered = np.stack([dither(out[..., k], threshold(x, y, k), white) for k in range(samples)], -1)
    return np.clip(np.where(reference[..., 3:] > 1, dithered, np.rint(out)), 0, white)

"""Twins of kernels/colour.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import (
    EXPOSURE_FLOOR,
    Array,
    Numbers,
    cell_parts,
    exposure_scale,
    layer_seen,
    pixels,
    take,
)

# A layer's pixels, its field, and their box.
Side = tuple[Array, Array, Sequence[int]]


# The brightest channel up to which a sample tells nothing, and from which on all.
DARK, BRIGHT = 0.05, 0.3


def colour_difference(
    layer_a: Array,
    field_a: Array,
    box_a: Sequence[int],
    layer_b: Array,
    field_b: Array,
    box_b: Sequence[int],
    border: Sequence[int],
    lonlat: Numbers,
    cells: Sequence[int],
    shoulder: float,
    clipped_a: Numbers,
    clipped_b: Numbers,
    spread: float,
) -> tuple[Array, Array, Array, Array]:
    """Mean difference a - b of every cell's pixels, every other one in x and y, and its weight; the mean of
    those that one layer shows clipped, where these are most; how far both layers are seen; and their mean.
    """
    sides = ((layer_a, field_a, box_a), (layer_b, field_b, box_b))
    a, b, clips_a, clips_b, known = _seen(*sides, border, lonlat, clipped_a, clipped_b)
    columns, rows = pixels(border[0], border[1])
    s, t = (take(field, box, columns, rows)[..., 3].astype(np.float64) for _, field, box in sides)
    mixed = np.where(known, 4 * s * t / np.maximum((s + t) ** 2, 1e-20), 0)
    mixing, level = np.zeros((2, cells[1], cells[0]))
    light = np.stack([exposure_scale(a, shoulder), exposure_scale(b, shoulder)])
    difference = light[0] - light[1]
    tells = np.ones(known.shape)
    if shoulder:
        tells = np.clip((np.minimum(a.max(-1), b.max(-1)) - DARK) / (BRIGHT - DARK), 0, 1)
    result, beyond = np.zeros((2, cells[1], cells[0], 4))
    for place, part in cell_parts(border, cells, 2):
        count = known[part].size
        mixing[place] = mixed[part].mean()
        usable = (known & ~clips_a & ~clips_b)[part]
        told, values = tells[part][usable], difference[part][usable]
        if told.any():
            mean = np.average(values, 0, told)
            variance = np.average((values - mean) ** 2, 0, told).sum()
            level[place] = np.average(light.mean((0, -1))[part][usable], weights=told)
            result[place] = [*mean, told.sum() / count / (1 + variance / spread**2)]
        for sign, alone in ((1, clips_a & ~clips_b), (-1, clips_b & ~clips_a)):
            values = difference[part][(known & alone)[part]]
            if 2 * len(values) > count:
                beyond[place] = [*values.mean(0), sign * (2 * len(values) / count - 1)]
    return result, beyond, mixing, level


def colour_misfit(
    layer_a: Array,
    field_a: Array,
    box_a: Sequence[int],
    layer_b: Array,
    field_b: Array,
    box_b: Sequence[int],
    border: Sequence[int],
    lonlat: Numbers,
    cells: Sequence[int],
    shoulders: Numbers,
    clipped_a: Numbers,
    clipped_b: Numbers,
) -> Array:
    """What the best gain of a cell leaves of the difference, by weighted least squares on each scale."""
    sides = ((layer_a, field_a, box_a), (layer_b, field_b, box_b))
    a, b, clips_a, clips_b, known = _seen(*sides, border, lonlat, clipped_a, clipped_b)
    a, b = np.maximum(a, EXPOSURE_FLOOR), np.maximum(b, EXPOSURE_FLOOR)
    result = np.zeros((cells[1], cells[0], len(shoulders)))
    for place, part in cell_parts(border, cells, 4):
        usable = (known & ~clips_a & ~clips_b)[part]
        u, v = a[part][usable], b[part][usable]
        for k, shoulder in enumerate(shoulders):
            difference = np.log(u / (1 - shoulder * u)) - np.log(v / (1 - shoulder * v))
            slope = (u + v) / 2 * (1 - shoulder * (u + v) / 2)
            for channel in range(3 if len(u) else 0):
                weights = slope[:, channel] ** 2
                mean = np.average(difference[:, channel], weights=weights)
                squares = weights * (difference[:, channel] - mean) ** 2
                result[(*place, k)] += squares.sum() / known[part].size
    return result


def _seen(
    side_a: Side,
    side_b: Side,
    border: Sequence[int],
    lonlat: Numbers,
    clipped_a: Numbers,
    clipped_b: Numbers,
) -> tuple[Array, Array, Array, Array, Array]:
    """Colours of both aligned layers, where each is clipped, and where both are."""
    columns, rows = pixels(border[0], border[1])
    a, b = (layer_seen(*side, columns, rows, border, lonlat) for side in (side_a, side_b))
    clips = (
        (one[..., :3] > np.float32(limit)[:3]).any(-1) for one, limit in ((a, clipped_a), (b, clipped_b))
    )
    return a[..., :3], b[..., :3], *clips, (a[..., 3] > 0) & (b[..., 3] > 0)

"""Twins of kernels/geometry.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import (
    Array,
    Numbers,
    bilinear,
    canvas_point,
    canvas_position,
    chart_point,
    chart_position,
    on_box,
    pixels,
    take,
)

# Coefficients below this move nothing.
NEGLIGIBLE = 1e-5
# A weight falls to e to the power of minus that at most.
FAINTEST = 14.0


def flow_at(flow: Array, u: Array, v: Array, grid: Sequence[int]) -> Array:
    """Flow at chart positions, from the pixels that exist; 0 beyond the chart."""
    total, share = bilinear(flow, grid, u, v)
    known = share > 1e-6
    return np.where(known[..., None], total / np.where(known, share, 1)[..., None], 0.0)


def geometry_add(
    blend_j: Array,
    box_j: Sequence[int],
    layer_k: Array,
    box_k: Sequence[int],
    lonlat: Numbers,
    flow: Array,
    grid: Sequence[int],
    chart: Numbers,
    field: Array,
) -> Array:
    """Field of layer k with the part of layer j added to its displacement."""
    x, y = pixels(box_k[2], box_k[3], box_k[0], box_k[1])
    weight = np.where(layer_k[..., 3] != 0, take(blend_j, box_j, x, y), 0.0)
    weight[weight < NEGLIGIBLE] = 0
    point = canvas_point(x + 0.5, y + 0.5, lonlat)
    u, v = chart_position(point, chart)
    moved = flow_at(flow, u, v, grid)
    way = chart_point(u + moved[..., 0], v + moved[..., 1], chart) - chart_point(u, v, chart)
    result = field.astype(np.float64)
    result[..., :3] += weight[..., None] * way
    return result


def geometry_within(
    field: Array, box: Sequence[int], border: Sequence[int], lonlat: Numbers, fade: float
) -> Array:
    """The field with displacements that lead half of the way to the grid's last pixels' centres at most, and
    weights that are less where they are shortened."""
    columns, rows = pixels(box[2], box[3], box[0], box[1])
    x, y = columns + 0.5, rows + 0.5
    own = canvas_point(x, y, lonlat)
    there_x, there_y = canvas_position(own + field[..., :3], lonlat)
    if lonlat[1]:
        around = 2 * np.pi / lonlat[1]
        there_x = there_x - around * np.round((there_x - x) / around)
    inside_x = there_x if border[2] else there_x.clip(x / 2 + 0.25, (x + border[0]) / 2 - 0.25)
    inside_y = there_y if border[3] & 1 else np.maximum(there_y, y / 2 + 0.25)
    inside_y = inside_y if border[3] & 2 else np.minimum(inside_y, (y + border[1]) / 2 - 0.25)
    moved = (inside_x != there_x) | (inside_y != there_y)
    result = field.astype(np.float64)
    result[moved, :3] = (canvas_point(inside_x, inside_y, lonlat) - own)[moved]
    shortened = np.hypot(inside_x - there_x, inside_y - there_y)
    result[..., 3] *= np.exp(-np.minimum(fade * shortened, FAINTEST))
    return result


def geometry_activation(
    field: Array,
    blend: Array,
    box: Sequence[int],
    sharpness: float,
    magnitude: float,
    width: float,
    furthest: float,
    highest: Array,
) -> tuple[Array, Array]:
    """a_k in the field's last channel, and the maximum over layers."""
    result, highest = field.astype(np.float64), highest.astype(np.float64)
    shared = np.where(blend < 1, 1 - blend, np.inf)  # nobody else: f_k is 0
    long = np.minimum(np.linalg.norm(field[..., :3], axis=-1) / shared, furthest)
    a = sharpness * blend * (1 + magnitude * long / width)
    result[..., 3] = np.where(blend != 0, a, result[..., 3])
    its = highest[on_box(box)]
    highest[on_box(box)] = np.where(blend != 0, np.maximum(its, a), its)
    return result, highest


def geometry_softmax(field: Array, blend: Array, box: Sequence[int], highest: Array) -> Array:
    """s_k, not normalised, in the field's last channel."""
    result = field.astype(np.float64)
    top = highest[on_box(box)]
    result[..., 3] = np.where(blend > 0, np.exp(np.minimum(field[..., 3] - top, 0)), 0.0)
    return result


def geometry_reach(field: Array, box: Sequence[int], lonlat: Numbers) -> Array:
    """The longest way of each row, and how many rows its ways lead up or down at most: (height, 2)."""
    x, y = pixels(box[2], box[3], box[0], box[1])
    way = field[..., :3].astype(np.float64)
    _, there = canvas_position(canvas_point(x + 0.5, y + 0.5, lonlat) + way, lonlat)
    return np.stack([np.linalg.norm(way, axis=-1).max(1), np.abs(there - y - 0.5).max(1)], -1)

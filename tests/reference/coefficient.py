"""Twins of kernels/coefficient.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import Array, Numbers, bilinear, canvas_point, grid_border, on_box, pixels


def _touches(count: int, of: int) -> Array:
    """(count, of): which of `of` equal parts of a line share a stretch with which of `count` parts."""
    i, k = np.arange(count)[:, None], np.arange(of)[None, :]
    return ((k + 1) * count > i * of) & (k * count < (i + 1) * of)


def coefficient_mask(layer: Array, box: Sequence[int], working: Sequence[int], grid: Sequence[int]) -> Array:
    """uint8 (height, width) of the mask grid: 1 where no working pixel under it lacks the layer."""
    missing = np.ones((working[1], working[0]), int)
    missing[on_box(box)] = layer[..., 3] == 0
    across, down = _touches(grid[0], working[0]), _touches(grid[1], working[1])
    return (down.astype(int) @ missing @ across.T.astype(int) == 0).astype(np.uint8)


def coefficient_seed(mask: Array, cover: Array) -> Array:
    """int32 (height, width): a pixel's own place where the union is covered, but not by this layer."""
    return np.where((cover != 0) & (mask == 0), packed(mask.shape), -1).astype(np.int32)


def packed(shape: tuple[int, int]) -> Array:
    """Every pixel's own place, packed as x + 65536 y."""
    return np.arange(shape[1])[None, :] + 65536 * np.arange(shape[0])[:, None]


def between(x: Array, y: Array, place: Array, grid: Sequence[int], lonlat: Numbers) -> Array:
    """Distance in mask px from pixels to packed places; on the sphere an angle in radians."""
    sx, sy = place % 65536, place // 65536
    if not lonlat[1]:
        dx = np.abs(x - sx)
        return np.hypot(np.minimum(dx, grid[0] - dx) if grid[2] else dx, y - sy)
    here, there = canvas_point(x + 0.5, y + 0.5, lonlat), canvas_point(sx + 0.5, sy + 0.5, lonlat)
    chord = np.linalg.norm(here - there, axis=-1)
    return 2 * np.arcsin(np.minimum(1, chord / 2))


def coefficient_flood(seed: Array, grid: Sequence[int], lonlat: Numbers, step: int) -> Array:
    """Each pixel's nearest seed among those that it and its eight neighbours at `step` know."""
    x, y = pixels(grid[0], grid[1])
    best, nearest = np.full(seed.shape, -1), np.full(seed.shape, np.inf)
    for dy in (-step, 0, step):
        for dx in (-step, 0, step):
            px, py, inside = grid_border(x + dx, y + dy, grid)
            found = np.where(inside, seed[np.where(inside, py, 0), np.where(inside, px, 0)], -1)
            far = np.where(found >= 0, between(x, y, np.maximum(found, 0), grid, lonlat), np.inf)
            closer = (far < nearest) | ((far == nearest) & (found >= 0) & (found < best))
            best, nearest = np.where(closer, found, best), np.where(closer, far, nearest)
    return best.astype(np.int32)


def coefficient_distance(
    seed: Array, mask: Array, grid: Sequence[int], lonlat: Numbers, unit: float, furthest: float
) -> Array:
    """D_k in working pixels on the mask grid; unit: working px per mask px, or per radian."""
    x, y = pixels(grid[0], grid[1])
    inside = np.where(seed >= 0, unit * between(x, y, np.maximum(seed, 0), grid, lonlat), furthest)
    return np.where(mask != 0, inside, 0.0)


def coefficient_expand(
    distance: Array,
    grid: Sequence[int],
    ratio: Numbers,
    layer: Array,
    box: Sequence[int],
    total: Array,
) -> tuple[Array, Array]:
    """D_k on the layer's box of the working grid, and the sum over layers with it added."""
    x, y = pixels(box[2], box[3], box[0], box[1])
    summed, share = bilinear(distance, grid, (x + 0.5) * ratio[0], (y + 0.5) * ratio[1])
    expanded = np.where(layer[..., 3] != 0, np.maximum(summed / share, 1e-3), 0.0)
    total = total.astype(np.float64)
    total[on_box(box)] += expanded
    return expanded, total


def coefficient_ratio(value: Array, box: Sequence[int], total: Array) -> Array:
    """What a layer has on its box, over the total, (height, width) of the grid; as it is where that is 0."""
    total = total[on_box(box)].astype(np.float64)
    return np.where(total > 0, value / np.where(total > 0, total, 1), value)

"""Twins of kernels/search.cl. A descriptor is (h, dh/dx, dh/dy, valid); grid = (width, height, wraps, 0)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import Array, bilinear, on_grid, pixels

SLOPE = 1.5  # weight of the derivatives


def windows(values: Array, grid: Sequence[int], radius: int) -> Array:
    """(taps, height, width, ...): every pixel's square neighbourhood, 0 beyond the border."""
    x, y = pixels(grid[0], grid[1])
    span = range(-radius, radius + 1)
    return np.stack([on_grid(values, grid, x + dx, y + dy)[0] for dy in span for dx in span])


def displacements(reach: Sequence[int]) -> list[tuple[int, int]]:
    """All (x, y) within reach, in the order of the cost array."""
    return [(u, v) for v in range(-reach[1], reach[1] + 1) for u in range(-reach[0], reach[0] + 1)]


def _energy(feature: Array) -> Array:
    """(height, width, 2): each pixel's energy and whether it is known."""
    scaled = feature[..., :3] * np.array([1, SLOPE, SLOPE])
    return np.stack([(scaled**2).sum(-1) * feature[..., 3], feature[..., 3]], -1)


def search_energy(feature: Array, grid: Sequence[int]) -> Array:
    """Energy and what is known, over seven pixels of a row."""
    x, y = pixels(grid[0], grid[1])
    return sum(on_grid(_energy(feature), grid, x + dx, y)[0] for dx in range(-3, 4))


def search_descriptor(feature: Array, grid: Sequence[int], noise: float) -> Array:
    """Feature over the root of its mean energy in 7 x 7 pixels."""
    scaled = feature * np.array([1, SLOPE, SLOPE, 1.0])
    around = windows(_energy(feature), grid, 3).sum(0)
    strength = np.sqrt(around[..., 0] / np.maximum(around[..., 1], 1)) + noise
    return np.concatenate([scaled[..., :3] / strength[..., None], feature[..., 3:]], -1)


def misfit(a: Array, b: Array, outside: float) -> Array:
    """0 where descriptors are equal, 1 where they are far apart; `outside` where one is missing."""
    away = ((a[..., :3].astype(np.float64) - b[..., :3]) ** 2).sum(-1)
    return np.where(a[..., 3] * b[..., 3] > 0, away / (away + 0.5), outside)


def search_planes(descriptor: Array, grid: Sequence[int], margin: int, wide: int) -> Array:
    """(height, 4, wide): components, from `margin` columns before the grid on."""
    x, y = np.meshgrid(np.arange(wide) - margin, np.arange(grid[1]))
    values, inside = on_grid(descriptor, grid, x, y)
    return np.moveaxis(np.where(inside[..., None], values, 0), -1, 1)


def search_pixel_cost(a: Array, b: Array, grid: Sequence[int], reach: Sequence[int], outside: float) -> Array:
    """(displacements, height, width): misfit of every pixel and what b has there; -1 where a is not known."""
    x, y = pixels(grid[0], grid[1])
    found = [misfit(a, on_grid(b, grid, x + u, y + v)[0], outside) for u, v in displacements(reach)]
    return np.where(a[..., 3] > 0, np.stack(found), -1.0)


def search_cost(pixel_cost: Array, grid: Sequence[int], outside: float) -> Array:
    """(displacements, height, width): mean over those of 3 x 3 pixels that are known."""
    known = (pixel_cost[0] >= 0).astype(np.float64)
    weight = windows(known, grid, 1).sum(0)
    sums = np.stack([windows(one * known, grid, 1).sum(0) for one in pixel_cost])
    return np.where(weight > 0, sums / np.maximum(weight, 1), outside)


def costs(a: Array, b: Array, grid: Sequence[int], reach: Sequence[int], outside: float) -> Array:
    """Both of the above."""
    return search_cost(search_pixel_cost(a, b, grid, reach, outside), grid, outside)


def search_best(cost: Array, flow: Array, reach: Sequence[int], coupling: float) -> Array:
    """The displacement of least cost and squared distance from flow."""
    tried = np.array(displacements(reach), np.float64)
    away = ((tried[:, None, None] - flow.astype(np.float64)) ** 2).sum(-1)
    return tried[(cost.astype(np.float64) + coupling * away).argmin(0)]


def search_mean(flow: Array, grid: Sequence[int]) -> Array:
    """Mean of those of 3 x 3 pixels that exist."""
    return windows(flow, grid, 1).sum(0) / windows(np.ones(flow.shape), grid, 1).sum(0)


def search_distinct(cost: Array, found: Array, reach: Sequence[int], distinct: float) -> Array:
    """Whether every displacement more than 2 px away costs at least so much more than the one found."""
    whole, every = found.astype(int), cost.astype(np.float64)
    index = (whole[..., 1] + reach[1]) * (2 * reach[0] + 1) + whole[..., 0] + reach[0]
    own = np.take_along_axis(every, index[None], 0)[0]
    far = np.abs(np.array(displacements(reach))[:, None, None] - whole).max(-1) > 2
    return np.where(far, every, np.inf).min(0) >= own + distinct


def search_agree(
    found: Array, back: Array, distinct: Array, flow: Array, grid: Sequence[int], tolerance: float
) -> Array:
    """`found` where it is distinct and `back` is its opposite, else `flow`."""
    x, y = pixels(grid[0], grid[1])
    whole = found.astype(int)
    answer, inside = on_grid(back, grid, x + whole[..., 0], y + whole[..., 1])
    agrees = distinct & inside & (np.linalg.norm(found + answer, axis=-1) <= tolerance)
    return np.where(agrees[..., None], found, flow)


def window_misfit(
    a: Array, b: Array, flow: Array, grid: Sequence[int], radius: int, focus: float, outside: float
) -> Array:
    """Mean misfit of each pixel's window under its flow; what differs from the middle counts less."""
    x, y = pixels(grid[0], grid[1])
    flow = flow.astype(np.float64)
    total, weight = np.zeros(x.shape), np.zeros(x.shape)
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            own, _ = on_grid(a, grid, x + dx, y + dy)
            there, _ = bilinear(b, grid, x + dx + 0.5 + flow[..., 0], y + dy + 0.5 + flow[..., 1])
            there = np.where(there[..., 3:] > 0.999, there, 0)
            w = np.exp(-focus * np.abs(own[..., 0] - a[..., 0])) * (own[..., 3] > 0)
            total += w * misfit(own, there, outside)
            weight += w
    return np.where(weight > 0, total / np.where(weight > 0, weight, 1), 0)


def search_choose(
    a: Array, b: Array, flow: Array, other: Array, grid: Sequence[int], step: int, radius: int, focus: float,
    outside: Sequence[float], patience: float,
) -> Array:  # fmt: skip
    """Own flow, or the best of ten from here and `step` px beside that fits better by `patience`."""
    x, y = pixels(grid[0], grid[1])
    own, best = flow.astype(np.float64), flow.astype(np.float64)
    least = window_misfit(a, b, own, grid, radius, focus, outside[0]) - patience
    for field in (flow,) if other is flow else (flow, other):
        for dx, dy in ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)):
            there, inside = on_grid(field, grid, x + step * dx, y + step * dy)
            differs = (((there - own) ** 2).sum(-1) >= 0.25) & (((there - best) ** 2).sum(-1) >= 0.25)
            cost = window_misfit(a, b, there, grid, radius, focus, outside[1])
            better = inside & differs & (a[..., 3] > 0) & (cost < least)
            best, least = np.where(better[..., None], there, best), np.where(better, cost, least)
    return best


def search_adopt(
    a: Array, b: Array, trusted: Array, grid: Sequence[int], step: int, radius: int, focus: float,
    outside: Sequence[float], patience: float, most: float, enough: float,
) -> Array:  # fmt: skip
    """Flow, trust and what stays, with the best trusted flow from `step` px beside where none is trusted."""
    x, y = pixels(grid[0], grid[1])
    best = trusted.astype(np.float64)
    least = np.minimum(window_misfit(a, b, best[..., :2], grid, radius, focus, outside[0]) - patience, most)
    for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        there, inside = on_grid(trusted, grid, x + step * dx, y + step * dy)
        cost = window_misfit(a, b, there[..., :2], grid, radius, focus, outside[1])
        better = inside & (there[..., 2] >= enough) & (trusted[..., 2] < enough)
        better &= (a[..., 3] > 0) & (cost < least)
        taken = np.stack([there[..., 0], there[..., 1], np.full(x.shape, enough), trusted[..., 3]], -1)
        best, least = np.where(better[..., None], taken, best), np.where(better, cost, least)
    return best

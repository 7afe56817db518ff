"""Twins of kernels/intermediate.cl."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from reference.common import (
    Array,
    Numbers,
    canvas_position,
    chart_point,
    grid_border,
    on_grid,
    pixels,
    take,
)
from reference.geometry import flow_at

# Squared px: up to which flows are alike, differ less than counts, and are trusted.
ALIKE, APART, TRUSTED = 1.0, 4.0, 4.0
STEPS, KEEP, GROW = 4, 4, 3


def intermediate_share(
    blend_a: Array,
    box_a: Sequence[int],
    blend_b: Array,
    box_b: Sequence[int],
    border: Sequence[int],
    lonlat: Numbers,
    grid: Sequence[int],
    chart: Numbers,
) -> Array:
    """w_b / (w_a + w_b) in the pixels of the working grid in which a chart's centres lie."""
    u, v = pixels(grid[0], grid[1])
    x, y = canvas_position(chart_point(u + 0.5, v + 0.5, chart), lonlat)
    column, row, inside = grid_border(np.floor(x).astype(int), np.floor(y).astype(int), border)
    a, b = (take(blend, box, column, row, inside) for blend, box in ((blend_a, box_a), (blend_b, box_b)))
    some = a + b > 1e-5
    return np.where(some, b / np.where(some, a + b, 1), 0.5)


def square(way: Array) -> Array:
    """Its squared length."""
    return (way**2).sum(-1)


def off(
    flow: Array, back: Array, u: Array, v: Array, way: Array, share: Array, grid: Sequence[int]
) -> tuple[Array, Array]:
    """By what, squared, the flows at the start and at the end of a way through (u, v) lead elsewhere."""
    dx, dy = way[..., 0], way[..., 1]
    start = flow_at(flow, u - share * dx, v - share * dy, grid)
    end = flow_at(back, u + (1 - share) * dx, v + (1 - share) * dy, grid)
    return square(start - way), square(end + way)


def intermediate_direct(flow: Array, back: Array, grid: Sequence[int], share: Array) -> Array:
    """The mean of both flows at a place, by share, and by how much they are doubted where they differ."""
    u, v = (n + 0.5 for n in pixels(grid[0], grid[1]))
    first, second = flow.astype(np.float64), -back.astype(np.float64)
    doubts = []
    for way in (first, second):
        both = sum(off(flow, back, u, v, way, share, grid))
        doubts.append(1 + 6 * both**2 / (both**2 + 256))
    its, rest = (1 - share) * doubts[1] ** 2, share * doubts[0] ** 2
    part = np.where(square(first - second) > ALIKE, its / (its + rest), 1 - share)[..., None]
    return part * first + (1 - part) * second


def intermediate_follow(flows: tuple[Array, Array], grid: Sequence[int], share: Array) -> Array:
    """(2, height, width, 2): column and row from which on the four pixels lie that flow passes; a row of -2
    where it does not lead back, or passes beside the grid.
    """
    width, height, wraps, _ = grid
    x, y = (n + 0.5 for n in pixels(width, height))
    corners = []
    for other in (0, 1):
        f = flows[other].astype(np.float64)
        back = flow_at(flows[1 - other], x + f[..., 0], y + f[..., 1], grid)
        u, v = x, y
        for _ in range(STEPS):
            column, row = np.floor(u).astype(int), np.clip(np.floor(v).astype(int), 0, height - 1)
            s = share[row, column % width if wraps else np.clip(column, 0, width - 1)]
            s = (1 - s if other else s)[..., None]
            u, v = np.moveaxis(np.stack([x, y], -1) + s * f, -1, 0)
        column, row = np.floor(u - 0.5).astype(int), np.floor(v - 0.5).astype(int)
        column = column % width if wraps else column
        beside = (column < -1) | (column >= width) | (row < -1) | (row >= height)
        told = (square(f) > ALIKE) & (square(f + back) < TRUSTED) & ~beside
        corners.append(np.where(told[..., None], np.stack([column, row], -1), -2))
    return np.stack(corners)


def intermediate_pass(
    flows: tuple[Array, Array], grid: Sequence[int], corners: Array, passing: Array
) -> tuple[Array, Array]:
    """Both passes over both flows: the largest squared differences, and whose they are."""
    width, height = grid[:2]
    furthest, source = np.zeros(width * height), np.zeros(width * height, np.int64)
    for other in (0, 1):
        f = flows[other].astype(np.float64)
        names = 1 + np.arange(width * height).reshape(height, width) + other * width * height
        for tap in range(4):
            column, row = corners[other, ..., 0] + tap % 2, corners[other, ..., 1] + tap // 2
            column, row, inside = grid_border(column, row, grid)
            at = np.where(inside, row * width + column, 0)
            apart = square((-f if other else f) - passing.reshape(-1, 2)[at])
            counts = (corners[other, ..., 1] > -2) & inside & (apart > APART)
            for place, how, name in zip(at[counts], apart[counts], names[counts], strict=True):
                if (how, name) > (furthest[place], source[place]):
                    furthest[place], source[place] = how, name
    return furthest.reshape(height, width), source.reshape(height, width)


def hides(
    flow: Array, back: Array, u: Array, v: Array, way: Array, hidden: Array, share: Array, grid: Sequence[int]
) -> Array:
    """In how many layers `hidden` leads from what it shows to where `way` has its thing."""
    a = np.stack([u, v], -1) - share[..., None] * way
    before, after = a + way - hidden, a + hidden
    first = square(flow_at(flow, before[..., 0], before[..., 1], grid) - hidden) < TRUSTED
    second = square(flow_at(back, after[..., 0], after[..., 1], grid) + hidden) < TRUSTED
    return first.astype(int) + second


def intermediate_choose(
    flow: Array, back: Array, grid: Sequence[int], share: Array, source: Array, passing: Array
) -> tuple[Array, Array]:
    """What is there, and where it is what passes."""
    u, v = (n + 0.5 for n in pixels(grid[0], grid[1]))
    ways = np.concatenate([flow.reshape(-1, 2), -back.reshape(-1, 2)]).astype(np.float64)
    way = ways[np.maximum(source - 1, 0)]
    its, there = (np.maximum(*off(flow, back, u, v, one, share, grid)) for one in (way, passing))
    over = hides(flow, back, u, v, way, passing, share, grid)
    under = hides(flow, back, u, v, passing, way, share, grid)
    seen = (source > 0) & (its < TRUSTED) & ((there >= TRUSTED) | (over > under))
    return np.where(seen[..., None], way, passing), seen


def around(values: Array, grid: Sequence[int]) -> Iterator[tuple[Array, Array]]:
    """Values of each pixel and its eight neighbours, and which of these lie on the grid."""
    x, y = pixels(grid[0], grid[1])
    for j in (-1, 0, 1):
        for i in (-1, 0, 1):
            yield on_grid(values, grid, x + i, y + j)


def intermediate_keep(passing: Array, seen: Array, grid: Sequence[int]) -> Array:
    """Marks of what is alike in enough pixels around."""
    alike = sum(inside & (square(its - passing) < APART) for its, inside in around(passing, grid))
    return (seen != 0) & (alike >= KEEP)


def intermediate_fill(direct: Array, passing: Array, kept: Array, grid: Sequence[int]) -> Array:
    """What passes where it is kept, and its mean beside that."""
    total = sum(its for its, _ in around(passing * kept[..., None], grid))
    number = sum(its for its, _ in around(kept.astype(int), grid))
    beside = ~kept & (number >= GROW)
    result = np.where(kept[..., None], passing, direct)
    return np.where(beside[..., None], total / np.maximum(number, 1)[..., None], result)

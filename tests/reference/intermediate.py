"""Twins of kernels/intermediate.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from reference.common import Array, Numbers, canvas_position, chart_point, grid_border, on_grid, pixels, take
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
    lens: Numbers,
    grid: Sequence[int],
    chart: Numbers,
) -> Array:
    """w_b / (w_a + w_b) in the pixels of the working grid in which a chart's centres lie."""
    u, v = pixels(grid[0], grid[1])
    x, y = canvas_position(chart_point(u + 0.5, v + 0.5, chart), lens)
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


def intermediate_pass(
    flows: tuple[Array, Array], grid: Sequence[int], share: Array, through: Array
) -> tuple[Array, Array]:
    """Both passes over both flows: the largest squared differences, and whose they are."""
    width, height = grid[:2]
    found = np.zeros((height, width)), np.zeros((height, width), np.int64)
    for y in range(height):
        for x in range(width):
            for other in (0, 1):
                _one(x, y, other, flows, grid, share, through, found)
    return found


def _one(x, y, other, flows, grid, share, through, found) -> None:
    """What the flow of one pixel tells others."""
    width, height, wraps, _ = grid
    furthest, source = found
    f = flows[other][y, x].astype(np.float64)
    back = flow_at(flows[1 - other], np.array([x + 0.5 + f[0]]), np.array([y + 0.5 + f[1]]), grid)[0]
    if square(f) <= ALIKE or square(f + back) >= TRUSTED:
        return
    u, v = x + 0.5, y + 0.5
    for _ in range(STEPS):
        column = int(np.floor(u)) % width if wraps else int(np.clip(np.floor(u), 0, width - 1))
        s = float(share[int(np.clip(np.floor(v), 0, height - 1)), column])
        s = 1 - s if other else s
        u, v = x + 0.5 + s * f[0], y + 0.5 + s * f[1]
    for j in (0, 1):
        for i in (0, 1):
            column, row, inside = grid_border(
                np.array(int(np.floor(u - 0.5)) + i), np.array(int(np.floor(v - 0.5)) + j), grid
            )
            if not inside:
                continue
            at = int(row), int(column)
            apart = square((-f if other else f) - through[at])
            name = 1 + y * width + x + other * width * height
            if apart > APART and (apart, name) > (furthest[at], source[at]):
                furthest[at], source[at] = apart, name


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
    flow: Array, back: Array, grid: Sequence[int], share: Array, through: Array, source: Array
) -> tuple[Array, Array]:
    """What passes, and where it is to be seen."""
    u, v = (n + 0.5 for n in pixels(grid[0], grid[1]))
    ways = np.concatenate([flow.reshape(-1, 2), -back.reshape(-1, 2)]).astype(np.float64)
    way = ways[np.maximum(source - 1, 0)]
    its, there = (np.maximum(*off(flow, back, u, v, one, share, grid)) for one in (way, through))
    over = hides(flow, back, u, v, way, through, share, grid)
    under = hides(flow, back, u, v, through, way, share, grid)
    seen = (source > 0) & (its < TRUSTED) & ((there >= TRUSTED) | (over > under))
    return np.where(seen[..., None], way, 0.0), seen


def count(marks: Array, wraps: bool) -> Array:
    """How many of each pixel and its eight neighbours are marked."""
    rows = ndimage.convolve1d(marks.astype(int), [1, 1, 1], axis=0, mode="constant")
    return ndimage.convolve1d(rows, [1, 1, 1], axis=1, mode="wrap" if wraps else "constant")


def intermediate_keep(seen: Array, grid: Sequence[int]) -> Array:
    """Marks of which enough are together."""
    return (seen != 0) & (count(seen != 0, bool(grid[2])) >= KEEP)


def intermediate_settle(through: Array, passing: Array, kept: Array, grid: Sequence[int]) -> Array:
    """What passes where it is kept, and its mean beside that."""
    x, y = pixels(grid[0], grid[1])
    total, number = np.zeros(through.shape), count(kept != 0, bool(grid[2]))
    for j in (-1, 0, 1):
        for i in (-1, 0, 1):
            its, inside = on_grid(passing * (kept != 0)[..., None], grid, x + i, y + j)
            total += its * inside[..., None]
    beside = (kept == 0) & (number >= GROW)
    result = np.where((kept != 0)[..., None], passing, through)
    return np.where(beside[..., None], total / np.maximum(number, 1)[..., None], result)

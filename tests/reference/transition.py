"""Twins of kernels/transition.cl. Shares, and which layers have some, are arrays (layers, height, width)."""

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
    grid_border,
    pixels,
    take,
)

TRACE, WEAKEST = 1e-6, 0.25
TORN = 1.0  # squared strain of a flow
PLAIN, TEXTURED, FAR = 0.012, 0.035, 64.0


def transition_texture(
    layer: Array, box: Sequence[int], border: Sequence[int], cells: Sequence[int], place: Sequence[int]
) -> Array:
    """The steepest slope, by Sobel's operator, of r, g or b in each cell of place (left, top, width, height),
    where all pixels around are valid; those of a layer that goes all round are beside each other at its ends.
    """
    height, width = layer.shape[:2]
    padded = np.pad(np.asarray(layer, np.float64), ((1, 1), (0, 0), (0, 0)))
    all_round = border[2] and width == border[0]
    padded = np.pad(padded, ((0, 0), (1, 1), (0, 0)), "wrap" if all_round else "constant")
    around = {
        (right, down): padded[1 + down : 1 + down + height, 1 + right : 1 + right + width]
        for down in (-1, 0, 1)
        for right in (-1, 0, 1)
    }
    slopes = np.zeros((2, height, width, 3))
    for (right, down), one in around.items():
        slopes[0] += right * (2 - abs(down)) / 8 * one[..., :3]
        slopes[1] += down * (2 - abs(right)) / 8 * one[..., :3]
    valid = np.all([one[..., 3] != 0 for at, one in around.items() if at != (0, 0)], 0)
    steepest = np.where(valid, np.hypot(*slopes).max(-1), 0)
    found = np.zeros((place[3], place[2]))
    for row, column in np.ndindex(*found.shape):
        first, last = (
            [
                max((n + more) * of // to - start, 0)
                for n, of, to, start in zip(
                    (row + place[1], column + place[0]), border[1::-1], cells[1::-1], box[1::-1], strict=True
                )
            ]
            for more in (0, 1)
        )
        found[row, column] = steepest[first[0] : last[0], first[1] : last[1]].max(initial=0)
    return found


def transition_met(
    texture: Array, place: Sequence[int], start: Array, end: Array, border: Sequence[int], lonlat: Array,
    cells: Sequence[int],
) -> Array:  # fmt: skip
    """The largest texture in the cells along straight ways, and beside them.

    start, end: (height, width, 2), working px.
    """
    period = 2 * np.pi / lonlat[1] if lonlat[1] else border[0] * bool(border[2])
    way = end - start
    if period:
        way[..., 0] -= period * np.floor(way[..., 0] / period + 0.5)
    ratio = np.array([cells[0] / border[0], cells[1] / border[1]])
    steps = 1 + np.minimum(np.abs(way * ratio).max(-1), FAR).astype(int)
    met = np.zeros(start.shape[:2])
    for step in range(steps.max() + 1):
        at = np.floor((start + way * np.minimum(step / steps, 1)[..., None]) * ratio).astype(int)
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                x, y, inside = grid_border(at[..., 0] + right, at[..., 1] + down, cells)
                met = np.maximum(met, take(texture, place, x, y, inside))
    return met


def read_flow(flow: Array, grid: Sequence[int], x: Array, y: Array) -> Array:
    """Flow between the pixels of a grid, of those that exist."""
    total, share = bilinear(flow, grid, x, y)
    return total / np.maximum(share, 1e-6)[..., None]


def flow_strain(flow: Array, grid: Sequence[int], x: Array, y: Array) -> Array:
    """The sum of the squares of a flow's four derivatives, over two px, but no more than that of a tear.
    Beyond the centres of the outermost pixels flow goes on as it is there.
    """

    def at(x: Array, y: Array) -> Array:
        x = x if grid[2] else np.clip(x, 0.5, grid[0] - 0.5)
        return read_flow(flow, grid, x, np.clip(y, 0.5, grid[1] - 0.5))

    across, down = (at(x + 1, y) - at(x - 1, y)) / 2, (at(x, y + 1) - at(x, y - 1)) / 2
    return np.minimum((across**2 + down**2).sum(-1), TORN)


def transition_parallax(
    flows: Sequence[Array],
    chart_grid: Sequence[int],
    chart: Numbers,
    masks: Sequence[Array],
    textures: Sequence[tuple[Array, Sequence[int]]],
    border: Sequence[int],
    lonlat: Numbers,
    cells: Sequence[int],
    before: Sequence[Array],
) -> tuple[Array, Array]:
    """The squares of the longest flow of both ways in each cell, and the mean of their squared strain, as far
    as they are seen, or what was `before`, where that is more.

    masks: of both layers, any (height, width) over the same region. textures: with their places.
    """
    lonlat, chart = np.asarray(lonlat, np.float64), np.asarray(chart, np.float64)
    longest, bent = np.zeros((2, *before[0].shape))
    columns, rows = pixels(cells[0], cells[1])
    for down in (0.25, 0.75):
        for right in (0.25, 0.75):
            x, y = (columns + right) / cells[0], (rows + down) / cells[1]
            height, width = masks[0].shape
            there = np.floor(y * height).astype(int), np.floor(x * width).astype(int)
            both = (masks[0][there] != 0) & (masks[1][there] != 0)
            point = canvas_point(x * border[0], y * border[1], lonlat)
            at = chart_position(point, chart)
            for flow in flows:
                found = read_flow(flow, chart_grid, *at) / chart[9:11] / (lonlat[1] or 1)
                longest = np.where(both, np.maximum(longest, (found**2).sum(-1)), longest)
                bent = bent + both * flow_strain(flow, chart_grid, *at) / 8
    x, y = (columns + 0.5) * border[0] / cells[0], (rows + 0.5) * border[1] / cells[1]
    at, met = chart_position(canvas_point(x, y, lonlat), chart), 0.0
    for (texture, place), flow in zip(textures, flows[::-1], strict=True):
        u, v = np.moveaxis(np.stack(at, -1) + read_flow(flow, chart_grid, *at), -1, 0)
        end = np.stack(canvas_position(chart_point(u, v, chart), lonlat), -1)
        seen = transition_met(texture, place, np.stack([x, y], -1), end, border, lonlat, cells)
        met = np.maximum(met, seen)
    share = np.clip((met - PLAIN) / (TEXTURED - PLAIN), 0, 1) ** 2
    return np.maximum(before[0], longest * share), np.maximum(before[1], bent * share)


def transition_refine(coarse: Array, cells: Sequence[int], owns: Array) -> Array:
    """Shares on a finer grid from coarser ones. owns: (layers, height, width), which have some there."""
    height, width = owns.shape[1:]
    columns, rows = pixels(width, height)
    x, y = (columns + 0.5) * cells[0] / width, (rows + 0.5) * cells[1] / height
    read = owns * np.stack([bilinear(one, cells, x, y)[0] + TRACE for one in coarse])
    return read / np.where(owns.any(0), read.sum(0), 1)


def nearest_shares(values: Array) -> Array:
    """The nearest point to `values` of which no part is below 0 and whose sum is 1, by bisection."""
    low, high = values.min() - 1, values.max()
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if np.maximum(values - middle, 0).sum() > 1 else (low, middle)
    return np.maximum(values - low, 0)


def transition_relax(
    share: Array, owns: Array, east: Array, south: Array, well: Array, deep: float, colour: int, over: float
) -> Array:
    """Shares after one step, of the cells (x, y) whose x + y has the parity of `colour`."""
    result = share.astype(np.float64).copy()
    height, width = owns.shape[1:]
    for y, x in np.ndindex(height, width):
        its = np.flatnonzero(owns[:, y, x])
        links = [
            (east[y, x - 1], (y, x - 1)),  # from the first column on to the last one
            (east[y, x], (y, (x + 1) % width)),
            (south[y - 1, x] if y else 0.0, (y - 1, x)),
            (south[y, x], (min(y + 1, height - 1), x)),
        ]
        sum_ = sum(link for link, _ in links)
        if (x + y) % 2 != colour or len(its) < 2 or sum_ <= 0:
            continue
        pulled = sum(link * (share * owns)[its, j, i] for link, (j, i) in links)
        least = pulled / max(sum_ - deep * well[y, x], WEAKEST * sum_)
        own = share[its, y, x].astype(np.float64)
        result[its, y, x] = nearest_shares(own + over * (least - own))
    return result


def transition_expand(
    blend: Array, box: Sequence[int], border: Sequence[int], share: Array, cells: Sequence[int]
) -> Array:
    """w_k of a layer on its box from its share (height, width), where it is neither 0 nor 1."""
    columns, rows = pixels(box[2], box[3], box[0], box[1])
    x, y = (columns + 0.5) * cells[0] / border[0], (rows + 0.5) * cells[1] / border[1]
    w = np.maximum(bilinear(share, cells, x, y)[0], TRACE)
    return np.where((blend > 0) & (blend < 1), w, blend.astype(np.float64))

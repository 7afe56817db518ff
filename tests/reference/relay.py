"""Twins of kernels/relay.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import (
    Array,
    Numbers,
    bilinear,
    chart_point,
    chart_position,
    four_taps,
    grid_border,
    on_grid,
    pixels,
)
from reference.consistency import EXCLUDED

MOST = 0.3


def _shown(brightness: Array) -> Array:
    return (brightness != 0) & (brightness < EXCLUDED)


def seen(other: Array, flow: Array, grid: Sequence[int]) -> tuple[Array, Array]:
    """What the other layer shows where flow leads from each pixel, and whether that is known."""
    columns, rows = pixels(grid[0], grid[1])
    total, known = np.zeros(columns.shape), np.ones(columns.shape, bool)
    for column, row, weight in four_taps(columns + 0.5 + flow[..., 0], rows + 0.5 + flow[..., 1]):
        found, inside = on_grid(other[..., 3], grid, column, row)
        known &= (inside > 0) & _shown(found)
        total += weight * found
    return total, known


def relay_cells(found: Array, other: Array, grid: Sequence[int], cell: int, noise: float) -> Array:
    """(height, width, 4) of cells: flow in their middles, its trust in the overlap, else -1, and its fit
    around, -1 where that is not known.
    """
    found, other = found.astype(np.float64), other.astype(np.float64)
    there, known = seen(other, found, grid)
    own = found[..., 3]
    known &= _shown(own)
    off = own - there
    result = np.empty((-(-grid[1] // cell), -(-grid[0] // cell), 4))
    for y, x in np.ndindex(result.shape[:2]):
        row, column = min(y * cell + cell // 2, grid[1] - 1), min(x * cell + cell // 2, grid[0] - 1)
        step = np.arange(-cell, cell, 2)
        columns, rows, inside = grid_border(*np.meshgrid(column + step, row + step), grid)
        at = rows[inside], columns[inside]
        at = tuple(axis[known[at]] for axis in at)
        fit = -1.0
        if len(at[0]) >= 0.2 * cell * cell:
            texture, misfit = (
                np.mean(np.clip(values[at] - values[at].mean(), -MOST, MOST) ** 2) for values in (own, off)
            )
            fit = ((texture + noise**2) / (texture + noise**2 + 2 * misfit)) ** 4
        here = found[row, column]
        both = _shown(here[3]) and other[row, column, 3] != 0
        result[y, x] = [*here[:2], here[2] if both else -1, fit]
    return result


def _follow(
    found: Array, back: Array, cells: Array, grid: Sequence[int], cell: int, u: Array, v: Array
) -> tuple[Array, Array, Array]:
    """Where flow leads from chart positions, and how far it is believed."""
    inside = (u >= 0) & (v >= 0) & (u < grid[0]) & (v < grid[1])
    weighted = np.dstack([found[..., :2] * found[..., 2:3], found[..., 2]]).astype(np.float64)
    total, share = bilinear(weighted, grid, u, v)
    total = total / np.maximum(share, 1e-9)[..., None]
    columns, rows = (np.where(inside, axis, 0).astype(int) for axis in (u, v))
    both = (found[rows, columns, 3] != 0) & (back[rows, columns, 3] != 0)
    trust = np.where(inside & both, total[..., 2], 0)
    flow = total[..., :2] / np.where(trust > 0, trust, 1)[..., None]
    return u + flow[..., 0], v + flow[..., 1], trust * cells[rows // cell, columns // cell, 3]


def relay_add(
    first: tuple[Array, Array, Array, Sequence[int], Numbers],
    second: tuple[Array, Array, Array, Sequence[int], Numbers],
    cell: int,
    grid: Sequence[int],
    chart: Numbers,
    step: int,
    share: float,
) -> Array:
    """Weighted flow by way of another layer, and weights, (height, width, 4), at every step-th pixel; each
    part is found flow, that back, its cells, its grid and its chart.
    """
    places = [np.minimum(np.arange(-(-n // step)) * step + step // 2, n - 1) + 0.5 for n in grid[:2]]
    x, y = np.meshgrid(*places)
    u, v = chart_position(chart_point(x, y, chart), first[4])
    u, v, weight = _follow(*first[:4], cell, u, v)
    u, v = chart_position(chart_point(u, v, first[4]), second[4])
    u, v, more = _follow(*second[:4], cell, u, v)
    weight = share * weight * more
    u, v = chart_position(chart_point(u, v, second[4]), chart)
    across, down = u - x, v - y
    period = 2 * np.pi * chart[9] if chart[13] else chart[14] * chart[9]
    if period:
        across = (across + period / 2) % period - period / 2
    return np.stack([weight * across, weight * down, weight, np.zeros_like(weight)], -1)


def _agreement(off: Array, agrees: float) -> Array:
    """How ways agree that lie so far apart, (..., 2) px."""
    return (1 + (np.linalg.norm(off, axis=-1) / agrees) ** 2) ** -2.0


def relay_hold(points: Array, sigma: float, agrees: float, found: Array, grid: Sequence[int]) -> Array:
    """How far control points hold flow, (height, width)."""
    x, y = np.meshgrid(np.arange(grid[0]) + 0.5, np.arange(grid[1]) + 0.5)
    holds = [np.zeros(x.shape)]
    for u, v, *move in np.asarray(points, np.float64):
        across = (x - u + grid[0] / 2) % grid[0] - grid[0] / 2 if grid[2] else x - u
        near = np.exp(-0.5 * (across**2 + (y - v) ** 2) / sigma**2)
        holds.append(near * _agreement(found[..., :2] - move, agrees))
    return np.max(holds, axis=0)


def relay_take(total: Array, enough: float, agrees: float, counts: float, found: Array) -> Array:
    """Found flow as far as it is trusted and others agree, theirs for the rest, with their trust;
    as found where control points hold it, or one layer is taken whole.
    """
    held = total[..., 3]
    told, own = (1 - held * found[..., 2]) * np.minimum(total[..., 2] / enough, 1), found[..., :2]
    other = total[..., :2] / np.maximum(total[..., 2], 1e-9)[..., None]
    agreement = _agreement(other - own, agrees)
    kept = np.maximum(counts, held) * found[..., 2] * (1 - told * (1 - agreement))
    taken = told * (1 - kept)
    mixed = (kept[..., None] * own + taken[..., None] * other) / np.maximum(kept + taken, 1e-9)[..., None]
    flow = np.where((taken > 0)[..., None], mixed, own)
    changed = np.dstack([flow, kept + taken, found[..., 3]])
    return np.where((found[..., 3] < EXCLUDED)[..., None], changed, found)

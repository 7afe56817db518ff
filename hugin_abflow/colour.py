"""Smooth exposure and colour correction of each layer (kernels/colour.cl).

One gain field per layer and channel on a coarse grid, on the exposure scale of common.cl (log odds of integer
images, log of floats): where layers overlap, the corrected layers agree; from there the correction spreads
through each layer, smoothly, and fades out. It is the minimum of

    sum_pairs c (g_a - g_b + d_ab)^2  +  sum_k |grad g_k|^2  +  g_k^2 / fade^2

with d_ab the measured difference of the aligned layers: a sparse linear system, solved directly. Where there
is no difference it is exactly zero.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import splu

from hugin_abflow.coefficient import on_cells
from hugin_abflow.geometry import Pair
from hugin_abflow.layer import Layer
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.settings import Settings
from hugin_abflow.working import Grid, WorkingLayer

# Working pixels per cell of the colour grid.
_CELL = 16
# Layers that lie on each other, by their cubic mean: from here on cells grow with them, because the solution
# takes time by cells^1.5 and layers^3.
_DEEP = 4.0
# Samples brighter than this, of full scale, may be clipped and measure nothing (integer images only).
_CLIPPED = 0.98
# Standard deviation of the differences within a cell that halves its trust, on the exposure scale.
_SPREAD = 0.3
# Rounds of (weight of the measured differences against smoothness, distance from the solution at which a cell
# counts no longer): what is smooth is followed bit by bit.
_ROUNDS = ((0.1, 4.0), (1.0, 3.0), (100.0, 2.5))
# The same, slower and stricter: what lies far from it is no exposure but something that only one layer shows.
_STRICT = ((0.01, 4.0), (0.03, 2.5), (0.3, 1.6), (3.0, 1.2), (100.0, 1.0))
# The correction fades out over this share of the canvas's width; a trend hardly does.
_FADE, _TREND_FADE = 0.12, 1.0
# All gains shrink towards 0 by this, at most a quarter of an 8-bit level, so that small ones are exactly 0.
_NEGLIGIBLE = 1e-3

# Of two layers, by their indices, a - b per cell of the colour grid, on the exposure scale:
# (height, width, 4), r, g, b and a weight 0..1.
Difference = tuple[int, int, npt.NDArray[np.float64]]


@dataclass(frozen=True)
class Correction:
    """grid: the colour grid. gains: per layer, float32 (height, width, 4) on the exposure scale: r, g, b and
    an unused 0; None: no correction.
    """

    grid: Grid
    gains: tuple[Buffer | None, ...]


def colour_grid(grid: Grid, covered: npt.NDArray[np.bool_]) -> Grid:
    """The coarse grid over the region of `grid`; covered: (layers, height, width), of any grid over it."""
    depth = np.cbrt(np.mean(covered.sum(0, dtype=np.float64) ** 3))
    return grid.coarser(max(_CELL, round(_CELL * depth / _DEEP)))


def clipping(layer: Layer) -> float:
    """The share of full scale above which a layer's samples may be clipped; floats never are."""
    return _CLIPPED if layer.dtype.kind == "u" else math.inf


def differences(
    device: Device,
    layers: Sequence[WorkingLayer],
    fields: Sequence[Buffer],
    pairs: Sequence[Pair],
    grid: Grid,
    covered: npt.NDArray[np.bool_],
) -> list[Difference]:
    """Measure the overlaps of the aligned layers. fields: of geometry.py, whose weights do not count here.
    covered: (layers, height, width) on any grid over the same region.
    """
    cells = colour_grid(grid, covered)
    return [(pair.a, pair.b, _difference(device, layers, fields, pair, grid, cells)) for pair in pairs]


def correction(
    device: Device,
    measured: Sequence[Difference],
    grid: Grid,
    covered: npt.NDArray[np.bool_],
    settings: Settings,
    ignored: npt.NDArray[np.bool_] | None = None,
    strict: bool = False,
) -> Correction:
    """Solve for the gains of all layers.

    measured, covered: of `differences`.
    ignored: (height, width) on any grid over the same region: what is no evidence, none of a cell's.
    strict: leave out what may not be exposure, to see it.
    With `settings.exposure` off there is no correction.
    """
    cells = colour_grid(grid, covered)
    if not settings.exposure:
        return Correction(cells, (None,) * len(covered))
    if ignored is not None:
        counts = ~on_cells(ignored[None], cells, np.logical_or)[0]
        measured = [(a, b, values * counts[..., None]) for a, b, values in measured]
    if not any(np.any(d[..., :3] * d[..., 3:]) for _, _, d in measured):
        return Correction(cells, (None,) * len(covered))
    inside = on_cells(covered, cells, np.logical_or)
    gains = solve(measured, inside, cells, _STRICT if strict else _ROUNDS)
    gains = np.sign(gains) * np.maximum(np.abs(gains) - _NEGLIGIBLE, 0)
    result: list[Buffer | None] = []
    for gain, mask in zip(gains, inside, strict=True):
        if not gain.any():
            result.append(None)
            continue
        packed = np.zeros((*cells.shape, 4), np.float32)
        packed[..., :3] = _extend(gain, mask, cells.wraps)
        result.append(device.upload(packed))
    return Correction(cells, tuple(result))


def _difference(
    device: Device,
    layers: Sequence[WorkingLayer],
    fields: Sequence[Buffer],
    pair: Pair,
    grid: Grid,
    cells: Grid,
) -> npt.NDArray[np.float64]:
    """Difference a - b of a pair's aligned layers on the exposure scale, per cell of the grid `cells`.

    (height, width, 4): r, g, b and a weight 0..1: the share of the cell's pixels that both layers show
    unclipped, less where their differences scatter.
    """
    a, b = layers[pair.a], layers[pair.b]
    integer = a.layer.dtype.kind == "u"
    values = device.empty((*cells.shape, 4))
    device.run(
        "colour", "colour_difference", cells.border[:2],
        a.pixels, fields[pair.a], a.box, b.pixels, fields[pair.b], b.box, grid.border, grid.lens,
        cells.border, int(integer), clipping(a.layer), _SPREAD, values,
    )  # fmt: skip
    return values.get().astype(np.float64)


def solve(
    measured: Sequence[Difference],
    inside: npt.NDArray[np.bool_],
    cells: Grid,
    rounds: Sequence[tuple[float, float]] = _ROUNDS,
) -> npt.NDArray[np.float64]:
    """Gains (layers, height, width, 3) for differences."""
    latitude = cells.lens[2] - (np.arange(cells.height) + 0.5) * cells.lens[3]
    area = np.maximum(np.cos(latitude), 0.02)[:, None] if cells.lens[1] else np.ones((cells.height, 1))
    # a cell's sides: steps along a row are shorter near a pole, so neighbours there are bound closer
    east = (inside & np.roll(inside, -1, 2)) / area
    if not cells.wraps:
        east[:, :, -1] = 0
    south = np.zeros(inside.shape)
    south[:, :-1] = (inside[:, :-1] & inside[:, 1:]) * np.sqrt(area[:-1] * area[1:])
    number = np.cumsum(inside).reshape(inside.shape) - 1  # of a layer's cell among the unknowns
    count = int(np.count_nonzero(inside))
    step, stiffness = _steps(
        [(number, np.roll(number, -1, 2), east), (number, np.roll(number, -1, 1), south)], count
    )
    # what a layer is measured to be beside its own cells binds nothing else
    evidence = [d[..., 3] * area * (inside[a] & inside[b]) for a, b, d in measured]
    link, weight = _steps(
        [(number[a], number[b], e) for (a, b, _), e in zip(measured, evidence, strict=True)], count
    )
    difference = np.concatenate([d[e > 0, :3] for (_, _, d), e in zip(measured, evidence, strict=True)])
    smooth = step.T @ diags_array(stiffness) @ step
    round_ = cells.circumference / (cells.lens[1] or 1.0)  # cells
    solution = np.zeros((count, 3))
    for data, limit in rounds:
        fade = _TREND_FADE if rounds is _STRICT and data < rounds[-1][0] else _FADE
        hold = (inside * area)[inside] / max(1.0, fade * round_) ** 2
        off = np.linalg.norm(link @ solution + difference, axis=1) if solution.any() else 0.0
        trusted = data * weight * np.maximum(0.0, 1 - (off / limit) ** 2) ** 2  # Tukey's biweight
        matrix = diags_array(hold) + smooth + link.T @ diags_array(trusted) @ link
        factors = splu(matrix.tocsc(), "MMD_AT_PLUS_A", diag_pivot_thresh=0, options={"SymmetricMode": True})
        solution = factors.solve(-(link.T @ (trusted[:, None] * difference)))
    result = np.zeros((*inside.shape, 3))
    result[inside] = solution
    return result


def _steps(
    weighted: Sequence[tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], npt.NDArray[np.float64]]], count: int
) -> tuple[csr_array, npt.NDArray[np.float64]]:
    """A matrix (n, count) that takes differences of `count` unknowns, and the weights (n,) of these.

    weighted    arrays of one shape: the unknown to take, the one to subtract, the weight; 0: no row.
    """
    taken, less, weights = (np.concatenate([entry[k][entry[2] > 0] for entry in weighted]) for k in range(3))
    rows = np.arange(weights.size)
    signs = np.repeat([1.0, -1.0], rows.size)
    places = np.tile(rows, 2), np.concatenate([taken, less])
    return csr_array((signs, places), shape=(rows.size, count)), weights


def _extend(
    gain: npt.NDArray[np.float64], mask: npt.NDArray[np.bool_], wraps: bool
) -> npt.NDArray[np.float64]:
    """Carry gains two cells beyond the layer, so that interpolation at its border finds no zeros."""
    known = mask.astype(np.float64)
    rows, columns = known.shape
    value = gain * known[..., None]
    for _ in range(2):
        sums, weights = np.zeros_like(value), np.zeros_like(known)
        around_w, around_v = np.pad(known, 1), np.pad(value, [(1, 1), (1, 1), (0, 0)])
        if wraps:
            around_w[1:-1, 0], around_w[1:-1, -1] = known[:, -1], known[:, 0]
            around_v[1:-1, 0], around_v[1:-1, -1] = value[:, -1], value[:, 0]
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                sums += around_v[1 + dy : 1 + dy + rows, 1 + dx : 1 + dx + columns]
                weights += around_w[1 + dy : 1 + dy + rows, 1 + dx : 1 + dx + columns]
        new = (known == 0) & (weights > 0)
        value[new] = sums[new] / weights[new][:, None]
        known[new] = 1
    return value

"""What flow cannot explain is taken from one layer, whole (kernels/seam.cl).

Somebody who walked, or a near thing that hides another part of the scene for each camera, leaves aligned
layers that differ although exposure is corrected. In each connected region of such cells every cell is given
to one layer: the one that the softmax favours, with cuts between layers, and at the layers' own
borders, where they show least. This is a labelling of least energy,

    sum_cells (r (1 - s_k) + h e_k)  +  sum_neighbours c (t + t') / 2 [k != k']  +  sum_borders c t

with r the residual of low frequencies, averaged over the cells around, t that of all, not averaged, s_k the
share of the softmax, c the price of a cut (labelling.py), and h that of what layer k clips of what another
one, as bright, still shows, e_k. A cut through somebody who is as bright as what is behind shows in t alone.
Regions keep to themselves: elsewhere the softmax stays as it is, and the transition lies where the layers
agree. What is clipped in one photo only is no such difference: it is brighter in the other by an unknown
amount, and changes over best where it does so slowly.

Where there is no flow, layers are not aligned, and each overlap is such a region, whole: on finer cells, with
the mean square of the difference in place of r and t, since fine texture is as much in the way, and with
narrow transitions; multiband.py blends low frequencies across them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from hugin_abflow.cells import averaged, grown, neighbours
from hugin_abflow.coefficient import Masks, on_cells
from hugin_abflow.colour import Correction, clipping
from hugin_abflow.geometry import Pair
from hugin_abflow.labelling import Graph, energy, least
from hugin_abflow.layer import Box
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.working import Grid, Place, WorkingLayer, connected, shared_cells

# Working pixels per cell of the seam grid.
_CELL = 8
# Without flow.
_FINE_CELL = 4
# Cells over which differences are averaged: texture that is a little off is no reason to cut; and how far.
_SIGMA, _REACH = 1.0, 3
# Residual of low frequencies, of full scale, that makes a region one layer's, and that of its outskirts.
# Where that of all frequencies reaches the first there are outskirts as well.
_STRONG, _WEAK = 0.2, 0.045
# From the first less this to it and this more, a cell counts from not at all to wholly as strong.
_DOUBT = 0.05
# Strong cells, of the equator's size, that a region has at least: fewer are an edge that is a pixel off.
_LEAST = 4.5
# Price of a cut, in cells: what is cut off must be favoured by the softmax over this depth, times t / r.
_CUT = 10.0
# The same without flow, where the softmax has little to say: overlaps are some hundred cells wide.
_FINE_CUT = 120.0
# Residual of layers that agree, without flow: of two cuts that nobody sees the shorter one is taken.
_SHORTER = 0.005
# No layer is taken where it is not.
_FORBIDDEN = 1e4
# Price of a cell that is clipped, and is not in another layer, as of a residual that nothing favours; and by
# how much, of full scale, that may be darker: what is white here and darker there is something else.
_CLIPPED, _DARKER = 0.5, 0.05
# What is left of a layer's weight where it yields: a pixel that no other layer can fill stays opaque.
_TRACE = 1e-12
# How much more a region may cost if that shows things once and whole, from a layer that has most of it: where
# flow tells that something moved, and anywhere.
_ONCE, _WHOLE, _MOSTLY = 2.0, 1.65, 0.5


Cells = npt.NDArray[np.bool_]  # (height, width) on the seam grid
Prices = npt.NDArray[np.float64]  # (layers, height, width) on the seam grid


@dataclass(frozen=True)
class Residuals:
    """How far aligned, corrected layers differ, float64 (height, width) on the seam grid: the largest of
    any pair and channel, 0 where no two lie.

    mean    r: of their low frequencies.
    rms     t: of all, of each cell by itself. What is strong, averaged, would fill a gap beside it, and a cut
            through somebody's chin be as cheap as one below. In `divide` both are the mean square, on finer
            cells.
    around  of all, averaged as r is, for the outskirts of regions. None: t.
    told    where any pair has pixels to compare: none are where layers are clipped, or sampled beyond their
            borders. None: everywhere.
    """

    mean: npt.NDArray[np.float64]
    rms: npt.NDArray[np.float64]
    told: Cells | None = None
    around: npt.NDArray[np.float64] | None = None


def seam_grid(grid: Grid) -> Grid:
    """The grid of the regions, over the working grid's region."""
    return grid.coarser(_CELL)


def residuals(
    device: Device,
    layers: Sequence[WorkingLayer],
    fields: Sequence[Buffer],
    pairs: Sequence[Pair],
    correction: Correction,
    grid: Grid,
) -> Residuals:
    """What flow and exposure do not explain."""
    cells = seam_grid(grid)
    mean, square, around = (np.zeros(cells.shape) for _ in range(3))
    told = np.zeros(cells.shape, bool)
    clipped = [clipping(layer) for layer in layers]
    for its, found in _differences(device, layers, fields, pairs, correction, grid, cells, clipped):
        share = found[..., 4:]
        smooth = _smooth(np.concatenate([found[..., :4] * share, share], -1), cells)
        smooth = (share > 0) * smooth[..., :4] / np.where(share > 0, smooth[..., 4:], 1)
        mean[its] = np.maximum(mean[its], np.abs(smooth[..., :3]).max(-1))
        square[its] = np.maximum(square[its], found[..., 3])
        around[its] = np.maximum(around[its], smooth[..., 3])
        told[its] |= share[..., 0] > 0
    return Residuals(mean, np.sqrt(square), told, np.sqrt(around))


def lost(
    device: Device,
    layers: Sequence[WorkingLayer],
    fields: Sequence[Buffer],
    pairs: Sequence[Pair],
    correction: Correction,
    clipped: npt.NDArray[np.float32],
    grid: Grid,
) -> Prices | None:
    """What it costs to take what one layer shows clipped, and another one as bright, but not clipped; None:
    nothing anywhere.

    clipped     how much each layer clips of what another one shows (`highlights.Clipped`).
    """
    if not clipped.any():
        return None
    cells = seam_grid(grid)
    told = np.zeros((len(layers), *cells.shape), bool)
    all_tells = [(math.inf,) * 4] * len(layers)
    differences = _differences(device, layers, fields, pairs, correction, grid, cells, all_tells)
    for pair, (its, found) in zip(pairs, differences, strict=True):
        brighter, both = found[..., :3].mean(-1), found[..., 4] > 0
        told[pair.a][its] |= both & (brighter < _DARKER)
        told[pair.b][its] |= both & (-brighter < _DARKER)
    row, column = _centres(cells, clipped.shape)
    prices: Prices = _CLIPPED * told * clipped[:, row[:, None], column]
    return prices


def regions(residual: Residuals, grid: Grid, aligned: bool = True, once: Cells | None = None) -> Cells:
    """Where layers differ too much to be blended, of the same shape; unless they are aligned, texture differs
    everywhere and tells nothing. once: cells that belong to a region whatever the layers show there.
    """
    residual = residual if aligned else Residuals(residual.mean, residual.mean)
    found = _regions(residual, seam_grid(grid), np.zeros(residual.mean.shape, bool) if once is None else once)
    return np.logical_or.reduce(found) if found else np.zeros(residual.mean.shape, bool)


def cut(
    device: Device,
    layers: Sequence[WorkingLayer],
    fields: Sequence[Buffer],
    residual: Residuals,
    whole: Cells,
    masks: Masks,
    grid: Grid,
    once: Cells | None = None,
    lost: Prices | None = None,
) -> npt.NDArray[np.intp]:
    """Give each cell of the regions `whole` to one layer: the others lose their colour weight there
    (fields[...].w, in place). A region is cut in two only if that is clearly better, one that has cells of
    `once` if it is much better. lost: what each layer costs in a cell besides.

    Returns the layer of each cell, (height, width) on the seam grid, elsewhere that which weighs most, -1
    where none covers it.
    """
    cells = seam_grid(grid)
    dearer = np.full(whole.shape, _WHOLE) if once is None else np.where(once, _ONCE, _WHOLE)
    owner = _owners(layers, fields, residual, whole, masks, grid, cells, _CUT, dearer, lost)
    yields = [yielded(whole, owner, k, cells.wraps) for k in range(len(layers))]
    _yield(device, layers, fields, yields, grid, cells)
    return owner


def yielded(whole: Cells, owner: npt.NDArray[np.intp], k: int, wraps: bool) -> npt.NDArray[np.float32]:
    """How much layer k yields in each cell, 0..1: outlines are softened over a cell to each side, those of
    regions a cell beyond, since what ends there may have nearly all of the softmax's weight.
    """
    others = whole & (owner != k)
    beyond = grown(others, 1, wraps) & ~whole
    return np.ascontiguousarray(averaged((others | beyond).astype(np.float32), wraps))


def divide(
    device: Device,
    layers: Sequence[WorkingLayer],
    fields: Sequence[Buffer],
    pairs: Sequence[Pair],
    correction: Correction,
    masks: Masks,
    grid: Grid,
) -> None:
    """Give each cell of every overlap of layers that are not aligned to one layer, as `cut` does."""
    cells = grid.coarser(_FINE_CELL)
    square = np.zeros(cells.shape)
    all_tells = [(math.inf,) * 4] * len(layers)
    for its, found in _differences(device, layers, fields, pairs, correction, grid, cells, all_tells):
        told = found[..., 4] > 0
        square[its] = np.maximum(square[its], np.where(told, _SHORTER + found[..., 3], 0))
    whole = square > 0
    owner = _owners(layers, fields, Residuals(square, square), whole, masks, grid, cells, _FINE_CUT)
    yields = [(whole & (owner != k)).astype(np.float32) for k in range(len(layers))]
    _yield(device, layers, fields, yields, grid, cells)


def _owners(
    layers: Sequence[WorkingLayer],
    fields: Sequence[Buffer],
    residual: Residuals,
    whole: npt.NDArray[np.bool_],
    masks: Masks,
    grid: Grid,
    cells: Grid,
    cut_price: float,
    dearer: npt.NDArray[np.float64] | None = None,
    lost: Prices | None = None,
) -> npt.NDArray[np.intp]:
    """The layer of each cell, (height, width): in the regions `whole` the one it is taken from, elsewhere the
    one that the softmax favours, -1 where none is. dearer: see `label`, of a region the most.
    """
    cover = on_cells(masks.host, cells, np.logical_and)
    residual = _completed(residual, cover, cells.wraps)
    shares = np.stack(
        [_at_centres(f.get()[..., 3], k.box, grid, cells) for f, k in zip(fields, layers, strict=True)]
    )
    shares /= np.maximum(shares.sum(0), 1e-12)
    owner = np.where(cover.any(0), (shares * cover).argmax(0), -1)
    for region in _connected(whole, cells.wraps):
        rows, columns = np.nonzero(region)
        more = None if dearer is None else float(dearer[region].max())
        owner[rows, columns] = label(
            rows, columns, residual, shares, cover, cells.wraps, cut_price, more, lost
        )
    return owner


def _completed(residual: Residuals, cover: npt.NDArray[np.bool_], wraps: bool) -> Residuals:
    """With the nearest cell's residual in cells that nothing tells of, from a layer's border on: things are
    moved away from there, and a cut would cost nothing, and leave half of somebody.

    cover       (layers, height, width): the cells that each of them covers.
    """
    if residual.told is None or not residual.told.any():
        return residual
    by = residual.told.shape[1] // 2 if wraps else 0
    around = [(0, 0), (by, by)]
    cover = np.pad(cover, [(0, 0), *around], mode="wrap")
    told = np.pad(residual.told, around, mode="wrap")
    borders = [one & scipy.ndimage.binary_dilation(~one, np.ones((3, 3))) for one in cover]
    missing = (cover.sum(0) > 1) & ~told
    missing = scipy.ndimage.binary_propagation(np.any(borders, 0) & missing, np.ones((3, 3)), missing)
    nearest = scipy.ndimage.distance_transform_edt(~told, return_distances=False, return_indices=True)

    def completed(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        values = np.pad(values, around, mode="wrap")
        whole = np.where(missing, values[tuple(nearest)], values)
        return whole[:, by : whole.shape[1] - by]

    return Residuals(completed(residual.mean), completed(residual.rms))


def _yield(
    device: Device,
    layers: Sequence[WorkingLayer],
    fields: Sequence[Buffer],
    yields: Sequence[npt.NDArray[np.float32]],
    grid: Grid,
    cells: Grid,
) -> None:
    """Take the layers' colour weight away where they yield."""
    for layer, field, one in zip(layers, fields, yields, strict=True):
        if one.any():
            there = device.upload(one)
            device.run(
                "seam", "seam_yield", layer.box[2:],
                field, layer.box, grid.border, there, cells.border, _TRACE,
            )  # fmt: skip


def _differences(
    device: Device,
    layers: Sequence[WorkingLayer],
    fields: Sequence[Buffer],
    pairs: Sequence[Pair],
    correction: Correction,
    grid: Grid,
    cells: Grid,
    clipped: Sequence[tuple[float, ...]],
) -> Iterator[tuple[tuple[slice, slice], npt.NDArray[np.float64]]]:
    """Of each two corrected layers, rows and columns of the cells that both may be in, and of these
    (height, width, 5): the mean of the layers' difference in r, g, b and the largest mean square of these,
    where neither is brighter than `clipped`, and the share of the pixels that tell.
    """
    none = device.zeros((*correction.grid.shape, 4))

    def start(pair: Pair) -> tuple[Box, Buffer, Buffer]:
        part = shared_cells(layers[pair.a], layers[pair.b], grid, cells)
        difference = device.empty((part.height, part.width, 4))
        square = device.empty((part.height, part.width))
        sides: list[Any] = []
        for k in (pair.a, pair.b):
            sides += [layers[k].pixels, fields[k], layers[k].box, correction.gains[k] or none]
        device.run(
            "seam", "seam_difference", (part.width, part.height), *sides, grid.border, grid.lens,
            correction.grid.border, cells.border, part.place, correction.shoulder, clipped[pair.a],
            clipped[pair.b], difference, square,
        )  # fmt: skip
        return part, difference, square

    def fetch(
        part: Box, difference: Buffer, square: Buffer
    ) -> tuple[tuple[slice, slice], npt.NDArray[np.float64]]:
        mean = difference.get()
        found = np.dstack([mean[..., :3], square.get(), mean[..., 3]]).astype(np.float64)
        return part.slices, found

    if not pairs:
        return
    started = start(pairs[0])
    for pair in pairs[1:]:
        found = fetch(*started)
        started = start(pair)  # the device goes on while the caller looks at what is found
        device.flush()
        yield found
    yield fetch(*started)


def _smooth(values: npt.NDArray[np.float64], cells: Grid) -> npt.NDArray[np.float64]:
    """A Gaussian of _SIGMA cells, not normalised at the borders, of some of a grid's columns side by side."""
    columns = values.shape[1]
    gap = min(_REACH, cells.width - columns)  # what is between its ends if columns wrap, and matters
    values = np.pad(values, ((0, 0), (0, gap), (0, 0)))
    modes = ("constant", "wrap" if cells.wraps else "constant", "constant")
    smooth = scipy.ndimage.gaussian_filter(values, (_SIGMA, _SIGMA, 0), mode=modes, radius=_REACH)
    return np.asarray(smooth[:, :columns])


def _regions(residual: Residuals, cells: Grid, once: Cells) -> list[Cells]:
    """Connected outskirts that hold enough of strong residual, or anything of `once`, grown by a cell."""
    around = residual.rms if residual.around is None else residual.around
    weak = (residual.mean > _WEAK) | (around > _STRONG) | once
    strong = np.interp(residual.mean, (_STRONG - _DOUBT, _STRONG + _DOUBT), (0, 1))
    strong *= cells.row_widths[:, None]
    return [
        region
        for region in _connected(grown(weak, 1, cells.wraps), cells.wraps)
        if strong[region].sum() >= _LEAST or once[region].any()
    ]


def _connected(mask: npt.NDArray[np.bool_], wraps: bool) -> list[npt.NDArray[np.bool_]]:
    """The connected parts of a mask."""
    labels = connected(mask, wraps)
    return [labels == k for k in np.unique(labels[mask])]


def label(
    rows: npt.NDArray[np.intp],
    columns: npt.NDArray[np.intp],
    residual: Residuals,
    shares: npt.NDArray[np.float64],
    cover: npt.NDArray[np.bool_],
    wraps: bool,
    cut_price: float = _CUT,
    dearer: float | None = None,
    lost: Prices | None = None,
) -> npt.NDArray[np.intp]:
    """Which layer each cell (rows, columns) of a region is taken from: the least energy found.

    shares, cover: shares of the softmax and coverage (layers, height, width).
    cut_price: of a cut, in cells.
    lost: what each layer costs in a cell besides (layers, height, width).
    dearer: one layer is taken, as far as it goes, if that costs no more than so many times as much (None: it
    is not asked). Somebody may stand there twice, and a cut between his two places, or where these overlap,
    is as cheap as one beside him.
    """
    candidates = np.flatnonzero(cover[:, rows, columns].any(1))
    if candidates.size < 2:
        return np.full(rows.size, candidates[0] if candidates.size else 0)
    weight, rough = residual.mean[rows, columns], residual.rms[rows, columns]
    present = cover[candidates][:, rows, columns]
    price = np.where(present, weight * (1 - shares[candidates][:, rows, columns]), _FORBIDDEN)
    if lost is not None:
        price += lost[candidates][:, rows, columns]
    number = np.full(residual.mean.shape, -1)
    number[rows, columns] = np.arange(rows.size)
    links = []
    for down, right in ((0, 1), (1, 0), (0, -1), (-1, 0)):
        inside, there = neighbours(rows + down, columns + right, residual.mean.shape, wraps)
        # a layer's own border is a cut as well, where the union goes on
        price += cut_price * rough * (inside & cover[:, *there].any(0) & ~cover[candidates][:, *there])
        if down + right > 0:
            linked = np.flatnonzero(inside & (number[there] >= 0))
            links.append(np.stack([linked, number[there][linked]]))
    first, second = np.concatenate(links, 1)
    cuts = cut_price * (rough[first] + rough[second]) / 2
    graph = Graph(rows, columns, price, present, first, second, cuts)
    labels = least(graph)
    if dearer is not None:
        somewhere = replace(graph, price=np.where(present.any(0), price, 0.0))
        alone = [np.where(one, k, labels) for k, one in enumerate(present) if one.mean() > _MOSTLY]
        energies = [energy(somewhere, one) for one in (labels, *alone)]
        if alone and min(energies[1:]) <= dearer * energies[0]:
            labels = alone[int(np.argmin(energies[1:]))]
    return candidates[labels]


def _centres(cells: Grid, shape: Sequence[int]) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Rows and columns, of an array (..., height, width) over the same region, at the centres of cells."""
    row, column = (
        ((np.arange(to) + 0.5) * of / to).astype(np.intp)
        for to, of in zip(cells.shape, shape[-2:], strict=True)
    )
    return row, column


def _at_centres(
    weights: npt.NDArray[np.float32], box: Place, grid: Grid, cells: Grid
) -> npt.NDArray[np.float64]:
    """Weights at the cells' centres; 0 outside the layer's box."""
    left, top, width, height = box
    rows, columns = _centres(cells, grid.shape)
    rows, columns = rows - top, columns - left
    row_inside, column_inside = (rows >= 0) & (rows < height), (columns >= 0) & (columns < width)
    result = np.zeros(cells.shape)
    result[np.ix_(row_inside, column_inside)] = weights[np.ix_(rows[row_inside], columns[column_inside])]
    return result

"""What flow cannot explain is taken from one layer, whole (kernels/seam.cl).

Somebody who walked, or a near thing that hides another part of the scene for each camera, leaves aligned
layers that differ although exposure is corrected. Each region of such cells is given to one layer, or cut
between layers where the cut shows least (regions.py). Nothing changes outside the regions: there the softmax
stays as it is, and layers agree.

What is clipped in one photo only is no such difference: the other one shows it brighter by an unknown
amount, and a slow transition suits it best. But if the other photo is so dark there that this one would
certainly not clip, it shows something else, such as no white van.

Without flow layers are not aligned, and each overlap is such a region, whole. Then cells are finer, the mean
square of the difference takes the place of r and t, since differences of fine texture are as much in the
way, and transitions are narrow. Low frequencies are blended across them by multiband.py, except for those
that differ because edges lie elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from hugin_abflow import comparison
from hugin_abflow.cells import averaged, centres, grown
from hugin_abflow.colour import Correction, clipping
from hugin_abflow.comparison import MEAN, SHARE, SQUARE, Comparison
from hugin_abflow.content import ALIKE, Unlike
from hugin_abflow.geometry import Pair
from hugin_abflow.grid import Grid, any_around, on_cells
from hugin_abflow.layer import Box
from hugin_abflow.opencl import Buffer
from hugin_abflow.regions import Cells, Choice, Gone, Prices, Residuals, completed, find, seen
from hugin_abflow.scene import Scene
from hugin_abflow.working import shared_cells

# Working pixels per cell of the seam grid.
_CELL = 8
# Without flow.
_FINE_CELL = 4
# Price of a cut, in cells: what is cut off must be favoured by the softmax over this depth, times t / r.
_CUT = 10.0
# The same of large regions, as a share of their size.
_CUT_SHARE = 0.25
# How many times as dear cuts are, by the residual itself, where short ones would be bare: then what the
# softmax favours says little. White stone ended before dark glass in a cut of 14 cells; one of 40 goes from
# stone to stone.
_LONG = 4
# _CUT without flow, where the softmax has little to say: overlaps are some hundred cells wide, and the cut
# that is seen least may lie anywhere in them.
_FINE_CUT = 400.0
# Residual of layers that agree, without flow: of two cuts that nobody sees the shorter one is taken.
_SHORTER = 0.005
# The share of an overlap in which layers that are not aligned may show different things, at most.
_FEW = 0.5
# Price of a cell that is clipped, and is not in another layer that is as bright: as of a residual that
# nothing favours.
_CLIPPED = 0.5
# By how much, of full scale, that layer may be darker: what is white here and darker there is something else.
_DARKER = 0.05
# What is clipped here and, by the exposures of both, darker there than what would just clip here by more than
# this, of full scale, is something else for certain.
_CERTAINLY_DARKER = 0.1
# More than anything is: where their exposures are not known well enough.
_NEVER = 1e6
# The share of a cell, neither clipped nor beyond borders, from which on it tells of fine detail.
_TELLS = 0.75
# What is left of a layer's weight where it yields: a pixel that no other layer can fill stays opaque.
_TRACE = 1e-12
# Bytes that `cut` takes for each cell of each layer: share, cover, and where it is torn; and more where
# several layers are, for a graph of prices with what finds the least of them.
_CELL_BYTES = 8 + 3
_SHARED_BYTES = 16
# The same of prices for another cut, and of where layers are.
_OTHER_BYTES = 8 + 1
# How many times as much as a cut it may cost to take a region from one layer that has most of it, which shows
# things once and whole.
_WHOLE_FACTOR = 1.65
# The same of regions that single.py and shadows.py found.
_SINGLE_FACTOR = 2.0


def seam_grid(grid: Grid) -> Grid:
    """The grid of the regions, over the working grid's region."""
    return grid.coarser(_CELL)


def room(grid: Grid, aligned: bool, layers: int, shared: float) -> int:
    """Bytes that `cut` takes, at most; `cut_unaligned` if layers are not `aligned`.

    grid        the working grid. layers: how many. shared: the share of the grid that several of them cover.
    """
    cells = grid.coarser(_CELL if aligned else _FINE_CELL)
    several = _SHARED_BYTES + (_OTHER_BYTES if aligned else 0)
    return math.ceil(layers * cells.width * cells.height * (_CELL_BYTES + shared * several))


def residuals(
    scene: Scene,
    correction: Correction,
    known: Sequence[bool] | None = None,
    single: Cells | None = None,
) -> Residuals:
    """What flow and exposure do not explain.

    known       of each of `scene.pairs`, whether by how much their exposures differ is known; None: of none.
    single      cells that are to be taken from one layer in any case, whatever explains them.
    """
    cells = seam_grid(scene.grid)
    mean, square, smooth_square, fine = (np.zeros(cells.shape) for _ in range(4))
    measured, unrelated = (np.zeros(cells.shape, bool) for _ in range(2))
    limits = [clipping(layer) for layer in scene.layers]
    for its, found in _differences(scene, correction, cells, limits, known):
        smooth = comparison.smoothed(found, cells)
        other = ~comparison.in_another_light(found, smooth, cells)
        if single is not None:
            other |= single[its]
        mean[its] = np.maximum(mean[its], other * np.abs(smooth[MEAN]).max(-1))
        square[its] = np.maximum(square[its], other * found[SQUARE])
        smooth_square[its] = np.maximum(smooth_square[its], other * smooth[SQUARE])
        measured[its] |= found[SHARE] > 0
        varies = found[SQUARE] - np.square(np.abs(found[MEAN]).max(-1))
        fine[its] = np.maximum(fine[its], np.where(found[SHARE] > _TELLS, varies, 0))
        unrelated[its] |= other & comparison.unrelated(smooth, cells)
    return Residuals(mean, np.sqrt(square), measured, np.sqrt(smooth_square), unrelated, np.sqrt(fine))


def clipping_prices(
    scene: Scene, correction: Correction, excess: npt.NDArray[np.float32], whole: Cells
) -> Prices | None:
    """What it costs to take a cell of the regions `whole` from a layer that clips it where another one is as
    bright and not clipped; None: nothing anywhere.

    excess      how much each layer clips of what another one shows, 0..1: (layers, height, width) on the
                highlights grid (`highlights.Clipped`).
    """
    cells = seam_grid(scene.grid)
    row, column = centres(cells, excess.shape)
    clips = excess[:, row[:, None], column] * whole
    pairs = [pair for pair in scene.pairs if clips[[pair.a, pair.b]].any()]
    if not pairs:
        return None
    as_bright = np.zeros((len(scene.layers), *cells.shape), bool)
    differences = _differences(replace(scene, pairs=pairs), correction, cells)
    for pair, (its, found) in zip(pairs, differences, strict=True):
        brighter, both = found[MEAN].mean(-1), found[SHARE] > 0
        as_bright[pair.a][its] |= both & (brighter < _DARKER)
        as_bright[pair.b][its] |= both & (-brighter < _DARKER)
    prices: Prices = _CLIPPED * as_bright * clips
    return prices


def regions(residual: Residuals, grid: Grid, aligned: bool = True, single: Cells | None = None) -> Cells:
    """Where layers differ too much to be blended, (height, width) on the seam grid.

    aligned     whether the layers are; else texture differs everywhere and tells nothing.
    single      what single.py and shadows.py found: cells that belong to a region whatever layers show there.
    """
    residual = residual if aligned else Residuals(residual.mean, residual.mean)
    return find(residual, seam_grid(grid), np.zeros(residual.mean.shape, bool) if single is None else single)


def cut(
    scene: Scene,
    residual: Residuals,
    whole: Cells,
    single: Cells | None = None,
    clipping_price: Prices | None = None,
    torn: npt.NDArray[np.bool_] | None = None,
    choose: Callable[[Choice], tuple[npt.NDArray[np.intp], Gone]] | None = None,
) -> tuple[npt.NDArray[np.intp], Gone]:
    """Give each cell of the regions `whole` to one layer: the others lose their colour weight there
    (fields[...].w, in place).

    single      what single.py and shadows.py found: a region that has cells of it is cut in two only if that
                is much better, others if it is clearly better.
    clipping_price    what each layer costs in a cell besides (`clipping_prices`).
    torn        where each layer is torn (`tears.find`).
    choose      the layers of a choice, and who is gone then; default: the least energy, and nobody.

    Returns the layer of each cell, (height, width) on the seam grid, elsewhere that which weighs most, -1
    where none covers it; and who is gone.
    """
    cells = seam_grid(scene.grid)
    factor = np.full(whole.shape, _WHOLE_FACTOR)
    if single is not None:
        factor = np.where(single, _SINGLE_FACTOR, _WHOLE_FACTOR)
    plain = _choice(scene, residual, whole, cells, _shown(scene, cells), _CUT)
    plain = replace(plain, cut_share=_CUT_SHARE, whole_factor=factor, clipping=clipping_price, torn=torn)
    long = replace(plain, cut_price=_LONG * _CUT, cut_share=_LONG * _CUT_SHARE)
    choice = replace(plain, residual=seen(plain.residual), otherwise=long)
    owner, gone = choose(choice) if choose else (choice.owners()[0], Gone())

    def yields(k: int) -> npt.NDArray[np.float32]:
        one = yielded(whole, owner, k, cells.wraps)
        if k in gone:  # wholly: beside a border the softmax hardly knows another layer
            one = np.maximum(one, grown(gone[k], 1, cells.wraps) & (owner != k))
        return one

    same = averaged(grown(whole, 1, cells.wraps).astype(np.float32), cells.wraps)
    _yield(scene, yields, same, cells)
    return owner, gone


def yielded(whole: Cells, owner: npt.NDArray[np.intp], k: int, wraps: bool) -> npt.NDArray[np.float32]:
    """How much layer k yields in each cell, 0..1: outlines are softened over a cell to each side, those of
    regions a cell beyond, since what ends there may have nearly all of the softmax's weight.
    """
    others = whole & (owner != k)
    beyond = grown(others, 1, wraps) & ~whole
    return np.ascontiguousarray(averaged((others | beyond).astype(np.float32), wraps))


def clamp_displacements(scene: Scene, owner: npt.NDArray[np.intp], whole: Cells) -> None:
    """Clamp displacements of what is taken from a layer (fields[...].xyz, in place) to what the layer shows:
    else another one would be seen along its border. owner, whole: of `cut`.
    """
    grid, cells = scene.grid, seam_grid(scene.grid)
    for k, (layer, field) in enumerate(zip(scene.layers, scene.fields, strict=True)):
        its = whole & (owner == k)
        if its.any():  # of many layers nearly all
            scene.device.run(
                "seam", "seam_clamp", layer.box[2:], layer.pixels, field, layer.box, grid.border, grid.lonlat,
                scene.device.upload(its.astype(np.uint8)), cells.border,
            )  # fmt: skip


def unlike(scene: Scene, correction: Correction) -> Unlike:
    """Where layers that are not aligned show different things, by their low frequencies.

    Each cell tells by itself: an edge that is elsewhere in another layer is no wider than a cell or two. Of
    two layers that differ in most cells of their overlap it is their exposure that does.
    """
    cells = seam_grid(scene.grid)
    mean = np.zeros(cells.shape)
    limits = [clipping(layer) for layer in scene.layers]
    for its, found in _differences(scene, correction, cells, limits):
        measured = found[SHARE] > 0
        apart = np.where(measured, np.abs(found[MEAN]).max(-1), 0)
        if np.count_nonzero(apart > ALIKE) <= _FEW * np.count_nonzero(measured):
            mean[its] = np.maximum(mean[its], apart)
    return Unlike.of(cells, mean, np.ones(cells.shape, bool), None)


def cut_unaligned(scene: Scene, correction: Correction) -> None:
    """Give each cell of every overlap of layers that are not aligned to one layer, as `cut` does."""
    cells = scene.grid.coarser(_FINE_CELL)
    square = np.zeros(cells.shape)
    for its, found in _differences(scene, correction, cells):
        measured = found[SHARE] > 0
        square[its] = np.maximum(square[its], np.where(measured, _SHORTER + found[SQUARE], 0))
    whole = square > 0
    cover = on_cells(scene.masks.host, cells, np.logical_and)
    owner, _ = _choice(scene, Residuals(square, square), whole, cells, cover, _FINE_CUT).owners()
    _yield(scene, lambda k: (whole & (owner != k)).astype(np.float32), whole.astype(np.float32), cells)


def _choice(
    scene: Scene,
    residual: Residuals,
    whole: Cells,
    cells: Grid,
    cover: npt.NDArray[np.bool_],
    cut_price: float,
) -> Choice:
    """From which layer, of those that `cover` it, each cell of the regions `whole` is to be taken."""
    shares = _weights(scene, cells)
    shares /= np.maximum(shares.sum(0), 1e-12)
    residual = completed(residual, cover, cells.wraps)
    return Choice(whole, residual, shares, cover, cells.wraps, cut_price)


def _shown(scene: Scene, cells: Grid) -> npt.NDArray[np.bool_]:
    """The cells that each layer can be taken from, (layers, height, width): those that it covers and where it
    is not sampled beyond its border. Where that is none of those that cover a cell, it is all of them.
    """
    device, grid = scene.device, scene.grid
    cover = on_cells(scene.masks.host, cells, np.logical_and)
    inside, shown = cover.copy(), device.empty(cells.shape, np.uint8)
    for layer, field, one in zip(scene.layers, scene.fields, inside, strict=True):
        device.run(
            "seam", "seam_shown", cells.border.size,
            layer.pixels, field, layer.box, grid.border, grid.lonlat, cells.border, shown,
        )  # fmt: skip
        one &= shown.get() > 0
    np.copyto(inside, cover, where=~inside.any(0))
    return inside


def _weights(scene: Scene, cells: Grid) -> npt.NDArray[np.float64]:
    """The layers' colour weights at the centres of cells, (layers, height, width)."""
    device = scene.device
    rows, columns = (device.upload(one, np.int32) for one in centres(cells, scene.grid.shape))
    # of 300 layers these are a third of a gigabyte: one buffer serves all, and nothing is copied
    weights, found = np.empty((len(scene.layers), *cells.shape)), device.empty(cells.shape)
    for layer, field, one in zip(scene.layers, scene.fields, weights, strict=True):
        device.run(
            "seam", "seam_weights", cells.border.size, field, layer.box, rows, columns, cells.border, found
        )
        one[:] = found.get()
    return weights


def _yield(
    scene: Scene,
    yields: Callable[[int], npt.NDArray[np.float32]],
    same: npt.NDArray[np.floating],
    cells: Grid,
) -> None:
    """Take the layers' colour weight away where they yield; where they are the `same`, 0..1, none weighs more
    than another one before.

    yields      gives how much a layer does, (height, width): of many layers all take gigabytes.
    """
    device, grid = scene.device, scene.grid
    anywhere, everywhere = same > 0, device.upload(same, np.float32)
    for k, (layer, field) in enumerate(zip(scene.layers, scene.fields, strict=True)):
        if any_around(anywhere, layer.box, grid, cells):  # of many layers few
            device.run(
                "seam", "seam_yield", layer.box[2:],
                field, layer.box, grid.border, device.upload(yields(k)), everywhere, cells.border, _TRACE,
            )  # fmt: skip


def _differences(
    scene: Scene,
    correction: Correction,
    cells: Grid,
    limits: Sequence[tuple[float, ...]] | None = None,
    known: Sequence[bool] | None = None,
) -> Iterator[tuple[tuple[slice, slice], Comparison]]:
    """Of each two corrected layers, rows and columns of the cells that both may be in, and what is found
    of these, of the pixels that are not brighter than their layer's limits (r, g, b, 1), or where the other
    is certainly darker, if their exposures are `known` (of each of `scene.pairs`; None: of none). No limits:
    of all.
    """
    device, layers, fields, grid = scene.device, scene.layers, scene.fields, scene.grid
    limits = [(math.inf,) * 4] * len(layers) if limits is None else limits
    no_gain = device.zeros((*correction.grid.shape, 4))

    def start(pair: Pair, known: bool) -> tuple[Box, Buffer, Buffer, Buffer]:
        part = shared_cells(layers[pair.a], layers[pair.b], grid, cells)
        difference = device.empty((part.height, part.width, 4))
        square = device.empty((part.height, part.width))
        texture = device.empty((part.height, part.width, 8))
        sides: list[Any] = []
        for k in (pair.a, pair.b):
            sides += [layers[k].pixels, fields[k], layers[k].box, correction.gains[k] or no_gain]
        device.run(
            "seam", "seam_difference", (part.width, part.height), *sides, grid.border, grid.lonlat,
            correction.grid.border, cells.border, part.place, correction.shoulder, limits[pair.a],
            limits[pair.b], _CERTAINLY_DARKER if known else _NEVER, difference, square, texture,
        )  # fmt: skip
        return part, difference, square, texture

    def fetch(
        part: Box, difference: Buffer, square: Buffer, texture: Buffer
    ) -> tuple[tuple[slice, slice], npt.NDArray[np.float64]]:
        mean = difference.get()
        found = np.dstack([mean[..., :3], square.get(), texture.get()[..., :5], mean[..., 3]])
        return part.slices, found.astype(np.float64)

    if not scene.pairs:
        return
    first, *others = zip(scene.pairs, known or [False] * len(scene.pairs), strict=True)
    started = start(*first)
    for pair in others:
        found = fetch(*started)
        started = start(*pair)  # the device goes on while the caller looks at what is found
        device.flush()
        yield found
    yield fetch(*started)

"""Smooth displacements for what is taken from one layer, whole (kernels/membrane.cl).

In such a region flow had nothing to match; what it found would bend people, and the floor beside them. Where
layers show different things there, the displacements of the layer that is taken become those of a membrane.
It is held where layers agree, and along cuts, where flow has brought them together; between them it is
harmonic, so that no displacement is larger than those around (of least slopes, as in Perez, Gangnet, Blake,
"Poisson image editing", 2003).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import scipy

from hugin_abflow.cells import averaged, grown, neighbours
from hugin_abflow.coefficient import Masks
from hugin_abflow.grid import Grid, on_cells
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.working import WorkingLayer

# Cells along a cut in which layers stay as flow has brought them together.
_HELD = 2
# So little holds every cell where its photo shows it: there it is where nothing else holds it.
_LOOSE = 1e-9

Cells = npt.NDArray[np.bool_]  # (height, width)
Values = npt.NDArray[np.float64]  # (height, width, ...)


def stretch(
    device: Device,
    layers: Sequence[WorkingLayer],
    fields: Sequence[Buffer],
    owner: npt.NDArray[np.intp],
    whole: Cells,
    unlike: Cells,
    masks: Masks,
    grid: Grid,
    cells: Grid,
) -> list[int]:
    """Make displacements (fields[...].xyz, in place) smooth in regions of cells; what nothing holds is not
    displaced at all. Returns which layers have changed.

    owner   (height, width) on `cells`: the layer that each cell is taken from.
    whole   the regions in which layers differ.
    unlike  where they show different things; what they agree in holds them.
    """
    cover = on_cells(masks.host, cells, np.logical_or)
    several = cover.sum(0) > 1
    changed = []
    for k, (layer, field) in enumerate(zip(layers, fields, strict=True)):
        its = whole & unlike & (owner == k)
        if not its.any():  # of many layers nearly all
            continue
        inner = its & ~_held(k, owner, whole, cover[k] & several, cells.wraps)
        if inner.any() and _stretch(device, layer, field, inner, grid, cells):
            changed.append(k)
    return changed


def _stretch(
    device: Device, layer: WorkingLayer, field: Buffer, inner: Cells, grid: Grid, cells: Grid
) -> bool:
    """The same of one layer, in the cells `inner`; whether it shows anything there."""
    means = mean_displacements(device, layer, field, grid, cells)
    known = means[..., 3] > 0
    free = inner & known
    if not free.any():
        return False
    around, all_of_it = (averaged(one * 1.0, cells.wraps) for one in (free, known))
    # a third at a straight outline, all a cell from there; what is beyond the layer is no outline
    far = (free * np.clip(2 * around / np.maximum(all_of_it, 0.1) - 1, 0, 1))[..., None]
    smooth = np.concatenate([far * _harmonic(means[..., :3], free, known, cells), far], -1)
    # beside the layer as in it: its last pixels are read between
    beside = averaged(smooth, cells.wraps) / np.maximum(around, 0.1)[..., None]
    smooth = np.where(known[..., None], smooth, beside)
    device.run(
        "membrane", "membrane_stretch", layer.box[2:], field, layer.box, grid.border,
        device.upload(np.ascontiguousarray(smooth, np.float32)), cells.border,
    )  # fmt: skip
    return True


def mean_displacements(device: Device, layer: WorkingLayer, field: Buffer, grid: Grid, cells: Grid) -> Values:
    """The mean displacement of a layer's pixels in each cell, and 1; zeros where it has none: (height, width,
    4).
    """
    found = device.empty((*cells.shape, 4))
    device.run(
        "membrane", "membrane_mean", cells.border.size,
        layer.pixels, field, layer.box, grid.border, cells.border, found,
    )  # fmt: skip
    return found.get().astype(np.float64)


def _held(k: int, owner: npt.NDArray[np.intp], whole: Cells, both: Cells, wraps: bool) -> Cells:
    """Cells along cuts of layer k, in or beside what it and others show, `both`."""
    return grown(whole & (owner != k) & grown(both, 1, wraps), _HELD, wraps)


def _harmonic(values: Values, free: Cells, known: Cells, cells: Grid) -> Values:
    """Values with those of `free` cells such that each is the mean of its neighbours; cells that are not
    `known` have no part.
    """
    rows, columns = np.nonzero(free)
    number = np.full(free.shape, -1)
    number[rows, columns] = np.arange(rows.size)
    diagonal, held = np.full(rows.size, _LOOSE), np.zeros((rows.size, 3))
    links = []
    for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        there, at = neighbours(rows + down, columns + right, cells.shape, cells.wraps)
        there &= known[at]
        diagonal += there
        linked = there & free[at]
        held += (there & ~linked)[:, None] * values[at]
        links.append(np.stack([np.flatnonzero(linked), number[at][linked]]))
    every = np.arange(rows.size)
    first, second = np.concatenate([*links, np.stack([every, every])], 1)
    weights = np.concatenate([np.full(first.size - rows.size, -1.0), diagonal])
    size = rows.size, rows.size
    matrix = scipy.sparse.csc_array((weights, (first, second)), shape=size)
    result = values.copy()
    result[rows, columns] = scipy.sparse.linalg.spsolve(matrix, held).reshape(-1, 3)
    return result

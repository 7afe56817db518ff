"""Where a layer is torn by its own displacements (on the host).

Where flow finds no match, or a wrong one, displacements change from one cell to the next by as much as the
cells are apart. In a blend that hardly shows, since each layer weighs most where it is displaced least. But
a region is taken from one layer, whole: a lamp post that is torn there ends in a hook. So torn cells have a
price when the layer of a region is chosen (regions.py).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from hugin_abflow import membrane
from hugin_abflow.grid import Grid, any_around
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.working import WorkingLayer

# By how much displacements differ from a cell to the next, beside their distance, from which on a layer is
# torn between them: surfaces seen from aside are compressed, or stretched, by up to a third or so.
_TORN = 0.6

Cells = npt.NDArray[np.bool_]  # (height, width)


def find(
    device: Device,
    layers: Sequence[WorkingLayer],
    fields: Sequence[Buffer],
    whole: Cells,
    grid: Grid,
    cells: Grid,
) -> npt.NDArray[np.bool_]:
    """The cells of the regions `whole` where each layer is torn, (layers, height, width).

    fields      where each layer is sampled (`geometry.fields`). cells: the grid of the regions.
    """
    torn = np.zeros((len(layers), *whole.shape), bool)
    along, down = _steps(grid, cells)
    for layer, field, one in zip(layers, fields, torn, strict=True):
        if any_around(whole, layer.box, grid, cells):  # of many layers few
            means = membrane.mean_displacements(device, layer, field, grid, cells)
            known = whole & (means[..., 3] > 0)
            one |= _beside(means[..., :3], known, cells.wraps, along)
            one |= _beside(means[..., :3].swapaxes(0, 1), known.T, False, down).T
    return torn


def _steps(grid: Grid, cells: Grid) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """How far cells are from the next ones in a row, (height, 1), and in a column, (1, 1): as displacements
    are measured.
    """
    if cells.spherical:
        return cells.lonlat[1] * cells.bounded_widths[:, None], np.full((1, 1), cells.lonlat[3])
    return (
        np.full((cells.height, 1), grid.width / cells.width),
        np.full((1, 1), grid.height / cells.height),
    )


def _beside(
    means: npt.NDArray[np.float64], known: Cells, wraps: bool, step: npt.NDArray[np.float64]
) -> Cells:
    """The known cells between which, along rows, displacements differ by too much, on both sides.

    means   (height, width, 3), of cells' displacements. step: how far cells are apart, of each row.
    """
    following, next_known = np.roll(means, -1, 1), np.roll(known, -1, 1)
    apart = np.linalg.norm(following - means, axis=-1)
    torn: Cells = known & next_known & (apart > _TORN * step)
    if not wraps:
        torn[:, -1] = False
    both_sides: Cells = torn | np.roll(torn, 1, 1)
    return both_sides

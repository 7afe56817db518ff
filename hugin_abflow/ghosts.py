"""Quicker transitions of colour where aligned layers differ in fine detail (kernels/ghosts.cl).

Beside outlines of near things flow is not exact: one layer shows a box a few pixels wider than the other one,
and a line of the ceiling behind it elsewhere. The softmax changes over within some ten working pixels, in
which both would be seen, half transparent. So weights are raised to a power there: it is the middle of the
transition that stays, and only a pixel or two show both. Low frequencies do not count, since steps of these
are seen where the change is quick, nor does what is clipped, which suits a slow one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import scipy

from hugin_abflow.cells import Mask, averaged, grown
from hugin_abflow.grid import Grid, any_around
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.working import WorkingLayer

# How far layers differ, root of the mean square within a cell, less their mean difference, full scale is 1:
# up to the first nobody sees both, and from the second on everybody does.
_HARDLY, _CLEARLY = 0.02, 0.06
# How many times as quick the change is at most.
_QUICKEST = 3.0


def sharpen(
    device: Device,
    layers: Sequence[WorkingLayer],
    fields: Sequence[Buffer],
    fine: npt.NDArray[np.float64],
    whole: Mask | None,
    grid: Grid,
    cells: Grid,
) -> None:
    """Make layers change over quickly where they differ: weights of fields, in place.

    fine        how far aligned layers differ in fine detail, (height, width) on `cells`.
    whole       cells that are taken from one layer already, (height, width); None: none are.
    """
    power = powers(fine, whole, cells.wraps)
    quicker = power > 1
    if not quicker.any():
        return
    on_device = device.upload(power)
    for layer, field in zip(layers, fields, strict=True):
        if any_around(quicker, layer.box, grid, cells):  # of many layers few
            device.run(
                "ghosts", "ghosts_sharpen", layer.box[2:],
                field, layer.box, grid.border, on_device, cells.border,
            )  # fmt: skip


def powers(fine: npt.NDArray[np.float64], whole: Mask | None, wraps: bool) -> npt.NDArray[np.float32]:
    """To which power weights are raised, 1 or more; the arguments are those of `sharpen`.

    Around each cell as well: an outline ends beside it.
    """
    widest = scipy.ndimage.maximum_filter(fine, 3, mode=("nearest", "wrap" if wraps else "nearest"))
    share = averaged(np.clip((widest - _HARDLY) / (_CLEARLY - _HARDLY), 0, 1), wraps)
    if whole is not None:
        share = np.where(grown(whole, 1, wraps), 0, share)
    return np.ascontiguousarray(1 + (_QUICKEST - 1) * share, np.float32)

"""What one photo shows clipped is taken from another one that does not (kernels/highlights.cl).

Where a photo runs into white (saturation.py), a darker one beside it still has structure. The softmax knows
nothing of that. So a layer's colour weight falls with how much it shows clipped of what the layer that clips
least still shows of the surroundings:

    s_k <- s_k exp(-strength_k * e_k),    e_k = (c_k - min_j c_j) / (1 - min_j c_j)

with c_k the clipped share. The minimum matters on a white ceiling: all photos clip most of it, and only the
darkest one shows its specks.

White and what is not white differ by an unknown amount. So the transition is as wide there as the overlap
allows (transition.py), and the darker layer is seen nearly up to its border, if there is nothing but white
beyond. Where layers that clip less than k, by all that both show, reach beyond each other, white need not be
shown at all, and the strength is twice as large; it falls towards what layer k alone has to show white.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hugin_abflow.cells import Mask
from hugin_abflow.coefficient import Masks, distance
from hugin_abflow.grid import Grid, any_around, on_cells
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.settings import Settings
from hugin_abflow.working import CLIPPED, WorkingLayer

# Working pixels per cell.
_CELL = 16
# A pixel's brightest channel, of white, from which on it counts as clipped in part; wholly from CLIPPED on.
_NEARLY = 0.9
# The softmax's own weights span e^10: with as much, layers are mixed next to the border of the darker one.
# A little more, as dark spots are not clipped, and what white leaves of these looks like no photo.
_STRENGTH = 12.0
# Where white need not be shown: the softmax's weights span more than that where things shift.
_FULL_STRENGTH = 24.0
# The clipped share of a cell from which on it has to be shown, though white, if no layer shows it that clips
# less.
_WHITE = 0.5
# Working pixels from such cells on which strength is full: next to them it is _STRENGTH.
_FAR = 128.0
# The least that a layer shows of a cell for others to lose all of it: less may be noise.
_SHOWN = 0.03
# A layer clips less than another if this part of what both show clipped, together, is the other one's alone.
_LESS = 0.25

PerLayer = npt.NDArray[np.float32]  # (layers, height, width) on the highlights grid


@dataclass(frozen=True)
class Clipped:
    """How much of each layer is clipped, 0..1.

    shares  c_k of the pixels that the layer covers, 0 where it is not.
    excess  e_k, 0 where the layer is not, where it is alone, and where all are clipped alike.
    """

    shares: PerLayer
    excess: PerLayer


def highlights_grid(grid: Grid) -> Grid:
    """The coarse grid, over the region of the working grid, of what is clipped."""
    return grid.coarser(_CELL)


def measure(
    device: Device, layers: Sequence[WorkingLayer], masks: Masks, grid: Grid, settings: Settings
) -> Clipped:
    """What all layers show clipped; nothing with `settings.highlights` off."""
    cells = highlights_grid(grid)
    shares = np.zeros((len(layers), *cells.shape), np.float32)
    if not settings.highlights or not any(np.isfinite(layer.clips_at).all() for layer in layers):
        return Clipped(shares, shares)
    for layer, share in zip(layers, shares, strict=True):
        found = device.empty(cells.shape)
        device.run(
            "highlights", "highlights_share", cells.border.size, layer.pixels, layer.box, grid.border,
            cells.border, (*layer.clips_at, 1.0), _NEARLY, CLIPPED, found,
        )  # fmt: skip
        share[:] = found.get()
    inside = on_cells(masks.host, cells, np.logical_or)
    least = np.where(inside, shares, np.float32(1)).min(0)
    excess = (shares - least) / np.maximum(1 - least, np.float32(_SHOWN))
    return Clipped(shares, np.where(inside, excess, np.float32(0)))


def reduce_weights(
    device: Device,
    layers: Sequence[WorkingLayer],
    fields: Sequence[Buffer],
    clipped: Clipped,
    masks: Masks,
    grid: Grid,
) -> PerLayer:
    """Reduce colour weights of what is clipped (fields[...].w, in place).

    Returns by how much more than if white had to be shown everywhere: the exponential of this, 0 or more,
    bilinear between the cells, divides the weights besides.
    """
    cells = highlights_grid(grid)
    extra = np.zeros_like(clipped.excess)
    if not clipped.excess.any():
        return extra
    required = _required(clipped, masks, cells)
    for k, (layer, field, excess) in enumerate(zip(layers, fields, clipped.excess, strict=True)):
        if excess.any():
            extra[k] = excess * _extra_strength(device, required[k], grid)
            device.run(
                "highlights", "highlights_reduce", layer.box[2:], field, layer.box, grid.border,
                device.upload(_STRENGTH * excess + extra[k]), cells.border,
            )  # fmt: skip
    return extra


def restore_weights(
    device: Device,
    layers: Sequence[WorkingLayer],
    fields: Sequence[Buffer],
    extra: PerLayer,
    there: Mask,
    grid: Grid,
    cells: Grid,
) -> None:
    """Restore, in some cells, the colour weights that layers would have if white had to be shown.

    extra       what `reduce_weights` returned.
    there       (height, width) on `cells`, over the region of `grid`: these.
    """
    part = device.upload(there, np.float32)
    for layer, field, one in zip(layers, fields, extra, strict=True):
        if one.any() and any_around(there, layer.box, grid, cells):
            device.run(
                "highlights", "highlights_restore", layer.box[2:], field, layer.box, grid.border,
                device.upload(one), highlights_grid(grid).border, part, cells.border,
            )  # fmt: skip


def _required(clipped: Clipped, masks: Masks, cells: Grid) -> npt.NDArray[np.bool_]:
    """What each layer has to show, though white, (layers, height, width): no layer shows it that clips less
    than it, by all that both show.
    """
    count = len(clipped.shares)
    shares = clipped.shares.reshape(count, -1).astype(np.float64)
    whole = on_cells(masks.host, cells, np.logical_and).reshape(count, -1)
    where_both = (shares * whole) @ whole.T  # [j, k]: what j shows clipped, of what k shows as well
    less = where_both.T - where_both > _LESS * (where_both.T + where_both)  # [j, k]: j clips less than k
    replaced = less.T.astype(np.float32) @ whole.astype(np.float32) > 0
    return np.asarray((clipped.shares > _WHITE) & ~replaced.reshape(clipped.shares.shape))


def _extra_strength(device: Device, required: Mask, grid: Grid) -> npt.NDArray[np.float32]:
    """What is added to _STRENGTH, (height, width) on the highlights grid: from 0 at what is `required` on."""
    cells = highlights_grid(grid)
    most = np.float32(_FULL_STRENGTH - _STRENGTH)
    if not required.any():
        return np.full(cells.shape, most)
    free, everywhere = ~required, np.ones(cells.shape, np.uint8)
    masks = Masks(cells, (device.upload(free, np.uint8),), free[None])
    off = distance(device, masks, 0, device.upload(everywhere), grid).get()
    off = np.minimum(off / np.float32(_FAR), 1)
    return np.asarray(most * off * off * (3 - 2 * off), np.float32)

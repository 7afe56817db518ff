"""What one photo shows clipped is taken from another that does not (kernels/highlights.cl).

Where a photo runs into white (saturation.py), a darker one beside it still has structure. The softmax knows
nothing of that. So a layer's colour weight falls with how much more of its surroundings it shows clipped than
the layer that shows least so,

    s_k <- s_k exp(-strength * e_k),    e_k = c_k - min_j c_j

with c_k the clipped share. As white and what is not differ by an unknown amount, the transition is as wide as
the overlap allows there (transition.py), and the darker layer is seen nearly up to its border, if there is
nothing but white beyond. Where darker layers reach beyond each other white need not be shown at all, and the
strength is as much greater as that takes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hugin_abflow.cells import Mask
from hugin_abflow.coefficient import Masks, distance, on_cells
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.settings import Settings
from hugin_abflow.working import Grid, WorkingLayer

# Working pixels per cell.
_CELL = 16
# A pixel's brightest channel, of white, from which on it may be clipped, and where it surely is.
_NEARLY, _SURELY = 0.9, 0.98
# The softmax's own weights span e^10: with as much, layers are mixed next to the border of the darker one.
# A little more, as dark spots are not clipped, and what white leaves of these looks like no photo.
_STRENGTH = 12.0
# The same far from white that has to be shown: of a clipped layer nothing is seen.
_FULL_STRENGTH = 24.0
# The clipped share of a cell that is white, and how far from such cells, in working pixels, that is.
_WHITE, _FAR = 0.5, 128.0

Cells = npt.NDArray[np.float32]  # (layers, height, width) on the highlights grid


@dataclass(frozen=True)
class Clipped:
    """How much of each layer is clipped, 0..1.

    shares  c_k, 0 where the layer is not.
    excess  e_k, 0 where the layer is not, where it is alone, and where all are clipped alike.
    """

    shares: Cells
    excess: Cells


def highlights_grid(grid: Grid) -> Grid:
    """The coarse grid, over the region of the working grid, on which it is told what is clipped."""
    return grid.coarser(_CELL)


def measure(
    device: Device, layers: Sequence[WorkingLayer], masks: Masks, grid: Grid, settings: Settings
) -> Clipped:
    """What all layers show clipped: of floats nothing, and with `settings.highlights` off."""
    cells = highlights_grid(grid)
    shares = np.zeros((len(layers), *cells.shape), np.float32)
    if not settings.highlights or layers[0].layer.dtype.kind != "u":
        return Clipped(shares, shares)
    for layer, share in zip(layers, shares, strict=True):
        found = device.empty(cells.shape)
        device.run(
            "highlights", "highlights_share", cells.border[:2], layer.pixels, layer.box, grid.border,
            cells.border, (*layer.white, 1.0), _NEARLY, _SURELY, found,
        )  # fmt: skip
        share[:] = found.get()
    inside = on_cells(masks.host, cells, np.logical_or)
    least = np.where(inside, shares, np.float32(1)).min(0)
    return Clipped(shares, np.where(inside, shares - least, np.float32(0)))


def give_way(
    device: Device,
    layers: Sequence[WorkingLayer],
    fields: Sequence[Buffer],
    clipped: Clipped,
    masks: Masks,
    grid: Grid,
) -> Cells:
    """Divide the colour weights of fields (geometry.py), in place, by what the result is the logarithm of."""
    cells = highlights_grid(grid)
    logarithms = np.zeros_like(clipped.excess)
    if not clipped.excess.any():
        return logarithms
    inside, whole = (on_cells(masks.host, cells, rule) for rule in (np.logical_or, np.logical_and))
    for k, (layer, field, excess) in enumerate(zip(layers, fields, clipped.excess, strict=True)):
        if excess.any():
            bound = inside[k] & (clipped.shares[k] > _WHITE) & ~_shown_darker(k, clipped, inside, whole)
            logarithms[k] = excess * _strength(device, bound, np.logical_or.reduce(inside, 0), grid)
            device.run(
                "highlights", "highlights_yield", layer.box[2:], field, layer.box, grid.border,
                device.upload(logarithms[k]), cells.border,
            )  # fmt: skip
    return logarithms


def _shown_darker(index: int, clipped: Clipped, inside: Mask, whole: Mask) -> Mask:
    """The cells that layers show whole which clip less than one, where both are, (height, width)."""
    more = np.sum((clipped.shares[index] - clipped.shares) * (inside & inside[index]), (1, 2))
    return np.asarray(whole[more > 0].any(0))


def _strength(device: Device, bound: Mask, cover: Mask, grid: Grid) -> npt.NDArray[np.float32]:
    """How strongly a layer gives way, (height, width) on the highlights grid: less near `bound`, where it is
    to be shown, though white. cover: where any layer is.
    """
    cells = highlights_grid(grid)
    if not bound.any():
        return np.full(cells.shape, _FULL_STRENGTH, np.float32)
    free = Masks(cells, (device.upload(~bound, np.uint8),), ~bound[None])
    off = distance(device, free, 0, device.upload(cover, np.uint8), grid).get()
    off = np.minimum(off / np.float32(_FAR), 1)
    smooth = off * off * (3 - 2 * off)
    return np.asarray(_STRENGTH + (_FULL_STRENGTH - _STRENGTH) * smooth, np.float32)

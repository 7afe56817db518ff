"""What one photo shows clipped is taken from another that does not (kernels/highlights.cl).

Where a photo runs into white (saturation.py), a darker one beside it still has structure. The softmax knows
nothing of that. So a layer's colour weight falls with how much more of its surroundings it shows clipped than
the layer that shows least so,

    s_k <- s_k exp(-strength * e_k),    e_k = c_k - min_j c_j

with c_k the clipped share. The darker layer is then seen nearly up to its border; as white and what is not
differ by an unknown amount, the transition is as wide as the overlap allows there (transition.py).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from hugin_abflow.coefficient import Masks, on_cells
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


def highlights_grid(grid: Grid) -> Grid:
    """The coarse grid, over the region of the working grid, on which it is told what is clipped."""
    return grid.coarser(_CELL)


def excess(
    device: Device, layers: Sequence[WorkingLayer], masks: Masks, grid: Grid, settings: Settings
) -> npt.NDArray[np.float32]:
    """e_k of all layers, float32 (layers, height, width) on `highlights_grid`, 0..1.

    0 where a layer is not, where it is alone, and where all are clipped alike; everywhere for floats, which
    are never clipped, and with `settings.highlights` off.
    """
    cells = highlights_grid(grid)
    clipped = np.zeros((len(layers), *cells.shape), np.float32)
    if not settings.highlights or layers[0].layer.dtype.kind != "u":
        return clipped
    for layer, share in zip(layers, clipped, strict=True):
        found = device.empty(cells.shape)
        device.run(
            "highlights", "highlights_share", cells.border[:2], layer.pixels, layer.box, grid.border,
            cells.border, (*layer.white, 1.0), _NEARLY, _SURELY, found,
        )  # fmt: skip
        share[:] = found.get()
    inside = on_cells(masks.host, cells, np.logical_or)
    least = np.where(inside, clipped, np.float32(1)).min(0)
    return np.where(inside, clipped - least, np.float32(0))


def give_way(
    device: Device,
    layers: Sequence[WorkingLayer],
    fields: Sequence[Buffer],
    clipped: npt.NDArray[np.float32],
    grid: Grid,
) -> None:
    """Scale the colour weights of fields (geometry.py), in place; clipped: `excess`."""
    cells = highlights_grid(grid)
    for layer, field, share in zip(layers, fields, clipped, strict=True):
        if share.any():
            device.run(
                "highlights", "highlights_yield", layer.box[2:], field, layer.box, grid.border,
                device.upload(share), cells.border, _STRENGTH,
            )  # fmt: skip

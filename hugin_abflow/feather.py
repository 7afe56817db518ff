"""Shares of layers that fade towards where each of them ends and another one goes on (kernels/feather.cl)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hugin_abflow.coefficient import divide
from hugin_abflow.grid import Grid, Place
from hugin_abflow.opencl import MUCH, Buffer, Device

# Columns and rows to a work-group: few, that all cores have some.
_GROUP = 16
# Columns and distances are kept in 16 bits: those of working grids are some thousand.
_MOST = 65_535


def feathers(device: Device, layers: Sequence[tuple[Place, Buffer]], grid: Grid) -> list[Buffer]:
    """Shares of layers that sum to 1 where any is, each by the distance in px to where it ends and another
    one goes on: float32 (height, width) on the layer's box, 0 where it shows nothing.

    layers      each one's place on `grid`, and float32 (height, width, 4) on it: colour, valid.
    """
    shown, total = device.zeros(grid.shape, np.uint8), device.zeros(grid.shape)
    for box, layer in layers:
        device.run("feather", "feather_mark", box[2:], layer, box, grid.border, shown)
    shares = []
    for box, layer in layers:
        width, height = box[2:]
        around = min(width // 2, (_MOST - width) // 2) if grid.wraps and width == grid.width else 0
        rows, share = device.empty((height, width), np.uint16), device.empty((height, width))
        lowest = device.empty((height, width + 2 * around, 2), np.uint16)
        device.run(
            "feather", "feather_columns", (width,),
            layer, box, grid.border, shown, min(grid.width + grid.height, _MOST), rows, group=_GROUP,
        )  # fmt: skip
        device.run(
            "feather", "feather_distance", (height,),
            layer, box, grid.border, rows, around, lowest, share, total, group=_GROUP,
        )  # fmt: skip
        shares.append(share)
        del rows, lowest
        device.give_back(MUCH)  # layers are of different sizes
    divide(device, [(box, share) for (box, _), share in zip(layers, shares, strict=True)], total, grid)
    return shares

"""Flow that leads back to where it started is trusted; elsewhere it is filled (kernels/consistency.cl).

A flow from a to b and the flow from b to a undo each other where both are right. Where they do not
(occlusions, surfaces without texture), and where something moved by itself (movers.py), flow is taken from
the trusted flow around, near before far: a pyramid of trust-weighted means, from which every level fills the
finer one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hugin_abflow.geometry import PairFlow
from hugin_abflow.movers import CELL, Mask, Movers
from hugin_abflow.opencl import Buffer, Device

# Pixels between start and return that leave a quarter of the trust.
_TOLERANCE = 1.5


def mend(device: Device, pair: PairFlow, moved: Movers | None = None) -> PairFlow:
    """The pair's flows, filled where they disagree and where things moved by themselves."""
    wraps = pair.chart.wraps
    first, second = (moved.first, moved.second) if moved else (None, None)
    forward = _fill(device, trust(device, pair.forward, pair.backward, wraps, first), wraps)
    backward = _fill(device, trust(device, pair.backward, pair.forward, wraps, second), wraps)
    return replace(pair, forward=forward, backward=backward)


def trust(device: Device, flow: Buffer, back: Buffer, wraps: bool, moved: Mask | None = None) -> Buffer:
    """float32 (height, width, 4): flow in px, trust 0..1, and an unused 0. moved: cells that have none."""
    trusted = device.empty((*flow.shape[:2], 4))
    grid = _grid(flow, wraps)
    distrusted = device.upload(np.zeros((1, 1), np.uint8) if moved is None else moved.astype(np.uint8))
    cells = (*distrusted.shape[::-1], CELL, 0)
    device.run(
        "consistency", "consistency_trust", grid[:2], flow, back, grid, _TOLERANCE, distrusted, cells, trusted
    )
    return trusted


def _fill(device: Device, trusted: Buffer, wraps: bool) -> Buffer:
    levels = [trusted]
    while max(levels[-1].shape[:2]) > 1:
        fine = levels[-1]
        small = device.empty(((fine.shape[0] + 1) // 2, (fine.shape[1] + 1) // 2, 4))
        size = _grid(small, wraps)[:2]
        device.run("consistency", "consistency_push", size, fine, _grid(fine, wraps), small, size)
        levels.append(small)
    for coarse, fine in zip(levels[:0:-1], levels[-2::-1], strict=True):
        grid = _grid(fine, wraps)
        device.run("consistency", "consistency_pull", grid[:2], fine, grid, coarse, _grid(coarse, wraps))
    mended = device.empty((*trusted.shape[:2], 2))
    grid = _grid(trusted, wraps)
    device.run("consistency", "consistency_flow", grid[:2], levels[0], grid, mended)
    return mended


def _grid(buffer: Buffer, wraps: bool) -> tuple[int, int, int, int]:
    return buffer.shape[1], buffer.shape[0], int(wraps), 0

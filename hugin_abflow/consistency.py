"""Flow that leads back to where it started is trusted; elsewhere it is filled (kernels/consistency.cl).

A flow from a to b and the flow from b to a undo each other where both are right. Where they do not
(occlusions, people who moved, surfaces without texture), flow is taken from the trusted flow around, near
before far: a pyramid of trust-weighted means, from which every level fills the finer one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from hugin_abflow.geometry import PairFlow
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.working import Grid

# Pixels between start and return that leave a quarter of the trust.
_TOLERANCE = 1.5


def mend(
    device: Device, pair: PairFlow, grid: Grid, regions: npt.NDArray[np.bool_] | None = None
) -> PairFlow:
    """The pair's flows, filled where they disagree, and in `regions`.

    regions: (height, width) on any grid over the region of the working grid `grid`: where flow is known not
    to explain what the layers show.
    """
    unexplained = None if regions is None else device.upload(regions.astype(np.uint8))
    forward, backward = (
        _fill(device, _trusted(device, pair, *flows, grid, unexplained), pair.chart.wraps)
        for flows in ((pair.forward, pair.backward), (pair.backward, pair.forward))
    )
    return replace(pair, forward=forward, backward=backward)


def _trusted(
    device: Device, pair: PairFlow, flow: Buffer, back: Buffer, grid: Grid, regions: Buffer | None
) -> Buffer:
    trusted = trust(device, flow, back, pair.chart.wraps)
    if regions is not None:
        cells = grid.resized(regions.shape[1], regions.shape[0]).border
        size = (pair.chart.width, pair.chart.height)
        device.run(
            "consistency", "consistency_distrust", size, trusted, pair.chart.transform, size, grid.lens,
            grid.border, regions, cells,
        )  # fmt: skip
    return trusted


def trust(device: Device, flow: Buffer, back: Buffer, wraps: bool) -> Buffer:
    """float32 (height, width, 4): flow in px, trust 0..1, and an unused 0."""
    trusted = device.empty((*flow.shape[:2], 4))
    grid = _grid(flow, wraps)
    device.run("consistency", "consistency_trust", grid[:2], flow, back, grid, _TOLERANCE, trusted)
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

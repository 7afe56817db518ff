"""An overlap in figures: how far things shift, how much of that is sure, where one layer is taken whole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hugin_abflow.coefficient import on_cells
from hugin_abflow.consistency import trust
from hugin_abflow.geometry import PairFlow
from hugin_abflow.opencl import Device
from hugin_abflow.pyramid import Level
from hugin_abflow.working import Grid

# Trust (consistency.py) from which a flow is sure: there and back again ends about a pixel from the start.
_SURE = 0.5


@dataclass(frozen=True)
class Parallax:
    """How two layers shift against each other where both are.

    median, largest     length of the flow where it is sure, full-resolution canvas px; on a sphere an
                        angle, in px of the equator.
    consistent          share of the pixels where it is, 0..1.
    """

    median: float
    largest: float
    consistent: float


def parallax(device: Device, pair: PairFlow, levels: Sequence[Level], grid: Grid) -> Parallax:
    """Of a pair's flow as it was found, before it is mended; levels: both layers on the pair's chart."""
    both = np.logical_and(*(level.mask.get() > 0 for level in levels))
    ways = pair.forward, pair.backward
    trusted = trust(device, *ways, pair.chart.wraps, levels[0].image).get()
    sure = both & (trusted[..., 2] >= _SURE)
    if not sure.any():
        return Parallax(0.0, 0.0, 0.0)
    pixel = (grid.canvas_width or grid.region.width) / pair.chart.around(grid)
    lengths = np.hypot(trusted[..., 0], trusted[..., 1])[sure] * pixel
    return Parallax(float(np.median(lengths)), float(lengths.max()), float(sure.sum() / both.sum()))


def share(overlap: npt.NDArray[np.bool_], cells: Grid, regions: npt.NDArray[np.bool_] | None) -> float:
    """The share of an overlap that lies in `regions`, on the grid `cells` over the same region."""
    if regions is None:
        return 0.0
    reached = on_cells(overlap[None], cells, np.logical_or)[0]
    return float((reached & regions).sum() / max(1, reached.sum()))

"""An overlap in figures: how far things shift, how much of that is sure, where one layer is taken whole."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hugin_abflow.consistency import EXCLUDED, WeightedFlow
from hugin_abflow.geometry import Pair
from hugin_abflow.grid import Grid, on_cells
from hugin_abflow.working import WorkingLayer

_log = logging.getLogger(__name__)

# Trust (consistency.py, relay.py) from which a flow is sure: there and back again ends about a pixel from the
# start, or others tell it.
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


def parallax(found: WeightedFlow, grid: Grid) -> Parallax:
    """Of a pair's flow before it is filled, beside what is taken from one photo. grid: the working grid."""
    trusted, brightness = found.forward.get(), found.backward.get()[..., 3]
    both = np.logical_and(*((one != 0) & (one < EXCLUDED) for one in (trusted[..., 3], brightness)))
    sure = both & (trusted[..., 2] >= _SURE)
    if not sure.any():
        return Parallax(0.0, 0.0, 0.0)
    pixel = (grid.canvas_width or grid.region.width) / found.chart.circumference(grid)
    lengths = np.hypot(trusted[..., 0], trusted[..., 1])[sure] * pixel
    return Parallax(float(np.median(lengths)), float(lengths.max()), float(sure.sum() / both.sum()))


def share(overlap: npt.NDArray[np.bool_], cells: Grid, regions: npt.NDArray[np.bool_] | None) -> float:
    """The share of an overlap that lies in `regions`, on the grid `cells` over the same region."""
    if regions is None:
        return 0.0
    reached = on_cells(overlap[None], cells, np.logical_or)[0]
    return float((reached & regions).sum() / max(1, reached.sum()))


def report(
    layers: Sequence[WorkingLayer],
    pairs: Sequence[Pair],
    overlaps: Sequence[npt.NDArray[np.bool_]],
    parallaxes: Sequence[Parallax],
    cells: Grid,
    whole: npt.NDArray[np.bool_] | None,
) -> None:
    """Log of each overlap how far things shift in it, and how much of it is taken from one layer.

    The log record has the same as `overlap`, for reports.

    parallaxes  of `pairs`; empty where there is no flow.
    whole       where one layer was taken, on the grid `cells`; None: nowhere.
    """
    for number, pair in enumerate(pairs):
        a, b = layers[pair.a].layer, layers[pair.b].layer
        one_layer = share(overlaps[number], cells, whole) if parallaxes else 1.0
        found: dict[str, object] = {"layers": [a.name, b.name], "one_layer": round(one_layer, 4)}
        said = f"{one_layer:.0%} from one layer"
        if parallaxes:
            shift = parallaxes[number]
            found["parallax_median"], found["parallax_max"] = round(shift.median, 2), round(shift.largest, 2)
            found["consistent"] = round(shift.consistent, 4)
            said = (
                f"parallax {shift.median:.1f} px, up to {shift.largest:.1f} px; "
                f"{shift.consistent:.0%} consistent; {said}"
            )
        _log.info("overlap of %s and %s: %s", a.called, b.called, said, extra={"overlap": found})

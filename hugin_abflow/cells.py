"""Cells on the host: those of a chart, with a pair's flow, for what is taken from one photo, whole
(single.py); and what seams, regions and others do with cells of any grid.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from hugin_abflow.chart import Chart
from hugin_abflow.grid import Border, Grid
from hugin_abflow.pyramid import Level

Mask = npt.NDArray[np.bool_]
Flows = tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]
Places = npt.NDArray[np.float64]  # (n, 2): x right, y down, px of the chart; a pixel's centre at .5

# Cells of a chart, (height, width), by the number of the thing that they show; 0: none.
Things = npt.NDArray[np.int32]

# Chart pixels per cell; a cell has the flow at pixel CELL // 2 of it, whose centre is half a pixel right of
# and below the cell's.
CELL = 4
# Cells by which what is found is grown: flow is smooth across outlines.
GROWN = 3
# Cells of a thing, at least.
LEAST_CELLS = 20
# Chart pixels between start and return of a flow that is consistent.
CONSISTENT = 1.0

# A photo shows all of a thing if hardly any of its cells lie at the photo's border, beyond which the other
# photo goes on: no more than so many.
_FEW_AT_BORDER = 2
# And so many more, as a share of those that lie at the other photo's border.
_SHARE_AT_BORDER = 0.15
# Cells from a border that still lie at it.
_BORDER = 2


@dataclass(frozen=True)
class View:
    """What one photo shows on a chart, float32 (height, width): log brightness and its mask."""

    image: npt.NDArray[np.float32]
    mask: npt.NDArray[np.float32]

    @classmethod
    def of(cls, level: Level) -> View:
        """A copy of what is on the device."""
        return cls(level.image.get(), level.mask.get())

    @property
    def cells(self) -> Mask:
        """The cells whose centre it shows."""
        return at_centres(self.mask) > 0


@dataclass(frozen=True)
class SingleSource:
    """What is taken from a single photo of a pair, whole: where the first and where the second photo show it,
    cells of their chart.
    """

    first: Mask
    second: Mask

    @classmethod
    def of(cls, found: Sequence[Mask], wraps: bool) -> SingleSource | None:
        """What was found in each photo, and the cells around; None: nothing."""
        if not any(one.any() for one in found):
            return None
        first, second = (grown(one, GROWN, wraps) for one in found)
        return cls(first, second)

    def __or__(self, other: SingleSource) -> SingleSource:
        return SingleSource(self.first | other.first, self.second | other.second)

    def finer(self) -> SingleSource:
        """The same by cells of the chart of twice the resolution."""
        first, second = (one.repeat(2, 0).repeat(2, 1) for one in (self.first, self.second))
        return SingleSource(first, second)

    def on_canvas(self, chart: Chart, cells: Grid) -> Mask:
        """Cells of a grid over the canvas, (height, width), that show it, in either photo, or lie beside one
        that does.
        """
        rows, columns = (n.ravel() + 0.5 for n in np.indices(cells.shape))
        region = cells.region
        places = np.stack(
            [
                region.left + columns * region.width / cells.width,
                region.top + rows * region.height / cells.height,
            ],
            1,
        )
        found = np.zeros(cells.shape, bool)
        inside, (row, column) = cells_at(chart.positions(cells.points(places)), self.first.shape, chart)
        found.ravel()[inside] = (self.first | self.second)[row, column]
        return grown(found, 1, cells.wraps)


@dataclass(frozen=True)
class CellFlow:
    """Flow from one photo of a pair to the other, at the centres of cells.

    starts      (height, width, 2) px: the centres.
    ends        the same: where the flow leads.
    shown       whether both photos show where it starts and where it ends.
    consistent  whether, besides, the opposite flow leads back (forward-backward consistency).
    wraps       whether the columns of the chart are periodic.
    period      px after which places repeat, on the chart or beside it; 0: never (`Chart.period`).
    """

    starts: Places
    ends: Places
    shown: Mask
    consistent: Mask
    wraps: bool = False
    period: float = 0.0

    @classmethod
    def of(
        cls, chart: Chart, flows: Flows, views: tuple[View, View], index: int, gap: float = CONSISTENT
    ) -> CellFlow:
        """From photo `index` of a pair. gap: px between start and return that are still consistent."""
        flow = at_centres(flows[index]).astype(np.float64)
        rows, columns = np.indices(flow.shape[:2])
        starts = np.stack([columns, rows], -1).astype(np.float64) * CELL + CELL // 2 + 0.5
        inside, (row, column) = pixels_at(starts + flow, chart.border)
        there = np.where(inside, row, 0), np.where(inside, column, 0)
        shown = inside & views[index].cells & (views[1 - index].mask[there] > 0)
        consistent = shown & (np.linalg.norm(flow + flows[1 - index][there], axis=-1) < gap)
        return cls(starts, starts + flow, shown, consistent, chart.wraps, chart.period)

    @property
    def vectors(self) -> Places:
        """(height, width, 2) px, from cells' centres."""
        return self.ends - self.starts

    def confirmed(self, things: Things, control_points: tuple[Places, Places]) -> npt.NDArray[np.intp]:
        """The numbers of the things whose flow a control point agrees with.

        control_points  their places on the photo on which the flow starts, and on the other one.
        """
        starts, ends = control_points
        cell = np.floor(starts / CELL).astype(int)
        inside = (cell >= 0).all(1) & (cell[:, 0] < things.shape[1]) & (cell[:, 1] < things.shape[0])
        column, row = cell[inside].T
        off = self.ends[row, column] - ends[inside]
        off[:, 0] -= self.period * np.rint(off[:, 0] / (self.period or 1))
        agree = np.linalg.norm(off, axis=1) < CELL
        return np.unique(things[row[agree], column[agree]])


def at_centres(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """What pixels have, (height, width, ...), at cells' centres; cells cut short by the border count if they
    have that pixel.
    """
    return values[CELL // 2 :: CELL, CELL // 2 :: CELL]


def reached(ends: Places, shape: tuple[int, ...], chart: Chart) -> Mask:
    """The cells that flow leads to."""
    found = np.zeros(shape, bool)
    _, (row, column) = cells_at(ends, found.shape, chart)
    found[row, column] = True
    return found


def ends_within(
    shown: Sequence[Things], count: int, masks: tuple[Mask, Mask], wraps: bool
) -> npt.NDArray[np.bool_]:
    """Which things one photo shows as far as the other one does: they cross the other's border alone."""
    crossing = np.zeros((2, count))
    for number, (own, other) in enumerate((masks, masks[::-1])):
        border = grown(own & ~other, _BORDER, wraps)
        for its in shown:
            crossing[number] += np.bincount(its[border], minlength=count)
    within: npt.NDArray[np.bool_] = crossing.min(0) <= _FEW_AT_BORDER + _SHARE_AT_BORDER * crossing.max(0)
    within[0] = False
    return within


def grown(mask: Mask, by: int, wraps: bool) -> Mask:
    """With as many cells around, across a wrapped border, but not across poles."""
    modes = "constant", "wrap" if wraps else "constant"
    found: Mask = scipy.ndimage.maximum_filter(mask, 2 * by + 1, mode=modes)
    return found


def across_border(
    function: Callable[[npt.NDArray[Any]], npt.ArrayLike], values: npt.NDArray[Any], by: int, wraps: bool
) -> npt.NDArray[Any]:
    """The result of a function of SciPy, which takes no account of columns that wrap, for values (height,
    width). If they wrap, `by` columns of either side are first put beyond the other one, and then left out of
    the result.
    """
    if not wraps:
        return np.asarray(function(values))
    wider = np.pad(values, ((0, 0), (by, by)), mode="wrap")
    return np.asarray(function(wider))[..., by : by + values.shape[1]]


def averaged(values: npt.NDArray[np.floating], wraps: bool) -> npt.NDArray[np.floating]:
    """The means of 3 x 3 cells, (height, width, ...); beyond an edge, as a pole, lies what lies at it."""
    modes = "nearest", "wrap" if wraps else "nearest"
    return np.asarray(scipy.ndimage.uniform_filter(values, 3, mode=modes, axes=(0, 1)))


def neighbours(
    rows: npt.NDArray[np.intp], columns: npt.NDArray[np.intp], shape: tuple[int, ...], wraps: bool
) -> tuple[npt.NDArray[np.bool_], tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]]:
    """Which places lie on the grid, and rows and columns that can be read for all of them."""
    inside = (rows >= 0) & (rows < shape[0])
    if not wraps:
        inside &= (columns >= 0) & (columns < shape[1])
    return inside, (np.clip(rows, 0, shape[0] - 1), columns % shape[1])


def centres(cells: Grid, shape: Sequence[int]) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Rows and columns, of an array (..., height, width) over the same region, at the centres of cells."""
    row, column = (
        ((np.arange(to) + 0.5) * of / to).astype(np.intp)
        for to, of in zip(cells.shape, shape[-2:], strict=True)
    )
    return row, column


def cells_at(
    places: Places, shape: tuple[int, ...], chart: Chart
) -> tuple[Mask, tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]]:
    """Which places (n, 2) px lie on the chart, and the rows and columns of the cells of those."""
    inside, pixels = pixels_at(places, chart.border)
    at = (np.minimum(n[inside] // CELL, most - 1) for n, most in zip(pixels, shape, strict=True))
    return inside, (next(at), next(at))


def pixels_at(
    places: Places, border: Border
) -> tuple[Mask, tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]]:
    """Which places (..., 2) px lie on a grid (width, height, wraps, 0), and the rows and columns of all."""
    width, height, wraps, _ = border
    column, row = np.moveaxis(np.floor(places).astype(int), -1, 0)
    column = column % width if wraps else column
    return (row >= 0) & (row < height) & (column >= 0) & (column < width), (row, column)

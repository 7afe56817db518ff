"""Things that moved by themselves between two photos, told by their flow (on the host).

The flow of what stands still is parallax (epipolar.py). Somebody who took a step is matched like a near thing
where he has not left his place wholly; but halfway between two such matches he and what is beside him are
bent, as it did not move along. Flow that leads clearly away from parallax, in an overlap where all else is
parallax, and over a place where the photos differ without it, is of something that moved: consistency.py
fills its place with the flow of what is around, and seam.py takes it from one photo, whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from hugin_abflow import epipolar
from hugin_abflow.chart import Chart
from hugin_abflow.flow import Refused
from hugin_abflow.projection import Eye
from hugin_abflow.pyramid import Level
from hugin_abflow.working import Grid, connected

Mask = npt.NDArray[np.bool_]
Flows = tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]
Places = npt.NDArray[np.float64]  # (n, 2): x right, y down, px of the chart; a pixel's centre at .5

# Chart pixels per cell: a cell is told by the flow at its centre.
CELL = 4
# Chart pixels between start and return of a flow that is believed.
_CONSISTENT = 1.0
# By how much flow has to miss parallax: chart pixels at the canvas's centre, and times the third quartile of
# what all flow of the overlap misses it by; lenses and their places are not known exactly.
_APART, _SPREADS = 3.0, 5.0
# The share of a motion that has to lead elsewhere: a near thing's edge may be matched anywhere along itself,
# and misses parallax, but goes its way.
_ELSEWHERE = 0.5
# The share of the limit that is enough beside what misses parallax so far.
_WEAK = 0.3
# Cells of a thing.
_LEAST = 20
# Mean difference of log brightness that shows without the thing's own flow, and times that of what is around,
# as far as so many cells: plain walls and floors are matched with anything.
_DIFFERS, _MORE, _RING = 0.12, 2.0, 4
# Of a mask, between pixels: all of them show something.
_SHOWN = 0.999
# Cells by which what was found is grown: flow is smooth across outlines.
_GROWN = 3


@dataclass(frozen=True)
class View:
    """What one photo shows on a chart, float32 (height, width): log brightness and its mask."""

    image: npt.NDArray[np.float32]
    mask: npt.NDArray[np.float32]

    @classmethod
    def of(cls, level: Level) -> View:
        """A copy of what is on the device."""
        return cls(level.image.get(), level.mask.get())


@dataclass(frozen=True)
class Movers:
    """Where the first and the second photo of a pair show what moved: cells of their chart."""

    first: Mask
    second: Mask


@dataclass(frozen=True)
class _Way:
    """Flow that starts on one photo, by cells.

    ends        (height, width, 2) px, where it leads.
    flow        the same, from cells' centres.
    shown       whether both photos show where it starts and where it leads.
    believed    whether the opposite flow leads back, too.
    u, v        (height * width, 3): where the first and the second photo show it.
    around      columns of a chart that wraps, px; else 0.
    """

    ends: Places
    flow: Places
    shown: Mask
    believed: Mask
    u: epipolar.Points
    v: epipolar.Points
    around: int = 0


def find(
    chart: Chart, flows: Flows, views: tuple[View, View], vouched: tuple[Places, Places],
    refused: Sequence[Refused] = (),
) -> Movers | None:  # fmt: skip
    """What moved by itself; None, too, where nothing tells how the camera moved: flow does not, or it is not
    known in what directions the chart shows its places.

    flows       from the first to the second photo and back, float32 (height, width, 2), chart px.
    vouched     where somebody says that both show the same: what is matched so is left alone.
    refused     what a search found besides.
    """
    if not chart.eye:
        return None
    ways = [_way(chart, chart.eye, flows, views, index, _CONSISTENT) for index in (0, 1)]
    u = np.concatenate([way.u[way.believed.ravel()] for way in ways])
    v = np.concatenate([way.v[way.believed.ravel()] for way in ways])
    direction = epipolar.known_move(u, v)
    if direction is None:
        return None
    scale = chart.eye.down
    limit = max(_APART, _SPREADS * scale * float(np.percentile(epipolar.across(u, v, direction), 75)))
    found = [np.zeros(way.shown.shape, bool) for way in ways]
    every = [(index, False, way) for index, way in enumerate(ways)]
    for one in refused:
        wide, gap = one.finest(chart.width, chart.height), _CONSISTENT * max(1.0, 2.0 ** (one.level - 1))
        every += [(index, True, _way(chart, chart.eye, wide, views, index, gap)) for index in (0, 1)]
    for index, searched, way in every:
        across = epipolar.across(way.u, way.v, direction)
        apart = scale * across / limit
        its_way = across < _ELSEWHERE * np.linalg.norm(way.v - way.u, axis=1)
        apart = np.where(its_way, np.minimum(apart, 1.0), apart).reshape(way.shown.shape)
        if searched:  # only what is certain
            apart *= way.believed
        its = _things(way, apart, (views[index], views[1 - index]), (vouched[index], vouched[1 - index]))
        found[index] |= its
        found[1 - index] |= _reached(way.ends[its & way.believed], its.shape, chart)
    if not any(one.any() for one in found):
        return None
    first, second = (_grown(one, _GROWN, chart.wraps) for one in found)
    return Movers(first, second)


def _things(way: _Way, apart: Places, views: tuple[View, View], vouched: tuple[Places, Places]) -> Mask:
    """The cells of what moves by itself; apart: by how much each misses parallax, of the limit."""
    things = connected(apart > _WEAK, way.around > 0)
    kept = np.bincount(things[(apart > 1) & way.shown], minlength=things.max() + 1) >= _LEAST
    kept[_vouched(things, way, *vouched)] = False
    for thing in np.flatnonzero(kept):
        kept[thing] = _differs(*views, way, things == thing)
    its: Mask = kept[things]
    return its


def on_canvas(movers: Movers, chart: Chart, cells: Grid) -> Mask:
    """Cells of a grid over the canvas, (height, width), that show what moved, in either photo, or lie beside
    one that does.
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
    inside, (row, column) = _cells(chart.positions(cells.points(places)), movers.first.shape, chart)
    found.ravel()[inside] = (movers.first | movers.second)[row, column]
    return _grown(found, 1, cells.wraps)


def _way(
    chart: Chart,
    eye: Eye,
    flows: Flows,
    views: tuple[View, View],
    index: int,
    gap: float,
) -> _Way:
    """Of flow from photo `index` of a pair; gap: px between start and return that are believed."""
    middle = np.s_[CELL // 2 :: CELL, CELL // 2 :: CELL]
    flow = flows[index][middle].astype(np.float64)
    rows, columns = np.indices(flow.shape[:2])
    starts = np.stack([columns, rows], -1).astype(np.float64) * CELL + CELL // 2 + 0.5
    ends = starts + flow
    inside, (row, column) = _pixels(ends, chart)
    there = np.where(inside, row, 0), np.where(inside, column, 0)
    shown = inside & (views[index].mask[middle] > 0) & (views[1 - index].mask[there] > 0)
    believed = shown & (np.linalg.norm(flow + flows[1 - index][there], axis=-1) < gap)
    seen = eye.bearings(starts.reshape(-1, 2)), eye.bearings(ends.reshape(-1, 2))
    return _Way(ends, flow, shown, believed, seen[index], seen[1 - index], chart.width * chart.wraps)


def _vouched(things: npt.NDArray[np.int32], way: _Way, starts: Places, ends: Places) -> npt.NDArray[np.intp]:
    """The numbers of the things that somebody says are matched as their flow has it."""
    cell = np.floor(starts / CELL).astype(int)
    inside = (cell >= 0).all(1) & (cell[:, 0] < things.shape[1]) & (cell[:, 1] < things.shape[0])
    column, row = cell[inside].T
    off = way.ends[row, column] - ends[inside]
    off[:, 0] -= way.around * np.rint(off[:, 0] / (way.around or 1))
    agree = np.linalg.norm(off, axis=1) < CELL
    return np.unique(things[row[agree], column[agree]])


def _differs(here: View, there: View, way: _Way, thing: Mask) -> bool:
    """Whether the photos differ in a thing's place if it moves as what is around, more than they do there.

    What is across the border of a chart that wraps does not count as around.
    """
    grown = _grown(thing, _GROWN, wraps=False)
    ring = np.nonzero(_grown(grown, _RING, wraps=False) & ~grown & way.believed)
    its = np.nonzero(thing & way.shown)
    if min(len(ring[0]), len(its[0])) < _LEAST:
        return False
    unknown = grown | ~way.believed
    nearest = scipy.ndimage.distance_transform_edt(unknown, return_distances=False, return_indices=True)
    beside = _difference(here, there, ring, way.flow[ring])
    inside = _difference(here, there, its, way.flow[tuple(nearest[:, its[0], its[1]])])
    if min(beside.size, inside.size) < _LEAST:
        return False
    exposure = np.median(beside)
    off, around = (np.abs(one - exposure).mean() for one in (inside, beside))
    return bool(off >= max(_DIFFERS, _MORE * around))


def _difference(
    here: View, there: View, cells: tuple[npt.NDArray[np.intp], ...], flow: Places
) -> npt.NDArray[np.float32]:
    """(n,): of log brightness, at cells' centres and where flow leads from there, if both are shown."""
    row, column = (n * CELL + CELL // 2 for n in cells)
    place = row + flow[:, 1], column + flow[:, 0]
    image, mask = (scipy.ndimage.map_coordinates(one, place, order=1) for one in (there.image, there.mask))
    shown = mask > _SHOWN
    found: npt.NDArray[np.float32] = (here.image[row, column] - image)[shown]
    return found


def _reached(ends: Places, shape: tuple[int, int], chart: Chart) -> Mask:
    """The cells that flow leads to."""
    reached = np.zeros(shape, bool)
    _, (row, column) = _cells(ends, shape, chart)
    reached[row, column] = True
    return reached


def _cells(
    places: Places, shape: tuple[int, int], chart: Chart
) -> tuple[Mask, tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]]:
    """Which places (n, 2) px lie on the chart, and the rows and columns of the cells of those."""
    inside, pixels = _pixels(places, chart)
    at = (np.minimum(n[inside] // CELL, most - 1) for n, most in zip(pixels, shape, strict=True))
    return inside, (next(at), next(at))


def _pixels(places: Places, chart: Chart) -> tuple[Mask, tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]]:
    """Which places (..., 2) px lie on the chart, and the rows and columns of all."""
    column, row = np.moveaxis(np.floor(places).astype(int), -1, 0)
    column = column % chart.width if chart.wraps else column
    return (row >= 0) & (row < chart.height) & (column >= 0) & (column < chart.width), (row, column)


def _grown(mask: Mask, by: int, wraps: bool) -> Mask:
    modes = "constant", "wrap" if wraps else "constant"
    grown: Mask = scipy.ndimage.maximum_filter(mask, 2 * by + 1, mode=modes)
    return grown

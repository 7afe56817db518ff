"""Near things that would change over too quickly, told by their flow (on the host).

A near thing shifts by more than what is behind it, and goes from its place in one photo to that in the
other within their overlap: it is bent, by a strain (transition.py) of what it shifts by more over the
overlap's width. Where that is much it looks bent, and flow is of no help. But if it ends within the overlap,
one of the photos shows all of it that the other one does: consistency.py fills its place with the flow of
what is behind, and seam.py takes it from that photo, whole. What crosses the overlap from one photo's border
to the other's is left alone: taken from either, it would break at a border.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from itertools import compress
from operator import or_

import numpy as np
import numpy.typing as npt
import scipy

from hugin_abflow.cells import CELL, LEAST, Flows, Mask, Places, View, Way, Whole, at_centres, grown, reached
from hugin_abflow.chart import Chart
from hugin_abflow.working import connected

# Chart pixels by which flow may differ from cell to cell within a surface.
_ALIKE = 0.75
# Cells of a surface that is behind things, and its share of what both photos show.
_WIDE, _SHARE = 40, 0.15
# Chart pixels by which a thing's flow differs from that of what is behind it.
_APART = 4.0
# Strain from which on a thing is beyond repair.
_STRAIN = 0.1
# Cells beside a thing that may lie beyond a photo's border and its other photo still show all of it, and
# their share of those beyond the other's.
_FEW, _FEWER = 2, 0.15
# Cells that a thing's outline is smoothed by, and beside it, in which a border is looked for.
_CLOSED, _BESIDE = 2, 2


@dataclass(frozen=True)
class _Thing:
    """Where each photo of a pair shows it, and its strain."""

    shown: tuple[Mask, Mask]
    strain: float

    def meets(self, other: _Thing) -> bool:
        """Whether it is the same, in both photos."""
        return all((a & b).any() for a, b in zip(self.shown, other.shown, strict=True))

    def __or__(self, other: _Thing) -> _Thing:
        first, second = (a | b for a, b in zip(self.shown, other.shown, strict=True))
        return _Thing((first, second), max(self.strain, other.strain))


def find(
    chart: Chart, flows: Flows, views: tuple[View, View], vouched: tuple[Places, Places]
) -> Whole | None:
    """What is to be taken from one photo.

    flows       from the first to the second photo and back, float32 (height, width, 2), chart px.
    vouched     where somebody says that both show the same: what is matched so is left alone.
    """
    masks = at_centres(views[0].mask) > 0, at_centres(views[1].mask) > 0
    width = _width(masks, chart.wraps)
    things: list[_Thing] = []
    for index in (0, 1):
        way = Way.of(chart, flows, views, index)
        for its, strain in _standing_out(way, width, (vouched[index], vouched[1 - index])):
            there = reached(way.ends[its], its.shape, chart)
            ends = (its, there) if index == 0 else (there, its)
            found = _Thing((_filled(ends[0], chart.wraps), _filled(ends[1], chart.wraps)), strain)
            same = [one.meets(found) for one in things]
            found = reduce(or_, compress(things, same), found)
            things = [one for one, is_same in zip(things, same, strict=True) if not is_same] + [found]
    places = [np.zeros(width.shape, bool) for _ in masks]
    for thing in things:
        if thing.strain >= _STRAIN and _ends_within(thing, masks, chart.wraps):
            places = [one | its for one, its in zip(places, thing.shown, strict=True)]
    return Whole.of(places, chart.wraps)


def _standing_out(
    way: Way, width: npt.NDArray[np.float64], vouched: tuple[Places, Places]
) -> Iterator[tuple[Mask, float]]:
    """The cells of each thing that stands out of what is behind it, and its strain."""
    surfaces = _surfaces(way)
    sizes = np.bincount(surfaces[way.believed], minlength=surfaces.max() + 1)
    behind = way.believed & (sizes >= max(_WIDE, _SHARE * np.count_nonzero(way.shown)))[surfaces]
    if not behind.any():
        return
    around = way.flow[_nearest(behind, way.around > 0)]
    own = np.linalg.norm(way.flow - around, axis=-1)
    longer = np.linalg.norm(way.flow, axis=-1) > np.linalg.norm(around, axis=-1)
    things = connected((own > _APART) & longer & way.shown, way.around > 0)
    told = np.bincount(things[way.believed], minlength=things.max() + 1) >= LEAST
    told[0] = False
    told[way.vouched(things, vouched)] = False
    for number in np.flatnonzero(told):
        its = things == number
        yield its, float(np.median(own[its & way.believed]) / np.median(width[its]))


def _surfaces(way: Way) -> npt.NDArray[np.int32]:
    """Cells side by side whose flows are believed and alike, numbered; each other one has its own number."""
    number = np.arange(way.shown.size).reshape(way.shown.shape)
    links = [_alike(way, np.s_[:, :-1], np.s_[:, 1:]), _alike(way, np.s_[:-1], np.s_[1:])]
    if way.around:
        links.append(_alike(way, np.s_[:, -1:], np.s_[:, :1]))
    first, second = (np.concatenate([number[ends[k]][alike] for *ends, alike in links]) for k in (0, 1))
    graph = scipy.sparse.csr_array((np.ones(first.size), (first, second)), shape=(number.size, number.size))
    found: npt.NDArray[np.int32] = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    return found.reshape(number.shape)


def _alike(
    way: Way, first: tuple[slice, ...] | slice, second: tuple[slice, ...] | slice
) -> tuple[tuple[slice, ...] | slice, tuple[slice, ...] | slice, Mask]:
    """Which of the cells `first` have a flow like that of their neighbours `second`."""
    near = np.linalg.norm(way.flow[first] - way.flow[second], axis=-1) < _ALIKE
    return first, second, way.believed[first] & way.believed[second] & near


def _nearest(mask: Mask, wraps: bool) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Rows and columns of the cell of a mask that is nearest to each cell."""
    columns = mask.shape[1]
    tiled = np.tile(mask, 3) if wraps else mask
    row, column = scipy.ndimage.distance_transform_edt(~tiled, return_distances=False, return_indices=True)
    middle = np.s_[:, columns : 2 * columns] if wraps else np.s_[:, :]
    return row[middle], column[middle] % columns


def _width(masks: tuple[Mask, Mask], wraps: bool) -> npt.NDArray[np.float64]:
    """How wide the overlap is at each cell, px: from the border of one photo, where the other one goes on, to
    that of the other.
    """
    total = np.zeros(masks[0].shape)
    for own, other in (masks, masks[::-1]):
        beyond = np.tile(other & ~own, 3 if wraps else 1)
        if not beyond.any():
            return np.full(total.shape, np.inf)
        distance = scipy.ndimage.distance_transform_edt(~beyond)
        total += distance[:, own.shape[1] : 2 * own.shape[1]] if wraps else distance
    return CELL * total


def _filled(mask: Mask, wraps: bool) -> Mask:
    """A mask without gaps and holes."""
    wider = grown(np.pad(mask, ((_CLOSED, _CLOSED), (0, 0))), _CLOSED, wraps)
    modes = "constant", "wrap" if wraps else "constant"
    closed = scipy.ndimage.minimum_filter(wider, 2 * _CLOSED + 1, mode=modes, cval=1)[_CLOSED:-_CLOSED]
    filled: Mask = scipy.ndimage.binary_fill_holes(closed)
    return filled


def _ends_within(thing: _Thing, masks: tuple[Mask, Mask], wraps: bool) -> bool:
    """Whether one photo shows all of a thing that the other one does: it crosses the other's border alone."""
    beside = [grown(shown, _BESIDE, wraps) for shown in thing.shown]
    beyond = [
        sum(np.count_nonzero(its & own & ~other) for its in beside) for own, other in (masks, masks[::-1])
    ]
    return bool(min(beyond) <= _FEW + _FEWER * max(beyond))

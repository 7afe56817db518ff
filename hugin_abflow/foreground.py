"""Near things that would change over too quickly, told by their flow (on the host).

A near thing shifts by more than what is behind it, and goes from its place in one photo to that in the
other within their overlap: it is bent, by a strain (transition.py) of what it shifts by more over the
overlap's width. Transitions go round it, but not where it is too near to a photo's border for that: there it
looks bent, and flow is of no help. But if it ends within the overlap, one of the photos shows all of it that
the other one does: consistency.py fills its place with the flow of what is behind, and seam.py takes it from
that photo, whole. What crosses the overlap from one photo's border to the other's is left alone: taken from
either, it would break at a border.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from hugin_abflow.cells import (
    CELL,
    LEAST,
    Flows,
    Mask,
    Places,
    Things,
    View,
    Way,
    Whole,
    cells_at,
    ends_within,
    grown,
)
from hugin_abflow.chart import Chart
from hugin_abflow.working import connected

# Chart pixels by which flow may differ from cell to cell within a surface.
_ALIKE = 0.75
# Cells of a surface that is behind things, and its share of what both photos show.
_WIDE, _SHARE = 40, 0.15
# Chart pixels by which a thing's flow differs from that of what is behind it, at least and in its median.
_APART, _FAR = 4.0, 6.0
# Strain from which on a thing is taken whole.
_STRAIN = 0.08
# Cells that a thing's outline is smoothed by.
_CLOSED = 2


def find(
    chart: Chart, flows: Flows, views: tuple[View, View], vouched: tuple[Places, Places]
) -> Whole | None:
    """What is to be taken from one photo.

    flows       from the first to the second photo and back, float32 (height, width, 2), chart px.
    vouched     where somebody says that both show the same: what is matched so is left alone.
    """
    masks = views[0].cells, views[1].cells
    ways = [Way.of(chart, flows, views, index) for index in (0, 1)]
    if not all(way.believed.any() for way in ways):
        return None
    width = _width(masks, chart.wraps)
    found = [_standing_out(way, width, (vouched[k], vouched[1 - k])) for k, way in enumerate(ways)]
    shown, strain = _joined(chart, ways, found)
    kept = (strain >= _STRAIN) & ends_within(shown, len(strain), masks, chart.wraps)
    return Whole.of([_filled(kept[its], chart.wraps) for its in shown], chart.wraps)


def _standing_out(
    way: Way, width: npt.NDArray[np.float64], vouched: tuple[Places, Places]
) -> tuple[Things, npt.NDArray[np.float64]]:
    """The things that stand out of what is behind them, and the strain of each number, 0 of 0."""
    surfaces = _surfaces(way)
    sizes = np.bincount(surfaces[way.believed], minlength=surfaces.max() + 1)
    behind = (sizes >= max(_WIDE, _SHARE * np.count_nonzero(way.shown)))[surfaces]
    if not behind.any():
        return np.zeros(behind.shape, np.int32), np.zeros(1)
    around = way.flow[_nearest(behind, way.around > 0)]
    own = np.linalg.norm(way.flow - around, axis=-1)
    longer = np.linalg.norm(way.flow, axis=-1) > np.linalg.norm(around, axis=-1)
    parts = connected((own > _APART) & longer & way.shown, way.around > 0)
    told = np.bincount(parts[way.believed], minlength=parts.max() + 1) >= LEAST
    told[0] = False
    told[way.vouched(parts, vouched)] = False
    numbers = np.flatnonzero(told)
    shift = scipy.ndimage.median(own, np.where(way.believed, parts, 0), numbers)
    strain = np.where(shift >= _FAR, shift / scipy.ndimage.median(width, parts, numbers), 0.0)
    new = np.zeros(told.size, np.int32)
    new[numbers] = np.arange(1, numbers.size + 1)
    return new[parts], np.concatenate([[0.0], strain])


def _joined(
    chart: Chart, ways: Sequence[Way], found: Sequence[tuple[Things, npt.NDArray[np.float64]]]
) -> tuple[list[Things], npt.NDArray[np.float64]]:
    """Where each photo shows the things that were found by flow from either, and the strain of each number:
    two that lead to each other are one.
    """
    (first, strain), (second, other_strain) = found
    second = np.where(second > 0, second + strain.size - 1, 0)
    count = strain.size + other_strain.size - 1
    shown, led = [first.copy(), second.copy()], []
    for its, there, place, way in zip((first, second), (second, first), shown[::-1], ways, strict=True):
        inside, (row, column) = cells_at(way.ends[its > 0], its.shape, chart)
        number, met = its[its > 0][inside], there[row, column]
        led.append(np.unique((np.minimum(number, met) * count + np.maximum(number, met))[met > 0]))
        place[row, column] = np.where(met > 0, met, number)
    same = np.divmod(np.intersect1d(led[0], led[1]), count)
    graph = scipy.sparse.csr_array((np.ones(same[0].size), same), shape=(count, count))
    total, thing = scipy.sparse.csgraph.connected_components(graph, directed=False)
    strains = np.zeros(total)
    np.maximum.at(strains, thing, np.concatenate([strain, other_strain[1:]]))
    return [thing[its] for its in shown], strains


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
    indices = partial(scipy.ndimage.distance_transform_edt, return_distances=False, return_indices=True)
    row, column = _all_around(indices, ~mask, wraps)
    return row, column % mask.shape[1]


def _width(masks: tuple[Mask, Mask], wraps: bool) -> npt.NDArray[np.float64]:
    """How wide the overlap is at each cell, px: from the border of one photo, where the other one goes on, to
    that of the other. Without end if one has no such border: then one of them shows all.
    """
    total = np.zeros(masks[0].shape)
    for own, other in (masks, masks[::-1]):
        within = own | ~other
        if within.all():
            return np.full(total.shape, np.inf)
        total += _all_around(scipy.ndimage.distance_transform_edt, within, wraps)
    return CELL * total


def _filled(mask: Mask, wraps: bool) -> Mask:
    """A mask without gaps and holes."""
    wider = grown(np.pad(mask, ((_CLOSED, _CLOSED), (0, 0))), _CLOSED, wraps)
    modes = "constant", "wrap" if wraps else "constant"
    closed = scipy.ndimage.minimum_filter(wider, 2 * _CLOSED + 1, mode=modes, cval=1)[_CLOSED:-_CLOSED]
    return _all_around(scipy.ndimage.binary_fill_holes, closed, wraps)


def _all_around(function: Callable[[Mask], Any], mask: Mask, wraps: bool) -> npt.NDArray[Any]:
    """What a function of SciPy that knows no columns which wrap makes of a mask, (..., height, width)."""
    columns = mask.shape[1]
    return np.asarray(function(np.tile(mask, 3))[..., columns : 2 * columns] if wraps else function(mask))

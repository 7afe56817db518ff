"""Near things that blending would bend, though flow matches them (on the host).

A near thing shifts by more than what is behind it. Within the overlap it goes from its place in one photo to
its place in the other, and is bent: by a strain (transition.py) of its additional shift over the overlap's
width. Transitions go round near things; but where one is too near to a photo's border there is no room for
that, and it looks bent, although its flow is right.

If the thing ends within the overlap, one of the photos shows all of it that the other one does. Then it can
be taken from that photo, whole (seam.py), and its place is filled with the flow of what is behind it
(consistency.py). A thing that crosses the overlap from one photo's border to the other's is left alone:
taken from either, it would break at a border.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
import scipy

from hugin_abflow.cells import (
    CELL,
    LEAST_CELLS,
    CellFlow,
    Flows,
    Mask,
    Places,
    SingleSource,
    Things,
    View,
    across_border,
    cells_at,
    ends_within,
    grown,
)
from hugin_abflow.chart import Chart
from hugin_abflow.grid import connected

# Chart pixels by which flow may differ from cell to cell within a surface.
_ALIKE = 0.75
# Cells that a surface has, at least, for it to be behind things.
_WIDE = 40
# The share of what both photos show that it has, at least.
_SHARE = 0.15
# Chart pixels by which flow differs in each cell of a thing from that of what is behind it, at least.
_APART = 4.0
# The same for the median of the thing's cells.
_FAR = 6.0
# Strain from which on a thing is taken whole.
_STRAIN = 0.08
# Cells that a thing's outline is smoothed by.
_CLOSED = 2


def find(
    chart: Chart, flows: Flows, views: tuple[View, View], control_points: tuple[Places, Places]
) -> SingleSource | None:
    """What is to be taken from one photo.

    flows           from the first to the second photo and back, float32 (height, width, 2), chart px.
    control_points  their places on both photos: what they say is matched rightly is left alone.
    """
    masks = views[0].cells, views[1].cells
    cell_flows = [CellFlow.of(chart, flows, views, index) for index in (0, 1)]
    if not all(flow.consistent.any() for flow in cell_flows):
        return None
    width = _width(masks, chart.wraps)
    first, second = (
        _near_things(flow, width, (control_points[k], control_points[1 - k]))
        for k, flow in enumerate(cell_flows)
    )
    shown, strain = _joined(chart, cell_flows, first, second)
    kept = (strain >= _STRAIN) & ends_within(shown, len(strain), masks, chart.wraps)
    return SingleSource.of([_filled(kept[its], chart.wraps) for its in shown], chart.wraps)


@dataclass(frozen=True)
class _NearThings:
    """Things that are nearer than what is behind them. strain: of each by its number, 0 of 0."""

    things: Things
    strain: npt.NDArray[np.float64]


def _near_things(
    flow: CellFlow, width: npt.NDArray[np.float64], control_points: tuple[Places, Places]
) -> _NearThings:
    """What shifts by more than the large surface that is nearest to it. width: of the overlap, px."""
    surfaces = _surfaces(flow)
    sizes = np.bincount(surfaces[flow.consistent], minlength=surfaces.max() + 1)
    behind = (sizes >= max(_WIDE, _SHARE * np.count_nonzero(flow.shown)))[surfaces]
    if not behind.any():
        return _NearThings(np.zeros(behind.shape, np.int32), np.zeros(1))
    around = flow.vectors[_nearest(behind, flow.wraps)]
    own = np.linalg.norm(flow.vectors - around, axis=-1)
    longer = np.linalg.norm(flow.vectors, axis=-1) > np.linalg.norm(around, axis=-1)
    parts = connected((own > _APART) & longer & flow.shown, flow.wraps)
    kept = np.bincount(parts[flow.consistent], minlength=parts.max() + 1) >= LEAST_CELLS
    kept[0] = False
    kept[flow.confirmed(parts, control_points)] = False
    numbers = np.flatnonzero(kept)
    shift = scipy.ndimage.median(own, np.where(flow.consistent, parts, 0), numbers)
    strain = np.where(shift >= _FAR, shift / scipy.ndimage.median(width, parts, numbers), 0.0)
    new = np.zeros(kept.size, np.int32)
    new[numbers] = np.arange(1, numbers.size + 1)
    return _NearThings(new[parts], np.concatenate([[0.0], strain]))


def _joined(
    chart: Chart, cell_flows: Sequence[CellFlow], from_first: _NearThings, from_second: _NearThings
) -> tuple[list[Things], npt.NDArray[np.float64]]:
    """Where each photo shows the things that were found by flow from either, and the strain of each number:
    two that lead to each other are one.
    """
    first, strain, other_strain = from_first.things, from_first.strain, from_second.strain
    second = np.where(from_second.things > 0, from_second.things + strain.size - 1, 0)
    count = strain.size + other_strain.size - 1
    shown, led = [first.copy(), second.copy()], []
    for its, there, place, flow in zip(
        (first, second), (second, first), shown[::-1], cell_flows, strict=True
    ):
        inside, (row, column) = cells_at(flow.ends[its > 0], its.shape, chart)
        number, met = its[its > 0][inside], there[row, column]
        led.append(np.unique((np.minimum(number, met) * count + np.maximum(number, met))[met > 0]))
        place[row, column] = np.where(met > 0, met, number)
    same = np.divmod(np.intersect1d(led[0], led[1]), count)
    graph = scipy.sparse.csr_array((np.ones(same[0].size), same), shape=(count, count))
    total, thing = scipy.sparse.csgraph.connected_components(graph, directed=False)
    strains = np.zeros(total)
    np.maximum.at(strains, thing, np.concatenate([strain, other_strain[1:]]))
    return [thing[its] for its in shown], strains


def _surfaces(flow: CellFlow) -> npt.NDArray[np.int32]:
    """Adjacent cells whose flows are consistent and alike share a number; each other one has its own."""
    number = np.arange(flow.shown.size).reshape(flow.shown.shape)
    links = [_alike(flow, np.s_[:, :-1], np.s_[:, 1:]), _alike(flow, np.s_[:-1], np.s_[1:])]
    if flow.wraps:
        links.append(_alike(flow, np.s_[:, -1:], np.s_[:, :1]))
    first, second = (np.concatenate([number[ends[k]][alike] for *ends, alike in links]) for k in (0, 1))
    graph = scipy.sparse.csr_array((np.ones(first.size), (first, second)), shape=(number.size, number.size))
    found: npt.NDArray[np.int32] = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    return found.reshape(number.shape)


def _alike(
    flow: CellFlow, first: tuple[slice, ...] | slice, second: tuple[slice, ...] | slice
) -> tuple[tuple[slice, ...] | slice, tuple[slice, ...] | slice, Mask]:
    """Which of the cells `first` have a flow like that of their neighbours `second`."""
    near = np.linalg.norm(flow.vectors[first] - flow.vectors[second], axis=-1) < _ALIKE
    return first, second, flow.consistent[first] & flow.consistent[second] & near


def _nearest(mask: Mask, wraps: bool) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Rows and columns of the cell of a mask that is nearest to each cell."""
    indices = partial(scipy.ndimage.distance_transform_edt, return_distances=False, return_indices=True)
    row, column = across_border(indices, ~mask, mask.shape[1], wraps)
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
        total += across_border(scipy.ndimage.distance_transform_edt, within, within.shape[1], wraps)
    return CELL * total


def _filled(mask: Mask, wraps: bool) -> Mask:
    """A mask without gaps and holes."""
    wider = grown(np.pad(mask, ((_CLOSED, _CLOSED), (0, 0))), _CLOSED, wraps)
    modes = "constant", "wrap" if wraps else "constant"
    closed = scipy.ndimage.minimum_filter(wider, 2 * _CLOSED + 1, mode=modes, cval=1)[_CLOSED:-_CLOSED]
    return across_border(scipy.ndimage.binary_fill_holes, closed, closed.shape[1], wraps)

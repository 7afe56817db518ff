"""Things that moved by themselves between two photos, told by their flow (on the host).

The flow of what stands still is parallax (epipolar.py). Somebody who took a step is matched like a near thing
where he has not left his place wholly; but halfway between two such matches he and what is beside him are
bent, as it did not move along. Flow that leads clearly away from parallax, in an overlap where all else is
parallax, and over a place where the photos differ without it, is of something that moved. If one photo shows
all of it that the other one does, consistency.py fills its place with the flow of what is around, and seam.py
takes it from that photo, whole.

What repeats, as bars of a railing, fits the next ones nearly as well, and that leads elsewhere than parallax.
So flow that hardly leads back from a thing tells of nobody. Nor does flow that a search found and nothing
uses, unless it explains clearly more than that of what is around, and than the flow that is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from hugin_abflow import epipolar
from hugin_abflow.cells import (
    CELL,
    CONSISTENT,
    GROWN,
    LEAST_CELLS,
    CellFlow,
    Flows,
    Mask,
    Places,
    SingleSource,
    View,
    ends_within,
    grown,
    reached,
)
from hugin_abflow.chart import Chart
from hugin_abflow.decision import Refused
from hugin_abflow.grid import connected

# By how much flow has to miss parallax, in chart pixels at the canvas's centre.
_APART = 3.0
# The same, times the third quartile of what all flow of the overlap misses it by: lenses and their places are
# not known exactly. The larger of both is the limit.
_SPREADS = 5.0
# The share of a motion that has to lead elsewhere: a near thing's edge may be matched anywhere along itself,
# and misses parallax, but goes its way.
_ELSEWHERE = 0.5
# The share of the limit that is enough beside what misses parallax so far.
_WEAK = 0.3
# The share of a thing's cells that have to miss it so far, and be shown by both photos: of a near thing an
# edge may, where flow errs.
_CLEAR = 0.125
# The share from which flow has to lead back, for it to know of the thing: else nothing is matched.
_KNOWN = 0.125
# By how much the photos have to differ in a thing's place without its own flow: mean deviation of differences
# of log brightness from their median. Plain walls and floors are matched with anything.
_DIFFERS = 0.12
# The same, times what they differ by around the thing.
_MORE = 2.0
# Flow that nothing uses tells of somebody only if it leaves less than this share of the difference that flow
# of what is around leaves, or the flow that is used, whichever explains more.
_REMAINS = 0.75
# Cells from a thing up to which others are around it.
_RING = 4
# Of a mask, between pixels: all of them show something.
_SHOWN = 0.999


def find(
    chart: Chart, flows: Flows, views: tuple[View, View], control_points: tuple[Places, Places],
    refused: Sequence[Refused] = (),
) -> SingleSource | None:  # fmt: skip
    """What moved by itself. None: nothing, or it is not known how the camera moved, since too little flow
    tells it, or the chart's projection is not known.

    flows           from the first to the second photo and back, float32 (height, width, 2), chart px.
    control_points  their places on both photos: what they say is matched rightly is left alone.
    refused         flow that a search found besides.
    """
    if not chart.projection:
        return None
    matches = [_Matches.of(chart, flows, views, index) for index in (0, 1)]
    u, v = (
        np.concatenate([one.seen[photo][one.flow.consistent.ravel()] for one in matches]) for photo in (0, 1)
    )
    direction = epipolar.known_move(u, v)
    if direction is None:
        return None
    scale = chart.projection.focal_y
    limit = max(_APART, _SPREADS * scale * float(np.percentile(epipolar.across(u, v, direction), 75)))
    found = [np.zeros(one.flow.shown.shape, bool) for one in matches]
    for candidate in refused:
        finest = candidate.finest(chart.width, chart.height)
        # a search is as exact as half a pixel of the level that it was made on
        gap = CONSISTENT * max(1.0, 2.0 ** (candidate.level - 1))
        matches += [_Matches.of(chart, finest, views, index, gap, refused=True) for index in (0, 1)]
    for one in matches:
        off_parallax = one.off_parallax(direction, scale, limit)
        if one.refused:  # only what is certain
            off_parallax *= one.flow.consistent
        here, there = one.index, 1 - one.index
        moved = _moved(
            chart, one.flow, off_parallax, (views[here], views[there]),
            (control_points[here], control_points[there]), matches[here].flow,
        )  # fmt: skip
        found[here] |= moved
        found[there] |= reached(one.flow.ends[moved & one.flow.consistent], moved.shape, chart)
    return SingleSource.of(found, chart.wraps)


@dataclass(frozen=True)
class _Matches:
    """What flow from photo `index` of a pair matches, by cells.

    seen        in what directions the first and the second photo show it: unit vectors (height * width, 3).
    refused     whether it is flow that a search found and that was refused.
    """

    index: int
    flow: CellFlow
    seen: tuple[epipolar.Points, epipolar.Points]
    refused: bool

    @classmethod
    def of(
        cls, chart: Chart, flows: Flows, views: tuple[View, View], index: int, gap: float = CONSISTENT,
        refused: bool = False,
    ) -> _Matches:  # fmt: skip
        """Of a chart whose projection is known; gap: as of `CellFlow.of`."""
        assert chart.projection is not None
        flow = CellFlow.of(chart, flows, views, index, gap)
        start, end = (chart.projection.bearings(one.reshape(-1, 2)) for one in (flow.starts, flow.ends))
        return cls(index, flow, (end, start) if index else (start, end), refused)

    def off_parallax(self, direction: epipolar.Points, scale: float, limit: float) -> Places:
        """By how much each cell's motion misses parallax, of the limit, (height, width), for a camera that
        moved in a direction. scale: px per radian; limit: px.
        """
        u, v = self.seen
        across = epipolar.across(u, v, direction)
        off = scale * across / limit
        its_way = across < _ELSEWHERE * np.linalg.norm(v - u, axis=1)
        return np.where(its_way, np.minimum(off, 1.0), off).reshape(self.flow.shown.shape)


def _moved(
    chart: Chart, flow: CellFlow, off_parallax: Places, views: tuple[View, View],
    control_points: tuple[Places, Places], used: CellFlow,
) -> Mask:  # fmt: skip
    """The cells of what moved by itself.

    off_parallax    by how much each misses parallax, of the limit.
    used            the flow that is used: `flow` itself, or another one.
    """
    things = connected(off_parallax > _WEAK, flow.wraps)
    sizes = np.bincount(things.ravel())
    clear, known = (
        np.bincount(things[its], minlength=sizes.size)
        for its in ((off_parallax > 1) & flow.shown, flow.consistent)
    )
    kept = (clear >= np.maximum(LEAST_CELLS, _CLEAR * sizes)) & (known >= _KNOWN * sizes)
    kept[flow.confirmed(things, control_points)] = False
    for thing in np.flatnonzero(kept):
        its = things == thing
        kept[thing] = _ends_within(chart, flow, views, its) and _differs(*views, flow, used, its)
    moved: Mask = kept[things]
    return moved


def _ends_within(chart: Chart, flow: CellFlow, views: tuple[View, View], thing: Mask) -> bool:
    """Whether one photo shows a thing as far as the other one does: taken from either, what crosses the
    overlap would break at a border. Most often it is no thing: photos that are badly aligned miss parallax.
    """
    its = thing & flow.shown
    there = reached(flow.ends[its & flow.consistent], its.shape, chart)
    masks = views[0].cells, views[1].cells
    shown = [its.astype(np.int32), there.astype(np.int32)]
    return bool(ends_within(shown, 2, masks, chart.wraps)[1])


def _differs(here: View, there: View, flow: CellFlow, used: CellFlow, thing: Mask) -> bool:
    """Whether the photos differ in a thing's place if it moves as what is around, more than they do there. If
    nothing uses its own flow, that has to leave clearly less than both what is around and the flow that is
    used do.

    What is across the border of a chart that wraps does not count as around. A plain thing that left its
    place wholly differs there by as much all over, as a place that one photo shows darker, and is not told.
    """
    wider = grown(thing, GROWN, wraps=False)
    ring = np.nonzero(grown(wider, _RING, wraps=False) & ~wider & flow.consistent)
    its = np.nonzero(thing & flow.shown)
    if min(len(ring[0]), len(its[0])) < LEAST_CELLS:
        return False
    unknown = wider | ~flow.consistent
    nearest = scipy.ndimage.distance_transform_edt(unknown, return_distances=False, return_indices=True)
    beside = _difference(here, there, ring, flow.vectors[ring])
    inside = _difference(here, there, its, flow.vectors[tuple(nearest[:, its[0], its[1]])])
    if min(beside.size, inside.size) < LEAST_CELLS:
        return False
    off = _deviation(inside)
    if off < max(_DIFFERS, _MORE * _deviation(beside)):
        return False
    if used is flow:
        return True
    if np.count_nonzero(used.consistent[its]) >= _KNOWN * len(its[0]):
        off = min(off, _deviation(_difference(here, there, its, used.vectors[its])))
    return _deviation(_difference(here, there, its, flow.vectors[its])) < _REMAINS * off


def _deviation(difference: npt.NDArray[np.float32]) -> float:
    """By how much photos differ: from the median, as exposure may be another one in a place, and change
    faster than anything tells. Without end if too few cells tell it.
    """
    if difference.size < LEAST_CELLS:
        return np.inf
    return float(np.abs(difference - np.median(difference)).mean())


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

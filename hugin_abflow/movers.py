"""Things that moved by themselves between two photos, told by their flow (on the host).

The flow of what stands still is parallax (epipolar.py). Somebody who took a step is matched like a near thing
where he has not left his place wholly; but halfway between two such matches he and what is beside him are
bent, as it did not move along. Flow that leads clearly away from parallax, in an overlap where all else is
parallax, and over a place where the photos differ without it, is of something that moved. If one photo shows
all of it that the other one does, consistency.py fills its place with the flow of what is around, and seam.py
takes it from that photo, whole.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import scipy

from hugin_abflow import epipolar
from hugin_abflow.cells import (
    CELL,
    CONSISTENT,
    GROWN,
    LEAST,
    Flows,
    Mask,
    Places,
    View,
    Way,
    Whole,
    ends_within,
    grown,
    reached,
)
from hugin_abflow.chart import Chart
from hugin_abflow.decision import Refused
from hugin_abflow.projection import Projection
from hugin_abflow.working import connected

# By how much flow has to miss parallax: chart pixels at the canvas's centre, and times the third quartile of
# what all flow of the overlap misses it by; lenses and their places are not known exactly.
_APART, _SPREADS = 3.0, 5.0
# The share of a motion that has to lead elsewhere: a near thing's edge may be matched anywhere along itself,
# and misses parallax, but goes its way.
_ELSEWHERE = 0.5
# The share of the limit that is enough beside what misses parallax so far.
_WEAK = 0.3
# The share of a thing's cells that have to miss it so far, and be shown by both photos: of a near thing an
# edge may, where flow errs.
_CLEAR = 0.125
# Mean deviation of differences of log brightness from their median, without the thing's own flow, and times
# that of what is around, as far as so many cells: plain walls and floors are matched with anything.
_DIFFERS, _MORE, _RING = 0.12, 2.0, 4
# Of a mask, between pixels: all of them show something.
_SHOWN = 0.999


def find(
    chart: Chart, flows: Flows, views: tuple[View, View], vouched: tuple[Places, Places],
    refused: Sequence[Refused] = (),
) -> Whole | None:  # fmt: skip
    """What moved by itself; None, too, where nothing tells how the camera moved: flow does not, or it is not
    known in what directions the chart shows its places.

    flows       from the first to the second photo and back, float32 (height, width, 2), chart px.
    vouched     where somebody says that both show the same: what is matched so is left alone.
    refused     what a search found besides.
    """
    if not chart.projection:
        return None
    ways = [Way.of(chart, flows, views, index) for index in (0, 1)]
    seen = [_seen(chart.projection, way, index) for index, way in enumerate(ways)]
    u, v = (
        np.concatenate([its[photo][way.believed.ravel()] for its, way in zip(seen, ways, strict=True)])
        for photo in (0, 1)
    )
    direction = epipolar.known_move(u, v)
    if direction is None:
        return None
    scale = chart.projection.focal_y
    limit = max(_APART, _SPREADS * scale * float(np.percentile(epipolar.across(u, v, direction), 75)))
    found = [np.zeros(way.shown.shape, bool) for way in ways]
    every = [(index, False, way, its) for index, (way, its) in enumerate(zip(ways, seen, strict=True))]
    for one in refused:
        wide, gap = one.finest(chart.width, chart.height), CONSISTENT * max(1.0, 2.0 ** (one.level - 1))
        for index in (0, 1):
            way = Way.of(chart, wide, views, index, gap)
            every.append((index, True, way, _seen(chart.projection, way, index)))
    for index, searched, way, (u, v) in every:
        across = epipolar.across(u, v, direction)
        apart = scale * across / limit
        its_way = across < _ELSEWHERE * np.linalg.norm(v - u, axis=1)
        apart = np.where(its_way, np.minimum(apart, 1.0), apart).reshape(way.shown.shape)
        if searched:  # only what is certain
            apart *= way.believed
        its = _things(
            chart, way, apart, (views[index], views[1 - index]), (vouched[index], vouched[1 - index])
        )
        found[index] |= its
        found[1 - index] |= reached(way.ends[its & way.believed], its.shape, chart)
    return Whole.of(found, chart.wraps)


def _seen(projection: Projection, way: Way, index: int) -> tuple[epipolar.Points, epipolar.Points]:
    """Where the first and the second photo show what flow from photo `index` matches: (height * width, 3)."""
    ends = way.starts.reshape(-1, 2), way.ends.reshape(-1, 2)
    seen = projection.bearings(ends[0]), projection.bearings(ends[1])
    return seen[index], seen[1 - index]


def _things(
    chart: Chart, way: Way, apart: Places, views: tuple[View, View], vouched: tuple[Places, Places]
) -> Mask:
    """The cells of what moves by itself; apart: by how much each misses parallax, of the limit."""
    things = connected(apart > _WEAK, way.around > 0)
    clear = np.bincount(things[(apart > 1) & way.shown], minlength=things.max() + 1)
    kept = clear >= np.maximum(LEAST, _CLEAR * np.bincount(things.ravel()))
    kept[way.vouched(things, vouched)] = False
    for thing in np.flatnonzero(kept):
        its = things == thing
        kept[thing] = _ends_within(chart, way, views, its) and _differs(*views, way, its)
    moved: Mask = kept[things]
    return moved


def _ends_within(chart: Chart, way: Way, views: tuple[View, View], thing: Mask) -> bool:
    """Whether one photo shows a thing as far as the other one does: taken from either, what crosses the
    overlap would break at a border. Most often it is no thing: photos that are badly aligned miss parallax.
    """
    its = thing & way.shown
    there = reached(way.ends[its & way.believed], its.shape, chart)
    masks = views[0].cells, views[1].cells
    shown = [its.astype(np.int32), there.astype(np.int32)]
    return bool(ends_within(shown, 2, masks, chart.wraps)[1])


def _differs(here: View, there: View, way: Way, thing: Mask) -> bool:
    """Whether the photos differ in a thing's place if it moves as what is around, more than they do there.

    What is across the border of a chart that wraps does not count as around. A plain thing that left its
    place wholly differs there by as much all over, as a place that one photo shows darker, and is not told.
    """
    wider = grown(thing, GROWN, wraps=False)
    ring = np.nonzero(grown(wider, _RING, wraps=False) & ~wider & way.believed)
    its = np.nonzero(thing & way.shown)
    if min(len(ring[0]), len(its[0])) < LEAST:
        return False
    unknown = wider | ~way.believed
    nearest = scipy.ndimage.distance_transform_edt(unknown, return_distances=False, return_indices=True)
    beside = _difference(here, there, ring, way.flow[ring])
    inside = _difference(here, there, its, way.flow[tuple(nearest[:, its[0], its[1]])])
    if min(beside.size, inside.size) < LEAST:
        return False
    # each from its own median: exposure may be another one there, and change faster than anything tells
    off, around = (np.abs(one - np.median(one)).mean() for one in (inside, beside))
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

"""Shadows that fall in one photo and not in another (on the host).

Gains would take the shadow of somebody who walks by for exposure: it would be half as dark, with an edge
where gains change less quickly. So a place is taken from one layer, whole, if two layers differ by the same
amount all over it, and clearly by something else around it. A shadow's outline shows in one layer alone;
stray light in a lens, in contrast, changes how much layers differ where both become darker.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import numpy.typing as npt
import scipy

from hugin_abflow.cells import Mask, across_border, centres, grown
from hugin_abflow.gains import Difference, Measured
from hugin_abflow.grid import Grid

# Weight of a cell, 0..1, from which on it counts. (One that an outline cuts may weigh more, but is not even.)
_TRUSTED = 0.3
# How far what layers differ by may spread over a cell and those beside it for it to be even, on the exposure
# scale, whose unit is a factor of e.
_EVEN = 0.25
# Even cells that touch, at least, for them to be a place.
_LEAST = 6
# Cells from a place up to which others are around it.
_AROUND = 4
# By how much more, or less, layers differ in a place of shadow than in cells around it, on the exposure
# scale.
_JUMP = 0.3
# The share of these cells of which that has to be so.
_MOST = 0.7
# The part of that by which the layer without a shadow may change there.
_ALONE = 0.3
# The colour that differs least has to differ by this part of what the one that differs most does: somebody in
# a coat has another colour than what is behind him.
_GREY = 0.4
# Cells by which places are grown: those that an outline cuts are not even, nor those beside them.
_GROWN = 2


def find(measured: Measured, cells: Grid) -> Mask | None:
    """Where shadows are, (height, width) on the grid `cells` over the same region; None: nowhere."""
    found = np.zeros(measured.grid.shape, bool)
    for difference in measured.differences:
        found[difference.cells] |= _of(difference, measured.grid)
    if not found.any():
        return None
    row, column = centres(cells, found.shape)
    return np.asarray(grown(found, _GROWN, measured.grid.wraps)[row[:, None], column])


def _of(difference: Difference, grid: Grid) -> Mask:
    """The places of two layers' overlap in which one of them shows a shadow, but for its outline."""
    differ, level = difference.values[..., :3], difference.level
    around = grid.wraps and level.shape[1] == grid.width
    even = _even(differ.mean(-1), difference.values[..., 3] > _TRUSTED, around)
    shadows = np.zeros(level.shape, bool)
    for turn in (0, grid.width // 2) if around else (0,):  # what the border cuts is whole in one of them
        found = _shadows(np.roll(differ, turn, 1), np.roll(level, turn, 1), np.roll(even, turn, 1))
        shadows |= np.roll(found, -turn, 1)
    return shadows


def _shadows(differ: npt.NDArray[np.float64], level: npt.NDArray[np.float64], even: Mask) -> Mask:
    """Those that no border of the arrays cuts."""
    place = scipy.ndimage.label(even)[0]
    windows = scipy.ndimage.find_objects(place)
    size = np.bincount(place.ravel(), minlength=1)
    size[0] = 0  # what is not even
    large, shadows = size >= _LEAST, np.zeros(place.shape, bool)
    for number in np.flatnonzero(large):
        near = tuple(slice(max(0, one.start - _AROUND), one.stop + _AROUND) for one in windows[number - 1])
        its = place[near] == number
        around = large[place[near]] & ~its & grown(its, _AROUND, wraps=False)
        # what others lie in is none, though they have less light by as much as it has more
        if size[np.unique(place[near][around])].sum() > size[number]:
            shadows[near] |= its & _darker(its, around, differ[near], level[near])
    return shadows


def _darker(its: Mask, around: Mask, differ: npt.NDArray[np.float64], level: npt.NDArray[np.float64]) -> bool:
    """Whether one layer is clearly darker in a place than in cells around, in all colours, and the other one
    much the same.

    differ, level       what they differ by, r, g, b, and the mean of both and of these.
    """
    nearest = scipy.ndimage.distance_transform_edt(~its, return_distances=False, return_indices=True)
    inside = tuple(nearest[:, around])
    jump, change = (one[around] - one[inside] for one in (differ, level))
    colours = np.median(jump, 0)
    more = colours.mean()
    grey = (np.sign(more) * colours).min() > _GREY * np.abs(colours).max()
    alone = abs(np.median(change) - abs(more) / 2) < _ALONE * abs(more)
    return bool(grey and alone and np.mean(np.sign(more) * jump.mean(-1) > _JUMP) > _MOST)


def _even(values: npt.NDArray[np.float64], trusted: Mask, around: bool) -> Mask:
    """The trusted cells that differ little from the four beside them, of those that are trusted; around:
    whether the last column is beside the first one.
    """
    beside = scipy.ndimage.generate_binary_structure(2, 1)
    highest = partial(scipy.ndimage.grey_dilation, footprint=beside)
    high, low = (
        across_border(highest, np.where(trusted, sign * values, -np.inf), 1, around) for sign in (1, -1)
    )
    return np.asarray(trusted & (high + low < _EVEN))

"""Shadows that fall in one photo and not in another (on the host).

Gains follow the shadow of somebody who walks by as any other exposure: it would be half as dark, with an edge
where gains are not as quick. So where two layers differ by as much all over a place, and clearly by something
else around it, one of them is taken, whole. Its outline shows in one layer alone: light that strays in a lens
changes how much layers differ where both become darker.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy

from hugin_abflow.cells import centres, grown
from hugin_abflow.gains import Difference, Measured
from hugin_abflow.working import Grid

Mask = npt.NDArray[np.bool_]

# Weight of a cell that counts: one that is cut by an outline may weigh more, but is not even. The exposure
# scale over which a cell and those beside it are; its unit is a factor of e.
_TRUSTED, _EVEN = 0.3, 0.25
# Cells that a place has, at least, and up to how many from it others are around it.
_LEAST, _AROUND = 6, 4
# By how much more or less layers differ in a place than in most cells around, on the exposure scale; and by
# how much of that the layer without a shadow may change there.
_JUMP, _MOST, _ALONE = 0.3, 0.7, 0.3
# Cells by which places are grown: those that an outline cuts are not even, nor those beside them.
_GROWN = 2


def find(measured: Measured, cells: Grid) -> Mask | None:
    """Where shadows are, (height, width) on the grid `cells` over the same region; None: nowhere."""
    found = np.zeros(measured.grid.shape, bool)
    for difference in measured.differences:
        found[difference.cells] |= _of(difference)
    if not found.any():
        return None
    row, column = centres(cells, found.shape)
    return np.asarray(grown(found, _GROWN, measured.grid.wraps)[row[:, None], column])


def _of(difference: Difference) -> Mask:
    """The places of two layers' overlap in which one of them shows a shadow, but for its outline. The largest
    one is what others lie in.
    """
    differ, trusted = difference.values[..., :3].mean(-1), difference.values[..., 3] > _TRUSTED
    place = scipy.ndimage.label(_even(differ, trusted))[0]
    size = np.bincount(place.ravel())
    size[0] = 0  # what is not even
    large = np.flatnonzero(size >= _LEAST)
    others, shadows = np.isin(place, large), np.zeros(place.shape, bool)
    windows = scipy.ndimage.find_objects(place)
    for number in large[large != size.argmax()]:
        near = tuple(slice(max(0, one.start - _AROUND), one.stop + _AROUND) for one in windows[number - 1])
        its = place[near] == number
        if _apart(its, others[near] & ~its, differ[near], difference.level[near]):
            shadows[near] |= its
    return shadows


def _apart(its: Mask, others: Mask, differ: npt.NDArray[np.float64], level: npt.NDArray[np.float64]) -> bool:
    """Whether layers differ in a place otherwise than in others around it, and one of them hardly changes."""
    around = others & grown(its, _AROUND, wraps=False)
    if not around.any():
        return False
    nearest = scipy.ndimage.distance_transform_edt(~its, return_distances=False, return_indices=True)
    inside = tuple(nearest[:, around])
    jump, change = (one[around] - one[inside] for one in (differ, level))
    more, both = np.median(jump), np.median(change)
    alone = min(abs(both - more / 2), abs(both + more / 2)) < _ALONE * abs(more)
    return bool(alone and np.mean(np.sign(more) * jump > _JUMP) > _MOST)


def _even(values: npt.NDArray[np.float64], trusted: Mask) -> Mask:
    """The trusted cells that differ little from the four beside them, of those that are trusted."""
    beside = scipy.ndimage.generate_binary_structure(2, 1)
    high, low = (
        scipy.ndimage.grey_dilation(np.where(trusted, sign * values, -np.inf), footprint=beside)
        for sign in (1, -1)
    )
    return np.asarray(trusted & (high + low < _EVEN))

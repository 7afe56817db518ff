"""What the comparison of two aligned layers tells of what they show (on the host)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy

from hugin_abflow.cells import Mask, grown
from hugin_abflow.grid import Grid, connected

# Of some columns of the seam grid, (height, width, 10): MEAN to SHARE. Masks are of the same cells.
Comparison = npt.NDArray[np.float64]

# What a comparison has of each cell (kernels/seam.cl, seam_difference), by its last axis.
MEAN = np.s_[..., :3]  # of the layers' difference, in r, g, b
SQUARE = np.s_[..., 3]  # the mean square of that difference, of the channel in which it is largest
VARIANCES = np.s_[..., 4:6]  # of what each of both layers shows
COARSE = np.s_[..., 6:8]  # the same of means of blocks of pixels, in which noise is less
COVARIANCE = np.s_[..., 8]  # of the two layers, of these blocks
SHARE = np.s_[..., 9]  # of the cell that tells: what both layers show, clipped only if the other is darker

# Sigma, in cells, of the Gaussian by which differences are averaged: texture that is a little off is no
# reason to cut.
_SIGMA = 1.0
# Sigmas from the middle to the end of any Gaussian here.
_REACH = 3

# Layers may show things that have nothing in common in cells that are `apart`: where the next three hold.
# They differ in all frequencies by more than this, the root of the mean square, of full scale.
_UNRELATED = 0.06
# That mean square is more than this share of the sum of their variances: 1 of what has nothing in common.
_OF_VARIANCES = 0.7
# The larger variance is more than so many times the smaller one: 1 of one texture that is not aligned.
_VARIANCE_RATIO = 1.5
# Those that are apart, and touch, show unrelated things if no more than this share of what the smoother layer
# shows there is in the other one as well: 1 of what is the same and less sharp, as in a photo that was out of
# focus, or shaken.
_RELATED = 0.7
# So many cells that touch tell that by themselves; fewer are taken for what all such of both layers are.
_ENOUGH = 64

# Layers may show the same things in another light in cells that are `strong`: where their mean difference is
# more than this in any channel, of full scale.
_STRONG = 0.15
# Strong cells that touch, at least, for that to be asked.
_LEAST = 16
# The share of them in which what layers show has to be correlated: then it is the same.
_MOST = 0.7
# Correlation from which on it is.
_SAME = 0.8
# Sigma, in cells, of the means by which that correlation is found.
_WIDE = 3.0
# Of the cells on their rim the share, at most, in which it is not correlated: the edge of a shadow is in one
# layer alone.
_FEW = 0.2
# Correlation from which on it is, on the rim.
_RIM_SAME = 0.6
# Deviation, of full scale, up to which what a layer shows in a cell may be noise, and does not count for a
# rim.
_CONTRAST = 0.01


def smoothed(found: Comparison, cells: Grid, sigma: float = _SIGMA) -> Comparison:
    """The mean of the cells around each, by a Gaussian of sigma cells, as far as they tell; share: 1 where
    any does, else 0.
    """
    share = found[SHARE]
    smooth = _gaussian(np.dstack([found[..., :-1] * share[..., None], share]), cells, sigma)
    smooth /= np.where(share > 0, smooth[SHARE], np.inf)[..., None]
    return smooth


def unrelated(smooth: Comparison, cells: Grid) -> Mask:
    """Where layers show things that have nothing in common, though they may be as bright."""
    # layer by layer: along an axis of two NumPy takes ten times as long
    square, (first, second) = smooth[SQUARE], np.moveaxis(smooth[VARIANCES], -1, 0)
    apart = (square > _UNRELATED**2) & (square > _OF_VARIANCES * (first + second))
    apart &= np.maximum(first, second) > _VARIANCE_RATIO * np.minimum(first, second)
    smoother = np.where(first <= second, *np.moveaxis(smooth[COARSE], -1, 0))
    number = connected(apart, _wraps(smooth, cells))
    common, own, count = (
        np.bincount(number.flat, (apart * one).flat) for one in (smooth[COVARIANCE], smoother, 1.0)
    )
    few = count < _ENOUGH
    common[few], own[few] = common.sum(), own.sum()
    return np.asarray(apart & (common <= _RELATED * own)[number])


def in_another_light(found: Comparison, smooth: Comparison, cells: Grid) -> Mask:
    """Where layers show the same things in another light, as far as that reaches.

    Light that strays in one camera's lens, where the sun is beside the photo, is added to all that it shows:
    dark things are lightened more than bright ones, as by no exposure. The strict gains, by which regions are
    found, leave that; the final ones follow it bit by bit, as well as they can.
    """
    strong: Mask = (found[SHARE] > 0) & (np.abs(smooth[MEAN]).max(-1) > _STRONG)
    if not strong.any():
        return strong
    wraps, wide = _wraps(found, cells), smoothed(found, cells, _WIDE)
    same, shows = _correlated(wide, _SAME), _shows(wide)
    rim = strong & grown(~strong, 1, wraps) & _shows(smooth)
    number = connected(strong, wraps)
    all_, its_same, its_rim, apart = (
        np.bincount(number.flat, one.flat)
        for one in (strong, strong & same, rim, rim & ~_correlated(smooth, _RIM_SAME))
    )
    lit = (all_ >= _LEAST) & (its_same >= _MOST * all_) & (apart <= _FEW * its_rim)
    light = lit[number]  # of no part's cells: of 0
    reach = connected((found[SHARE] > 0) & (light | ~strong) & (same | ~shows), wraps)
    return np.isin(reach, np.unique(reach[light & same]))


def _shows(smooth: Comparison) -> Mask:
    """Where either layer shows more than noise."""
    return np.asarray(smooth[COARSE].max(-1) > _CONTRAST**2)


def _correlated(smooth: Comparison, correlation: float) -> Mask:
    """Where what layers show is correlated by more than that."""
    first, second = np.moveaxis(smooth[COARSE], -1, 0)
    return np.asarray(smooth[COVARIANCE] > correlation * np.sqrt(np.maximum(first * second, 0)))


def _wraps(found: Comparison, cells: Grid) -> bool:
    """Whether the last column of what was found is beside the first one."""
    return cells.wraps and found.shape[1] == cells.width


def _gaussian(values: Comparison, cells: Grid, sigma: float) -> Comparison:
    """A Gaussian of sigma cells, not normalised at the borders, of some of a grid's columns side by side."""
    columns, reach = values.shape[1], round(_REACH * sigma)
    gap = min(reach, cells.width - columns)  # what is between its ends if columns wrap, and matters
    values = np.pad(values, ((0, 0), (0, gap), (0, 0)))
    modes = ("constant", "wrap" if cells.wraps else "constant", "constant")
    smooth = scipy.ndimage.gaussian_filter(values, (sigma, sigma, 0), mode=modes, radius=(reach, reach, 0))
    return np.asarray(smooth[:, :columns])

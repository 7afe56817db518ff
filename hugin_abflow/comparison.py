"""What the comparison of two aligned layers tells of what they show (on the host)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy

from hugin_abflow.cells import Mask, grown
from hugin_abflow.working import Grid, connected

# Of some columns of the seam grid, (height, width, 10): MEAN to SHARE. Masks are of the same cells.
Comparison = npt.NDArray[np.float64]

# Of a cell: the mean of the layers' difference in r, g, b, the largest mean square of these, each layer's
# variance, those of blocks, in which noise is less, and their covariance, and the share of the cell that
# tells (kernels/seam.cl, seam_difference).
MEAN, SQUARE, VARIANCES, COARSE, COVARIANCE, SHARE = (
    np.s_[..., :3], np.s_[..., 3], np.s_[..., 4:6], np.s_[..., 6:8], np.s_[..., 8], np.s_[..., 9],
)  # fmt: skip

# Mask over which differences are averaged: texture that is a little off is no reason to cut; and how many
# times as far others count.
_SIGMA, _REACH = 1.0, 3
# Layers show unrelated things: what they differ by in all frequencies, at least, its square's share of the
# sum of their variances (1 of what has nothing in common), and how many times one's is the other's (1 of one
# texture that is not aligned); and how much of the smoother one, in all such cells that touch, may be in the
# other as well (1 of what is the same and less sharp: photos of which one was out of focus, or shaken). So
# many cells tell that by themselves, fewer as all such of both layers do.
_UNRELATED, _OF_VARIANCES, _VARIANCE_RATIO, _RELATED, _ENOUGH = 0.06, 0.7, 1.5, 0.7, 64
# Layers show the same things in another light: what they differ by, at least, in how many cells that touch.
_STRONG, _LEAST = 0.15, 16
# The share of these, at least, around which, by means over _WIDE cells, what layers show is correlated by
# more than _SAME. And of those on their rim that show more than noise, of full scale, the share, at most,
# that is not by _RIM_SAME: the edge of a shadow is in one layer alone.
_MOST, _WIDE, _SAME = 0.7, 3.0, 0.8
_CONTRAST, _FEW, _RIM_SAME = 0.01, 0.2, 0.6


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

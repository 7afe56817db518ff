"""Which flow is kept: flow without a search, or flow with what a search found (on the host).

What was found has to pass two tests:

- The images have to be clearly more alike by it: where patterns repeat, much fits a little.
- It must not be a thing that moved by itself: somebody who walked would be torn from what is behind. It
  passes if it moves as still things do for a camera that moved (epipolar.py), or if it is a large part of
  what the images show and is consistent: what fits by chance fits in one direction only.

Of what is kept, each part that explains less than flow without a search is dropped: a chair is found, and
the bars of a banister beside it are matched one bar too far.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hugin_abflow import epipolar
from hugin_abflow.grid import connected
from hugin_abflow.search import SearchParameters

Mask = npt.NDArray[np.bool_]
# Unit vectors (n, 3) in which places (n, 2) are seen: px of the finest grid, pixels' centres at .5.
Bearings = Callable[[npt.NDArray[np.float64]], npt.NDArray[np.float64]]

# Px by which two flows differ within a part, at least.
_DIFFERS = 0.5


@dataclass(frozen=True)
class Candidate:
    """One of two flows between a pair of images on a level, both ways.

    flows   float32 (2, height, width, 2), px of the level.
    misfit  float32 (2, height, width): what it leaves unexplained, where both images show something; else -1.
    """

    flows: npt.NDArray[np.float32]
    misfit: npt.NDArray[np.float32]


@dataclass(frozen=True)
class Refused:
    """Flow that a search found and that was refused: it explains something, but not much, and is not known to
    be of what stands still.

    flows   both ways, float32 (2, height, width, 2), px of `level`.
    """

    level: int
    flows: npt.NDArray[np.float32]

    def finest(self, width: int, height: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Both ways on the finest level's grid, px."""
        times = 1 << self.level
        wide = np.repeat(np.repeat(self.flows * np.float32(times), times, 1), times, 2)[:, :height, :width]
        return wide[0], wide[1]


@dataclass(frozen=True)
class Decision:
    """found: whether flow with what a search found may be taken. refused: what may not."""

    found: bool
    refused: tuple[Refused, ...] = ()


def trusted_misfit(plain: Candidate, found: Candidate, gap: float, wraps: bool) -> npt.NDArray[np.float32]:
    """(2, height, width): the misfit of `found`, but no less than that of `plain` where it is not consistent.

    gap     px of the level between start and return from which on it is not.
    wraps   whether the last column is beside the first one.
    """
    ways, height, width = found.misfit.shape
    way, row, column = np.ogrid[:ways, :height, :width]
    rows, columns = (np.rint(found.flows[..., k]).astype(int) + at for k, at in ((1, row), (0, column)))
    columns = columns % width if wraps else np.clip(columns, 0, width - 1)
    back = found.flows[1 - way, np.clip(rows, 0, height - 1), columns]
    returns = np.hypot(*np.moveaxis(found.flows + back, -1, 0)) < gap
    return np.where(returns, found.misfit, np.maximum(found.misfit, plain.misfit))


def decide(
    plain: Candidate,
    found: Candidate,
    level: int,
    last_level: int,
    textured: Callable[[], Mask],
    bearings: Bearings | None,
    wraps: bool,
    parameters: SearchParameters,
) -> Decision:
    """Whether flow as `found` may be taken for `plain`, without a search, after a level.

    last_level  the level on which that is decided at last; on coarser ones what gains too little is dropped.
    textured    gives (2, height, width): where the images tell motion.
    wraps       whether the last column is beside the first one.
    """
    common, last = plain.misfit >= 0, level <= last_level
    distance = parameters.apart * 2.0 ** (last_level - level)
    apart = common & (_difference(plain, found) > distance)
    if not apart.any():
        return Decision(False)
    gain = parameters.gain if last else parameters.early_gain
    trusted = trusted_misfit(plain, found, parameters.gap, wraps)
    shows = common & textured()
    # what shows nothing is explained by any flow alike; a small thing alone does not tell of all the rest
    tells = shows if shows.sum() >= parameters.tells * common.sum() else common
    gained = trusted[tells].mean() <= gain * plain.misfit[tells].mean()
    if gained and (not last or apart.sum() >= parameters.wide * common.sum()):
        return Decision(True)
    remains, before = found.misfit[apart].mean(), plain.misfit[apart].mean()
    if bearings and remains <= parameters.gain_apart * before:
        known = _seen(bearings, plain.flows, shows & ~apart, level)
        # one line of two on which it may go says little of what fits by chance: that does not lead back
        back = bool(trusted[apart].mean() <= parameters.gain_back * before)
        if epipolar.parallax(known, _seen(bearings, found.flows, apart, level), either_way=back):
            return Decision(True)
    return Decision(False, (Refused(level, found.flows),) if remains < before else ())


def worse(plain: Candidate, found: Candidate, wraps: bool) -> Mask:
    """(2, height, width): the parts of `found` that explain less than `plain` does there."""
    parts = [connected(its, wraps) for its in _difference(plain, found) > _DIFFERS]
    dropped = []
    for part, before, after in zip(parts, plain.misfit, found.misfit, strict=True):
        gain = np.bincount(part.ravel(), np.where(before >= 0, before - after, 0).ravel())
        gain[0] = 0
        dropped.append((gain < 0)[part])
    return np.stack(dropped)


def _difference(plain: Candidate, found: Candidate) -> npt.NDArray[np.float32]:
    """(2, height, width): by how many px two flows differ."""
    difference: npt.NDArray[np.float32] = np.hypot(*np.moveaxis(found.flows - plain.flows, -1, 0))
    return difference


def _seen(
    bearings: Bearings, flows: npt.NDArray[np.float32], where: Mask, level: int
) -> tuple[epipolar.Points, epipolar.Points]:
    """Where the first and where the second image show what flows both ways match at some pixels of a level:
    unit vectors (n, 3).
    """
    ends: list[list[epipolar.Points]] = [[], []]
    for way in (0, 1):
        rows, columns = np.nonzero(where[way])
        places = np.stack([columns, rows], 1).astype(np.float64) + 0.5
        ends[way].append(bearings(places * 2.0**level))
        ends[1 - way].append(bearings((places + flows[way, rows, columns]) * 2.0**level))
    first, second = (np.concatenate(points) for points in ends)
    return first, second

"""Guides: places that two layers have in common, vouched for by somebody; and which of them to doubt."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from hugin_abflow.errors import GuideError

Points = npt.NDArray[np.float64]  # (n, 2): x right, y down

# Ends closer than this are one place: points are set to a tenth of a pixel at best.
_SAME_PLACE = 1.0
# Moves that differ by less are no contradiction, whatever their neighbours say.
_LEAST_DEVIATION = 3.0
# Of the neighbours' own spread, as in the normalised median test of Westerweel and Scarano ("Universal
# outlier detection for PIV data", 2005).
_SPREADS = 3.0
# A neighbour that moves so nearly alike, as a share of the deviation from the others, is a second witness.
_WITNESS = 0.3
# With fewer neighbours there is no majority.
_LEAST_NEIGHBOURS = 3
_MOST_NEIGHBOURS = 8


@dataclass(frozen=True)
class Guide:
    """What layer `a` shows at `at_a`, layer `b` shows at `at_b`.

    a, b        indices of the layers in the sequence that is merged.
    at_a, at_b  (x, y) in pixels of the whole canvas; the centre of its first pixel is at (0.5, 0.5).
    name        what messages call it.
    """

    a: int
    b: int
    at_a: tuple[float, float]
    at_b: tuple[float, float]
    name: str = "guide"


def check_guides(guides: Iterable[Guide], layers: int) -> None:
    """Raise `GuideError` unless each guide is about two of so many layers and about places."""
    for guide in guides:
        if guide.a == guide.b or any(index not in range(layers) for index in (guide.a, guide.b)):
            raise GuideError(
                f"{guide.name} is about the layers {guide.a} and {guide.b}; name two different ones of "
                f"0 to {layers - 1}, their indices among the layers that are merged"
            )
        if not all(map(math.isfinite, (*guide.at_a, *guide.at_b))):
            raise GuideError(f"{guide.name} is at {guide.at_a} and {guide.at_b}; give canvas pixels")


def doubts(places: Points, moves: Points, radius: float, period: float = math.inf) -> list[str]:
    """Why each guide of one pair of layers is to be ignored; "" where it is not.

    places  (n, 2) px, one end of each guide; moves: (n, 2) px, from there to the other end.
    radius  px: neighbours are the nearest guides within it.
    period  px after which columns repeat; infinity: they do not.

    Repeated guides count once. Guides that send one place to two are both ignored. Else a guide is an
    outlier if its move is far from the median of three neighbours or more, and none of them moves like it:
    two points on a near thing vouch for each other. One without neighbours is trusted.
    """
    reasons = [""] * len(places)
    for i in range(len(places)):  # row by row: a project may have ten thousand points
        again = (distances(places, i, period) < _SAME_PLACE) & (distances(moves, i) < _SAME_PLACE)
        for j in np.flatnonzero(again[i + 1 :]) if not reasons[i] else ():
            reasons[i + 1 + j] = "it repeats another"
    counted = np.array([not reason for reason in reasons], bool)
    for i in map(int, np.flatnonzero(counted)):
        apart = np.where(counted, distances(places, i, period), np.inf)
        apart[i] = np.inf
        others = np.argsort(apart, kind="stable")[:_MOST_NEIGHBOURS]
        others = others[apart[others] < radius]
        differ = np.linalg.norm(moves[others] - moves[i], axis=1)
        if ((apart[others] < _SAME_PLACE) & (differ > _LEAST_DEVIATION)).any():
            reasons[i] = "another sends the same place elsewhere"
        elif len(others) >= _LEAST_NEIGHBOURS and _stands_alone(moves[i], moves[others]):
            reasons[i] = "its neighbours move otherwise; a second point beside it would confirm it"
    return reasons


def by_pair(guides: Iterable[Guide], numbers: Sequence[int]) -> dict[tuple[int, int], list[Guide]]:
    """Guides by the pairs of layers (a, b) that they connect, a < b. Layers are counted anew in the result:
    by their places in `numbers`. Guides of layers that are not among them are left out.

    numbers     the number by which guides call each layer.
    """
    index = {number: k for k, number in enumerate(numbers)}
    pairs: dict[tuple[int, int], list[Guide]] = {}
    for guide in guides:
        if guide.a not in index or guide.b not in index:
            continue
        a, b = index[guide.a], index[guide.b]
        its = replace(guide, a=a, b=b)
        its = its if a < b else replace(its, a=b, b=a, at_a=its.at_b, at_b=its.at_a)
        pairs.setdefault((its.a, its.b), []).append(its)
    return pairs


def distances(points: Points, index: int, period: float = math.inf) -> npt.NDArray[np.float64]:
    """From one of the points to each of them, px; `period`: as of `doubts`."""
    apart = np.abs(points - points[index])
    columns = apart[:, 0] % period
    apart[:, 0] = np.minimum(columns, period - columns)
    found: npt.NDArray[np.float64] = np.linalg.norm(apart, axis=1)
    return found


def _stands_alone(move: npt.NDArray[np.float64], others: Points) -> bool:
    """Whether a move is far from the median of others and like none of them."""
    median = np.median(others, axis=0)
    spread = float(np.median(np.linalg.norm(others - median, axis=1)))
    deviation = float(np.linalg.norm(move - median))
    if deviation <= _LEAST_DEVIATION + _SPREADS * spread:
        return False
    return bool(np.linalg.norm(others - move, axis=1).min() > max(_LEAST_DEVIATION, _WITNESS * deviation))

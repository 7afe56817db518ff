"""Guides: places that two layers have in common, vouched for by somebody; and which of them to doubt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

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


def doubts(places: Points, moves: Points, radius: float) -> list[str]:
    """Why each guide of one pair of layers is to be ignored; "" where it is not.

    places  (n, 2) px, one end of each guide; moves: (n, 2) px, from there to the other end.
    radius  px: neighbours are the nearest guides within it.

    Repeated guides count once. Guides that send one place to two are both ignored. Else a guide is an
    outlier if its move is far from the median of three neighbours or more, and none of them moves like it:
    two points on a near thing vouch for each other. One without neighbours is trusted.
    """
    reasons = [""] * len(places)
    apart = np.linalg.norm(places[:, None] - places, axis=-1)
    differ = np.linalg.norm(moves[:, None] - moves, axis=-1)
    for i, j in zip(*np.nonzero(np.triu((apart < _SAME_PLACE) & (differ < _SAME_PLACE), 1)), strict=True):
        if not reasons[i]:
            reasons[j] = "it repeats another"
    counted = [i for i, reason in enumerate(reasons) if not reason]
    for i in counted:
        others = [j for j in counted if j != i and apart[i, j] < radius]
        others = sorted(others, key=lambda j: float(apart[i, j]))[:_MOST_NEIGHBOURS]
        if any(apart[i, j] < _SAME_PLACE and differ[i, j] > _LEAST_DEVIATION for j in others):
            reasons[i] = "another sends the same place elsewhere"
        elif len(others) >= _LEAST_NEIGHBOURS and _stands_alone(moves[i], moves[others]):
            reasons[i] = "its neighbours move otherwise; a second point beside it would confirm it"
    return reasons


def _stands_alone(move: npt.NDArray[np.float64], others: Points) -> bool:
    """Whether a move is far from the median of others and like none of them."""
    median = np.median(others, axis=0)
    spread = float(np.median(np.linalg.norm(others - median, axis=1)))
    deviation = float(np.linalg.norm(move - median))
    if deviation <= _LEAST_DEVIATION + _SPREADS * spread:
        return False
    return bool(np.linalg.norm(others - move, axis=1).min() > max(_LEAST_DEVIATION, _WITNESS * deviation))

"""Of two flows between a pair of images one or the other, cell by cell, so that little is torn (on the host).

    energy = sum of misfit  +  _TEARING * sum of structure * jump  +  _ASTRAY * sum of texture * astray

over pixels, neighbouring cells, and cells. Where flow jumps from a cell to the next, what crosses the border
between them is torn: bars, if it jumps along them; an outline is not, along which near things jump before
far ones. `astray` is 1 where flow does not lead back. Both ways are decided at once, by one minimal cut
(Lempitsky, Rother, Roth, Blake, "Fusion moves for Markov random field optimization", 2010): so what leads
back does so afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from hugin_abflow import labelling
from hugin_abflow.cells import CELL, CONSISTENT, LEAST_CELLS, Mask, at_centres
from hugin_abflow.decision import Candidate

Values = npt.NDArray[np.float32]
_Numbers = npt.NDArray[np.intp]

# Px by which flow differs from a cell to the next one, from which on something is torn: surfaces seen from
# aside are compressed, or stretched, by up to this share of their width.
STEP = 0.6 * CELL
# Px beyond that from which on it does not matter by how much.
_FURTHEST = 16.0
# Slope of log brightness, per px, from which on structure is clear: as far as misfits count.
_CLEAR = 0.2
# Slope at which a pixel counts fully, less ones by their square: bars count, not the lawn between them, which
# moves otherwise.
_STRONG = 0.4
# What a torn px of clear structure weighs for each px of its jump, beside misfits of pixels. With 1 each part
# of a drawn railing kept what fits the lawn behind it best.
_TEARING = 4.0
# Likewise a cell of clear texture whose flow does not lead back.
_ASTRAY = 2.0
# Px between start and return from which on it does not.
_ASTRAY_FROM = 2 * CONSISTENT
# A cell that may not take the other flow pays this for it.
_NEVER = 1e3
# The clear structure of what takes the other flow has to be explained by it as well, but for so much more:
# bars of drawn railings leave .92 to 1.22 of what they left unexplained, things of judged rooms 1.7 and more.
_ALIKE = 1.25
# Px of clear structure times px of its jump, in each image, by which a part has to be less torn: six bars.
# Drawn railings save 88 and more, a part of a real wall that was better as it had been 41.
WORTH = 75.0


@dataclass(frozen=True)
class Structure:
    """What both images show, by cells: px of clear structure.

    down, right float32 (2, height - 1, width) and (2, height, width - 1): what crosses the border between a
                cell and the one below, and the one on its right.
    texture     float32 (2, height, width), 0..1.
    weights     float32 (2, rows, columns) of pixels, 0..1: how much they tell of what repeats.
    """

    down: Values
    right: Values
    texture: Values
    weights: Values


def structure(features: Values) -> Structure:
    """Of both images, from features (2, height, width, 4) as in kernels/flow.cl."""
    shown = features[..., 3:].min(0, keepdims=True)
    slopes = _means(np.minimum(np.abs(features[..., 1:3]) / _CLEAR, 1) * shown)
    across, along = slopes[..., 0], slopes[..., 1]
    return Structure(
        CELL * np.minimum(across[:, :-1], across[:, 1:]),
        CELL * np.minimum(along[:, :, :-1], along[:, :, 1:]),
        np.minimum(np.hypot(across, along), 1),
        np.minimum((features[..., 1:3] ** 2).sum(-1) / _STRONG**2, 1),
    )


def by_cells(pixels: Candidate, weights: Values | None = None) -> Candidate:
    """Flows at the centres of whole cells, and their mean misfit, of weighted pixels; -1: one has none."""
    height, width = (side // CELL for side in pixels.misfit.shape[1:])
    unknown = _means((pixels.misfit < 0).astype(np.float32)) > 0
    flows = np.stack([at_centres(one)[:height, :width] for one in pixels.flows])
    misfit = pixels.misfit if weights is None else weights * pixels.misfit
    return Candidate(flows, np.where(unknown, -1, _means(misfit)))


def pixels_of(cells: Mask, height: int, width: int) -> Mask:
    """Pixels of cells, (height, width); those beside the last whole cells are as these are."""
    rows, columns = (
        np.minimum(np.arange(side) // CELL, count - 1)
        for side, count in zip((height, width), cells.shape, strict=True)
    )
    return np.asarray(cells[rows][:, columns])


def _means(pixels: Values) -> Values:
    """Means over whole cells of (2, height, width, ...)."""
    height, width = (side // CELL for side in pixels.shape[1:3])
    whole = pixels[:, : height * CELL, : width * CELL]
    return np.asarray(whole.reshape(2, height, CELL, width, CELL, *pixels.shape[3:]).mean((2, 4)))


def jump(first: Values, second: Values) -> Values:
    """Px by which flow jumps, of neighbours' flows (..., 2)."""
    away: Values = np.clip(np.hypot(*np.moveaxis(second - first, -1, 0)) - STEP, 0, _FURTHEST)
    return away


@dataclass(frozen=True)
class _Links:
    """Neighbours on both grids, whose nodes are numbered through, and what crosses between them.

    first, second   (n,) numbers of cells: way, row, column.
    crossing        (n,) px of clear structure, 0 where not both are known.
    """

    first: _Numbers
    second: _Numbers
    crossing: Values

    @classmethod
    def of(cls, shown: Structure, known: Mask) -> _Links:
        number = np.arange(known.size).reshape(known.shape)
        before, after = (number[:, :-1], number[:, :, :-1]), (number[:, 1:], number[:, :, 1:])
        first, second, crossing = (
            np.concatenate([one.ravel() for one in both])
            for both in (before, after, (shown.down, shown.right))
        )
        is_known = known.ravel()
        return cls(first, second, np.where(is_known[first] & is_known[second], crossing, 0))

    def torn(self, before: Values, after: Values) -> Values:
        """By link, if its first cell has flow `before` and its second one `after`: (nodes, 2)."""
        return self.crossing * jump(before[self.first], after[self.second])


def fused(shown: Structure, present: Candidate, other: Candidate, may: Mask) -> Mask:
    """The cells, (2, rows, columns), that take the other flow: such as `may`, in parts that are torn less by
    it, and whose structure is explained as well. Flows and misfits are by pixels.
    """
    before, after = (by_cells(one) for one in (present, other))
    known = (before.misfit >= 0) & (after.misfit >= 0)
    may = may & known & (np.linalg.norm(after.flows - before.flows, axis=-1) > STEP)
    if not may.any():
        return may
    problem = Problem.of(shown, before, after, known)
    taken = problem.least(may.ravel())
    clear = [by_cells(one, shown.weights).misfit.ravel() for one in (present, other)]
    return problem.accepted(taken, clear[0], clear[1]).reshape(may.shape)


@dataclass(frozen=True)
class Problem:
    """Cells of both images, numbered through (image, row, column), that have one flow or take another.

    links       neighbours.
    flows       float32 (nodes, 2) px, both flows.
    ends        for both whether it leads to a cell of the other image, and that one's number.
    misfit      (nodes,): what the other flow leaves unexplained beyond what the present one does, pixels.
    texture     (nodes,): what it weighs if flow does not lead back.
    """

    links: _Links
    flows: tuple[Values, Values]
    ends: tuple[tuple[Mask, _Numbers], tuple[Mask, _Numbers]]
    misfit: npt.NDArray[np.float64]
    texture: Values

    @classmethod
    def of(cls, shown: Structure, present: Candidate, other: Candidate, known: Mask) -> Problem:
        """Flows and misfits are by cells; of those that are not known these do not count."""
        return cls(
            _Links.of(shown, known),
            (present.flows.reshape(-1, 2), other.flows.reshape(-1, 2)),
            (_ends(present.flows), _ends(other.flows)),
            np.where(known, CELL**2 * (other.misfit - present.misfit), 0).ravel().astype(np.float64),
            np.where(known, _ASTRAY * shown.texture, 0).ravel(),
        )

    def energy(self, taken: Mask) -> float:
        """What it costs if these cells, (nodes,), take the other flow, beside what their own one leaves."""
        flows = np.where(taken[:, None], self.flows[1], self.flows[0])
        inside, end = (np.where(taken, *both) for both in zip(*self.ends[::-1], strict=True))
        back = np.linalg.norm(flows + flows[end], axis=-1) > _ASTRAY_FROM
        # one that leads to a cell that does not take the same flow counts as if it did not lead back
        astray = self.texture * inside * (back | (taken != taken[end]))
        torn = _TEARING * self.links.torn(flows, flows)
        return float(self.misfit[taken].sum() + astray.sum() + torn.sum())

    def terms(self) -> tuple[npt.NDArray[np.float64], _Numbers, _Numbers, npt.NDArray[np.float64]]:
        """The energy as sums over nodes and pairs: what taking the other flow costs each node (nodes,); and
        the first and second nodes of pairs, and what it costs if the second one alone takes it (pairs,).
        """
        links, flows, texture = self.links, self.flows, self.texture
        torn = [[_TEARING * links.torn(flows[i], flows[j]) for j in (0, 1)] for i in (0, 1)]
        own, each = self.misfit.copy(), np.arange(self.misfit.size)
        np.add.at(own, links.first, torn[1][0] - torn[0][0])
        np.add.at(own, links.second, torn[1][1] - torn[1][0])
        first, second = [links.first], [links.second]
        price = [torn[0][1] + torn[1][0] - torn[0][0] - torn[1][1]]
        for takes, (inside, end) in enumerate(self.ends):
            back = np.linalg.norm(flows[takes] + flows[takes][end], axis=-1)
            astray = texture * inside * (back > _ASTRAY_FROM)
            own += astray if takes else -astray
            first.append(end if takes else each)
            second.append(each if takes else end)
            price.append(texture * inside - astray)
        return own, np.concatenate(first), np.concatenate(second), np.concatenate(price)

    def least(self, may: Mask) -> Mask:
        """The cells, of those that `may`, that take the other flow, for the least energy."""
        own, first, second, price = self.terms()
        own[~may] = _NEVER
        # where less is torn if only one of two takes it than otherwise, a cut can but know that as no price
        return labelling.taking(first, second, np.maximum(price, 0), own, np.zeros(own.size, bool))

    def accepted(self, taken: Mask, before: Values, after: Values) -> Mask:
        """Of cells those in parts, of both images, that are large enough, explained as well, and torn less.

        before, after   (nodes,): what flows leave of clear structure.
        """
        links, (inside, end) = self.links, self.ends[1]
        each = np.flatnonzero(taken & inside & taken[end])
        near = taken[links.first] & taken[links.second]
        pairs = (
            np.concatenate([links.first[near], each]),
            np.concatenate([links.second[near], end[each]]),
        )
        graph = scipy.sparse.coo_array((np.ones(pairs[0].size), pairs), shape=(taken.size, taken.size))
        count, part = scipy.sparse.csgraph.connected_components(graph, directed=False)
        cells, was, becomes = (
            np.bincount(part[taken], None if one is None else one[taken], count)
            for one in (None, before, after)
        )
        mixed: Values = np.where(taken[:, None], self.flows[1], self.flows[0])
        saved = links.torn(self.flows[0], self.flows[0]) - links.torn(mixed, mixed)
        touched = taken[links.first] | taken[links.second]
        its = part[np.where(taken[links.first], links.first, links.second)]
        worth = np.bincount(its[touched], saved[touched], count)
        good = (cells >= LEAST_CELLS) & (becomes <= _ALIKE * was) & (worth >= 2 * WORTH)
        return np.asarray(taken & good[part])


def _ends(flows: Values) -> tuple[Mask, _Numbers]:
    """Of all cells, whether flow leads to a cell of the other image, and that one's number (nodes,)."""
    height, width = flows.shape[1:3]
    rows, columns = np.indices((height, width))
    x, y = (np.floor(flows[..., k] / CELL + at + 0.5).astype(int) for k, at in ((0, columns), (1, rows)))
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    there = np.array([1, 0])[:, None, None] * height + np.clip(y, 0, height - 1)
    return inside.ravel(), (there * width + np.clip(x, 0, width - 1)).ravel()

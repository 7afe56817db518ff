"""Somebody whom two layers show at two places, shown once (kernels/clones.cl).

Somebody who walks along while photos are taken may stand twice in the overlap of two layers: at his first
place one layer shows him, and the other one what is behind him; at his second place it is the other way
round. A cut between both places costs nothing, so the labelling of least energy (regions.py) shows him at
both.

He is recognised by his looks. With a and b what two aligned, corrected layers show in a cell p, and d the
way from his one place to the other, in cells, he is there if

    sum_p max(0, <(|a(p) - b(p)|^2 + |a(p + d) - b(p + d)|^2) / 2 - l |a(p) - b(p + d)|^2>)

is large. < > is the mean of 3 x 3 cells; the sum is over the cells in which it is positive. What is behind
him is alike at both places as well, and gives the same for -d; but unlike him it does not end at his
outline. What stands still and repeats, such as windows, is found as far away again.

He is taken away at that of his two places without which the energy is less, by taking it from the other
layer; unless he reaches beyond that layer, and a part of him would stay.

Where all of a region was taken from one layer lest somebody is there twice, which costs more than a cut, a
cut that shows him once is better, if his places are beside each other: the rest of the region then comes
from whichever layer suits it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import cv2
import numpy as np
import numpy.typing as npt

from hugin_abflow.cells import grown
from hugin_abflow.chart import widest_gap
from hugin_abflow.colour import Correction
from hugin_abflow.geometry import Pair
from hugin_abflow.grid import Grid, cells_under, connected
from hugin_abflow.layer import Box
from hugin_abflow.regions import Cells, Choice, Gone, Prices, parts
from hugin_abflow.scene import Scene

# l: how unlike his two images may be, against how unlike he is to what is behind him.
_CONTRAST = 3.0
# Squared difference, summed over r, g, b, from which on two cells show different things.
_DIFFERS = 0.02
# Cells between his places, at least.
_NEAR = 2
# Cells between them across, at most.
_ACROSS = 48
# Cells between them down, at most: people keep to the ground.
_DOWN = 6
# The least sum that tells of somebody.
_TOLD = 0.5
# The least of him, in cells of the equator's size.
_LEAST = 8.0
# The share of what differs at one place, or at both, that has to be found at the other.
_MOSTLY = 0.6
# The share of the cells of what is found in which both are alike: two people may wear the same trousers.
_ALIKE = 0.6
# The share of a look that may be found as far away again: what repeats stands still.
_REPEATS = 0.6
# The share of one of his places that may be in the other for a cut between them, lest that goes through him.
_UPON = 0.1
# How much more he has to differ from what is around him than what is behind him does.
_OUTLINED = 1.2
# Displacements of a pair of layers that are looked at.
_TRIED = 12
# The share of what he differs by that has to be shown at each place for him to be there.
_SHOWN = 0.3
# What it costs to show him in a cell where he shall not be: more than all cuts around it.
_UNWANTED = 5.0
# Cells beside him in which a part of him may be that they do not tell.
_BESIDE = 2
# Energy that showing him once may cost, by how much he differs (of the place where he differs less): what the
# softmax favours costs once that, and the rest is left for cuts beside a border, which are dear.
_DEARER = 1.75
# Cells narrower than that, of the equator's width, are not looked at: what moves there is turned as well.
_NARROW = 0.5

# Layers' looks that are kept: each of 300 layers meets few others.
_KEPT = 16

_log = logging.getLogger(__name__)

Part = tuple[slice, slice]
Look = npt.NDArray[np.float32]  # (height, width, 4) on cells: r, g, b as seen, and the share that is shown


@dataclass(frozen=True)
class Clone:
    """What layers a and b (indices) show alike, cells of the seam grid: a at `first`, b at `second`.

    told: how clearly, the sum above.
    """

    a: int
    b: int
    first: Cells
    second: Cells
    told: float

    @property
    def places(self) -> tuple[tuple[int, Cells], tuple[int, Cells]]:
        """Each layer and where it shows it."""
        return (self.a, self.first), (self.b, self.second)


def owners(
    scene: Scene, correction: Correction, cells: Grid, choice: Choice
) -> tuple[npt.NDArray[np.intp], Gone]:
    """The layer of each cell, as `choice.owners`, but that nobody is there twice if it can be helped; and by
    layers the cells in which each showed somebody who is there no longer.

    cells       the seam grid, over the region of the scene's.
    """
    owner, energy = choice.owners()
    differs, gone = choice.residual.mean, Gone()
    look = lru_cache(_KEPT)(partial(_look, scene, correction, cells))
    clones = list[Clone]()
    for pair in scene.pairs:
        both = choice.whole & choice.cover[pair.a] & choice.cover[pair.b]
        if np.count_nonzero(both & np.isin(owner, (pair.a, pair.b))) >= 2 * _LEAST:
            clones += find(pair, look(pair.a), look(pair.b), both, cells)
    for clone in sorted(clones, key=lambda one: -one.told):
        twice = _twice(clone, owner, differs)
        its_choice = choice if twice else _cut(choice, clone, look)
        if its_choice is None:
            continue
        more = _DEARER * min(differs[at].sum() for _, at in clone.places) if twice else 0.0
        options = []
        for (k, at), (other, _) in (clone.places, clone.places[::-1]):
            if (grown(at, _BESIDE, cells.wraps) & choice.cover[k] & ~choice.cover[other]).any():
                continue  # a part of him may be where that layer is alone
            without = gone | {k: at | gone.get(k, False)}
            options.append((*its_choice.owners(_prices(without, choice)), without, its_choice))
        best = min(options, key=lambda one: one[1], default=None)
        if best and best[1] <= energy + more:
            owner, energy, gone, choice = best
            _log.info(
                "%s and %s show the same at two places; it is shown once",
                scene.layers[clone.a].layer.called, scene.layers[clone.b].layer.called,
            )  # fmt: skip
    return owner, gone


def _twice(clone: Clone, owner: npt.NDArray[np.intp], differs: npt.NDArray[np.float64]) -> bool:
    """Whether somebody is there at both of his places."""
    return all(differs[at & (owner == k)].sum() >= _SHOWN * differs[at].sum() for k, at in clone.places)


def _cut(choice: Choice, clone: Clone, look: Callable[[int], Look]) -> Choice | None:
    """The same, but with cuts, whatever one layer costs, in regions in which little differs but him; None:
    there are none, or he is not beside his other place.
    """
    beside = (clone.first & clone.second).sum() <= _UPON * min(clone.first.sum(), clone.second.sum())
    if choice.whole_factor is None or not beside:
        return None
    at, both = clone.first | clone.second, choice.cover[clone.a] & choice.cover[clone.b]
    off = both & (_apart(look(clone.a)[..., :3], look(clone.b)[..., :3]) > _DIFFERS)
    his = np.zeros(choice.whole.shape, bool)
    for region in parts(choice.whole, choice.wraps):
        his |= region & ((at & off & region).sum() > _MOSTLY * (off & region).sum())
    return replace(choice, whole_factor=np.where(his, 0.0, choice.whole_factor)) if his.any() else None


def _prices(gone: Gone, choice: Choice) -> Prices:
    """What it costs to show each layer, (layers, height, width), that nobody is where he shall not be."""
    prices = np.zeros(choice.cover.shape)
    for k, at in gone.items():
        prices[k][at] = _UNWANTED
    return prices


def find(pair: Pair, a: Look, b: Look, both: Cells, cells: Grid) -> Iterator[Clone]:
    """What the layers of a pair show at two places.

    both: cells of regions that both layers cover.
    """
    if not both.any():
        return
    # what goes once around begins behind its widest gap
    turn = -widest_gap(np.logical_or.reduce(both, 0))[0] if cells.wraps else 0
    both = np.roll(both, turn, 1)
    rows, columns = (np.flatnonzero(both.any(axis)) for axis in (1, 0))
    # a cell more to each side, where outlines end
    part = np.s_[max(0, rows[0] - 1) : rows[-1] + 2, max(0, columns[0] - 1) : columns[-1] + 2]
    a, b = (np.roll(one, turn, 1)[part] for one in (a, b))
    search = _Search(a, b, both[part], cells.row_widths[part[0], None])
    for first, second, told in search.found():
        places = np.zeros((2, *cells.shape), bool)
        places[(slice(None), *part)] = first, second
        first, second = np.roll(places, -turn, 2)
        yield Clone(pair.a, pair.b, first, second, told)


def _apart(one: npt.NDArray[np.float32], other: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Squared difference of two looks' r, g, b, (..., 3), summed."""
    return np.asarray(np.square(one - other).sum(-1))


class _Search:
    """The search for what two layers show at two places, of a part of the grid that does not wrap."""

    def __init__(self, a: Look, b: Look, both: Cells, widths: npt.NDArray[np.float64]) -> None:
        self._a, self._b, self._widths = a[..., :3], b[..., :3], widths
        self._compared = (a[..., 3] > 0) & (b[..., 3] > 0)
        self._off = _apart(self._a, self._b)
        # where somebody may be who was not found yet
        self._open = both & self._compared & (self._off > _DIFFERS) & (widths > _NARROW)

    def found(self) -> Iterator[tuple[Cells, Cells, float]]:
        """Where a shows it, and b, and how clearly."""
        height, width = self._off.shape
        down, across = min(height - 3, _DOWN), min(width - 3, _ACROSS)
        moves = [
            (dy, dx)
            for dy in range(-down, down + 1)
            for dx in range(-across, across + 1)
            if dy * dy + dx * dx >= _NEAR**2
        ]
        told = {move: float(self._told(move)[0].sum()) for move in moves}
        refused: list[tuple[int, int]] = []
        for move in sorted(told, key=lambda one: -told[one]):
            if told[move] < _TOLD or len(refused) == _TRIED:
                return
            if any(max(abs(move[0] - y), abs(move[1] - x)) <= _NEAR for y, x in refused):
                continue
            first, second = self._places(move)
            if self._is_somebody(first, second) and not self._repeats(first, second, move):
                self._open &= ~(first | second)
                yield first, second, told[move]
            else:
                refused.append(move)

    def _told(self, move: tuple[int, int]) -> tuple[npt.NDArray[np.float32], Part, Part]:
        """By how much each cell tells that a shows there what b does `move` (down, right) from there; these
        cells, and those where they lead.
        """
        here, there = self._part(-move[0], -move[1]), self._part(*move)
        both = self._open[here] & self._open[there]  # a few cells of thousands
        off = (self._off[here][both] + self._off[there][both]) / 2
        gain = np.zeros(both.shape, np.float32)
        gain[both] = off - _CONTRAST * _apart(self._a[here][both], self._b[there][both])
        mean = cv2.blur(gain, (3, 3), borderType=cv2.BORDER_CONSTANT)
        return np.where(gain > 0, np.maximum(mean, 0), 0), here, there

    def _part(self, down: int, across: int) -> Part:
        """The cells that are others moved so far."""
        height, width = self._off.shape
        return (
            slice(max(0, down), height + min(0, down)),
            slice(max(0, across), width + min(0, across)),
        )

    def _places(self, move: tuple[int, int]) -> tuple[Cells, Cells]:
        """The largest connected part of what a and b show `move` apart, where a shows it, and b."""
        told, here, there = self._told(move)
        labels = connected(told > 0, wraps=False)
        sizes = np.bincount(labels[labels > 0], minlength=2)
        places = np.zeros((2, *self._off.shape), bool)
        places[0][here] = places[1][there] = labels == max(1, int(sizes.argmax()))
        return places[0], places[1]

    def _is_somebody(self, first: Cells, second: Cells) -> bool:
        """Whether what a shows at the first place, and b at the second, is large enough, all that is to be
        seen at one of them, and ends there, unlike what the other one shows.
        """
        if (self._widths * first).sum() < _LEAST:
            return False
        if (_apart(self._a[first], self._b[second]) < _DIFFERS).mean() < _ALIKE:
            return False
        things = connected(self._open, wraps=False)
        places = first, second, first | second
        if all(at.sum() < _MOSTLY * np.isin(things, np.unique(things[at])).sum() for at in places):
            return False
        sides = ((first, self._a, self._b), (second, self._b, self._a))
        return all(
            self._outline(its, at) > _OUTLINED * self._outline(behind, at) for at, its, behind in sides
        )

    def _repeats(self, first: Cells, second: Cells, move: tuple[int, int]) -> bool:
        """Whether a layer shows the same again, as far from one of the places but in the other direction."""
        for look, place, (down, across) in ((self._a, first, (-move[0], -move[1])), (self._b, second, move)):
            here, there = self._part(-down, -across), self._part(down, across)
            again = _apart(look[here], look[there]) < _DIFFERS
            again &= place[here] & self._compared[there]
            if np.count_nonzero(again) > _REPEATS * np.count_nonzero(place):
                return True
        return False

    def _outline(self, look: npt.NDArray[np.float32], place: Cells) -> float:
        """Mean difference of a look across the outline of a place, r, g and b together."""
        total, count = 0.0, 0
        for here, there in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
            across = (place[here] != place[there]) & self._compared[here] & self._compared[there]
            total += float(np.abs(look[here] - look[there])[across].sum())
            count += int(np.count_nonzero(across))
        return total / max(count, 1)


def _look(scene: Scene, correction: Correction, cells: Grid, k: int) -> Look:
    """What layer k, aligned and corrected, shows in cells; nothing where its box does not reach."""
    device, grid, layer, colours = scene.device, scene.grid, scene.layers[k], correction.grid
    part = cells_under(Box.at(*layer.box), grid, cells)
    gain = correction.gains[k] or device.zeros((*colours.shape, 4))
    shown = device.empty((part.height, part.width, 4))
    device.run(
        "clones", "clones_look", (part.width, part.height),
        layer.pixels, scene.fields[k], layer.box, gain, grid.border, grid.lonlat, colours.border,
        cells.border, part.place, correction.shoulder, shown,
    )  # fmt: skip
    look = np.zeros((*cells.shape, 4), np.float32)
    look[part.slices] = shown.get()
    return look

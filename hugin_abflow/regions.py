"""Regions that one layer shows, whole: where they are, and which layer that is (on the host).

In each connected region of cells where aligned layers differ, every cell is given to one layer: the one that
the softmax favours, with cuts where they show least, between layers and at the layers' own borders. This is
a labelling of least energy (labelling.py),

    sum_cells (r (1 - s_k) + h e_k + q_k)  +  sum_neighbours c (t + t') / 2 [k != k']  +  sum_borders c t.

    r   residual of low frequencies, averaged over the cells around.
    t   how far the residual of all frequencies, not averaged, is seen: a cut through somebody who is as
        bright as what is behind him shows in t alone.
    s   the share of layer k in the softmax.
    c   price of a cut.
    e   what layer k clips of what another one, as bright, still shows; h: its price.
    q   price of a layer that is torn there (tears.py).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import numpy.typing as npt
import scipy

from hugin_abflow.cells import grown, neighbours
from hugin_abflow.grid import Grid, connected
from hugin_abflow.labelling import Graph, Labels, energy, least

# Residual of low frequencies, of full scale, by which a cell is strong: enough of these make a region, which
# is taken from one layer. Cells in which that of all frequencies is as much are outskirts.
_STRONG = 0.2
# From so much less to so much more than that, a cell counts from not at all to wholly as strong.
_DOUBT = 0.05
# Residual of low frequencies, of full scale, from which on a cell belongs to the outskirts of a region.
_WEAK = 0.045
# Where layers differ in texture as well as in brightness, less is enough: the residual of low frequencies, of
# full scale, up to which a cell counts not at all, and from which on wholly.
_FAINT = (0.08, 0.14)
# The share that this residual has of that of all frequencies there: a cell counts wholly between the inner
# two, not at all beyond the outer two. More is what exposures leave, less what is not quite aligned, or
# noise.
_TEXTURED = (0.55, 0.6, 0.7, 0.8)
# The share of a region that such cells have at least: somebody fills his.
_FILLED = 0.06
# Strong cells, of the equator's size, that a region has at least: fewer are an edge that is a pixel off.
_LEAST = 4.5
# Cells from a region up to which what is unrelated belongs to it: farther away it is no part of somebody, but
# what one photo shows less sharp.
_FAR = 32
# Residual of all frequencies, of full scale, from which on a cut is seen hardly the more: a short cut through
# a face was dearer than a long one through a dark coat, which left the face alone.
_SEEN = 0.2
# The one for which a cut costs as much as without that rule: with less it is dearer, with more cheaper.
_AS_IT_IS = 0.15
# No layer is taken where it is not.
_FORBIDDEN = 1e4
# The share of a region's cells that a layer has for it to be taken from there, whole.
_MOSTLY = 0.5
# The share of what a cut shows up to which next to nothing is seen of another, or of a whole region: then
# favour of the softmax, which grows with the area, is no reason to cut. A car across the middle of an overlap
# was cut in two. Nor is it to cut where two places of one thing overlap: a flower box lost its middle.
_CLEAN = 1 / 3
# Price of a cell of a layer that its displacements tear there (tears.py), as of a residual that nothing
# favours.
_TORN = 0.3
# How bare a cut may be, in cells times full scale, before another one is looked for: by how much the residual
# of low frequencies is more than _STRONG along it. No texture hides where white stone ends before dark glass.
_BARE = 1.0
# The share of that which the other one's may be, at most, for it to be taken.
_LESS_BARE = 1 / 3

Cells = npt.NDArray[np.bool_]  # (height, width) on the seam grid
Prices = npt.NDArray[np.float64]  # (layers, height, width) on the seam grid
Gone = dict[int, Cells]  # by layers, where each showed somebody who is there no longer


@dataclass(frozen=True)
class Residuals:
    """How far aligned, corrected layers differ, float64 (height, width) on the seam grid: the largest of
    any pair and channel, 0 where no two lie.

    mean    r: of their low frequencies.
    rms     t: of all frequencies, of each cell by itself. What is strong, averaged, would fill a gap beside
            it, and a cut through somebody's chin be as cheap as one below. In `seam.cut_unaligned` both are
            the mean square, on finer cells.
    measured    where any pair has pixels to compare: none are where layers are clipped, or sampled beyond
                their borders. None: everywhere.
    smooth_rms  of all frequencies, averaged as r is, for the outskirts of regions. None: t.
    unrelated   where any two show things that have nothing in common, though they may be as bright: trousers
                and paving; but also what one shows less sharp. None: nowhere.
    fine        of fine detail: t without the mean difference of the cell, of cells of which enough tells.
                None: not measured.
    """

    mean: npt.NDArray[np.float64]
    rms: npt.NDArray[np.float64]
    measured: Cells | None = None
    smooth_rms: npt.NDArray[np.float64] | None = None
    unrelated: Cells | None = None
    fine: npt.NDArray[np.float64] | None = None


@dataclass(frozen=True)
class Choice:
    """The choice of the layer that each cell of some regions is taken from.

    whole       (height, width): the cells of all regions.
    residual    on the same grid.
    shares      (layers, height, width): s_k, of the softmax.
    cover       (layers, height, width): the cells that each layer can be taken from.
    wraps       whether columns are periodic.
    cut_price   c: of a cut, in cells. cut_share: the share of a region's size, the root of its cells, that c
                is at least: what one layer favours grows with the area, a cut through somebody with the size.
    whole_factor    (height, width): how many times as much as a cut it may cost to take a region from one
                    layer, the largest of its cells; None: it is cut wherever that is cheapest.
    clipping    h e_k: what each layer costs in a cell besides, for what it clips; None: nothing.
    torn        (layers, height, width): where each layer's displacements tear it (tears.py); None: nowhere.
    otherwise   a second choice, with longer cuts: a region whose cut by this one would be bare is cut by that
                one, if that is much less bare, and any other if that is seen much less. None: there is none.
    """

    whole: Cells
    residual: Residuals
    shares: Prices
    cover: npt.NDArray[np.bool_]
    wraps: bool
    cut_price: float
    whole_factor: npt.NDArray[np.float64] | None = None
    clipping: Prices | None = None
    cut_share: float = 0.0
    torn: npt.NDArray[np.bool_] | None = None
    otherwise: Choice | None = None

    def owners(self, unwanted: Prices | None = None) -> tuple[npt.NDArray[np.intp], float]:
        """The layer of each cell, (height, width): in the regions the one it is taken from, elsewhere the one
        that the softmax favours, -1 where none is; and the energy of all regions.

        unwanted: what each layer costs in a cell, which does not count as energy.
        """
        owner, total = self._favoured(), 0.0
        for region in parts(self.whole, self.wraps):
            rows, columns = np.nonzero(region)
            owner[rows, columns], its = self.label(rows, columns, unwanted)
            total += its
        return owner, total

    def _favoured(self) -> npt.NDArray[np.intp]:
        """The layer of each cell that the softmax favours, (height, width); -1 where none is. One by one: of
        many layers a product of all would take gigabytes.
        """
        owner, most = np.full(self.whole.shape, -1), np.full(self.whole.shape, -np.inf)
        for k, (shares, there) in enumerate(zip(self.shares, self.cover, strict=True)):
            its = shares * there
            better = its > most
            owner[better], most[better] = k, its[better]
        owner[~self.cover.any(0)] = -1
        return owner

    def label(
        self, rows: npt.NDArray[np.intp], columns: npt.NDArray[np.intp], unwanted: Prices | None = None
    ) -> tuple[npt.NDArray[np.intp], float]:
        """Which layer each cell (rows, columns) of a region is taken from, and the energy of that: the least
        found.

        One layer is taken, as far as it goes, if that costs no more than `whole_factor` allows: somebody may
        stand there twice, and a cut between his two places, or where these overlap, is as cheap as one beside
        him. So it is, whatever the softmax favours, if a cut is seen much better.

        A cut is short, and where the softmax favours neither layer. Where it would be bare, that of
        `otherwise` is taken if it is much less so, and wherever it is seen much less.
        """
        candidates = np.flatnonzero(self.cover[:, rows, columns].any(1))
        if candidates.size < 2:
            return np.full(rows.size, candidates[0] if candidates.size else 0), 0.0
        more = None if unwanted is None else unwanted[candidates][:, rows, columns]
        plain = self._graph(rows, columns, candidates)
        wanted = _dearer(plain, more)
        labels = least(wanted)
        bare = partial(_bareness, plain, self.residual.mean[rows, columns])
        other = labels
        if self.otherwise is not None and np.ptp(labels):
            other = least(_dearer(self.otherwise._graph(rows, columns, candidates), more))
            if bare(labels) > _BARE and bare(other) <= _LESS_BARE * bare(labels):
                labels = other
        if self.whole_factor is not None:

            def unseen(labels: Labels) -> float:
                return float(self._disfavour(candidates[labels], rows, columns).sum())

            factor, faint = self.whole_factor[rows, columns].max(), _WEAK * self._cut_price(rows.size)
            labels = _seen_less(wanted, labels, other, factor, unseen, faint)
        return candidates[labels], _energy(plain, labels)

    def _cut_price(self, cells: int) -> float:
        """c in a region of so many cells."""
        return max(self.cut_price, self.cut_share * math.sqrt(cells))

    def _disfavour(
        self, owner: npt.NDArray[np.intp] | np.intp, rows: npt.NDArray[np.intp], columns: npt.NDArray[np.intp]
    ) -> npt.NDArray[np.float64]:
        """r (1 - s_k) of a region's cells (cells,), k the layers that they are of."""
        return np.asarray(self.residual.mean[rows, columns] * (1 - self.shares[owner, rows, columns]))

    def _graph(
        self, rows: npt.NDArray[np.intp], columns: npt.NDArray[np.intp], candidates: npt.NDArray[np.intp]
    ) -> Graph:
        """The energy of a region's cells, taken from the layers `candidates`."""
        rough = self.residual.rms[rows, columns]
        cut_price = self._cut_price(rows.size)
        present = self.cover[candidates[:, None], rows, columns]
        price = np.full(present.shape, _FORBIDDEN)
        # in place: where 300 layers overlap each array of prices takes a sixth of a gigabyte
        for k, its, there in zip(candidates, price, present, strict=True):
            its[there] = self._disfavour(k, rows, columns)[there]
        if self.clipping is not None:
            price += self.clipping[candidates][:, rows, columns]
        if self.torn is not None:
            np.add(price, _TORN, out=price, where=self.torn[candidates[:, None], rows, columns])
        number = np.full(self.residual.mean.shape, -1)
        number[rows, columns] = np.arange(rows.size)
        links = []
        for down, right in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            inside, there = neighbours(rows + down, columns + right, self.residual.mean.shape, self.wraps)
            # a layer's own border is a cut as well, where the union goes on
            ends = inside & self.cover[:, *there].any(0) & ~self.cover[candidates[:, None], *there]
            np.add(price, cut_price * rough, out=price, where=ends)
            if down + right > 0:
                linked = np.flatnonzero(inside & (number[there] >= 0))
                links.append(np.stack([linked, number[there][linked]]))
        first, second = np.concatenate(links, 1)
        cuts = cut_price * (rough[first] + rough[second]) / 2
        return Graph(rows, columns, price, present, first, second, cuts)


def _dearer(graph: Graph, more: Prices | None) -> Graph:
    """With what labels cost besides, (labels, nodes); None: nothing."""
    return graph if more is None else replace(graph, price=graph.price + more)


def _bareness(graph: Graph, mean: npt.NDArray[np.float64], labels: Labels) -> float:
    """How bare the cuts of a labelling are, see `_BARE`. mean: r of each node."""
    cut = labels[graph.first] != labels[graph.second]
    along = (mean[graph.first[cut]] + mean[graph.second[cut]]) / 2
    return float(np.maximum(along - _STRONG, 0).sum())


def _seen_less(
    graph: Graph,
    labels: Labels,
    other: Labels,
    factor: float,
    unseen: Callable[[Labels], float],
    faint: float,
) -> Labels:
    """Of the labels that take all cells from one layer, as far as it goes, which has most of them, and of
    `other`, those that show next to nothing of what `labels` show; or else of the former those that cost no
    more than `factor` times as much; else `labels`.

    unseen      the part of what labels cost that nobody sees. faint: the price of a cut up to which it is not
                seen, either.
    """

    def price(labels: Labels) -> float:
        return _energy(graph, labels)

    def shown(labels: Labels) -> float:
        return price(labels) - unseen(labels)

    cuts = graph.cut[labels[graph.first] != labels[graph.second]]
    alone = [np.where(one, k, labels) for k, one in enumerate(graph.possible) if one.mean() > _MOSTLY]
    is_cut = cuts.sum() > faint * cuts.size
    clean = [one for one in [*alone, other] if is_cut and shown(one) <= _CLEAN * shown(labels)]
    cheap = [one for one in alone if price(one) <= factor * price(labels)]
    return min(clean or cheap, key=price, default=labels)


def seen(residual: Residuals) -> Residuals:
    """Residuals with, for that of all frequencies, how far a cut there is seen: a strong difference is seen
    little more than one half as strong, and a long cut more than a short one.
    """
    rms = residual.rms
    return replace(residual, rms=(_SEEN + _AS_IT_IS) * rms / (_SEEN + rms))


def find(residual: Residuals, cells: Grid, single: Cells) -> Cells:
    """Connected outskirts, grown by a cell, that hold enough strong residual, are filled with what differs by
    less and in texture as well, or have any cell of `single`. What is unrelated beside them belongs to them,
    and they to each other.
    """
    smooth_rms = residual.rms if residual.smooth_rms is None else residual.smooth_rms
    unrelated = np.zeros_like(single) if residual.unrelated is None else residual.unrelated
    weak = (residual.mean > _WEAK) | (smooth_rms > _STRONG) | single
    area = np.broadcast_to(cells.row_widths[:, None], weak.shape)
    strong = area * np.interp(residual.mean, (_STRONG - _DOUBT, _STRONG + _DOUBT), (0, 1))
    share = residual.mean / np.maximum(smooth_rms, 1e-12)
    textured = area * np.interp(residual.mean, _FAINT, (0, 1)) * np.interp(share, _TEXTURED, (0, 1, 1, 0))
    outskirts, found = grown(weak, 1, cells.wraps), np.zeros_like(weak)
    for part in parts(outskirts, cells.wraps):
        filled = textured[part].sum() >= max(_LEAST, _FILLED * area[part].sum())
        if filled or single[part].any():
            found |= part
    for part in parts(_extended(outskirts, unrelated, cells.wraps), cells.wraps):
        if strong[part].sum() >= _LEAST:
            found |= part
    return _extended(found, unrelated, cells.wraps)


def _extended(regions: Cells, unrelated: Cells, wraps: bool) -> Cells:
    """Regions with what is unrelated, grown by a cell, that leads away from them, but not far."""
    unrelated = grown(unrelated, 1, wraps)
    for _ in range(_FAR):
        beside = grown(regions, 1, wraps) & unrelated & ~regions
        if not beside.any():
            break
        regions = regions | beside
    return regions


def parts(mask: Cells, wraps: bool) -> list[Cells]:
    """The connected parts of a mask."""
    labels = connected(mask, wraps)
    return [labels == k for k in np.unique(labels[mask])]


def completed(residual: Residuals, cover: npt.NDArray[np.bool_], wraps: bool) -> Residuals:
    """With the nearest cell's residual in cells without a measured one, from a layer's border on: flow leads
    away from there, so that a cut would cost nothing, and leave half of somebody. What else residuals tell,
    by which regions are found, is left out.

    cover       (layers, height, width): the cells that each of them can be taken from.
    """
    if residual.measured is None or not residual.measured.any():
        return residual
    by = residual.measured.shape[1] // 2 if wraps else 0
    around = [(0, 0), (by, by)]
    cover = np.pad(cover, [(0, 0), *around], mode="wrap")
    measured = np.pad(residual.measured, around, mode="wrap")
    borders = [one & scipy.ndimage.binary_dilation(~one, np.ones((3, 3))) for one in cover]
    missing = (cover.sum(0) > 1) & ~measured
    missing = scipy.ndimage.binary_propagation(np.any(borders, 0) & missing, np.ones((3, 3)), missing)
    nearest = scipy.ndimage.distance_transform_edt(~measured, return_distances=False, return_indices=True)

    def whole(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        values = np.pad(values, around, mode="wrap")
        filled = np.where(missing, values[tuple(nearest)], values)
        return filled[:, by : filled.shape[1] - by]

    return Residuals(whole(residual.mean), whole(residual.rms))


def _energy(graph: Graph, labels: Labels) -> float:
    """What a labelling costs, where any layer is."""
    return energy(graph, labels, np.asarray(graph.possible.any(0)))

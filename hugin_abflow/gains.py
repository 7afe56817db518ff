"""Smooth gains that explain how overlapping layers differ.

Each layer and channel has one field of gains, on a coarse grid of cells and on the exposure scale of
common.cl. Where layers overlap, the corrected layers agree; from there the correction spreads through each
layer, smoothly, and fades out. The gains minimise

    sum_pairs c (g_a - g_b + d_ab)^2 + h |grad (g_a - g_b)|^2  +  sum_k |grad g_k|^2 + g_k^2 / fade^2

with d_ab the measured difference of the aligned layers and c how much it counts. That is a sparse linear
system, solved directly in rounds, which find out what to trust; the first ones are solved for blocks of
cells. Where no layers differ, all gains are exactly zero.

h is 0 but in and beside cells where what is seen tells nothing of exposure, such as somebody whom only one
layer shows. There, without it, both gains would fade, and with them their difference, which would leave a
step beside him. With it the difference goes on from around, and fades much more slowly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import scipy

from hugin_abflow.grid import Grid

# Rounds of (weight of the measured differences against smoothness, distance from the solution at which a cell
# counts no longer): what is smooth is followed bit by bit.
_ROUNDS = ((0.1, 4.0), (1.0, 3.0), (100.0, 2.5))
# The same, slower and stricter: what lies far from it is no exposure but something that only one layer shows.
_STRICT = ((0.01, 4.0), (0.03, 2.5), (0.3, 1.6), (3.0, 1.2), (100.0, 1.0))
# Cells across a block that shares one gain in rough rounds: fewer unknowns take much less time, nearly all of
# which goes into eliminating them.
_BLOCK = 2
# Weight of the differences up to which a round is rough: they weigh hardly more than smoothness there, so
# that gains are smooth anyway.
_ROUGH = 3.0
# Weight of a clipped cell against smoothness: what it tells is a bound, of a brightness that nobody knows.
_BOUND = 0.1
# Weight of the smoothness of the difference of two layers' gains, for steps into and within cells that tell
# nothing; that of each gain's own is 1.
_TOGETHER = 10.0
# The share of the canvas's width over which the correction fades out.
_FADE = 0.12
# The same in all strict rounds but the last, which follow a trend: that hardly fades.
_TREND_FADE = 1.0

# Of the layers' cells, as the unknowns of `solve`.
_Numbers = npt.NDArray[np.signedinteger[Any]]


@dataclass(frozen=True)
class Difference:
    """How layers a and b (indices) differ, float64 (height, width, 4) on cells of the colour grid.

    values  a - b on the exposure scale, r, g, b, and a weight 0..1.
    beyond  the same where only one of them is clipped, a if the weight is positive, b if it is negative: at
            least that much.
    mixing  how far both are seen, (height, width).
    level   the mean of both, all channels, on the exposure scale, where the weight of `values` is above 0.
    cells   rows and columns of the grid that these are; what only one layer can be in is left out.
    """

    a: int
    b: int
    values: npt.NDArray[np.float64]
    beyond: npt.NDArray[np.float64]
    mixing: npt.NDArray[np.float64]
    level: npt.NDArray[np.float64]
    cells: tuple[slice, slice] = (slice(None), slice(None))

    @property
    def known(self) -> bool:
        """Whether more cells tell by how much exposures differ than have one layer clipped."""
        return bool(np.count_nonzero(self.values[..., 3]) > np.count_nonzero(self.beyond[..., 3]))


@dataclass(frozen=True)
class Measured:
    """What the layers' overlaps tell of their exposure.

    grid        the colour grid.
    inside      (layers, height, width): the cells of each layer.
    shoulder    of the exposure scale (common.cl).
    """

    grid: Grid
    inside: npt.NDArray[np.bool_]
    shoulder: float
    differences: tuple[Difference, ...]


def solve(
    measured: Measured,
    strict: bool = False,
    unknown: npt.NDArray[np.bool_] | None = None,
) -> npt.NDArray[np.float64]:
    """Gains, float64 (cells, 3), r, g, b of all layers' cells in the order of `np.nonzero(measured.inside)`.

    strict: reject outliers earlier, so that what moved stays visible in the residual.
    unknown: (height, width), cells where what is seen tells nothing of exposure, and no difference weighs.
    """
    numbering = _Numbering.of(measured)
    agreement, bounds = _Agreement(measured, numbering), _Bounds(measured, numbering)
    smooth = _smoothness(measured, numbering, unknown)
    blocks = _blocks(measured.inside)
    # from a block to the next one gains change in one step, between cells in _BLOCK smaller ones, the squares
    # of which sum to so much less
    smooth_blocks = blocks.T @ smooth @ blocks / _BLOCK
    solution, solver, rough_solver = np.zeros((numbering.count, 3)), _Solver(), _Solver()
    rounds = _STRICT if strict else _ROUNDS
    for data, limit in rounds:
        fade = _TREND_FADE if strict and data < rounds[-1][0] else _FADE
        agreeing, towards = agreement.active(solution, data, limit)
        held, pull = bounds.active(solution, limit)
        data_term = scipy.sparse.diags_array(_fading(measured, numbering, fade) + held) + agreeing
        wanted = pull + towards
        if data <= _ROUGH:
            matrix = blocks.T @ data_term @ blocks + smooth_blocks
            solution = blocks @ rough_solver.solve(matrix, blocks.T @ wanted)
        else:
            solution = solver.solve(data_term + smooth, wanted)
    return np.asarray(solution)


@dataclass(frozen=True)
class _Numbering:
    """The layers' cells as unknowns, in the order of `np.nonzero(measured.inside)`.

    number  (layers, height, width): of each cell among the unknowns; 0 where a layer is not.
    count   how many unknowns there are.
    area    of each row's cells, (height, 1).
    """

    number: _Numbers
    count: int
    area: npt.NDArray[np.float64]

    @classmethod
    def of(cls, measured: Measured) -> _Numbering:
        """The numbering of all cells that layers have."""
        number, count = np.zeros(measured.inside.shape, np.int32), int(np.count_nonzero(measured.inside))
        number[measured.inside] = np.arange(count)
        return cls(number, count, measured.grid.bounded_widths[:, None])


def _fading(measured: Measured, numbering: _Numbering, fade: float) -> npt.NDArray[np.float64]:
    """How strongly each gain is held at 0, (count,), for it to fade out over the share `fade` of the canvas's
    width: area / fade^2.
    """
    cells = measured.grid
    around = cells.circumference / (cells.lonlat[1] or 1.0)  # the canvas's width in cells
    own_area = np.broadcast_to(numbering.area, measured.inside.shape)[measured.inside]
    return np.asarray(own_area / max(1.0, fade * around) ** 2)


def _smoothness(
    measured: Measured, numbering: _Numbering, unknown: npt.NDArray[np.bool_] | None
) -> scipy.sparse.csr_array:
    """The quadratic form (count, count) of how uneven gains are, and, around `unknown`, their differences."""
    step, stiffness = _slopes(measured.inside, numbering.area, measured.grid.wraps)
    smooth = step.T @ scipy.sparse.diags_array(stiffness) @ step
    if unknown is not None:
        smooth += _TOGETHER * _apart(measured, numbering, unknown)
    return smooth


def _apart(
    measured: Measured, numbering: _Numbering, unknown: npt.NDArray[np.bool_]
) -> scipy.sparse.csr_array:
    """The quadratic form (count, count) of how uneven differences of layers' gains are around `unknown`."""
    inside, differences, number = measured.inside, measured.differences, numbering.number
    shared = np.stack([inside[d.a] & inside[d.b] for d in differences])
    pairs = [(number[d.a], number[d.b], its) for d, its in zip(differences, shared, strict=True)]
    step, stiffness = _slopes(shared, numbering.area, measured.grid.wraps)
    beside = abs(step) @ np.broadcast_to(unknown, shared.shape)[shared] > 0
    apart = step[beside] @ _steps(pairs, numbering.count)[0]
    return apart.T @ scipy.sparse.diags_array(stiffness[beside]) @ apart


def _slopes(
    masks: npt.NDArray[np.bool_], area: npt.NDArray[np.float64], wraps: bool
) -> tuple[scipy.sparse.csr_array, npt.NDArray[np.float64]]:
    """The steps between neighbouring cells within each of some masks (n, height, width): a matrix (steps,
    cells) that takes them, cells in the order of `np.nonzero(masks)`, and their stiffness (steps,).

    area: of each row's cells, (height, 1).
    """
    mask, row, column = np.nonzero(masks)
    own = np.arange(mask.size)
    number = np.zeros(masks.shape, np.int32)
    number[masks] = own
    right, below = (column + 1) % masks.shape[2], np.minimum(row + 1, masks.shape[1] - 1)
    goes_on = (column + 1 < masks.shape[2]) | wraps
    # a cell's sides: steps along a row are shorter near a pole, so neighbours there are bound closer
    east = (masks[mask, row, right] & goes_on) / area[row, 0]
    south = (masks[mask, below, column] & (below > row)) * np.sqrt(area[row, 0] * area[below, 0])
    ends = [(number[mask, row, right], east), (number[mask, below, column], south)]
    return _steps([(own, end, stiffness) for end, stiffness in ends], mask.size)


def _blocks(inside: npt.NDArray[np.bool_]) -> scipy.sparse.csr_array:
    """A matrix (cells, blocks) that gives each of the layers' cells the value of its block."""
    layer, row, column = np.nonzero(inside)
    names = np.stack([layer, row // _BLOCK, column // _BLOCK])
    blocks, its = np.unique(np.ravel_multi_index(tuple(names), inside.shape), return_inverse=True)
    return scipy.sparse.csr_array((np.ones(its.size), (np.arange(its.size), its)), (its.size, blocks.size))


class _Solver:
    """Solves symmetric positive definite systems of much the same pattern: the order in which the first one's
    unknowns are best eliminated serves the others as well. No factors are kept; they are large.
    """

    # SuperLU's own supernodes and panels are for factors that are less sparse than a grid's
    _OPTIONS: Final = {
        "diag_pivot_thresh": 0,
        "relax": 1,
        "panel_size": 4,
        "options": {"SymmetricMode": True},
    }

    def __init__(self) -> None:
        self._order: _Numbers | None = None

    def solve(
        self, matrix: scipy.sparse.csr_array, wanted: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.float64]:
        """x (n, k) of matrix (n, n) @ x = wanted."""
        from scipy.sparse.linalg import splu  # SciPy's parts load when they are needed

        if self._order is None:
            factors = splu(matrix.tocsc(), "MMD_AT_PLUS_A", **self._OPTIONS)
            self._order = np.argsort(factors.perm_c)
            return np.asarray(factors.solve(wanted))
        ordered = matrix[self._order][:, self._order].tocsc()
        solution = np.empty_like(wanted)
        solution[self._order] = splu(ordered, "NATURAL", **self._OPTIONS).solve(wanted[self._order])
        return solution


class _Agreement:
    """Corrected layers are to agree where both are seen: g_a - g_b = -d_ab."""

    def __init__(self, measured: Measured, numbering: _Numbering) -> None:
        links, differences = [], []
        for d in measured.differences:
            # what a layer is measured to be beside its own cells binds nothing else
            both = measured.inside[d.a][d.cells] & measured.inside[d.b][d.cells]
            evidence = d.values[..., 3] * numbering.area[d.cells[0]] * both
            links.append((numbering.number[d.a][d.cells], numbering.number[d.b][d.cells], evidence))
            differences.append(d.values[evidence > 0, :3])
        self._link, self._weight = _steps(links, numbering.count)
        self._difference = np.concatenate(differences)

    def active(
        self, solution: npt.NDArray[np.float64], data: float, limit: float
    ) -> tuple[scipy.sparse.csr_array, npt.NDArray[np.float64]]:
        """What a round adds to the normal equations: to the matrix (count, count), and to the right side
        (count, 3).

        solution    of the round before: a difference that it misses by `limit` or more weighs nothing. One of
                    zeros stands for none: then all weigh.
        data        the most that a difference weighs, against smoothness.
        """
        link, difference = self._link, self._difference
        off = link @ solution + difference if solution.any() else np.zeros_like(difference)
        trusted = data * self._weight * _biweight(off, limit)
        return link.T @ scipy.sparse.diags_array(trusted) @ link, -(link.T @ (trusted[:, None] * difference))


class _Bounds:
    """Where only one of two layers is clipped, the other is to be raised by their difference at least."""

    def __init__(self, measured: Measured, numbering: _Numbering) -> None:
        unknowns, targets, weights = [], [], []
        for d in measured.differences:
            for other, sign in ((d.b, 1.0), (d.a, -1.0)):
                its = measured.inside[other][d.cells]
                weight = np.maximum(sign * d.beyond[..., 3], 0) * numbering.area[d.cells[0]] * its
                unknowns.append(numbering.number[other][d.cells][weight > 0])
                targets.append(sign * d.beyond[weight > 0, :3])
                weights.append(weight[weight > 0])
        self._count = numbering.count
        self._unknowns, self._targets, self._weights = map(np.concatenate, (unknowns, targets, weights))

    def active(
        self, solution: npt.NDArray[np.float64], limit: float
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """What a round adds likewise: to the matrix's diagonal (count,), and to the right side (count, 3).

        A gain that is as high as its bound, or misses it by `limit` or more, is left alone.
        """
        short = self._targets - solution[self._unknowns]
        weight = _BOUND * self._weights * (short.mean(1) > 0) * _biweight(short, limit)
        held, pull = np.zeros(self._count), np.zeros((self._count, 3))
        np.add.at(held, self._unknowns, weight)
        np.add.at(pull, self._unknowns, weight[:, None] * self._targets)
        return held, pull


def _biweight(off: npt.NDArray[np.float64], limit: float) -> npt.NDArray[np.float64]:
    """Tukey's biweight of vectors (n, 3): 1 at 0, nothing from `limit` on."""
    return np.asarray(np.maximum(0.0, 1 - (np.square(off).sum(1) / limit**2)) ** 2)


def _steps(
    weighted: Sequence[tuple[_Numbers, _Numbers, npt.NDArray[np.float64]]], count: int
) -> tuple[scipy.sparse.csr_array, npt.NDArray[np.float64]]:
    """A matrix (n, count) that takes differences of `count` unknowns, and the weights (n,) of these.

    weighted    arrays of one shape: the unknown to take, the one to subtract, the weight; 0: no row.
    """
    taken, less, weights = (np.concatenate([entry[k][entry[2] > 0] for entry in weighted]) for k in range(3))
    rows = np.arange(weights.size)
    signs = np.repeat([1.0, -1.0], rows.size)
    places = np.tile(rows, 2), np.concatenate([taken, less])
    return scipy.sparse.csr_array((signs, places), shape=(rows.size, count)), weights

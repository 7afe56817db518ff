"""Flow of a pair that other pairs contradict, replaced by flow by way of a third layer (kernels/relay.cl).

Where layers a, b and c overlap, the flow from a to c equals the flow from a to b composed with that from b
to c. Where it does not, one of the three is wrong. Most often it is that of a small overlap, either because
much of what it shows is seen in the other layer beyond it, or because a pattern was matched one repeat too
far. It may lead forward and back consistently all the same.

Which one is wrong is told by the other triangles, and by the images. A pair is the less reliable the more
reliable pairs contradict it, and the worse its layers fit by its flow:

    r_ac = (h f_ac T_ac + A_ac) / (h f_ac T_ac + A_ac + D_ac).

    T   the sum of trust in the pair's own flow, over the cells of its overlap.
    f   its mean fit.
    h   a constant.
    A   the sum, over all other layers b, of what flow composed by way of b says for the pair's flow.
    D   the same for what it says against it.

What composed flow says weighs, in each cell, the trust in both legs times their fit times r_ab r_bc; it
counts for A by how near to each other both flows lead, for D by how far. All r start at 1, and become a fixed
point.

Two kinds of pairs are mended: doubted ones, and those of which others know much more than their own flow is
sure of. Where their flow contradicts the more reliable composed flows, or is not trusted, it becomes the
mean of these; but not around control points that agree with it, on what moves as they do.

The flow of a small overlap that others show in much larger ones is not even searched for (in a ring of
fisheyes that is a third of all pairs): it is inferred from the others, once these have been compared.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hugin_abflow.chart import Chart
from hugin_abflow.consistency import WeightedFlow
from hugin_abflow.geometry import Pair
from hugin_abflow.grid import Grid
from hugin_abflow.opencl import Buffer, Device

# Chart pixels in the side of a cell, in the middle of which flows are compared.
_CELL = 8
# Noise of log brightness, below which texture tells nothing.
_NOISE = 0.03
# Chart pixels between the ends of two flows that leave a quarter of their agreement.
_AGREES = 3.0
# h: the weight of a pair's own flow that fits, beside one composed flow that is sure all over its overlap.
_OWN = 0.3
# Pairs that are less reliable than this take composed flow that is more so, where there is any. (In rendered
# rooms, whose parallax is known, .9 spoilt some that were right.)
_DOUBTED = 0.8
# Of pairs that are less reliable than this nothing of their own flow is left, if others are sure enough.
_REFUTED = 0.33
# The part of the overlap in which others have to be sure for that.
_COVERED = 0.3
# The share of an overlap that others have to know, and its own flow does not, to be asked where it is not
# doubted.
_MISSED = 0.15
# Weight of composed flow (trust in both legs, times their fit and reliability) that is as good as sure.
_SURE = 0.1
# Rounds of the fixed point, each of which goes half of the way.
_ROUNDS = 8
# Weight that composed flow has to have in a cell for that to count.
_LEAST_WEIGHT = 0.05
# Cells that count, at least, for composed flow to tell something.
_LEAST_CELLS = 4
# Sigma, in working pixels, around a control point in which it holds flow that agrees with its move.
_HELD = 64.0
# Third layers that are asked about a pair, those with the largest overlaps: where many overlap each other,
# all triangles would be too many.
_MOST = 4
# How many times as large as a small overlap those of a third layer have to be for its flow to be inferred.
_MUCH = 3.0
# The share of that overlap that they have to show.
_ALL = 0.95

Values = npt.NDArray[np.float64]
Key = tuple[int, int]


@dataclass(frozen=True)
class _DirectedFlow:
    """Flow from one layer of a pair to the other, as it was found.

    forward, backward   on the chart: this flow and the opposite one (`WeightedFlow`).
    cells       what `relay_cells` tells of it, on the device.
    vectors     (height, width, 2) in cells, px of the chart.
    overlap     (height, width): which cells lie in the overlap.
    trust       (height, width), 0..1; 0 beside the overlap.
    fit         mean of how well both layers fit by it, 0..1.
    """

    chart: Chart
    forward: Buffer
    backward: Buffer
    cells: Buffer
    vectors: Values
    overlap: npt.NDArray[np.bool_]
    trust: Values
    fit: float

    @property
    def area(self) -> float:
        """Working px in which it is trusted."""
        return float(self.trust.sum()) * (_CELL * self.chart.coarse) ** 2


@dataclass(frozen=True)
class _ComposedFlow:
    """Flow of a pair by way of a third layer.

    via         that layer.
    weight      (height, width) in cells of the pair's chart: how far it is known, 0..1.
    agrees, differs     sums over cells: how far it leads where the pair's own flow does, and elsewhere.
    """

    via: int
    weight: Values
    agrees: float
    differs: float


@dataclass(frozen=True)
class Compared:
    """Flows of pairs in both directions, those composed by way of third layers, and how reliable each pair
    is, 0..1, in both directions the same.
    """

    flows: dict[Key, _DirectedFlow]
    composed: dict[Key, list[_ComposedFlow]]
    reliability: dict[Key, float]


def triangles(pairs: Iterable[Pair]) -> bool:
    """Whether there are three layers each two of which are a pair."""
    partners = _partners((pair.a, pair.b) for pair in pairs)
    return any(partners[a] & partners[b] for a, its in partners.items() for b in its)


def inferable(pairs: Sequence[Pair], overlaps: Sequence[npt.NDArray[np.bool_]], grid: Grid) -> list[bool]:
    """Of which pairs flow need not be found: others show all of their overlap, in much larger overlaps with
    each of both layers. What was found in such a small one would be replaced, or seldom matter: two photos
    that end in the middle of a third one weigh little there.

    overlaps    of `pairs`, on `grid`.
    """
    keys = [(pair.a, pair.b) for pair in pairs]
    number, area = dict[Key, int](), dict[Key, float]()
    for index, (a, c) in enumerate(keys):
        number[a, c] = number[c, a] = index
        area[a, c] = area[c, a] = _area(overlaps[index], grid)
    partners, found = _partners(keys), set[Key]()
    for a, c in sorted(keys, key=lambda key: (-area[key], key)):
        legs = [b for b in partners[a] & partners[c] if found.isdisjoint(((a, b), (b, c)))]
        smaller = {b: min(area[a, b], area[b, c]) for b in legs}
        large = [b for b in _largest(smaller) if smaller[b] >= _MUCH * area[a, c]]
        shown = [overlaps[number[a, b]] & overlaps[number[b, c]] for b in large]
        if shown and _area(np.logical_or.reduce(shown), grid) >= _ALL * area[a, c]:
            found |= {(a, c), (c, a)}
    return [key in found for key in keys]


def _area(mask: npt.NDArray[np.bool_], grid: Grid) -> float:
    """In pixels of the grid, on a sphere those of its equator."""
    return float(np.count_nonzero(mask, 1) @ grid.row_widths)


def _largest(areas: Mapping[int, float]) -> list[int]:
    """The third layers that are asked, of those with these areas."""
    return sorted(areas, key=lambda layer: (-areas[layer], layer))[:_MOST]


def compare(device: Device, found: Sequence[WeightedFlow]) -> Compared:
    """What pairs say of each other."""
    flows = dict(_directed(device, found))
    composed = dict(_all_composed(device, flows, flows))
    return Compared(flows, composed, _reliability(flows, composed))


def mend(
    device: Device, found: Sequence[WeightedFlow], compared: Compared, held: Mapping[Key, Values]
) -> list[Key]:
    """Replace, in place, flow that others contradict, or know better; returns of which pairs, as (a, b).

    compared    what `found` say of each other, as `compare` tells; no longer true of pairs that are returned.
    held        for some pairs, in both directions, control points that hold their flow: places and moves,
                (n, 4) px of their chart.
    """
    flows, composed, reliability = compared.flows, compared.composed, compared.reliability
    changed = []
    # the least reliable first: legs of what is doubted are more so, and still as they were found
    for a, c in sorted(((pair.a, pair.b) for pair in found), key=lambda pair: (reliability[pair], pair)):
        doubted = reliability[a, c] < _DOUBTED
        better = {key: _better(key, composed[key], reliability) for key in ((a, c), (c, a))}
        if not all(better.values()):  # both directions are needed for consistency
            continue
        if doubted or all(_missed(flows[key], its) >= _MISSED for key, its in better.items()):
            covered = all(_covered(flows[key], its) >= _COVERED for key, its in better.items())
            own_weight = 0.0 if reliability[a, c] < _REFUTED and covered else 1.0
            totals = {key: _sum(device, flows, key, its, reliability) for key, its in better.items()}
            for key, total in totals.items():  # all of them are known before one is taken
                _take(device, flows[key], total, own_weight, held.get(key))
            changed.append((a, c))
    return sorted(changed)


def infer(device: Device, compared: Compared, unknown: Sequence[WeightedFlow]) -> None:
    """Give `unknown` pairs, in place, flow composed of that of others, where reliable ones know it.

    compared    what all others say of each other, mended: what is doubted of them still has no say.
    """
    asked = dict(_directed(device, unknown))
    flows = compared.flows | asked
    reliability = compared.reliability | dict.fromkeys(asked, 1.0)
    for key, composed in _all_composed(device, flows, asked):
        total = _sum(device, flows, key, _better(key, composed, reliability), reliability)
        _take(device, flows[key], total, 0.0, None)


def _take(device: Device, flow: _DirectedFlow, total: Buffer, own_weight: float, held: Values | None) -> None:
    """Replace a flow by the mean of composed ones, in place. own_weight: of its own trust, 0 or 1."""
    grid = flow.chart.border
    if held is not None and len(held):
        device.run(
            "relay", "relay_hold", grid.size, device.upload(held, np.float32), len(held),
            _HELD / flow.chart.coarse, _AGREES, flow.forward, grid, total,
        )  # fmt: skip
    device.run("relay", "relay_take", grid.size, total, grid, _SURE, _AGREES, own_weight, flow.forward)


def _legs(key: Key, via: int, reliability: dict[Key, float]) -> float:
    """How reliable flow from a to c by way of another layer is: both legs of it."""
    return reliability[key[0], via] * reliability[via, key[1]]


def _better(
    key: Key, composed: Sequence[_ComposedFlow], reliability: dict[Key, float]
) -> list[_ComposedFlow]:
    """The composed flows that are more reliable than the pair, or reliable enough."""
    least = min(reliability[key], _DOUBTED)
    return [one for one in composed if _legs(key, one.via, reliability) > least]


def _sum(
    device: Device,
    flows: dict[Key, _DirectedFlow],
    key: Key,
    composed: Sequence[_ComposedFlow],
    reliability: dict[Key, float],
) -> Buffer:
    """The weighted sum of composed flows at all pixels of the pair's chart, as `relay_add` makes it."""
    chart = flows[key].chart
    total = device.zeros((chart.height, chart.width, 4))
    for one in composed:
        _add(device, flows, (key[0], one.via, key[1]), 1, _legs(key, one.via, reliability), total)
    return total


def _partners(keys: Iterable[Key]) -> dict[int, set[int]]:
    """With which others each layer is a pair."""
    result = defaultdict[int, set[int]](set)
    for a, b in keys:
        result[a].add(b)
        result[b].add(a)
    return result


def _directed(device: Device, found: Sequence[WeightedFlow]) -> Iterator[tuple[Key, _DirectedFlow]]:
    for pair in found:
        for key, own, other in (
            ((pair.a, pair.b), pair.forward, pair.backward),
            ((pair.b, pair.a), pair.backward, pair.forward),
        ):
            yield key, _in_cells(device, pair.chart, own, other)


def _in_cells(device: Device, chart: Chart, forward: Buffer, backward: Buffer) -> _DirectedFlow:
    size = -(-chart.width // _CELL), -(-chart.height // _CELL)
    cells = device.empty((*size[::-1], 4))
    device.run("relay", "relay_cells", size, forward, backward, chart.border, _CELL, _NOISE, size, cells)
    values = cells.get().astype(np.float64)
    overlap, trust, fit = values[..., 2] >= 0, np.maximum(values[..., 2], 0), values[..., 3]
    known = trust * (fit >= 0)
    mean = float((known * fit).sum() / known.sum()) if known.any() else 1.0
    values[..., 3] = np.where(fit >= 0, fit, mean)  # where it cannot be seen
    cells.set(values.astype(np.float32))
    return _DirectedFlow(chart, forward, backward, cells, values[..., :2], overlap, trust, mean)


def _all_composed(
    device: Device, flows: dict[Key, _DirectedFlow], asked: Iterable[Key]
) -> Iterator[tuple[Key, list[_ComposedFlow]]]:
    """The flows by way of third layers, for each pair that is asked."""
    partners = _partners(flows)
    for a, c in asked:
        smaller = {b: min(flows[a, b].area, flows[b, c].area) for b in partners[a] & partners[c]}
        yield (a, c), list(_composed(device, flows, (a, c), sorted(_largest(smaller))))


def _composed(
    device: Device, flows: dict[Key, _DirectedFlow], key: Key, third: Iterable[int]
) -> Iterator[_ComposedFlow]:
    """The flows from a to c by way of some third layers, of those that tell something."""
    own, (a, c) = flows[key], key
    for b in third:
        total = device.zeros((*own.trust.shape, 4))
        _add(device, flows, (a, b, c), _CELL, 1.0, total)
        values = total.get().astype(np.float64)
        weight = values[..., 2]
        if np.count_nonzero(weight > _LEAST_WEIGHT) < _LEAST_CELLS:
            continue
        vectors = values[..., :2] / np.maximum(weight, 1e-12)[..., None]
        agree = 1 / np.square(1 + np.square(vectors - own.vectors).sum(-1) / _AGREES**2)
        common = weight * own.trust
        yield _ComposedFlow(b, weight, float((common * agree).sum()), float((common * (1 - agree)).sum()))


def _add(
    device: Device,
    flows: dict[Key, _DirectedFlow],
    path: tuple[int, int, int],
    step: int,
    share: float,
    total: Buffer,
) -> None:
    """Add the flow from a to c by way of b, for path (a, b, c), at every step-th pixel of their chart."""
    a, b, c = path
    first, second, own = flows[a, b], flows[b, c], flows[a, c]
    size = total.shape[1], total.shape[0]
    device.run(
        "relay", "relay_add", size, first.forward, first.backward, first.cells, first.chart.border,
        first.chart.transform, second.forward, second.backward, second.cells, second.chart.border,
        second.chart.transform, _CELL, own.chart.border, own.chart.transform, step, size, share, total,
    )  # fmt: skip


def _reliability(
    flows: dict[Key, _DirectedFlow], composed: dict[Key, list[_ComposedFlow]]
) -> dict[Key, float]:
    """r: how reliable each pair is, 0..1, in both directions the same."""
    result = dict.fromkeys(flows, 1.0)
    for _ in range(_ROUNDS):
        new = {key: _ratio(key, flows[key], composed[key], result) for key in flows}
        result = {(a, c): (2 * r + new[a, c] + new[c, a]) / 4 for (a, c), r in result.items()}
    return result


def _ratio(
    key: Key, own: _DirectedFlow, composed: Sequence[_ComposedFlow], reliability: dict[Key, float]
) -> float:
    """How reliable a flow is, if the others are as reliable as that."""
    differs = sum(_legs(key, one.via, reliability) * one.differs for one in composed)
    agrees = sum(_legs(key, one.via, reliability) * one.agrees for one in composed)
    support = _OWN * own.fit * float(own.trust.sum()) + agrees
    return support / (support + differs) if differs else 1.0


def _weights(composed: Sequence[_ComposedFlow]) -> Values:
    """The sum of composed flows' weights, by cells."""
    return np.asarray(np.sum([one.weight for one in composed], axis=0))


def _missed(flow: _DirectedFlow, composed: Sequence[_ComposedFlow]) -> float:
    """The share of an overlap that others know, and in which its own flow is not trusted."""
    missed = (1 - flow.trust) * np.minimum(_weights(composed), 1)
    return float(missed[flow.overlap].mean()) if flow.overlap.any() else 0.0


def _covered(flow: _DirectedFlow, composed: Sequence[_ComposedFlow]) -> float:
    """The share of what own flow is trusted in that others are sure of."""
    trusted = flow.trust.sum()
    sure = np.minimum(_weights(composed) / _SURE, 1)
    return float((flow.trust * sure).sum() / trusted) if trusted else 1.0

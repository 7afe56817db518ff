"""Flow of a pair that other pairs contradict, by way of a third layer instead (kernels/relay.cl).

Where a, b and c overlap, the way from a to c is that from a to b and on to c. Where it is not, one of the
three flows is wrong: most often that of a small overlap, of which much is seen beyond it in the other layer,
or in which a pattern was matched one repeat too far; and it may lead back to the start all the same. Which
one it is, the other triangles tell, and the images: a pair is the less reliable the more pairs contradict it
that are reliable themselves, and the worse its layers fit by it,

    r_ac = (h f_ac T_ac + A_ac) / (h f_ac T_ac + A_ac + D_ac).

T is the sum of trust in its own flow, over cells of its overlap; f its mean fit; h a constant. A is the sum,
over all other layers b, of what ways by b say for that flow, and D of what they say against it: the trust
that both have in a cell, times the fit of the legs, r_ab r_bc, and how near to each other they lead, or how
far. It is solved by a fixed point, from r = 1. Of doubted pairs, and of those of which others know much more
than their own flow is sure of, what contradicts the more reliable ways becomes their mean, and so does what
is not trusted; but not around control points that own flow agrees with, on what moves as they do.

The flow of small overlaps that others show in much larger ones need not be found before, in a ring of
fisheyes that of a third of all pairs; it is told by others, once these have been compared.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hugin_abflow.chart import Chart
from hugin_abflow.consistency import Weighed
from hugin_abflow.geometry import Pair
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.working import Grid

# Chart pixels in the side of a cell, in the middle of which ways are compared.
_CELL = 8
# Noise of log brightness, below which texture tells nothing.
_NOISE = 0.03
# Chart pixels between two ways that agree to a quarter.
_AGREES = 3.0
# What an overlap that fits has to say of itself, against one other way that is believed all over it.
_OWN = 0.3
# Pairs that are less reliable than this go by way of others that are more so, where these know it. (In
# rendered rooms, whose parallax is known, .9 spoilt some that were right.)
_DOUBTED = 0.8
# Below this, if others are sure in such a part of the overlap, nothing of its own flow is left.
_REFUTED, _COVERED = 0.33, 0.3
# The share of an overlap that others have to know, and its own flow does not, to be asked where it is not
# doubted.
_MISSED = 0.15
# How far a way is to be believed, both legs times their fit and reliability, that is as good as sure.
_SURE = 0.1
# Rounds of the fixed point, each of which goes half of the way.
_ROUNDS = 8
# A way has to be known so far in so many cells.
_KNOWN, _LEAST_CELLS = 0.05, 4
# Working pixels around a control point, a sigma, in which it holds flow that is as far from its own move as
# ways that agree.
_HELD = 64.0
# Third layers that are asked about a pair, those with the largest overlaps: where many overlap each other,
# all triangles would be too many.
_MOST = 4
# How much larger the overlaps of a third layer have to be than one for whose flow they stand, and how much of
# it they have to show.
_MUCH, _ALL = 3.0, 0.95

Values = npt.NDArray[np.float64]
Key = tuple[int, int]


@dataclass(frozen=True)
class _Way:
    """Found flow from one layer of a pair to the other, and back; in cells, (height, width): its way, in px,
    whether it lies in the overlap, and its trust, 0 beside that; and the mean of its fit.
    """

    chart: Chart
    found: Buffer
    back: Buffer
    cells: Buffer
    flow: Values
    inside: npt.NDArray[np.bool_]
    trust: Values
    fit: float

    @property
    def area(self) -> float:
        """Working px in which it is trusted."""
        return float(self.trust.sum()) * (_CELL * self.chart.coarse) ** 2


@dataclass(frozen=True)
class _Other:
    """A way by a third layer: how far it is known, 0..1 in cells; and the sums, in cells, of where it leads
    as the pair's own flow does, and elsewhere.
    """

    by: int
    known: Values
    agrees: float
    differs: float


@dataclass(frozen=True)
class Compared:
    """Ways of pairs, those by third layers, and how reliable each is, 0..1, both ways the same."""

    ways: dict[Key, _Way]
    others: dict[Key, list[_Other]]
    reliable: dict[Key, float]


def triangles(pairs: Iterable[Pair]) -> bool:
    """Whether there are three layers each two of which are a pair."""
    beside = _beside((pair.a, pair.b) for pair in pairs)
    return any(beside[a] & beside[b] for a, its in beside.items() for b in its)


def relayed(pairs: Sequence[Pair], overlaps: Sequence[npt.NDArray[np.bool_]], grid: Grid) -> list[bool]:
    """Of which pairs flow need not be found: all that they share, others show, in much larger overlaps with
    each of both. What was found in such a small one would be replaced, or seldom matter: two photos that end
    in the middle of a third one weigh little there.

    overlaps    of `pairs`, on `grid`.
    """
    keys = [(pair.a, pair.b) for pair in pairs]
    number, area = dict[Key, int](), dict[Key, float]()
    for index, (a, c) in enumerate(keys):
        number[a, c] = number[c, a] = index
        area[a, c] = area[c, a] = _area(overlaps[index], grid)
    beside, found = _beside(keys), set[Key]()
    for a, c in sorted(keys, key=lambda key: (-area[key], key)):
        legs = [b for b in beside[a] & beside[c] if found.isdisjoint(((a, b), (b, c)))]
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


def compare(device: Device, found: Sequence[Weighed]) -> Compared:
    """What pairs say of each other."""
    ways = dict(_ways(device, found))
    others = dict(_all_others(device, ways, ways))
    return Compared(ways, others, _reliable(ways, others))


def mend(
    device: Device, found: Sequence[Weighed], compared: Compared, held: Mapping[Key, Values]
) -> list[Key]:
    """Replace, in place, flow that others contradict, or know better; returns of which pairs, as (a, b).

    compared    what `found` say of each other. Where something is returned, it no longer is.
    held        for some pairs, both ways, control points that hold their flow: places and moves, (n, 4) px of
                their chart.
    """
    ways, others, reliable = compared.ways, compared.others, compared.reliable
    changed = []
    # the least reliable first: legs of what is doubted are more so, and still as they were found
    for a, c in sorted(((pair.a, pair.b) for pair in found), key=lambda pair: (reliable[pair], pair)):
        doubted = reliable[a, c] < _DOUBTED
        better = {key: _better(key, others[key], reliable) for key in ((a, c), (c, a))}
        if not all(better.values()):  # both ways have to lead back
            continue
        if doubted or all(_missed(ways[key], its) >= _MISSED for key, its in better.items()):
            covered = all(_covered(ways[key], its) >= _COVERED for key, its in better.items())
            counts = 0.0 if reliable[a, c] < _REFUTED and covered else 1.0
            totals = {key: _sum(device, ways, key, its, reliable) for key, its in better.items()}
            for key, total in totals.items():  # all of them are known before one is taken
                _take(device, ways[key], total, counts, held.get(key))
            changed.append((a, c))
    return sorted(changed)


def tell(device: Device, compared: Compared, unknown: Sequence[Weighed]) -> None:
    """Have `unknown` pairs go by way of others, in place, where reliable ones of these know it.

    compared    what all others say of each other, mended: what is doubted of them still has no say.
    """
    asked = dict(_ways(device, unknown))
    ways = compared.ways | asked
    reliable = compared.reliable | dict.fromkeys(asked, 1.0)
    for key, others in _all_others(device, ways, asked):
        total = _sum(device, ways, key, _better(key, others, reliable), reliable)
        _take(device, ways[key], total, 0.0, None)


def _take(device: Device, way: _Way, total: Buffer, counts: float, held: Values | None) -> None:
    """Make a way's flow that of others, in place. counts: what its own trust does, 0 or 1."""
    grid = way.chart.border
    if held is not None and len(held):
        device.run(
            "relay", "relay_hold", grid[:2], device.upload(held, np.float32), len(held),
            _HELD / way.chart.coarse, _AGREES, way.found, grid, total,
        )  # fmt: skip
    device.run("relay", "relay_take", grid[:2], total, grid, _SURE, _AGREES, counts, way.found)


def _share(key: Key, by: int, reliable: dict[Key, float]) -> float:
    """How reliable the way from a to c by another layer is."""
    return reliable[key[0], by] * reliable[by, key[1]]


def _better(key: Key, others: Sequence[_Other], reliable: dict[Key, float]) -> list[_Other]:
    """The others that are more reliable than the pair, or reliable enough."""
    least = min(reliable[key], _DOUBTED)
    return [one for one in others if _share(key, one.by, reliable) > least]


def _sum(
    device: Device, ways: dict[Key, _Way], key: Key, others: Sequence[_Other], reliable: dict[Key, float]
) -> Buffer:
    """The weighted sum of the ways by others at all pixels."""
    chart = ways[key].chart
    total = device.zeros((chart.height, chart.width, 4))
    for one in others:
        _add(device, ways, (key[0], one.by, key[1]), 1, _share(key, one.by, reliable), total)
    return total


def _beside(keys: Iterable[Key]) -> dict[int, set[int]]:
    """With which others each layer is a pair."""
    result = defaultdict[int, set[int]](set)
    for a, b in keys:
        result[a].add(b)
        result[b].add(a)
    return result


def _ways(device: Device, found: Sequence[Weighed]) -> Iterator[tuple[Key, _Way]]:
    for pair in found:
        for key, own, other in (
            ((pair.a, pair.b), pair.forward, pair.backward),
            ((pair.b, pair.a), pair.backward, pair.forward),
        ):
            yield key, _way(device, pair.chart, own, other)


def _way(device: Device, chart: Chart, own: Buffer, other: Buffer) -> _Way:
    size = -(-chart.width // _CELL), -(-chart.height // _CELL)
    cells = device.empty((*size[::-1], 4))
    device.run("relay", "relay_cells", size, own, other, chart.border, _CELL, _NOISE, size, cells)
    values = cells.get().astype(np.float64)
    inside, trust, fit = values[..., 2] >= 0, np.maximum(values[..., 2], 0), values[..., 3]
    known = trust * (fit >= 0)
    mean = float((known * fit).sum() / known.sum()) if known.any() else 1.0
    values[..., 3] = np.where(fit >= 0, fit, mean)  # where it cannot be seen
    cells.set(values.astype(np.float32))
    return _Way(chart, own, other, cells, values[..., :2], inside, trust, mean)


def _all_others(
    device: Device, ways: dict[Key, _Way], asked: Iterable[Key]
) -> Iterator[tuple[Key, list[_Other]]]:
    """The ways by third layers, for each that is asked."""
    beside = _beside(ways)
    for a, c in asked:
        smaller = {b: min(ways[a, b].area, ways[b, c].area) for b in beside[a] & beside[c]}
        yield (a, c), list(_others(device, ways, (a, c), sorted(_largest(smaller))))


def _others(device: Device, ways: dict[Key, _Way], key: Key, by: Iterable[int]) -> Iterator[_Other]:
    """The ways from a to c by some other layers, of those that tell something."""
    own, (a, c) = ways[key], key
    for b in by:
        total = device.zeros((*own.trust.shape, 4))
        _add(device, ways, (a, b, c), _CELL, 1.0, total)
        values = total.get().astype(np.float64)
        known = values[..., 2]
        if np.count_nonzero(known > _KNOWN) < _LEAST_CELLS:
            continue
        flow = values[..., :2] / np.maximum(known, 1e-12)[..., None]
        agree = 1 / np.square(1 + np.square(flow - own.flow).sum(-1) / _AGREES**2)
        told = known * own.trust
        yield _Other(b, known, float((told * agree).sum()), float((told * (1 - agree)).sum()))


def _add(
    device: Device, ways: dict[Key, _Way], path: tuple[int, int, int], step: int, share: float, total: Buffer
) -> None:
    """Add the way from a to c by b, for path (a, b, c), at every step-th pixel of their chart."""
    a, b, c = path
    first, second, own = ways[a, b], ways[b, c], ways[a, c]
    size = total.shape[1], total.shape[0]
    device.run(
        "relay", "relay_add", size, first.found, first.back, first.cells, first.chart.border,
        first.chart.transform, second.found, second.back, second.cells, second.chart.border,
        second.chart.transform, _CELL, own.chart.border, own.chart.transform, step, size, share, total,
    )  # fmt: skip


def _reliable(ways: dict[Key, _Way], others: dict[Key, list[_Other]]) -> dict[Key, float]:
    """How reliable each pair is, 0..1, both ways the same."""
    reliable = dict.fromkeys(ways, 1.0)
    for _ in range(_ROUNDS):
        told = {key: _told(key, ways[key], others[key], reliable) for key in ways}
        reliable = {(a, c): (2 * r + told[a, c] + told[c, a]) / 4 for (a, c), r in reliable.items()}
    return reliable


def _told(key: Key, own: _Way, others: Sequence[_Other], reliable: dict[Key, float]) -> float:
    """How reliable a pair is, if the others are as reliable as that."""
    differs = sum(_share(key, one.by, reliable) * one.differs for one in others)
    agrees = sum(_share(key, one.by, reliable) * one.agrees for one in others)
    held = _OWN * own.fit * float(own.trust.sum()) + agrees
    return held / (held + differs) if differs else 1.0


def _known(others: Sequence[_Other]) -> Values:
    """How far a way is known by others, by cells."""
    return np.asarray(np.sum([one.known for one in others], axis=0))


def _missed(way: _Way, others: Sequence[_Other]) -> float:
    """The share of an overlap that others know, and in which its own flow is not trusted."""
    missed = (1 - way.trust) * np.minimum(_known(others), 1)
    return float(missed[way.inside].mean()) if way.inside.any() else 0.0


def _covered(way: _Way, others: Sequence[_Other]) -> float:
    """The share of what own flow is trusted in that others are sure of."""
    trusted = way.trust.sum()
    return float((way.trust * np.minimum(_known(others) / _SURE, 1)).sum() / trusted) if trusted else 1.0

"""A label for each node of a graph, of least energy, by graph cuts.

    energy = sum_nodes price[label, node]  +  sum_links cut [label of first != label of second]

Each step, an expansion, finds the best of all labellings in which every node keeps its label or takes one
label, the same for all (Boykov, Veksler, Zabih, "Fast approximate energy minimization via graph cuts", 2001).
What that takes grows faster than the graph. A large one is therefore solved on blocks of nodes first, and
then anew near the cuts that were found (as Lombaert et al., "A multilevel banded graph cuts method", 2005).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

# Nodes of a graph that is solved at once.
_LARGE = 10_000
# Rounds in which nodes are left out of a graph whose label is certain.
_ROUNDS = 10
# Nodes on each side of a cut of blocks that it may be moved to.
_BAND = 16
# Capacity of a price of 1: capacities are integers, and prices are around 1.
_UNIT = 1000
# The largest capacity of a price: a node's four links have together less than _MUST.
_MOST = 2**27
# The capacity by which a node never keeps a label that it may not have.
_MUST = 2**30

Labels = npt.NDArray[np.intp]  # (nodes,)


@dataclass(frozen=True)
class Graph:
    """Nodes on a grid, prices and links.

    rows, columns   intp (nodes,): where they are.
    price           float64 (labels, nodes), of each label at each node.
    possible        bool (labels, nodes): labels that a node may have; where it has none of these it gets any.
    first, second   intp (links,): the nodes that are linked.
    cut             float64 (links,): price of different labels there.
    """

    rows: npt.NDArray[np.intp]
    columns: npt.NDArray[np.intp]
    price: npt.NDArray[np.float64]
    possible: npt.NDArray[np.bool_]
    first: npt.NDArray[np.intp]
    second: npt.NDArray[np.intp]
    cut: npt.NDArray[np.float64]


def energy(graph: Graph, labels: Labels, priced: npt.NDArray[np.bool_] | None = None) -> float:
    """What a labelling costs. priced: (nodes,), those whose own price counts; None: all."""
    own = np.take_along_axis(graph.price, labels[None], 0)
    own = (own if priced is None else np.where(priced, own, 0.0)).sum()
    return float(own + graph.cut[labels[graph.first] != labels[graph.second]].sum())


def least(graph: Graph) -> Labels:
    """The labelling of least energy found; the same for the same graph."""
    kinds, count = graph.price.shape
    if count > _LARGE:
        blocks, block = _in_blocks(graph)
        labels = least(blocks)[block]
        free = _band(graph, labels)
    else:
        labels = np.full(count, np.argmin(graph.price.sum(1)))
        free = np.ones(count, bool)
    for _ in range(1 if kinds == 2 else 2):
        for label in range(kinds):
            labels = _expand(graph, labels, label, free)
    return labels


def _in_blocks(graph: Graph) -> tuple[Graph, npt.NDArray[np.intp]]:
    """The graph for labellings that are the same within blocks of 2 x 2 places; the block of each node."""
    width = int(graph.columns.max()) // 2 + 1
    places, block = np.unique(graph.rows // 2 * width + graph.columns // 2, return_inverse=True)
    price = np.stack([_summed(block, one, places.size) for one in graph.price])
    possible = np.stack([np.bincount(block, ~one, places.size) == 0 for one in graph.possible])
    ends = np.sort([block[graph.first], block[graph.second]], 0)
    apart = ends[0] != ends[1]
    links, link = np.unique(ends[0, apart] * places.size + ends[1, apart], return_inverse=True)
    whole = Graph(
        places // width, places % width, price, possible,
        links // places.size, links % places.size, _summed(link, graph.cut[apart], links.size),
    )  # fmt: skip
    return whole, block


def _summed(
    places: npt.NDArray[np.intp], values: npt.NDArray[np.float64], count: int
) -> npt.NDArray[np.float64]:
    """Sums of the values at each of `count` places."""
    return np.asarray(np.bincount(places, values, count), np.float64)


def _band(graph: Graph, labels: Labels) -> npt.NDArray[np.bool_]:
    """Nodes near cuts, and near those with labels that they cannot have."""
    near: npt.NDArray[np.bool_] = ~np.take_along_axis(graph.possible, labels[None], 0)[0]
    apart = labels[graph.first] != labels[graph.second]
    near[graph.first[apart]] = near[graph.second[apart]] = True
    for _ in range(_BAND - 1):
        grown = near.copy()
        grown[graph.first[near[graph.second]]] = True
        grown[graph.second[near[graph.first]]] = True
        near = grown
    return near


def _expand(graph: Graph, labels: Labels, label: int, free: npt.NDArray[np.bool_]) -> Labels:
    """The best of all labellings in which each node that is `free` keeps its label or takes this one."""
    free = free & (labels != label) & (graph.possible[label] | ~graph.possible.any(0))
    nodes = np.flatnonzero(free)
    if not nodes.size:
        return labels
    number = np.full(labels.size, -1)
    number[nodes] = np.arange(nodes.size)
    linked = free[graph.first] | free[graph.second]
    first, second, cut = graph.first[linked], graph.second[linked], graph.cut[linked]
    # what a link costs now, and where only one of its nodes takes the label; where both do, nothing
    now = cut * (labels[first] != labels[second])
    only_first, only_second = cut * (labels[second] != label), cut * (labels[first] != label)
    both = free[first] & free[second]
    take = graph.price[label] - graph.price[labels, np.arange(labels.size)]  # to take it over to keep it
    take += _summed(first, only_first - now, labels.size)
    take += _summed(second, np.where(both, -only_first, only_second - now), labels.size)
    edge = (only_second + only_first - now)[both]
    must = graph.possible[label, nodes] & ~graph.possible[labels[nodes], nodes]
    own = np.where(must, 0, take[nodes])
    result = labels.copy()
    result[nodes[taking(number[first[both]], number[second[both]], edge, own, must)]] = label
    return result


def taking(
    first: npt.NDArray[np.intp],
    second: npt.NDArray[np.intp],
    edge: npt.NDArray[np.float64],
    own: npt.NDArray[np.float64],
    must: npt.NDArray[np.bool_],
) -> npt.NDArray[np.bool_]:
    """Which nodes take a label, by a minimal cut between those that do and those that keep theirs.

    edge        (links,): price where the first of a link keeps its label and the second takes the other.
    own         (nodes,): price of taking it over that of keeping.
    must        (nodes,): it has to be taken, whatever that costs.
    """
    unit = min(_UNIT, _MOST / max(np.abs(own).max(), edge.max(initial=0), 1))
    capacity = np.maximum(np.rint(edge * unit), 0)
    takes, is_open, own, linked = _settled(
        first, second, capacity, np.where(must, -_MUST, np.rint(own * unit))
    )
    if not is_open.any():
        return takes
    own, number = own[is_open], np.cumsum(is_open) - 1
    count = own.size
    source, sink, each = count, count + 1, np.arange(count)
    starts = np.concatenate([number[first[linked]], np.full(count, source), each])
    ends = np.concatenate([number[second[linked]], each, np.full(count, sink)])
    capacities = np.concatenate([capacity[linked], np.maximum(own, 0), np.maximum(-own, 0)])
    whole = np.minimum(capacities, _MUST).astype(np.int32)
    network = scipy.sparse.csr_array((whole, (starts, ends)), shape=(count + 2, count + 2))
    left = network - scipy.sparse.csgraph.maximum_flow(network, source, sink).flow
    left.eliminate_zeros()
    keeps = scipy.sparse.csgraph.breadth_first_order(left, source, return_predecessors=False)
    open_takes = np.ones(count + 2, bool)
    open_takes[keeps] = False
    takes[is_open] = open_takes[:count]
    return takes


def _settled(
    first: npt.NDArray[np.intp],
    second: npt.NDArray[np.intp],
    edge: npt.NDArray[np.float64],
    own: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_], npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """What does not need a cut: nodes that keep their label, or take the other one, whatever others do. They
    are left out, and what remains is the same problem.

    edge, own   as for `taking`, whole numbers.

    Returns which nodes take it, (nodes,); which are open; for these the price, with that of links to nodes
    that are not; and which links are between two of these, (links,).
    """
    count, own = own.size, own.copy()
    takes, is_open, linked = np.zeros(count, bool), np.ones(count, bool), edge > 0
    for _ in range(_ROUNDS):
        start, end, price = first[linked], second[linked], edge[linked]
        # more than is saved if all that follow it take it too; less than is lost if none before it does
        keep = is_open & (own > _summed(start, price, count))
        take = is_open & (own + _summed(end, price, count) <= 0)
        if not (keep | take).any():
            break
        takes |= take
        is_open &= ~(keep | take)
        own += _summed(end[keep[start]], price[keep[start]], count)
        own -= _summed(start[take[end]], price[take[end]], count)
        linked[linked] = is_open[start] & is_open[end]
    return takes, is_open, own, linked

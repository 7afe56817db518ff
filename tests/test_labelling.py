"""Labels of least energy: against all that are possible, and large graphs against the same solved at once."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hugin_abflow import labelling
from hugin_abflow.labelling import Graph, energy, least


def grid_graph(height: int, width: int, labels: int, rng: np.random.Generator, smooth: int = 1) -> Graph:
    """Random prices, cuts that are dear or cheap over patches, and labels that end somewhere."""
    number = np.arange(height * width).reshape(height, width)
    links = [np.stack([number[:, :-1], number[:, 1:]]), np.stack([number[:-1], number[1:]])]
    first, second = np.concatenate([one.reshape(2, -1) for one in links], 1)
    rough = rng.random((-(-height // smooth), -(-width // smooth))) ** 3
    rough = np.kron(rough, np.ones((smooth, smooth)))[:height, :width].ravel()
    rows, columns = (place.ravel() for place in np.mgrid[:height, :width])
    ends = rng.integers(0, width, labels)
    possible = np.stack([columns >= end if k % 2 else columns <= end for k, end in enumerate(ends)])
    possible[0] |= ~possible.any(0)
    price = np.where(possible, 0.1 * rng.random(possible.shape), 1e4)
    return Graph(rows, columns, price, possible, first, second, rough[first] + rough[second])


@settings(max_examples=150)
@given(
    st.tuples(st.integers(1, 3), st.integers(1, 3)),
    st.integers(1, 3),
    st.integers(0, 2**32 - 1),
    st.sampled_from([1.0, 1e4, 1e6, 1e8]),
    st.booleans(),
)
def test_nothing_is_better(shape: tuple[int, int], labels: int, seed: int, scale: float, lost: bool) -> None:
    """Of two labels; of three next to nothing. Prices may exceed that of what is impossible, as in HDR, and
    a node may be left with no label that it may have.
    """
    rng = np.random.default_rng(seed)
    graph = grid_graph(*shape, labels, rng)
    if lost:
        graph.possible[:, rng.integers(graph.rows.size)] = False
    price = np.where(graph.possible, scale * graph.price, 1e4)
    graph = replace(graph, price=price, cut=scale * graph.cut)
    found = least(graph)
    assert np.take_along_axis(graph.possible, found[None], 0)[0, graph.possible.any(0)].all()
    allowed = (np.flatnonzero(one if one.any() else ~one) for one in graph.possible.T)
    best = min(energy(graph, np.array(one)) for one in product(*allowed))
    rounding = scale * 4 * (graph.first.size + found.size) / labelling._UNIT
    assert best <= energy(graph, found) + 1e-9 * scale
    assert energy(graph, found) <= 1.1 * best + rounding


def test_a_node_that_can_have_no_label_gets_any() -> None:
    graph = grid_graph(3, 5, 3, np.random.default_rng(3))
    graph.possible[:, 7] = False
    graph.price[:, 7] = 1e4
    found = least(graph)
    others = np.arange(15) != 7
    assert np.take_along_axis(graph.possible, found[None], 0)[0, others].all()
    assert found[7] in found[[2, 6, 8, 12]]  # no cut more than needed


@pytest.mark.parametrize("seed", range(3))
def test_blocks_cost_what_their_nodes_do(seed: int) -> None:
    rng = np.random.default_rng(seed)
    graph = grid_graph(13, 17, 3, rng)
    some = rng.permutation(graph.rows.size)[:180]  # regions have any shape, nodes any order
    number = np.full(graph.rows.size, -1)
    number[some] = np.arange(some.size)
    linked = (number[graph.first] >= 0) & (number[graph.second] >= 0)
    graph = Graph(
        graph.rows[some], graph.columns[some], graph.price[:, some], graph.possible[:, some],
        number[graph.first[linked]], number[graph.second[linked]], graph.cut[linked],
    )  # fmt: skip
    blocks, block = labelling._in_blocks(graph)
    assert np.array_equal(blocks.rows[block], graph.rows // 2)
    assert np.array_equal(blocks.columns[block], graph.columns // 2)
    for k in range(blocks.rows.size):
        assert np.array_equal(blocks.possible[:, k], graph.possible[:, block == k].all(1))
    labels = rng.integers(0, 3, blocks.rows.size)
    assert energy(blocks, labels) == pytest.approx(energy(graph, labels[block]))


@pytest.mark.parametrize("seed", range(4))
def test_large_graphs_are_solved_nearly_as_well_on_blocks(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    graph = grid_graph(61, 75, 4, np.random.default_rng(seed), 7)
    whole = least(graph)
    monkeypatch.setattr(labelling, "_LARGE", 500)
    sizes, expand = [], labelling._expand
    monkeypatch.setattr(
        labelling, "_expand", lambda graph, *more: sizes.append(graph.rows.size) or expand(graph, *more)
    )
    found = least(graph)
    assert [sizes.count(count) for count in sorted(set(sizes))] == [8, 8, 8] and min(sizes) < 500
    assert np.take_along_axis(graph.possible, found[None], 0).all()
    assert 0 < energy(graph, whole) < 1e4
    assert energy(graph, found) <= 1.1 * energy(graph, whole)


def test_blocks_that_can_have_no_label_are_looked_at_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """Far from any cut."""
    graph = grid_graph(40, 40, 2, np.random.default_rng(0))
    possible = np.ones((2, 1600), bool)
    possible[1, 20 * 40 + 20] = possible[0, 20 * 40 + 21] = False  # within one block
    price = np.where(possible, [[0.0], [1.0]], 1e4)
    graph = replace(graph, possible=possible, price=price, cut=np.full(graph.cut.size, 0.1))
    monkeypatch.setattr(labelling, "_LARGE", 500)
    assert np.flatnonzero(least(graph)).tolist() == [20 * 40 + 21]


def test_cuts_are_moved_within_the_band(monkeypatch: pytest.MonkeyPatch) -> None:
    """Past a wall that blocks do not tell from what is beside it."""
    graph = grid_graph(40, 40, 2, np.random.default_rng(0))
    column = np.minimum(graph.columns[graph.first], graph.columns[graph.second])
    possible = np.stack([graph.columns < 30, graph.columns > 9])
    cut = np.where(column == 18, 0.5, np.where(abs(column - 14) < 3, 0.8, 1.0))
    graph = replace(graph, possible=possible, price=np.where(possible, 0.0, 1e4), cut=cut)
    blocks, block = labelling._in_blocks(graph)
    start = least(blocks)[block]
    monkeypatch.setattr(labelling, "_LARGE", 500)
    found = least(graph)
    assert np.array_equal(found, graph.columns > 18)  # blocks are cut between odd and even columns
    assert (found != start).mean() > 0.05


@settings(max_examples=200)
@given(st.integers(1, 8), st.integers(0, 24), st.integers(0, 2**32 - 1))
def test_takes_all_that_may_take_a_label(nodes: int, links: int, seed: int) -> None:
    """Links have a direction, as in fusion.py; of equally good sets the one with all nodes of the others."""
    rng = np.random.default_rng(seed)
    first, second = rng.integers(0, nodes, (2, links))
    edge, own = rng.integers(0, 6, links).astype(float), rng.integers(-7, 8, nodes).astype(float)
    must = rng.random(nodes) < 0.1
    sets = (np.arange(2**nodes)[:, None] >> np.arange(nodes)) & 1 == 1
    sets = sets[(sets | ~must).all(1)]
    price = (sets * own).sum(1) + (edge * (~sets[:, first] & sets[:, second])).sum(1)
    expected = sets[price == price.min()].any(0)
    assert np.array_equal(labelling.taking(first, second, edge, own, must), expected)


def test_most_labels_are_certain_without_a_cut() -> None:
    """Prices differ by more than links cost but beside a border, as where textures differ."""
    side = 60
    graph = grid_graph(side, side, 2, np.random.default_rng(5))
    own = np.where(graph.columns < side // 2, 9.0, -9.0)
    own[np.abs(graph.columns - side // 2) < 3] = 0.1
    takes, is_open, _, linked = labelling._settled(graph.first, graph.second, graph.cut, own)
    assert np.count_nonzero(is_open) < 6 * side
    assert np.count_nonzero(linked) < 12 * side
    assert not takes[graph.columns < side // 2 - 3].any()
    assert takes[graph.columns >= side // 2 + 3].all()

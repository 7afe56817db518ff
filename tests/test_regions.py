"""Regions that one layer shows, whole: labels of least energy, and where regions are."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from grids import patches, plane, sphere
from hypothesis import given
from labels import CUT, alike, energies, label, many, problems

from hugin_abflow import labelling, regions, seam
from hugin_abflow.grid import Grid
from hugin_abflow.regions import Choice, Residuals

WRAPS = [False, True]

# Labels of least energy


def least_and_found(problem, layers: int) -> tuple[float, float, float]:
    """Least energy of all labellings, that of `label`, and what integer capacities may cost."""
    rows, columns, residual, _, cover, _ = problem
    found = label(*problem)
    assert found.shape == rows.shape
    assert cover[found, rows, columns].all()  # no layer is taken where it is not
    everything = np.array(list(product(range(layers), repeat=rows.size)))
    assert max(residual.mean.max(), residual.rms.max()) <= 3  # so that _FORBIDDEN forbids
    least = energies(everything, *problem).min()
    return least, energies(found[None], *problem)[0], 5 * rows.size / labelling._UNIT


@many
@given(problem=problems(2, 11))
def test_of_two_layers_the_least_energy_is_found(problem) -> None:
    least, found, rounding = least_and_found(problem, 2)
    assert least <= found + 1e-9
    assert found <= least + rounding


@many
@given(problem=problems(3, 7))
def test_of_three_layers_nearly_the_least_energy_is_found(problem) -> None:
    least, found, rounding = least_and_found(problem, 3)
    assert least <= found + 1e-9
    assert found <= 1.05 * least + rounding


def test_a_lone_layer_is_taken_even_where_it_is_not() -> None:
    """Nothing else could be."""
    rows, columns = np.array([0, 0, 1]), np.array([0, 1, 1])
    cover = np.zeros((3, 2, 2), bool)
    shares, residual = np.full((3, 2, 2), 1 / 3), alike(np.ones((2, 2)))
    assert label(rows, columns, residual, shares, cover, False).shape == (3,)
    cover[2, 0, 0] = True
    assert label(rows, columns, residual, shares, cover, False).tolist() == [2, 2, 2]


def valley(shift: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Layers differ by 1 but along two winding paths, two cells wide: residual, shares, whose cells."""
    columns, rows = np.meshgrid(np.arange(40), np.arange(15))
    left, right = 9 + np.abs(rows - 7) // 2, 30 - rows // 4
    residual = np.ones((15, 40))
    for path in (left, right):
        residual[(columns == path) | (columns == path - 1)] = 0.01
    share = np.clip(1.5 - np.abs(columns - 19.5) / 10, 0, 1)  # layer 1 is the middle's
    labels = (columns >= left) & (columns < right)
    return (
        np.roll(residual, shift, 1),
        np.roll(np.stack([1 - share, share]), shift, 2),
        np.roll(labels, shift, 1),
    )


@pytest.mark.parametrize(("shift", "wraps"), [(0, False), (0, True), (12, True), (25, True)])
def test_a_cut_runs_through_the_least_residual(shift: int, wraps: bool) -> None:
    """Not where the coefficients are equal, which is up to three cells beside; across the border, too."""
    residual, shares, expected = valley(shift)
    rows, columns = (v.ravel() for v in np.mgrid[0:15, 0:40])
    everywhere = np.ones((2, 15, 40), bool)
    found = label(rows, columns, alike(residual), shares, everywhere, wraps).reshape(15, 40)
    assert 0.3 < expected.mean() < 0.6
    assert np.array_equal(found, expected)
    assert not np.array_equal(found, shares.argmax(0))


def test_no_cut_runs_through_what_is_as_bright_as_the_other() -> None:
    """Low frequencies agree along the middle, where the coefficients are equal; what is there does not. The
    cut goes round it, where both agree in both."""
    rows, columns = (v.ravel() for v in np.mgrid[0:15, 0:30])
    mean, rms = np.full((15, 30), 0.3), np.full((15, 30), 0.4)
    mean[:, 14:16] = 0.01
    mean[:, 22:24] = rms[:, 22:24] = 0.02
    share = np.clip(np.arange(30) / 29, 0, 1) * np.ones((15, 1))
    shares, everywhere = np.stack([1 - share, share]), np.ones((2, 15, 30), bool)
    for residual, first in ((alike(mean), 15), (Residuals(mean, rms), 23)):
        found = label(rows, columns, residual, shares, everywhere, False).reshape(15, 30)
        assert np.array_equal(found, np.arange(30) >= first * np.ones((15, 1)))


def test_a_short_cut_through_what_differs_much_is_seen_less_than_a_long_one() -> None:
    """A face is two cells high, and a coat that is nearly as dark as what is behind it twelve: the cut goes
    where only the face shows it.
    """
    rows, columns = (v.ravel() for v in np.mgrid[0:14, 0:30])
    mean, rms = np.zeros((14, 30)), np.full((14, 30), 0.09)
    mean[:, :8] = mean[:, 26:] = 0.5
    rms[:2, 14:], rms[2:, 20:22] = 0.66, 0.05
    share = np.where(np.arange(30) < 15, 0.95, 0.05) * np.ones((14, 1))
    shares, everywhere = np.stack([share, 1 - share]), np.ones((2, 14, 30), bool)
    plain = Residuals(mean, rms)
    for residual, along in ((plain, False), (regions.seen(plain), True)):
        found = label(rows, columns, residual, shares, everywhere, False).reshape(14, 30)
        assert not found[:, :8].any() and found[:, 26:].all()
        assert (not found[:, :21].any() and found[:, 21:].all()) == along
    assert np.allclose(regions.seen(alike(np.array([[0.0, 0.15]]))).rms, [[0, 0.15]])


@pytest.mark.parametrize(
    ("differ", "at_edge", "gives_way"),
    [(0.5, 0.02, True), (0.5, 0.45, False), (0.25, 0.02, False)],
    ids=["bare", "no better", "not bare"],
)
def test_a_bare_cut_gives_way_to_a_long_one(differ: float, at_edge: float, gives_way: bool) -> None:
    """White stone before dark glass: the short way, where both layers are favoured alike, goes straight
    through, a long one along its edge.
    """
    rows, columns = (v.ravel() for v in np.mgrid[0:12, 0:40])
    edge = np.zeros((12, 40), bool)
    edge[:8, 2:4] = edge[6:8, 2:22] = edge[6:, 20:22] = True
    mean = np.where(edge, at_edge, differ)
    residual = Residuals(mean, np.where(edge, 0.1, 0.5))
    share = np.clip(np.linspace(1.1, -0.1, 40), 0, 1) * np.ones((12, 1))
    cover = np.ones((2, 12, 40), bool)
    cover[1, :, 0] = cover[0, :, 39] = False
    plain = Choice(np.ones((12, 40), bool), residual, np.stack([share, 1 - share]), cover, False, CUT)
    short, long = replace(plain, residual=regions.seen(residual)), replace(plain, cut_price=8 * CUT)
    straight, along = (one.label(rows, columns)[0] for one in (short, long))
    found = replace(short, otherwise=long).label(rows, columns)[0]
    assert not np.array_equal(straight, along)
    assert np.array_equal(found, along if gives_way else straight)


@pytest.mark.parametrize("at_edge", [0.005, 0.05])
def test_a_cut_through_a_thing_gives_way_to_one_beside_it(at_edge: float) -> None:
    """A thing that layers show at two places that overlap, alike there: far from where the softmax favours
    neither layer a cut is seen much less, or not.
    """
    rows, columns = (v.ravel() for v in np.mgrid[0:12, 0:40])
    rms = np.full((12, 40), 0.3)
    rms[:, 18:22], rms[:, 2:5] = 0.08, at_edge
    residual = Residuals(np.where(rms < 0.1, rms / 2, rms), rms)
    share = np.clip(np.linspace(1.1, -0.1, 40), 0, 1) * np.ones((12, 1))
    cover = np.ones((2, 12, 40), bool)
    cover[1, :, 0] = cover[0, :, 39] = False
    whole = np.ones((12, 40), bool)
    short = Choice(whole, residual, np.stack([share, 1 - share]), cover, False, CUT, 1.0 * whole)
    long = replace(short, cut_price=8 * CUT)
    through, beside = (one.label(rows, columns)[0].reshape(12, 40) for one in (short, long))
    assert (through[:, 17] == 0).all()
    assert (through[:, 22] == 1).all()
    found = replace(short, otherwise=long).label(rows, columns)[0].reshape(12, 40)
    assert np.array_equal(found, beside if at_edge < 0.01 else through)
    assert (beside[:, 5] == 1).all() or at_edge > 0.01


def test_how_bare_a_cut_is() -> None:
    """By what it is more than strong along it."""
    graph = regions.Graph(
        np.zeros(4, int), np.arange(4), np.zeros((2, 4)), np.ones((2, 4), bool),
        np.arange(3), np.arange(1, 4), np.ones(3),
    )  # fmt: skip
    mean = np.array([0.9, 0.5, 0.3, 0.1])
    assert np.isclose(regions._bareness(graph, mean, np.array([0, 1, 1, 1])), 0.5)
    assert np.isclose(regions._bareness(graph, mean, np.array([0, 1, 0, 0])), 0.7)
    assert regions._bareness(graph, mean, np.array([0, 0, 0, 1])) == 0


@pytest.mark.parametrize("seed", range(3))
def test_outside_regions_the_softmax_favours_the_first_of_equals(seed: int) -> None:
    """Of layers that are there; where none is, nobody's."""
    random = np.random.default_rng(seed)
    shares, cover = random.integers(0, 3, (4, 9, 11)) / 2, random.random((4, 9, 11)) < 0.4
    assert not cover.any(0).all()
    whole = np.zeros(cover.shape[1:], bool)
    owner, total = Choice(whole, alike(whole * 1.0), shares, cover, False, CUT).owners()
    assert np.array_equal(owner, np.where(cover.any(0), (shares * cover).argmax(0), -1))
    assert total == 0


def test_a_border_counts_as_a_cut() -> None:
    """A favoured layer that ends where its region does gives way to one that goes on beyond; where both end
    there is no cut to be seen."""
    rows, columns = (v.ravel() for v in np.mgrid[0:6, 0:7])
    residual, cover = alike(np.ones((6, 12))), np.ones((2, 6, 12), bool)
    shares = np.stack([np.full((6, 12), 0.2), np.full((6, 12), 0.8)])
    for ends, taken in (((), 1), ((1,), 0), ((0, 1), 1)):
        cover[list(ends), :, 7:] = False
        assert (label(rows, columns, residual, shares, cover, False) == taken).all()


def test_what_is_clipped_costs_what_its_price_says() -> None:
    """Where cuts are free, each cell is of the layer that costs least."""
    random = np.random.default_rng(4)
    rows, columns = (n.ravel() for n in np.indices((9, 13)))
    shares = random.dirichlet((1, 1, 1), (9, 13)).transpose(2, 0, 1)
    lost = random.random((3, 9, 13)) * (random.random((3, 9, 13)) < 0.3)
    residual, cover = Residuals(np.full((9, 13), 0.3), np.zeros((9, 13))), np.ones((3, 9, 13), bool)
    found = label(rows, columns, residual, shares, cover, False, clipping=lost)
    assert np.array_equal(found, (0.3 * (1 - shares) + lost).argmin(0).ravel())
    assert (found != shares.argmax(0).ravel()).mean() > 0.1


def test_a_border_is_priced_by_all_frequencies() -> None:
    """The same, where a border that differs in low frequencies alone is just worth it."""
    rows, columns = (v.ravel() for v in np.mgrid[0:6, 0:19])
    mean, cover = np.ones((6, 24)), np.ones((2, 6, 24), bool)
    cover[1, :, 19:] = False
    shares = np.stack([np.full((6, 24), 0.2), np.full((6, 24), 0.8)])
    for rms, taken in ((1.0, 1), (2.0, 0)):
        residual = Residuals(mean, rms * mean)
        assert (label(rows, columns, residual, shares, cover, False) == taken).all()


# Regions


def found(residual: Residuals, cells: Grid) -> list[np.ndarray]:
    """Each of them, where nothing moved."""
    return regions.parts(regions.find(residual, cells, np.zeros(cells.shape, bool)), cells.wraps)


@pytest.mark.parametrize("wraps", WRAPS)
def test_connected_parts_are_those_of_a_flood(wraps: bool) -> None:
    count = 0
    for seed in range(20):
        mask = patches(seed, 17, 12, 0.35, 1) > 0
        parts = regions.parts(mask, wraps)
        left, expected = {(int(y), int(x)) for y, x in np.argwhere(mask)}, set()
        while left:
            part, edge = set(), [left.pop()]
            while edge:
                y, x = edge.pop()
                part.add((y, x))
                near = {(y + j, (x + i) % 17 if wraps else x + i) for j in (-1, 0, 1) for i in (-1, 0, 1)}
                edge += near & left
                left -= near
            expected.add(frozenset(part))
        assert {frozenset(map(tuple, np.argwhere(part).tolist())) for part in parts} == expected
        count += len(expected)
    assert count > 60


def test_a_region_is_strong_and_takes_its_outskirts() -> None:
    cells = plane(480, 320).resized(60, 40)
    residual = np.zeros((40, 60))
    residual[5:12, 5:20] = 0.5 * (regions._WEAK + regions._STRONG)
    assert found(alike(residual), cells) == []  # weak alone
    residual[6:8, 7:9] = 2.0
    residual[20, 30:34] = 2.0
    assert found(alike(residual), cells) == []  # 4 cells here, 4 there: edges
    residual[8, 7:10] = 2.0
    (region,) = found(alike(residual), cells)
    expected = np.zeros((40, 60), bool)
    expected[4:13, 4:21] = True
    assert np.array_equal(region, expected)


@pytest.mark.parametrize(("off", "count", "counts"), [
    (-1.0, 60, False), (-0.5, 17, False), (-0.5, 19, True), (0.0, 8, False), (0.0, 10, True),
    (0.5, 5, False), (0.5, 7, True), (1.0, 4, False), (1.0, 5, True),
])  # fmt: skip
def test_what_is_nearly_strong_counts_in_part(off: float, count: int, counts: bool) -> None:
    """Cells so far from strong, of what makes them count not at all or wholly."""
    residual = np.zeros((40, 60))
    residual[20, :count] = regions._STRONG + off * regions._DOUBT
    assert len(found(alike(residual), plane(480, 320).resized(60, 40))) == counts


def test_texture_that_differs_joins_a_region_but_makes_none() -> None:
    """Two arms of a coat, and between them a shirt as bright as the wall."""
    cells = plane(480, 320).resized(60, 40)
    mean, rms = np.zeros((40, 60)), np.zeros((40, 60))
    rms[5:12, 5:20] = 1.1 * regions._STRONG
    assert found(Residuals(mean, rms), cells) == []
    mean[5:12, [5, 19]] = 2 * regions._STRONG
    assert len(found(alike(mean), cells)) == 2
    assert len(found(Residuals(mean, rms), cells)) == 1
    assert len(found(Residuals(mean, 0 * rms, smooth_rms=rms), cells)) == 1
    assert len(found(Residuals(mean, rms, smooth_rms=mean), cells)) == 2
    for aligned in (True, False):  # between the arms, where texture tells
        assert seam.regions(Residuals(mean, rms), plane(480, 320), aligned)[8, 12] == aligned


def test_what_is_unrelated_belongs_to_what_is_beside_it_but_not_far() -> None:
    """It makes no region, takes none away that would be filled without it, and counts up to `_FAR` cells."""
    cells = plane(480, 800).resized(60, 100)
    mean, unrelated = np.zeros((100, 60)), np.zeros((100, 60), bool)
    unrelated[10:, 10:50] = True
    assert found(Residuals(mean, mean, unrelated=unrelated), cells) == []
    mean[5:9, 20:24] = 0.14 + 1e-9
    residual = Residuals(mean, mean / 0.65, unrelated=unrelated)
    (alone,), (region,) = found(replace(residual, unrelated=None), cells), found(residual, cells)
    assert np.argwhere(alone).min(0).tolist() == [4, 19] and np.argwhere(alone).max(0).tolist() == [9, 24]
    assert (region >= alone).all() and region[10:40, 12:48].all() and not region[:, :9].any()
    assert region[9 + regions._FAR].any() and not region[10 + regions._FAR :].any()


def test_what_is_unrelated_links_what_is_strong() -> None:
    """A head and a shoe, and between them trousers as bright as the paving."""
    cells = plane(480, 320).resized(60, 40)
    mean, unrelated = np.zeros((40, 60)), np.zeros((40, 60), bool)
    mean[5, 5:8] = mean[20, 5:8] = 2.0
    unrelated[7:19, 6] = True
    assert found(Residuals(mean, mean), cells) == []
    (region,) = found(Residuals(mean, mean, unrelated=unrelated), cells)
    assert region[4:22, 5:8].all() and region.sum() == 18 * 3 + 2 * 6


@pytest.mark.parametrize(("mean", "share", "count", "counts"), [
    (0.14, 0.65, 4, False), (0.14, 0.65, 5, True), (0.11, 0.62, 8, False), (0.11, 0.62, 10, True),
    (0.08, 0.65, 60, False), (0.14, 0.8, 60, False), (0.14, 0.75, 8, False), (0.14, 0.75, 10, True),
    (0.14, 0.55, 60, False), (0.14, 0.575, 8, False), (0.14, 0.575, 10, True),
])  # fmt: skip
def test_less_is_strong_where_texture_differs_too(
    mean: float, share: float, count: int, counts: bool
) -> None:
    """Somebody in pale clothes before a pattern. share: of low frequencies in all."""
    residual = np.zeros((40, 60))
    residual[20, :count] = mean + 1e-9
    regions_there = found(Residuals(residual, residual / share), plane(480, 320).resized(60, 40))
    assert len(regions_there) == counts


@pytest.mark.parametrize(("rows", "counts"), [(4, True), (12, False)])
def test_somebody_fills_his_region(rows: int, counts: bool) -> None:
    """What is not quite aligned differs here and there, in a region of many cells."""
    residual = np.full((40, 60), 0.0)
    residual[10 : 10 + rows, 5:15] = 1.1 * regions._WEAK
    residual[12, 7:14] = 0.14 + 1e-9
    assert len(found(Residuals(residual, residual / 0.65), plane(480, 320).resized(60, 40))) == counts


def test_a_region_across_the_border_is_one() -> None:
    residual = np.zeros((40, 60))
    residual[5:9, 58:] = residual[5:8, :1] = 2.0  # neither side is enough alone
    residual[7:9, 58:] = 0.5 * (regions._WEAK + regions._STRONG)
    cells = plane(480, 320, wraps=True).resized(60, 40)
    (region,) = found(alike(residual), cells)
    assert region[:, [57, 58, 59, 0, 1]].any(0).all()
    assert region.sum() == 6 * 4 + 5
    assert found(alike(residual), plane(480, 320).resized(60, 40)) == []


def test_cells_near_a_pole_count_by_their_area() -> None:
    cells = sphere(480, 240).resized(60, 30)
    counts = []
    for row in (0, 14):
        residual = np.zeros((30, 60))
        residual[row : row + 2, 10:20] = 2.0
        counts.append(len(found(alike(residual), cells)))
    assert counts == [0, 1]

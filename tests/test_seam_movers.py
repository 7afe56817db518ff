"""What moved by itself: shown once, if that is not much worse; and always a region of its own."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from grids import on_device, plane
from hypothesis import given
from labels import alike, cuts_of, energies, favoured, label, many, problems
from test_seam import whole_layer

from hugin_abflow import coefficient, labelling, regions, seam
from hugin_abflow.colour import Correction
from hugin_abflow.geometry import Pair
from hugin_abflow.opencl import Device
from hugin_abflow.regions import Choice, Residuals
from hugin_abflow.scene import Scene

WRAPS = [False, True]


def twice(favour: float, beside: float = 0.001) -> tuple[Residuals, np.ndarray]:
    """Somebody stands on the left in one layer, on the right in the other: residual, and shares, by which
    each layer is favoured where he stands in it, the second a little more. beside: how they differ there.
    """
    places = np.zeros((12, 30), bool)
    places[2:10, 4:13] = places[2:10, 17:26] = True
    share = np.where(np.arange(30) < 15, 0.5 - favour, 0.5 + favour) * np.ones((12, 1)) + 0.02
    return alike(np.where(places, 1.0, beside)), np.stack([1 - share, share])


def everywhere(shape: tuple[int, int] = (12, 30)) -> tuple[np.ndarray, np.ndarray]:
    return tuple(v.ravel() for v in np.indices(shape))


def test_what_moved_is_shown_once() -> None:
    """A cut between his two places is cheapest, and shows him twice; one layer shows him once."""
    residual, shares = twice(0.15)
    cover = np.ones((2, 12, 30), bool)
    for turned, best in ((slice(None), 1), (slice(None, None, -1), 0)):
        for wraps in WRAPS:
            problem = (*everywhere(), residual, shares[turned], cover, wraps)
            found = label(*problem).reshape(12, 30)
            assert (found[:, 4:13] == 1 - best).all() and (found[:, 17:26] == best).all()
            assert (label(*problem, whole_factor=seam._SINGLE_FACTOR) == best).all()


def test_a_cut_that_is_much_better_is_kept() -> None:
    """Each layer shows him where it is favoured by far, as the other has its border there."""
    residual, shares = twice(0.45)
    cover = np.ones((2, 12, 30), bool)
    cut = label(*everywhere(), residual, shares, cover, False)
    once = label(*everywhere(), residual, shares, cover, False, whole_factor=seam._SINGLE_FACTOR)
    problem = (*everywhere(), residual, shares, cover, False)
    least, *alone = energies(np.stack([cut, 0 * cut, 0 * cut + 1]), *problem)
    assert min(alone) > seam._SINGLE_FACTOR * least
    assert np.array_equal(once, cut) and 0 < cut.mean() < 1


@pytest.mark.parametrize("times", [2, 3])
def test_cuts_are_as_dear_for_large_people(times: int) -> None:
    """Seen by cells twice as fine he is cut no sooner: what a layer favours grows with the area, and so does
    a share of the region's size for every cell of a cut.
    """
    rng = np.random.default_rng(3)
    residual = Residuals(rng.random((12, 14)), np.full((12, 14), 0.02))
    share = rng.random((12, 14))

    def owners(by: int, cut_share: float, cut_price: float) -> np.ndarray:
        mean, rms, whole, first = (
            np.repeat(np.repeat(one, by, 0), by, 1)
            for one in (residual.mean, residual.rms, np.ones((12, 14), bool), share)
        )
        cover = np.ones((2, *whole.shape), bool)
        shares = np.stack([first, 1 - first])
        choice = Choice(whole, Residuals(mean, rms), shares, cover, False, cut_price, cut_share=cut_share)
        return choice.owners()[0][::by, ::by]

    coarse = owners(1, 0.5, 0)
    assert 0.1 < coarse.mean() < 0.9
    assert np.array_equal(owners(times, 0.5, 0), coarse)
    assert np.array_equal(owners(1, 0.5, 20), owners(1, 0, 20))  # of two prices the higher one
    assert not np.array_equal(owners(times, 0, 0.5 * np.sqrt(coarse.size)), coarse)


@many
@given(problem=problems(2, 11))
def test_one_layer_of_two_is_taken_if_it_costs_no_more_than_twice_as_much(problem) -> None:
    """One that has more than half of the region, as far as it goes; the other one where it does not. Or if
    it shows next to nothing of what a cut shows.
    """
    rows, columns, cover = problem[0], problem[1], problem[4]
    found, cut = label(*problem, whole_factor=seam._SINGLE_FACTOR), label(*problem)
    assert cover[found, rows, columns].all()
    there = cover[:, rows, columns]
    alone = np.array([np.where(there[k], k, 1 - k) for k in (0, 1) if there[k].mean() > 0.5])
    if not there.any(1).all() or not len(alone):
        assert np.array_equal(found, cut)
        return
    costs, least = energies(alone, *problem), energies(cut[None], *problem)[0]
    seen, of_cut = costs - favoured(alone, *problem), least - favoured(cut[None], *problem)[0]
    rounding = 5 * rows.size / labelling._UNIT
    clean = (seen <= regions._CLEAN * of_cut) & (cuts_of(cut, *problem) > regions._WEAK)
    if clean.any() or costs.min() < seam._SINGLE_FACTOR * least - rounding:
        wanted = costs[clean] if clean.any() else costs
        assert np.isclose(energies(found[None], *problem)[0], wanted.min())
        assert (found == alone).all(1).any()
    elif costs.min() > seam._SINGLE_FACTOR * least + rounding:
        assert np.array_equal(found, cut)


@pytest.mark.parametrize("contrast", [0.3, 0.9])
def test_a_long_thing_across_the_middle_is_not_cut(contrast: float) -> None:
    """Half of it is a large area, in which the softmax favours the other layer; but one shows it whole, and
    nothing of it beside.
    """
    thing = np.zeros((14, 50), bool)
    thing[2:12, 5:45] = True
    residual = regions.seen(alike(np.where(thing, contrast, 0.01)))
    share = np.where(np.arange(50) < 25, 0.999, 0.001) * np.ones((14, 1))
    problem = (
        *everywhere((14, 50)),
        residual,
        np.stack([share, 1 - share]),
        np.ones((2, 14, 50), bool),
        False,
    )
    assert set(label(*problem)) == {0, 1}
    assert len(set(label(*problem, whole_factor=seam._WHOLE_FACTOR))) == 1
    ends = np.ones((2, 14, 50), bool)
    ends[0, :, 40:] = ends[1, :, :10] = False  # neither shows all of it: a cut is seen anyway
    found = label(*problem[:4], ends, False, whole_factor=seam._WHOLE_FACTOR).reshape(14, 50)
    assert set(found[:, 24]) == {0} and set(found[:, 25]) == {1}


def test_cells_that_no_layer_covers_cost_nothing() -> None:
    """They would outweigh all else, so that one layer would never be much worse than a cut."""
    residual, shares = twice(0.45)
    cover = np.ones((2, 12, 30), bool)
    cover[:, 11, 20:] = False
    cut, once = (
        label(*everywhere(), residual, shares, cover, False, whole_factor=more)
        for more in (None, seam._SINGLE_FACTOR)
    )
    shown = cover.any(0).ravel()
    assert np.array_equal(cut[shown], once[shown]) and 0 < cut[shown].mean() < 1


def test_where_the_one_layer_ends_another_goes_on() -> None:
    """Those of the cut; no layer is taken where it is not."""
    residual, shares = twice(0.15)
    shares = np.concatenate([shares, 0.1 * shares[:1]])
    shares[2, :, :2] = 0.9
    cover = np.ones((3, 12, 30), bool)
    cover[1, :, :3] = False
    problem = (*everywhere(), residual, shares, cover, False)
    cut, found = (label(*problem, whole_factor=more).reshape(12, 30) for more in (None, seam._SINGLE_FACTOR))
    assert np.array_equal(found[:, :3], cut[:, :3]) and (found[:, 3:] == 1).all()
    assert (cut[:, 4:13] == 0).all()


def test_a_third_layer_in_a_corner_does_not_show_what_moved_twice() -> None:
    """It goes hardly anywhere: that it is taken there says nothing of the two others elsewhere."""
    residual, shares = twice(0.15)
    shares = np.concatenate([shares, 0.1 * shares[:1]])
    cover = np.ones((3, 12, 30), bool)
    cover[2, :, 2:] = False
    found = label(*everywhere(), residual, shares, cover, False, whole_factor=seam._SINGLE_FACTOR)
    found = found.reshape(12, 30)
    assert (found[:, 4:13] == 1).all() and (found[:, 17:26] == 1).all()


def test_what_moved_makes_a_region_whatever_the_layers_show() -> None:
    """Small as it is, with what differs around; its flow is gone, so that it would be doubled."""
    grid, residual, moved = plane(480, 320), np.zeros((40, 60)), np.zeros((40, 60), bool)
    moved[6:8, 7:9] = True
    for aligned in (True, False):
        found = seam.regions(alike(residual), grid, aligned, moved)
        assert np.argwhere(found).tolist() == [[y, x] for y in range(5, 9) for x in range(6, 10)]
        assert not seam.regions(alike(residual), grid, aligned).any()
    residual[6:8, 9] = 0.5 * (regions._WEAK + regions._STRONG)
    residual[30, 30] = 2 * regions._STRONG
    found = seam.regions(alike(residual), grid, single=moved)
    assert np.argwhere(found).tolist() == [[y, x] for y in range(5, 9) for x in range(6, 11)]
    assert not seam.regions(alike(residual), grid).any()


def owners(device: Device, told: np.ndarray, residual: np.ndarray, turn: int = 0) -> np.ndarray:
    """Whose each cell is: the first layer ends at column 26, the second begins at 14; somebody is on 8 to 17
    in one, on 16 to 23 in the other. All is turned by some columns.
    """
    grid = plane(240, 96, wraps=turn > 0)
    x, region = np.arange(30), np.zeros((12, 30), bool)
    region[2:10, 8:26] = True
    covers = np.stack([np.tile(one, (12, 1)) for one in (x < 26, x >= 14)])
    share = np.clip((x - 13) / 13, 0, 1) * np.ones((12, 1))
    told, residual, region, covers, share = (
        np.roll(v, turn, -1) for v in (told, residual, region, covers, share)
    )
    fields = [np.stack([0 * s] * 3 + [s], -1).repeat(8, 0).repeat(8, 1) for s in (1 - share, share)]
    choice = seam._choice(
        Scene(
            device, [SimpleNamespace(box=(0, 0, 240, 96))] * 2, [],
            [device.upload(field, np.float32) for field in fields], SimpleNamespace(host=covers), grid,
        ),
        Residuals(residual, residual, told), region, seam.seam_grid(grid), covers, seam._CUT,
    )  # fmt: skip
    choice = replace(choice, whole_factor=seam._SINGLE_FACTOR * region)
    return np.roll(choice.owners()[0], -turn, 1)


@pytest.mark.parametrize("flow", [True, False])
def test_a_region_comes_from_one_layer_and_an_overlap_from_both(
    device: Device, monkeypatch: pytest.MonkeyPatch, flow: bool
) -> None:
    """Of layers that are aligned; without flow, where all of an overlap is a region, it is cut where it shows
    least."""
    monkeypatch.setattr(seam, "_WHOLE_FACTOR", np.inf)
    grid = plane(240, 96)
    pictures = np.full((2, 96, 240, 4), 0.1, np.float32)
    pictures[..., 3] = 1
    pictures[1, 16:80, 40:200, :3] = 0.9
    pictures[1, :, 110:130, :3] = 0.1  # where a cut costs next to nothing
    layers = [on_device(device, one) for one in pictures]
    left = np.where(np.arange(240) < 118, 0.95, 0.05).astype(np.float32)[None].repeat(96, 0)
    fields = []
    for weight in (left, 1 - left):
        field = np.zeros((96, 240, 4), np.float32)
        field[..., 3] = weight
        fields.append(device.upload(field))
    masks = coefficient.masks(device, layers, grid)
    correction = Correction(grid.resized(4, 4), 1.0, (None, None))
    scene = Scene(device, layers, [Pair(0, 1)], fields, masks, grid)
    if flow:
        residual = seam.residuals(scene, correction)
        whole = seam.regions(residual, grid) | np.pad(np.ones((8, 20), bool), ((2, 2), (5, 5)))
        seam.cut(scene, residual, whole)
    else:
        seam.cut_unaligned(scene, correction)
    inside = [field.get()[24:72, 56:184, 3] for field in fields]
    first = inside[0] > inside[1]
    assert first.all() or not first.any() if flow else 0.2 < first.mean() < 0.8


def test_unlike_is_what_any_two_layers_differ_by_in_a_small_part(device: Device) -> None:
    """Not what they differ by all over."""
    grid = plane(96, 64)
    pictures = np.full((4, 64, 96, 4), 0.5, np.float32)
    pictures[..., 3] = 1
    pictures[1, 16:24, 32:40, :3] = 0.9
    pictures[3, ..., :3] = 0.8
    layers = [on_device(device, one) for one in pictures]
    fields = [device.zeros((64, 96, 4)) for _ in layers]
    correction = Correction(grid.resized(4, 4), 1.0, (None,) * 4)
    pairs = [Pair(1, 2), Pair(2, 3), Pair(0, 2)]
    masks = coefficient.masks(device, layers, grid)
    other = seam.unlike(Scene(device, layers, pairs, fields, masks, grid), correction).other
    expected = np.zeros((8, 12), bool)
    expected[2, 4] = True
    assert np.array_equal(other > 0, expected)


@pytest.mark.parametrize(("cost", "moved", "cut"), [
    (1.6, False, False), (1.8, False, True), (1.8, True, False), (2.1, True, True),
])  # fmt: skip
def test_one_layer_may_cost_more_where_something_moved(
    device: Device, monkeypatch: pytest.MonkeyPatch, cost: float, moved: bool, cut: bool
) -> None:
    """So many times as much as cut in two; a single cell that moved is enough."""
    grid = plane(240, 96)
    region = np.zeros((12, 30), bool)
    region[2:10, 4:26] = True
    alone = {0: cost, 1: 9.0}
    monkeypatch.setattr(
        regions, "energy", lambda _, labels, priced: alone[labels[0]] if (labels == labels[0]).all() else 1.0
    )
    monkeypatch.setattr(regions, "_WEAK", math.inf)  # a cut is not seen, however much it costs
    seen = []
    monkeypatch.setattr(seam, "_yield", lambda *given: seen.append(given[3]))
    once = np.zeros(region.shape, bool)
    once[5, 5] = moved
    share = np.where(np.arange(240) < 120, 0.9, 0.1) * np.ones((96, 1))
    fields = [device.upload(np.stack([0 * s] * 3 + [s], -1), np.float32) for s in (share, 1 - share)]
    residual = np.where(region, 0.3, 0.0)
    residual[:, 14:16] = 0
    masks = SimpleNamespace(host=np.ones((2, 12, 30), bool))
    scene = Scene(device, [whole_layer(device, 240, 96)] * 2, [], fields, masks, grid)
    found, _ = seam.cut(scene, Residuals(residual, residual), region, once)
    assert len(seen) == 1
    assert (len(np.unique(found[region])) == 2) == cut


@pytest.mark.parametrize("turn", [0, 15])
def test_nobody_is_cut_by_a_border_where_nothing_tells_what_is_there(device: Device, turn: int) -> None:
    """Beside the second layer's border what it shows was moved away: a cut there seems to cost nothing."""
    residual = np.zeros((12, 30))
    residual[:, 14:26] = 0.02
    residual[2:10, [15, *range(18, 24)]] = 0.3
    residual[:, 14] = 0
    assert (owners(device, np.ones((12, 30), bool), residual, turn)[2:10, 14:24] == 1).all()
    told = residual > 0
    assert (owners(device, told, residual, turn)[2:10, 8:26] == 0).all()


@pytest.mark.parametrize("wraps", WRAPS)
def test_cells_beside_a_border_of_which_nothing_tells_are_as_the_nearest(wraps: bool) -> None:
    """One layer lies on all cells, another one on columns 3 to 19 of 24; what is clipped tells nothing."""
    mean, rms = np.random.default_rng(3).random((2, 9, 24))
    cover = np.ones((2, 9, 24), bool)
    cover[1, :, :3] = cover[1, :, 20:] = False
    told = cover[1].copy()
    told[2:7, 3:6] = told[0:4, 18:20] = False
    clipped = np.s_[3:6, 10:13]
    told[clipped] = False
    told[7:, 3:] = told[7:, :4] = False
    told[8, 12] = True
    for turn in (0, 11):
        turned = [np.roll(v, turn, -1) for v in (mean, rms, told, cover)]
        if turn and not wraps:
            continue
        found = regions.completed(Residuals(*turned[:3]), turned[3], wraps)
        its_mean, its_rms = (np.roll(v, -turn, 1) for v in (found.mean, found.rms))
        missing = cover[1] & ~told
        missing[clipped] = False
        assert missing.sum() > 40
        assert np.array_equal(its_mean[~missing], mean[~missing])
        assert np.array_equal(its_rms[~missing], rms[~missing])
        y, x = np.nonzero(told)
        for row, column in np.argwhere(missing):
            aside = np.abs(x - column)
            apart = (y - row) ** 2 + (np.minimum(aside, 24 - aside) if wraps else aside) ** 2
            nearest = apart == apart.min()
            assert its_mean[row, column] in mean[y, x][nearest]
            assert its_rms[row, column] in rms[y, x][nearest]
    nothing = Residuals(mean, rms, 0 * told)
    assert regions.completed(nothing, cover, wraps) is nothing

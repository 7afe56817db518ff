"""One layer, whole, where flow explains nothing: the kernels, labels of least energy, regions."""

from __future__ import annotations

import math
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from grids import GRIDS, patches, plane, random_layer, sphere
from hypothesis import given
from labels import alike, energies, many, problems
from reference.seam import seam_difference, seam_yield
from scipy import ndimage
from tolerances import POSITION, SUM, assert_close

from hugin_abflow import labelling, seam
from hugin_abflow.cells import averaged
from hugin_abflow.coefficient import on_cells
from hugin_abflow.opencl import Device
from hugin_abflow.working import Grid

WRAPS = [False, True]

# The kernel


def test_twin_of_yield_reads_scipys_zoom() -> None:
    """A layer's weight times (1 - y) ** 4, with y between the cells' centres; never quite nothing."""
    yields = patches(0, 13, 9, 0.5, 3).astype(np.float64)
    field = np.random.default_rng(1).random((40, 60, 4))
    for wraps in WRAPS:
        result = seam_yield(
            field, (11, 7, 60, 40), (77, 53, int(wraps), 0), yields, (13, 9, int(wraps), 0), seam._TRACE
        )
        around = np.pad(
            np.pad(yields, ((1, 1), (0, 0)), "edge"), ((0, 0), (1, 1)), "wrap" if wraps else "edge"
        )
        y, x = np.mgrid[7:47, 11:71] + 0.5
        read = ndimage.map_coordinates(around, [y * 9 / 53 + 0.5, x * 13 / 77 + 0.5], order=1)
        assert (read == 0).any()
        assert np.allclose(
            result[..., 3], field[..., 3] * np.maximum((1 - read) ** 4, 1e-12), rtol=1e-9, atol=0
        )
        assert np.array_equal(result[..., :3], field[..., :3])
        assert result[..., 3].min() > 0


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize("shoulder", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("clipped", [((0.8, 0.85, 0.9, 1.0), (0.85, 0.8, 0.75, 1.0)), ((math.inf,) * 4,) * 2])
def test_difference_equals_its_twin(device: Device, name: str, shoulder: float, clipped: tuple) -> None:
    grid = GRIDS[name]
    cells, colours = grid.resized(10, 7).border, grid.resized(5, 3).border
    sides: list = []
    for k, box in enumerate(((0, 0, 60, grid.height), (9, 1, grid.width - 9, grid.height - 1))):
        pixels = random_layer(20 + k, box[2], box[3], 0.9)
        field = ndimage.gaussian_filter(np.random.default_rng(k).normal(size=(box[3], box[2], 4)), (4, 4, 0))
        field = (3 * field * (grid.lens[1] or 1)).astype(np.float32)
        if not grid.lens[1]:
            field[..., 2] = 0
        gain = np.random.default_rng(9 + k).normal(size=(3, 5, 4)).astype(np.float32)
        sides += [pixels, field, box, gain]
    part, of_part = (2, 1, 7, 5), np.s_[1:6, 2:9]
    out, square = device.empty((5, 7, 4)), device.empty((5, 7))
    uploaded = [device.upload(one) if isinstance(one, np.ndarray) else one for one in sides]
    device.run(
        "seam", "seam_difference", part[2:], *uploaded, grid.border, grid.lens, colours, cells, part,
        shoulder, *clipped, out, square,
    )  # fmt: skip
    expected, squares = seam_difference(*sides, grid.border, grid.lens, colours, cells, shoulder, *clipped)
    assert (expected[..., 3] > 0).mean() > 0.4
    assert (squares > 1.5 * np.square(expected[..., :3]).max(-1)).any()
    # a pixel more or less at a mask's rim is one of some ten of a cell
    assert_close(out.get(), expected[of_part], 10 * POSITION, decisions=0.05)
    assert_close(square.get(), squares[of_part], 10 * POSITION, decisions=0.05)


@pytest.mark.parametrize("name", list(GRIDS))
def test_yield_equals_its_twin(device: Device, name: str) -> None:
    """On grids of cells that divide nothing, over poles and borders."""
    grid = GRIDS[name]
    cells = grid.resized(10, 7).border
    box = (5, 0, grid.width - 5, grid.height - 2)
    yields = (patches(2, 10, 7, 0.5, 2) * np.random.default_rng(3).random((7, 10)).clip(0.3)).astype(
        np.float32
    )
    field = np.random.default_rng(4).normal(size=(box[3], box[2], 4)).astype(np.float32)
    out = device.upload(field)
    device.run("seam", "seam_yield", box[2:], out, box, grid.border, device.upload(yields), cells, 1e-3)
    expected = seam_yield(field, box, grid.border, yields, cells, 1e-3)
    assert_close(out.get(), expected, 10 * SUM)
    assert np.array_equal(out.get()[..., :3], field[..., :3])
    assert (expected[..., 3] == field[..., 3]).any()
    assert (expected[..., 3] != field[..., 3]).any()


# Labels of least energy


def least_and_found(problem, layers: int) -> tuple[float, float, float]:
    """Least energy of all labellings, that of `label`, and what integer capacities may cost."""
    rows, columns, residual, _, cover, _ = problem
    found = seam.label(*problem)
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
    assert seam.label(rows, columns, residual, shares, cover, False).shape == (3,)
    cover[2, 0, 0] = True
    assert seam.label(rows, columns, residual, shares, cover, False).tolist() == [2, 2, 2]


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
    found = seam.label(rows, columns, alike(residual), shares, everywhere, wraps).reshape(15, 40)
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
    for residual, first in ((alike(mean), 15), (seam.Residuals(mean, rms), 23)):
        found = seam.label(rows, columns, residual, shares, everywhere, False).reshape(15, 30)
        assert np.array_equal(found, np.arange(30) >= first * np.ones((15, 1)))


def test_a_border_counts_as_a_cut() -> None:
    """A favoured layer that ends where its region does gives way to one that goes on beyond; where both end
    there is no cut to be seen."""
    rows, columns = (v.ravel() for v in np.mgrid[0:6, 0:7])
    residual, cover = alike(np.ones((6, 12))), np.ones((2, 6, 12), bool)
    shares = np.stack([np.full((6, 12), 0.2), np.full((6, 12), 0.8)])
    for ends, taken in (((), 1), ((1,), 0), ((0, 1), 1)):
        cover[list(ends), :, 7:] = False
        assert (seam.label(rows, columns, residual, shares, cover, False) == taken).all()


def test_what_is_clipped_costs_what_its_price_says() -> None:
    """Where cuts are free, each cell is of the layer that costs least."""
    random = np.random.default_rng(4)
    rows, columns = (n.ravel() for n in np.indices((9, 13)))
    shares = random.dirichlet((1, 1, 1), (9, 13)).transpose(2, 0, 1)
    lost = random.random((3, 9, 13)) * (random.random((3, 9, 13)) < 0.3)
    residual, cover = seam.Residuals(np.full((9, 13), 0.3), np.zeros((9, 13))), np.ones((3, 9, 13), bool)
    found = seam.label(rows, columns, residual, shares, cover, False, lost=lost)
    assert np.array_equal(found, (0.3 * (1 - shares) + lost).argmin(0).ravel())
    assert (found != shares.argmax(0).ravel()).mean() > 0.1


@pytest.mark.parametrize("size", [(7, 5), (24, 18), (1, 1)])
def test_cells_read_what_lies_at_their_centres(size: tuple[int, int]) -> None:
    cells = plane(96, 72).resized(24, 18)
    values = np.arange(2 * size[0] * size[1], dtype=np.float32).reshape(2, size[1], size[0])
    rows, columns = seam._centres(cells, values.shape)
    found = values[:, rows[:, None], columns]
    for y, x in ((0, 0), (3, 23), (17, 11)):
        row, column = int((y + 0.5) / 18 * size[1]), int((x + 0.5) / 24 * size[0])
        assert found[:, y, x].tolist() == values[:, row, column].tolist()
    assert found.shape == (2, 18, 24)


def test_a_border_is_priced_by_all_frequencies() -> None:
    """The same, where a border that differs in low frequencies alone is just worth it."""
    rows, columns = (v.ravel() for v in np.mgrid[0:6, 0:19])
    mean, cover = np.ones((6, 24)), np.ones((2, 6, 24), bool)
    cover[1, :, 19:] = False
    shares = np.stack([np.full((6, 24), 0.2), np.full((6, 24), 0.8)])
    for rms, taken in ((1.0, 1), (2.0, 0)):
        residual = seam.Residuals(mean, rms * mean)
        assert (seam.label(rows, columns, residual, shares, cover, False) == taken).all()


# Residuals

LAYERS = [SimpleNamespace(layer=SimpleNamespace(dtype=np.dtype(np.uint8)), white=(1.0, 1.0, 1.0))] * 2


def test_a_cell_of_which_little_is_seen_tells_as_much_less(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of those around; a cut through it crosses what is seen."""
    found = np.zeros((9, 12, 5))
    found[..., 4] = 1
    found[4, 6] = 0.5, -0.6, 0.1, 0.4, 0.1
    found[4, 7] = 0
    monkeypatch.setattr(seam, "_differences", lambda *_: [(np.s_[0:9, 0:12], found)])
    residual = seam.residuals(None, LAYERS, [], [seam.Pair(0, 1)], None, plane(96, 72))
    y, x = np.mgrid[0:9, 0:12]
    weight = np.exp(-0.5 * ((y - 4) ** 2 + (x - 6) ** 2)) * found[..., 4]
    assert np.isclose(residual.mean[4, 6], 0.6 * 0.1 / weight.sum(), rtol=0.01)
    assert residual.around is not None
    assert np.isclose(residual.around[4, 6], np.sqrt(0.4 * 0.1 / weight.sum()), rtol=0.01)
    assert residual.mean[4, 7] == residual.around[4, 7] == residual.rms[4, 7] == 0
    assert residual.rms[4, 6] == residual.rms.sum() == np.sqrt(0.4)
    assert residual.told is not None and residual.told.sum() == 107 and not residual.told[4, 7]


def test_a_cut_goes_through_a_gap_of_one_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    """Between somebody's head, which one layer shows whole, and his body, which it cuts off: also where the
    head is as bright as what is behind.
    """
    found = np.zeros((14, 12, 5))
    found[..., 4] = 1
    found[:7, 2:10, :3], found[:7, 2:10, 3] = 0.1, 0.02
    found[7, 2:10, :3], found[7, 2:10, 3] = 0.01, 0.001
    found[8:, 2:10, :3], found[8:, 2:10, 3] = 0.5, 0.3
    monkeypatch.setattr(seam, "_differences", lambda *_: [(np.s_[0:14, 0:12], found)])
    residual = seam.residuals(None, LAYERS, [], [seam.Pair(0, 1)], None, plane(96, 112))
    cover = np.ones((2, 16, 12), bool)
    cover[0, 14:] = cover[1, 0] = False
    rows, columns = np.nonzero(np.ones((14, 12)))
    padded = seam.Residuals(*(np.pad(one, [(0, 2), (0, 0)]) for one in (residual.mean, residual.rms)))
    owner = seam.label(rows, columns, padded, np.full((2, 16, 12), 0.5), cover, False).reshape(14, 12)
    assert (owner[1:7, 2:10] == 0).all() and (owner[8:, 2:10] == 1).all()


def test_residuals_are_smoothed_across_the_border(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a canvas that wraps, by what is compared all along it; the same at each column."""
    found = np.random.default_rng(4).random((9, 12, 5))
    means = []
    for wraps in (True, False):
        for shift in (0, 5):
            turned = np.roll(found, shift, 1)
            monkeypatch.setattr(seam, "_differences", lambda *_, its=turned: [(np.s_[0:9, 0:12], its)])
            residual = seam.residuals(None, LAYERS, [], [seam.Pair(0, 1)], None, plane(96, 72, wraps))
            means.append(np.roll(residual.mean, -shift, 1))
    assert np.array_equal(means[0], means[1])
    assert not np.array_equal(means[2], means[3]) and not np.array_equal(means[0], means[2])


def test_a_cell_is_told_of_by_any_pair(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is as bright as clipped pixels are is not compared, but without flow."""
    found = np.zeros((2, 9, 12, 5))
    found[0, :, :5, 4], found[1, 3, 3:, 4] = 0.2, 1
    found[0, 3, 3, 3], found[1, 3, 3, 3], found[1, 3, 8, 3] = 0.09, 0.01, 0.04
    asked = []
    everywhere = [(np.s_[0:9, 0:12], one) for one in found]
    monkeypatch.setattr(seam, "_differences", lambda *given: asked.append(given[-1]) or iter(everywhere))
    residual = seam.residuals(None, LAYERS, [], [seam.Pair(0, 1)] * 2, None, plane(96, 72))
    assert np.array_equal(residual.told, (found[..., 4] > 0).any(0)) and asked == [
        [(0.98, 0.98, 0.98, 1.0)] * 2
    ]
    assert np.isclose(residual.rms[3, [3, 8]], [0.3, 0.2]).all()
    assert residual.around is not None and (residual.around[3, [3, 8]] > 0.05).all()


# Regions


def regions(residual: seam.Residuals, cells: Grid) -> list[np.ndarray]:
    """Each of them, where nothing moved."""
    return seam._regions(residual, cells, np.zeros(cells.shape, bool))


@pytest.mark.parametrize("wraps", WRAPS)
def test_connected_parts_are_those_of_a_flood(wraps: bool) -> None:
    count = 0
    for seed in range(20):
        mask = patches(seed, 17, 12, 0.35, 1) > 0
        parts = seam._connected(mask, wraps)
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
    residual[5:12, 5:20] = 0.5 * (seam._WEAK + seam._STRONG)
    assert regions(alike(residual), cells) == []  # weak alone
    residual[6:8, 7:9] = 2.0
    residual[20, 30:34] = 2.0
    assert regions(alike(residual), cells) == []  # 4 cells here, 4 there: edges
    residual[8, 7:10] = 2.0
    (region,) = regions(alike(residual), cells)
    expected = np.zeros((40, 60), bool)
    expected[4:13, 4:21] = True
    assert np.array_equal(region, expected)


@pytest.mark.parametrize(("off", "count", "found"), [
    (-1.0, 60, False), (-0.5, 17, False), (-0.5, 19, True), (0.0, 8, False), (0.0, 10, True),
    (0.5, 5, False), (0.5, 7, True), (1.0, 4, False), (1.0, 5, True),
])  # fmt: skip
def test_what_is_nearly_strong_counts_in_part(off: float, count: int, found: bool) -> None:
    """Cells so far from strong, of what makes them count not at all or wholly."""
    residual = np.zeros((40, 60))
    residual[20, :count] = seam._STRONG + off * seam._DOUBT
    assert len(regions(alike(residual), plane(480, 320).resized(60, 40))) == found


def test_texture_that_differs_joins_a_region_but_makes_none() -> None:
    """Two arms of a coat, and between them a shirt as bright as the wall."""
    cells = plane(480, 320).resized(60, 40)
    mean, rms = np.zeros((40, 60)), np.zeros((40, 60))
    rms[5:12, 5:20] = 1.1 * seam._STRONG
    assert regions(seam.Residuals(mean, rms), cells) == []
    mean[5:12, [5, 19]] = 2 * seam._STRONG
    assert len(regions(alike(mean), cells)) == 2
    assert len(regions(seam.Residuals(mean, rms), cells)) == 1
    assert len(regions(seam.Residuals(mean, 0 * rms, around=rms), cells)) == 1
    assert len(regions(seam.Residuals(mean, rms, around=mean), cells)) == 2
    for aligned in (True, False):  # between the arms, where texture tells
        assert seam.regions(seam.Residuals(mean, rms), plane(480, 320), aligned)[8, 12] == aligned


def test_a_region_across_the_border_is_one() -> None:
    residual = np.zeros((40, 60))
    residual[5:9, 58:] = residual[5:8, :1] = 2.0  # neither side is enough alone
    residual[7:9, 58:] = 0.5 * (seam._WEAK + seam._STRONG)
    cells = plane(480, 320, wraps=True).resized(60, 40)
    (region,) = regions(alike(residual), cells)
    assert region[:, [57, 58, 59, 0, 1]].any(0).all()
    assert region.sum() == 6 * 4 + 5
    assert regions(alike(residual), plane(480, 320).resized(60, 40)) == []


def test_cells_near_a_pole_count_by_their_area() -> None:
    cells = sphere(480, 240).resized(60, 30)
    found = []
    for row in (0, 14):
        residual = np.zeros((30, 60))
        residual[row : row + 2, 10:20] = 2.0
        found.append(len(regions(alike(residual), cells)))
    assert found == [0, 1]


@pytest.mark.parametrize("wraps", WRAPS)
def test_outlines_are_blurred_over_a_cell(wraps: bool) -> None:
    mask = patches(5, 17, 12, 0.5, 4)
    mask[:, :3] = mask[:, -1:]  # something to see across the border
    mask[3] = 1 - mask[3]
    expected = ndimage.uniform_filter(
        mask.astype(np.float64), 3, mode=("nearest", "wrap" if wraps else "nearest")
    )
    assert np.allclose(averaged(mask, wraps), expected, atol=1e-6)


@pytest.mark.parametrize("columns", [0, 9])
def test_a_layer_yields_all_of_a_region_that_is_not_its_own(columns: int) -> None:
    whole, owner = np.zeros((13, 19), bool), np.zeros((13, 19), int)
    whole[4:9, 5:15] = True
    owner[:, :10] = 1
    whole, owner = (np.roll(one, columns, 1) for one in (whole, owner))  # also across the border
    first, second = (np.roll(seam.yielded(whole, owner, k, columns > 0), -columns, 1) for k in (0, 1))
    assert first.dtype == second.dtype == np.float32
    # from a cell beyond the region, less and less, as far as the next; at the cut half in each layer
    third = 1 / 3
    assert np.allclose(first[6, 2:12], [0, third, 2 * third, 1, 1, 1, 1, 2 * third, third, 0])
    assert np.allclose(second[6, 8:18], [0, third, 2 * third, 1, 1, 1, 1, 2 * third, third, 0])
    assert np.allclose(first[:7, 7], [0, 0, third, 2 * third, 1, 1, 1])
    assert not first[:, 13:].any() and not second[:, :7].any()


def test_cells_that_a_layer_covers_whole() -> None:
    covered = np.ones((2, 53, 77), bool)
    covered[0, 12, 20] = covered[1, 52, 76] = False
    whole = on_cells(covered, plane(110, 70).resized(9, 5), np.logical_and)
    assert np.argwhere(~whole).tolist() == [[0, 1, 2], [1, 4, 8]]

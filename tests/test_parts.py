"""Layers are compared where both of their boxes are, and nowhere else: nothing depends on that."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from grids import GRIDS, on_device, patches, plane, random_layer, sphere
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from hugin_abflow import colour, seam
from hugin_abflow.coefficient import Masks, Overlaps
from hugin_abflow.gains import Difference, Measured, solve
from hugin_abflow.geometry import Pair
from hugin_abflow.grid import cells_under
from hugin_abflow.layer import Box
from hugin_abflow.opencl import Device
from hugin_abflow.scene import Scene
from hugin_abflow.settings import Settings

SPANS = st.tuples(st.integers(0, 40), st.integers(0, 40))


@given(columns=st.tuples(SPANS, SPANS), rows=st.tuples(SPANS, SPANS))
def test_common_is_what_is_in_both(columns: tuple, rows: tuple) -> None:
    places = [(x, y, width, height) for (x, width), (y, height) in zip(columns, rows, strict=True)]
    shown = []
    for left, top, width, height in places:
        mask = np.zeros((80, 80), bool)
        mask[top : top + height, left : left + width] = True
        shown.append(mask)
    first, second = (Box.at(*place) for place in places)
    left, top, width, height = first.intersect(second).place
    both = np.zeros((80, 80), bool)
    both[top : top + height, left : left + width] = True
    assert np.array_equal(both, shown[0] & shown[1])
    assert second.intersect(first).place[2:] == (width, height)
    assert np.array_equal(both[first.slices], shown[1][first.slices])


@given(data=st.data(), width=st.integers(1, 60), height=st.integers(1, 60))
def test_cells_under_a_place_are_those_that_have_a_pixel_of_it(
    data: st.DataObject, width: int, height: int
) -> None:
    """Also where cells are smaller than pixels, and some have none."""
    grid = plane(width, height)
    cells = grid.resized(data.draw(st.integers(1, 70)), data.draw(st.integers(1, 70)))
    left, top = data.draw(st.integers(0, width - 1)), data.draw(st.integers(0, height - 1))
    place = left, top, data.draw(st.integers(0, width - left)), data.draw(st.integers(0, height - top))
    found = cells_under(Box.at(*place), grid, cells).place
    for first, count, start, length, of, to in zip(
        found[:2], found[2:], place[:2], place[2:], (width, height), (cells.width, cells.height), strict=True
    ):
        pixels = [set(range(c * of // to, (c + 1) * of // to)) for c in range(to)]
        within = {c for c, its in enumerate(pixels) if its & set(range(start, start + length))}
        assert within <= set(range(first, first + count))
        if within:
            assert (first, first + count - 1) == (min(within), max(within))
        else:
            assert count == 0


@pytest.mark.parametrize("name", list(GRIDS))
def test_cells_beside_are_as_if_compared(device: Device, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Layers at both borders, in the middle and all along a grid; the same to the bit if all cells are."""
    grid = GRIDS[name]
    width, height = grid.width, grid.height
    places = [(0, 0, 31, height), (19, 3, 40, height - 5), (0, 2, width, 15), (width - 40, 7, 40, height - 7)]
    places += [(0, 1, width, height - 2), (0, 5, width - 9, height - 5)]
    pairs = [Pair(a, b) for a, b in combinations(range(len(places)), 2)]
    monkeypatch.setattr(colour, "_CELL", 5)  # else all begin in the first row
    layers, fields = [], []
    covered = np.zeros((len(places), *grid.shape), bool)
    for number, place in enumerate(places):
        pixels = random_layer(30 + number, *place[2:], 0.9)
        pixels[..., :3][patches(number, *place[2:], 0.3, 9) > 0] = 1  # clipped
        field = ndimage.gaussian_filter(np.random.default_rng(number).normal(size=pixels.shape), (4, 4, 0))
        field *= 3 * (grid.lonlat[1] or 1)
        field[..., 2] *= grid.lonlat[1] > 0
        field[..., 3] = np.abs(field[..., 3]) + 0.1
        covered[number][place[1] :, place[0] :][: place[3], : place[2]] = pixels[..., 3] > 0
        layers.append(on_device(device, pixels, *place[:2]))
        fields.append(device.upload(field, np.float32))
    results = []
    for everything in (False, True):
        if everything:
            for module in (colour, seam):
                monkeypatch.setattr(module, "shared_cells", lambda *given: Box(0, 0, *given[-1].border[:2]))
        measured = colour.measure(device, layers, fields, pairs, grid, covered)
        of_all = [difference.mixing.shape == measured.grid.shape for difference in measured.differences]
        assert all(of_all) == everything
        correction = colour.correction(device, measured, Settings())
        masks = Masks(grid, tuple(device.upload(mask, np.uint8) for mask in covered), covered)
        scene = Scene(device, layers, pairs, fields, masks, grid)
        residual = seam.residuals(scene, correction)
        excess = np.ones((len(layers), *grid.shape), np.float32)
        everywhere = np.ones(seam.seam_grid(grid).shape, bool)
        lost = seam.clipping_prices(scene, correction, excess, everywhere)
        gains = [gain.get() for gain in correction.gains]
        results.append([*gains, residual.mean, residual.rms, residual.smooth_rms, residual.measured, lost])
        cut = [device.copy(field) for field in fields]
        seam.cut_unaligned(replace(scene, fields=cut), correction)
        results[-1] += [field.get() for field in cut]
    for few, every in zip(*results, strict=True):
        assert np.array_equal(few, every)
        assert few.any()


def test_differences_count_in_their_rows_and_columns() -> None:
    """Also what only bounds tell; rows of a sphere count by how wide they are."""
    cells, random = sphere(24, 12), np.random.default_rng(7)
    inside = random.random((2, *cells.shape)) < 0.9
    few = [random.normal(size=(4, 7, 4)) for _ in range(2)]
    wide = [np.zeros((*cells.shape, 4)) for _ in few]
    for one, same in zip(few, wide, strict=True):
        one[..., 3] = np.abs(one[..., 3]) if one is few[0] else np.round(one[..., 3])
        same[1:5, 13:20] = one
    differences = (
        Difference(0, 1, *few, *np.ones((2, 4, 7)), np.s_[1:5, 13:20]),
        Difference(0, 1, *wide, *np.ones((2, *cells.shape))),
    )
    for beyond_alone in (False, True):
        if beyond_alone:
            few[0][..., 3] = wide[0][..., 3] = 0
        gains = [solve(Measured(cells, inside, 1.0, (one,))) for one in differences]
        assert np.array_equal(*gains)
        assert (np.abs(gains[0]) > 0.01).any()


def test_overlaps_are_what_both_layers_cover() -> None:
    covered = np.random.default_rng(1).random((5, 13, 17)) < 0.5
    pairs = [(0, 1), (3, 2), (4, 0)]
    overlaps = Overlaps(Masks(plane(17, 13), (), covered), pairs)
    assert len(overlaps) == 3
    for (a, b), overlap in zip(pairs, overlaps, strict=True):
        assert np.array_equal(overlap, covered[a] & covered[b])

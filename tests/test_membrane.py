"""What is taken from one layer, whole, is moved smoothly: kernels against twins, and by how much."""

from __future__ import annotations

import numpy as np
import pytest
import test_movers_panoramas as movers
from grids import GRIDS, boxes, on_device, patches, plane, random_layer
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import membrane as twin
from reference.common import Array
from scipy import ndimage
from tolerances import SUM, assert_close

from hugin_abflow import coefficient, geometry, joint, membrane, working
from hugin_abflow.grid import Grid
from hugin_abflow.opencl import Device
from hugin_abflow.progress import silent
from hugin_abflow.settings import Settings

# The kernels


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize("part", [0, 1, 2])
def test_kernels_equal_their_twins(device: Device, name: str, part: int) -> None:
    """On cells that divide nothing."""
    grid, box, cells = GRIDS[name], boxes(GRIDS[name])[part], GRIDS[name].resized(10, 7)
    layer = random_layer(1, box[2], box[3], 0.4)
    field = np.random.default_rng(2).normal(size=layer.shape).astype(np.float32)
    out, mean = device.upload(field), device.empty((7, 10, 4))
    device.run(
        "membrane", "membrane_mean", (10, 7), device.upload(layer), out, box, grid.border, cells.border, mean
    )
    expected = twin.membrane_mean(layer, field, box, grid.border, cells.border)
    assert_close(mean.get(), expected, 10 * SUM)
    assert expected[..., 3].any()
    assert part == 0 or not expected[..., 3].all()
    told = np.random.default_rng(3).random((7, 10, 4)).astype(np.float32)
    told *= patches(4, 10, 7, 0.5, 3)[..., None]
    device.run(
        "membrane", "membrane_stretch", box[2:], out, box, grid.border, device.upload(told), cells.border
    )
    expected = twin.membrane_stretch(field, box, grid.border, told, cells.border)
    assert_close(out.get(), expected, 10 * SUM)
    assert np.array_equal(out.get()[..., 3], field[..., 3])
    same = (out.get() == field).all(-1)
    assert 0.02 < same.mean() < 0.9


# Harmonic values


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), wraps=st.booleans())
def test_values_are_between_those_around_and_their_neighbours_mean(seed: int, wraps: bool) -> None:
    """Of a random shape; what is not known plays no part, whatever it is."""
    cells = plane(17, 11, wraps)
    random = np.random.default_rng(seed)
    values = random.normal(size=(11, 17, 3))
    free, known = random.random((11, 17)) < 0.6, random.random((11, 17)) < 0.9
    free &= known
    if not free.any():
        return
    values[~known] = np.nan
    found = membrane._harmonic(np.where(known[..., None], values, 1e9), free, known, cells)
    assert np.array_equal(found[known & ~free], values[known & ~free])
    held = found[known & ~free]
    low, high = np.minimum(held.min(0), 0) - 1e-6, np.maximum(held.max(0), 0) + 1e-6
    assert (found[free] >= low).all() and (found[free] <= high).all()
    around, count = np.zeros(values.shape), np.zeros(free.shape)
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        its, there = np.roll(found, step, axis), np.roll(known, step, axis)
        if axis == 0 or not wraps:
            edge = [slice(None)] * 2
            edge[axis] = 0 if step > 0 else -1
            there = there.copy()
            there[tuple(edge)] = False
        around += np.where(there[..., None], its, 0)
        count += there
    expected = around / np.maximum(count, 1)[..., None]
    assert np.allclose(found[free], expected[free], atol=1e-6)


# Fields

WIDTH, HEIGHT = 240, 96
CELLS = (12, 30)


def stretched(
    device: Device,
    field: Array,
    owner: Array,
    whole: Array,
    covers: list[Array],
    wraps: bool = False,
    unlike: Array | None = None,
) -> tuple[list[int], Array, Array]:
    """Which of two layers have changed, and displacements (height, width) along x of both, by the same field
    before. covers: of cells or of pixels. unlike: default: all cells."""
    grid: Grid = plane(WIDTH, HEIGHT, wraps)
    layers, fields = [], []
    for cover in covers:
        mask = cover if cover.shape == (HEIGHT, WIDTH) else np.kron(cover, np.ones((8, 8), bool))
        layers.append(on_device(device, np.ones((HEIGHT, WIDTH, 4), np.float32) * mask[..., None]))
        values = np.zeros((HEIGHT, WIDTH, 4), np.float32)
        values[..., 0], values[..., 3] = field, 0.5
        fields.append(device.upload(values))
    masks = coefficient.masks(device, layers, grid)
    unlike = np.ones(CELLS, bool) if unlike is None else unlike
    cells = grid.coarser(8)
    changed = membrane.stretch(device, layers, fields, owner, whole, unlike, masks, grid, cells)
    assert all((its.get()[..., 3] == 0.5).all() for its in fields)
    first, second = (its.get()[..., 0] for its in fields)
    return changed, first, second


@pytest.mark.parametrize("turn", [0, 15, 22])
def test_what_is_torn_is_straightened_and_nothing_else(device: Device, turn: int) -> None:
    """A wave with noise on it, in a region that comes from the first of two layers; it has a hole, and lies
    across the border as elsewhere."""
    wave = np.broadcast_to(2 * np.sin(np.arange(WIDTH) * 2 * np.pi / WIDTH), (HEIGHT, WIDTH))
    whole, cover = np.zeros(CELLS, bool), np.ones(CELLS, bool)
    whole[3:9, 8:22] = True
    cover[5, 14] = False
    pixels = np.kron(whole, np.ones((8, 8), bool))
    noise = np.random.default_rng(1).normal(size=wave.shape)
    before = (wave + 3 * noise * ndimage.binary_erosion(pixels, iterations=2)).astype(np.float32)
    turned = [np.roll(one, turn, 1) for one in (whole, cover)]
    moved, first, second = stretched(
        device, np.roll(before, 8 * turn, 1), np.zeros(CELLS, int), turned[0],
        [turned[1], np.ones(CELLS, bool)], wraps=True,
    )  # fmt: skip
    assert moved == [0]
    first, second = (np.roll(one, -8 * turn, 1) for one in (first, second))
    _, straight, _ = stretched(
        device, before, np.zeros(CELLS, int), whole, [cover, np.ones(CELLS, bool)], wraps=True
    )
    assert_close(first, straight, 10 * SUM)
    inside = ndimage.binary_erosion(pixels, iterations=12) & np.kron(cover, np.ones((8, 8), bool))
    assert np.abs(first - wave)[inside].max() < 0.5
    assert np.abs(before - wave)[inside].max() > 8
    beside = ~ndimage.binary_dilation(pixels, iterations=4)  # between cells, half of one
    assert np.array_equal(first[beside], before[beside])
    assert np.array_equal(second, before)  # nothing is taken from it


def test_layers_are_held_where_they_agree(device: Device) -> None:
    """In a region as beside it."""
    whole, unlike = np.zeros(CELLS, bool), np.zeros(CELLS, bool)
    whole[2:10, 4:26] = True
    unlike[:, 10:20] = True
    field = np.random.default_rng(4).normal(size=(HEIGHT, WIDTH)).astype(np.float32)
    covers = [np.ones(CELLS, bool)] * 2
    _, first, _ = stretched(device, field, np.zeros(CELLS, int), whole, covers, unlike=unlike)
    changed = np.argwhere(first != field)
    assert changed.min(0).tolist() == [12, 76]  # half a cell beside
    assert changed.max(0).tolist() == [83, 163]


def test_a_layers_border_is_a_cut_wherever_it_lies_among_cells(device: Device) -> None:
    """The first layer ends inside the region, and another goes on."""
    whole = np.zeros(CELLS, bool)
    whole[:, 4:26] = True
    owner = np.broadcast_to(np.where(np.arange(30) >= 15, 1, 0), CELLS)
    field = np.random.default_rng(3).normal(size=(HEIGHT, WIDTH)).astype(np.float32)
    found = []
    for end in range(120, 128):
        covers = [np.ones((HEIGHT, WIDTH), bool), np.ones((HEIGHT, WIDTH), bool)]
        covers[0][:, end:] = False
        _, first, _ = stretched(device, field, owner, whole, covers)
        assert np.array_equal(first[:, 108:120], field[:, 108:120])
        found.append(first[:, :100])
    assert np.abs(found[0][:, 60:84]).max() < 0.5
    assert all(np.array_equal(one, found[0]) for one in found)


@pytest.mark.parametrize("turn", [0, 15])
def test_along_cuts_layers_stay_where_they_meet(device: Device, turn: int) -> None:
    """Where both are; where the other one is not there is no such place. Across the border as elsewhere."""
    whole, owner = np.zeros(CELLS, bool), np.zeros(CELLS, int)
    whole[:, 4:26] = True
    owner[:, 15:] = 1
    covers = [np.ones(CELLS, bool), np.ones(CELLS, bool)]
    covers[1][6:, :15] = covers[0][6:, 15:] = False
    field = np.random.default_rng(2).normal(size=(HEIGHT, WIDTH)).astype(np.float32)
    turned = [np.roll(one, turn, 1) for one in (whole, owner, *covers)]
    changed, *found = stretched(
        device, np.roll(field, 8 * turn, 1), turned[1], turned[0], turned[2:], wraps=True
    )
    assert changed == [0, 1]
    for k, one in enumerate(found):
        one = np.roll(one, -8 * turn, 1)
        meet = np.s_[:40, 108:120] if k == 0 else np.s_[:40, 120:132]
        assert np.array_equal(one[meet], field[meet])
        alone = np.s_[80:, 108:116] if k == 0 else np.s_[80:, 124:132]
        assert np.abs(one[alone]).max() < 0.5 < np.abs(field[alone]).max()


def test_nothing_is_held_and_nothing_known(device: Device) -> None:
    """A layer that is all in one region is not moved; one that has no pixel in it is left alone."""
    everywhere = np.ones(CELLS, bool)
    field = np.ones((HEIGHT, WIDTH), np.float32)
    covers = [everywhere, ~everywhere]
    changed, first, second = stretched(device, field, np.zeros(CELLS, int), everywhere, covers)
    assert changed == [0]
    assert np.abs(first).max() < 1e-3
    assert np.array_equal(second, field)


def test_rows_that_are_read_are_those_that_are_then_shown(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`reach` tells them, of displacements as they are at last: here of more than they would be."""
    shoot, kept, told = movers.shoot(movers.PERSON), [], []
    read, stretch = joint.reading.read, membrane.stretch

    def watched(device, layers, fields, *others):
        told.append(stretch(device, layers, fields, *others))
        for k in told[0]:
            fields[k].set(fields[k].get() * np.float32([3, 3, 3, 1]))
        return told[0]

    monkeypatch.setattr(membrane, "stretch", watched)
    monkeypatch.setattr(joint.reading, "read", lambda *given: kept.append(read(*given)) or kept[0])
    found = joint.prepare(device, shoot.layers, movers.CANVAS, Settings(), silent)
    assert len(told) == 1
    assert told[0]
    by_layer = {id(one.layer): one for one in kept[0]}
    for one in found.layers:
        its: working.WorkingLayer = by_layer[id(one.layer)]
        assert one.reach == geometry.reach(device, its, one.field, found.grid)

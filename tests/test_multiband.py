"""A multi-band blend of layers that were cut: kernels against twins."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from bands import field_of
from grids import GRIDS, boxes, patches, plane, random_layer, sphere
from reference import multiband as twin
from reference.common import Array
from tolerances import DECISIONS, SUM, TRIGONOMETRY, assert_close

from hugin_abflow import multiband
from hugin_abflow.grid import Grid
from hugin_abflow.opencl import Device

PARTS = ["all", "border", "inside"]

# The kernels


def box_of(grid: Grid, part: str) -> tuple[int, int, int, int]:
    return boxes(grid)[PARTS.index(part)]


def shares(seed: int, box: Sequence[int]) -> Array:
    """Of all weight, on a box; 0 for some pixels."""
    random = np.random.default_rng(seed).random((box[3], box[2])).astype(np.float32)
    return random * patches(seed + 7, box[2], box[3], 0.7)


def level_of(device: Device, seed: int, grid: Grid, box: tuple[int, int, int, int]) -> multiband._Level:
    """A random level on a box."""
    colours, share = random_layer(seed, box[2], box[3], 0.5), shares(seed + 1, box)
    return multiband._Level(grid, box, device.upload(colours), device.upload(share))


def test_twin_of_the_spline_is_a_box_convolved_twice() -> None:
    fine = np.ones(1000) / 1000
    t = (np.arange(2998) - 1498.5) / 1000
    expected = np.convolve(np.convolve(fine, fine), fine) * 1000
    assert np.allclose(twin.spline(t), expected, atol=1e-5)
    around = np.linspace(-0.5, 0.5, 11)
    assert np.allclose(sum(twin.spline(around + i) for i in range(-2, 3)), 1)


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize("shoulder", [0.0, 0.75])
def test_weights_and_finest_levels_equal_their_twins(device: Device, name: str, shoulder: float) -> None:
    """Layers that move, with gains and one without."""
    grid, cells = GRIDS[name], GRIDS[name].resized(7, 5)
    half = grid.resized(round(grid.width / 2), round(grid.height / 2))
    total, expected = device.zeros(grid.shape), np.zeros(grid.shape)
    layers = [random_layer(10 * k, box[2], box[3], 0.8) for k, box in enumerate(boxes(grid))]
    fields = [field_of(10 * k, grid, box, 1.5) for k, box in enumerate(boxes(grid))]
    for layer, field, box in zip(layers, fields, boxes(grid), strict=True):
        device.run(
            "multiband", "multiband_weights", box[2:], device.upload(layer), device.upload(field), box,
            grid.border, total,
        )  # fmt: skip
        expected = twin.multiband_weights(layer, field, box, grid.border, expected)
    assert_close(total.get(), expected, SUM)
    assert 0 < (expected == 0).mean() < 0.9
    gains = [np.random.default_rng(k).normal(size=(5, 7, 4)).astype(np.float32) * 0.2 for k in (1, 2)]
    for layer, field, box, gain in zip(layers, fields, boxes(grid), [None, *gains], strict=True):
        there = multiband._box(box, grid, half, np.zeros(half.height, np.float32))
        level, share = device.empty((*there[:1:-1], 4)), device.empty(there[:1:-1])
        way = device.upload(field)
        given = (way, twin.NONE) if gain is None else (device.upload(gain), cells.border)
        device.run(
            "multiband", "multiband_finest", there[2:], device.upload(layer), way, box, grid.border,
            grid.lonlat, total, *given, shoulder, there, half.border, level, share,
        )  # fmt: skip
        found = twin.multiband_finest(
            layer, field, box, grid.border, grid.lonlat, expected, gain, cells.border, shoulder, there,
            half.border,
        )  # fmt: skip
        # a hundredth of a pixel's position, some tenth of full scale from one to the next
        assert_close(level.get(), found[0], 5 * TRIGONOMETRY, 2 * DECISIONS)
        assert_close(share.get(), found[1], SUM, 2 * DECISIONS)
        assert 0.2 < found[0][..., 3].mean() < 0.95


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize("part", PARTS)
def test_differences_equal_their_twin(device: Device, name: str, part: str) -> None:
    grid = GRIDS[name]
    box = box_of(grid, part)
    level, mean = random_layer(3, box[2], box[3], 0.7), random_layer(4, grid.width, grid.height, 0.7)
    out = device.upload(level)
    device.run("multiband", "multiband_differ", box[2:], out, box, grid.border, device.upload(mean))
    expected = twin.multiband_differ(level, box, mean)
    assert_close(out.get(), expected, SUM)
    assert expected[..., 3].sum() < (level[..., 3] > 0).sum()


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize("part", PARTS)
def test_reduced_levels_equal_their_twins(device: Device, name: str, part: str) -> None:
    """On grids half as large, which is no whole number, and on some that halve nothing; and on any box."""
    grid = GRIDS[name]
    box = box_of(grid, part)
    layer, share = random_layer(30, box[2], box[3], 0.5), shares(40, box)
    for coarse in grid.coarser(2), grid.resized(grid.width * 4 // 9 + 1, grid.height * 4 // 9 + 1):
        for smaller in (0, 0, coarse.width, coarse.height), (3, 2, coarse.width - 3, 9):
            out, out_share = device.empty((*smaller[:1:-1], 4)), device.empty(smaller[:1:-1])
            device.run(
                "multiband", "multiband_reduce", smaller[2:], device.upload(layer), device.upload(share),
                box, grid.border, out, out_share, smaller, coarse.border,
            )  # fmt: skip
            expected = twin.multiband_reduce(layer, share, box, grid.border, smaller, coarse.border)
            assert_close(out.get(), expected[0], 10 * SUM)
            assert_close(out_share.get(), expected[1], 10 * SUM)
            valid = expected[0][..., 3]
            assert (valid > 0).any() and (part != "inside" or (valid == 0).any())


@pytest.mark.parametrize("name", [name for name, grid in GRIDS.items() if grid.lonlat[1]])
@pytest.mark.parametrize("part", PARTS)
def test_levels_are_spread_as_their_twins(device: Device, name: str, part: str) -> None:
    """Far at the poles, across the border where the grid wraps; hardly at all around the equator."""
    for grid in GRIDS[name], GRIDS[name].coarser(2):
        box, widths = box_of(grid, part), multiband._widths(grid)
        level, share = random_layer(50, box[2], box[3], 0.6), shares(51, box)
        out, out_share = device.empty(level.shape), device.empty(share.shape)
        device.run(
            "multiband", "multiband_spread", box[2:], device.upload(level), device.upload(share), box,
            grid.border, device.upload(widths), out, out_share,
        )  # fmt: skip
        expected = twin.multiband_spread(level, share, box, grid.border, widths)
        assert_close(out.get(), expected[0], 10 * SUM)
        assert_close(out_share.get(), expected[1], 10 * SUM)
        assert np.abs(expected[1] - share).max() > (0.05 if grid.poles else 0.002)


def test_rows_are_spread_as_widely_as_a_reduction_does_at_the_equator() -> None:
    """At 45 degrees a column, between the bounds; not at all on a plane."""
    grid = sphere(256, 128)
    widths = multiband._widths(grid)
    assert widths.shape == (128,)
    assert np.allclose(widths[31:33], 1, atol=0.03) and np.array_equal(widths, widths[::-1])
    assert widths[64] == np.float32(0.7) and 80 < widths[0] <= 256 / 3
    assert not multiband._widths(plane()).any()


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("coarsest", [False, True])
def test_added_and_joined_levels_equal_their_twins(
    device: Device, name: str, part: str, coarsest: bool
) -> None:
    """Each with a coarser level under it, on a box and with holes in that, or none."""
    grid = GRIDS[name]
    coarse, box = grid.coarser(2), box_of(grid, part)
    under = twin.NONE if coarsest else coarse.border
    level, share = random_layer(60, box[2], box[3], 0.7), shares(61, box)
    smaller_box = multiband._box(box, grid, coarse, multiband._widths(coarse))
    smaller = random_layer(62, smaller_box[2], smaller_box[3], 0.5)
    total = np.random.default_rng(63).random((*grid.shape, 4)).astype(np.float32)
    total *= patches(64, grid.width, grid.height, 0.5)[..., None]
    out = device.upload(total)
    device.run(
        "multiband", "multiband_add", box[2:], device.upload(level), device.upload(share), box, grid.border,
        device.upload(smaller), smaller_box, under, out,
    )  # fmt: skip
    expected = twin.multiband_add(level, share, box, grid.border, smaller, smaller_box, under, total)
    assert_close(out.get(), expected, 10 * SUM)
    assert (expected != total).any() and (expected == total).any()

    joined = random_layer(65, coarse.width, coarse.height, 0.5)
    out = device.upload(total)
    device.run("multiband", "multiband_join", grid.border[:2], out, grid.border, device.upload(joined), under)
    expected = twin.multiband_join(total, grid.border, joined, under)
    # weights are random: colours of some thousand, of rounded sums
    assert_close(out.get(), expected, 10 * SUM)
    assert 0.2 < expected[..., 3].mean() < 0.8


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize("part", PARTS)
def test_offsets_equal_their_twins(device: Device, name: str, part: str) -> None:
    """Beside the layer, across the border too, and holes in the blend; small ones are exactly nothing."""
    grid = GRIDS[name]
    box = box_of(grid, part)
    level = random_layer(70, box[2], box[3], 0.6)
    blend = random_layer(71, grid.width, grid.height, 0.8)
    out = device.empty((*box[:1:-1], 4))
    device.run(
        "multiband", "multiband_offset", box[2:], device.upload(level), box, grid.border,
        device.upload(blend), 0.1, out,
    )  # fmt: skip
    expected = twin.multiband_offset(level, box, grid.border, blend, 0.1)
    assert_close(out.get(), expected, 10 * SUM)
    zero = (expected == 0).all(-1)
    assert 0.01 < zero.mean() < 0.8
    assert ((out.get() == 0).all(-1) == zero).mean() > 1 - DECISIONS
    assert (expected[level[..., 3] == 0] != 0).any()


@pytest.mark.parametrize("grid", [*GRIDS.values(), sphere(512, 256)], ids=[*GRIDS, "large sphere"])
def test_a_level_shows_nothing_beside_its_box(
    device: Device, grid: Grid, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On the whole grid it is the same: beside the box it has neither share nor colour, half a turn further
    beyond a pole either."""
    coarse = grid.coarser(2)
    widths, everything = multiband._widths(coarse), (0, 0, coarse.width, coarse.height)
    w, h = grid.width, grid.height
    corners = [(w // 2 - 2, 0, 3, 4), (w // 2 - 2, h - 4, 3, 4), (0, h // 2, 4, 3), (w - 4, h // 2, 4, 3)]
    smaller = 0
    for box in [*boxes(grid), *corners]:
        level = level_of(device, 80, grid, box)
        found = multiband._reduced(device, level, coarse, widths)
        with monkeypatch.context() as patch:
            patch.setattr(multiband, "_box", lambda *given: everything)
            whole = multiband._reduced(device, level, coarse, widths)
        left, top, width, height = found.box
        part = np.s_[top : top + height, left : left + width]
        for values, its in (whole.colours.get(), found.colours), (whole.share.get(), found.share):
            assert_close(its.get(), values[part], 10 * SUM)
            values[part] = 0
            assert not values.any(), box
        smaller += found.box != everything
    assert smaller

"""Shares that fade towards where a layer ends: kernels against twins, and what they are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from grids import GRIDS, boxes, patches, plane
from hypothesis import given, settings
from hypothesis import strategies as st
from pictures import one_device
from reference import feather as twin
from reference.coefficient import coefficient_ratio
from reference.common import on_box
from tolerances import SUM, assert_close

from hugin_abflow.feather import feathers
from hugin_abflow.grid import Grid, Place
from hugin_abflow.kept import kept_device
from hugin_abflow.opencl import Device

__all__ = ["one_device"]


def layer_of(mask: np.ndarray) -> np.ndarray:
    return np.dstack([np.zeros((*mask.shape, 3)), mask]).astype(np.float32)


def shares(
    device: Device, masks: Sequence[np.ndarray], places: Sequence[Place], grid: Grid
) -> list[np.ndarray]:
    layers = [(box, device.upload(layer_of(mask))) for box, mask in zip(places, masks, strict=True)]
    return [one.get() for one in feathers(device, layers, grid)]


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize("part", [0, 1, 2])
@pytest.mark.parametrize("share", [0.05, 0.6, 0.95])
def test_kernels_equal_their_twins(device: Device, name: str, part: int, share: float) -> None:
    """Of masks in patches, of which some have borders in few columns."""
    grid, box = GRIDS[name], boxes(GRIDS[name])[part]
    width, height = box[2:]
    mask, before = patches(1, width, height, share) > 0, patches(2, grid.width, grid.height, 0.5) > 0
    layer, shown = device.upload(layer_of(mask)), device.upload(before, np.uint8)
    device.run("feather", "feather_mark", box[2:], layer, box, grid.border, shown)
    marked = twin.feather_mark(mask, box, before)
    assert np.array_equal(shown.get(), marked)
    far, beyond = grid.width + grid.height, width // 2 * (part == 0)
    rows = device.empty((height, width), np.uint16)
    device.run("feather", "feather_columns", (width,), layer, box, grid.border, shown, far, rows, group=16)
    expected = twin.feather_columns(mask, box, marked, far)
    assert np.array_equal(rows.get(), expected)
    lowest = device.empty((height, width + 2 * beyond, 2), np.uint16)
    distance, total = device.empty((height, width)), device.upload(before, np.float32)
    device.run(
        "feather", "feather_distance", (height,),
        layer, box, grid.border, rows, beyond, lowest, distance, total, group=16,
    )  # fmt: skip
    expected = twin.feather_distance(mask, expected, beyond)
    assert_close(distance.get(), expected, SUM)
    sums = before.astype(float)
    sums[on_box(box)] += expected
    assert_close(total.get(), sums, SUM)
    device.run("coefficient", "coefficient_ratio", box[2:], distance, box, grid.border, total)
    assert_close(distance.get(), coefficient_ratio(expected, box, sums), SUM)


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize("share", [0.05, 0.6, 0.97, 1.0])
def test_shares_are_by_distance(device: Device, name: str, share: float) -> None:
    """As SciPy measures it; also where some have no border."""
    grid = GRIDS[name]
    places = boxes(grid)
    masks = [patches(k, width, height, share) > 0 for k, (_, _, width, height) in enumerate(places)]
    found = shares(device, masks, places, grid)
    for one, expected in zip(found, twin.feathers(masks, places, grid.border), strict=True):
        assert one.dtype == np.float32
        assert_close(one, expected, SUM)


@settings(max_examples=40)
@given(
    width=st.integers(1, 40), height=st.integers(1, 30), share=st.floats(0, 1), seed=st.integers(0, 2**31),
    wraps=st.booleans(),
)  # fmt: skip
@pytest.mark.usefixtures(one_device.__name__)
def test_whatever_the_size(width: int, height: int, share: float, seed: int, wraps: bool) -> None:
    grid, random = plane(width, height, wraps), np.random.default_rng(seed)
    inner = (width // 3, height // 4, max(1, width // 2), max(1, height // 2))
    places = [(0, 0, width, height), inner]
    masks = [random.random((h, w)) < share for _, _, w, h in places]
    found = shares(kept_device(None, 0), masks, places, grid)
    for one, expected in zip(found, twin.feathers(masks, places, grid.border), strict=True):
        assert_close(one, expected, SUM)


@pytest.mark.parametrize("name", list(GRIDS))
def test_shares_sum_to_one_and_fade_to_borders(device: Device, name: str) -> None:
    """Of random masks; beside another layer each counts for less than where it is alone."""
    grid = GRIDS[name]
    places = boxes(grid)
    masks = [patches(k, width, height, 0.6) > 0 for k, (_, _, width, height) in enumerate(places)]
    total, count = np.zeros(grid.shape), np.zeros(grid.shape, int)
    found = shares(device, masks, places, grid)
    for one, mask, (left, top, width, height) in zip(found, masks, places, strict=True):
        assert (one[mask] > 0).all() and not one[~mask].any()
        total[top : top + height, left : left + width] += one
        count[top : top + height, left : left + width] += mask
    assert np.allclose(total, count > 0, atol=1e-6)
    assert (count > 1).any()


def test_a_feather_is_as_wide_as_the_overlap(device: Device) -> None:
    """It falls evenly; across the border of a canvas that wraps as well. What covers all has no border."""
    grid = plane(60, 20, wraps=True)
    columns = np.broadcast_to(np.arange(60), grid.shape)
    box = (0, 0, 60, 20)
    for turn in (0, 35):
        masks = [np.roll(mask, turn, 1) for mask in ((columns >= 30), (columns < 40) | (columns >= 52))]
        first, second = (np.roll(one, -turn, 1) for one in shares(device, masks, [box, box], grid))
        assert np.allclose(first[:, 30:40], (np.arange(10) + 1) / 11, atol=0.02)
        assert np.allclose(second[:, 52:60], (np.arange(8) + 1) / 9, atol=0.02)
        assert (first[:, 41:51] == 1).all() and (second[:, 2:28] == 1).all()
    everywhere = np.ones(grid.shape, bool)
    assert np.allclose(shares(device, [everywhere] * 2, [box, box], grid)[0], 0.5)

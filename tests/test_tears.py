"""Where a layer's own displacements tear it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import test_seam_panoramas as discs
from grids import on_device, plane, sphere
from pictures import merged, one_device

from hugin_abflow import tears
from hugin_abflow.grid import Grid
from hugin_abflow.opencl import Device
from hugin_abflow.regions import Choice, Residuals

COLUMNS, ROWS, SIZE = 12, 7, 8  # cells, and working pixels of each


def torn(
    device: Device, grid: Grid, displaced: np.ndarray, covers: np.ndarray | None = None, by: str = "x"
) -> np.ndarray:
    """Where a layer is torn of which each cell is displaced by so many cells."""
    cells = grid.resized(COLUMNS, ROWS)
    pixels, field = (np.zeros((grid.height, grid.width, 4), np.float32) for _ in range(2))
    pixels[..., 3] = 1 if covers is None else np.kron(covers, np.ones((SIZE, SIZE)))
    step = cells.lonlat[3] if cells.spherical else SIZE
    field[..., "xyz".index(by)] = step * np.kron(displaced, np.ones((SIZE, SIZE)))
    layer = on_device(device, pixels)
    (found,) = tears.find(
        device, [layer], [device.upload(field)], np.ones((ROWS, COLUMNS), bool), grid, cells
    )
    return np.asarray(found)


def flat(wraps: bool = False) -> Grid:
    return plane(COLUMNS * SIZE, ROWS * SIZE, wraps)


@pytest.mark.parametrize("down", [False, True])
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_jump_tears_both_of_its_sides(device: Device, down: bool, sign: int) -> None:
    displaced, expected = np.zeros((ROWS, COLUMNS)), np.zeros((ROWS, COLUMNS), bool)
    if down:
        displaced[3:], expected[2:4] = sign * 0.65, True
    else:
        displaced[:, 5:], expected[:, 4:6] = sign * 0.65, True
    assert np.array_equal(torn(device, flat(), displaced), expected)
    assert np.array_equal(torn(device, flat(), displaced, by="y"), expected)  # shearing as well
    assert not torn(device, flat(), 0.85 * displaced).any()


def test_slopes_are_told_by_how_steep_they_are(device: Device) -> None:
    """However far they lead: a surface seen from aside."""
    slope = np.tile(np.arange(COLUMNS), (ROWS, 1))
    assert not torn(device, flat(), 0.5 * slope).any()
    assert torn(device, flat(), 0.7 * slope).all()


def test_borders_are_no_jumps(device: Device) -> None:
    """But for that which wraps: there columns are neighbours."""
    displaced = np.zeros((ROWS, COLUMNS))
    displaced[:, 0] = 0.5
    displaced[:, -1] = -0.5
    expected = np.zeros((ROWS, COLUMNS), bool)
    assert not torn(device, flat(), displaced).any()
    expected[:, [0, -1]] = True
    assert np.array_equal(torn(device, flat(wraps=True), displaced), expected)


def test_what_is_beside_the_layer_or_the_regions_does_not_count(device: Device) -> None:
    displaced, covers = np.zeros((ROWS, COLUMNS)), np.ones((ROWS, COLUMNS))
    displaced[:, 5:] = 3
    covers[:, 5:] = 0
    assert not torn(device, flat(), displaced, covers).any()


def test_rows_beside_a_pole_are_narrower(device: Device) -> None:
    """So the same displacement tears more; and along columns as at the equator."""
    grid = sphere(COLUMNS * SIZE, ROWS * SIZE)
    displaced = np.zeros((ROWS, COLUMNS))
    displaced[:, 3:9] = 0.5
    found = torn(device, grid, displaced)
    assert found[0, [2, 3, 8, 9]].all()
    assert found[-1, [2, 3, 8, 9]].all()
    assert not found[ROWS // 2].any()


def test_a_region_is_taken_from_the_layer_that_is_whole() -> None:
    """Though the softmax slightly favours the other one; but not where it clearly does."""
    whole, cover = np.ones((6, 20), bool), np.ones((2, 6, 20), bool)
    shares = np.stack([np.full(whole.shape, 0.6), np.full(whole.shape, 0.4)])
    residual = np.full(whole.shape, 0.3)
    is_torn = np.zeros((2, *whole.shape), bool)
    choice = Choice(whole, Residuals(residual, residual), shares, cover, False, 10.0, torn=is_torn)
    assert (choice.owners()[0] == 0).all()
    is_torn[0, :, 8:14] = True
    assert (choice.owners()[0] == 1).all()
    shares += np.array([0.2, -0.2])[:, None, None]
    assert (choice.owners()[0] == 0).all()
    shares -= np.array([0.2, -0.2])[:, None, None]
    is_torn[1] = is_torn[0]  # no better
    assert (choice.owners()[0] == 0).all()


@pytest.mark.usefixtures(one_device.__name__)
@pytest.mark.parametrize("index", [0, 1])
def test_a_panorama_does_not_show_what_is_torn(monkeypatch: pytest.MonkeyPatch, index: int) -> None:
    """A disc in the first layer alone is whole if the second is torn there, absent if the first is."""

    def found(*arguments: Any) -> np.ndarray:
        whole = arguments[3]
        return np.arange(2)[:, None, None] == np.where(whole, index, -1)

    monkeypatch.setattr(tears, "find", found)
    layers, canvas, away, _ = discs.scene("plane", 0)
    result = merged(layers, canvas, seam=True, exposure=False)
    assert (discs.off(result, discs.DISC)[away < discs.RADIUS - 1] <= 8).mean() == index

"""Grids: their region, size and borders, and masks on them."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from grids import plane

from hugin_abflow.grid import Grid, any_around, connected, full_grid, on_cells, working_grid
from hugin_abflow.layer import Box, Canvas, Layer
from hugin_abflow.settings import Settings

PLANE = (0.0, 0.0, 0.0, 0.0)
SPHERE = Canvas.sphere(802, 401)


def grid_over(region: Box, width: int, height: int, wraps: bool = False) -> Grid:
    return Grid(region, width, height, wraps, 0, PLANE)


def boxes(*edges: tuple[int, int, int, int]) -> list[Layer]:
    """Layers that are boxes only: (left, top, right, bottom)."""
    return [
        Layer("b", Box(*e), np.dtype(np.uint8), 3, lambda top, bottom: np.zeros((0, 0, 4), np.uint8))
        for e in edges
    ]


def test_the_region_is_the_layers_bounding_box() -> None:
    grid = full_grid(Canvas.plane(500, 300), boxes((40, 20, 90, 70), (60, 10, 200, 50)))
    assert grid.region == Box(40, 10, 200, 70)
    assert (grid.width, grid.height, grid.wraps, grid.poles) == (160, 60, False, 0)
    assert grid.lonlat == PLANE


@pytest.mark.parametrize(("top", "bottom", "poles"), [(0, 401, 3), (0, 400, 1), (1, 401, 2), (30, 300, 0)])
def test_poles_are_known_where_layers_reach_them(top: int, bottom: int, poles: int) -> None:
    grid = full_grid(SPHERE, boxes((100, top, 300, bottom), (400, 50, 600, 90)))
    assert grid.region == Box(0, top, 802, bottom)
    assert (grid.wraps, grid.poles) == (True, poles)
    assert grid.lonlat[0] == pytest.approx(-math.pi)
    assert grid.lonlat[2] == pytest.approx(math.pi / 2 - top * math.pi / 401)


def test_a_canvas_of_odd_width_has_no_row_beyond_the_pole() -> None:
    grid = full_grid(Canvas.sphere(801, 400), boxes((0, 0, 801, 400)))
    assert (grid.wraps, grid.poles) == (True, 0)


@pytest.mark.parametrize(
    ("width", "height"), [(802, 401), (1333, 777), (9001, 4501), (64, 32), (3000, 20), (20, 3000)]
)
@pytest.mark.parametrize("wraps", [False, True])
def test_the_working_grid_is_bounded_and_covers_the_region(width: int, height: int, wraps: bool) -> None:
    full = grid_over(Box(0, 0, width, height), width, height, wraps)
    grid = working_grid(full, Settings(working_pixels=100_000))
    assert grid.width <= width and grid.height <= height
    assert grid.width * grid.height <= 100_000 * 1.03 + width + height
    assert grid.region == full.region
    if width * height <= 100_000:
        assert grid.shape == full.shape
    elif wraps and grid.width < width:
        assert grid.width % 2 == 0


@pytest.mark.parametrize("pixels", [2, 3, 4, 16])
def test_half_of_a_turn_is_whole_columns_of_coarser_grids(pixels: int) -> None:
    """So far a row beyond a pole goes on; nor may sweeps over every other column meet at the border."""
    for width in range(30, 60):
        flat = grid_over(Box(0, 0, width, 20), width, 20)
        cells = replace(flat, wraps=True).coarser(pixels)
        assert cells.width % 2 == 0 and abs(cells.width - width / pixels) <= 1.5
        assert flat.coarser(pixels).width == round(width / pixels)
    sphere = full_grid(Canvas.sphere(2050, 1025), boxes((0, 0, 2050, 1025)))
    assert (sphere.coarser(2).width, sphere.coarser(2).poles) == (1026, 3)
    assert sphere.coarser(2).lonlat[1] * 1026 == pytest.approx(2 * math.pi)


@pytest.mark.parametrize("size", [(100_000, 20), (20, 70_000), (100_000, 50_000), (300_000, 3)])
def test_places_on_the_working_grid_are_found_in_32_bits(size: tuple[int, int]) -> None:
    full = grid_over(Box(0, 0, *size), *size, False)
    grid = working_grid(full, Settings())
    assert grid.width * full.width < 2**31 and grid.height * full.height < 2**31
    assert grid.height < 2**15  # rows are packed beside columns (coefficient.cl)


def test_resizing_a_sphere_keeps_its_edges() -> None:
    full = full_grid(SPHERE, boxes((0, 0, 802, 401)))
    grid = full.resized(77, 53)
    for field in (0, 2):
        assert grid.lonlat[field] == full.lonlat[field]
    assert grid.lonlat[1] * 77 == pytest.approx(2 * math.pi)
    assert grid.lonlat[3] * 53 == pytest.approx(math.pi)
    assert grid.circumference == 2 * math.pi
    assert grid_over(full.region, 77, 53).circumference == 77


@pytest.mark.parametrize("small", [(100, 60), (31, 17)])
def test_the_circumference_is_the_canvass_whatever_layers_cover(small: tuple[int, int]) -> None:
    """Flow's share of the canvas's width must not depend on how much of the canvas is used."""
    layers = boxes((40, 20, 140, 80))
    flat = full_grid(Canvas.plane(500, 300), layers).resized(*small)
    assert flat.circumference == pytest.approx(500 * small[0] / 100)
    part = full_grid(Canvas.sphere(500, 300, 120.0), layers).resized(*small)
    assert part.circumference == pytest.approx(math.radians(120))


def test_parts_of_a_mask_meet_across_the_border_and_at_corners() -> None:
    mask = np.zeros((5, 7), bool)
    mask[0, 0] = mask[1, 6] = mask[3, 2] = mask[4, 3] = True
    for wraps in (False, True):
        number = connected(mask, wraps)
        assert ((number > 0) == mask).all() and number[3, 2] == number[4, 3]
        assert (number[0, 0] == number[1, 6]) == wraps and number[3, 2] != number[0, 0]
    for shape in ((0, 7), (5, 0), (5, 7)):
        assert not connected(np.zeros(shape, bool), True).any()


@pytest.mark.parametrize("wraps", [False, True])
def test_what_lies_beside_a_place_is_around_it(wraps: bool) -> None:
    """A cell farther than what it reaches into, in rows and columns, across a wrapped border as well."""
    grid = plane(80, 40, wraps)
    for row, column, seen in (
        (9, 0, True), (9, 4, True), (9, 5, False), (9, 19, wraps), (9, 18, False),
        (7, 2, True), (6, 2, False),
    ):  # fmt: skip
        mask = np.zeros((10, 20), bool)
        mask[row, column] = True
        assert any_around(mask, (0, 32, 13, 8), grid, grid.coarser(4)) == seen
        assert not any_around(mask, (0, 0, 13, 20), grid, grid.coarser(4))


@pytest.mark.parametrize("rule", [np.logical_or, np.logical_and, np.add])
@pytest.mark.parametrize("shape", [(5, 7), (19, 31), (23, 5)])
def test_cells_have_what_lies_in_them(rule: np.ufunc, shape: tuple[int, int]) -> None:
    """Each finer row and column is of one cell; where there are fewer than cells, of several."""
    values = np.random.default_rng(0).random((2, 19, 31)) < 0.9
    values = values if rule is not np.add else values.astype(np.float64)
    result = on_cells(values, plane(31, 23).resized(*shape[::-1]), rule)
    rows, columns = (np.append(np.arange(n) * m // n, m) for n, m in zip(shape, (19, 31), strict=True))
    expected = [
        [rule.reduce(values[:, a : max(b, a + 1), c:d], (1, 2)) for c, d in pairwise(columns)]
        for a, b in pairwise(rows)
    ]
    assert result.flags.c_contiguous
    assert np.array_equal(result, np.moveaxis(expected, 2, 0))

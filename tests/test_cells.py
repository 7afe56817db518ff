"""What is taken from one photo, from charts to cells of the canvas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from grids import plane
from reference import common
from scenes import CANVAS, CHARTS
from scipy import ndimage

from hugin_abflow.cells import CELL, CellFlow, SingleSource, View, ends_within
from hugin_abflow.chart import pair_chart
from hugin_abflow.grid import Grid
from hugin_abflow.layer import Box


def check_on_canvas(grid: Grid, at: int) -> None:
    """Each cell of a canvas, by what its centre shows; rows 50 to 130 around column `at` are the overlap."""
    overlap = np.zeros(grid.shape, bool)
    overlap[50:130, np.arange(at - 60, at + 60) % grid.width] = True
    chart = pair_chart(overlap, grid, grid)
    assert not chart.wraps
    empty = np.zeros(((chart.height + 1) // CELL, (chart.width + 1) // CELL), bool)
    first, second = empty.copy(), empty.copy()
    rows, columns = (n // 2 for n in empty.shape)
    first[rows - 9 : rows - 2, columns - 5 : columns + 6] = True
    second[rows + 1 : rows + 4, columns + 2 : columns + 9] = True
    cells = grid.resized(round(grid.width / 7.9), 23)
    found = SingleSource(first, second).on_canvas(chart, cells)
    assert found.shape == cells.shape
    x, y = (n + 0.5 for n in common.pixels(cells.width, cells.height))
    u, v = common.chart_position(common.canvas_point(x, y, cells.lonlat), chart.transform)
    u, v = np.floor(u / CELL).astype(int), np.floor(v / CELL).astype(int)
    inside = (u >= 0) & (u < empty.shape[1]) & (v >= 0) & (v < empty.shape[0])
    there = np.zeros(cells.shape, bool)
    there[inside] = (first | second)[v[inside], u[inside]]
    expected = np.pad(there, ((0, 0), (1, 1)), mode="wrap" if grid.wraps else "constant")
    expected = ndimage.binary_dilation(expected, np.ones((3, 3)))[:, 1:-1]
    assert 20 < expected.sum() < 200
    assert np.array_equal(found, expected)
    assert np.array_equal(SingleSource(first, second).finer().on_canvas(chart.finer(), cells), expected)
    assert not SingleSource(empty, empty).on_canvas(chart, cells).any()


LONLAT = (-np.pi, CANVAS.lonlat[1], np.pi / 2 - 90 * CANVAS.lonlat[3], CANVAS.lonlat[3])


@pytest.mark.parametrize("longitude", [0.0, *np.linspace(2.8, 3.5, 9)])
def test_cells_of_the_canvas_are_told_by_what_they_show(longitude: float) -> None:
    """Of a canvas that is larger than its working grid and whose rows begin below its top, across its border
    as well."""
    grid = replace(CANVAS, region=Box(0, 225, 1800, 675), height=180, poles=0, lonlat=LONLAT)
    check_on_canvas(grid, int(360 + longitude / grid.lonlat[1]) % 720)


def test_cells_are_those_of_a_region_of_the_canvas() -> None:
    region, lonlat = Box(500, 225, 1250, 675), (0.1, *LONLAT[1:])
    check_on_canvas(Grid(region, 300, 180, False, 0, lonlat, 1800), 170)


def test_around_the_canvas_every_cell_has_one_of_the_chart() -> None:
    chart = CHARTS[True]
    shape = (chart.height + 1) // CELL, (chart.width + 1) // CELL
    everywhere = SingleSource(np.ones(shape, bool), np.zeros(shape, bool))
    found = everywhere.on_canvas(chart, CANVAS.resized(90, 45))
    assert found[20:25].all() and not found[:5].any() and not found[-5:].any()


@pytest.mark.parametrize("move", [-40, 40])
def test_a_control_point_confirms_flow_beyond_a_chart_of_a_cylinder(move: int) -> None:
    """Which does not wrap, while places do."""
    grid = plane(800, 200, wraps=True)
    overlap = np.zeros(grid.shape, bool)
    overlap[:, 300:400] = True
    chart = pair_chart(overlap, grid, grid)
    there = np.full((chart.height, chart.width, 2), (move, 0), np.float32)
    views = (View(*np.ones((2, chart.height, chart.width), np.float32)),) * 2
    found = CellFlow.of(chart, (there, -there), views, 0)
    things = np.ones(found.shown.shape, np.int32)
    start = 300.0 if move < 0 else 400.0
    starts, ends, wrong = (
        chart.positions(grid.points(np.array([(start + by, 100.0)]))) for by in (0, move, -move)
    )
    assert found.confirmed(things, (starts, ends)).tolist() == [1]
    assert found.confirmed(things, (starts, wrong)).tolist() == []


@pytest.mark.parametrize("wraps", [False, True])
def test_what_crosses_one_border_by_far_ends_within(wraps: bool) -> None:
    """Of a photo that ends at column 10 and one that begins at column 4: at a border lies what is up to two
    columns from where one photo alone is. Two cells may lie at the other border, and a seventh."""
    own, other = np.ones((60, 30), bool), np.ones((60, 30), bool)
    own[:, 10:], other[:, :4] = False, False
    for at_left, at_right, within in (
        (50, 0, True),
        (0, 50, True),
        (50, 9, True),
        (50, 10, False),
        (2, 2, True),
    ):
        things = np.zeros((60, 30), np.int32)
        things[:at_left, 5], things[:at_right, 8] = 2, 2
        for masks in ((own, other), (other, own)):
            assert ends_within([things], 4, masks, wraps).tolist() == [False, True, within, True]
            halves = [np.where(np.arange(30) < 7, things, 0), np.where(np.arange(30) >= 7, things, 0)]
            assert ends_within(halves, 4, masks, wraps)[2] == within
    things = np.zeros((60, 30), np.int32)
    things[:50, 29] = 1
    assert ends_within([things], 2, (own, other), wraps)[1] == (not wraps)

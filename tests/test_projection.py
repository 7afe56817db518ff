"""In what directions canvases show their places, against Hugin and against each other."""

from __future__ import annotations

import math

import numpy as np
import pytest
from grids import plane
from hypothesis import given, settings
from hypothesis import strategies as st

from hugin_abflow.chart import pair_chart
from hugin_abflow.grid import full_grid
from hugin_abflow.layer import Box, Canvas, Layer
from hugin_abflow.pano_trafo import map_places
from hugin_abflow.project import read_plan
from hugin_abflow.projection import EQUIRECTANGULAR, Projection

PROJECTIONS = {
    "rectilinear": 'f0 w501 h403 v110 n"TIFF_m"',
    "rectilinear, cropped": 'f0 w701 h403 v95 S31,601,101,333 n"TIFF_m"',
    "cylindrical": 'f1 w801 h203 v360 n"TIFF_m"',
    "cylindrical, part": 'f1 w401 h303 v150 n"TIFF_m"',
    "equirectangular": 'f2 w802 h401 v360 n"TIFF_m"',
    "fisheye": 'f3 w501 h403 v170 n"TIFF_m"',
    "stereographic": 'f4 w501 h403 v200 n"TIFF_m"',
    "Mercator": 'f5 w801 h303 v360 n"TIFF_m"',
}
UNKNOWN = (-1, 6, 7, 9, 12, 19)


@pytest.mark.parametrize("kind", PROJECTIONS)
def test_directions_are_hugins(make_project, pano_trafo, kind: str) -> None:
    """What a photo shows at a place is in the direction in which Hugin's whole sphere has it."""
    photo = [(0, x, y) for x in (20.5, 75.0, 101.0, 190.25) for y in (12.0, 75.0, 131.5)]
    found = []
    for stem, panorama in (("canvas", PROJECTIONS[kind]), ("sphere", 'f2 w4000 h2000 v360 n"TIFF_m"')):
        plan = read_plan(make_project(stem=stem, panorama=panorama, yaws=(17,)))
        canvas = plan.canvas
        view = Projection.of(canvas.projection, canvas.width, canvas.height, canvas.hfov)
        places = map_places(plan, photo)
        assert view and None not in places
        found.append(view.bearings(np.array(places, float) + 0.5))
    assert np.allclose(np.linalg.norm(found[0], axis=1), 1)
    assert np.degrees(np.arccos(np.clip((found[0] * found[1]).sum(1), -1, 1))).max() < 0.02


@pytest.mark.parametrize("projection", UNKNOWN)
def test_what_has_no_formula_here_is_unknown(projection: int) -> None:
    assert Projection.of(projection, 801, 401, 120.0) is None


@pytest.mark.parametrize(
    ("projection", "hfov"), [(0, 180.0), (0, 0.0), (2, 0.0), (4, 360.0), (1, -5.0), (5, math.nan)]
)
def test_a_field_of_view_that_cannot_be_is_unknown(projection: int, hfov: float) -> None:
    assert Projection.of(projection, 801, 401, hfov) is None


@settings(max_examples=60)
@given(
    projection=st.integers(0, 5),
    hfov=st.floats(5, 170),
    size=st.tuples(st.integers(2, 999), st.integers(2, 999)),
)
def test_the_centre_is_ahead_and_the_width_is_the_field_of_view(projection, hfov, size) -> None:
    width, height = size
    view = Projection.of(projection, width, height, hfov)
    middle, left, right, above = view.bearings(
        np.array(
            [[width / 2, height / 2], [0, height / 2], [width, height / 2], [width / 2, height / 2 - 1e-3]]
        )
    )
    assert np.allclose(middle, (0, 1, 0), atol=1e-6)
    assert math.degrees(math.acos(left @ middle)) == pytest.approx(hfov / 2)
    assert right[0] > 0 > left[0]
    assert above[2] > 0


@pytest.mark.parametrize("projection", range(6))
def test_pixels_at_the_centre_are_as_wide_as_said(projection: int) -> None:
    view = Projection.of(projection, 301, 201, 80.0).on_grid(0.5, 0.75, 11.0, 7.0)
    x, y = view.centre_x, view.centre_y
    step = view.bearings(np.array([[x, y], [x + 0.01, y], [x, y + 0.01]]))
    assert (x, y) == ((150.5 - 11) * 0.5, (100.5 - 7) * 0.75)
    assert np.linalg.norm(step[1] - step[0]) * view.focal_x == pytest.approx(0.01)
    assert np.linalg.norm(step[2] - step[0]) * view.focal_y == pytest.approx(0.01)


@pytest.mark.parametrize("coarse", [1, 2])
@pytest.mark.parametrize("projection", [0, 1, 3, 4, 5])
def test_a_chart_of_a_flat_canvas_shows_the_same_directions(projection: int, coarse: int) -> None:
    """A chart of a corner of a working canvas over two layers, which do not begin at the canvas's corner."""
    wraps = projection == 1
    canvas = Canvas(
        701, 403, Box(0, 0, 701, 403), wraps, hfov=360.0 if wraps else 97.0, projection=projection
    )
    pixels = np.zeros((211, 307, 4), np.uint8)
    layers = [Layer.from_array("one", pixels, 57, 31), Layer.from_array("other", pixels, 103, 75)]
    full = full_grid(canvas, layers)
    grid = full.resized(237, 141)
    mask = np.zeros((47, 79), bool)
    mask[20:40, 30:60] = True
    chart = pair_chart(mask, plane(79, 47), grid, coarse)
    places = np.random.default_rng(8).uniform((150, 100), (300, 200), (40, 2))
    expected = Projection.of(projection, 701, 403, canvas.hfov).bearings(places)
    assert np.allclose(chart.projection.bearings(chart.positions(grid.points(places))), expected, atol=1e-5)


def test_a_sphere_knows_its_directions_without_a_canvas() -> None:
    canvas = Canvas.sphere(402, 201)
    layer = Layer.from_array("all", np.zeros((201, 402, 4), np.uint8))
    grid = full_grid(canvas, [layer])
    mask = np.zeros((50, 100), bool)
    mask[10:20, 30:50] = True
    chart = pair_chart(mask, grid.resized(100, 50), grid)
    assert chart.projection.kind == EQUIRECTANGULAR
    assert pair_chart(mask, plane(100, 50), plane(402, 201)).projection is None

"""What is told of places that no layer covers."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from hugin_abflow.holes import Coverage, Hole, holes
from hugin_abflow.layer import Box, Canvas
from hugin_abflow.projection import Projection


def covered(*gaps: tuple[slice, slice]) -> np.ndarray:
    mask = np.ones((97, 181), bool)
    for gap in gaps:
        mask[gap] = False
    return mask


def told(canvas: Canvas, mask: np.ndarray, caplog: pytest.LogCaptureFixture, rows: int = 7) -> str:
    """What is said of a panorama of rows that come some at a time."""
    caplog.clear()
    coverage = Coverage(canvas)
    pixels = np.dstack([np.zeros(mask.shape, np.uint16), mask.astype(np.uint16)])
    for row in range(0, len(pixels), rows):
        coverage.add(pixels[row : row + rows])
    with caplog.at_level(logging.WARNING):
        coverage.report()
    return caplog.text


def boxes(found: list[Hole]) -> list[tuple]:
    return [one[:4] for one in found]


def test_holes_are_found_where_they_are() -> None:
    found = holes(covered(np.s_[20:40, 31:60], np.s_[60:71, 90:99]), wraps=False)
    assert boxes(found) == [(31, 20, 60, 40), (90, 60, 99, 71)]
    assert [one.size for one in found] == [18 * 27, 9 * 7]


@pytest.mark.parametrize(
    "gap",
    [np.s_[:30, 40:60], np.s_[80:, 40:60], np.s_[20:40, :9], np.s_[20:40, 160:], np.s_[20:40, 40:42]],
)
def test_no_hole_is_what_reaches_the_border_or_is_tiny(gap: tuple) -> None:
    assert not holes(covered(gap), wraps=False)


def test_a_slit_is_no_hole_however_it_runs() -> None:
    """Nor is it, with its box, larger than a hole beside it."""
    mask = covered(np.s_[10:20, 20:30])
    np.fill_diagonal(mask[20:80, 60:120], False)
    assert boxes(holes(mask, wraps=False)) == [(20, 10, 30, 20)]


def test_a_hole_across_the_border_of_columns_that_wrap_is_one() -> None:
    gap = covered(np.s_[20:40, :10], np.s_[20:40, 170:])
    assert not holes(gap, wraps=False)
    assert boxes(holes(gap, wraps=True)) == [(170, 20, 191, 40)]
    assert boxes(holes(covered(np.s_[20:40, 50:80]), wraps=True)) == [(50, 20, 80, 40)]
    for left, right, found in ((0, 9, [181]), (1, 9, [1]), (172, 181, [172])):
        assert [one.left for one in holes(covered(np.s_[20:40, left:right]), wraps=True)] == found
    assert not holes(covered(np.s_[20:40]), wraps=True)  # all around: two panoramas


@pytest.mark.parametrize("rows", [1, 7, 400])
def test_the_largest_is_told_in_pixels_of_the_canvas(caplog: pytest.LogCaptureFixture, rows: int) -> None:
    """Of a panorama of which every third pixel is looked at, whatever rows come at a time."""
    canvas = Canvas(5000, 2000, Box(100, 200, 3301, 1791))
    mask = np.ones((1591, 3201), bool)
    assert not told(canvas, mask, caplog, rows)
    mask[1260:1380, 2700:3000] = mask[200:230, 2000:2090] = False
    text = told(canvas, mask, caplog, rows)
    assert "2 holes, the largest of about 300 x 120 px at (2800, 1460) of the canvas" in text
    mask[1200:, 2600:] = False
    assert "a hole of about 90 x 30 px at (2101, 401)" in told(canvas, mask, caplog, rows)


def test_nothing_is_told_of_the_ground_below_a_tripod(caplog: pytest.LogCaptureFixture) -> None:
    canvas, mask = Canvas.sphere(180, 90), np.ones((90, 180), bool)
    mask[80:] = False
    assert not told(canvas, mask, caplog)
    mask[40:60, :9] = mask[40:60, 171:] = False
    assert "a hole of about 18 x 20 px at (171, 40)" in told(canvas, mask, caplog)
    mask[40:60, 171:] = True
    assert "a hole of about 9 x 20 px at (0, 40)" in told(canvas, mask, caplog)
    mask[:] = False
    assert "wholly transparent" in told(canvas, mask, caplog)


@pytest.mark.parametrize(("projection", "hfov"), [(4, 300.0), (3, 360.0)], ids=["planet", "fisheye"])
def test_nor_where_the_ground_is_within(
    caplog: pytest.LogCaptureFixture, projection: int, hfov: float
) -> None:
    """A level camera: straight down is below the middle. Elsewhere it is a hole."""
    canvas = Canvas(400, 400, Box(0, 0, 400, 400), hfov=hfov, projection=projection)
    seen = Projection.of(projection, 400, 400, hfov)
    y, x = np.mgrid[:400, :400] + 0.5
    up = seen.bearings(np.stack([x.ravel(), y.ravel()], 1))[:, 2].reshape(400, 400)
    assert not told(canvas, abs(up) < 0.985, caplog)
    ahead = np.hypot(x - 200, y - 200) > 20
    assert "a hole of about 40 x 40 px at (180, 180)" in told(canvas, ahead, caplog)

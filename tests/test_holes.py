"""What is told of places that no layer covers."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from hugin_abflow.holes import Coverage, holes
from hugin_abflow.layer import Box, Canvas


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


def test_holes_are_found_where_they_are() -> None:
    found = holes(covered(np.s_[20:40, 31:60], np.s_[60:71, 90:99]), wraps=False)
    assert found.tolist() == [[31, 20, 60, 40], [90, 60, 99, 71]]


@pytest.mark.parametrize(
    "gap",
    [np.s_[:30, 40:60], np.s_[80:, 40:60], np.s_[20:40, :9], np.s_[20:40, 160:], np.s_[20:40, 40:42]],
)
def test_no_hole_is_what_reaches_the_border_or_is_tiny(gap: tuple) -> None:
    assert not holes(covered(gap), wraps=False).size


def test_a_hole_across_the_border_of_columns_that_wrap_is_one() -> None:
    gap = covered(np.s_[20:40, :10], np.s_[20:40, 170:])
    assert not holes(gap, wraps=False).size
    assert holes(gap, wraps=True).tolist() == [[170, 20, 191, 40]]
    assert holes(covered(np.s_[20:40, 50:80]), wraps=True).tolist() == [[50, 20, 80, 40]]
    assert not holes(covered(np.s_[20:40]), wraps=True).size  # all around: two panoramas


@pytest.mark.parametrize("rows", [1, 7, 400])
def test_the_largest_is_told_in_pixels_of_the_canvas(caplog: pytest.LogCaptureFixture, rows: int) -> None:
    """Of a panorama of which every third pixel is looked at, whatever rows come at a time."""
    canvas = Canvas(5000, 900, Box(100, 200, 3301, 591))
    mask = np.ones((391, 3201), bool)
    assert not told(canvas, mask, caplog, rows)
    mask[60:180, 300:600] = mask[200:230, 2000:2090] = False
    text = told(canvas, mask, caplog, rows)
    assert "2 holes, the largest of about 300 x 120 px at (400, 260)" in text


def test_nothing_is_told_of_the_ground_below_a_tripod(caplog: pytest.LogCaptureFixture) -> None:
    canvas, mask = Canvas.sphere(180, 90), np.ones((90, 180), bool)
    mask[80:] = False
    assert not told(canvas, mask, caplog)
    mask[40:60, :9] = mask[40:60, 171:] = False
    assert "a hole of about 18 x 20 px at (171, 40)" in told(canvas, mask, caplog)
    mask[:] = False
    assert "wholly transparent" in told(canvas, mask, caplog)

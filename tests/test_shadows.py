"""Shadows that fall in one photo and not in another."""

from __future__ import annotations

import numpy as np
import pytest
from grids import plane
from pictures import masked, merged, one_device, pixel_places
from scipy import ndimage

from hugin_abflow import shadows
from hugin_abflow.gains import Difference, Measured
from hugin_abflow.grid import Grid
from hugin_abflow.layer import Canvas

COLUMNS, ROWS = 40, 21  # cells of the colour grid
PLACE = np.s_[6:14, 12:22]


def grid(wraps: bool = False) -> Grid:
    return plane(COLUMNS * 16, ROWS * 16, wraps).resized(COLUMNS, ROWS)


def found(
    differ: np.ndarray, level: np.ndarray, weight: float | np.ndarray = 1.0, wraps: bool = False
) -> np.ndarray:
    """Where shadows are, on the colour grid itself, of two layers that differ by so much everywhere."""
    colours = [differ] * 3 if differ.ndim == 2 else list(np.moveaxis(differ, -1, 0))
    values = np.dstack([*colours, np.broadcast_to(weight, level.shape)])
    difference = Difference(0, 1, values, np.zeros_like(values), np.ones_like(level), level)
    inside = np.ones((2, ROWS, COLUMNS), bool)
    mask = shadows.find(Measured(grid(wraps), inside, 1.0, (difference,)), grid(wraps))
    return np.zeros((ROWS, COLUMNS), bool) if mask is None else mask


def scene(jump: float, level: float, soft: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """What layers differ by, with noise and a slope of exposure, and by `jump` more in PLACE, where both
    together change by `level`.
    """
    y, x = np.mgrid[:ROWS, :COLUMNS]
    noise = np.random.default_rng(1).normal(0, 0.02, (2, ROWS, COLUMNS))
    place = np.zeros((ROWS, COLUMNS))
    place[PLACE] = 1
    place = ndimage.gaussian_filter(place, 4) if soft else place
    return noise[0] + 0.03 * x + jump * place, noise[1] + 0.02 * y + level * place


@pytest.mark.parametrize("jump", [-1.2, -0.5, 0.5, 1.2])
def test_the_shadow_in_one_layer_is_found(jump: float) -> None:
    """It makes both together darker by half of what they differ by, whichever is in the shade."""
    expected = np.zeros((ROWS, COLUMNS), bool)
    expected[5:15, 11:23] = True  # where it is even, and two cells around
    assert np.array_equal(found(*scene(jump, -abs(jump) / 2)), expected)


@pytest.mark.parametrize(
    ("jump", "level", "soft", "weight"),
    [
        (0.6, -2.0, False, 1.0),  # light that strays where both are dark
        (0.6, 1.0, False, 1.0),  # and a shoulder where both are bright
        (0.6, 0.3, False, 1.0),  # a lamp that one of them shows, and what is around that
        (-0.6, 0.3, False, 1.0),
        (0.2, -0.1, False, 1.0),  # hardly to be seen
        (0.6, -0.3, True, 1.0),  # soft: gains follow that
        (0.6, -0.3, False, 0.2),  # something else
        (0.0, -2.0, False, 1.0),
    ],
)
def test_what_is_no_shadow_is_none(jump: float, level: float, soft: bool, weight: float) -> None:
    assert not found(*scene(jump, level, soft), weight).any()


@pytest.mark.parametrize(("blue", "counts"), [(0.6, True), (0.2, False), (-1.0, False)])
def test_a_shadow_is_bluish_at_most(blue: float, counts: bool) -> None:
    """Of other colours is somebody himself. blue: how much it differs by, of the others."""
    differ, level = scene(0.9, -0.45)
    values = np.dstack([differ] * 3)
    values[..., 2] = scene(0.9 * blue, 0)[0]
    level -= (blue - 1) * 0.15 * (scene(1, 0)[0] - scene(0, 0)[0])
    assert found(values, level).any() == counts


def test_a_line_is_none() -> None:
    """The edge of a near thing that is a little off; and a place of few cells."""
    y, x = np.mgrid[:ROWS, :COLUMNS]
    for place in (np.abs(x - y - 5) < 2, (abs(x - 20) < 2) & (abs(y - 9) < 2)):
        assert not found(0.8 * place, -0.4 * place).any()


@pytest.mark.parametrize("columns", [12, 17])
def test_a_shadow_goes_on_across_the_border(columns: int) -> None:
    """Of a canvas that wraps, with the cells that its outline cuts: the same as elsewhere."""
    differ, level = scene(0.8, -0.4)
    differ -= 0.03 * np.arange(COLUMNS)  # of exposure nothing changes from column to column
    elsewhere = found(differ, level, wraps=True)
    turned = found(np.roll(differ, -columns, 1), np.roll(level, -columns, 1), wraps=True)
    assert elsewhere[5:15, 11:23].all() and elsewhere.sum() == 120
    assert np.array_equal(np.roll(turned, columns, 1), elsewhere)


def test_what_a_shadow_lies_in_is_none() -> None:
    """Neither where overlaps are in two pieces, nor where it crosses the smaller one."""
    y, x = np.mgrid[:ROWS, :COLUMNS]
    for shadow in ((abs(x - 33) < 3) & (abs(y - 9) < 4), abs(y - 12) < 5):
        differ, level = 0.8 * shadow, -0.4 * shadow
        mask = found(differ, level, np.where((x < 23) | (x > 26), 1.0, 0.0))
        assert mask[shadow & (x > 28) & (x < 38)].all()
        assert not mask[~ndimage.binary_dilation(shadow, np.ones((3, 3)), 2)].any()


@pytest.mark.usefixtures(one_device.__name__)
@pytest.mark.parametrize("who", [0, 1])
@pytest.mark.parametrize("soft", [0.7, 5.0])
def test_a_shadow_is_whole_or_absent(who: int, soft: float) -> None:
    """Of somebody who is not in the picture, on ground with a texture."""
    height, width = 317, 633
    y, x = pixel_places(height, width)
    noise = np.random.default_rng(2).standard_normal((height, width))
    ground = 0.55 + 0.04 * sum(ndimage.gaussian_filter(noise, s) * s for s in (2, 9))
    body = (((y - 170) / 85) ** 2 + ((x - 320) / 65) ** 2 < 1).astype(float)
    shade = 0.45 ** (ndimage.gaussian_filter(body, soft) / 2.2)
    photos = [ground, ground]
    photos[who] = ground * shade
    stored = [np.rint(255 * np.dstack([one] * 3 + [np.ones_like(one)])).astype(np.uint8) for one in photos]
    layers = [masked(stored[0], x < 460), masked(stored[1], x >= 180)]
    result = merged(layers, Canvas.plane(width, height), seam=True)[..., 0] / 255
    off = [np.abs(ndimage.gaussian_filter(result - one, 3)) for one in (ground, ground * shade)]
    assert min(one.max() for one in off) < 0.03
    assert max(one.max() for one in off) > 0.12

"""What the comparison of two layers tells of what both show."""

from __future__ import annotations

import numpy as np
import pytest
from grids import plane
from pictures import masked, merged, one_device, pixel_places
from scipy import ndimage

from hugin_abflow import alignment, comparison
from hugin_abflow.layer import Canvas

# Cells of the seam grid across and down; of so many px; each with four blocks of as many samples.
COLUMNS, ROWS, CELL = 60, 40, 8


def compared(a: np.ndarray, b: np.ndarray) -> comparison.Comparison:
    """As kernels/seam.cl compares two grey pictures of whole cells, of two samples to a px in x and in y."""
    cells = np.stack([a, b]).reshape(2, ROWS, CELL, COLUMNS, CELL).swapaxes(2, 3)
    blocks = (
        cells.reshape(2, ROWS, COLUMNS, CELL // 2, 2, CELL // 2, 2)
        .mean((-1, -3))
        .reshape(2, ROWS, COLUMNS, -1)
    )
    cells = cells.reshape(2, ROWS, COLUMNS, -1)
    found = np.ones((ROWS, COLUMNS, 10))
    found[comparison.MEAN] = (cells[0] - cells[1]).mean(-1, keepdims=True)
    found[comparison.SQUARE] = np.square(cells[0] - cells[1]).mean(-1)
    found[comparison.VARIANCES] = np.moveaxis(cells.var(-1), 0, -1)
    found[comparison.COARSE] = np.moveaxis(blocks.var(-1), 0, -1)
    found[comparison.COVARIANCE] = (blocks[0] * blocks[1]).mean(-1) - blocks[0].mean(-1) * blocks[1].mean(-1)
    return found


def linear(picture: np.ndarray) -> np.ndarray:
    return np.asarray(picture**2.2)


def screen(light: np.ndarray) -> np.ndarray:
    return np.asarray(light ** (1 / 2.2))


def rough(seed: int, contrast: float = 0.3) -> np.ndarray:
    """Rock, dark and bright: grey, (height, width) px."""
    noise = np.random.default_rng(seed).standard_normal((ROWS * CELL, COLUMNS * CELL))
    fine, broad = (ndimage.gaussian_filter(noise, sigma, mode="wrap") for sigma in (2.5, 20))
    shapes = fine / fine.std() + 3 * np.roll(broad, 50) / broad.std()
    return np.asarray(0.4 + contrast * np.clip(shapes / shapes.std() / 3, -1, 1))


def veil(strength: float = 0.2) -> np.ndarray:
    """Of light, strongest in the lower right corner, and weak in the upper left one."""
    y, x = np.ogrid[: ROWS * CELL, : COLUMNS * CELL]
    away = np.hypot((y / (ROWS * CELL)) - 1, (x / (COLUMNS * CELL)) - 1)
    return np.asarray(strength * np.exp(-((away / 0.7) ** 2)))


def told(a: np.ndarray, b: np.ndarray, wraps: bool = False) -> np.ndarray:
    cells = plane(COLUMNS * CELL, ROWS * CELL, wraps).resized(COLUMNS, ROWS)
    found = compared(a, b)
    return comparison.in_another_light(found, comparison.smoothed(found, cells), cells)


def test_light_that_strays_is_told_as_far_as_it_reaches() -> None:
    """In a sky without clouds beside it, too; where the camera is another one's by a little noise, too."""
    picture = rough(1)
    picture[:, : 20 * CELL] = 0.35  # it is weak there, and nothing but the rock tells what it is
    picture[: 12 * CELL, 30 * CELL :] = 0.5
    noise = np.random.default_rng(5).normal(0, 0.008, picture.shape)
    lit = screen(linear(picture) + veil())
    for first, second in ((picture, lit + noise), (lit, picture + noise)):
        found = told(first, second)
        assert np.abs(first - second)[-80:, -80:].mean() > 0.15
        assert found[16:, 24:].all() and found[:10, 34:].all()


@pytest.mark.parametrize("soft", [1.0, 6.0])
def test_a_shadow_is_none(soft: float) -> None:
    """Its edge is in one layer alone; flat ground shows little besides."""
    y, x = np.ogrid[: ROWS * CELL, : COLUMNS * CELL]
    inside = ((y - 160) / 110) ** 2 + ((x - 240) / 150) ** 2 < 1
    shade = 1 - 0.6 * ndimage.gaussian_filter(inside.astype(float), soft)
    picture = rough(2, contrast=0.06) + 0.2
    shaded = screen(linear(picture) * shade)
    assert np.abs(picture - shaded)[160, 200:280].mean() > 0.15
    assert not told(picture, shaded).any()


def test_something_else_is_none() -> None:
    """Somebody who is textured himself; and all that is around him, where light strays, is."""
    picture = rough(3)
    person = np.s_[10 * CELL : 30 * CELL, 8 * CELL : 16 * CELL]
    somebody = picture.copy()
    somebody[person] = rough(4)[person] + 0.25
    assert not told(picture, somebody).any()
    found = told(picture, screen(linear(somebody) + veil()))
    assert found[18:, 40:].all() and not found[12:28, 10:14].any()


def test_little_is_none() -> None:
    """Something bright of nine cells; and what differs by less than regions need."""
    picture = rough(3)
    spot = picture.copy()
    spot[20 * CELL : 23 * CELL, 20 * CELL : 23 * CELL] += 0.3
    assert not told(picture, spot).any()
    assert not told(picture, screen(linear(picture) + veil(0.02))).any()


def test_light_strays_across_the_border() -> None:
    """Of a canvas that wraps: the same wherever its border is."""
    picture = rough(6)
    lit = screen(linear(picture) + np.maximum(veil(), veil()[:, ::-1]))
    found = told(picture, lit, wraps=True)
    assert found[20:, :20].mean() > 0.95 and found[20:, 40:].mean() > 0.95
    for shift in (1, 29):
        turned = (np.roll(one, shift * CELL, 1) for one in (picture, lit))
        assert np.array_equal(np.roll(told(*turned, wraps=True), -shift, 1), found)


@pytest.mark.usefixtures(one_device.__name__)
def test_a_photo_with_stray_light_leaves_no_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """No layer is taken whole, and brightness changes over more slowly than light strays."""
    height, width = ROWS * CELL, COLUMNS * CELL
    canvas, (y, x) = Canvas.plane(width, height), pixel_places(height, width)
    light = 0.35 * np.exp(-(((x - 240) / 100) ** 2) - (y / 100) ** 2)
    grey = rough(1)
    lit = screen(linear(grey) + light)
    photos = [np.dstack([one] * 3 + [np.ones_like(grey)]) for one in (grey, lit)]
    photos = [np.rint(255 * one).astype(np.uint8) for one in photos]
    layers = [masked(photos[0], x < 340), masked(photos[1], x >= 140)]
    aligned, align = [], alignment.align
    monkeypatch.setattr(alignment, "align", lambda *its: aligned.append(align(*its)) or aligned[-1])
    result = merged(layers, canvas, seam=True)
    assert aligned[0].whole is None
    more, its = (ndimage.gaussian_filter(one - 255 * grey, 8) for one in (result[..., 0], 255 * lit))
    slopes = [np.abs(np.diff(one, axis=1)).max() for one in (more, its)]
    assert slopes[0] < 0.8 * slopes[1]


def test_few_cells_tell_of_sharpness_as_all_do() -> None:
    """Whether a photo is out of focus, or shaken, is told by cells that touch if they are many, else by all
    such of both layers.
    """
    cells = plane(480, 320).resized(60, 40)

    def unrelated(*slopes: tuple[int, float]) -> list[bool]:
        """Of squares of so many cells whose smoother layer has so much in common with the other."""
        found = np.zeros((40, 60, 10))
        for k, (side, slope) in enumerate(slopes):
            variances, coarse = (0.0095, 0.0015), (0.005, 0.001)
            square = sum(variances) - 2 * slope * variances[1]
            found[2 : 2 + side, 12 * k : 12 * k + side] = (
                0, 0, 0, square, *variances, *coarse, slope * coarse[1], 1,
            )  # fmt: skip
        told = comparison.unrelated(found, cells)
        squares = [told[2 : 2 + side, 12 * k : 12 * k + side] for k, (side, _) in enumerate(slopes)]
        assert all(one.all() == one.any() for one in squares)
        return [bool(one.any()) for one in squares]

    assert unrelated((8, 0.1), (8, 0.9)) == [True, False]
    assert unrelated((7, 0.1), (7, 0.9), (6, 0.2)) == [True] * 3
    assert unrelated((3, 0.1), (7, 0.9), (7, 0.95)) == [False] * 3
    assert unrelated((3, 0.9), (8, 0.1), (8, 0.8)) == [True, True, False]

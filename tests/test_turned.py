"""A canvas of 360 degrees that is turned gives the turned panorama: its border is none."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.merge import merge_layers
from hugin_abflow.settings import Settings

WIDTH, HEIGHT, COUNT = 1024, 256, 4


def photos(turn: int) -> list[Layer]:
    """Four photos around, each a little higher and brighter than the last one; somebody in every other."""
    random = np.random.default_rng(1)
    wall = sum(
        share * ndimage.gaussian_filter(random.random((HEIGHT, WIDTH, 3)), (sigma, sigma, 0), mode="wrap")
        for sigma, share in ((3, 1.0), (12, 1.5))
    )
    wall = (wall - wall.min()) / np.ptp(wall)
    row, column = np.indices((HEIGHT, WIDTH))
    layers = []
    for k in range(COUNT):
        away = (column - (k + 0.5) * WIDTH / COUNT + WIDTH / 2) % WIDTH - WIDTH / 2
        picture = np.minimum(np.roll(wall, (k % 3, 3 * k % 5), (0, 1)) * (1.0 + 0.1 * k), 1)
        if k % 2 == 0:
            picture[(np.abs(away - 128 + 10 * k) < 25) & (np.abs(row - 120) < 60)] = 0.9, 0.1, 0.1
        pixels = np.dstack([picture, np.abs(away) < 0.72 * WIDTH / COUNT]).astype(np.float32)
        layers.append(Layer.from_array(f"layer{k}", np.roll(pixels, turn, 1)))
    return layers


@pytest.mark.parametrize("chosen", [{}, {"exposure": False}, {"flow": False}])
def test_a_canvas_that_is_turned_gives_the_turned_panorama(chosen: dict[str, bool]) -> None:
    """By a quarter, which all grids divide."""
    canvas, settings = Canvas.plane(WIDTH, HEIGHT, wraps=True), Settings(**chosen)
    before, after = (merge_layers(photos(turn), canvas, settings) for turn in (0, WIDTH // 4))
    assert before[..., :3].std() > 0.1 and (before[..., 3] == 1).all()
    assert np.abs(np.roll(before, WIDTH // 4, 1) - after).max() < 1e-3

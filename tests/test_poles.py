"""Straight up and down: full spheres come out whole where many layers meet, and where a patch was put in.

The scene is a ball, seen from inside by cameras that are off its centre: what every camera sees, and every
place between them, is known exactly.
"""

from __future__ import annotations

import sys
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from pictures import masked, merged, one_device
from scipy import ndimage

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from hugin_abflow import joint
from hugin_abflow import merge as pipeline
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.opencl import Device
from sample_projects.lens import canvas_points, cap_directions, equirect_directions

pytestmark = pytest.mark.usefixtures(one_device.__name__)

WIDTH = 512
CANVAS = Canvas.sphere(WIDTH, WIDTH // 2)
ROWS, COLUMNS = np.mgrid[0 : WIDTH // 2, 0:WIDTH] + 0.5
CANVAS_DIRECTIONS = equirect_directions(COLUMNS, ROWS, WIDTH)
OFF = 0.06  # of the ball's radius, from its centre to each camera: 7 px between opposite ones
VIEW, RADIUS = 120, 40.0  # px and degrees of a view straight up or down
PATCH = 11  # px
# The least difference of a patch from what is seen from any place between the cameras, in levels. A pixel off
# is some 8 levels; flow is right to a quarter of it, and geometry changes over within a patch.
WORST, MEAN = 10.0, 4.0


def colours(camera: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """What a camera inside the ball sees in unit directions (..., 3): levels (..., 3)."""
    along = directions @ camera
    away = np.sqrt(along**2 + 1 - camera @ camera) - along
    place = camera + away[..., None] * directions
    waves = np.random.default_rng(5).normal(size=(3, 14, 3)) * 9
    phases = np.random.default_rng(6).uniform(0, 2 * np.pi, (3, 14))
    seen = [np.sin(place @ wave.T + phase).sum(-1) for wave, phase in zip(waves, phases, strict=True)]
    return np.clip(128 + 16 * np.stack(seen, -1), 1, 255)


def layer(camera: np.ndarray, covered: np.ndarray) -> Layer:
    picture = np.full((*CANVAS_DIRECTIONS.shape[:2], 4), 255, np.uint8)
    picture[..., :3] = np.rint(colours(camera, CANVAS_DIRECTIONS))
    return masked(picture, covered)


def fisheyes() -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Four that look around, 208 degrees each: all see both poles. Their places, and masks."""
    ahead = [np.array([np.sin(a), np.cos(a), 0.0]) for a in np.radians([10, 100, 190, 280])]
    return [OFF * a for a in ahead], [CANVAS_DIRECTIONS @ a > np.cos(np.radians(104)) for a in ahead]


def view(picture: np.ndarray, south: bool) -> tuple[np.ndarray, np.ndarray]:
    """The azimuthal view of a pole (VIEW, VIEW, 3), and its directions."""
    y, x = np.mgrid[0:VIEW, 0:VIEW] + 0.5
    directions = cap_directions(x, y, VIEW, RADIUS, south)
    places = canvas_points(directions, WIDTH)
    # rows beyond a pole go on half a turn further
    beyond = np.roll(picture, WIDTH // 2, 1)[::-1]
    around = np.concatenate([beyond[-8:], picture, beyond[:8]])
    around = np.concatenate([around[:, -8:], around, around[:, :8]], 1).astype(float)
    at = [places[..., 1] - 0.5 + 8, places[..., 0] - 0.5 + 8]
    seen = [ndimage.map_coordinates(around[..., k], at, order=3) for k in range(3)]
    return np.stack(seen, -1), directions


def unlike(seen: np.ndarray, directions: np.ndarray, cameras: list[np.ndarray]) -> np.ndarray:
    """How far each patch is from what can be seen from some place between the cameras, levels RMS."""
    low, high = np.min(cameras, 0), np.max(cameras, 0)
    between = product(*(np.unique(np.linspace(a, b, 6)) for a, b in zip(low, high, strict=True)))
    least = np.full(seen.shape[:2], np.inf)
    for place in between:
        square = ((seen - colours(np.array(place), directions)) ** 2).mean(-1)
        least = np.minimum(least, ndimage.uniform_filter(square, PATCH))
    half = PATCH // 2
    return np.sqrt(least[half:-half, half:-half])


def polar_faults(picture: np.ndarray, cameras: list[np.ndarray]) -> np.ndarray:
    """`unlike` of both poles' views."""
    return np.stack([unlike(*view(picture, south), cameras) for south in (False, True)])


def four() -> tuple[list[Layer], list[np.ndarray]]:
    """Layers of the four fisheyes, and where they were."""
    cameras, masks = fisheyes()
    assert all(mask[0].all() and mask[-1].all() for mask in masks)
    return [layer(camera, mask) for camera, mask in zip(cameras, masks, strict=True)], cameras


@pytest.fixture(scope="module")
def whole(device: Device) -> np.ndarray:
    """The four fisheyes merged."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "kept_device", lambda *wanted: device)
        return merged(four()[0], CANVAS)


def test_four_fisheyes_meet_without_break_pinch_or_star(whole: np.ndarray) -> None:
    faults = polar_faults(whole, four()[1])
    assert faults.max() < WORST and faults.mean() < MEAN
    assert (whole[..., 3] == 255).all()


def test_a_wedge_that_is_off_would_be_seen(whole: np.ndarray) -> None:
    """The check above can fail: a sixteenth of the sky turned by two thirds of its width."""
    broken = whole.copy()
    broken[:40, 100:132] = np.roll(whole, 20, 1)[:40, 100:132]
    assert polar_faults(broken, four()[1])[0].max() > 2 * WORST


def test_without_flow_it_would_double(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(joint.pairflow, "solve", lambda *arguments: ([], [], []))
    faults = polar_faults(merged(four()[0], CANVAS, seam=False), four()[1])
    assert faults.max() > 1.3 * WORST


def with_patch() -> tuple[list[Layer], list[np.ndarray]]:
    """The four, masked where the tripod was, and a photo of the ground from beside it."""
    cameras, masks = fisheyes()
    down = -CANVAS_DIRECTIONS[..., 2]
    masks = [mask & (down < np.cos(np.radians(18))) for mask in masks]
    cameras.append(np.array([0.05, -0.02, -0.03]))
    masks.append(down > np.cos(np.radians(34)))
    return [layer(camera, mask) for camera, mask in zip(cameras, masks, strict=True)], cameras


def test_a_nadir_patch_fits_in() -> None:
    """Seen from straight above; and where the patch is alone it is copied as it is."""
    layers, cameras = with_patch()
    result = merged(layers, CANVAS, exposure=False)
    faults = unlike(*view(result, True), cameras)
    assert faults.max() < WORST and faults.mean() < MEAN
    alone = -CANVAS_DIRECTIONS[..., 2] > np.cos(np.radians(17))
    assert alone.sum() > 5000
    np.testing.assert_array_equal(
        result[alone][:, :3], np.rint(colours(cameras[-1], CANVAS_DIRECTIONS[alone])).astype(np.uint8)
    )

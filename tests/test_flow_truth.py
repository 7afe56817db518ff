"""Flow of scenes whose motion is known: none, whole and part pixels, across borders, exposure, masks."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from grids import patches
from reference import common
from scipy import ndimage

from hugin_abflow import flow
from hugin_abflow.opencl import Device
from hugin_abflow.pyramid import Level

Scene = Callable[[np.ndarray, np.ndarray], np.ndarray]


def scene(seed: int, period: float) -> Scene:
    """A texture of many waves at all scales, brightness 0.05 to 1, defined at any position; columns repeat
    after `period`."""
    random = np.random.default_rng(seed)
    turns = random.integers(-28, 29, 90)
    down = random.normal(size=90) * 0.35
    phases = random.random(90) * 2 * np.pi
    strength = 1 / (0.1 + np.hypot(turns * 2 * np.pi / period, down))

    def brightness(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        total = np.zeros(np.broadcast(x, y).shape)
        for turn, v, phase, a in zip(turns, down, phases, strength, strict=True):
            total += a * np.sin(2 * np.pi * turn / period * x + v * y + phase)
        return 0.5 + 0.45 * np.tanh(total / (2 * np.sqrt((strength**2).sum() / 2)))

    return brightness


def level(device: Device, image: np.ndarray, mask: np.ndarray | None = None, wraps: bool = False) -> Level:
    mask = np.ones_like(image) if mask is None else mask
    return Level(
        device.upload((image * mask).astype(np.float32)), device.upload(mask.astype(np.float32)), wraps
    )


def log(brightness: np.ndarray) -> np.ndarray:
    return np.log(brightness + 0.05)


WIDTH, HEIGHT = 203, 117


def shifted(
    seed: int, by: tuple[float, float], width: int = WIDTH, wraps: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Brightness of a, and of b in which everything is moved by `by`."""
    view = scene(seed, float(width) if wraps else 211.0)
    x, y = common.pixels(width, HEIGHT)
    return view(x + 0.5, y + 0.5), view(x + 0.5 - by[0], y + 0.5 - by[1])


def found(device: Device, a: Level, b: Level) -> tuple[np.ndarray, np.ndarray]:
    forward, backward = flow.pair_flow(device, a, b)
    return forward.get().astype(np.float64), backward.get().astype(np.float64)


@pytest.mark.parametrize("wraps", [False, True])
def test_no_motion_is_exactly_zero(device: Device, wraps: bool) -> None:
    """Also with a ragged mask, if both have it."""
    a, _ = shifted(0, (0, 0), 256)
    for mask in (None, patches(1, 256, HEIGHT, 0.8, 20)):
        same = level(device, log(a), mask, wraps)
        for field in found(device, same, same):
            assert not field.any()


@pytest.mark.parametrize("by", [(7, 0), (-7, 0), (0, 7), (0, -7), (7, -7)])
def test_a_layer_moved_by_seven_pixels_gives_seven(device: Device, by: tuple[int, int]) -> None:
    """Everywhere, also at the border beyond which b shows nothing of what a does."""
    a, b = shifted(2, by)
    forward, backward = found(device, level(device, log(a)), level(device, log(b)))
    off = np.linalg.norm(forward - by, axis=-1), np.linalg.norm(backward + by, axis=-1)
    for error in off:
        assert np.median(error) < 0.02
        assert np.quantile(error, 0.97) < 0.08
        assert error.max() < 0.3


@pytest.mark.parametrize("by", [(0.25, 0), (0, -0.5), (1.7, 0.4), (-3.3, 2.6)])
def test_parts_of_a_pixel_are_found(device: Device, by: tuple[float, float]) -> None:
    a, b = shifted(3, by)
    forward, backward = found(device, level(device, log(a)), level(device, log(b)))
    for error in (np.linalg.norm(forward - by, axis=-1), np.linalg.norm(backward + by, axis=-1)):
        assert np.median(error) < 0.04
        assert np.quantile(error, 0.97) < 0.12
        assert error.max() < 0.4


@pytest.mark.parametrize("by", [(7, 0), (-5.5, 2)])
def test_motion_across_the_border_of_a_cylinder(device: Device, by: tuple[float, float]) -> None:
    """No column is worse than another, and turning the cylinder turns the flow."""
    a, b = shifted(4, by, 256, wraps=True)
    forward, _ = found(device, level(device, log(a), None, True), level(device, log(b), None, True))
    error = np.linalg.norm(forward - by, axis=-1)[16:-16]
    assert error.max() < 0.3
    assert error[:, [0, 1, 2, -3, -2, -1]].max() < 0.3
    turned = [level(device, log(np.roll(v, 64, 1)), None, True) for v in (a, b)]
    again, _ = found(device, *turned)
    assert np.allclose(np.roll(forward, 64, 1), again, atol=1e-4)


@pytest.mark.parametrize(("gain", "offset"), [(2.0, 0.0), (0.5, 0.0), (1.0, 0.03)])
def test_exposure_hardly_changes_flow(device: Device, gain: float, offset: float) -> None:
    """One stop more or less, or some haze."""
    a, b = shifted(5, (4.5, -2))
    forward, backward = found(device, level(device, log(a)), level(device, log(gain * b + offset)))
    for field, way in ((forward, (4.5, -2)), (backward, (-4.5, 2))):
        error = np.linalg.norm(field - way, axis=-1)[8:-8, 8:-8]
        assert np.median(error) < 0.06
        assert np.quantile(error, 0.97) < 0.15
        assert error.max() < 0.4


def test_vignetting_hardly_changes_flow(device: Device) -> None:
    a, b = shifted(6, (3, 2))
    x, y = common.pixels(WIDTH, HEIGHT)
    falling = 1 - 0.6 * ((x / WIDTH - 0.5) ** 2 + (y / HEIGHT - 0.5) ** 2) / 0.5
    forward, _ = found(
        device, level(device, log(a * falling)), level(device, log(b * falling[:, ::-1] ** 0.3))
    )
    error = np.linalg.norm(forward - (3, 2), axis=-1)[8:-8, 8:-8]
    assert np.median(error) < 0.1
    assert (error < 0.5).mean() > 0.95


def test_flow_goes_on_smoothly_beyond_the_mask(device: Device) -> None:
    """Known in the middle only: outside it is continued, without a step at the mask's rim."""
    by = (5.0, -3.0)
    a, b = shifted(7, by)
    x, y = common.pixels(WIDTH, HEIGHT)
    mask = (np.hypot((x - 100) / 1.6, y - 58) < 40).astype(np.float64)
    forward, backward = found(device, level(device, log(a), mask), level(device, log(b), mask))
    inner = ndimage.binary_erosion(mask, iterations=8)
    for field, way in ((forward, by), (backward, (-by[0], -by[1]))):
        error = np.linalg.norm(field - way, axis=-1)
        assert np.median(error[inner]) < 0.05
        assert error[mask == 0].max() < 2
        steps = [np.linalg.norm(np.diff(field, axis=i), axis=-1) for i in (0, 1)]
        assert max(step.max() for step in steps) < 0.6


def test_ragged_masks_do_not_show_in_flow(device: Device) -> None:
    """Each image has holes of its own; black in them would pull the flow towards their rims."""
    a, b = (log(v) for v in shifted(8, (3, 1)))
    masks = patches(9, WIDTH, HEIGHT, 0.8, 25), patches(10, WIDTH, HEIGHT, 0.8, 25)
    forward, _ = found(device, level(device, a, masks[0]), level(device, b, masks[1]))
    both = masks[0] * ndimage.shift(masks[1], (-1, -3), order=0) > 0
    error = np.linalg.norm(forward - (3, 1), axis=-1)
    assert 0.4 < both.mean() < 0.8
    assert np.median(error[both]) < 0.05
    assert np.quantile(error[ndimage.binary_erosion(both, iterations=2)], 0.97) < 0.3


def test_forward_and_backward_are_inverse(device: Device) -> None:
    """F_ab(q) + F_ba(q + F_ab(q)) is nothing, for a motion that changes from place to place."""
    view = scene(10, 211.0)
    x, y = common.pixels(WIDTH, HEIGHT)
    x, y = x + 0.5, y + 0.5
    dx, dy = 4 + 2 * np.sin(y / 30), 2 * np.cos(x / 40)
    a, b = log(view(x + dx, y + dy)), log(view(x, y))  # what a shows at q, b shows at q + (dx, dy)
    forward, backward = found(device, level(device, a), level(device, b))
    error = np.linalg.norm(forward - np.stack([dx, dy], -1), axis=-1)[8:-8, 8:-8]
    assert np.median(error) < 0.08
    assert np.quantile(error, 0.97) < 0.3
    there = [x - 0.5 + forward[..., 0], y - 0.5 + forward[..., 1]]
    back = np.stack(
        [ndimage.map_coordinates(backward[..., i], there[::-1], order=1, mode="nearest") for i in (0, 1)], -1
    )
    closed = np.linalg.norm(forward + back, axis=-1)[8:-8, 8:-8]
    assert np.median(closed) < 0.1
    assert np.quantile(closed, 0.97) < 0.3


def test_what_moved_alone_has_its_own_motion(device: Device) -> None:
    """A patch that moves against the rest: both motions are found, a few pixels from its edge."""
    back, front = scene(11, 211.0), scene(12, 211.0)
    x, y = common.pixels(WIDTH, HEIGHT)
    x, y = x + 0.5, y + 0.5

    def inside(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return (np.abs(u - 100) < 35) & (np.abs(v - 58) < 30)

    a = np.where(inside(x, y), front(x, y), back(x, y))
    b = np.where(inside(x - 4, y), front(x - 4, y), back(x + 2, y))
    forward, _ = found(device, level(device, log(a)), level(device, log(b)))
    patch = inside(x, y)
    core, rest = ndimage.binary_erosion(patch, iterations=6), ndimage.binary_erosion(~patch, iterations=10)
    assert (np.linalg.norm(forward - (4, 0), axis=-1)[core] < 0.5).mean() > 0.9
    assert (np.linalg.norm(forward - (-2, 0), axis=-1)[rest] < 0.5).mean() > 0.9


@pytest.mark.parametrize("wraps", [False, True])
def test_flow_of_half_the_resolution_is_refined(device: Device, wraps: bool) -> None:
    """Known to a few tenths of a pixel, it is found to a few hundredths of one half as large."""
    by, width = (1.6, -0.7), 202
    images = [level(device, log(one), wraps=wraps) for one in shifted(13, by, width, wraps)]
    random = np.random.default_rng(14)
    mode = "nearest", "wrap" if wraps else "nearest"
    coarse = []
    for way in (1, -1):
        off = np.stack([ndimage.gaussian_filter(random.normal(size=(59, 101)), 4, mode=mode) for _ in by], 2)
        off *= 0.3 / np.abs(off).max()
        coarse.append(device.upload((way * np.array(by) / 2 + off).astype(np.float32)))
    ways = flow.refine(device, *images, *coarse, flow.FlowParameters())
    for way, one in zip((1, -1), ways, strict=True):
        error = np.linalg.norm(one.get() - way * np.array(by), axis=-1)
        inside = error if wraps else error[:, 6:-6]
        assert np.median(inside[6:-6]) < 0.03
        assert (inside[6:-6] < 0.1).mean() > 0.97


def test_refined_flow_is_taken_over_from_beside(device: Device) -> None:
    """A strip of a board that moves by 14 px was given the flow of the wall behind: too far for warping."""
    back, front = scene(15, 211.0), scene(16, 211.0)
    x, y = common.pixels(WIDTH - 1, HEIGHT - 1)
    x, y = x + 0.5, y + 0.5

    def inside(u: np.ndarray) -> np.ndarray:
        return (np.abs(u - 90) < 50) & (np.abs(y - 58) < 45)

    images = [np.where(inside(x - by), front(x - by, y), back(x, y)) for by in (0, 14)]
    levels = [level(device, log(image)) for image in images]
    coarse = []
    for by, way in ((0, 1), (14, -1)):
        known = np.where(inside(x - by)[..., None], (14.0 * way, 0.0), (0.0, 0.0))
        known[:, 84 + by : 100 + by] = 0
        coarse.append(device.upload((known[::2, ::2] / 2).astype(np.float32)))
    forward, _ = flow.refine(device, *levels, *coarse, flow.FlowParameters())
    strip = ndimage.binary_erosion(inside(x), iterations=6) & (np.abs(x - 92) < 8)
    assert (np.linalg.norm(forward.get() - (14, 0), axis=-1)[strip] < 1).mean() > 0.9

"""A room and things in it, seen from two places: every point is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Array = np.ndarray

# Half the axes of the ellipsoid that is the room; the first photo is taken in its middle.
ROOM = np.array([5.0, 3.0, 2.0])


@dataclass(frozen=True)
class Thing:
    """What is so far away, seen within an angle of a direction, and takes a step between the photos."""

    middle: tuple[float, float, float]
    step: Array
    size: float = 0.12
    distance: float = 1.8

    def seen(self, camera: Array, rays: Array, second: bool) -> tuple[Array, Array]:
        """Its points where rays from a camera meet it, as they lay at first, and which rays do."""
        # as if it stood still and the camera had moved by as much less
        points = hit(np.full(3, self.distance), camera - self.step * second, rays)
        return points, np.arccos(np.clip(unit(points) @ unit(np.array(self.middle)), -1, 1)) < self.size


def unit(points: Array) -> Array:
    return points / np.linalg.norm(points, axis=-1, keepdims=True)


def hit(axes: Array, camera: Array, rays: Array) -> Array:
    """Where rays (..., 3) from within an ellipsoid around the origin meet it."""
    p, d = camera / axes, rays / axes
    a, b, c = (d * d).sum(-1), (d * p).sum(-1), (p * p).sum() - 1
    return camera + rays * ((np.sqrt(b * b - a * c) - b) / a)[..., None]


def pattern(rays: Array, seed: int, scale: float) -> Array:
    """Log brightness by direction, of waves of 9 to 20 px; scale: px per radian."""
    rng = np.random.default_rng(seed)
    waves = scale * 2 * np.pi / rng.uniform(9, 20, 9)[:, None] * unit(rng.normal(size=(9, 3)))
    return 0.25 * np.sin(rays @ waves.T + rng.uniform(0, 6, 9)).sum(-1)

"""Cameras as Hugin describes them, and views of a sphere, as rays.

Angles are degrees in Hugin's sense: yaw to the right, pitch up, roll clockwise seen from behind the camera.
World axes as in tracer.py: longitude 0 looks along +y, longitude 90 along +x, latitude 90 along +z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

RECTILINEAR, CIRCULAR_FISHEYE, FULL_FRAME_FISHEYE = 0, 2, 3  # i-line f


@dataclass(frozen=True)
class Camera:
    """One photo: an i-line and, what Hugin does not know, where the camera was.

    projection  i-line f: 0 rectilinear, 2 circular or 3 full-frame fisheye (both r = focal * angle).
    width, height  photo in pixels; hfov in degrees over the width.
    b           i-line b, the lens's barrel distortion (a and c are 0).
    circle      radius in pixels of the lens's image circle; 0: none.
    """

    centre: tuple[float, float, float]
    yaw: float
    pitch: float
    roll: float
    width: int
    height: int
    hfov: float
    projection: int = FULL_FRAME_FISHEYE
    b: float = 0.0
    circle: float = 0.0

    @property
    def focal(self) -> float:
        """Pixels per radian (fisheye) or at the tangent plane (rectilinear)."""
        half = np.radians(self.hfov) / 2
        return float(self.width / 2 / (np.tan(half) if self.projection == RECTILINEAR else half))

    def rotation(self) -> Floats:
        """(3, 3): camera axes (right, ahead, up) to world."""
        yaw, pitch, roll = np.radians([self.yaw, self.pitch, self.roll])
        cy, sy, cp, sp, cr, sr = (
            np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll),
        )  # fmt: skip
        turn = np.array([[cy, sy, 0], [-sy, cy, 0], [0, 0, 1]])
        lift = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
        lean = np.array([[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]])
        return np.asarray(turn @ lift @ lean)

    def directions(self, x: Floats, y: Floats) -> Floats:
        """(..., 3): where photo points look; (0, 0) is the photo's upper left corner."""
        dx, dy = x - self.width / 2, y - self.height / 2
        bent = np.hypot(dx, dy)
        radius = self._unbend(bent)
        angle = np.arctan(radius / self.focal) if self.projection == RECTILINEAR else radius / self.focal
        scale = np.sin(angle) / np.maximum(bent, 1e-12)
        local = np.stack([dx * scale, np.cos(angle), -dy * scale], axis=-1)
        return np.asarray(local @ self.rotation().T)

    def project(self, points: Floats) -> Floats:
        """(..., 2): photo coordinates of world directions (not positions); far outside: nan."""
        local = points @ self.rotation()
        flat = np.hypot(local[..., 0], local[..., 2])
        angle = np.arctan2(flat, local[..., 1])
        if self.projection == RECTILINEAR:
            radius = np.where(angle < np.radians(89), self.focal * np.tan(angle), np.nan)
        else:
            radius = self.focal * angle
        unit = min(self.width, self.height) / 2
        ratio = radius / unit
        # Hugin's polynomial takes the ideal radius to the photo's; beyond its maximum it folds back
        bent = radius * (self.b * ratio**2 + 1 - self.b)
        if self.b < 0:
            bent = np.where(3 * self.b * ratio**2 + 1 - self.b > 0, bent, np.nan)
        scale = bent / np.maximum(flat, 1e-12)
        return np.stack(
            [self.width / 2 + local[..., 0] * scale, self.height / 2 - local[..., 2] * scale], axis=-1
        )

    def _unbend(self, bent: Floats) -> Floats:
        """Ideal radius of a radius in the photo: the inverse of Hugin's polynomial, by Newton's method."""
        if self.b == 0.0:
            return bent
        unit = min(self.width, self.height) / 2
        target = bent / unit
        ratio = target.copy()
        for _ in range(8):
            value = self.b * ratio**3 + (1 - self.b) * ratio - target
            ratio -= value / (3 * self.b * ratio**2 + 1 - self.b)
        return np.asarray(ratio * unit)

    def rays(self) -> npt.NDArray[np.float32]:
        """(height, width, 3, 3) rays of all pixels, as `Tracer.look` takes them."""
        y, x = np.mgrid[0 : self.height, 0 : self.width] + 0.5
        centre = self.directions(x, y)
        right = self.directions(x + 0.5, y) - self.directions(x - 0.5, y)
        down = self.directions(x, y + 0.5) - self.directions(x, y - 0.5)
        return np.stack([centre, right, down], axis=-2).astype(np.float32)

    def covers(self, directions: Floats) -> npt.NDArray[np.bool_]:
        """Which directions the photo shows (nona takes a pixel whose centre falls inside the photo)."""
        at = self.project(directions)
        x, y = at[..., 0], at[..., 1]
        with np.errstate(invalid="ignore"):
            seen = (x >= 0.5) & (x <= self.width - 0.5) & (y >= 0.5) & (y <= self.height - 0.5)
            if self.circle:
                seen &= np.hypot(x - self.width / 2, y - self.height / 2) < self.circle
        return np.asarray(seen)


def equirect_directions(x: Floats, y: Floats, width: int) -> Floats:
    """(..., 3): unit directions of points of a 360 degree canvas, `width` pixels wide; corner (0, 0)."""
    longitude, latitude = (x / width - 0.5) * 2 * np.pi, (0.25 - y / width) * 2 * np.pi
    flat = np.cos(latitude)
    return np.stack([np.sin(longitude) * flat, np.cos(longitude) * flat, np.sin(latitude)], axis=-1)


def equirect_rays(width: int, top: int = 0, bottom: int | None = None) -> npt.NDArray[np.float32]:
    """(rows, width, 3, 3): rays of the rows `top` to `bottom` of a 360 degree canvas."""
    y, x = np.mgrid[top : width // 2 if bottom is None else bottom, 0:width] + 0.5
    centre = equirect_directions(x, y, width)
    right = equirect_directions(x + 0.5, y, width) - equirect_directions(x - 0.5, y, width)
    down = equirect_directions(x, y + 0.5, width) - equirect_directions(x, y - 0.5, width)
    return np.stack([centre, right, down], axis=-2).astype(np.float32)


def cap_directions(x: Floats, y: Floats, size: int, radius: float, south: bool) -> Floats:
    """(..., 3): azimuthal view of a pole, equidistant, `size` pixels for 2 x `radius` degrees."""
    dx, dy = (x / size - 0.5) * 2, (y / size - 0.5) * 2
    far = np.hypot(dx, dy)
    angle = np.radians(radius) * far
    scale = np.sin(angle) / np.maximum(far, 1e-12)
    up = -np.cos(angle) if south else np.cos(angle)
    return np.stack([dx * scale, dy * scale * (-1 if south else 1), up], axis=-1)


def cap_rays(size: int, radius: float, south: bool) -> npt.NDArray[np.float32]:
    """(size, size, 3, 3): rays of a `cap_directions` view."""
    y, x = np.mgrid[0:size, 0:size] + 0.5
    centre = cap_directions(x, y, size, radius, south)
    right = cap_directions(x + 0.5, y, size, radius, south) - cap_directions(x - 0.5, y, size, radius, south)
    down = cap_directions(x, y + 0.5, size, radius, south) - cap_directions(x, y - 0.5, size, radius, south)
    return np.stack([centre, right, down], axis=-2).astype(np.float32)


def canvas_points(directions: Floats, width: int) -> Floats:
    """(..., 2): inverse of equirect_directions: where unit directions fall on the canvas."""
    longitude = np.arctan2(directions[..., 0], directions[..., 1])
    latitude = np.arcsin(np.clip(directions[..., 2], -1, 1))
    return np.stack([(longitude / (2 * np.pi) + 0.5) * width, (0.25 - latitude / (2 * np.pi)) * width], -1)

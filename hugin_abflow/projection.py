"""Projections: from places on a panorama to directions, where a formula is known.

Formulas: Snyder, "Map Projections: A Working Manual", 1987 (cylindrical, Mercator,
stereographic); panorama tools call the central projection of a plane rectilinear, the cylinder with heights
as they are seen from its axis cylindrical, and an azimuthal equidistant one fisheye.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
_Index = npt.NDArray[np.intp] | slice

# Hugin's numbers (f of the p-line).
RECTILINEAR, CYLINDRICAL, EQUIRECTANGULAR, FISHEYE, STEREOGRAPHIC, MERCATOR = range(6)
_AZIMUTHAL = (RECTILINEAR, FISHEYE, STEREOGRAPHIC)


@dataclass(frozen=True)
class Projection:
    """A projection of directions onto a flat pixel grid.

    kind        one of those above.
    focal_x, focal_y    focal lengths: px per radian at the centre.
    centre_x, centre_y  px.
    """

    kind: int
    focal_x: float
    focal_y: float
    centre_x: float
    centre_y: float

    @classmethod
    def of(cls, kind: int, width: int, height: int, hfov: float) -> Projection | None:
        """That of a canvas (px, degrees); None for a kind or a field of view that is not known."""
        half = math.radians(hfov) / 2
        widest = {RECTILINEAR: math.pi / 2, STEREOGRAPHIC: math.pi}.get(kind, math.inf)
        if not RECTILINEAR <= kind <= MERCATOR or not 0 < half < widest:
            return None
        extent = {RECTILINEAR: math.tan(half), STEREOGRAPHIC: 2 * math.tan(half / 2)}.get(kind, half)
        focal = width / 2 / extent
        return cls(kind, focal, focal, width / 2, height / 2)

    def on_grid(self, scale_x: float, scale_y: float, left: float, top: float) -> Projection:
        """The same on a grid that begins at (left, top) and has so many px for each px in x and y."""
        return Projection(
            self.kind, self.focal_x * scale_x, self.focal_y * scale_y,
            (self.centre_x - left) * scale_x, (self.centre_y - top) * scale_y,
        )  # fmt: skip

    def bearings(self, places: Floats) -> Floats:
        """Unit vectors (n, 3) towards what places (n, 2) px show: right, ahead, up."""
        x, y = (places[:, 0] - self.centre_x) / self.focal_x, (self.centre_y - places[:, 1]) / self.focal_y
        if self.kind in _AZIMUTHAL:
            radius = np.hypot(x, y)
            angle = {
                RECTILINEAR: np.arctan(radius),
                FISHEYE: radius,
                STEREOGRAPHIC: 2 * np.arctan(radius / 2),
            }[self.kind]
            share = np.sin(angle) / np.maximum(radius, 1e-12)
            return np.stack([share * x, np.cos(angle), share * y], 1)
        latitudes = {
            CYLINDRICAL: np.arctan(y),
            EQUIRECTANGULAR: y,
            MERCATOR: np.arctan(np.sinh(y)),
        }[self.kind]
        return directions(x, latitudes)


def directions(
    longitudes: Floats, latitudes: Floats, column: _Index = slice(None), row: _Index = slice(None)
) -> Floats:
    """Unit vectors (n, 3) to places on a sphere, radians (kernels/common.cl): to longitudes and latitudes
    (n,), or, of places on a grid, to longitudes[column] and latitudes[row] (n,), whose sines are found once.
    """
    level = np.cos(latitudes)[row]
    east, ahead = np.sin(longitudes)[column], np.cos(longitudes)[column]
    return np.stack([level * east, level * ahead, np.sin(latitudes)[row]], 1)

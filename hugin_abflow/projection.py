"""In what directions a panorama shows its places, for projections of which a formula says so.

Formulas of the projections: Snyder, "Map Projections: A Working Manual", 1987 (cylindrical, Mercator,
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
class Eye:
    """From where a flat picture is seen.

    projection      one of those above.
    across, down    px for a radian, at the centre.
    x, y            the centre, px.
    """

    projection: int
    across: float
    down: float
    x: float
    y: float

    @classmethod
    def of(cls, projection: int, width: int, height: int, hfov: float) -> Eye | None:
        """Of a canvas, px and degrees; None for a projection or a field of view that is not known."""
        half = math.radians(hfov) / 2
        widest = {RECTILINEAR: math.pi / 2, STEREOGRAPHIC: math.pi}.get(projection, math.inf)
        if not RECTILINEAR <= projection <= MERCATOR or not 0 < half < widest:
            return None
        extent = {RECTILINEAR: math.tan(half), STEREOGRAPHIC: 2 * math.tan(half / 2)}.get(projection, half)
        focal = width / 2 / extent
        return cls(projection, focal, focal, width / 2, height / 2)

    def on(self, across: float, down: float, left: float, top: float) -> Eye:
        """The same on a grid of so many px per px in each direction, which begins at (left, top)."""
        return Eye(
            self.projection, self.across * across, self.down * down,
            (self.x - left) * across, (self.y - top) * down,
        )  # fmt: skip

    def bearings(self, places: Floats) -> Floats:
        """Unit vectors (n, 3) in which places (n, 2) px are seen: to the right, ahead, up."""
        x, y = (places[:, 0] - self.x) / self.across, (self.y - places[:, 1]) / self.down
        if self.projection in _AZIMUTHAL:
            radius = np.hypot(x, y)
            angle = {
                RECTILINEAR: np.arctan(radius),
                FISHEYE: radius,
                STEREOGRAPHIC: 2 * np.arctan(radius / 2),
            }[self.projection]
            share = np.sin(angle) / np.maximum(radius, 1e-12)
            return np.stack([share * x, np.cos(angle), share * y], 1)
        latitudes = {
            CYLINDRICAL: np.arctan(y),
            EQUIRECTANGULAR: y,
            MERCATOR: np.arctan(np.sinh(y)),
        }[self.projection]
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

"""Charts: the flat grids on which flow is found, one for each pair (kernels/chart.cl, formulas in common.cl).

On a sphere the overlap of two layers is a band or a patch anywhere, even over a pole. Its chart is an
equirectangular projection about an axis of its own, chosen so that the overlap lies along the chart's
equator: no pole is in it, and hardly any stretch. On a plane it is the canvas's own grid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from hugin_abflow.grid import Border, Grid, on_cells
from hugin_abflow.opencl import Device
from hugin_abflow.projection import EQUIRECTANGULAR, Projection, directions
from hugin_abflow.pyramid import Level
from hugin_abflow.working import WorkingLayer

# Chart pixels around the overlap, so that flow is smooth across its border.
_MARGIN = 16
# Widths of charts that wrap are multiples of this, so that they halve exactly seven times: flow.py halves
# them six times, which a shorter side of less than 1536 px asks for.
_WRAP_MULTIPLE = 128
# Pixels of a row that a work item takes: CHART_CHUNK of kernels/chart.cl.
_CHUNK = 4
# Brightness that is added before the logarithm: about the dark noise of a photo, full scale is 1.
_FLOOR = 0.05
# Squared extents of an overlap are alike if they differ by less than this share of the largest one: which way
# it reaches least or most is chance then.
_ALIKE = 0.02
# An overlap has no centre if the mean of its directions, unit vectors, is shorter than this across its axis:
# it goes all round.
_CENTRED = 0.02


@dataclass(frozen=True)
class Chart:
    """The flat grid of one pair.

    transform       from the scene to the grid: the 16 numbers of common.cl.
    width, height   px.
    wraps           whether columns are periodic.
    coarse          pixels of the working grid per pixel in x and y, 1 or 2.
    projection      from places to directions, on a sphere in axes of its own; None: not known.
    """

    transform: npt.NDArray[np.float32]
    width: int
    height: int
    wraps: bool
    coarse: int = 1
    projection: Projection | None = None

    def finer(self) -> Chart:
        """The same place, of a chart that is `coarse`, in pixels of half the size."""
        transform = self.transform.copy()
        transform[9:13] *= 2
        projection = self.projection and self.projection.on_grid(2, 2, 0, 0)
        width, height = 2 * self.width, 2 * self.height
        return replace(self, transform=transform, width=width, height=height, coarse=1, projection=projection)

    def circumference(self, grid: Grid) -> float:
        """The width of the whole canvas of `grid`, in px of the chart."""
        return grid.circumference * float(self.transform[9])

    @property
    def border(self) -> Border:
        """Grid as the kernels take it."""
        return Border(self.width, self.height, int(self.wraps))

    @property
    def spherical(self) -> bool:
        """Whether it is of a sphere."""
        return bool(self.transform[13])

    @property
    def period(self) -> float:
        """Px after which positions repeat, also beside a chart that does not wrap; 0: never."""
        if self.wraps:
            return float(self.width)
        around = 2 * math.pi if self.spherical else float(self.transform[14])
        return around * float(self.transform[9])

    def positions(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Chart positions (n, 2) of points (n, 3) in the scene; on the host what kernels do on the device."""
        t = self.transform.astype(np.float64)
        if self.spherical:
            x, y, z = t[:9].reshape(3, 3) @ points.T
            return np.stack(
                [np.arctan2(x, y) * t[9] + t[11], t[12] - np.arctan2(z, np.hypot(x, y)) * t[10]], 1
            )
        places = points[:, :2] * t[9:11] + t[11:13]
        if t[14]:  # the copy that lies on the chart
            places[:, 0] %= t[14] * t[9]
        return places


def widest_gap(columns: npt.NDArray[np.bool_]) -> tuple[int, int]:
    """The longest periodic run of False, where any is True: (first column after it, its length)."""
    used = np.flatnonzero(columns)
    gaps = np.diff(np.append(used, used[0] + columns.size)) - 1
    widest = int(np.argmax(gaps))
    return int(used[(widest + 1) % used.size]), int(gaps[widest])


def _plane(overlap: npt.NDArray[np.bool_], grid: Grid) -> Chart:
    """overlap: as fine as the chart, over the region of `grid`."""
    height, width = overlap.shape
    rows = np.flatnonzero(overlap.any(1))
    top, bottom = max(0, rows[0] - _MARGIN), min(height, rows[-1] + 1 + _MARGIN)
    transform = np.zeros(16, np.float32)
    transform[9:11] = width / grid.width, height / grid.height
    columns = np.logical_or.reduce(overlap, 0)
    if not grid.wraps:
        used = np.flatnonzero(columns)
        left, right = max(0, used[0] - _MARGIN), min(width, used[-1] + 1 + _MARGIN)
        transform[11:13] = -left, -top
        return Chart(transform, int(right - left), int(bottom - top), False)
    transform[14] = grid.width
    first, gap = widest_gap(columns)
    if gap > 2 * _MARGIN:
        transform[11:13] = _MARGIN - first, -top
        return Chart(transform, width - gap + 2 * _MARGIN, int(bottom - top), False)
    width = max(1, round(width / _WRAP_MULTIPLE)) * _WRAP_MULTIPLE
    transform[9], transform[12] = width / grid.width, -top
    return Chart(transform, width, int(bottom - top), True)


def _plane_projection(chart: Chart, grid: Grid) -> Projection | None:
    """The projection of a plane's chart."""
    scale_x, scale_y, left, top = chart.transform[9:13].astype(np.float64)
    scale_x, scale_y = scale_x * grid.width / grid.region.width, scale_y * grid.height / grid.region.height
    return grid.projection and grid.projection.on_grid(
        scale_x, scale_y, grid.region.left - left / scale_x, grid.region.top - top / scale_y
    )


def _axes(points: npt.NDArray[np.float64], weights: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Rows x, y, z of the chart's axes: z where the overlap reaches least, y at its centre."""
    scatter = (points * weights[:, None]).T @ points
    values, vectors = np.linalg.eigh(scatter)
    z = vectors[:, 0]
    if values[1] - values[0] < _ALIKE * values[2]:  # as wide as long: of all axes beside it the most upright
        free = 3 if values[2] - values[0] < _ALIKE * values[2] else 2
        upright = vectors[:, :free] @ vectors[2, :free]
        length = np.linalg.norm(upright)
        z = upright / length if length > 0.1 else z  # none is upright where it lies around a pole
    z = z * (1.0 if z[np.argmax(np.abs(z))] > 0 else -1.0)
    mean = points.T @ weights
    y = mean - z * (z @ mean)
    if np.linalg.norm(y) < _CENTRED * weights.sum():  # a ring has no centre
        y = vectors[:, 2] - z * (z @ vectors[:, 2])
    if np.linalg.norm(y) < 1e-6:
        y = np.array([0.0, 1.0, 0.0]) if abs(z[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
        y = y - z * (z @ y)
    y /= np.linalg.norm(y)
    return np.stack([np.cross(y, z), y, z])


def _sphere(overlap: npt.NDArray[np.bool_], mask_grid: Grid, scale: float) -> Chart:
    lon0, dlon = mask_grid.lonlat[:2]
    lon = lon0 + (np.arange(mask_grid.width, dtype=np.float64) + 0.5) * dlon
    rows, columns = np.nonzero(overlap)
    points = directions(lon, mask_grid.latitudes, columns, rows)
    axes = _axes(points, mask_grid.row_widths[rows])
    x, y, z = axes @ points.T
    chart_lon = np.arctan2(x, y)
    lowest, highest = (math.asin(min(max(end, -1.0), 1.0)) for end in (z.min(), z.max()))
    steps = 720
    margin = _MARGIN / scale + 2 * math.pi / steps
    used = np.zeros(steps, bool)
    used[((chart_lon / (2 * math.pi) + 0.5) * steps).astype(int) % steps] = True
    south = max(lowest - margin, -math.pi / 2)
    north = min(highest + margin, math.pi / 2)
    first, gap = widest_gap(used)
    wraps = gap * 2 * math.pi / steps < 2 * margin + 4 * math.pi / steps
    if wraps:
        width = max(1, round(2 * math.pi * scale / _WRAP_MULTIPLE)) * _WRAP_MULTIPLE
        across, middle = width / (2 * math.pi), 0.0
    else:
        span = (steps - gap) * 2 * math.pi / steps + 2 * margin
        width, across = math.ceil(span * scale), scale
        middle = (first / steps - 0.5) * 2 * math.pi + span / 2 - margin
    turn = np.array(
        [[math.cos(middle), -math.sin(middle), 0], [math.sin(middle), math.cos(middle), 0], [0, 0, 1]]
    )
    transform = np.zeros(16, np.float32)
    transform[:9] = (turn @ axes).ravel()
    transform[9:14] = across, scale, width / 2, north * scale, 1
    projection = Projection(EQUIRECTANGULAR, across, scale, width / 2, north * scale)
    return Chart(transform, width, math.ceil((north - south) * scale), wraps, projection=projection)


def pair_chart(overlap: npt.NDArray[np.bool_], mask_grid: Grid, grid: Grid, coarse: int = 1) -> Chart:
    """The chart for an overlap given as a mask on `mask_grid` (a grid over the same region as `grid`).

    It is as fine as the working grid, or half as fine if `coarse` is 2; the mask is not empty.
    """
    if grid.spherical:
        found = _sphere(overlap, mask_grid, 1 / (coarse * grid.lonlat[1]))
    else:
        height, width = (max(1, round(n / coarse)) for n in grid.shape)
        # all that it reaches into: a strip of a pixel may lie between those that are picked
        found = _plane(on_cells(overlap[None], mask_grid.resized(width, height), np.logical_or)[0], grid)
        found = replace(found, projection=_plane_projection(found, grid))
    return replace(found, coarse=coarse)


def sample(device: Device, layer: WorkingLayer, grid: Grid, chart: Chart) -> Level:
    """Log brightness of a layer on the chart, with its mask."""
    size = (chart.width, chart.height)
    chunks = (-(-chart.width // _CHUNK), chart.height)
    level = Level(device.empty(size[::-1]), device.empty(size[::-1]), chart.wraps)
    device.run(
        "chart", "chart_sample", chunks, layer.pixels, layer.box, grid.border, grid.lonlat,
        chart.transform, size, chart.coarse, _FLOOR, level.image, level.mask,
    )  # fmt: skip
    return level

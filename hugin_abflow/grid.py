"""Grids of pixels and of cells over the region that the layers cover, and what is asked of masks on them.

The region is the layers' common bounding box, or the canvas's whole width where it wraps. All grids cover it,
each with ratios of its own in x and y, so that edges coincide for any size.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from hugin_abflow.layer import Box, Canvas, Layer, bounding_box
from hugin_abflow.projection import Projection, directions
from hugin_abflow.settings import Settings

# Bounds of what kernels calculate with int, less some for rounding; only canvases longer than 30,000 px and
# very narrow get near them.
_LARGEST_PRODUCT = 0.99 * 2**31
_MOST_ROWS = 32_000

# The least `Grid.bounded_widths`, of a pixel's width at the equator: beside a pole rows are narrower, down to
# nothing.
_NARROWEST = 0.02

Place = tuple[int, int, int, int]  # left, top, width, height on a grid

_Kind = TypeVar("_Kind", bound=np.generic)


class Border(NamedTuple):
    """A grid's size and border rules, as the kernels take them (kernels/common.cl); poles: as `Grid` has."""

    width: int
    height: int
    wraps: int
    poles: int = 0

    @classmethod
    def of(cls, shape: tuple[int, ...], wraps: bool) -> Border:
        """Of an image of that shape, (height, width, ...), which has no poles."""
        height, width = shape[:2]
        return cls(width, height, int(wraps))

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), as kernels are run."""
        return self.width, self.height


@dataclass(frozen=True)
class Grid:
    """A pixel grid over the region.

    region      full-resolution canvas pixels that it covers.
    width, height    of the grid.
    wraps, poles     border rules (kernels/common.cl); poles: bit 0 at the top, bit 1 at the bottom.
    lonlat      (longitude of x = 0, radians per column, latitude of y = 0, radians per row); plane: zeros.
    canvas_width    of the whole canvas, full-resolution px; 0: the region's.
    projection  of a plane, in px of the whole canvas; None: not known.
    """

    region: Box
    width: int
    height: int
    wraps: bool
    poles: int
    lonlat: tuple[float, float, float, float]
    canvas_width: int = 0
    projection: Projection | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width), as arrays have it."""
        return self.height, self.width

    @property
    def border(self) -> Border:
        """The grid as the kernels take it."""
        return Border(self.width, self.height, int(self.wraps), self.poles)

    @property
    def spherical(self) -> bool:
        """Whether it is of a sphere."""
        return self.lonlat[1] > 0

    @property
    def row_height(self) -> float:
        """Of a row of the grid, full-resolution px."""
        return self.region.height / self.height

    @property
    def latitudes(self) -> npt.NDArray[np.float64]:
        """Of the middles of rows; 0 on a plane."""
        _, _, top, down = self.lonlat
        rows = np.arange(self.height, dtype=np.float64)
        return top - (rows + 0.5) * down

    @property
    def row_widths(self) -> npt.NDArray[np.float64]:
        """How wide the pixels of each row are, beside those at the equator; 1 on a plane."""
        widths: npt.NDArray[np.float64] = np.cos(self.latitudes)
        return widths

    @property
    def bounded_widths(self) -> npt.NDArray[np.float64]:
        """`row_widths`, but never next to nothing: for equations over cells, which are divided by it."""
        widths: npt.NDArray[np.float64] = np.maximum(self.row_widths, _NARROWEST)
        return widths

    @property
    def circumference(self) -> float:
        """The whole canvas's width: radians on a sphere (2 pi if it wraps), grid px on a plane."""
        if self.spherical and self.wraps:
            return 2 * math.pi
        share = self.canvas_width / self.region.width if self.canvas_width else 1.0
        return share * self.width * (self.lonlat[1] or 1.0)

    def points(self, places: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Points (n, 3) in the scene (kernels/common.cl) of canvas positions (n, 2), full-resolution px."""
        x, y = ((places - (self.region.left, self.region.top)) * self.ratios).T
        if not self.spherical:
            return np.stack([x, y, np.zeros_like(x)], 1)
        lon, lat = self.lonlat[0] + x * self.lonlat[1], self.lonlat[2] - y * self.lonlat[3]
        return directions(lon, lat)

    def places(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """The inverse of `points`; points on a sphere may have any length but 0."""
        x, y, z = points.T
        if self.spherical:
            lon, lat = np.arctan2(x, y), np.arctan2(z, np.hypot(x, y))
            x, y = (lon - self.lonlat[0]) / self.lonlat[1], (self.lonlat[2] - lat) / self.lonlat[3]
        return np.stack([x, y], 1) / self.ratios + (self.region.left, self.region.top)

    @property
    def ratios(self) -> tuple[float, float]:
        """Pixels of the grid per full-resolution pixel."""
        return self.width / self.region.width, self.height / self.region.height

    def coarser(self, pixels: int) -> Grid:
        """A grid over the same region, of cells of about `pixels` x `pixels` of this one's."""
        return self.reduced(max(1, round(self.width / pixels)), max(1, round(self.height / pixels)))

    def reduced(self, width: int, height: int) -> Grid:
        """The same region on fewer pixels. Where columns wrap their number is made even: a line over a pole
        goes on half of the columns further, and solvers' sweeps take every other column.
        """
        wider = self.wraps and width < self.width
        return self.resized(width + width % 2 if wider else width, height)

    def resized(self, width: int, height: int) -> Grid:
        """The same region on another number of pixels."""
        lon, dlon, lat, dlat = self.lonlat
        lonlat = (lon, dlon * self.width / width, lat, dlat * self.height / height)
        return replace(self, width=width, height=height, lonlat=lonlat)


def full_grid(canvas: Canvas, layers: Sequence[Layer]) -> Grid:
    """The region's own pixels: the layers' common bounding box at full resolution."""
    region = bounding_box(layers)
    if canvas.wraps:
        region = replace(region, left=0, right=canvas.width)
    lonlat, poles, projection = (0.0, 0.0, 0.0, 0.0), 0, None
    if canvas.spherical:
        step = math.radians(canvas.hfov) / canvas.width
        left, top = region.left - canvas.width / 2, canvas.height / 2 - region.top
        lonlat = (left * step, step, top * step, step)
        if canvas.wraps and canvas.width % 2 == 0:
            poles += abs(lonlat[2] - math.pi / 2) < step / 2
            poles += 2 * (abs(lonlat[2] - region.height * step + math.pi / 2) < step / 2)
    else:
        projection = Projection.of(canvas.projection, canvas.width, canvas.height, canvas.hfov)
    return Grid(
        region, region.width, region.height, canvas.wraps, poles, lonlat, canvas.width, projection
    )  # fmt: skip


def working_grid(full: Grid, settings: Settings) -> Grid:
    """The grid on which flow, coefficients and colour are calculated."""
    # kernels multiply a grid's width by its region's in 32 bits, and pack rows of the mask grid into 15
    longest = max(full.width, full.height) ** 2 / _LARGEST_PRODUCT
    pixels = math.sqrt(full.width * full.height / settings.working_limit)
    ratio = max(1.0, pixels, longest, full.height / _MOST_ROWS)
    width, height = max(2, round(full.width / ratio)), max(1, round(full.height / ratio))
    return full.reduced(min(width, full.width), min(height, full.height))


def on_cells(values: npt.NDArray[_Kind], cells: Grid, rule: np.ufunc) -> npt.NDArray[_Kind]:
    """Values of any finer grid over the same region, (n, height, width), united by a rule in each of `cells`.

    Of masks, `np.logical_or` gives the cells that they reach into, `np.logical_and` those that they cover.
    """
    values = _on_rows(values, cells.height, rule).transpose(0, 2, 1)
    return np.ascontiguousarray(_on_rows(np.ascontiguousarray(values), cells.width, rule).transpose(0, 2, 1))


def _on_rows(values: npt.NDArray[_Kind], count: int, rule: np.ufunc) -> npt.NDArray[_Kind]:
    """(n, height, width) as (n, count, width). By whole rows: `reduceat` takes several times as long."""
    starts = np.arange(count) * values.shape[1] // count
    ends = np.maximum(np.append(starts[1:], values.shape[1]), starts + 1)
    return np.stack([rule.reduce(values[:, a:b], 1) for a, b in zip(starts, ends, strict=True)], 1)


def connected(mask: npt.NDArray[np.bool_], wraps: bool) -> npt.NDArray[np.int32]:
    """The connected parts of a mask, each with a number of its own above 0 (some numbers are left out); 0
    elsewhere.
    """
    if not mask.any():  # OpenCV takes no mask without pixels
        return np.zeros(mask.shape, np.int32)
    labels = np.asarray(cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)[1], np.int32)
    if wraps:  # parts that meet across the border, at a corner too, are one
        height = labels.shape[0]
        for down in (-1, 0, 1):
            for row in range(max(0, -down), height - max(0, down)):
                first, last = labels[row, 0], labels[row + down, -1]
                if first and last and first != last:
                    labels[labels == last] = first
    return labels


def cells_under(box: Box, grid: Grid, cells: Grid) -> Box:
    """The box of those `cells` into which a box of `grid`, over the same region, reaches."""
    left, right = _cells(box.left, box.right, grid.width, cells.width)
    top, bottom = _cells(box.top, box.bottom, grid.height, cells.height)
    return Box(left, top, right, bottom)


def any_around(mask: npt.NDArray[np.bool_], place: Place, grid: Grid, cells: Grid) -> bool:
    """Whether a mask on `cells` is set anywhere that a kernel may read it for a place of `grid`: in the cells
    that the place reaches into, or in those next to them, between which values are interpolated.
    """
    its = cells_under(Box.at(*place), grid, cells)
    rows, columns = np.arange(its.top - 1, its.bottom + 1), np.arange(its.left - 1, its.right + 1)
    columns = columns % cells.width if cells.wraps else columns.clip(0, cells.width - 1)
    return bool(mask[np.ix_(rows.clip(0, cells.height - 1), columns)].any())


def _cells(start: int, end: int, pixels: int, cells: int) -> tuple[int, int]:
    """The first cell that has one of the pixels from `start` up to `end`, and the one after the last; cell c
    begins with pixel c * pixels // cells.
    """
    first = ((start + 1) * cells - 1) // pixels
    return first, (end * cells - 1) // pixels + 1 if end > start else first

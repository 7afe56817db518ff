"""The working canvas: a reduced grid with a bounded number of pixels on which everything that sees far
is calculated (kernels/working.cl).

The grid covers the layers' common bounding box ("region"; the canvas's whole width where it wraps), with
separate ratios in x and y, so that edges coincide for any size. A working pixel is valid only if every
full-resolution pixel under it is, so that layers cut from one picture agree exactly.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple, TypeVar
from zlib import crc32

import cv2
import numpy as np
import numpy.typing as npt

from hugin_abflow.layer import Box, Canvas, Layer, bounding_box
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.progress import Advance
from hugin_abflow.projection import Projection, directions
from hugin_abflow.settings import Settings

# Rows of a layer that are decoded and uploaded at a time, at most: many take memory, few more calls, for
# which many cores have to wait.
_ROWS = 64
# The same for graphics cards.
_ROWS_FOR_CARD = 256
# Bytes of such rows, at most.
_BYTES = 8 << 20

# Strips of a layer that a part has at least.
_PART_STRIPS = 8

# Bounds of what kernels calculate with int, less some for rounding; only canvases longer than 30,000 px and
# very narrow get near them.
_LARGEST_PRODUCT = 0.99 * 2**31
_MOST_ROWS = 32_000

# Samples brighter than this, of what a layer shows white, may be clipped.
CLIPPED = 0.98

# OpenCL type and full-scale value of each depth; half is widened on the host.
PIXEL = {"uint8": ("uchar", 255.0), "uint16": ("ushort", 65535.0), "float32": ("float", 1.0)}

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
    def of(cls, image: Buffer, wraps: bool) -> Border:
        """The border rules of an image, (height, width, ...), that is no whole sphere."""
        height, width = image.shape[:2]
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
        """The same region on fewer pixels; where it wraps, a column more if that makes them even. Crossing a
        pole goes half of them further, and sweeps take every other one.
        """
        wider = self.wraps and width < self.width
        return self.resized(width + width % 2 if wider else width, height)

    def resized(self, width: int, height: int) -> Grid:
        """The same region on another number of pixels."""
        lon, dlon, lat, dlat = self.lonlat
        lonlat = (lon, dlon * self.width / width, lat, dlat * self.height / height)
        return replace(self, width=width, height=height, lonlat=lonlat)


def on_cells(values: npt.NDArray[_Kind], cells: Grid, rule: np.ufunc) -> npt.NDArray[_Kind]:
    """What any finer grid over the region of `cells` has, (n, height, width), per cell. Of masks
    `np.logical_or` tells cells that they reach into, `np.logical_and` those that they cover whole.
    """
    values = _on_rows(values, cells.height, rule).transpose(0, 2, 1)
    return np.ascontiguousarray(_on_rows(np.ascontiguousarray(values), cells.width, rule).transpose(0, 2, 1))


def _on_rows(values: npt.NDArray[_Kind], count: int, rule: np.ufunc) -> npt.NDArray[_Kind]:
    """(n, height, width) as (n, count, width). By whole rows: `reduceat` takes several times as long."""
    starts = np.arange(count) * values.shape[1] // count
    ends = np.maximum(np.append(starts[1:], values.shape[1]), starts + 1)
    return np.stack([rule.reduce(values[:, a:b], 1) for a, b in zip(starts, ends, strict=True)], 1)


def connected(mask: npt.NDArray[np.bool_], wraps: bool) -> npt.NDArray[np.int32]:
    """The connected parts of a mask over a grid, numbered from 1 on, not all numbers in use; 0 elsewhere."""
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


@dataclass(frozen=True)
class WorkingLayer:
    """A layer on the working grid.

    box         its place on the grid.
    pixels      float32 (height, width, 4), r, g, b (full scale is 1) and valid. Of floats light as it is
                stored, up to unit.py, which codes it in place: all that follows sees it coded.
    checksum    of the stored pixels: tells layers of one size and place apart.
    white       r, g, b of what is clipped, of full scale; None: of integers that, of floats nothing.
    """

    layer: Layer
    box: Place
    pixels: Buffer
    checksum: int
    white: tuple[float, float, float] | None = None

    @property
    def clips_at(self) -> tuple[float, float, float]:
        """r, g, b of what is clipped, infinite where nothing is."""
        return self.white or (((1.0 if self.layer.dtype.kind == "u" else math.inf),) * 3)


def shared_box(a: WorkingLayer, b: WorkingLayer) -> Box:
    """What both layers' boxes have in common."""
    return Box.at(*a.box).intersect(Box.at(*b.box))


def shared_cells(a: WorkingLayer, b: WorkingLayer, grid: Grid, cells: Grid) -> Box:
    """Those of `cells`, over the region of their grid, that both layers' boxes reach into."""
    return cells_under(shared_box(a, b), grid, cells)


def cells_under(box: Box, grid: Grid, cells: Grid) -> Box:
    """What a box of `grid` reaches into of `cells`, into which kernels part the same region."""
    left, right = _cells(box.left, box.right, grid.width, cells.width)
    top, bottom = _cells(box.top, box.bottom, grid.height, cells.height)
    return Box(left, top, right, bottom)


def any_around(mask: npt.NDArray[np.bool_], place: Place, grid: Grid, cells: Grid) -> bool:
    """Whether a mask on `cells` has any that a place of `grid` reaches into, or beside these, from where what
    lies between cells is read.
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


def device_dtype(layer: Layer) -> np.dtype[Any]:
    """The type of a layer's samples on the device (half as float32)."""
    return np.dtype(np.float32) if layer.dtype == np.float16 else layer.dtype


def pixel_options(layer: Layer) -> tuple[str, float]:
    """Build options and full-scale value for a layer's rows on the device."""
    name, white = PIXEL[device_dtype(layer).name]
    return f"-DPIXEL={name} -DSAMPLES={layer.channels + 1}", white


def device_rows(layer: Layer, top: int, bottom: int) -> np.ndarray:
    """Rows of a layer in a type that kernels read."""
    return layer.rows(top, bottom).astype(device_dtype(layer), copy=False)


def rows_at_a_time(device: Device, layer: Layer) -> int:
    """How many rows of a layer are decoded at a time, but for whole strips."""
    most = _ROWS_FOR_CARD if device.kind == "GPU" else _ROWS
    return max(1, min(most, _BYTES // layer.row_bytes))


def _span(low: int, high: int, start: int, ratio: tuple[int, int]) -> tuple[int, int]:
    """Grid pixels (first, end) that lie wholly within full-resolution pixels [low, high)."""
    full, small = ratio
    return -(-(low - start) * small // full), (high - start) * small // full


class Reduction:
    """A layer on its way onto the working grid: decoded once, band by band, several parts of it at a time.

    checked         whether a checksum is calculated, which costs a fifth of what decoding does; else it is 0.
    """

    def __init__(self, device: Device, layer: Layer, grid: Grid, *, checked: bool = True) -> None:
        region = grid.region
        left, right = _span(layer.box.left, layer.box.right, region.left, (region.width, grid.width))
        top, bottom = _span(layer.box.top, layer.box.bottom, region.top, (region.height, grid.height))
        width, height = max(1, right - left), max(1, bottom - top)
        # a layer smaller than a working pixel covers none, but kernels write to the grid under its box
        self._box = (min(left, grid.width - width), min(top, grid.height - height), width, height)
        self._device, self._layer, self._checked = device, layer, checked
        self._top, self._rows = top, max(0, bottom - top)
        self._place = layer.box.left - region.left, layer.box.top - region.top
        self._ratio = (region.width, grid.width, region.height, grid.height)
        self._band = max(1, rows_at_a_time(device, layer) * grid.height // region.height)
        self._pixels = device.zeros((height, width, 4))
        self._checksum, self._checking = 0, threading.Lock()

    def parts(self, count: int) -> list[tuple[int, int]]:
        """Rows of the grid, `first` to `end`, that `read` takes: all of them, in so many parts at most. Two
        may share a strip, which is decoded for each of them, so each part has several; a layer that is
        decoded from its top alone is one.
        """
        bands, strip = -(-self._rows // self._band), self._layer.strip
        most = self._layer.box.height // (_PART_STRIPS * strip) if strip > 1 else 1
        count = max(1, min(bands, count, most))
        ends = [min(self._rows, bands * index // count * self._band) for index in range(count + 1)]
        return list(pairwise(ends))

    def read(self, first: int, end: int, advance: Advance) -> None:
        """Decode one of `parts`; `advance` counts rows of the layer. For several threads, each part once."""
        width, pixels = self._box[2], self._pixels
        options, white = pixel_options(self._layer)
        for row in range(first, end, self._band):
            rows = min(self._band, end - row)
            start, stop = self._begins(row), self._ends(row + rows)
            rows_read = device_rows(self._layer, start, stop)
            if self._checked:
                self._check(rows_read, start, row, row + rows)
            stored = self._device.upload(rows_read)
            place = (self._place[0], start + self._place[1], self._layer.box.width, stop - start)
            self._device.run(
                "working", "working_reduce", (width, rows), stored, place, self._ratio, self._box, row,
                (width, rows), white, pixels, options=options,
            )  # fmt: skip
            advance(self._counted(row + rows) - self._counted(row))  # bands share rows; each counts once
        if not self._rows:
            advance(self._layer.box.height)

    def result(self) -> WorkingLayer:
        """The layer, of which all parts were read."""
        if self._checked:
            height = self._layer.box.height
            first, last = (self._begins(0), self._ends(self._rows)) if self._rows else (height, height)
            for start, stop in ((0, first), (last, height)):  # under no whole row of the grid
                if start < stop:
                    self._sum(device_rows(self._layer, start, stop), start)
        return WorkingLayer(self._layer, self._box, self._pixels, self._checksum)

    def _begins(self, row: int) -> int:
        """The layer's row in which a row of its box on the grid begins."""
        _, _, full, small = self._ratio
        return (self._top + row) * full // small - self._place[1]

    def _ends(self, row: int) -> int:
        """The layer's row that follows on all that lie under those of its box on the grid before `row`."""
        _, _, full, small = self._ratio
        return -(-(self._top + row) * full // small) - self._place[1]

    def _counted(self, row: int) -> int:
        """How many rows of the layer come before one of its box on the grid: none, or all, at its ends."""
        if row == self._rows:
            return self._layer.box.height
        return self._begins(row) if row else 0

    def _check(self, stored: np.ndarray, start: int, row: int, end: int) -> None:
        """Have the checksum tell of what lies under rows `row` to `end`, and no more: bands share rows, come
        in any order, and may be larger elsewhere.

        stored: rows of the layer from its row `start` on.
        """
        first, last = max(start, self._counted(row)), min(start + len(stored), self._counted(end))
        self._sum(stored[first - start : max(first, last) - start], first)

    def _sum(self, stored: np.ndarray, start: int) -> None:
        """Have the checksum tell of rows of the layer from its row `start` on."""
        its = sum(crc32(row.data, y) for y, row in enumerate(stored, start))
        with self._checking:
            self._checksum = (self._checksum + its) % 2**32


def reduce_layer(
    device: Device, layer: Layer, grid: Grid, advance: Advance, *, checked: bool = True
) -> WorkingLayer:
    """A layer on the working grid, all of it decoded here; see `Reduction`."""
    reduction = Reduction(device, layer, grid, checked=checked)
    for first, end in reduction.parts(1):
        reduction.read(first, end, advance)
    return reduction.result()


def same_where_both(device: Device, a: WorkingLayer, b: WorkingLayer) -> bool:
    """Whether two layers show the same colours wherever both cover the grid: then there is no parallax."""
    differs = device.zeros((1,), np.int32)
    options, _ = pixel_options(a.layer)
    size = a.box[2:]
    device.run("working", "working_compare", size, a.pixels, a.box, b.pixels, b.box, differs, options=options)
    return not differs.get()[0]

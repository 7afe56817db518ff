"""Layers on the working grid, on which everything that sees far is calculated (kernels/working.cl).

A working pixel is valid only if every full-resolution pixel under it is, so that layers cut from one picture
agree exactly.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from itertools import pairwise
from typing import Any
from zlib import crc32

import numpy as np

from hugin_abflow.grid import Grid, Place, cells_under
from hugin_abflow.layer import Box, Layer
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.progress import Advance

# Rows of a layer that are decoded and uploaded at a time, at most: many take memory, few more calls, for
# which many cores have to wait.
_ROWS = 64
# The same for graphics cards.
_ROWS_FOR_CARD = 256
# Bytes of such rows, at most.
_BYTES = 8 << 20

# Strips of a layer that a part has at least.
_PART_STRIPS = 8

# Samples may be clipped from this share of a layer's white (`WorkingLayer.clips_at`) on.
CLIPPED = 0.98

# OpenCL type and full-scale value of each depth; half is widened on the host.
PIXEL = {"uint8": ("uchar", 255.0), "uint16": ("ushort", 65535.0), "float32": ("float", 1.0)}


@dataclass(frozen=True)
class WorkingLayer:
    """A layer on the working grid.

    box         its place on the grid.
    pixels      float32 (height, width, 4), r, g, b (full scale is 1) and valid. Floats are light as it was
                stored until unit.py codes them, in place, before anything else looks at them.
    checksum    of the stored pixels: tells layers of one size and place apart.
    white       r, g, b at which it is clipped, of full scale (saturation.py). None: not looked for yet, or
                nothing is found; then integers are clipped at full scale, and floats are not.
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

"""What a band of the full-resolution pass reads of coarse grids: rows of fields, gains and offsets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from hugin_abflow.grid import Grid, Place
from hugin_abflow.layer import Box
from hugin_abflow.opencl import Buffer, Device

Span = tuple[int, int]
Coarse = tuple[Place, Buffer]  # place on a coarse grid; float32 (height, width, 4)


@dataclass(frozen=True)
class Band:
    """part: the band, in pixels of the region. rows: for each layer, the half-open range of its rows that
    this band may sample; both ends equal where it samples none.
    """

    part: Box
    rows: tuple[Span, ...]

    @cached_property
    def samples(self) -> npt.NDArray[np.bool_]:
        """Which layers it may sample, (layers,)."""
        return np.array([start < end for start, end in self.rows], bool)


def coarse_rows(box: Place, part: Box, scale: float) -> Span:
    """Rows of a coarse grid in `box` that a band reads, at least one; scale: band rows per coarse row."""
    start, end = _read_span(part, scale)
    first, last = _clipped_spans(np.array([box]), start, end)
    return int(first[0]), int(last[0])


def _read_span(part: Box, scale: float) -> Span:
    """Rows of a coarse grid, and beyond it, that a band reads between."""
    return math.floor(part.top / scale) - 1, math.ceil(part.bottom / scale) + 2


def _clipped_spans(boxes: npt.NDArray[np.int_], start: int, end: int) -> tuple[npt.NDArray[np.int_], ...]:
    """Of rows from `start` up to `end` those of each of some boxes (n, 4), at least one: the first, and that
    after the last.
    """
    top, height = boxes[:, 1], boxes[:, 3]
    first = np.minimum(np.maximum(start, top), top + height - 1)
    return first, np.minimum(np.maximum(end, first + 1), top + height)


class Slices:
    """Of layers' arrays on boxes of a coarse grid the rows that a band reads. values: float32 (n, 4), one
    array after the other.

    arrays      of each layer; None: it has none.
    everywhere  whether rows of layers that a band does not sample are read as well, if it has any: what is
                read for a place must not depend on the height of the band in which that is.
    """

    def __init__(
        self,
        device: Device,
        arrays: Sequence[Coarse | None],
        grid: Grid,
        plan: Sequence[Band],
        everywhere: bool = False,
    ) -> None:
        self._arrays, self._scale, self._everywhere = arrays, grid.row_height, everywhere
        self._there = np.array([array is not None for array in arrays], bool)
        self._boxes = np.array([array[0] if array else (0, 0, 0, 0) for array in arrays])
        most = max(int(places[:, 2] @ places[:, 3]) for places in map(self._places, plan))
        self.values = device.empty((most, 4))

    def take(self, band: Band) -> npt.NDArray[np.int32]:
        """Have `values` hold the rows of a band. Per array their box on the grid, without rows where none are
        read, where they begin, -1 where there is no array, and three zeros: (arrays, 8).
        """
        places = self._places(band)
        read = np.flatnonzero(places[:, 3])  # of 300 layers few: each copy takes as long as a small kernel
        for k in read.tolist():
            array, (_, first, width, height, start) = self._arrays[k], places[k, :5].tolist()
            if array is not None:
                self.values.copy(start, array[1], (first - array[0][1]) * width, height * width)
        return places

    def _places(self, band: Band) -> npt.NDArray[np.int32]:
        left, top, width, height = self._boxes.T
        start, end = _read_span(band.part, self._scale)
        first, last = _clipped_spans(self._boxes, start, end)
        # of a layer that is sampled beside its array the nearest row is read
        read = band.samples | (self._everywhere & (top < end) & (top + height > start))
        rows = np.where(read & self._there, last - first, 0)
        begin = np.where(self._there, np.cumsum(width * rows) - width * rows, -1)
        nothing = np.zeros_like(rows)
        places = np.stack([left, first, width, rows, begin, nothing, nothing, nothing], 1)
        return places.astype(np.int32)

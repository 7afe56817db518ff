"""Decoded rows of layers, kept in a temporary file from the first time that they are needed to the second.

Layers are read twice, for the working canvas and for the panorama, and decoding takes several times as long
as copying. What the file cannot hold is decoded again.
"""

from __future__ import annotations

import logging
import os
import shutil
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from typing import IO, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hugin_abflow import memory, scratch, trace
from hugin_abflow.layer import Layer

_log = logging.getLogger(__name__)

# The share of the memory that nobody uses, and of the free space on disk, that the file may take. Where new
# files take a tenth of that memory, Linux begins to write them to the disk; this one shall be gone before.
_SHARE = 10
# Columns of zeros between others that are not worth a call of their own.
_GAP = 256


@contextmanager
def spooled(layers: Sequence[Layer]) -> Iterator[list[Layer]]:
    """The same layers; of those that are compressed in their files, and fit, rows are decoded once.

    The file has no name, or an unknown one where a system cannot do that; nothing is left of it. Layers that
    are read afterwards are decoded. It is no error if there is no room: no layer has to be kept.
    """
    result, end = list(layers), 0
    with ExitStack() as stack:
        with suppress(OSError):
            folder = scratch.root()
            room = min(memory.unused(), shutil.disk_usage(folder).free) // _SHARE
            file = stack.enter_context(tempfile.TemporaryFile(dir=folder))
            for index, layer in enumerate(layers):
                size = layer.row_bytes * layer.box.height
                if layer.compressed and end + size <= room and hasattr(os, "preadv"):  # Windows has none
                    rows = _Rows(layer, file, end)
                    stack.callback(rows.end)
                    result[index] = replace(layer, read=rows.read)
                    end += size
        if end:
            _log.info("spool: up to %s of decoded layers in a temporary file in %s", memory.size(end), folder)
        yield result


class _Block(NamedTuple):
    """Rows that are stored: `first` to `end`, and of these the columns `left` to `right` from a place in the
    file on, for each (left, right, place) of `spans`; all else is 0.
    """

    first: int
    end: int
    spans: list[tuple[int, int, int]]


class _Rows:
    """Rows of one layer; the `read` of a `Layer`. start: where the room for them begins in the file."""

    def __init__(self, layer: Layer, file: IO[bytes], start: int) -> None:
        self._layer, self._start = layer, start
        self._file: IO[bytes] | None = file
        self._row = layer.row_bytes
        self._pixel = self._row // layer.box.width
        self._blocks: list[_Block] = []
        self._block_of = np.full(layer.box.height, -1)  # each row's; -1: it is not stored
        # a file is closed when nobody is at it: after two Ctrl-C threads may still read, and somebody else's
        # file have the number of ours
        self._lock = threading.Lock()

    def read(self, top: int, bottom: int) -> npt.NDArray[Any]:
        """Rows `top` to `bottom`, see `Layer.read`."""
        with self._lock:
            if self._file and 0 <= top < bottom <= len(self._block_of):
                blocks = np.unique(self._block_of[top:bottom])
                rows = self._recall(self._file, blocks, top, bottom) if blocks[0] >= 0 else None
                if rows is not None:
                    return rows
        rows = self._layer.rows(top, bottom)
        with self._lock:
            if self._file:
                self._keep(self._file, rows, top)
        return rows

    def end(self) -> None:
        """Leave the file alone from now on."""
        with self._lock:
            self._file = None

    def _recall(
        self, file: IO[bytes], blocks: npt.NDArray[Any], top: int, bottom: int
    ) -> npt.NDArray[Any] | None:
        """Rows of stored blocks; None if the disk fails."""
        shape = (bottom - top, self._layer.box.width, self._layer.channels + 1)
        rows = np.zeros(shape, self._layer.dtype)
        with trace.span("recall", trace.FILE, file=self._layer.name, rows=len(rows)), suppress(OSError):
            for block in (self._blocks[index] for index in blocks):
                first, end = max(top, block.first), min(bottom, block.end)
                for left, right, place in block.spans:
                    target = part = rows[first - top : end - top, left:right]
                    if not part.flags.c_contiguous:
                        part = np.empty(part.shape, part.dtype)
                    place += (first - block.first) * (right - left) * self._pixel
                    if os.preadv(file.fileno(), [_bytes(part).data], place) != part.nbytes:
                        return None
                    if part is not target:
                        target[:] = part
            return rows
        return None

    def _keep(self, file: IO[bytes], rows: npt.NDArray[Any], top: int) -> None:
        """Store rows from the first one that is not stored up to the next that is."""
        missing = np.flatnonzero(self._block_of[top : top + len(rows)] < 0)
        if not len(missing):
            return
        skipped = int(missing[0])
        count = np.count_nonzero(missing == skipped + np.arange(len(missing)))
        first, rows = top + skipped, rows[skipped : skipped + count]
        block, place = _Block(first, first + len(rows), []), self._start + first * self._row
        with trace.span("keep", trace.FILE, file=self._layer.name, rows=len(rows)), suppress(OSError):
            for left, right in self._spans(rows):
                part = np.ascontiguousarray(rows[:, left:right])
                # less is written than there is, or nothing, where the disk is full
                if os.pwrite(file.fileno(), _bytes(part).data, place) != part.nbytes:
                    return
                block.spans.append((left, right, place))
                place += part.nbytes
            self._block_of[block.first : block.end] = len(self._blocks)
            self._blocks.append(block)

    def _spans(self, rows: npt.NDArray[Any]) -> list[tuple[int, int]]:
        """The columns (left, right) in which not all of `rows` is 0. On a sphere most of a layer is: to write
        to new memory takes longer than to look.
        """
        set_ = np.bitwise_or.reduce(_bytes(np.ascontiguousarray(rows)).reshape(len(rows), -1), axis=0)
        columns = np.flatnonzero(set_.reshape(-1, self._pixel).any(axis=1))
        if not len(columns):
            return []
        ends = np.flatnonzero(np.diff(columns) > _GAP)
        lefts, rights = columns[[0, *(ends + 1)]], columns[[*ends, -1]] + 1
        return [(int(left), int(right)) for left, right in zip(lefts, rights, strict=True)]


def _bytes(rows: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    return rows.reshape(-1).view(np.uint8)

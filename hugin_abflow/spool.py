"""Decoded rows of layers, from the first time that they are needed to the second, in a temporary file.

Layers are read twice, for the working canvas and for the panorama, and to decode them takes several times as
long as to copy them. What the file can not hold is decoded again.
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
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from hugin_abflow import memory, scratch, trace
from hugin_abflow.layer import Layer

_log = logging.getLogger(__name__)

# The share of the memory that nobody uses, and of the free space on disk, that the file may take. Where new
# files take a tenth of that memory, Linux begins to write them to the disk; this one shall be gone before.
_SHARE = 10


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
                size = _row_bytes(layer) * layer.box.height
                if layer.compressed and end + size <= room and hasattr(os, "preadv"):  # Windows has none
                    rows = _Rows(layer, file, end)
                    stack.callback(rows.end)
                    result[index] = replace(layer, read=rows.read)
                    end += size
        if end:
            _log.info("spool: %s of decoded layers in a temporary file in %s", memory.size(end), folder)
        yield result


def _row_bytes(layer: Layer) -> int:
    return layer.box.width * (layer.channels + 1) * layer.dtype.itemsize


class _Rows:
    """Rows of one layer; the `read` of a `Layer`. start: where row 0 is in the file."""

    def __init__(self, layer: Layer, file: IO[bytes], start: int) -> None:
        self._layer, self._start = layer, start
        self._file: IO[bytes] | None = file
        self._row = _row_bytes(layer)
        self._stored = np.zeros(layer.box.height, np.bool_)
        # a file is closed when nobody is at it: after two Ctrl-C threads may still read, and somebody else's
        # file have the number of ours
        self._lock = threading.Lock()

    def read(self, top: int, bottom: int) -> npt.NDArray[Any]:
        """Rows `top` to `bottom`, see `Layer.read`."""
        with self._lock:
            if self._file and 0 <= top < bottom <= len(self._stored) and self._stored[top:bottom].all():
                rows = self._recall(self._file, top, bottom)
                if rows is not None:
                    return rows
        rows = self._layer.read(top, bottom)
        with self._lock:
            if self._file:
                self._keep(self._file, rows, top)
        return rows

    def end(self) -> None:
        """Leave the file alone from now on."""
        with self._lock:
            self._file = None

    def _recall(self, file: IO[bytes], top: int, bottom: int) -> npt.NDArray[Any] | None:
        """Stored rows; None if the disk fails."""
        shape = (bottom - top, self._layer.box.width, self._layer.channels + 1)
        rows, place = np.empty(shape, self._layer.dtype), self._start + top * self._row
        with trace.span("recall", trace.FILE, file=self._layer.name, rows=bottom - top), suppress(OSError):
            if os.preadv(file.fileno(), [_bytes(rows)], place) == rows.nbytes:
                return rows
        return None

    def _keep(self, file: IO[bytes], rows: npt.NDArray[Any], top: int) -> None:
        """Store rows from the first one on that is not stored."""
        missing = np.flatnonzero(~self._stored[top : top + len(rows)])
        if not len(missing):
            return
        first, rows = top + int(missing[0]), rows[missing[0] :]
        with trace.span("keep", trace.FILE, file=self._layer.name, rows=len(rows)), suppress(OSError):
            # less is written than there is, or nothing, where the disk is full
            written = os.pwrite(file.fileno(), _bytes(rows), self._start + first * self._row)
            self._stored[first : first + written // self._row] = True


def _bytes(rows: npt.NDArray[Any]) -> memoryview:
    return rows.reshape(-1).view(np.uint8).data

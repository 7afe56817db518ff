"""Write TIFF files, whose strips are encoded on several cores and written by a thread of their own.

With tifffile and imagecodecs: OpenImageIO encodes one strip after the other, and turns JPEG and zstd into
deflate.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hugin_abflow import trace

Pixels = npt.NDArray[Any]

# Names of compressions, and tifffile's; those that gain from storing differences of neighbours.
COMPRESSIONS = {
    "none": None,
    "packbits": "packbits",
    "lzw": "lzw",
    "deflate": "adobe_deflate",
    "zstd": "zstd",
    "jpeg": "jpeg",
}
# Bytes that noise takes for each byte of pixels, at most.
_WORST = {
    "none": 1.0,
    "packbits": 1.01,  # a byte in front of 128
    "lzw": 1.5,  # codes of up to 12 bits may stand for a byte each
    "deflate": 1.01,  # blocks that do not shrink are stored, as are zstd's
    "zstd": 1.01,
    "jpeg": 2.0,  # 1.9 for noise of black and white at a quality of 100
}
_MODEST = 90  # quality of JPEG up to which it is at most 1
_PREDICTED = {"lzw", "deflate", "zstd"}
_ROWS = 32  # of a strip
_DEFLATE_LEVEL, _ZSTD_LEVEL = 6, 3
_WAIT = 0.2  # seconds after which a waiting thread looks whether the other is still there


def worst_case(compression: str, quality: int) -> float:
    """Bytes that a byte of pixels may take: before the first strip is made, it is decided whether a file may
    become too large for a classic TIFF. quality: of JPEG, 1..100.
    """
    return 1.0 if compression == "jpeg" and quality <= _MODEST else _WORST[compression]


def encode(rows: Pixels, compression: str, quality: int) -> bytes:
    """One strip (rows, width, samples) as it lies in the file. quality: of JPEG, 1..100."""
    import imagecodecs

    if compression in _PREDICTED:
        predict = imagecodecs.floatpred_encode if rows.dtype.kind == "f" else imagecodecs.delta_encode
        rows = predict(rows, axis=-2)
    encoders: dict[str, Callable[[], Any]] = {
        "none": lambda: rows.tobytes(),
        # its rows are packed one by one
        "packbits": lambda: imagecodecs.packbits_encode(rows.reshape(len(rows), -1).view(np.uint8), axis=-1),
        "lzw": lambda: imagecodecs.lzw_encode(rows.tobytes()),
        "deflate": lambda: imagecodecs.deflate_encode(rows.tobytes(), _DEFLATE_LEVEL),
        "zstd": lambda: imagecodecs.zstd_encode(rows.tobytes(), _ZSTD_LEVEL),
        # samples as they are: alpha has no place in YCbCr
        "jpeg": lambda: imagecodecs.jpeg8_encode(
            rows, quality, colorspace="UNKNOWN", outcolorspace="UNKNOWN"
        ),
    }
    return bytes(encoders[compression]())


class TiffWriter:
    """Write rows from top to bottom. Errors of the file (`OSError`) are raised by any later call.

    path            an empty file, which is there already. shape: (height, width, samples), alpha last.
    compression     one of `COMPRESSIONS`; JPEG is for 8-bit RGB. quality: of JPEG, 1..100.
    offset          (x, y) on the canvas, at 150 dpi. big: BigTIFF, for more than 4 GB.
    threads         cores that encode.
    """

    def __init__(
        self,
        path: Path,
        shape: tuple[int, int, int],
        dtype: np.dtype[Any],
        *,
        compression: str,
        quality: int,
        offset: tuple[int, int],
        icc: bytes | None,
        big: bool,
        threads: int,
    ) -> None:
        self._shape, self._dtype = shape, dtype
        self._encode = partial(encode, compression=compression, quality=quality)
        self._rest = np.empty((0, *shape[1:]), dtype)
        self._strips: queue.Queue[Future[bytes] | None] = queue.Queue(2 * threads)
        self._encoders = ThreadPoolExecutor(threads, "encoder")
        self._error: BaseException | None = None
        # both, of 0 too: readers that find one expect the other
        more: list[tuple[int, int, int, Any, bool]] = [
            (tag, 5, 1, (value, 150), True) for tag, value in zip((286, 287), offset, strict=True)
        ]
        more.append((274, 3, 1, 1, True))  # orientation, as enblend writes it
        tags: dict[str, Any] = {
            "photometric": "rgb" if shape[2] > 2 else "minisblack", "planarconfig": "contig",
            "extrasamples": ["unassalpha"], "rowsperstrip": _ROWS, "compression": COMPRESSIONS[compression],
            "predictor": compression in _PREDICTED, "resolution": (150, 150), "resolutionunit": "inch",
            "iccprofile": icc, "extratags": more, "metadata": None, "software": False,
        }  # fmt: skip
        if compression == "jpeg":
            # else tifffile says that colours are YCbCr, which `encode` does not make of them
            tags["compressionargs"] = {"outcolorspace": "RGB"}
        self._thread = threading.Thread(
            target=self._write, args=(path, big, tags), name="writer", daemon=True
        )
        self._thread.start()

    def _write(self, path: Path, big: bool, tags: dict[str, Any]) -> None:
        """Write the strips as they come; what fails is kept for the caller."""
        try:
            import tifffile

            # not "w": after a Ctrl-C while this thread starts, it would make the file anew that was removed
            with path.open("r+b") as stream, tifffile.TiffWriter(stream, bigtiff=big) as file:
                file.write(self._encoded(), shape=self._shape, dtype=self._dtype, **tags)
        except BaseException as error:
            self._error = error

    def _encoded(self) -> Iterator[bytes]:
        while (strip := self._strips.get()) is not None:
            yield strip.result()

    def write(self, rows: Pixels) -> None:
        """Append rows (n, width, samples) of the file's dtype; they must not change afterwards."""
        if len(self._rest):
            missing = _ROWS - len(self._rest)
            self._rest, rows = np.concatenate([self._rest, rows[:missing]]), rows[missing:]
            if len(self._rest) < _ROWS:
                return
            self._put(self._rest)
        whole = len(rows) // _ROWS * _ROWS
        for top in range(0, whole, _ROWS):
            self._put(rows[top : top + _ROWS])
        self._rest = rows[whole:]

    def _put(self, rows: Pixels) -> None:
        strip = self._encoders.submit(self._traced, np.ascontiguousarray(rows))
        while True:
            if self._error:
                raise self._error
            try:
                return self._strips.put(strip, timeout=_WAIT)
            except queue.Full:
                continue

    def _traced(self, rows: Pixels) -> bytes:
        with trace.span("encode", trace.FILE, rows=len(rows)):
            return self._encode(rows)

    def close(self) -> None:
        """Write what is left, and the file's end."""
        if len(self._rest):
            self._put(self._rest)
        self._end()
        if self._error:
            raise self._error

    def abandon(self) -> None:
        """End at once; the file is no good."""
        self._encoders.shutdown(wait=False, cancel_futures=True)
        self._error = self._error or RuntimeError("given up")
        with suppress(queue.Empty):  # asked beforehand, it may be emptied by the thread meanwhile
            while True:
                self._strips.get_nowait()
        self._end()

    def _end(self) -> None:
        while self._thread.is_alive():
            try:
                self._strips.put(None, timeout=_WAIT)
                break
            except queue.Full:
                continue
        self._thread.join()
        self._encoders.shutdown(cancel_futures=True)

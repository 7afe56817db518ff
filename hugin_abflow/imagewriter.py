"""Write panoramas: whole files or none. Used through `hugin_abflow.images`.

With `hugin_abflow.images` the only module that uses OpenImageIO.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import math
import os
import shutil
from collections.abc import Iterator
from numbers import Integral
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt
import OpenImageIO as oiio  # noqa: N813

from hugin_abflow import tiffwriter, trace
from hugin_abflow.encoding import format_of, stored_dtype, to_depth, used_compression
from hugin_abflow.errors import OutputError
from hugin_abflow.exif import Metadata, embed, place_in_png
from hugin_abflow.layer import native
from hugin_abflow.scratch import part_beside, put
from hugin_abflow.targets import explained, final_file, may_grow
from hugin_abflow.tifftags import FURTHEST

Pixels = npt.NDArray[Any]

_log = logging.getLogger(__name__)

_OIIO_NAMES = {
    np.dtype(np.uint8): "uint8",
    np.dtype(np.uint16): "uint16",
    np.dtype(np.float16): "half",
    np.dtype(np.float32): "float",
}
_PNG_LEVEL = 4  # twice as fast as zlib's usual 6 for 2 % more bytes
_JPEG_LIMIT = 65500  # pixels a side, of libjpeg
_JPEG_LEAST = 1 << 16  # bytes of a JPEG beside its samples
_JPEG_BLANK = 1 / 64  # bytes that nothing takes for each sample
_CLASSIC_LIMIT = 0xFFFFFFFF - (16 << 20)  # bytes of a classic TIFF, with room for tags and metadata
_OVERSHOOT = 1.2  # of white, beside edges that were sampled by cubic and longer filters


class ImageWriter:
    """Write an image from top to bottom; the file appears, whole, when the ``with`` block ends.

    path            format by its ending, see `encoding.ENDINGS`; an existing file is replaced.
    width, height   pixels.
    channels        1 (grey) or 3 (RGB); rows have one more, alpha.
    dtype           of the rows: uint8, uint16, float16, float32.
    depth           samples that are stored: one of these; TIFF: float64 too; default: `dtype`.
                    Black and white stay what they are (65535 of uint16 is 1.0 of floats). JPEG is written
                    with 8 bit, PNG with 8 or 16; EXR needs floats.
    offset          (x, y) on the canvas: TIFF's (at 150 dpi) and PNG's as of enblend, EXR's data window.
    canvas_size     (width, height) for the EXR display window; default: the data window.
    compression     TIFF: none, lzw (default), packbits, deflate, zstd, jpeg (8-bit RGB, else deflate, with
                    a warning; it blurs alpha, too). EXR: none, rle, zips, zip (default),
                    piz. JPEG and PNG have but their own, jpeg and deflate.
    jpeg_quality    of JPEG, and of jpeg in TIFF; 1..100, default 90.
    threads         cores that encode TIFF; default: all.
    icc             profile, carried as it is; PNG leaves a broken one out, with a warning.
    metadata        EXIF and XMP; of EXR what OpenImageIO carries, as its attributes.
    named_with      the option that names the file, for messages.

    The attribute `compression` says what is really used. JPEG loses alpha: laid over black.
    Raises `OutputError` for an unknown ending, a depth or size the format cannot hold, an unwritable
    folder, a full disk, and if rows are missing in the end.
    """

    def __init__(
        self,
        path: Path | str,
        width: int,
        height: int,
        channels: int,
        dtype: npt.DTypeLike,
        *,
        depth: npt.DTypeLike | None = None,
        offset: tuple[int, int] = (0, 0),
        icc: bytes | None = None,
        compression: str | None = None,
        jpeg_quality: int | None = None,
        canvas_size: tuple[int, int] | None = None,
        metadata: Metadata | None = None,
        threads: int | None = None,
        named_with: str = "-o",
    ) -> None:
        self.path, self.metadata, self._named_with = Path(path), metadata, named_with
        self._threads = threads or os.cpu_count() or 1
        self.width, self.height, self.channels, self.dtype = width, height, channels, np.dtype(dtype)
        self.format = format_of(self.path)
        self.stored = stored_dtype(self.path, self.format, self.dtype, depth)
        self.compression = used_compression(
            self.path, self.format, self.stored, channels, compression, jpeg_quality
        )
        tall = height if self.format == "jpeg" else 0  # within TIFF each strip is a JPEG
        if self.compression.startswith("jpeg") and max(width, tall) > _JPEG_LIMIT:
            raise OutputError(f"{path}: JPEG ends at {_JPEG_LIMIT} pixels a side; choose a TIFF with LZW")
        if not all(isinstance(one, Integral) and abs(one) <= FURTHEST for one in offset):
            raise OutputError(f"{path}: it lies at {offset}; give whole pixels, up to {FURTHEST}")
        if self.format == "tiff" and min(offset) < 0:
            raise OutputError(f"{path}: TIFF holds no negative position {offset}; choose .exr")
        self._offset, self._icc = offset, icc
        self._spec: Any = None if self.format == "tiff" else self._make_spec(offset, icc, canvas_size)
        self._done = 0
        self._clipped = False
        self._output: Any = None
        self._tiff: tiffwriter.TiffWriter | None = None
        self._final = self._part = self.path
        self._scratch = contextlib.ExitStack()

    def _make_spec(
        self, offset: tuple[int, int], icc: bytes | None, canvas_size: tuple[int, int] | None
    ) -> Any:
        """What OpenImageIO is to write."""
        samples = self.channels if self.format == "jpeg" else self.channels + 1
        spec = oiio.ImageSpec(self.width, self.height, samples, _OIIO_NAMES[self.stored])
        colours = ("R", "G", "B") if self.channels == 3 else ("Y",)
        spec.channelnames = colours if self.format == "jpeg" else (*colours, "A")
        spec.alpha_channel = -1 if self.format == "jpeg" else self.channels
        spec["oiio:UnassociatedAlpha"] = 1  # else OpenImageIO takes colours for premultiplied
        if icc is not None:
            spec.attribute("ICCProfile", oiio.TypeDesc(f"uint8[{len(icc)}]"), np.frombuffer(icc, np.uint8))
            if self.format == "png":
                spec["oiio:ColorSpace"] = "unknown"  # else the file claims sRGB beside its profile
        if self.format == "openexr":
            spec["compression"] = self.compression
            spec.x, spec.y = spec.full_x, spec.full_y = offset
            if canvas_size is not None:
                spec.full_x, spec.full_y = 0, 0
                spec.full_width, spec.full_height = canvas_size
            for name, value in (self.metadata or Metadata({})).attributes().items():
                if isinstance(value, str):
                    spec[name] = value
                else:
                    spec.attribute(name, f"float[{len(value)}]", value)
        elif self.format == "png":
            spec["png:compressionLevel"] = _PNG_LEVEL
        elif self.format == "jpeg":
            spec["compression"] = self.compression
            spec["jpeg:subsampling"] = "4:4:4"  # as enblend: colour edges stay sharp
        return spec

    def __enter__(self) -> ImageWriter:
        self._final = final_file(self.path, self._named_with)
        with explained(self.path, self._final, self._named_with):
            # made here, not by OpenImageIO: a clear reason
            self._part = self._scratch.enter_context(part_beside(self._final, self.path.suffix))
        try:
            why = self._open()
            if why and self.format == "png" and self._spec.getattribute("ICCProfile") is not None:
                # PNG's library is the only one that looks into profiles, and it refuses the whole image
                self._spec.erase_attribute("ICCProfile")
                fault, why = why.splitlines()[0], self._open()
                if not why:
                    _log.warning("%s: written without the layers' ICC profile (%s)", self.path, fault)
            if why:
                raise self._failure(why)
        except BaseException:
            self._discard()
            raise
        return self

    def _open(self) -> str:
        """Begin the file; an error's text, or nothing."""
        if self.format == "tiff":
            shape = self.height, self.width, self.channels + 1
            compression, _, quality = self.compression.partition(":")
            worst = tiffwriter.worst_case(compression, int(quality or 0))
            self._tiff = tiffwriter.TiffWriter(
                self._part, shape, self.stored, compression=compression,
                quality=int(quality or 0), offset=self._offset, icc=self._icc, threads=self._threads,
                big=math.prod(shape) * self.stored.itemsize * worst > _CLASSIC_LIMIT,
            )  # fmt: skip
            return ""
        if self.format == "jpeg":
            self._refuse_full_disk(0)
        self._output = oiio.ImageOutput.create(str(self._part))
        if self._output is None:
            return str(oiio.geterror())
        if self._output.open(str(self._part), self._spec):
            return ""
        return str(self._output.geterror()) or "no reason given"

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                self._finish()
        finally:
            self._discard()

    def write_rows(self, rows: Pixels) -> None:
        """Append rows: (rows, width, channels + 1) of the writer's dtype, unassociated alpha last."""
        expected = (self.width, self.channels + 1)
        if rows.ndim != 3 or rows.shape[1:] != expected or rows.dtype != self.dtype:
            raise ValueError(f"rows of {rows.shape} {rows.dtype}, not (n, {expected}) {self.dtype}")
        if self._done + len(rows) > self.height:
            raise ValueError(f"row {self._done + len(rows)} of an image of {self.height} rows")
        if not len(rows):
            return
        samples = np.ascontiguousarray(self._convert(rows))
        if self._tiff:
            with self._told():
                self._tiff.write(samples)
            self._done += len(rows)
            return
        if self.format == "jpeg":
            self._refuse_full_disk(samples.nbytes)
        top = self._spec.y + self._done
        with trace.span("encode", trace.FILE, rows=len(rows)):
            written = self._output.write_scanlines(top, top + len(rows), 0, samples)
        if not written or self._has_hidden_error(self._output):
            raise self._failure(self._output.geterror())
        self._done += len(rows)

    @contextlib.contextmanager
    def _told(self) -> Iterator[None]:
        """Turn the system's errors into ours."""
        try:
            yield
        except OSError as error:
            raise self._failure(error.strerror or str(error)) from None

    def _has_hidden_error(self, output: Any) -> bool:
        """Whether a disk was full, of which PNG's writer only takes a note; TIFF's notes are no errors."""
        return self.format == "png" and bool(output.has_error)

    def _refuse_full_disk(self, samples: int) -> None:
        """Raise `OutputError` before libjpeg meets a full disk, or the end of what one file may take: it
        would end the process, untidily.

        samples     that are written next. OpenImageIO completes with blanks what is closed before its end.
        """
        blank = _JPEG_BLANK * self.width * (self.height - self._done) * self.channels
        quality = int(self.compression.partition(":")[2] or 100)
        needed = tiffwriter.worst_case("jpeg", quality) * samples + blank + _JPEG_LEAST
        disk = shutil.disk_usage(self._part.parent)
        if disk.total and disk.free < needed:  # some network folders say 0 of 0
            raise self._failure(os.strerror(errno.ENOSPC))
        if not may_grow(self._part, math.ceil(needed)):
            raise self._failure(f"{os.strerror(errno.EFBIG)}, by the limit for one file (ulimit -f)")

    def _convert(self, rows: Pixels) -> Pixels:
        """To the stored depth and the format's kind of alpha."""
        if self.dtype.kind == "f" and self.stored.kind == "u" and not self._clipped:
            self._clipped = bool((rows[..., :-1] > _OVERSHOOT).any())
            if self._clipped:
                _log.warning("%s: values above 1.0 are clipped; choose .exr or .tif to keep them", self.path)
        rows = to_depth(rows, self.stored)
        if self.format == "jpeg":
            alpha = rows[..., -1:].astype(np.uint16)
            return ((rows[..., :-1] * alpha + 127) // 255).astype(np.uint8)
        if self.format == "openexr" and bool((rows[..., -1] != 1).any()):
            return np.concatenate([rows[..., :-1] * rows[..., -1:], rows[..., -1:]], axis=2)
        return rows

    def _finish(self) -> None:
        """Close and move to the final name."""
        if self._done < self.height:
            raise OutputError(f"{self.path}: only {self._done} of {self.height} rows were made; not written")
        output, self._output = self._output, None
        if output and (not output.close() or self._has_hidden_error(output)):
            raise self._failure(output.geterror())
        with self._told():
            if self._tiff:
                self._tiff.close()
                self._tiff = None
            if self.format == "png":
                place_in_png(self._part, *self._offset)
            if self.metadata:
                embed(self._part, self.format, self.metadata)
            put(self._part, self._final)

    def _discard(self) -> None:
        """Close and remove what is not finished; nothing is left of it after `_finish`."""
        with self._scratch:  # removes the file, whatever fails before
            tiff, self._tiff = self._tiff, None
            if tiff:
                tiff.abandon()
            output, self._output = self._output, None
            if output is not None:
                with contextlib.suppress(OSError):
                    os.truncate(self._part, 0)  # room for the blanks that complete a JPEG
                with contextlib.suppress(RuntimeError):
                    output.close()

    def _failure(self, why: str) -> OutputError:
        reason = (why.strip() or "no reason given").splitlines()[0]  # PNG's writer adds a line for each block
        return OutputError(
            f"{self.path} cannot be written: {reason.strip()}; "
            f"is there room in the folder? Choose another with {self._named_with}"
        )


def write_image(
    path: Path | str,
    pixels: Pixels,
    *,
    offset: tuple[int, int] = (0, 0),
    icc: bytes | None = None,
    compression: str | None = None,
    jpeg_quality: int | None = None,
    canvas_size: tuple[int, int] | None = None,
) -> None:
    """Write pixels (height, width, 2 or 4), unassociated alpha last, as `native` has them; see `ImageWriter`.

    Raises `OutputError` for pixels of another shape and for what `ImageWriter` cannot write.
    """
    if pixels.ndim != 3 or pixels.shape[2] not in (2, 4) or not pixels.size:
        raise OutputError(
            f"{path}: the pixels have the shape {pixels.shape}; give (height, width, 4), RGB and alpha, "
            "or (height, width, 2), grey and alpha"
        )
    height, width, samples = pixels.shape
    pixels = native(pixels)
    with ImageWriter(
        path, width, height, samples - 1, pixels.dtype, offset=offset, icc=icc,
        compression=compression, jpeg_quality=jpeg_quality, canvas_size=canvas_size,
    ) as writer:  # fmt: skip
        writer.write_rows(pixels)


def check_target(
    path: Path, compression: str | None, samples: npt.DTypeLike | None = None, named_with: str = "-o"
) -> None:
    """Raise `OutputError` for a file that cannot be written, or not so, whatever it is to hold.

    samples     that it is to hold, if that is known. named_with: as `ImageWriter` has it.
    """
    final, kind = final_file(path, named_with), format_of(path)
    with explained(path, final, named_with):
        os.stat(f"{final.parent}{os.sep}")  # noqa: PTH116 - so a file is no folder
    if samples is not None:
        stored_dtype(path, kind, np.dtype(samples), None)
    used_compression(path, kind, np.dtype(np.uint8), 3, compression, None)

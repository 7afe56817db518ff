"""Read layers; give on what writes panoramas (imagewriter.py). These two alone use OpenImageIO.

Everything outside sees arrays of (rows, width, channels + 1), unassociated alpha last. OpenImageIO
multiplies colours by alpha unless told on both sides not to.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import OpenImageIO as oiio  # noqa: N813

from hugin_abflow import tiffreader, tifftags, trace
from hugin_abflow.errors import ImageReadError
from hugin_abflow.imagewriter import ImageWriter, check_target, write_image
from hugin_abflow.layer import Box, Layer, full_scale
from hugin_abflow.targets import named_in_unicode

__all__ = [
    "ImageWriter",
    "check_target",
    "image_size",
    "read_layer",
    "read_layers",
    "use_threads",
    "write_image",
]

Pixels = npt.NDArray[Any]

_DTYPES = {"uint8": np.uint8, "uint16": np.uint16, "half": np.float16, "float": np.float32}
_UNASSOCIATED = "oiio:UnassociatedAlpha"
# TIFF PhotometricInterpretation
_MIN_IS_WHITE, _MIN_IS_BLACK, _RGB, _PALETTE, _SEPARATED, _LABS = 0, 1, 2, 3, 5, (8, 9, 10)
_MAX_CHUNK = 32 << 20  # a strip above this size (bytes) is not decoded whole to get a few rows of it
_MAX_KEPT = 1 << 20  # bytes of already decoded rows that a layer keeps for its next read


def read_layer(path: Path | str) -> Layer:
    """The one layer in a file: TIFF (cropped or not, BigTIFF, tiled), EXR, PNG or JPEG.

    8, 16 bit, half or float; grey or RGB, with or without alpha. Pixels are decoded when
    `Layer.read` is called. Raises `ImageReadError` for what cannot be decoded, for palette, CMYK,
    Lab and 1-bit images, for grey ones whose 0 is white and that have alpha or more than 8 bit, and for a
    file of several layers (see `read_layers`).
    """
    layers = read_layers(path)
    if len(layers) > 1:
        raise ImageReadError(
            f"{path} holds {len(layers)} layers where one is expected; give one file a layer"
        )
    return layers[0]


def read_layers(path: Path | str) -> list[Layer]:
    """All layers in a file, thumbnails left out: the pages of nona's ``TIFF_multilayer``, else one."""
    path = Path(path)
    source = _open(path, 0)
    is_tiff = source.format_name() == "tiff"
    places = tifftags.read_places(path) if is_tiff else [None]
    wanted = [page for page, place in enumerate(places) if place is None or not place.reduced]
    layers = []
    for page in wanted:
        if not source.seek_subimage(page, 0):
            raise _unreadable(path, source.geterror())
        name = path.name if len(wanted) == 1 else f"{path.name}[{page}]"
        layers.append(_describe(path, name, page, source, places[page]))
    source.close()
    if not layers:
        raise ImageReadError(f"{path} holds no full-size image; make the layer again")
    return layers


def use_threads(count: int) -> None:
    """Have OpenImageIO decode and encode one file on so many cores, in the whole process."""
    oiio.attribute("threads", count)


def image_size(path: Path) -> tuple[int, int] | None:
    """Width and height of an image file, px; None if it is none that can be opened."""
    try:
        spec = _open(path, 0).spec()
    except ImageReadError:
        return None
    return spec.width, spec.height


def _open(path: Path, page: int) -> Any:
    """An ImageInput that leaves colours as they are stored."""
    if not named_in_unicode(path):
        raise ImageReadError(f"{path} cannot be read: its path is not valid UTF-8; rename it")
    config = oiio.ImageSpec()
    config[_UNASSOCIATED] = 1
    source = oiio.ImageInput.open(str(path), config)
    if source is None:
        raise _unreadable(path, oiio.geterror())
    if page and not source.seek_subimage(page, 0):
        raise _unreadable(path, source.geterror())
    return source


def _unreadable(path: Path, why: str) -> ImageReadError:
    if not path.exists():
        return ImageReadError(f"{path} is not there")
    reason = (why.strip() or "unknown format").splitlines()[0]  # OpenImageIO adds a line for each strip
    return ImageReadError(f"{path} cannot be read ({reason}); make the layer again")


def _describe(path: Path, name: str, page: int, source: Any, place: tifftags.Place | None) -> Layer:
    """The layer of the page that `source` stands at."""
    spec = source.spec()
    _refuse_unusable(path, spec)
    left, top, canvas = spec.x, spec.y, None
    if place is not None:
        # of several pages, nona gives the crop's size for the canvas's, and places on the canvas all the same
        left, top, canvas = place.x, place.y, None if place.paged else place.canvas
    elif source.format_name() == "openexr" and spec.full_x == 0 and spec.full_y == 0:
        canvas = spec.full_width, spec.full_height
    rows = _Rows(path, page, spec)
    profile = spec.getattribute("ICCProfile")
    return Layer(
        name=name,
        box=Box.at(left, top, spec.width, spec.height),
        dtype=rows.dtype,
        channels=rows.channels,
        read=rows.read,
        icc=None if profile is None else bytes(profile),
        canvas_size=canvas,
        file=path,
        has_alpha=rows.has_alpha,
        strip=rows.chunk,
        compressed=spec.get_string_attribute("compression") != "none",
    )


def _refuse_unusable(path: Path, spec: Any) -> None:
    """Raise `ImageReadError` for pixels that are no plain grey or RGB."""
    photometric = spec.get_int_attribute("tiff:PhotometricInterpretation", 1)
    bits = spec.get_int_attribute("oiio:BitsPerSample", 0)
    found = None
    if photometric == _PALETTE:
        found = "a palette image"
    elif photometric == _SEPARATED or spec.get_string_attribute("jpeg:ColorSpace").upper() in (
        "CMYK",
        "YCCK",
    ):
        found = "a CMYK image"
    elif photometric == _MIN_IS_WHITE and (spec.nchannels > 1 or str(spec.format) != "uint8"):
        found = "a grey image whose 0 is white"  # OpenImageIO inverts alpha, too; of 16 bit nothing
    elif photometric in _LABS:  # OpenImageIO calls its samples R, G and B
        found = "a Lab image"
    elif 0 < bits < 8:
        found = f"a {bits}-bit image"
    elif str(spec.format) not in _DTYPES:
        found = f"of sample type {spec.format}"
    elif spec.nchannels > 4 and not {"R", "G", "B"} <= set(spec.channelnames):
        found = f"an image of {spec.nchannels} samples"
    if found:
        raise ImageReadError(
            f"{path} is {found}; layers must be grey or RGB with 8, 16 bit, half or float samples"
        )


def _is_for_tifffile(spec: Any) -> bool:
    """Whether `tiffreader` has to decode it, and can: strips of whole samples, black is 0."""
    return bool(
        spec.get_int_attribute("tiff:Compression") in tiffreader.COMPRESSIONS
        and spec.tile_width == 0
        and spec.get_int_attribute("tiff:PlanarConfiguration", 1) == 1
        and spec.get_int_attribute("tiff:PhotometricInterpretation") in (_MIN_IS_BLACK, _RGB)
        and spec.get_int_attribute("oiio:BitsPerSample") == 8 * spec.format.basesize()
    )


class _Rows:
    """Rows of one stored image, decoded when asked for; the `read` of a `Layer`, for several threads."""

    def __init__(self, path: Path, page: int, spec: Any) -> None:
        self.path, self.page = path, page
        self.x, self.y, self.width, self.height = spec.x, spec.y, spec.width, spec.height
        self.samples: int = spec.nchannels
        self.dtype = np.dtype(_DTYPES[str(spec.format)])
        self.tiled = spec.tile_width > 0
        self.by_tifffile = _is_for_tifffile(spec)
        names = list(spec.channelnames)
        alpha = spec.alpha_channel
        if alpha < 0 and self.samples in (2, 4):
            alpha = self.samples - 1  # ExtraSamples "unspecified": what older tools write for alpha
        colours = [names.index(c) for c in "RGB"] if {"R", "G", "B"} <= set(names) else [0]
        self.channels = len(colours)
        self.order = [*colours, alpha] if alpha >= 0 else colours
        self.has_alpha = alpha >= 0
        self.associated = spec.alpha_channel >= 0 and not spec.get_int_attribute(_UNASSOCIATED, 0)
        self.chunk = self._chunk_rows(spec)
        self._idle, self._busy, self._done = list[_Decoder](), 0, False
        self._lock = threading.Lock()

    def _chunk_rows(self, spec: Any) -> int:
        """Rows that are decoded together; 1 where decoding is strictly sequential."""
        rows = spec.tile_height if self.tiled else spec.get_int_attribute("oiio:RowsPerChunk", 1)
        too_large = not self.tiled and not self.by_tifffile and rows * spec.scanline_bytes(True) > _MAX_CHUNK
        return 1 if too_large else max(1, int(rows))

    def read(self, top: int, bottom: int) -> Pixels:
        """Rows `top` to `bottom`: (bottom - top, width, channels + 1), read-only."""
        if not 0 <= top <= bottom <= self.height:
            raise IndexError(f"rows {top}..{bottom} of an image of {self.height} rows")
        if top == bottom:
            return np.empty((0, self.width, self.channels + 1), self.dtype)
        with (
            self._decoder(top) as decoder,
            trace.span("decode", trace.FILE, file=self.path.name, rows=bottom - top),
        ):
            rows = decoder.read(top, bottom)
            self._done = self._done or (bottom == self.height and self.chunk > 1)
        return rows

    @contextmanager
    def _decoder(self, top: int) -> Iterator[_Decoder]:
        """One that nobody uses: at best one that stands where rows from `top` on begin. If it fails it is not
        used again; once the image was read to its end, and nobody reads it, none are: layers can be many, and
        their files and rows take room.
        """
        with self._lock:
            self._busy += 1
            at = next((index for index, idle in enumerate(self._idle) if idle.stands_at(top)), -1)
            decoder = self._idle.pop(at) if self._idle else _Decoder(self)
        failed = True
        try:
            yield decoder
            failed = False
        finally:
            with self._lock:
                self._busy -= 1
                if not failed:
                    self._idle.append(decoder)
                if self._done and not self._busy:
                    self._idle.clear()
                    self._done = False

    def normalised(self, raw: Pixels) -> Pixels:
        """Stored samples -> colours and unassociated alpha; NaN and infinity -> alpha 0."""
        full = full_scale(raw.dtype)
        if self.order == list(range(raw.shape[2])) and self.has_alpha:
            rows = raw
        else:
            rows = np.full((*raw.shape[:2], self.channels + 1), full, raw.dtype)
            rows[..., : len(self.order)] = raw[..., self.order]
        if self.associated:
            _unpremultiply(rows)
        if rows.dtype.kind == "f":
            rows[~np.isfinite(rows).all(axis=2)] = 0
        return rows


class _Decoder:
    """A place in an image from where rows are decoded, for one thread at a time.

    OpenImageIO decodes from the top again after each step back, and everything in between on a step
    forward that does not begin at a strip. So whole strips are decoded, and the rows below the last
    answer are kept for the next.
    """

    def __init__(self, image: _Rows) -> None:
        self._image = image
        self._source: Any = None
        self._kept: Pixels | None = None  # rows that end at self._end
        self._end = 0

    @property
    def _kept_from(self) -> int:
        return self._end - (0 if self._kept is None else len(self._kept))

    def stands_at(self, top: int) -> bool:
        """Whether it goes on where it is if it reads from row `top` on."""
        return self._kept_from <= top <= self._end

    def read(self, top: int, bottom: int) -> Pixels:
        """See `_Rows.read`."""
        if self._kept is not None and self._kept_from <= top and bottom <= self._end:
            rows, first = self._kept, self._kept_from
        else:
            rows, first = self._extend(top, bottom)
            rows.setflags(write=False)  # the next answer is cut from the same memory
            self._keep(rows, first)
        return rows[top - first : bottom - first]

    def _extend(self, top: int, bottom: int) -> tuple[Pixels, int]:
        """Rows that include `top` to `bottom`, and which is the first: kept ones and newly decoded ones."""
        chunk, kept_from = self._image.chunk, self._kept_from
        end = min(self._image.height, bottom + -bottom % chunk)
        if self._kept is not None and kept_from <= top < self._end:
            return np.concatenate([self._kept[top - kept_from :], self._decode(self._end, end)]), top
        start = top - top % chunk
        return self._decode(start, end), start

    def _keep(self, rows: Pixels, first: int) -> None:
        """Remember the last rows for the next answer."""
        self._end = first + len(rows)
        if rows.nbytes > _MAX_KEPT:
            rows = rows[-max(self._image.chunk, _MAX_KEPT // rows[0].nbytes) :].copy()
            rows.setflags(write=False)
        self._kept = rows

    def _decode(self, first: int, last: int) -> Pixels:
        image = self._image
        if image.by_tifffile:
            return image.normalised(tiffreader.read_strips(image.path, image.page, first, last))
        if self._source is None:
            self._source = _open(image.path, image.page)
        whole = image.height - image.height % image.chunk
        if last <= whole or image.tiled or not whole:
            return image.normalised(self._stored(first, last))
        # OpenImageIO decodes from the top to get at the last, shorter strip unless it comes from the
        # strip above it
        above = self._stored(min(first, whole - image.chunk), whole)
        below = self._stored(whole, last)
        return image.normalised(below if first == whole else np.concatenate([above, below]))

    def _stored(self, first: int, last: int) -> Pixels:
        """Samples as they are in the file."""
        image = self._image
        top, bottom = image.y + first, image.y + last
        if image.tiled:
            right = image.x + image.width
            raw = self._source.read_tiles(image.x, right, top, bottom, 0, 1, 0, image.samples, "unknown")
        else:
            raw = self._source.read_scanlines(top, bottom, 0, 0, image.samples, "unknown")
        if raw is None:
            raise _unreadable(image.path, self._source.geterror())
        return np.asarray(raw)


def _unpremultiply(rows: Pixels) -> None:
    """Divide colours by alpha in place; nona's alpha is binary, so that its colours stay as they are."""
    full = full_scale(rows.dtype)
    partial = (rows[..., -1] > 0) & (rows[..., -1] < full)
    if partial.any():
        soft = rows[partial].astype(np.float64)
        colours = soft[:, :-1] * (full / soft[:, -1:])
        if rows.dtype.kind == "u":
            colours = np.minimum(np.rint(colours), full)
        rows[partial, :-1] = colours.astype(rows.dtype)

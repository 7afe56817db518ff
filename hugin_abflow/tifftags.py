"""TIFF's directories of tags: what OpenImageIO reads inexactly, cannot leave out or cannot write.

OpenImageIO truncates position * resolution, so that a layer which nona put at x = 49 would be read as
48; it stamps the time of writing into each file, so that two equal panoramas would differ; and of EXIF it
reads and writes a part, GPS into the wrong directory. EXIF is made of the same directories in all files.
Classic TIFF and BigTIFF, either byte order. Tags: TIFF 6.0, sections 8 and 12; 33300 and 33301 are
PIXAR's full image size, which nona sets to the canvas (``vigra_ext/ImageTransforms`` of Hugin).
"""

from __future__ import annotations

import io
import struct
from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from hugin_abflow.errors import ImageReadError

SUBFILE_TYPE, X_RESOLUTION, Y_RESOLUTION, X_POSITION, Y_POSITION = 254, 282, 283, 286, 287
FULL_WIDTH, FULL_HEIGHT = 33300, 33301
_IN_PIXELS = {
    X_POSITION: "XPosition", Y_POSITION: "YPosition", FULL_WIDTH: "ImageFullWidth",
    FULL_HEIGHT: "ImageFullLength",
}  # fmt: skip
FURTHEST = 10_000_000  # pixels from the canvas's corner; TIFF tells positions as fractions of 32 bits
MAIN, EXIF, GPS = 0, 34665, 34853  # directories, by the tag in the main one that points to them
ASCII, SHORT, LONG, RATIONAL, UNDEFINED = 2, 3, 4, 5, 7  # TIFF types
# Software, DateTime, Artist, XMP, Photoshop's own, EXIF: editors and exiftool write some of these, nona none.
# FillOrder, WhitePoint, PrimaryChromaticities: ImageMagick writes nothing else that nona does not.
_EDITORS = frozenset({266, 305, 306, 315, 318, 319, 700, 34377, EXIF})
_NUMBERS = {3: "H", 4: "I", 5: "II", 9: "i", 10: "ii", 11: "f", 12: "d", 16: "Q"}  # TIFF type -> struct
_RATIONALS = (5, 10)
_IFD8 = 18
# Bytes of a value of each type, and of the numbers that it is made of.
_KINDS = {1: (1, 2, 6, 7), 2: (3, 8), 4: (4, 9, 11, 13), 8: (5, 10, 12, 16, 17, 18)}
_SIZES = {kind: size for size, kinds in _KINDS.items() for kind in kinds}
_SWAPPED = _SIZES | {5: 4, 10: 4}
_LONGEST = 1 << 15  # bytes; JPEG's segments, in which EXIF must fit, end at twice of it
_MAX_PAGES = 65536  # a chain of directories that is longer runs in a circle
_MAX_ENTRIES = 65535  # of a directory; BigTIFF's count has room for more, but tags have two bytes


@dataclass(frozen=True)
class Value:
    """What a tag holds: the TIFF type, and the bytes, little-endian."""

    kind: int
    data: bytes


Directories = Mapping[int, Mapping[int, Value]]  # MAIN, EXIF, GPS -> tag -> value


@dataclass(frozen=True)
class Place:
    """Where one page of a TIFF file lies on its canvas.

    x, y        position in pixels, ``round(position * resolution)``; 0 without the tags.
    canvas      (width, height) of the full image, if the file tells it.
    reduced     the page is a thumbnail of another page.
    paged       the page declares itself one page of several (``TIFF_multilayer``).
    """

    x: int
    y: int
    canvas: tuple[int, int] | None
    reduced: bool
    paged: bool


@dataclass(frozen=True)
class _Layout:
    """Byte order and field widths of one file."""

    order: str
    big: bool

    @property
    def entry(self) -> int:
        return 20 if self.big else 12

    @property
    def head(self) -> str:
        return self.order + ("HHQ" if self.big else "HHI")

    @property
    def inline(self) -> int:
        """Bytes of an entry that hold a value, or the offset of a longer one."""
        return 8 if self.big else 4

    @property
    def count(self) -> str:
        return self.order + ("Q" if self.big else "H")

    @property
    def offset(self) -> str:
        return self.order + ("Q" if self.big else "I")


def read_places(path: Path) -> list[Place]:
    """The places of all pages, in file order.

    Raises `ImageReadError` for what is no TIFF file, and for places and canvases that cannot be.
    """
    try:
        with path.open("rb") as file:
            layout, first = _read_header(file)
            return [
                _place(path, _numbers(file, layout, start)) for start in _directories(file, layout, first)
            ]
    except (OSError, struct.error, OverflowError, ValueError) as error:
        raise ImageReadError(f"{path} is not a readable TIFF file ({error}); make the layer again") from None


def is_edited(path: Path) -> bool:
    """Whether another program than nona wrote a TIFF, or changed it; False for what is no TIFF file."""
    try:
        with path.open("rb") as file:
            return bool(_EDITORS & _entries(file, *_read_header(file))[0].keys())
    except (OSError, struct.error, OverflowError, ValueError):
        return False


def read_directories(file: BinaryIO) -> dict[int, dict[int, Value]]:
    """The tags of a TIFF file, or EXIF block, with EXIF's and GPS's own; values above 32 kB are left out.

    Raises `struct.error` for what is no TIFF.
    """
    layout, start = _read_header(file)
    found = {MAIN: _values(file, layout, start)}
    for pointer in (EXIF, GPS):
        place = found[MAIN].pop(pointer, None)
        if place is not None and place.kind in _NUMBERS | {13: "I", _IFD8: "Q"}:
            found[pointer] = _values(file, layout, int.from_bytes(place.data, "little"))
    return found


def read_long(file: BinaryIO, tags: Container[int], most: int) -> dict[int, bytes]:
    """What some tags of the first page hold, of up to `most` bytes, as it is in the file.

    Raises `struct.error` for what is no TIFF.
    """
    layout, start = _read_header(file)
    entries = _entries(file, layout, start)[0]
    found = {tag: _content(file, layout, entry, most) for tag, entry in entries.items() if tag in tags}
    return {tag: data for tag, data in found.items() if data}


def add_directories(path: Path, added: Directories) -> None:
    """Put tags into the first page, in place of those of the same numbers; EXIF's and GPS's are replaced."""
    with path.open("r+b") as file:
        layout, start = _read_header(file)
        kept, following = _entries(file, layout, start)
        at = file.seek(0, io.SEEK_END)
        file.write(b"\0" * (at % 2))  # directories begin at even offsets
        at += at % 2
        file.write(_pack(layout, added, at, kept, following))
        file.seek(8 if layout.big else 4)
        file.write(struct.pack(layout.offset, at))


def pack_directories(directories: Directories) -> bytes:
    """A TIFF file without an image: what EXIF is in files of other formats."""
    return b"II*\0\x08\0\0\0" + _pack(_Layout("<", False), directories, 8)


def _pack(
    layout: _Layout,
    directories: Directories,
    at: int,
    kept: Mapping[int, bytes] | None = None,
    following: bytes = b"",
) -> bytes:
    """The main directory, to lie at offset `at`, and behind it those that it points to.

    kept        entries of the main directory as they are in the file.
    following   offset of the next page's directory, as in the file.
    """
    parts = {pointer: values for pointer, values in directories.items() if pointer != MAIN and values}
    pointers = dict.fromkeys(parts, 0)
    main, behind = b"", b""
    for _ in range(2):  # at first to know how long the main directory is
        kind, size = (_IFD8, 8) if layout.big else (LONG, 4)
        own = {tag: Value(kind, offset.to_bytes(size, "little")) for tag, offset in pointers.items()}
        main = _directory(layout, {**directories.get(MAIN, {}), **own}, at, kept or {}, following)
        behind = b""
        for pointer, values in parts.items():
            pointers[pointer] = at + len(main) + len(behind)
            behind += _directory(layout, values, pointers[pointer])
    return main + behind


def _directory(
    layout: _Layout,
    values: Mapping[int, Value],
    at: int,
    kept: Mapping[int, bytes] | None = None,
    following: bytes = b"",
) -> bytes:
    """One directory to lie at offset `at`, with its longer values behind it; of even length."""
    entries = dict(kept or {})
    end = struct.calcsize(layout.offset)
    longer_at = at + struct.calcsize(layout.count) + layout.entry * len({*entries, *values}) + end
    longer = b""
    for tag, value in values.items():
        data = value.data
        if layout.order == ">":
            data = np.frombuffer(data, f"<u{_SWAPPED[value.kind]}").byteswap().tobytes()
        if len(data) <= layout.inline:
            field = data.ljust(layout.inline, b"\0")
        else:
            field = struct.pack(layout.offset, longer_at + len(longer))
            longer += data + b"\0" * (len(data) % 2)
        entries[tag] = struct.pack(layout.head, tag, value.kind, len(data) // _SIZES[value.kind])
        entries[tag] += field
    table = b"".join(entries[tag] for tag in sorted(entries))
    return struct.pack(layout.count, len(entries)) + table + (following or b"\0" * end) + longer


def _read_header(file: BinaryIO) -> tuple[_Layout, int]:
    """The file's layout and the offset of its first directory."""
    mark = file.read(4)
    for order, small, big in (("<", b"II*\0", b"II+\0"), (">", b"MM\0*", b"MM\0+")):
        if mark in (small, big):
            layout = _Layout(order, mark == big)
            if layout.big:
                file.read(4)  # size of offsets (8) and a zero
            (first,) = struct.unpack(layout.offset, file.read(struct.calcsize(layout.offset)))
            return layout, first
    raise struct.error("no TIFF signature")


def _directories(file: BinaryIO, layout: _Layout, first: int) -> Iterator[int]:
    """Offsets of the page directories."""
    start, size = first, struct.calcsize(layout.count)
    for _ in range(_MAX_PAGES):
        if not start:
            return
        yield start
        file.seek(start)
        (count,) = struct.unpack(layout.count, file.read(size))
        file.seek(start + size + count * layout.entry)
        (start,) = struct.unpack(layout.offset, file.read(struct.calcsize(layout.offset)))
    raise struct.error("the pages form a circle")


def _entries(file: BinaryIO, layout: _Layout, start: int) -> tuple[dict[int, bytes], bytes]:
    """The entries of one directory by tag, as they are, and the offset of the next page's directory."""
    file.seek(start)
    (count,) = struct.unpack(layout.count, file.read(struct.calcsize(layout.count)))
    if count > _MAX_ENTRIES:
        raise struct.error(f"a directory of {count} tags")
    table = file.read(count * layout.entry)
    following = file.read(struct.calcsize(layout.offset))
    entries = (table[at : at + layout.entry] for at in range(0, len(table), layout.entry))
    return {struct.unpack_from(layout.order + "H", entry)[0]: entry for entry in entries}, following


def _values(file: BinaryIO, layout: _Layout, start: int) -> dict[int, Value]:
    """The values of one directory, but for very long ones."""
    values: dict[int, Value] = {}
    for tag, entry in _entries(file, layout, start)[0].items():
        data = _content(file, layout, entry, _LONGEST)
        if data:
            _, kind, _ = struct.unpack_from(layout.head, entry)
            if layout.order == ">":
                data = np.frombuffer(data, f">u{_SWAPPED[kind]}").byteswap().tobytes()
            values[tag] = Value(kind, data)
    return values


def _content(file: BinaryIO, layout: _Layout, entry: bytes, most: int) -> bytes:
    """What an entry holds, as it is in the file; empty if that is longer than `most`, or cut."""
    _, kind, count = struct.unpack_from(layout.head, entry)
    length = count * _SIZES.get(kind, 0)
    if not 0 < length <= most:
        return b""
    data = entry[-layout.inline :][:length]
    if length > layout.inline:
        file.seek(struct.unpack(layout.offset, entry[-layout.inline :])[0])
        data = file.read(length)
    return data if len(data) == length else b""


def _numbers(file: BinaryIO, layout: _Layout, start: int) -> dict[int, float]:
    """All tags of one directory that hold a single number."""
    found: dict[int, float] = {}
    for tag, value in _values(file, layout, start).items():
        if value.kind in _NUMBERS and len(value.data) == _SIZES[value.kind]:
            numbers = struct.unpack("<" + _NUMBERS[value.kind], value.data)
            found[tag] = numbers[0] / (numbers[1] or 1) if value.kind in _RATIONALS else numbers[0]
    return found


def _place(path: Path, tags: dict[int, float]) -> Place:
    """Interpret the numbers of one directory."""

    def pixels(tag: int, resolution: float = 1) -> int:
        number = tags.get(tag, 0) * resolution
        if not abs(number) <= FURTHEST:  # so is what is no number
            raise ImageReadError(
                f"{path}: its tag {_IN_PIXELS[tag]} tells {number:.9g} pixels; make the layer again"
            )
        return round(number)

    width, height = pixels(FULL_WIDTH), pixels(FULL_HEIGHT)
    kind = int(tags.get(SUBFILE_TYPE, 0))
    return Place(
        # without a resolution the position can only be meant in pixels
        x=pixels(X_POSITION, tags.get(X_RESOLUTION, 0) or 1),
        y=pixels(Y_POSITION, tags.get(Y_RESOLUTION, 0) or 1),
        canvas=(width, height) if width and height else None,
        reduced=bool(kind & 1),
        paged=bool(kind & 2),
    )

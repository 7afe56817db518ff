"""The few TIFF tags that OpenImageIO reads inexactly or cannot leave out.

OpenImageIO truncates position * resolution, so that a layer which nona put at x = 49 would be read as
48; and it stamps the time of writing into each file, so that two equal panoramas would differ.
Classic TIFF and BigTIFF, either byte order. Tags: TIFF 6.0, sections 8 and 12; 33300 and 33301 are
PIXAR's full image size, which nona sets to the canvas (``vigra_ext/ImageTransforms`` of Hugin).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from hugin_abflow.errors import ImageReadError

SUBFILE_TYPE, X_RESOLUTION, Y_RESOLUTION, X_POSITION, Y_POSITION = 254, 282, 283, 286, 287
DATE_TIME, FULL_WIDTH, FULL_HEIGHT = 306, 33300, 33301
_NUMBERS = {3: "H", 4: "I", 5: "II", 9: "i", 10: "ii", 11: "f", 12: "d", 16: "Q"}  # TIFF type -> struct
_RATIONALS = (5, 10)
_MAX_PAGES = 65536  # a chain of directories that is longer runs in a circle


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
    def count(self) -> str:
        return self.order + ("Q" if self.big else "H")

    @property
    def offset(self) -> str:
        return self.order + ("Q" if self.big else "I")


def read_places(path: Path) -> list[Place]:
    """The places of all pages, in file order. Raises `ImageReadError` for what is no TIFF file."""
    try:
        with path.open("rb") as file:
            layout, first = _read_header(file)
            return [_place(_numbers(file, layout, start)) for start in _directories(file, layout, first)]
    except (OSError, struct.error, OverflowError, ZeroDivisionError) as error:
        raise ImageReadError(f"{path} is not a readable TIFF file ({error}); make the layer again") from None


def drop_tag(path: Path, tag: int) -> None:
    """Remove one tag from the first page, in place. Does nothing where it is missing."""
    with path.open("r+b") as file:
        layout, start = _read_header(file)
        count_size = struct.calcsize(layout.count)
        file.seek(start)
        (count,) = struct.unpack(layout.count, file.read(count_size))
        table = file.read(count * layout.entry)
        following = file.read(struct.calcsize(layout.offset))
        entries = [table[at : at + layout.entry] for at in range(0, len(table), layout.entry)]
        kept = [entry for entry in entries if struct.unpack(layout.order + "H", entry[:2])[0] != tag]
        file.seek(start)
        file.write(struct.pack(layout.count, len(kept)) + b"".join(kept) + following)


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


def _numbers(file: BinaryIO, layout: _Layout, start: int) -> dict[int, float]:
    """All tags of one directory that hold a single number."""
    file.seek(start)
    (count,) = struct.unpack(layout.count, file.read(struct.calcsize(layout.count)))
    table = file.read(count * layout.entry)
    head, inline = layout.order + ("HHQ" if layout.big else "HHI"), 8 if layout.big else 4
    found: dict[int, float] = {}
    for at in range(0, len(table), layout.entry):
        tag, kind, length = struct.unpack_from(head, table, at)
        if length != 1 or kind not in _NUMBERS:
            continue
        form = layout.order + _NUMBERS[kind]
        value = table[at + layout.entry - inline : at + layout.entry]
        if struct.calcsize(form) > inline:
            file.seek(struct.unpack(layout.offset, value)[0])
            value = file.read(struct.calcsize(form))
        numbers = struct.unpack_from(form, value)
        found[tag] = numbers[0] / (numbers[1] or 1) if kind in _RATIONALS else numbers[0]
    return found


def _place(tags: dict[int, float]) -> Place:
    """Interpret the numbers of one directory."""
    width, height = round(tags.get(FULL_WIDTH, 0)), round(tags.get(FULL_HEIGHT, 0))
    kind = int(tags.get(SUBFILE_TYPE, 0))
    return Place(
        # without a resolution the position can only be meant in pixels
        x=round(tags.get(X_POSITION, 0) * (tags.get(X_RESOLUTION, 0) or 1)),
        y=round(tags.get(Y_POSITION, 0) * (tags.get(Y_RESOLUTION, 0) or 1)),
        canvas=(width, height) if width and height else None,
        reduced=bool(kind & 1),
        paged=bool(kind & 2),
    )

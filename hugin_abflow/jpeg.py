"""JPEG files (ITU-T T.81, B.1): their segments, and whether they were cut."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

START = b"\xff\xd8"  # of a file
APP0, APP1, APP13 = 0xE0, 0xE1, 0xED
_SCAN, _END = 0xDA, 0xD9
# Any mark but restarts, which lie within what is coded.
_MARK = re.compile(rb"\xff([^\x00\xff\xd0-\xd7])", re.DOTALL)


def segments(file: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Kinds and contents of the segments before the first scan, behind each of which the file then is.

    Raises `struct.error` where the file ends before.
    """
    file.seek(len(START))
    while True:
        mark, kind = struct.unpack(">BB", file.read(2))
        while mark == kind == 0xFF:  # any number of bytes may fill up what is before a segment
            (kind,) = struct.unpack(">B", file.read(1))
        if mark != 0xFF or kind == _SCAN:
            return
        (length,) = struct.unpack(">H", file.read(2))
        yield kind, file.read(length - 2)


def is_cut(path: Path) -> bool:
    """Whether a JPEG file ends before the mark of its image's end; there may be other things behind that.

    Decoders paint grey what is missing, and are content. Other files are not cut, nor is what cannot be read:
    who decodes them tells.
    """
    try:
        with path.open("rb") as file:
            if file.read(len(START)) != START:  # others may have gigabytes
                return False
            content = file.read()
    except OSError:
        return False
    at = 0
    while mark := _MARK.search(content, at):
        if mark[1][0] == _END:
            return False
        length = int.from_bytes(content[mark.end() : mark.end() + 2])
        at = mark.end() + length  # what is coded comes behind the last segment, up to the next mark
    return True

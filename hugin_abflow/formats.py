"""What a file is, by its first bytes: which kind of picture, a text, a project; what Hugin reads of these."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

# Bytes from the start, and what begins so. "ftyp" of ISO 14496-12 comes after the length of its box.
_BEGINNINGS = (
    (0, b"\xff\xd8\xff", "JPEG"),
    (0, b"\x89PNG\r\n", "PNG"),
    (0, b"II*\0", "TIFF"),
    (0, b"MM\0*", "TIFF"),
    (0, b"v/1\x01", "OpenEXR"),
    (8, b"WEBP", "WebP"),
    (4, b"ftypavi", "AVIF"),
    (4, b"ftypcrx", "camera raw"),
    *((4, b"ftyp" + brand, "HEIF") for brand in (b"heic", b"heix", b"hevc", b"mif1", b"msf1")),
    (0, b"\xff\x0a", "JPEG XL"),
    (4, b"JXL \r\n", "JPEG XL"),
    (0, b"FUJIFILM", "camera raw"),
)
_LONGEST = 16
# Camera raw is TIFF of another kind in most: its name tells it.
_RAW = frozenset(
    {".arw", ".cr2", ".cr3", ".dng", ".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".srw"}
)  # fmt: skip
# A line by which a text is told to be a project: the first one of Hugin's or PTGui's, or a p-, i- or o-line.
_OF_PROJECTS = re.compile(rb"(?im)^(?:\xef\xbb\xbf)?(?:# (?:hugin|ptgui) project file|[pio] [fwh]\d)")
_READ_BY_HUGIN = frozenset({"JPEG", "PNG", "TIFF", "OpenEXR"})


def picture_format(data: bytes) -> str | None:
    """The format of the picture that a file begins so; None: it is none of those that are known here."""
    return next((name for at, start, name in _BEGINNINGS if data[at:].startswith(start)), None)


def holds_text(data: bytes) -> bool:
    """Whether a file that begins so may be a text: pictures, camera raws and videos have a NUL soon."""
    return b"\0" not in data


def holds_project(data: bytes) -> bool:
    """Whether a file that begins so may be a project, whatever its name."""
    return _OF_PROJECTS.search(data) is not None


def foreign_format(photo: Path) -> str | None:
    """The format of a photo that Hugin's programs do not read; None: they do, or it is not known."""
    if photo.suffix.lower() in _RAW:
        return "camera raw"
    with suppress(OSError), photo.open("rb") as file:
        found = picture_format(file.read(_LONGEST))
        return None if found in _READ_BY_HUGIN else found
    return None

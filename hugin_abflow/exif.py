"""EXIF, XMP and IPTC in image files: read from photos, and EXIF and XMP put into panoramas.

Both are put into a file that is whole otherwise, by writing at its end (TIFF) or by moving what follows
(JPEG, PNG); no pixel is decoded, and no other program is needed. Formats: CIPA DC-008 (Exif 2.32), Adobe's
XMP specification part 3, the PNG specification (third edition).
"""

from __future__ import annotations

import logging
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from io import SEEK_END, BytesIO
from pathlib import Path
from stat import S_ISREG
from typing import BinaryIO

from hugin_abflow import jpeg, tifftags
from hugin_abflow.tifftags import ASCII, EXIF, GPS, MAIN, SHORT, UNDEFINED, Directories, Value

_log = logging.getLogger(__name__)

SOFTWARE = 305
XMP_TAG, _IPTC_TAG, _PHOTOSHOP_TAG = 700, 33723, 34377  # of TIFF
_EXPOSURE_TIME = 33434
_PNG = b"\x89PNG\r\n\x1a\n"
_EXIF_MARK, _XMP_MARK = b"Exif\0\0", b"http://ns.adobe.com/xap/1.0/\0"  # of JPEG's APP1
_PHOTOSHOP_MARK = b"Photoshop 3.0\0"  # of JPEG's APP13
_XMP_KEY = b"XML:com.adobe.xmp\0"  # of PNG's iTXt
_IPTC = 0x0404  # among Photoshop's blocks
_MOST_XMP = 8 << 20  # bytes that are read of it: with an editor's brushes it is long
_LONGEST = 65533  # bytes of a JPEG segment
_BLOCK = 16 << 20  # bytes that are moved at a time
_NOT_IN_TIFF = (40962, 40963)  # PixelXDimension, PixelYDimension
# What EXIF must have in JPEG, and only there: ComponentsConfiguration (Y, Cb, Cr), YCbCrPositioning.
_JPEG_TAGS = {
    MAIN: {531: Value(SHORT, b"\1\0")},
    EXIF: {37121: Value(UNDEFINED, b"\1\2\3\0")},
}
# What OpenEXR's files name otherwise than by the tag's number; by directory.
_EXR_NAMES = {
    MAIN: {
        270: "ImageDescription", 271: "Make", 272: "Model", 305: "Software", 306: "DateTime", 315: "Artist",
        33432: "Copyright",
    },
    EXIF: {
        36867: "Exif:DateTimeOriginal", 36868: "Exif:DateTimeDigitized", 42035: "Exif:LensMake",
        42036: "Exif:LensModel",
    },
    GPS: {1: "GPS:LatitudeRef", 2: "GPS:Latitude", 3: "GPS:LongitudeRef", 4: "GPS:Longitude"},
}  # fmt: skip


@dataclass(frozen=True)
class Metadata:
    """What a file says of its picture beside pixels, place and profile.

    exif    tags and their values, by directory.
    xmp     an XMP packet; empty: none.
    """

    exif: Directories
    xmp: bytes = b""

    def attributes(self) -> dict[str, str | tuple[float, ...]]:
        """What EXR holds, by OpenImageIO's names: texts, and degrees, minutes, seconds."""
        # Without a date OpenImageIO writes that of now, and equal panoramas would be unequal files.
        found: dict[str, str | tuple[float, ...]] = {"DateTime": ""}
        for directory, names in _EXR_NAMES.items():
            for tag, value in self.exif.get(directory, {}).items():
                if tag in names and value.kind == ASCII:
                    found[names[tag]] = text_of(value)
                elif tag in names and len(value.data) == 24:
                    parts = struct.unpack("<6I", value.data)
                    pairs = zip(parts[::2], parts[1::2], strict=True)
                    found[names[tag]] = tuple(top / (bottom or 1) for top, bottom in pairs)
        return found


@dataclass(frozen=True)
class Packets:
    """What a photo has beside EXIF: an XMP packet, and an IPTC-IIM block; empty: none."""

    xmp: bytes = b""
    iptc: bytes = b""


def text(content: str) -> Value:
    """A text as EXIF holds it."""
    return Value(ASCII, content.encode() + b"\0")


def text_of(value: Value) -> str:
    """What `text` was given; also of cameras that pad it with blanks, or write Latin-1."""
    content = value.data.split(b"\0")[0].strip()
    try:
        return content.decode()
    except UnicodeDecodeError:
        return content.decode("latin-1")


def comment(content: str) -> Value:
    """A text as the tag UserComment holds it."""
    if content.isascii():
        return Value(UNDEFINED, b"ASCII\0\0\0" + content.encode())
    return Value(UNDEFINED, b"UNICODE\0" + content.encode("utf-16-le"))


def comment_of(value: Value | None) -> str:
    """The text of a UserComment; empty where there is none, or none that can be read."""
    if value is None:
        return ""
    code, content = value.data[:8], value.data[8:]
    if code == b"UNICODE\0":
        # in the byte order of the camera, which is forgotten: mostly letters below 256
        big = content[0::2].count(0) > content[1::2].count(0)
        return content.decode("utf-16-be" if big else "utf-16-le", "ignore").strip("\0 \ufeff")
    if code in (b"ASCII\0\0\0", bytes(8)):
        return text_of(Value(ASCII, content))
    return ""


def read_exif(path: Path) -> dict[int, dict[int, Value]]:
    """The EXIF tags of a JPEG, TIFF or PNG file; none where there are none, or none that can be read."""
    try:
        with path.open("rb") as file:
            mark = file.read(8)
            if mark[:2] == jpeg.START:
                block = _find_in_jpeg(file)
            elif mark == _PNG:
                block = _find_in_png(file)
            else:
                file.seek(0)
                return tifftags.read_directories(file)
        return tifftags.read_directories(BytesIO(block)) if block else {}
    except (OSError, struct.error, OverflowError, ValueError):
        return {}


def read_packets(path: Path) -> Packets:
    """XMP and IPTC of a JPEG, TIFF or PNG file; none where there are none, or none that can be read."""
    try:
        with path.open("rb") as file:
            mark = file.read(8)
            if mark[:2] == jpeg.START:
                return _packets_of_jpeg(file)
            if mark == _PNG:
                return Packets(_xmp_of_png(file))
            file.seek(0)
            tags = tifftags.read_long(file, (XMP_TAG, _IPTC_TAG, _PHOTOSHOP_TAG), _MOST_XMP)
            iptc = tags.get(_IPTC_TAG) or _iptc_of_photoshop(tags.get(_PHOTOSHOP_TAG, b""))
            return Packets(tags.get(XMP_TAG, b""), iptc)
    except (OSError, struct.error, OverflowError, ValueError, IndexError, zlib.error):
        return Packets()


def software(found: Directories) -> str:
    """The program that has saved a file, as its tags say; empty where they do not."""
    return text_of(found.get(MAIN, {}).get(SOFTWARE, text("")))


def is_ours(found: Directories) -> bool:
    """Whether the program that has saved a file is ours, or Hugin's."""
    return "hugin" in software(found).lower()


def is_photo(path: Path) -> bool:
    """Whether EXIF tells how a single photo was taken: that of panoramas does not, be they ours or Hugin's,
    or else it names Hugin. Several steps of a run ask it of one file, which is read again if it has changed.
    """
    with suppress(OSError, ValueError):  # it is not there, or no file can have its name
        status = path.stat()
        if S_ISREG(status.st_mode):  # who opens a pipe waits until somebody writes
            return _is_photo(path.absolute(), status.st_mtime_ns, status.st_ctime_ns, status.st_size)
    return False


@lru_cache
def _is_photo(path: Path, *state: int) -> bool:
    """The same of a file as long as its state, its times and size, is this one."""
    found = read_exif(path)
    return _EXPOSURE_TIME in found.get(EXIF, {}) and not is_ours(found)


def _find_in_jpeg(file: BinaryIO) -> bytes:
    """The EXIF block of a JPEG file, behind which the file is then."""
    for kind, content in jpeg.segments(file):
        if kind == jpeg.APP1 and content.startswith(_EXIF_MARK):
            return content[len(_EXIF_MARK) :]
    return b""


def _find_in_png(file: BinaryIO, wanted: bytes = b"eXIf") -> bytes:
    """The content of a PNG file's chunk, EXIF's by default, behind which the file is then."""
    for kind, length in _chunks(file):
        if kind == wanted:
            return file.read(length)
    return b""


def _chunks(file: BinaryIO) -> Iterator[tuple[bytes, int]]:
    """Kind and length of each chunk of a PNG file, which is where the chunk's content begins meanwhile."""
    at = len(_PNG)
    file.seek(at)
    while head := file.read(8):
        length, kind = struct.unpack(">I4s", head)
        yield kind, length
        at += len(head) + length + 4  # behind a checksum
        file.seek(at)


def _packets_of_jpeg(file: BinaryIO) -> Packets:
    """Without the parts of XMP that do not fit into its segment: thumbnails, and an editor's brushes."""
    xmp, photoshop = b"", b""
    for kind, content in jpeg.segments(file):
        if kind == jpeg.APP1 and content.startswith(_XMP_MARK):
            xmp = xmp or content[len(_XMP_MARK) :]
        elif kind == jpeg.APP13 and content.startswith(_PHOTOSHOP_MARK):
            photoshop += content[len(_PHOTOSHOP_MARK) :]  # one block may go on in the next segment
    return Packets(xmp, _iptc_of_photoshop(photoshop))


def _iptc_of_photoshop(blocks: bytes) -> bytes:
    """The IPTC block among those that Photoshop writes one behind the other; empty: none, or they are cut."""
    at = 0
    while blocks[at : at + 4] == b"8BIM" and at + 12 <= len(blocks):
        number = int.from_bytes(blocks[at + 4 : at + 6])
        start = at + 6 + (blocks[at + 6] + 2 & ~1)  # behind a name, with its length of even size
        length = int.from_bytes(blocks[start : start + 4])
        if number == _IPTC:
            return blocks[start + 4 : start + 4 + length]
        at = start + 4 + (length + 1 & ~1)
    return b""


def _xmp_of_png(file: BinaryIO) -> bytes:
    """Before or behind the pixels."""
    for kind, length in _chunks(file):
        if kind != b"iTXt" or length > _MOST_XMP:
            continue
        content = file.read(length)
        if content.startswith(_XMP_KEY):
            is_packed = content[len(_XMP_KEY)]
            packet = content[len(_XMP_KEY) + 2 :].split(b"\0", 2)[2]  # behind languages
            return zlib.decompressobj().decompress(packet, _MOST_XMP) if is_packed else packet
    return b""


def embed(path: Path, format_name: str, metadata: Metadata) -> None:
    """Put metadata into a panorama's file: OpenImageIO's "tiff", "jpeg" or "png"; others are left alone.

    TIFF may be BigTIFF. Raises `OSError`, such as for a full disk.
    """
    if format_name == "tiff":
        main = dict(metadata.exif.get(MAIN, {}))
        if metadata.xmp:
            main[XMP_TAG] = Value(1, metadata.xmp)
        exif = {tag: value for tag, value in metadata.exif.get(EXIF, {}).items() if tag not in _NOT_IN_TIFF}
        tifftags.add_directories(path, {**metadata.exif, MAIN: main, EXIF: exif})
    elif format_name == "jpeg":
        _insert_in_jpeg(path, metadata)
    elif format_name == "png":
        _insert_in_png(path, metadata)


def _insert_in_jpeg(path: Path, metadata: Metadata) -> None:
    """Behind JFIF's segment, which claims the first place.

    Here and in PNG: one block of EXIF is allowed, so an empty one that OpenImageIO writes is replaced. A
    block has to fit into a segment: the longest values are left out until it does.
    """
    exif = {
        key: {**metadata.exif.get(key, {}), **_JPEG_TAGS.get(key, {})}
        for key in {**metadata.exif, **_JPEG_TAGS}
    }
    xmp, left_out = _XMP_MARK + metadata.xmp if metadata.xmp else b"", []
    while len(block := _EXIF_MARK + tifftags.pack_directories(exif)) > _LONGEST:
        lengths = {(key, tag): len(value.data) for key, tags in exif.items() for tag, value in tags.items()}
        key, tag = max(lengths, key=lambda place: lengths[place])
        del exif[key][tag]
        left_out.append(f"EXIF tag {tag} ({lengths[key, tag]} bytes)")
    if len(xmp) > _LONGEST:
        xmp, left_out = b"", [*left_out, f"XMP ({len(xmp)} bytes)"]
    if left_out:
        _log.warning("left out of the panorama, as too long for JPEG: %s", ", ".join(left_out))
    segments = b"".join(
        struct.pack(">BBH", 0xFF, jpeg.APP1, len(content) + 2) + content
        for content in (block, xmp)
        if content
    )
    with path.open("r+b") as file:
        empty = len(_find_in_jpeg(file))
        replaced = empty + 4 + len(_EXIF_MARK) if empty else 0
        if not empty:
            file.seek(2)
            mark, kind, length = struct.unpack(">BBH", file.read(4))
            file.seek(2 + (2 + length if (mark, kind) == (0xFF, jpeg.APP0) else 0))
        _insert(file, file.tell() - replaced, segments, replaced)


def _insert_in_png(path: Path, metadata: Metadata) -> None:
    """Before the pixels: behind them, readers may overlook it."""
    chunks = _chunk(b"eXIf", tifftags.pack_directories(metadata.exif))
    if metadata.xmp:
        chunks += _chunk(b"iTXt", _XMP_KEY + bytes(4) + metadata.xmp)
    with path.open("r+b") as file:
        empty = len(_find_in_png(file))
        at = file.tell() - empty - 8 if empty else len(_PNG) + 25
        _insert(file, at, chunks, replaced=empty + 12 if empty else 0)


def place_in_png(path: Path, left: int, top: int) -> None:
    """Have a PNG file say where on the canvas it lies, in pixels, as enblend's do; before the pixels.

    Raises `OSError`.
    """
    chunk = _chunk(b"oFFs", struct.pack(">iiB", left, top, 0))
    with path.open("r+b") as file:
        if said := _find_in_png(file, b"oFFs"):  # OpenImageIO says 0, 0
            file.seek(file.tell() - len(said) - 8)
            file.write(chunk)
        else:
            _insert(file, len(_PNG) + 25, chunk)


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def _insert(file: BinaryIO, at: int, data: bytes, replaced: int = 0) -> None:
    """Put `data` into a file at `at`, in place of as many bytes as are `replaced`."""
    end, further = file.seek(0, SEEK_END), len(data) - replaced
    blocks = range(at + replaced, end, _BLOCK)
    # none may overwrite what has still to be moved
    for start in reversed(blocks) if further > 0 else blocks:
        file.seek(start)
        block = file.read(min(_BLOCK, end - start))
        file.seek(start + further)
        file.write(block)
    file.seek(at)
    file.write(data)
    file.truncate(end + further)

"""EXIF and XMP: read from photos, put into files of all formats; read back by exiftool."""

from __future__ import annotations

import io
import json
import os
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
import tifffile
from conftest import ICC, noise

from hugin_abflow import exif as exif_module
from hugin_abflow import tifftags
from hugin_abflow.errors import OutputError
from hugin_abflow.exif import (
    Metadata,
    comment,
    comment_of,
    embed,
    is_photo,
    place_in_png,
    read_exif,
    text,
    text_of,
)
from hugin_abflow.images import ImageWriter, read_layer
from hugin_abflow.tifftags import ASCII, EXIF, GPS, MAIN, Value

MAKE, SOFTWARE, ARTIST, COMMENT = 271, 305, 315, 37510
XMP = b"<?xpacket begin='' id=''?><x:xmpmeta xmlns:x='adobe:ns:meta/'></x:xmpmeta><?xpacket end='w'?>"
TAGS = {
    MAIN: {MAKE: text("Acme"), ARTIST: text("Zoë of the long name"), SOFTWARE: text("x")},
    EXIF: {36867: text("2020:01:02 03:04:05"), COMMENT: comment("one\ntwo")},
    GPS: {
        1: text("N"),
        2: Value(5, struct.pack("<6I", 48, 1, 30, 1, 1234, 100)),
        3: text("E"),
        4: Value(5, struct.pack("<6I", 11, 1, 15, 1, 0, 1)),
    },
}
FORMATS = {".tif": "tiff", ".jpg": "jpeg", ".png": "png"}


def picture(path: Path, dtype: type = np.uint8, metadata: Metadata | None = None, **options) -> np.ndarray:
    """Write noise with metadata; gives the pixels."""
    pixels = noise(dtype)
    height, width, samples = pixels.shape
    with ImageWriter(path, width, height, samples - 1, dtype, metadata=metadata, **options) as writer:
        writer.write_rows(pixels)
    return pixels


def shown(exiftool: str, path: Path) -> dict[str, object]:
    """What exiftool reads, by ``Group:Tag``; it must find nothing to complain about."""
    command = [exiftool, "-json", "-n", "-G1", "-a", "-warning", "-all", str(path)]
    (tags,) = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    assert "ExifTool:Warning" not in tags
    return dict(tags)


@pytest.mark.parametrize("ending", FORMATS)
def test_what_is_written_is_read_by_us_and_by_exiftool(exiftool: str, tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"a{ending}"
    pixels = picture(path, metadata=Metadata(TAGS, XMP))
    found = read_exif(path)
    for directory, tags in TAGS.items():
        assert {tag: found[directory][tag] for tag in tags} == tags
    tags = shown(exiftool, path)
    assert tags["IFD0:Make"] == "Acme" and tags["IFD0:Artist"] == "Zoë of the long name"
    assert tags["ExifIFD:UserComment"] == "one\ntwo"
    assert tags["Composite:GPSLatitude"] == pytest.approx(48.5 + 12.34 / 3600, abs=1e-9)
    if ending != ".jpg":
        np.testing.assert_array_equal(read_layer(path).read(0, len(pixels)), pixels)


@pytest.mark.parametrize("ending", FORMATS)
def test_metadata_changes_nothing_else(tmp_path: Path, ending: str) -> None:
    """Pixels, profile, size and place are those of the file without; it is longer by little."""
    plain, told = tmp_path / f"plain{ending}", tmp_path / f"told{ending}"
    place = {"offset": (7, 5), "icc": ICC} if ending == ".tif" else {}
    picture(plain, **place)
    picture(told, metadata=Metadata(TAGS, XMP), **place)
    ones, others = read_layer(plain), read_layer(told)
    assert (ones.box, ones.dtype, ones.icc) == (others.box, others.dtype, others.icc)
    np.testing.assert_array_equal(ones.read(0, ones.box.height), others.read(0, ones.box.height))
    assert 0 < told.stat().st_size - plain.stat().st_size < 2000


@pytest.mark.parametrize("ending", FORMATS)
def test_there_is_one_block_of_exif(tmp_path: Path, ending: str) -> None:
    """OpenImageIO writes an empty one by itself."""
    path = tmp_path / f"a{ending}"
    picture(path, metadata=Metadata(TAGS))
    content = path.read_bytes()
    assert content.count({".jpg": b"Exif\0\0", ".png": b"eXIf", ".tif": b"Acme"}[ending]) == 1


@pytest.mark.parametrize("ending", FORMATS)
def test_exiftool_replaces_what_is_there(exiftool: str, tmp_path: Path, ending: str) -> None:
    """As Hugin has it do afterwards: nothing is doubled."""
    path = tmp_path / f"a{ending}"
    picture(path, metadata=Metadata(TAGS, XMP))
    edit = ["-overwrite_original", "-Make=Other", "-Software=Hugin", "-UserComment=new"]
    subprocess.run([exiftool, "-q", *edit, str(path)], check=True)
    found = read_exif(path)
    assert text_of(found[MAIN][MAKE]) == "Other" and text_of(found[MAIN][SOFTWARE]) == "Hugin"
    assert comment_of(found[EXIF][COMMENT]) == "new"
    tags = shown(exiftool, path)
    assert (tags["IFD0:Make"], tags["ExifIFD:UserComment"]) == ("Other", "new")


def test_bigtiff(exiftool: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hugin_abflow.imagewriter._CLASSIC_LIMIT", 1000)
    path = tmp_path / "big.tif"
    pixels = picture(path, metadata=Metadata(TAGS, XMP))
    assert path.read_bytes()[:4] in (b"II+\0", b"MM\0+")
    tags = shown(exiftool, path)
    # exiftool reads GPS in BigTIFF with the names of other tags
    assert (tags["IFD0:Make"], tags["ExifOffset:UserComment"]) == ("Acme", "one\ntwo")
    with tifffile.TiffFile(path) as written:
        assert written.pages[0].tags["GPSTag"].value["GPSLongitude"] == (11, 1, 15, 1, 0, 1)
    assert {tag: read_exif(path)[EXIF][tag] for tag in TAGS[EXIF]} == TAGS[EXIF]
    np.testing.assert_array_equal(read_layer(path).read(0, len(pixels)), pixels)


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("big", [False, True])
def test_tiff_of_either_byte_order_and_many_pages(tmp_path: Path, order: str, big: bool) -> None:
    """Added to the first page; the others, and what the first held, stay."""
    path = tmp_path / "a.tif"
    pixels = [noise(np.uint16, seed=seed)[..., :3] for seed in (1, 2)]
    with tifffile.TiffWriter(path, bigtiff=big, byteorder=order) as writer:
        for page in pixels:
            writer.write(page, photometric="rgb", software="before", iccprofile=ICC)
    embed(path, "tiff", Metadata(TAGS, XMP))
    found = read_exif(path)
    assert {tag: found[MAIN][tag] for tag in TAGS[MAIN]} == TAGS[MAIN]
    assert (found[EXIF], found[GPS]) == (TAGS[EXIF], TAGS[GPS])
    with tifffile.TiffFile(path) as written:
        first, second = written.pages
        assert [first.tags[name].value for name in ("Make", "Software")] == ["Acme", "x"]
        assert bytes(first.tags["XMP"].value) == XMP and first.iccprofile == ICC
        assert first.tags["GPSTag"].value["GPSLatitude"] == (48, 1, 30, 1, 1234, 100)
        assert second.tags["Software"].value == "before"
        for page, expected in zip((first, second), pixels, strict=True):
            np.testing.assert_array_equal(page.asarray(), expected)


@pytest.mark.parametrize("metadata", [None, Metadata(TAGS, XMP)])
def test_png_says_where_it_lies(exiftool: str, tmp_path: Path, metadata: Metadata | None) -> None:
    """Once, and before the pixels."""
    path = tmp_path / "a.png"
    pixels = picture(path, metadata=metadata, offset=(656, 49))
    content = path.read_bytes()
    assert content.count(b"oFFs" + struct.pack(">iiB", 656, 49, 0)) == content.count(b"oFFs") == 1
    assert content.index(b"oFFs") < content.index(b"IDAT")
    assert shown(exiftool, path)["PNG:ImageOffset"] == "656, 49 (pixels)"
    np.testing.assert_array_equal(read_layer(path).read(0, len(pixels)), pixels)
    before = content.index(b"oFFs") - 4
    path.write_bytes(content[:before] + content[before + 21 :])  # none, as other writers leave it
    place_in_png(path, 656, 49)
    assert shown(exiftool, path)["PNG:ImageOffset"] == "656, 49 (pixels)"
    np.testing.assert_array_equal(read_layer(path).read(0, len(pixels)), pixels)


@pytest.mark.parametrize("count", [1, 2, 7])
def test_jpeg_may_fill_up_before_a_segment(tmp_path: Path, count: int) -> None:
    path = tmp_path / "a.jpg"
    picture(path, metadata=Metadata(TAGS))
    content = path.read_bytes()
    path.write_bytes(content.replace(b"\xff\xe1", b"\xff" * count + b"\xff\xe1", 1))
    assert text_of(read_exif(path)[MAIN][MAKE]) == "Acme"


def test_values_that_are_too_long_for_jpeg_are_left_out_and_told(
    exiftool: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The longest ones, and not all because of them: 65,533 bytes are all that a segment holds."""
    path, long = tmp_path / "a.jpg", {270: text("x" * 30_000), 33432: text("y" * 29_000)}
    picture(path, metadata=Metadata(TAGS | {MAIN: TAGS[MAIN] | long}))
    assert read_exif(path)[MAIN].keys() >= long.keys() and not caplog.records
    picture(path, metadata=Metadata(TAGS | {MAIN: TAGS[MAIN] | long | {ARTIST: text("z" * 28_000)}}))
    found = shown(exiftool, path)
    assert found["IFD0:Make"] == "Acme" and len(found["IFD0:Artist"]) == 28_000
    assert "IFD0:ImageDescription" not in found and len(found["IFD0:Copyright"]) == 29_000
    assert "left out of the panorama, as too long for JPEG: EXIF tag 270 (30001 bytes)" in caplog.text


@pytest.mark.parametrize("data", [b"", b"ab", b"abcde", b"abcdefghijk"])
@pytest.mark.parametrize("replaced", [0, 2, 5])
def test_what_is_put_into_a_file_may_be_shorter_than_what_was_there(
    monkeypatch: pytest.MonkeyPatch, data: bytes, replaced: int
) -> None:
    monkeypatch.setattr(exif_module, "_BLOCK", 3)
    content = bytes(range(20))
    file = io.BytesIO(content)
    exif_module._insert(file, 4, data, replaced)
    assert file.getvalue() == content[:4] + data + content[4 + replaced :]


def test_blocks_are_moved_piece_by_piece(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exif_module, "_BLOCK", 100)
    path = tmp_path / "a.png"
    pixels = picture(path, metadata=Metadata(TAGS, XMP))
    np.testing.assert_array_equal(read_layer(path).read(0, len(pixels)), pixels)


def test_exr_carries_what_openimageio_can(exiftool: str, tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    picture(path, np.float16, Metadata(TAGS, XMP))
    tags = shown(exiftool, path)
    assert (tags["OpenEXR:Make"], tags["OpenEXR:Software"]) == ("Acme", "x")
    assert tags["OpenEXR:GPSLatitude"].startswith("48 30 12.34")


@pytest.mark.parametrize("dated", ["no metadata", "no date", "a date"])
def test_exr_is_dated_as_the_photos_only(tmp_path: Path, dated: str) -> None:
    """OpenImageIO dates what has no date by the clock, and two of one project would differ by seconds."""
    path = tmp_path / "a.exr"
    date = {306: text("2020:01:02 03:04:05")} if dated == "a date" else {}
    picture(path, np.float16, None if dated == "no metadata" else Metadata({MAIN: TAGS[MAIN] | date}))
    assert (b"capDate" in path.read_bytes()) == bool(date)
    assert (b"2020:01:02 03:04:05" in path.read_bytes()) == bool(date)


@pytest.mark.parametrize("ending", [*FORMATS, ".exr"])
def test_equal_panoramas_are_equal_files(tmp_path: Path, ending: str) -> None:
    dtype = np.float16 if ending == ".exr" else np.uint8
    for name in "ab":
        picture(tmp_path / f"{name}{ending}", dtype, Metadata(TAGS, XMP))
    assert (tmp_path / f"a{ending}").read_bytes() == (tmp_path / f"b{ending}").read_bytes()


def test_failure_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk that is full in the end."""

    def fail(*arguments: object) -> None:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr("hugin_abflow.imagewriter.embed", fail)
    with pytest.raises(OutputError, match=r"a\.jpg cannot be written: No space left"):
        picture(tmp_path / "a.jpg", metadata=Metadata(TAGS))
    assert not list(tmp_path.iterdir())


# Photos


@pytest.mark.parametrize("byte_order", ["II", "MM"])
@pytest.mark.parametrize("ending", [".jpg", ".tif", ".png"])
def test_photos_of_other_programs(exiftool: str, tmp_path: Path, ending: str, byte_order: str) -> None:
    path = tmp_path / f"photo{ending}"
    if ending == ".tif":
        order = "<" if byte_order == "II" else ">"
        tifffile.imwrite(path, noise(np.uint8)[..., :3], photometric="rgb", byteorder=order)
    else:
        picture(path)
        subprocess.run([exiftool, "-q", "-overwrite_original", "-all=", str(path)], check=True)
    tags = ["-Make=Acme", "-Artist=Zoë", "-GPSLatitude=48.5", "-LensInfo=24 70 2.8 2.8"]
    options = ["-q", "-overwrite_original", f"-ExifByteOrder={byte_order}", "-UserComment=ß here"]
    subprocess.run([exiftool, *options, *tags, str(path)], check=True)
    found = read_exif(path)
    assert text_of(found[MAIN][MAKE]) == "Acme" and text_of(found[MAIN][ARTIST]) == "Zoë"
    assert comment_of(found[EXIF][COMMENT]) == "ß here"
    assert struct.unpack("<6I", found[GPS][2].data)[::2][:2] == (48, 30)
    assert struct.unpack("<8I", found[EXIF][42034].data)[:4] == (24, 1, 70, 1)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\xff\xd8",
        b"\xff\xd8\xff\xe1\x00\x0eExif\0\0II*\0",
        b"\xff\xd8\xff\xe1\x00\x14Exif\0\0II*\0\xff\xff\xff\x7f",
        b"II*\0\x08\0\0\0\xff\xff",
        b"II+\0\x08\0\0\0\x10\0\0\0\0\0\0\0" + (1 << 40).to_bytes(8, "little"),  # more tags than memory holds
        b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR",
        b"\x89PNG\r\n\x1a\n\0\0\0\x04eXIfMM\0*",
        b"nothing of the kind",
    ],
)
def test_broken_photos_tell_nothing(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "photo"
    path.write_bytes(content)
    assert not any(read_exif(path).values())
    assert read_exif(tmp_path / "gone") == {}


def test_a_very_long_value_is_left_out() -> None:
    """It would not fit into a JPEG."""
    long, short = Value(ASCII, b"x" * 40_000), text("Acme")
    block = tifftags.pack_directories({MAIN: {270: long, MAKE: short}})
    assert tifftags.read_directories(io.BytesIO(block)) == {MAIN: {MAKE: short}}


def test_texts_of_cameras() -> None:
    assert text_of(Value(ASCII, b"NIKON CORPORATION   \0\0")) == "NIKON CORPORATION"
    assert text_of(Value(ASCII, "Jörg".encode("latin-1") + b"\0")) == "Jörg"
    assert comment_of(None) == comment_of(Value(7, b"JIS\0\0\0\0\0abc")) == comment_of(Value(7, b"")) == ""
    assert comment_of(Value(7, bytes(8) + b"  abc \0\0")) == "abc"
    for encoding in ("utf-16-le", "utf-16-be"):
        assert comment_of(Value(7, b"UNICODE\0" + "Höhe Δ".encode(encoding))) == "Höhe Δ"
    for content in ("plain", "Höhe"):
        assert comment_of(comment(content)) == content


def test_a_photo_is_told_at_once_until_it_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run asks several times, of the file that its output would replace."""
    path, read = tmp_path / "a.tif", list[Path]()
    monkeypatch.setattr(exif_module, "read_exif", lambda path: [read.append(path), read_exif(path)][1])
    assert not is_photo(path) and not is_photo(tmp_path) and not is_photo(Path("a\0b")) and not read
    picture(path)
    assert not is_photo(path) and not is_photo(path) and len(read) == 1
    embed(path, "tiff", Metadata({EXIF: {33434: Value(5, struct.pack("<2I", 1, 250))}}))
    assert is_photo(path) and is_photo(path) and len(read) == 2
    path.unlink()
    assert not is_photo(path) and len(read) == 2

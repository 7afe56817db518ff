"""Kinds of pictures, by their first bytes."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest

from hugin_abflow.formats import foreign_format, picture_format


@pytest.mark.parametrize(
    ("ending", "name", "foreign"),
    [
        ("jpg", "JPEG", False), ("png", "PNG", False), ("tif", "TIFF", False), ("exr", "OpenEXR", False),
        ("webp", "WebP", True),
    ],
)  # fmt: skip
def test_pictures_are_told_by_what_they_hold(tmp_path: Path, ending: str, name: str, foreign: bool) -> None:
    """Whatever they are called."""
    file = tmp_path / f"written.{ending}"
    pixels = np.zeros((8, 16, 3), np.uint8)
    if ending == "webp":  # OpenImageIO may be built without it
        assert cv2.imwrite(str(file), pixels)
    else:
        output = oiio.ImageOutput.create(str(file))
        assert output.open(str(file), oiio.ImageSpec(16, 8, 3, "uint8"))
        output.write_image(pixels)
        output.close()
    renamed = file.rename(tmp_path / "photo.jpg")
    assert picture_format(renamed.read_bytes()) == name
    assert foreign_format(renamed) == (name if foreign else None)


def test_what_phones_and_cameras_write_is_foreign(tmp_path: Path) -> None:
    for data, name in (
        (b"\0\0\0\x18ftypheic\0\0\0\0", "HEIF"),
        (b"\0\0\0\x1cftypavif\0\0\0\0", "AVIF"),
        (b"\0\0\0\x0cJXL \r\n\x87\n", "JPEG XL"),
        (b"\0\0\0\x18ftypcrx \0\0\0\0", "camera raw"),
    ):
        (tmp_path / "photo.jpg").write_bytes(data)
        assert foreign_format(tmp_path / "photo.jpg") == name
    (tmp_path / "photo.NEF").write_bytes(b"MM\0*")  # TIFF of another kind
    assert foreign_format(tmp_path / "photo.NEF") == "camera raw"


def test_anything_else_has_no_format(tmp_path: Path) -> None:
    for data in (b"", b"p f2 w3000", b"II", b"GIF89a", b"ftypheic"):
        (tmp_path / "photo.jpg").write_bytes(data)
        assert picture_format(data) is None and foreign_format(tmp_path / "photo.jpg") is None
    assert foreign_format(tmp_path / "none.jpg") is None

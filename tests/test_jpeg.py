"""JPEG files that were cut are known, whatever they are made of."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import photo_pixels

from hugin_abflow.jpeg import is_cut

KINDS = {
    "baseline": [],
    "many scans": [cv2.IMWRITE_JPEG_PROGRESSIVE, 1],
    "restarts": [cv2.IMWRITE_JPEG_RST_INTERVAL, 3],
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_jpeg_that_is_cut_is_known(tmp_path: Path, kind: str) -> None:
    """Whatever comes behind it, and with a whole thumbnail in front; other files are none."""
    _, image = cv2.imencode(".jpg", photo_pixels(1), KINDS[kind])
    _, small = cv2.imencode(".jpg", photo_pixels(1)[::8, ::8])
    whole, thumbnail = image.tobytes(), small.tobytes()
    segment = b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2) + thumbnail
    trailer = np.random.default_rng(1).integers(0, 256, 200_000, np.uint8).tobytes()
    assert b"\xff\xda" in trailer
    photo = tmp_path / "photo.jpg"
    for content, cut in (
        (whole, False), (whole[:-800], True), (whole[:2] + segment + whole[2:], False),
        (whole[:2] + segment + whole[2:-800], True), (whole + trailer, False), (b"II*\0" + whole[:-9], False),
        (whole[:2] + segment, True),
    ):  # fmt: skip
        photo.write_bytes(content)
        assert is_cut(photo) == cut
    assert not is_cut(tmp_path / "none.jpg")


def test_of_other_files_hardly_anything_is_read(tmp_path: Path) -> None:
    """Panoramas have gigabytes."""
    path = tmp_path / "a.tif"
    path.write_bytes(b"II*\0")
    with path.open("r+b") as file:
        file.truncate(64 << 20)
    tracemalloc.start()
    try:
        assert not is_cut(path)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()

"""What is stored of what is asked for, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hugin_abflow.encoding import format_of, stored_dtype, to_depth, used_compression
from hugin_abflow.errors import OutputError

PATH = Path("a.tif")
BYTE, WORD, HALF, FLOAT, DOUBLE = map(np.dtype, (np.uint8, np.uint16, np.float16, np.float32, np.float64))


def test_the_ending_chooses_the_format() -> None:
    assert [format_of(Path(name)) for name in ("a.TIFF", "a.b.jpeg", "a.exr")] == ["tiff", "jpeg", "openexr"]
    with pytest.raises(OutputError, match=r"a\.gif: the ending must be one of \.tif, \.tiff, \.jpg"):
        format_of(Path("a.gif"))


@pytest.mark.parametrize(
    ("kind", "dtype", "depth", "stored"),
    [
        ("tiff", HALF, None, HALF),
        ("tiff", BYTE, DOUBLE, DOUBLE),
        ("jpeg", FLOAT, WORD, BYTE),
        ("png", BYTE, None, BYTE),
        ("png", WORD, BYTE, BYTE),
        ("png", FLOAT, None, WORD),
        ("openexr", HALF, None, HALF),
        ("openexr", BYTE, FLOAT, FLOAT),
    ],
)
def test_formats_hold_the_nearest_depth(
    kind: str, dtype: np.dtype, depth: np.dtype | None, stored: np.dtype
) -> None:
    assert stored_dtype(PATH, kind, dtype, depth) == stored


@pytest.mark.parametrize(
    ("kind", "dtype", "depth", "said"),
    [
        ("openexr", WORD, None, "EXR holds half or float, and these are uint16"),
        ("tiff", np.dtype(np.int32), None, "samples of type int32"),
        ("tiff", BYTE, np.dtype(np.int8), "samples of type int8"),
    ],
)
def test_other_depths_are_refused(kind: str, dtype: np.dtype, depth: np.dtype | None, said: str) -> None:
    with pytest.raises(OutputError, match=said):
        stored_dtype(PATH, kind, dtype, depth)


@pytest.mark.parametrize(
    ("kind", "stored", "channels", "name", "quality", "used"),
    [
        ("tiff", BYTE, 3, None, None, "lzw"),
        ("tiff", BYTE, 3, "ZIP", None, "deflate"),
        ("tiff", BYTE, 3, "jpeg", 75, "jpeg:75"),
        ("tiff", BYTE, 1, "jpeg", 75, "deflate"),
        ("tiff", WORD, 3, "jpeg", 75, "deflate"),
        ("openexr", HALF, 3, None, None, "zip"),
        ("jpeg", BYTE, 1, None, None, "jpeg:90"),
        ("png", BYTE, 3, "zip", None, "deflate"),
    ],
)
def test_the_compression_is_one_that_the_format_has(
    kind: str, stored: np.dtype, channels: int, name: str | None, quality: int | None, used: str
) -> None:
    assert used_compression(PATH, kind, stored, channels, name, quality) == used


@pytest.mark.parametrize(
    ("kind", "name", "quality", "said"),
    [
        ("tiff", "piz", None, "compression 'piz'; choose one of none, packbits, lzw, deflate, zstd, jpeg"),
        ("png", "lzw", None, "choose one of deflate, zip"),
        ("jpeg", None, 0, "JPEG quality 0; choose 1 to 100"),
        ("jpeg", None, 90.5, "JPEG quality 90.5"),
    ],
)
def test_other_compressions_are_refused(kind: str, name: str | None, quality: int | None, said: str) -> None:
    with pytest.raises(OutputError, match=said):
        used_compression(PATH, kind, BYTE, 3, name, quality)


def test_depths_are_rounded_to_the_nearest_and_keep_black_and_white() -> None:
    words = np.arange(65536).astype(np.uint16)
    assert np.array_equal(to_depth(words, BYTE), np.rint(np.arange(65536) / 257).astype(np.uint8))
    assert to_depth(np.array([-1, 0, 0.5, 1, 2], np.float32), WORD).tolist() == [0, 0, 32768, 65535, 65535]
    assert to_depth(words, FLOAT)[[0, -1]].tolist() == [0, 1]
    assert to_depth(words, WORD) is words

"""How a panorama's file is stored: its format, the depth of its samples, its compression, and what may be
asked of each.
"""

from __future__ import annotations

import logging
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hugin_abflow import tiffwriter
from hugin_abflow.errors import OutputError
from hugin_abflow.layer import full_scale

_log = logging.getLogger(__name__)

# Formats by the endings of files.
ENDINGS = {".tif": "tiff", ".tiff": "tiff", ".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png", ".exr": "openexr"}
# Compressions that the documentation names. `_KNOWN` has other names as well, which projects and other
# programs use.
COMPRESSIONS = {
    "TIFF": ("none", "packbits", "lzw", "deflate", "zstd", "jpeg"),
    "EXR": ("none", "rle", "zips", "zip", "piz"),
}
# Compressions by formats, and JPEG's quality, where nothing is said.
DEFAULTS, JPEG_QUALITY = {"tiff": "lzw", "openexr": "zip", "jpeg": "jpeg", "png": "deflate"}, 90
# All names that are understood, by formats, and the compression that each of them means.
_KNOWN = {
    "tiff": {name: name for name in tiffwriter.COMPRESSIONS} | {"zip": "deflate"},
    "openexr": {name: name for name in COMPRESSIONS["EXR"]},
    "jpeg": {"jpeg": "jpeg"}, "png": {"deflate": "deflate", "zip": "deflate"},
}  # fmt: skip
# Types of samples that may be given, and one more as which TIFF may store them.
_DTYPES = frozenset(map(np.dtype, (np.uint8, np.uint16, np.float16, np.float32)))
_WIDE = np.dtype(np.float64)


def format_of(path: Path) -> str:
    """The format that a file's ending chooses; raises `OutputError` for any other ending."""
    if path.suffix.lower() not in ENDINGS:
        raise OutputError(f"{path}: the ending must be one of {', '.join(ENDINGS)}")
    return ENDINGS[path.suffix.lower()]


def stored_dtype(path: Path, kind: str, dtype: np.dtype[Any], depth: npt.DTypeLike | None) -> np.dtype[Any]:
    """The type of the samples in a file of a format, for samples of `dtype` and a wanted `depth`, if any.

    Raises `OutputError` for samples that are not written, or not in that format.
    """
    wanted = dtype if depth is None else np.dtype(depth)
    if dtype not in _DTYPES or wanted not in {*_DTYPES, _WIDE}:
        odd = dtype if dtype not in _DTYPES else wanted
        raise OutputError(f"{path}: samples of type {odd}; possible are uint8, uint16, float16, float32")
    if kind == "tiff":
        return wanted
    if kind == "jpeg":
        return np.dtype(np.uint8)
    if kind == "png":
        return wanted if wanted == np.uint8 else np.dtype(np.uint16)
    if wanted.kind != "f":
        raise OutputError(
            f"{path}: EXR holds half or float, and these are {wanted}; choose .tif, .png or .jpg"
        )
    return wanted if wanted == np.float16 else np.dtype(np.float32)


def used_compression(
    path: Path, kind: str, stored: np.dtype[Any], channels: int, name: str | None, jpeg_quality: int | None
) -> str:
    """The compression that a file of a format gets, JPEG's with its quality: "lzw", "jpeg:90".

    stored, channels    of its samples, alpha not counted. name, jpeg_quality: what is wanted, if anything.

    Raises `OutputError` for a name that the format does not know, and for a quality out of range.
    """
    known = _KNOWN[kind]
    wanted = (name or DEFAULTS[kind]).lower()
    if wanted not in known:
        offered = ", ".join(COMPRESSIONS.get({"tiff": "TIFF", "openexr": "EXR"}.get(kind, ""), known))
        raise OutputError(f"{path}: compression {name!r}; choose one of {offered}")
    used = known[wanted]
    if used != "jpeg":
        return used
    if kind == "tiff" and (stored != np.uint8 or channels != 3):  # of grey OpenImageIO misreads the alpha
        _log.warning("%s: jpeg in TIFF is for 8-bit RGB; deflate is used", path)
        return "deflate"
    quality = JPEG_QUALITY if jpeg_quality is None else jpeg_quality
    if not isinstance(quality, Integral) or not 1 <= quality <= 100:
        raise OutputError(f"{path}: JPEG quality {quality}; choose 1 to 100")
    return f"jpeg:{quality}"


def to_depth(rows: npt.NDArray[Any], stored: np.dtype[Any]) -> npt.NDArray[Any]:
    """Rescale samples to another depth, rounded to nearest; 0 and full scale stay what they are."""
    if rows.dtype == stored:
        return rows
    if rows.dtype.kind == stored.kind == "f":
        return rows.astype(stored)
    scaled: npt.NDArray[Any] = rows.astype(np.float64 if stored == np.float64 else np.float32)
    scaled /= full_scale(rows.dtype)
    if stored.kind == "u":
        np.clip(scaled, 0, 1, out=scaled)
        scaled *= full_scale(stored)
        np.rint(scaled, out=scaled)
    return scaled.astype(stored)

"""What several test modules need: photos and projects made on the fly, programs that may be missing."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import tifffile


def require_program(name: str) -> str:
    """The program's path. Without it the test is skipped, but fails in CI, where it must be there."""
    path = shutil.which(name)
    if path is None:
        reason = f"{name} is not installed; `make test` says how to get it"
        if os.environ.get("CI", "").lower() == "true":
            pytest.fail(reason)
        pytest.skip(reason)
    return path


@pytest.fixture
def nona() -> str:
    """Hugin's nona, really installed."""
    return require_program("nona")


@pytest.fixture
def exiftool() -> str:
    """exiftool, really installed."""
    return require_program("exiftool")


@pytest.fixture
def enblend() -> str:
    """enblend, really installed."""
    return require_program("enblend")


def photo_pixels(
    seed: int, dtype: type = np.uint8, channels: int = 3, width: int = 203, height: int = 151
) -> np.ndarray:
    """A smooth photo without two equal rows or columns: (height, width, channels)."""
    y, x = np.mgrid[0:height, 0:width] / 25.0
    waves = [np.sin(x * (1 + 0.3 * c) + y * (0.7 + 0.2 * seed) + c + seed) for c in range(channels)]
    scaled = np.stack(waves, -1) * 0.45 + 0.5
    if np.dtype(dtype).kind == "f":
        return scaled.astype(dtype)
    return np.rint(scaled * np.iinfo(dtype).max).astype(dtype)


ProjectMaker = Callable[..., Path]


@pytest.fixture
def make_project(tmp_path: Path) -> ProjectMaker:
    """`make_project(...)` writes photos and a .pto, both in one folder, and returns the .pto's path.

    By default three rectilinear photos of 203x151, 80 degrees wide, 60 degrees apart, the last of which
    crosses the border of a 360-degree equirectangular canvas of 802x401.
    """

    def make(
        folder: str = "project",
        stem: str = "pano",
        yaws: Sequence[float] = (0, 60, 170),
        dtype: type = np.uint8,
        channels: int = 3,
        icc: bytes | None = None,
        panorama: str = 'f2 w802 h401 v360 n"TIFF_m c:LZW r:CROP"',
        disabled: Sequence[int] = (),
        extra: str = "",
        photo: str = "photo {}.tif",
        ending: str = ".pto",
    ) -> Path:
        place = tmp_path / folder
        place.mkdir(parents=True, exist_ok=True)
        lines = ["# hugin project file", f"p {panorama}", "m i0"]
        for index, yaw in enumerate(yaws):
            pixels = photo_pixels(index, dtype, channels)
            kind = "rgb" if channels == 3 else "minisblack"
            stored = pixels if channels == 3 else pixels[..., 0]
            # SampleFormat is set, else nona guesses
            tifffile.imwrite(place / photo.format(index), stored, photometric=kind, iccprofile=icc)
            lines.append(f"#-hugin  cropFactor=1{' disabled' if index in disabled else ''}")
            lines.append(
                f"i w203 h151 f0 v80 Ra0 Rb0 Rc0 Rd0 Re0 Eev0 Er1 Eb1 r0 p{5 * index} y{yaw} "
                f'TrX0 TrY0 TrZ0 j0 a0 b0 c0 d0 e0 g0 t0 Va1 Vb0 Vc0 Vd0 Vx0 Vy0 Vm5 n"{photo.format(index)}"'
            )
        project = place / f"{stem}{ending}"
        project.write_text("\n".join(lines) + "\n" + extra, encoding="utf-8")
        return project

    return make

"""Layers as nona writes them, made without it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tifffile

X_POSITION, Y_POSITION, FULL_WIDTH, FULL_HEIGHT = 286, 287, 33300, 33301
RATIONAL, _LONG = 5, 4


def write_layer(
    path: Path,
    pixels: np.ndarray,
    left: int = 0,
    top: int = 0,
    canvas: tuple[int, int] | None = None,
    alpha: bool = True,
) -> Path:
    """Pixels (height, width, channels + 1) at a place on the canvas, whose size goes into PIXAR's tags."""
    stored = pixels if alpha else pixels[..., :-1]
    tags = [(X_POSITION, RATIONAL, 1, (left, 150), True), (Y_POSITION, RATIONAL, 1, (top, 150), True)]
    if canvas:
        tags += [(FULL_WIDTH, _LONG, 1, canvas[0], True), (FULL_HEIGHT, _LONG, 1, canvas[1], True)]
    tifffile.imwrite(
        path,
        stored if stored.shape[2] > 1 else stored[..., 0],
        photometric="rgb" if pixels.shape[2] == 4 else "minisblack",
        extrasamples=["unassalpha"] if alpha else None,
        resolution=(150, 150),
        resolutionunit="inch",
        extratags=tags,
    )
    return path

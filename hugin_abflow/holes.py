"""Holes in a panorama: places within it that no photo shows. They are easily missed on a screen."""

from __future__ import annotations

import logging
import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from hugin_abflow.layer import Canvas
from hugin_abflow.projection import Projection

_log = logging.getLogger(__name__)

# Pixels of a panorama that are looked at, at most.
_LOOKED_AT = 1_000_000
# Sine of the elevation from which on a place is straight up or down.
_POLE = 0.98


class Hole(NamedTuple):
    """The box of a hole on a grid, and how many of its pixels the hole has, without those at its outline."""

    left: int
    top: int
    right: int
    bottom: int
    size: int


class Coverage:
    """Where a panorama is opaque, from its rows as they are made."""

    def __init__(self, canvas: Canvas) -> None:
        crop = canvas.crop
        self._crop = crop
        self._wraps = canvas.wraps and crop.width == canvas.width
        self._projection = Projection.of(canvas.projection, canvas.width, canvas.height, canvas.hfov)
        self._every = math.ceil(math.sqrt(crop.width * crop.height / _LOOKED_AT))
        self._done = 0
        self._visible = False
        self._rows = list[npt.NDArray[np.bool_]]()

    def add(self, rows: npt.NDArray[Any]) -> None:
        """The next rows of the crop, (rows, width, channels), alpha last."""
        alpha, every = rows[..., -1], self._every
        first = -self._done % every  # of these rows, counted from the crop's first
        self._rows.append(alpha[first::every, ::every] > 0)
        self._visible = self._visible or bool(alpha.any())
        self._done += len(rows)

    def report(self) -> None:
        """Warn if nothing is opaque, or of the largest hole."""
        if not self._visible:
            _log.warning(
                "the panorama is wholly transparent: no layer has an alpha of half or more inside the crop; "
                "check crop and masks in Hugin, and alpha of layers that others made"
            )
            return
        found = holes(np.concatenate(self._rows), self._wraps)
        found = [hole for hole in found if not self._shows_a_pole(hole)]
        if found:
            hole, every = max(found, key=lambda one: one.size), self._every
            _log.warning(
                "the panorama has %s of about %d x %d px at (%d, %d) of the canvas, which no photo shows; "
                "if you do not want that, see in Hugin whether a photo is missing, or masks hide it in all: "
                "what two photos include is left out of both",
                "a hole" if len(found) == 1 else f"{len(found)} holes, the largest",
                every * (hole.right - hole.left), every * (hole.bottom - hole.top),
                self._crop.left + every * hole.left % self._crop.width, self._crop.top + every * hole.top,
            )  # fmt: skip

    def _shows_a_pole(self, hole: Hole) -> bool:
        """Whether a hole is straight up or down, as the ground that nobody photographed below a tripod is on
        a little planet. (On most other canvases it reaches the border.)
        """
        if self._projection is None:
            return False
        across, down = (np.linspace(*ends, 9) for ends in (hole[0:3:2], hole[1:4:2]))
        x, y = np.meshgrid(across, down)
        places = self._every * np.stack([x.ravel(), y.ravel()], 1) + (self._crop.left, self._crop.top)
        return bool((abs(self._projection.bearings(places)[:, 2]) > _POLE).any())


def holes(covered: npt.NDArray[np.bool_], wraps: bool) -> list[Hole]:
    """What is not covered and does not reach the border, but for slits of less than three pixels.

    covered     (height, width).
    wraps       whether its columns are periodic. Then each hole is there once, and has its columns side by
                side: those that continue beyond the last column are counted on from there. So the right end
                of a hole across the border is beyond the width, and one that begins at column 0 has its left
                end at the width.
    """
    if covered.all():
        return []
    # columns that wrap twice, so that what lies across the border is whole in the middle, and so is its box,
    # which grid.connected does not tell
    gaps = ~np.tile(covered, 2 if wraps else 1)
    gaps = scipy.ndimage.binary_erosion(gaps, np.ones((3, 3)), border_value=1)
    labels, _ = scipy.ndimage.label(gaps, np.ones((3, 3)))
    sizes = np.bincount(labels.ravel())
    height, width = labels.shape
    found = []
    for number, (rows, columns) in enumerate(scipy.ndimage.find_objects(labels), 1):
        inside = rows.start > 0 and rows.stop < height and columns.start > 0 and columns.stop < width
        if inside and columns.start - 1 <= covered.shape[1]:  # others are there twice
            box = columns.start - 1, rows.start - 1, columns.stop + 1, rows.stop + 1
            found.append(Hole(*box, int(sizes[number])))
    return found

"""What a panorama does not show: holes are easily overlooked before it is printed."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from hugin_abflow.layer import Canvas

_log = logging.getLogger(__name__)

# Pixels of a row that are looked at, about; and how many of these a hole is wide and high at least.
_LOOKED_AT, _LEAST = 1000, 3


class Coverage:
    """Where a panorama is opaque, from its rows as they are made."""

    def __init__(self, canvas: Canvas) -> None:
        self._crop = canvas.crop
        self._wraps = canvas.wraps and canvas.crop.width == canvas.width
        self._every = max(1, canvas.crop.width // _LOOKED_AT)
        self._seen = 0
        self._visible = False
        self._rows = list[npt.NDArray[np.bool_]]()

    def add(self, rows: npt.NDArray[Any]) -> None:
        """The next rows of the crop, (rows, width, channels), alpha last."""
        alpha = rows[..., -1]
        self._rows.append(alpha[-self._seen % self._every :: self._every, :: self._every] > 0)
        self._visible = self._visible or bool(alpha.any())
        self._seen += len(rows)

    def report(self) -> None:
        """Warn if nothing is opaque, or of the largest place within the panorama that is not.

        What reaches the crop's border or a pole, as where nobody photographed the ground, is no such place.
        """
        if not self._visible:
            _log.warning(
                "the panorama is wholly transparent: no layer has an alpha of half or more inside the crop; "
                "check crop and masks in Hugin, and alpha of layers that others made"
            )
            return
        places = self._every * holes(np.concatenate(self._rows), self._wraps)
        if places.size:
            left, top, right, bottom = places[np.argmax(np.prod(places[:, 2:] - places[:, :2], 1))]
            _log.warning(
                "the panorama has %s of about %d x %d px at (%d, %d), where no layer shows anything; if you "
                "do not want that, check masks in Hugin: what one photo includes is left out of all others, "
                "also where these include it",
                "a hole" if len(places) == 1 else f"{len(places)} holes, the largest",
                right - left, bottom - top, self._crop.left + left, self._crop.top + top,
            )  # fmt: skip


def holes(covered: npt.NDArray[np.bool_], wraps: bool) -> npt.NDArray[np.intp]:
    """Places (n, 4), left, top, right, bottom, of what is not covered and does not reach the border, px.

    covered     (height, width); wraps: whether its columns are periodic. Of a hole that lies across the
                border of such columns the right end is beyond the width.
    """
    if covered.all():
        return np.empty((0, 4), np.intp)
    # columns that wrap twice, so that what lies across the border is whole in the middle
    labels, _ = scipy.ndimage.label(~np.tile(covered, 2 if wraps else 1), np.ones((3, 3)))
    height, width = labels.shape
    found = []
    for rows, columns in scipy.ndimage.find_objects(labels):
        inside = rows.start > 0 and rows.stop < height and columns.start > 0 and columns.stop < width
        large = min(rows.stop - rows.start, columns.stop - columns.start) >= _LEAST
        if inside and large and columns.start < covered.shape[1]:
            found.append([columns.start, rows.start, columns.stop, rows.stop])
    return np.asarray(found, np.intp).reshape(-1, 4)

"""How layers would differ if they showed the same things, where they do not (kernels/content.cl).

Where one layer shows somebody, and the panorama another layer, their difference is no difference of
exposure. The multi-band blend would spread it: his colours would be left as a shade on what is beside him.
So the difference is replaced there by one that is extrapolated from places around where both show the same,
from the nearest ones that suffice. Where few places tell it, as where all of a narrow overlap differs, the
measured difference stays: nothing else tells what gains have left.

What is nearly black may be anything, above all at the rim of a dark lens, and is left as it is, unless flow
tells that it moved.

Replaced differences, weighted as the layers are, need not sum to zero, as measured ones do.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from hugin_abflow.grid import Grid, Place, any_around
from hugin_abflow.opencl import Buffer, Device

# Residual, of full scale, up to which layers surely show the same.
ALIKE = 0.06
# Residual, of full scale, from which on they surely do not.
_OTHER = 0.15
# Cells of the Gaussians that places around are averaged with, the widest first.
_SIGMAS = (16.0, 8.0, 4.0, 2.0)
# Places around are enough if they are this share of what is averaged; if less, the next wider ones count in
# part.
_ENOUGH = 0.05
# The share from which on, in any width, what they tell is sure; if less, what is there counts in part.
_SURE = 0.1
# Sigmas to the end of a Gaussian.
_REACH = 3

Values = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Unlike:
    """How surely layers show different things, both float32 (height, width) on `grid`, 0..1.

    moved   what flow tells of, whatever the layers show.
    other   what differs though layers are aligned, unless it is nearly black; without flow, as edges do that
            lie elsewhere.
    """

    grid: Grid
    moved: Values
    other: Values

    @property
    def anywhere(self) -> npt.NDArray[np.bool_]:
        """The cells in which they do, for whatever reason."""
        return (self.moved > 0) | (self.other > 0)

    @classmethod
    def of(
        cls,
        grid: Grid,
        residual: npt.NDArray[np.float64],
        whole: npt.NDArray[np.bool_],
        moved: npt.NDArray[np.bool_] | None,
    ) -> Unlike:
        """By what low frequencies of layers differ, of full scale, in regions `whole`, which are cut or taken
        from one layer; all (height, width) on `grid`.
        """
        other = whole * np.clip((residual - ALIKE) / (_OTHER - ALIKE), 0, 1)
        anywhere = np.zeros(whole.shape, bool) if moved is None else moved
        return cls(grid, anywhere.astype(np.float32), other.astype(np.float32))


def complete(
    device: Device,
    difference: Buffer,
    share: Buffer,
    box: Place,
    grid: Grid,
    mean: Buffer,
    unlike: Unlike,
    shoulder: float,
) -> None:
    """Replace, in place, how a layer differs from a mean of all where they show different things.

    difference  float32 (height, width, 4) on a box of `grid`: colour, valid. share: its own in the mean.
    mean        float32 (height, width, 4) on all of the grid. shoulder: of the exposure scale, 0: of floats.
    """
    if not any_around(unlike.anywhere, box, grid, unlike.grid):  # of many layers nearly all
        return
    cells, sums = unlike.grid, device.empty((*unlike.grid.shape, 4))
    moved, other = device.upload(unlike.moved), device.upload(unlike.other)
    device.run(
        "content", "content_gather", cells.border.size,
        difference, share, box, grid.border, mean, moved, other, cells.border, shoulder, sums,
    )  # fmt: skip
    expected = device.upload(_from_beside(sums.get(), cells.wraps))
    device.run(
        "content", "content_complete", box[2:],
        difference, share, box, grid.border, mean, moved, other, expected, cells.border, shoulder,
    )  # fmt: skip


def _from_beside(sums: Values, wraps: bool) -> Values:
    """What layers would differ by everywhere, and how sure that is, 0..1, (height, width, 4), by what is
    measured beside: from sums of `content_gather`.
    """
    values, sure = np.zeros_like(sums[..., :3]), np.zeros_like(sums[..., 3:])
    for sigma in _SIGMAS:
        by = int(_REACH * sigma)
        columns = np.pad(sums, ((0, 0), (by, by), (0, 0)), mode="wrap" if wraps else "constant")
        size = 2 * by + 1
        around = cv2.GaussianBlur(columns, (size, size), sigma, borderType=cv2.BORDER_CONSTANT)
        around = around[:, by : around.shape[1] - by]
        weight = around[..., 3:]
        nearer = around[..., :3] / np.where(weight > 0, weight, 1)
        enough = np.where(sure > 0, np.clip(weight / _ENOUGH, 0, 1), 1)  # the widest known is all there is
        values = enough * nearer + (1 - enough) * values
        sure = np.maximum(sure, np.clip(weight / _SURE, 0, 1))
    return np.ascontiguousarray(np.dstack([values, sure]), np.float32)

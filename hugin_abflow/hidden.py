"""What nobody sees of the layers in a band, so that it need not be sampled (kernels/hidden.cl)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from hugin_abflow.grid import Place
from hugin_abflow.opencl import Buffer, Device

# Pixels of a row that a work item takes: HIDDEN_CHUNK of kernels/hidden.cl.
_CHUNK = 8


def mark(
    device: Device,
    fields: Buffer,
    places: npt.NDArray[np.int32],
    part: Place,
    share: float,
) -> None:
    """Make weights negative, in place, that are less than a share of the sum of all layers' there; the others
    hardly change.

    fields      float32 (n, 4), those of layers one after the other; the weight last.
    places      (layers, 8): of each its box (left, top, width, height) on the working grid, where it begins
                in `fields`, and three numbers that are not read.
    part        of the working grid, a box as well: where it is done.
    """
    chunks = (-(-part[2] // _CHUNK), part[3])
    device.run(
        "hidden", "hidden_mark", chunks, fields, device.upload(places), len(places), part, share,
    )  # fmt: skip

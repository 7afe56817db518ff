"""How quickly the geometry changes over from one layer to the next (kernels/transition.cl).

The published coefficient changes over the whole overlap. That is as slow as it can be, which parallax needs:
across a transition of width t, flow of length F stretches or squeezes the picture by F / t, its strain. Where
there is little parallax and much overlap it is slower than anybody can see, and everything in the overlap is
shown between its places in the photos, as sharp as the flow is right. So the coefficients are sharpened,

    w_k <- w_k^n / sum_j w_j^n,    n = wanted strain / strain, from 1 to a limit

with a smooth n: most of an overlap comes from one photo as it is, and no transition is steeper than wanted.
Where layers cannot be brought to one brightness, n stays 1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import scipy

from hugin_abflow import geometry
from hugin_abflow.coefficient import Coefficients
from hugin_abflow.geometry import PairFlow
from hugin_abflow.opencl import Device
from hugin_abflow.settings import Settings
from hugin_abflow.working import Grid, WorkingLayer

# Working pixels per cell of the transition grid.
_CELL = 16
# Working pixels from one that the strain is measured at to the next: it is averaged over thousands.
_EVERY = 4
# Cells over which the strain is averaged (by its fourth power), and the exponent again.
_SIGMA = 3.0
# A transition is at least this part of the published one.
_STEEPEST = 12.0


def transition_grid(grid: Grid) -> Grid:
    """The coarse grid over the region of the working grid."""
    return grid.coarser(_CELL)


def narrow(
    device: Device,
    layers: Sequence[WorkingLayer],
    coefficients: Sequence[Coefficients],
    flows: Sequence[PairFlow],
    grid: Grid,
    settings: Settings,
    unlike: npt.NDArray[np.float32],
) -> None:
    """Make coefficients as steep as `settings.transition_strain` allows, in place; 0 changes nothing.

    unlike: (height, width) on the transition grid, from 0 to 1, where the published coefficients stay.
    """
    if settings.transition_strain == 0 or not flows:
        return
    cells = transition_grid(grid)
    strain = device.zeros((*cells.shape, 2))
    displacements = geometry.displacements(device, layers, coefficients, flows, grid, settings, _EVERY)
    for layer, coefficient, displacement in zip(layers, coefficients, displacements, strict=True):
        device.run(
            "transition", "transition_strain", cells.border[:2], displacement, coefficient.blend,
            layer.pixels, layer.box, grid.border, grid.lens, _EVERY, cells.border, strain,
        )  # fmt: skip
    sums = strain.get().astype(np.float64)
    power = device.upload(exponent(sums, settings.transition_strain, cells.wraps, unlike))
    total = device.zeros(grid.shape)
    for layer, coefficient in zip(layers, coefficients, strict=True):
        device.run(
            "transition", "transition_sharpen", layer.box[2:], coefficient.blend, layer.box, grid.border,
            power, cells.border, total,
        )  # fmt: skip
    for layer, coefficient in zip(layers, coefficients, strict=True):
        device.run(
            "transition", "transition_ratio", layer.box[2:], coefficient.blend, layer.box, grid.border, total
        )


def exponent(
    strain: npt.NDArray[np.float64], wanted: float, wraps: bool, unlike: npt.NDArray[np.float32]
) -> npt.NDArray[np.float32]:
    """n on the transition grid, (height, width), from sums (height, width, 2) of transition_strain."""
    smooth = _smooth(strain, wraps)
    mean = (smooth[..., 0] / np.maximum(smooth[..., 1], 1e-6)) ** 0.25
    power = 1 + (1 - unlike) * (np.clip(wanted / np.maximum(mean, 1e-6), 1, _STEEPEST) - 1)
    weighed = _smooth(np.dstack([power, np.ones_like(power)]), wraps)
    return np.ascontiguousarray(weighed[..., 0] / weighed[..., 1], np.float32)


def _smooth(values: npt.NDArray[np.float64], wraps: bool) -> npt.NDArray[np.float64]:
    """A Gaussian of _SIGMA cells, not normalised at the borders."""
    modes = ("constant", "wrap" if wraps else "constant", "constant")
    return np.asarray(scipy.ndimage.gaussian_filter(values, (_SIGMA, _SIGMA, 0), mode=modes))

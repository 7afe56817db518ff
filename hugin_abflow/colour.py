"""Smooth exposure and colour correction of each layer (kernels/colour.cl).

The aligned layers are compared in their overlaps, on a coarse grid and on the exposure scale of common.cl:
log odds for integer images, logarithms of roots for floats. The correction is smooth gains that explain how
the layers differ (gains.py). A difference counts the more the better it can be trusted, the more it tells
(dark samples tell little), and the more both layers are seen.

Most cameras' curves level off towards white; there log odds change colours as exposure does. Others run
straight into white: for them the scale has a lower shoulder, and is log odds of a share of full scale. Of a
few shoulders the one is taken that explains the differences clearly best. With a wrong one a gain is too
large for bright things and too small for dark ones beside them, and steps remain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from hugin_abflow.cells import grown
from hugin_abflow.gains import Difference, Measured, solve
from hugin_abflow.geometry import Pair
from hugin_abflow.grid import Grid, on_cells
from hugin_abflow.layer import Box
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.settings import Settings
from hugin_abflow.working import CLIPPED, WorkingLayer, shared_cells

# Working pixels per cell of the colour grid.
_CELL = 16
# Layers that lie on each other, by their cubic mean: from here on cells grow with them, because the solution
# takes time by cells^1.5 and layers^3.
_DEEP = 4.0
# Standard deviation of the differences within a cell that halves its trust, on the exposure scale.
_SPREAD = 0.3
# Weight of what is seen of one layer alone: where layers are not mixed they are best left as they are.
_UNSEEN = 0.003
# All gains, and offsets of multiband.py, shrink towards 0 by this, at most a quarter of an 8-bit level, so
# that small ones are exactly 0.
NEGLIGIBLE = 1e-3

# Shoulders of the exposure scale that are tried for integer images; the first one keeps white.
_SHOULDERS = (1.0, 0.75, 0.5, 0.25)
# The part of what the first one leaves unexplained that another one may leave for it to be taken.
_BETTER = 0.8
# Misfit, of full scale, that halves the trust in a cell.
_MISFIT = 0.05


@dataclass(frozen=True)
class Correction:
    """grid: the colour grid. shoulder: of the exposure scale. gains: per layer, float32 (height, width, 4) on
    this scale: r, g, b and an unused 0; None: no correction.
    """

    grid: Grid
    shoulder: float
    gains: tuple[Buffer | None, ...]


def colour_grid(grid: Grid, covered: npt.NDArray[np.bool_]) -> Grid:
    """The coarse grid over the region of `grid`; covered: (layers, height, width), of any grid over it."""
    depth = np.cbrt(np.mean(covered.sum(0, dtype=np.float64) ** 3))
    return grid.coarser(max(_CELL, round(_CELL * depth / _DEEP)))


def clipping(layer: WorkingLayer) -> tuple[float, ...]:
    """The r, g, b above which a layer's samples may be clipped and measure nothing, and an unused 1."""
    return (*(CLIPPED * white for white in layer.clips_at), 1.0)


def measure(
    device: Device,
    layers: Sequence[WorkingLayer],
    fields: Sequence[Buffer],
    pairs: Sequence[Pair],
    grid: Grid,
    covered: npt.NDArray[np.bool_],
) -> Measured:
    """Compare the aligned layers in their overlaps. fields: of geometry.py.
    covered: (layers, height, width) on any grid over the same region.
    """
    cells = colour_grid(grid, covered)
    overlaps = [_Overlap(device, layers, fields, pair, grid, cells) for pair in pairs]
    shoulder = _shoulder(overlaps) if layers[0].layer.dtype.kind == "u" else 0.0
    started = [overlap.start_difference(shoulder) for overlap in overlaps]  # all before the first is fetched
    differences = tuple(overlap.difference(*its) for overlap, its in zip(overlaps, started, strict=True))
    return Measured(cells, on_cells(covered, cells, np.logical_or), shoulder, differences)


def correction(
    device: Device,
    measured: Measured,
    settings: Settings,
    ignored: npt.NDArray[np.bool_] | None = None,
    strict: bool = False,
) -> Correction:
    """Solve for the gains of all layers.

    ignored: (height, width) on any grid over the same region: pixels whose differences are not used; a colour
    cell with any of them counts for nothing, but where an overlap is no wider than two.
    strict: reject outliers earlier, so that what moved stays visible in the residual.
    With `settings.exposure` off there is no correction.
    """
    cells, inside = measured.grid, measured.inside
    none = Correction(cells, measured.shoulder, (None,) * len(inside))
    if not settings.exposure:
        return none
    differences = measured.differences
    unknown = None if ignored is None else on_cells(ignored[None], cells, np.logical_or)[0]
    if unknown is not None:
        differences = tuple(_weighted(d, _counts(d, unknown)) for d in differences)
    if settings.flow:  # without, layers are not mixed but cut, somewhere
        differences = tuple(_weighted(d, d.mixing + _UNSEEN) for d in differences)
    if not any(np.any(v[..., :3] * v[..., 3:]) for d in differences for v in (d.values, d.beyond)):
        return none
    gains = solve(replace(measured, differences=differences), strict, unknown)
    gains = np.sign(gains) * np.maximum(np.abs(gains) - NEGLIGIBLE, 0)
    result: list[Buffer | None] = []
    ends = np.cumsum(np.count_nonzero(inside, axis=(1, 2)))
    for mask, its in zip(inside, np.split(gains, ends[:-1]), strict=True):
        if not its.any():
            result.append(None)
            continue
        gain, packed = np.zeros((*cells.shape, 3)), np.zeros((*cells.shape, 4), np.float32)
        gain[mask] = its
        packed[..., :3] = _extend(gain, mask, cells.wraps)
        result.append(device.upload(packed))
    return replace(none, gains=tuple(result))


def _counts(difference: Difference, unknown: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Whether what is measured in each cell counts: not in `unknown` ones, (height, width) on the colour
    grid, but where the overlap is narrow. That is rather exposure, which nothing beside tells there, than
    somebody.
    """
    wide = scipy.ndimage.binary_opening(difference.values[..., 3] > 0, np.ones((3, 3)))
    return ~(unknown[difference.cells] & grown(wide, 1, wraps=False))


def _weighted(difference: Difference, weight: npt.NDArray[Any]) -> Difference:
    """The same, weighted by (height, width) besides."""
    scale = np.stack([np.ones(weight.shape)] * 3 + [weight], -1)
    return replace(difference, values=difference.values * scale, beyond=difference.beyond * scale)


@dataclass(frozen=True)
class _Overlap:
    """Two aligned layers, to be compared per cell of the grid `cells`."""

    device: Device
    layers: Sequence[WorkingLayer]
    fields: Sequence[Buffer]
    pair: Pair
    grid: Grid
    cells: Grid

    @property
    def _clipping(self) -> list[tuple[float, ...]]:
        return [clipping(self.layers[k]) for k in (self.pair.a, self.pair.b)]

    @property
    def _sides(self) -> list[Any]:
        """What both kernels begin with."""
        pairs = [(self.layers[k], self.fields[k]) for k in (self.pair.a, self.pair.b)]
        sides = [value for layer, field in pairs for value in (layer.pixels, field, layer.box)]
        return [*sides, self.grid.border, self.grid.lonlat, self.cells.border, self._part.place]

    @cached_property
    def _part(self) -> Box:
        """The cells that both layers' boxes reach into."""
        return shared_cells(self.layers[self.pair.a], self.layers[self.pair.b], self.grid, self.cells)

    def start_difference(self, shoulder: float) -> tuple[Buffer, Buffer, Buffer, Buffer]:
        """Have the device find the difference on the exposure scale of a shoulder."""
        width, height = self._part.width, self._part.height
        values, beyond = (self.device.empty((height, width, 4)) for _ in range(2))
        mixing, level = (self.device.empty((height, width)) for _ in range(2))
        self.device.run(
            "colour", "colour_difference", (width, height),
            *self._sides, shoulder, *self._clipping, _SPREAD, values, beyond, mixing, level,
        )  # fmt: skip
        return values, beyond, mixing, level

    def difference(self, *started: Buffer) -> Difference:
        """What `start_difference` started."""
        values, beyond, mixing, level = (one.get().astype(np.float64) for one in started)
        return Difference(self.pair.a, self.pair.b, values, beyond, mixing, level, self._part.slices)

    def start_misfit(self) -> Buffer:
        """Have the device find what is left of the difference on the scale of each of _SHOULDERS: (height,
        width, shoulders).
        """
        width, height = self._part.width, self._part.height
        misfit = self.device.empty((height, width, len(_SHOULDERS)))
        self.device.run(
            "colour", "colour_misfit", (width, height),
            *self._sides, _SHOULDERS, *self._clipping, misfit,
        )  # fmt: skip
        return misfit


def _shoulder(overlaps: Sequence[_Overlap]) -> float:
    """The shoulder that explains the layers' differences best; the first, where none is clearly better."""
    if not overlaps:
        return _SHOULDERS[0]
    started = [overlap.start_misfit() for overlap in overlaps]
    misfit = np.concatenate([one.get().astype(np.float64).reshape(-1, len(_SHOULDERS)) for one in started])
    # what no scale explains is no exposure, and counts for as little as it tells
    total = (misfit / (1 + misfit.min(1, keepdims=True) / _MISFIT**2)).sum(0)
    best = int(np.argmin(total))
    return _SHOULDERS[best if total[best] < _BETTER * total[0] else 0]


def _extend(
    gain: npt.NDArray[np.float64], mask: npt.NDArray[np.bool_], wraps: bool
) -> npt.NDArray[np.float64]:
    """Carry gains two cells beyond the layer, so that interpolation at its border finds no zeros."""
    known = mask.astype(np.float64)
    rows, columns = known.shape
    value = gain * known[..., None]
    for _ in range(2):
        sums, weights = np.zeros_like(value), np.zeros_like(known)
        around_w, around_v = np.pad(known, 1), np.pad(value, [(1, 1), (1, 1), (0, 0)])
        if wraps:
            around_w[1:-1, 0], around_w[1:-1, -1] = known[:, -1], known[:, 0]
            around_v[1:-1, 0], around_v[1:-1, -1] = value[:, -1], value[:, 0]
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                sums += around_v[1 + dy : 1 + dy + rows, 1 + dx : 1 + dx + columns]
                weights += around_w[1 + dy : 1 + dy + rows, 1 + dx : 1 + dx + columns]
        new = (known == 0) & (weights > 0)
        value[new] = sums[new] / weights[new][:, None]
        known[new] = 1
    return value

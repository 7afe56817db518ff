"""A multi-band blend of aligned, corrected layers: what is to be added to each (kernels/multiband.cl).

Each band of frequencies changes over as widely as its waves are long, so that neither steps of brightness
nor doubled texture show (Burt and Adelson, "A multiresolution spline with application to image mosaics",
1983).

What is blended are the layers' differences from a mean, and the blend is added to that mean. Where all
layers cover everything this is the usual blend; layers that agree are not changed at all, however narrow
their overlaps. In the mean each layer's share fades towards its border: a mean in which a layer simply ended
would have a step there, by the difference that it goes on with beyond.

Only what fits on half the working grid is calculated here. In finer bands the weighted mean of the
full-resolution pass is the blend, and what is added to a layer before leaves them as they are.

Gains (colour.py) come before: an offset cannot restore contrast. Where layers show different things their
difference is extrapolated from beside (content.py).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from hugin_abflow import content
from hugin_abflow.colour import NEGLIGIBLE, Correction
from hugin_abflow.content import Unlike
from hugin_abflow.feather import feathers
from hugin_abflow.grid import Grid, Place
from hugin_abflow.opencl import MUCH, Buffer, Device
from hugin_abflow.working import WorkingLayer

# The shorter side is halved down to this many pixels: the lowest frequencies change over along all of it.
_LEAST_SIDE = 4
# The least width, in columns, of the spline by which rows are smoothed: with less it hardly does anything.
_LEAST_SPREAD = 0.7
# Its largest width, as a share of all columns: beside a pole it would have no end.
_MOST_SPREAD = 1 / 3
# Of a grid that is none.
_NONE = (0, 0, 0, 0)

Widths = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Offsets:
    """What is added to each layer, on its place (left, top, width, height) on `grid`.

    Float32 (height, width, 4): r, g, b of full scale and an unused 0; for floats, what is added to their
    logarithms (exposure_scale of common.cl), of their roots. None: nothing.
    """

    grid: Grid
    layers: tuple[tuple[Place, Buffer] | None, ...]


@dataclass(frozen=True)
class _Level:
    """One level of one layer: colour and validity, float32 (height, width, 4), and share of the weights."""

    grid: Grid
    box: Place
    colours: Buffer
    share: Buffer


def offsets(
    device: Device,
    layers: Sequence[WorkingLayer],
    fields: Sequence[Buffer],
    correction: Correction,
    grid: Grid,
    unlike: Unlike | None = None,
) -> Offsets:
    """Those that make of the weighted mean of the layers a multi-band blend. fields: of geometry.py.

    unlike: where layers show different things: what they differ by is told from beside; None: nowhere.
    """
    grids = levels(grid)
    if len(grids) < 2:
        return none(grid, len(layers))
    device.give_back()
    widths = [_widths(one) for one in grids]
    total = device.zeros(grid.shape)
    for layer, field in zip(layers, fields, strict=True):
        device.run(
            "multiband", "multiband_weights", layer.box[2:],
            layer.pixels, field, layer.box, grid.border, total,
        )  # fmt: skip
    finest = []
    for k, (layer, field) in enumerate(zip(layers, fields, strict=True)):
        finest.append(_finest(device, layer, field, total, correction, k, grid, grids[1], widths[1]))
        device.give_back(MUCH)  # layers are of different sizes
    del total
    _differ(device, finest, widths[1], unlike, correction.shoulder)
    blend = _blend(device, finest, grids[1:], widths[1:])
    result = []
    while finest:  # each makes room for the next one's
        level = finest.pop(0)
        result.append((level.box, _offset(device, level, blend)))
        del level
        device.give_back(MUCH)
    return Offsets(grids[1], tuple(result))


def none(grid: Grid, layers: int) -> Offsets:
    """Those of so many layers that are left as they are."""
    return Offsets(grid, (None,) * layers)


def levels(grid: Grid) -> list[Grid]:
    """The grids of a pyramid over the same region, finest first, each half as large as the one before."""
    grids = [grid]
    while min(grids[-1].shape) >= 2 * _LEAST_SIDE:
        grids.append(grids[-1].coarser(2))
    return grids


def _finest(
    device: Device,
    layer: WorkingLayer,
    field: Buffer,
    total: Buffer,
    correction: Correction,
    index: int,
    grid: Grid,
    half: Grid,
    widths: Widths,
) -> _Level:
    """What a layer shows on half the working grid."""
    level = _empty(device, half, _box(layer.box, grid, half, widths))
    gain = correction.gains[index]
    device.run(
        "multiband", "multiband_finest", level.box[2:],
        layer.pixels, field, layer.box, grid.border, grid.lonlat, total,
        gain or field, correction.grid.border if gain else _NONE, correction.shoulder,
        level.box, half.border, level.colours, level.share,
    )  # fmt: skip
    return level  # smoothed later: each by its own side of a border, layers that agree would differ there


def _differ(
    device: Device, finest: list[_Level], widths: Widths, unlike: Unlike | None, shoulder: float
) -> None:
    """Have each entry be how it differs from a mean of all in which none ends suddenly."""
    grid = finest[0].grid
    mean = device.zeros((*grid.shape, 4))
    shares = feathers(device, [(level.box, level.colours) for level in finest], grid)
    for level, share in zip(finest, shares, strict=True):
        _add(device, replace(level, share=share), None, mean)
    _join(device, mean, grid, None, None)
    for k, (level, share) in enumerate(zip(finest, shares, strict=True)):
        device.run(
            "multiband", "multiband_differ", level.box[2:], level.colours, level.box, grid.border, mean
        )
        if unlike is not None:
            content.complete(device, level.colours, share, level.box, grid, mean, unlike, shoulder)
        finest[k] = _spread(device, level, widths)
        del level
        device.give_back(MUCH)


def _blend(
    device: Device, finest: Sequence[_Level], grids: Sequence[Grid], widths: Sequence[Widths]
) -> Buffer:
    """The multi-band blend of levels on the first grid, on all of it: colour, and 1 where there is any."""
    sums = [device.zeros((*one.shape, 4)) for one in grids]
    for level in finest:
        for one, grid, width in zip(sums, grids[1:], widths[1:], strict=False):
            smaller = _reduced(device, level, grid, width)
            _add(device, level, smaller, one)
            level = smaller
        _add(device, level, None, sums[-1])
        device.give_back(MUCH)
    _join(device, sums[-1], grids[-1], None, None)
    for k in reversed(range(len(grids) - 1)):
        _join(device, sums[k], grids[k], sums[k + 1], grids[k + 1])
    return sums[0]


def _reduced(device: Device, level: _Level, grid: Grid, widths: Widths) -> _Level:
    """The next coarser level, on `grid`."""
    smaller = _empty(device, grid, _box(level.box, level.grid, grid, widths))
    device.run(
        "multiband", "multiband_reduce", smaller.box[2:],
        level.colours, level.share, level.box, level.grid.border,
        smaller.colours, smaller.share, smaller.box, grid.border,
    )  # fmt: skip
    return _spread(device, smaller, widths)


def _spread(device: Device, level: _Level, widths: Widths) -> _Level:
    """The same, on a sphere as smooth along its rows as across them."""
    if not level.grid.spherical:
        return level
    spread = _empty(device, level.grid, level.box)
    device.run(
        "multiband", "multiband_spread", level.box[2:],
        level.colours, level.share, level.box, level.grid.border, device.upload(widths),
        spread.colours, spread.share,
    )  # fmt: skip
    return spread


def _add(device: Device, level: _Level, smaller: _Level | None, total: Buffer) -> None:
    """Add what a level of a layer shows beyond the next coarser one, weighted."""
    coarse = smaller or level
    device.run(
        "multiband", "multiband_add", level.box[2:],
        level.colours, level.share, level.box, level.grid.border,
        coarse.colours, coarse.box, smaller.grid.border if smaller else _NONE, total,
    )  # fmt: skip


def _join(device: Device, total: Buffer, grid: Grid, smaller: Buffer | None, coarse: Grid | None) -> None:
    """Have the sum of a level's details be that level, which the next coarser one is part of."""
    device.run(
        "multiband", "multiband_join", grid.border.size,
        total, grid.border, smaller or total, coarse.border if coarse else _NONE,
    )  # fmt: skip


def _offset(device: Device, level: _Level, blend: Buffer) -> Buffer:
    offset = device.empty(level.colours.shape)
    device.run(
        "multiband", "multiband_offset", level.box[2:],
        level.colours, level.box, level.grid.border, blend, NEGLIGIBLE, offset,
    )  # fmt: skip
    return offset


def _empty(device: Device, grid: Grid, box: Place) -> _Level:
    shape = box[3], box[2]
    return _Level(grid, box, device.empty((*shape, 4)), device.empty(shape))


def _widths(grid: Grid) -> Widths:
    """How widely each row of a sphere's grid is smoothed, in columns, to be as smooth along as across it."""
    if not grid.spherical:
        return np.zeros(grid.height, np.float32)
    slope = np.abs(np.tan(grid.latitudes))  # sqrt(1 / cos^2 - 1): the rest has been done by the reduction
    return np.asarray(np.clip(slope, _LEAST_SPREAD, _MOST_SPREAD * grid.width), np.float32)


def _box(box: Place, fine: Grid, grid: Grid, widths: Widths) -> Place:
    """Where what lies on a box of a grid shows on the next coarser one."""
    left, top, width, height = box
    across, down = grid.width / fine.width, grid.height / fine.height
    first = max(math.floor(top * down - 1.5), 0)
    last = min(math.ceil((top + height) * down + 1.5), grid.height)
    beyond = 1.5 + 1.5 * float(widths[first:last].max())
    start, end = math.floor(left * across - beyond), math.ceil((left + width) * across + beyond)
    over_pole = (first == 0 and grid.poles & 1) or (last == grid.height and grid.poles & 2)
    if over_pole or (grid.wraps and (start < 0 or end > grid.width)):
        start, end = 0, grid.width
    start, end = max(start, 0), min(end, grid.width)
    return start, first, end - start, last - first

"""Flow that leads back to where it started is trusted; elsewhere it is filled (kernels/consistency.cl).

A flow from a to b and the flow from b to a undo each other where both are right. Where they do not
(occlusions, surfaces without texture), flow is carried on from the trusted flow around, hardly across edges
of the image: a thing keeps its motion up to its outline, and what is behind it has its own. It is a diffusion
that stops at edges, on a pyramid of trust-weighted means: each level starts from the filled coarser one, and
a few sweeps do the rest (after Bornemann, Deuflhard, "The cascadic multigrid method for elliptic problems",
1996). The place of what is taken from one photo (single.py) is filled with wide means, without regard to
edges: what is beside it was matched half with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hugin_abflow.cells import CELL, Mask, Whole
from hugin_abflow.chart import Chart
from hugin_abflow.geometry import Pair, PairFlow
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.pyramid import Level

# Brightness of what tells nothing: UNTOLD of kernels/common.cl.
UNTOLD = 1e3
# Pixels between start and return that leave a sixteenth of the trust, whatever the chart's resolution:
# refined flow is that much more exact. What is far off must leave next to nothing: many such pixels would
# outweigh the few around them.
_TOLERANCE = 2.2
# What one photo shows and a near thing hides in the other has no place there. Flow squeezes it between its
# neighbours, and leads back all the same. A pixel has no trust if only this share of its area is left.
_SQUEEZED = 0.6
# The level whose mean tells how much is trusted around a pixel, and the mean that is enough: less is found on
# islands and lines on which wrong flows happen to lead back.
_AROUND, _ENOUGH = 2, 0.3
# What a pixel's own flow counts where its trust is a half, against what one neighbour has to say; else it
# counts by the odds of its trust. Less, and thin things lose theirs; more, and what is wrong is spread.
_OWN = 16.0
# Difference of log brightness between neighbours that halves what is carried from one to the other.
_EDGE = 0.08
# Sweeps per level, and how far each goes (successive over-relaxation); on levels of fewer pixels than this
# nothing is told apart.
_SWEEPS, _RELAXATION, _LEAST_PIXELS = 4, 1.5, 64


@dataclass(frozen=True)
class Weighed(Pair):
    """Flow between the layers of a pair as it was found, and how far it is trusted.

    forward, backward   float32 (height, width, 4) on their chart: flow in px, trust 0..1, and brightness of
                        the layer that it starts on, 0 where it shows nothing.
    whole               whether something is taken from one of them.
    """

    chart: Chart
    forward: Buffer
    backward: Buffer
    whole: bool


def weigh(device: Device, pair: PairFlow, images: Sequence[Level], whole: Whole | None = None) -> Weighed:
    """How far a pair's flows are trusted. images: log brightness of both layers on the pair's chart."""
    ways = [(pair.forward, pair.backward), (pair.backward, pair.forward)]
    cells = (whole.first, whole.second) if whole else (None, None)
    forward, backward = (
        _supported(device, trust(device, *way, pair.chart.wraps, level.image, its), pair.chart.wraps)
        for way, level, its in zip(ways, images, cells, strict=True)
    )
    return Weighed(pair.a, pair.b, pair.chart, forward, backward, bool(whole))


def unknown(device: Device, pair: Pair, chart: Chart, images: Sequence[Level]) -> Weighed:
    """A pair of whose flow nothing is known. images: log brightness of both layers on the chart."""

    def way(image: Level) -> Buffer:
        values = np.zeros((chart.height, chart.width, 4), np.float32)
        values[..., 3] = image.image.get()
        return device.upload(values)

    return Weighed(pair.a, pair.b, chart, way(images[0]), way(images[1]), whole=False)


def known(found: Weighed) -> float:
    """The share of an overlap, 0..1, in which its flow is trusted, both ways; but for its rim, from where
    flow leads out of it.
    """
    ways = found.forward.get(), found.backward.get()
    both = np.logical_and(*(way[..., 3] != 0 for way in ways))
    shares = []
    for way in ways:
        trusted = both & (way[..., 2] > 0.5)
        if not trusted.any():
            return 0.0
        across, down = np.rint(np.median(way[trusted, :2], axis=0)).astype(int)
        inside = both & _moved(_moved(both, -down, 0, False), -across, 1, found.chart.wraps)
        shares.append(float(way[inside, 2].mean()) if inside.any() else 0.0)
    return min(shares)


def _moved(mask: Mask, by: int, axis: int, wraps: bool) -> Mask:
    """A mask, so many pixels on; what comes in is not in it, unless it comes back."""
    moved, size = np.roll(mask, by, axis), mask.shape[axis]
    if not wraps:
        np.moveaxis(moved, axis, 0)[slice(by) if by > 0 else slice(max(0, size + by), size)] = False
    return moved


def mend(device: Device, found: Weighed) -> PairFlow:
    """The pair's flows, filled where they are not trusted, and in the place of what is taken from one."""
    forward, backward = (
        _fill(device, trusted, found.chart.wraps, found.whole) for trusted in (found.forward, found.backward)
    )
    return PairFlow(found.a, found.b, found.chart, forward, backward)


def trust(
    device: Device, flow: Buffer, back: Buffer, wraps: bool, image: Buffer, whole: Mask | None = None
) -> Buffer:
    """float32 (height, width, 4): flow in px, trust 0..1, and brightness, which tells where edges are.

    image: log brightness of the layer that the flow starts on, float32 (height, width), 0 where it shows
    nothing. whole: cells that have no trust, and whose brightness tells nothing.
    """
    trusted = device.empty((*flow.shape[:2], 4))
    grid = _grid(flow, wraps)
    distrusted = device.upload(np.zeros((1, 1), np.uint8) if whole is None else whole.astype(np.uint8))
    cells = (*distrusted.shape[::-1], CELL, 0)
    device.run(
        "consistency", "consistency_trust", grid[:2], flow, back, grid, _TOLERANCE, _SQUEEZED,
        distrusted, cells, image, trusted,
    )  # fmt: skip
    return trusted


def _supported(device: Device, trusted: Buffer, wraps: bool) -> Buffer:
    """Less trust, in place, where there is little around."""
    around, grid = trusted, _grid(trusted, wraps)
    for _ in range(_AROUND):
        around = _coarser(device, around, wraps)
    device.run(
        "consistency", "consistency_support", grid[:2], around, _grid(around, wraps), 2.0**_AROUND, _ENOUGH,
        trusted, grid,
    )  # fmt: skip
    return trusted


def _fill(device: Device, trusted: Buffer, wraps: bool, whole: bool) -> Buffer:
    grid, levels = _grid(trusted, wraps), [trusted]
    while max(levels[-1].shape[:2]) > 1:
        levels.append(_coarser(device, levels[-1], wraps))
    filled = _carried(device, levels, wraps, _SWEEPS)
    wide = _carried(device, levels, wraps, sweeps=0) if whole else filled
    device.run("consistency", "consistency_mix", grid[:2], trusted, grid, wide, filled)
    return filled


def _coarser(device: Device, fine: Buffer, wraps: bool) -> Buffer:
    """The next level of the pyramid."""
    small = device.empty(((fine.shape[0] + 1) // 2, (fine.shape[1] + 1) // 2, 4))
    size = _grid(small, wraps)[:2]
    device.run("consistency", "consistency_push", size, fine, _grid(fine, wraps), small, size)
    return small


def _carried(device: Device, levels: Sequence[Buffer], wraps: bool, sweeps: int) -> Buffer:
    """The finest level's flow, filled coarse to fine; without sweeps by wide means of what is around."""
    filled = device.empty((1, 1, 2))
    device.run("consistency", "consistency_flow", (1, 1), levels[-1], (1, 1, 0, 0), filled)
    for level in levels[-2::-1]:
        grid, coarse = _grid(level, wraps), filled
        filled = device.empty((*level.shape[:2], 2))
        device.run(
            "consistency", "consistency_pull", grid[:2], level, grid, coarse, _grid(coarse, wraps), filled
        )
        if sweeps and grid[0] * grid[1] >= _LEAST_PIXELS:
            calls = [(level, grid, _OWN, _EDGE, colour, _RELAXATION, filled) for colour in (0, 1)]
            half = (-(-grid[0] // 2), grid[1])
            device.repeat("consistency", "consistency_relax", half, calls, sweeps)
    return filled


def _grid(buffer: Buffer, wraps: bool) -> tuple[int, int, int, int]:
    return buffer.shape[1], buffer.shape[0], int(wraps), 0

"""Trust in flow that leads back to where it started, and filling of the rest (kernels/consistency.cl).

A flow from a to b and the flow from b to a undo each other where both are right. Where they do not
(occlusions, surfaces without texture), three things happen in turn:

- A pixel takes over trusted flow from around, if that fits what the images show: beside somebody who went,
  the floor is where it was.
- Elsewhere flow is carried on from the trusted flow around, hardly across edges of the image: a thing keeps
  its motion up to its outline, and what is behind it has its own. It is a diffusion that stops at edges, on
  a pyramid of trust-weighted means: each level starts from the filled coarser one, and needs few sweeps
  (after Bornemann, Deuflhard, "The cascadic multigrid method for elliptic problems", 1996).
- The place of what is taken from one photo (single.py) is filled with wide means, whatever the edges: what
  is beside it was matched half with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hugin_abflow.cells import CELL, Mask, SingleSource
from hugin_abflow.chart import Chart
from hugin_abflow.flow import FlowParameters, adopt
from hugin_abflow.geometry import Pair, PairFlow
from hugin_abflow.grid import Border
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.pyramid import Level

# Brightness of pixels that do not count: EXCLUDED of kernels/common.cl.
EXCLUDED = 1e3
# Pixels between start and return that leave a sixteenth of the trust, whatever the chart's resolution:
# refined flow is that much more exact. What is far off must leave next to nothing: many such pixels would
# outweigh the few around them.
_TOLERANCE = 2.2
# What a near thing hides in the other photo has no place there. Flow squeezes it between its neighbours, and
# is consistent all the same. A pixel has no trust if flow leaves no more than this share of its area.
_SQUEEZED = 0.6
# The level of the pyramid, 0 the finest, whose mean tells how much is trusted around a pixel.
_AROUND = 2
# The mean that is enough: less is found on islands and lines on which wrong flows happen to lead back.
_ENOUGH = 0.3
# Weight of a pixel's own flow where its trust is a half, against that of one neighbour's; else it counts by
# the odds of its trust. With less, thin things lose theirs; with more, what is wrong is spread.
_OWN = 16.0
# Difference of log brightness between neighbours that halves what is carried from one to the other.
_EDGE = 0.08
# Sweeps per level.
_SWEEPS = 4
# How far each sweep goes: 1 to the mean, more beyond it (successive over-relaxation).
_RELAXATION = 1.5
# Pixels of a level from which on it is swept: on smaller ones nothing is told apart.
_LEAST_PIXELS = 64


@dataclass(frozen=True)
class WeightedFlow(Pair):
    """Flow between the layers of a pair as it was found, weighted by how far it is trusted.

    forward, backward   float32 (height, width, 4) on their chart: flow in px, trust 0..1, and brightness of
                        the layer that it starts on: 0 where it shows nothing, EXCLUDED where it does not
                        count.
    single              whether anything is taken from a single one of them.
    """

    chart: Chart
    forward: Buffer
    backward: Buffer
    single: bool


def weigh(
    device: Device, pair: PairFlow, images: Sequence[Level], parameters: FlowParameters,
    single: SingleSource | None = None,
) -> WeightedFlow:  # fmt: skip
    """How far a pair's flows are trusted. Where they are not, each pixel may have taken over flow that is:
    beside somebody who is gone the floor is where it was.

    images      log brightness of both layers on the pair's chart.
    parameters  by which flow was found.
    single      what is taken from a single one of them: flow there is not trusted.
    """
    excluded = (single.first, single.second) if single else (None, None)
    wraps = pair.chart.wraps

    def weighed(forward: Buffer, backward: Buffer) -> tuple[Buffer, Buffer]:
        there, back = (
            _supported(device, trust(device, flow, other, wraps, level.image, cells), wraps)
            for flow, other, level, cells in zip(
                (forward, backward), (backward, forward), images, excluded, strict=True
            )
        )
        return there, back

    adopted = adopt(device, images, weighed(pair.forward, pair.backward), parameters)
    forward, backward = weighed(*(_flow(device, one, wraps) for one in adopted))
    return WeightedFlow(pair.a, pair.b, pair.chart, forward, backward, bool(single))


def unknown(device: Device, pair: Pair, chart: Chart, images: Sequence[Level]) -> WeightedFlow:
    """A pair of whose flow nothing is known. images: log brightness of both layers on the chart."""

    def untrusted(image: Level) -> Buffer:
        values = np.zeros((chart.height, chart.width, 4), np.float32)
        values[..., 3] = image.image.get()
        return device.upload(values)

    return WeightedFlow(pair.a, pair.b, chart, untrusted(images[0]), untrusted(images[1]), single=False)


def known(found: WeightedFlow) -> float:
    """The share of an overlap, 0..1, in which its flow is trusted in both directions; without its rim, from
    where flow leads out of it.
    """
    flows = found.forward.get(), found.backward.get()
    overlap = np.logical_and(*(flow[..., 3] != 0 for flow in flows))
    shares = []
    for flow in flows:
        trusted = overlap & (flow[..., 2] > 0.5)
        if not trusted.any():
            return 0.0
        across, down = np.rint(np.median(flow[trusted, :2], axis=0)).astype(int)
        inside = overlap & _moved(_moved(overlap, -down, 0, False), -across, 1, found.chart.wraps)
        shares.append(float(flow[inside, 2].mean()) if inside.any() else 0.0)
    return min(shares)


def _moved(mask: Mask, by: int, axis: int, wraps: bool) -> Mask:
    """A mask, moved by so many pixels; what comes in from beyond the border is False unless columns wrap."""
    moved, size = np.roll(mask, by, axis), mask.shape[axis]
    if not wraps:
        np.moveaxis(moved, axis, 0)[slice(by) if by > 0 else slice(max(0, size + by), size)] = False
    return moved


def fill(device: Device, found: WeightedFlow) -> PairFlow:
    """The pair's flows, filled where they are not trusted, and in the place of what one layer is to show."""
    forward, backward = (
        _filled(device, flow, found.chart.wraps, found.single) for flow in (found.forward, found.backward)
    )
    return PairFlow(found.a, found.b, found.chart, forward, backward)


def trust(
    device: Device, flow: Buffer, back: Buffer, wraps: bool, image: Buffer, excluded: Mask | None = None
) -> Buffer:
    """float32 (height, width, 4): flow in px, trust 0..1, and brightness, which tells where edges are.

    image       log brightness of the layer that the flow starts on, float32 (height, width), 0 where it shows
                nothing.
    excluded    cells that have no trust, and whose brightness does not count.
    """
    trusted = device.empty((*flow.shape[:2], 4))
    grid = Border.of(flow.shape, wraps)
    mask = device.upload(np.zeros((1, 1), np.uint8) if excluded is None else excluded.astype(np.uint8))
    cells = (*mask.shape[::-1], CELL, 0)
    device.run(
        "consistency", "consistency_trust", grid.size, flow, back, grid, _TOLERANCE, _SQUEEZED,
        mask, cells, image, trusted,
    )  # fmt: skip
    return trusted


def _supported(device: Device, trusted: Buffer, wraps: bool) -> Buffer:
    """Lower trust, in place, where there is little around."""
    around, grid = trusted, Border.of(trusted.shape, wraps)
    for _ in range(_AROUND):
        around = _coarser(device, around, wraps)
    device.run(
        "consistency", "consistency_support", grid.size,
        around, Border.of(around.shape, wraps), 2.0**_AROUND, _ENOUGH, trusted, grid,
    )  # fmt: skip
    return trusted


def _filled(device: Device, trusted: Buffer, wraps: bool, single: bool) -> Buffer:
    grid, levels = Border.of(trusted.shape, wraps), [trusted]
    while max(levels[-1].shape[:2]) > 1:
        levels.append(_coarser(device, levels[-1], wraps))
    filled = _carried(device, levels, wraps, _SWEEPS)
    wide = _carried(device, levels, wraps, sweeps=0) if single else filled
    device.run("consistency", "consistency_mix", grid.size, trusted, grid, wide, filled)
    return filled


def _coarser(device: Device, fine: Buffer, wraps: bool) -> Buffer:
    """The next level of the pyramid."""
    small = device.empty(((fine.shape[0] + 1) // 2, (fine.shape[1] + 1) // 2, 4))
    size = Border.of(small.shape, wraps).size
    device.run("consistency", "consistency_push", size, fine, Border.of(fine.shape, wraps), small, size)
    return small


def _carried(device: Device, levels: Sequence[Buffer], wraps: bool, sweeps: int) -> Buffer:
    """The finest level's flow, filled coarse to fine; without sweeps by wide means of what is around."""
    filled = _flow(device, levels[-1], wraps=False)
    for level in levels[-2::-1]:
        grid, coarse = Border.of(level.shape, wraps), filled
        filled = device.empty((*level.shape[:2], 2))
        device.run(
            "consistency", "consistency_pull", grid.size,
            level, grid, coarse, Border.of(coarse.shape, wraps), filled,
        )  # fmt: skip
        if sweeps and grid.width * grid.height >= _LEAST_PIXELS:
            calls = [(level, grid, _OWN, _EDGE, colour, _RELAXATION, filled) for colour in (0, 1)]
            half = (-(-grid.width // 2), grid.height)
            device.repeat("consistency", "consistency_relax", half, calls, sweeps)
    return filled


def _flow(device: Device, trusted: Buffer, wraps: bool) -> Buffer:
    """The flow alone, float32 (height, width, 2), px."""
    alone, grid = device.empty((*trusted.shape[:2], 2)), Border.of(trusted.shape, wraps)
    device.run("consistency", "consistency_flow", grid.size, trusted, grid, alone)
    return alone

"""Flow as it passes through the view between two layers (kernels/intermediate.cl).

Flow starts on a layer: F_ab at a place p tells where b shows what a shows at p. But that is not what the
panorama shows at p. It shows what passes through p on its way from its place in a to its place in b, having
come as far as b's share at p: the intermediate flow of frame interpolation.

Most often the two flows that start at p tell it well enough. Where a near thing is narrower than its motion
neither does: a cable that lies 20 px lower in the other photo would be cut halfway. So consistent flows are
also followed to where they pass (forward splatting). If two of them meet there, the one is taken that hides
the other: what is behind is seen beside the near thing in a layer, and leads to behind it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hugin_abflow.geometry import PairFlow
from hugin_abflow.grid import Grid
from hugin_abflow.opencl import MUCH, Buffer, Device
from hugin_abflow.settings import Settings
from hugin_abflow.working import WorkingLayer

# Rounds in which each place takes over what passes there.
_ROUNDS = 2
# Pixels of a row that a work item takes: INTERMEDIATE_CHUNK of kernels/intermediate.cl.
_CHUNK = 4


def replace_flows(
    device: Device,
    layers: Sequence[WorkingLayer],
    coefficients: Sequence[Buffer],
    flows: list[PairFlow],
    grid: Grid,
    settings: Settings,
) -> None:
    """Replace each pair's flows, which start at places, by intermediate ones, which pass through them. What
    is to be seen at p, layer a then shows at p + w_b `backward`(p), layer b at p + w_a `forward`(p), and
    `backward` is -`forward`. With `settings.intermediate` off nothing changes.

    coefficients    w_k on each layer's box; those of a pair count as if there were no other layers.
    """
    for number, pair in enumerate(flows if settings.intermediate else ()):
        a, b = layers[pair.a], layers[pair.b]
        width, height = pair.chart.width, pair.chart.height
        share, chunks = device.empty((height, width)), (-(-width // _CHUNK), height)
        device.run(
            "intermediate", "intermediate_share", chunks, coefficients[pair.a], a.box,
            coefficients[pair.b], b.box, grid.border, grid.lonlat, pair.chart.border, pair.chart.transform,
            share,
        )  # fmt: skip
        flows[number] = _passing(device, pair, share)
        device.give_back(MUCH)


def _passing(device: Device, pair: PairFlow, share: Buffer) -> PairFlow:
    """The intermediate flows of a pair. share: of layer b, float32 (height, width) on the chart."""
    flow, back = pair.forward, pair.backward
    shape, border = share.shape, pair.chart.border
    size = shape[::-1]
    direct = device.empty(flow.shape)
    device.run("intermediate", "intermediate_direct", size, flow, back, border, share, direct)
    passing, seen = device.copy(direct), device.zeros(shape, np.uint8)
    places, both = device.empty((2, *shape), np.int32), (*size, 2)
    device.run("intermediate", "intermediate_follow", both, flow, back, border, share, places)
    for _ in range(_ROUNDS):
        furthest, source = device.zeros(shape, np.uint32), device.zeros(shape, np.uint32)
        for named in (0, 1):
            device.run(
                "intermediate", "intermediate_pass", both, flow, back, border, places, passing, named,
                furthest, source,
            )  # fmt: skip
        device.run(
            "intermediate", "intermediate_choose", size, flow, back, border, share, source, passing, seen
        )
    kept = device.empty(shape, np.uint8)
    device.run("intermediate", "intermediate_keep", size, passing, seen, border, kept)
    forward, backward = device.empty(flow.shape), device.empty(flow.shape)
    device.run("intermediate", "intermediate_fill", size, direct, passing, kept, border, forward, backward)
    return PairFlow(pair.a, pair.b, pair.chart, forward, backward)

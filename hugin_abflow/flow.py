"""Flow between two images of one grid, in both directions (kernels/flow.cl).

Combined local-global optical flow: the data term is Lucas and Kanade's windowed least squares, on
brightness and gradient, and a smoothness term spreads it over untextured pixels and beyond the masks
(Bruhn, Weickert, Schnoerr, "Lucas/Kanade meets Horn/Schunck", 2005). Coarse to fine with warping; motion too
large for that comes from search.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from hugin_abflow import pyramid, search
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.pyramid import Level
from hugin_abflow.search import SearchParameters


@dataclass(frozen=True)
class FlowParameters:
    """What the solver weighs; units of h are log brightness."""

    coarsest: int = 12  # px: the coarsest level's shorter side is at least this, less than twice this
    warps: tuple[int, ...] = (2, 5)  # linearisations per level, finest first; the last holds for all coarser
    sweeps: tuple[int, ...] = (8, 12, 24, 24)  # red-black sweeps per linearisation, likewise
    relaxation: float = 1.85  # of successive over-relaxation
    brightness: float = 5.0  # weight of brightness constancy
    gradient: float = 10.0  # weight of gradient constancy
    smoothness: float = 12.0  # weight of the smoothness term
    contrast: float = 0.3  # step of h across which smoothness falls to 1/e
    noise: float = 0.01  # amplitude of h that is no texture
    mean_sigma: float = 6.0  # px: h is log brightness less its Gaussian mean of this sigma
    reach: float = 0.16  # of the longer side: how large a motion is searched where the caller does not say
    overlap: float = 0.5  # of the root of the common mask's area: no larger motion is searched
    choose_from: int = 2  # finest level (0: full) on which pixels take over flow from beside them
    search: SearchParameters = field(default_factory=SearchParameters)


# Changes a level's linear system, (level, left side, right side) of kernel flow_system, before it is solved.
Pull = Callable[[int, Buffer, Buffer], None]


@dataclass(frozen=True)
class Start:
    """A solution to start from: `flows` (both ways) on `level`; coarser levels are left out."""

    level: int
    flows: tuple[Buffer, Buffer]
    pulls: tuple[Pull | None, Pull | None] = (None, None)


@dataclass(frozen=True)
class _Features:
    feature: Buffer
    grid: tuple[int, int, int, int]


def _features(device: Device, level: Level, coarser: Level, parameters: FlowParameters) -> _Features:
    """Features of a level; the local mean is smooth enough to be taken from the next coarser one."""
    mean = pyramid.smooth(device, coarser, parameters.mean_sigma / 2)
    feature = device.empty((*level.image.shape, 4))
    device.run(
        "flow", "flow_feature", level.grid[:2], level.image, level.mask, level.grid,
        mean.image, mean.mask, mean.grid, feature,
    )  # fmt: skip
    return _Features(feature, level.grid)


def _refine(
    device: Device,
    a: _Features,
    b: _Features,
    flow: Buffer,
    level: int,
    parameters: FlowParameters,
    pull: Pull | None = None,
) -> Buffer:
    """Improve `flow` from a to b on one level."""
    grid, size = a.grid, a.grid[:2]
    shape = size[::-1]
    warped, tensor, left = (device.empty((*shape, 4)) for _ in range(3))
    right, median = (device.empty((*shape, 2)) for _ in range(2))
    system_left, system_right = (device.empty((*shape, 4)) for _ in range(2))
    window_right = device.empty((*shape, 2))
    warps, sweeps = (
        per_level[min(level, len(per_level) - 1)] for per_level in (parameters.warps, parameters.sweeps)
    )
    for _ in range(warps):
        device.run("flow", "flow_warp", size, b.feature, flow, grid, warped)
        device.run(
            "flow", "flow_tensor", size, a.feature, warped, grid,
            parameters.brightness, parameters.gradient, parameters.noise, tensor, right,
        )  # fmt: skip
        device.run("flow", "flow_window", size, tensor, right, grid, left, window_right)
        device.run(
            "flow", "flow_system", size, left, window_right, flow, a.feature, grid,
            parameters.smoothness, parameters.contrast, system_left, system_right,
        )  # fmt: skip
        if pull:
            pull(level, system_left, system_right)
        half = ((size[0] + 1) // 2, size[1])
        calls = [(system_left, system_right, grid, colour, parameters.relaxation, flow) for colour in (0, 1)]
        device.repeat("flow", "flow_relax", half, calls, sweeps)
        flow, median = search.filtered(device, flow, grid, median), flow
    return flow


def levels(image: Level, parameters: FlowParameters) -> int:
    """How many levels the flow of an image has."""
    shorter, count = min(image.grid[:2]), 1
    while shorter >= 2 * parameters.coarsest:
        shorter, count = shorter // 2, count + 1
    return count


def finest_features(device: Device, image: Level, parameters: FlowParameters) -> Buffer:
    """What the solver sees of an image on its finest level: float32 (height, width, 4), see flow.cl."""
    return _features(device, image, pyramid.reduce(device, image), parameters).feature


def _choose(
    device: Device, features: list[_Features], flows: list[Buffer], level: int, searched: bool,
    reach: float, parameters: FlowParameters,
) -> list[Buffer]:  # fmt: skip
    """The flows with which a level starts: each pixel's own, found by search, or from beside it."""
    grid, how = features[0].grid, parameters.search
    descriptors = a, b = [search.descriptor(device, f.feature, grid, how) for f in features]
    others = flows
    if searched:
        others = search.exhaustive(device, a, b, flows, grid, reach / 2**level, how)
    return [
        search.choose(device, descriptors[i], descriptors[1 - i], flow, others[i], grid, how)
        for i, flow in enumerate(flows)
    ]


def pair_flow(
    device: Device,
    a: Level,
    b: Level,
    parameters: FlowParameters | None = None,
    start: Start | None = None,
    reach: float | None = None,
) -> tuple[Buffer, Buffer]:
    """Flow from a to b and from b to a: two float32 (height, width, 2) in px of the grid.

    a, b: log brightness with masks, 0 outside them. start: its flows are worked on, not copied, and nothing
    else is searched. reach: the largest motion that is searched, px, 0: none; if it is None,
    `parameters.reach` of the longer side. It is less where the masks overlap little: in a small corner of a
    floor of tiles every tile fits. Raises `DeviceError` if the device fails.
    """
    parameters = parameters or FlowParameters()
    count = start.level + 1 if start else levels(a, parameters)
    searched, reach = -1, parameters.reach * max(a.grid[:2]) if reach is None else reach
    if reach > 0 and not start:
        common = np.count_nonzero(a.mask.get() * b.mask.get())
        reach = min(reach, parameters.overlap * math.sqrt(common))
        searched = search.level(reach, count, parameters.search) if reach > 0 else -1
    pyramids = [pyramid.build(device, image, count + 1) for image in (a, b)]
    flows: list[Buffer] | None = None
    for level in reversed(range(count)):
        features = [_features(device, p[level], p[level + 1], parameters) for p in pyramids]
        grid = features[0].grid
        if flows is None and start:
            flows = list(start.flows)
        elif flows is None:
            flows = [device.zeros((grid[1], grid[0], 2)) for _ in range(2)]
        else:
            flows = [_expand(device, flow, grid) for flow in flows]
        # a search on a level finer than choose_from (of a small image) is followed by no other choice
        if min(searched, parameters.choose_from) <= level <= searched:
            flows = _choose(device, features, flows, level, level == searched, reach, parameters)
        flows = [
            _refine(
                device,
                features[i],
                features[1 - i],
                flow,
                level,
                parameters,
                start.pulls[i] if start else None,
            )
            for i, flow in enumerate(flows)
        ]
    assert flows is not None
    return flows[0], flows[1]


def _expand(device: Device, flow: Buffer, grid: tuple[int, int, int, int]) -> Buffer:
    coarse = (flow.shape[1], flow.shape[0], grid[2], 0)
    fine = device.empty((grid[1], grid[0], 2))
    device.run("flow", "flow_expand", grid[:2], flow, coarse, fine, grid[:2])
    return fine

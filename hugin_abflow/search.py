"""Large motion, found by trying (kernels/search.cl).

On a coarse level every displacement within reach is tried; costs and smoothness are coupled and minimised in
turns (Steinbrücker, Pock, Cremers, "Large displacement optical flow computation without warping", 2009). What
both directions find and nothing else rivals is kept. There and on finer levels each pixel takes over a flow
from beside it where that fits better (Barnes et al., "PatchMatch", 2009).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hugin_abflow.grid import Border
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.pyramid import on_level

# SEARCH_MARGIN of kernels/search.cl.
_MARGIN = 16
# SEARCH_RADIUS of kernels/search.cl.
_LARGEST_RADIUS = 4
# Columns that a work item takes in kernels/search.cl: one float8.
_CHUNK = 8
# Columns that a work item of the median takes: FLOW_CHUNK of kernels/flow.cl.
_MEDIAN_CHUNK = 4
# Bytes for each pixel of the finest level that costs may take, and what they may take in any case: else
# motion is looked for on coarser levels.
_ROOM = 200
_LEAST_ROOM = 48 << 20


@dataclass(frozen=True)
class SearchParameters:
    """How large motion is searched. Costs are misfits of descriptors, 0 to 1."""

    coarse: float = 9.0  # px: displacements are tried on the finest level on which reach is at most this
    # px: the largest displacement tried there (reach is more if the coarsest level is too fine for it), and
    # on the next finer levels, which show finer texture
    furthest: tuple[int, ...] = (10, 7)
    noise: float = 0.05  # amplitude of h that is no texture
    outside: float = 0.5  # cost, on the coarse level, of what the other image does not show
    couplings: tuple[float, ...] = (0.001, 0.01, 0.03, 0.1, 0.3)  # of a squared pixel, in turns
    tolerance: float = 2.5  # px: by how much both directions may disagree
    distinct: float = 0.1  # how much less the one found costs than any other more than 2 px away
    own_outside: float = 0.25  # `outside` for a pixel's own flow, which is not given up for want of evidence
    other_outside: float = 0.75  # `outside` for a flow that it may take over
    patience: float = 0.06  # by how much a flow from elsewhere must fit better
    # px, at most 4, per level, finest first, the last for all coarser: of the window in which two flows are
    # compared; thin things show on finer levels alone, whose windows would hold too little if not larger
    radius: tuple[int, ...] = (4, 4, 2)
    focus: float = 4.0  # e-folds by which a pixel counts less there, for a difference of 1 from the middle
    # Which flow is kept (decision.py). Gains: the share of the misfit without a search that may remain.
    early_gain: float = 0.95  # on levels before the last decision
    gain: float = 0.82  # at last, if it leads elsewhere in a large share of the overlap
    apart: float = 1.5  # px of the level of the last decision, from which on flow leads elsewhere
    wide: float = 0.25  # the share of the overlap that is large
    gain_apart: float = 0.75  # where it leads elsewhere, if motion there is that of what stands still
    gain_back: float = 0.9  # and if it goes either way, if only what leads back explains anything
    textured: float = 0.02  # gradient of h from which on a pixel tells motion
    tells: float = 0.1  # the share of the overlap that has to be textured for all to be judged by that
    gap: float = 2.0  # px of a level between start and return from which on flow is not consistent
    always: bool = False  # keep what is found, whatever becomes of it
    # px from which flow is taken over, in turns, per level as for `radius`: short on finer levels, where the
    # rails of a chair in the sample room took over what fits them by chance (benchmarks/HISTORY.md, Parts)
    steps: tuple[tuple[int, ...], ...] = ((6, 3, 1), (6, 3, 1), (16, 8, 4, 2, 1))
    refined_steps: tuple[int, ...] = (12, 6, 3, 1)  # where flow is refined, and thin things are wider
    refined_patience: float = 0.2  # likewise; with less, outlines of what moves far get ragged
    # Where flow is not trusted: px from which that of trusted pixels is taken over, in turns, by how much it
    # must fit better, the misfit from which on nothing fits, and the trust that is enough.
    adopted_steps: tuple[int, ...] = (64, 16, 4, 1)
    adopted_patience: float = 0.3
    adopted_misfit: float = 0.3
    adopted_trust: float = 0.5

    def __post_init__(self) -> None:
        if max(self.radius) > _LARGEST_RADIUS:
            raise ValueError(f"radius is {self.radius}; windows have a radius of at most {_LARGEST_RADIUS}")
        if max(self.furthest) >= _MARGIN:
            raise ValueError(f"furthest is {self.furthest}; descriptors have a margin of {_MARGIN}")


def descriptor(device: Device, feature: Buffer, grid: Border, parameters: SearchParameters) -> Buffer:
    """Descriptors float32 (height, 4, columns) of one image's features (height, width, 4): see
    kernels/search.cl.
    """
    single, wide = device.empty(feature.shape), _pitch(grid.width) + 2 * _MARGIN
    energy = device.empty((grid.height, grid.width, 2))
    device.run("search", "search_energy", grid.size, feature, grid, energy)
    device.run("search", "search_descriptor", grid.size, feature, energy, grid, parameters.noise, single)
    result = device.empty((grid.height, 4, wide))
    device.run("search", "search_planes", (wide, grid.height), single, grid, wide, result)
    return result


def _pitch(width: int) -> int:
    """Columns of costs, and of descriptors without margins: what is read eight at a time, from up to two
    columns further on, ends within them.
    """
    return _CHUNK * (-(-width // _CHUNK) + 1)


def filtered(
    device: Device, flow: Buffer, grid: Border, result: Buffer, first: int = 0, ways: int = 1
) -> Buffer:
    """`result`, filled with the median of `flow`: both float32 (height, width, 2), or several of these, of
    which `ways` are filtered from `first` on.
    """
    chunks = (-(-grid.width // _MEDIAN_CHUNK), grid.height, ways)
    device.run("flow", "flow_median", chunks, flow, grid, first, result)
    return result


def reaches(
    reach: float, levels: int, grid: Border, parameters: SearchParameters, finest: int = 0
) -> dict[int, int]:
    """On which levels, of `levels`, how many of their px are tried, for motion of up to `reach` px of the
    finest; none but the first is finer than `finest`.

    grid    of the finest level.
    """
    if reach <= 0:
        return {}

    def tried(level: int, furthest: int) -> int:
        return min(math.ceil(reach / (1 << level)), furthest)

    def fits(level: int, furthest: int) -> bool:
        return _room(level, tried(level, furthest), grid) <= _enough_room(grid)

    first = min(levels - 1, max(0, math.ceil(math.log2(max(reach, 1) / parameters.coarse))))
    # on a chart around two far corners, which are small, motion is: fine levels would do
    while first < levels - 1 and not fits(first, parameters.furthest[0]):
        first += 1
    result = {first: tried(first, parameters.furthest[0])}
    for level, furthest in zip(range(first - 1, finest - 1, -1), parameters.furthest[1:], strict=False):
        if fits(level, furthest):
            result[level] = tried(level, furthest)
    return result


def _room(level: int, largest: int, grid: Border) -> int:
    """Bytes that `exhaustive` takes for costs on a level, where so many of its px are tried.

    grid    of the finest level.
    """
    width, height = (-(-side // (1 << level)) for side in grid.size)
    return 2 * 4 * height * (2 * largest + 1) ** 2 * _pitch(width)


def _enough_room(grid: Border) -> int:
    """Bytes that costs may take as long as there are coarser levels."""
    return max(_ROOM * grid.width * grid.height, _LEAST_ROOM)


def most_room(reach: float, levels: int, grid: Border, parameters: SearchParameters, finest: int = 0) -> int:
    """Bytes that `exhaustive` takes for costs, at most, on the levels of `reaches`: for motion of up to
    `reach` px, or of any less.
    """
    if reach <= 0:
        return 0
    tried = reaches(reach, levels, grid, parameters, finest)
    all_of_it = max((_room(level, largest, grid) for level, largest in tried.items()), default=0)
    less = _room(0, math.ceil(min(reach, parameters.coarse)), grid)
    return max(all_of_it, min(less, _enough_room(grid)))


def exhaustive(
    device: Device, a: Buffer, b: Buffer, flows: Sequence[Buffer], grid: Border, largest: int,
    parameters: SearchParameters,
) -> list[Buffer]:  # fmt: skip
    """Both directions' flow: what is found within `largest` px and beyond doubt, elsewhere `flows`.

    a, b: descriptors; flows, from a to b and from b to a, and the result: float32 (height, width, 2), px.
    """
    size = grid.size
    reach = min(largest, size[0] // 2), min(largest, size[1] // 2)
    count = (2 * reach[0] + 1) * (2 * reach[1] + 1)
    # one way after the other in the same memory
    room = [device.empty((grid.height, count, _pitch(grid.width))) for _ in range(2)]
    found, distinct = [], []
    for here, there, flow in ((a, b, flows[0]), (b, a, flows[1])):
        cost = costs(device, here, there, grid, reach, parameters.outside, room)
        found.append(_coupled(device, cost, flow, grid, reach, parameters))
        distinct.append(device.empty(size[::-1], np.uint8))
        device.run(
            "search", "search_distinct", size, cost, found[-1], grid, reach, parameters.distinct,
            cost.shape[2], distinct[-1],
        )  # fmt: skip
    agreed = [device.empty(flow.shape) for flow in flows]
    for way, out in enumerate(agreed):
        device.run(
            "search", "search_agree", size, found[way], found[1 - way], distinct[way], flows[way], grid,
            parameters.tolerance, out,
        )  # fmt: skip
    return agreed


def costs(
    device: Device, a: Buffer, b: Buffer, grid: Border, reach: tuple[int, int], outside: float,
    room: Sequence[Buffer],
) -> Buffer:  # fmt: skip
    """What displacements within reach cost, from a to b: float32 (height, displacements, columns), of which
    as many columns count as the grid has; it is the second of `room`, two of that shape.

    a, b: descriptors; outside: the cost of what the other image does not show.
    """
    width, height = grid.size
    pixel_cost, cost = room
    count, pitch = cost.shape[1:]
    device.run(
        "search", "search_pixel_cost", (pitch // _CHUNK * count * height,), a, b, grid, reach, a.shape[2],
        outside, pitch, pixel_cost,
    )  # fmt: skip
    rows = (-(-width // _CHUNK) * count * height,)
    device.run("search", "search_cost", rows, pixel_cost, grid, count, outside, pitch, cost)
    return cost


def _coupled(
    device: Device, cost: Buffer, flow: Buffer, grid: Border, reach: tuple[int, int],
    parameters: SearchParameters,
) -> Buffer:  # fmt: skip
    """The displacements of least cost, ever less free to differ from `flow`, then from their own mean."""
    chunks = (-(-grid.width // _CHUNK) * grid.height,)
    smooth, best, median = (device.empty(flow.shape) for _ in range(3))
    for turn, coupling in enumerate(parameters.couplings):
        if turn:
            for _ in range(2):
                best, median = filtered(device, best, grid, median), best
            device.run("search", "search_mean", grid.size, best, grid, smooth)
        device.run(
            "search", "search_best", chunks, cost, smooth if turn else flow, grid, reach, coupling,
            cost.shape[2], best,
        )  # fmt: skip
    return best


def choose(
    device: Device, a: Buffer, b: Buffer, flow: Buffer, other: Buffer, grid: Border, level: int,
    parameters: SearchParameters,
) -> Buffer:  # fmt: skip
    """`flow` from a to b, with flow from beside or of `other` where that fits better.

    a, b: descriptors; flows float32 (height, width, 2), px.
    """
    radius = on_level(parameters.radius, level)
    for step in on_level(parameters.steps, level):
        chosen = device.empty(flow.shape)
        device.run(
            "search", "search_choose", grid.size, a, b, flow, other, grid, a.shape[2], step, radius,
            parameters.focus, (parameters.own_outside, parameters.other_outside), parameters.patience, chosen,
        )  # fmt: skip
        flow = other = chosen
    return flow


def adopt(
    device: Device, a: Buffer, b: Buffer, trusted: Buffer, grid: Border, parameters: SearchParameters
) -> Buffer:
    """`trusted`, float32 (height, width, 4), with the flow of what is trusted around where it is not and that
    fits: flow from a to b in px, trust 0..1, and something that stays.

    a, b: descriptors.
    """
    outside = parameters.own_outside, parameters.other_outside
    for step in parameters.adopted_steps:
        adopted = device.empty(trusted.shape)
        device.run(
            "search", "search_adopt", grid.size, a, b, trusted, grid, a.shape[2], step, parameters.radius[0],
            parameters.focus, outside, parameters.adopted_patience, parameters.adopted_misfit,
            parameters.adopted_trust, adopted,
        )  # fmt: skip
        trusted = adopted
    return trusted

"""Flow between two images of one grid, in both directions (kernels/flow.cl).

Combined local-global optical flow: the data term is Lucas and Kanade's windowed least squares, on
brightness and gradient, and a smoothness term spreads it over untextured pixels and beyond the masks
(Bruhn, Weickert, Schnoerr, "Lucas/Kanade meets Horn/Schunck", 2005). Coarse to fine with warping; motion too
large for that comes from search.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from hugin_abflow import decision, pyramid, search
from hugin_abflow.decision import Bearings, Candidate, Refused
from hugin_abflow.grid import Border
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
    # of the longer side: how large a motion is searched for those who do not say it, such as tests and
    # benchmarks, to whom a picture is a whole canvas; pairflow.py says it, as a share of its canvas
    reach: float = 0.16
    overlap: float = 0.5  # of the root of the common mask's area: no larger motion is searched
    choose_from: int = 1  # finest level (0: full) on which pixels take over flow from beside them
    decide_on: int = 1  # level on which flow with and flow without what was searched are compared at last
    misfit: float = 0.2  # the largest misfit of a pixel, as a difference of the gradients of h
    search: SearchParameters = field(default_factory=SearchParameters)


# Work items that relax a row together: many, but few beyond the row's end. Rows of a board are whole groups.
_ROW_GROUP = 64
# Planes of a board: BOARD_PLANES of kernels/common.cl.
_PLANES = 22
# Pixels of a grid up to which a graphics card relaxes it by one work-group a way, so that it is started once.
_SMALL = 1 << 14
# Columns of such a group, which has as many rows as there can be.
_SMALL_COLUMNS = 16
# Bytes of a board up to which both ways are solved at a time: what does not stay in a CPU's cache is slower.
_TOGETHER = 1 << 23


def board_options(wraps: bool) -> str:
    """Build options of kernels that go over a board, whose last column may be beside its first one."""
    return f"-DWRAPS={int(wraps)}"


@dataclass(frozen=True)
class Board:
    """Linear systems of one grid with the flows that solve them, one for each way (kernels/common.cl).

    planes  float32 (ways, 2, height, planes, pitch).
    """

    planes: Buffer
    grid: Border

    @classmethod
    def of(cls, device: Device, ways: int, grid: Border) -> Board:
        """A board of zeros."""
        pitch = -(-((grid.width + 1) // 2 + 1) // _ROW_GROUP) * _ROW_GROUP
        return cls(device.zeros((ways, 2, grid.height, _PLANES, pitch)), grid)

    @property
    def pitch(self) -> int:
        """Columns of a row of one colour, unused ones at its end."""
        return self.planes.shape[-1]

    @property
    def ways(self) -> int:
        """How many systems there are."""
        return self.planes.shape[0]

    @property
    def options(self) -> str:
        """Build options of kernels that go over the board."""
        return board_options(bool(self.grid.wraps))

    def relax(self, device: Device, sweeps: int, relaxation: float) -> None:
        """Red-black sweeps."""
        width, height = self.grid.size
        if device.kind == "GPU" and width * height <= _SMALL:
            name = "flow_relax_small"
            most = device.largest_group("flow", name, self.options)
            columns = min(_SMALL_COLUMNS, most)
            group = (columns, most // columns)
            device.run(
                "flow", name, (*group, self.ways), self.grid, self.pitch, sweeps, relaxation, self.planes,
                options=self.options, group=group,
            )  # fmt: skip
            return
        calls = [(self.grid, self.pitch, colour, relaxation, self.planes) for colour in (0, 1)]
        size = (self.pitch, height, self.ways)
        device.repeat("flow", "flow_relax", size, calls, sweeps, self.options, _ROW_GROUP)

    def solution(self, device: Device, flows: Buffer, first: int = 0) -> Buffer:
        """`flows`, float32 (2, height, width, 2) or one of them, with the board's from way `first` on."""
        size = (*self.grid.size, self.ways)
        device.run("flow", "flow_solution", size, self.planes, self.grid, self.pitch, first, flows)
        return flows


# Changes a level's linear system before it is solved: level, board, which of its ways.
Pull = Callable[[int, Board, int], None]


@dataclass(frozen=True)
class Start:
    """A solution to start from: `flows` (both ways) on `level`; coarser levels are left out."""

    level: int
    flows: tuple[Buffer, Buffer]
    pulls: tuple[Pull | None, Pull | None] = (None, None)


@dataclass(frozen=True)
class Solution:
    """Flow from a to b and back, float32 (height, width, 2) px, and what was found besides."""

    forward: Buffer
    backward: Buffer
    refused: tuple[Refused, ...] = ()


def _features(device: Device, pairs: Sequence[tuple[Level, Level]], parameters: FlowParameters) -> Buffer:
    """Features of images, float32 (images, height, width, 4). Each is given by its level and the next coarser
    one: the local mean is smooth enough to be taken from there.
    """
    features = device.empty((len(pairs), *pairs[0][0].image.shape, 4))
    for way, (level, coarser) in enumerate(pairs):
        mean = pyramid.smooth(device, coarser, parameters.mean_sigma / 2)
        device.run(
            "flow", "flow_feature", level.grid.size, level.image, level.mask, level.grid,
            mean.image, mean.mask, mean.grid, way, features,
        )  # fmt: skip
    return features


def _refine(
    device: Device,
    features: Buffer,
    flows: Buffer,
    grid: Border,
    level: int,
    parameters: FlowParameters,
    pulls: tuple[Pull | None, Pull | None],
) -> Buffer:
    """Improve the flows between the images on one level, both ways; `flows` is used up."""
    median = device.empty(flows.shape)
    together = 2 * grid.width * grid.height * _PLANES * 4 <= _TOGETHER
    board = Board.of(device, 2 if together else 1, grid)
    rows, halves = (2 * board.pitch, grid.height, board.ways), (board.pitch, 2 * grid.height, board.ways)
    warps, sweeps = (pyramid.on_level(values, level) for values in (parameters.warps, parameters.sweeps))
    for first in range(0, 2, board.ways):
        old, new = flows, median
        device.run("flow", "flow_board", rows, features, grid, board.pitch, first, board.planes)
        for _ in range(warps):
            device.run("flow", "flow_warp", rows, features, old, grid, board.pitch, first, board.planes)
            device.run(
                "flow", "flow_tensor", halves, grid, board.pitch,
                parameters.brightness, parameters.gradient, parameters.noise, board.planes,
                options=board.options, group=_ROW_GROUP,
            )  # fmt: skip
            device.run(
                "flow", "flow_system", halves, grid, board.pitch, parameters.smoothness, parameters.contrast,
                board.planes, options=board.options, group=_ROW_GROUP,
            )  # fmt: skip
            for way, pull in enumerate(pulls[first : first + board.ways]):
                if pull:
                    pull(level, board, way)
            board.relax(device, sweeps, parameters.relaxation)
            search.filtered(device, board.solution(device, old, first), grid, new, first, board.ways)
            old, new = new, old
    return median if warps % 2 else flows


def levels(grid: Border, parameters: FlowParameters) -> int:
    """How many levels the flow of images on a grid has. None that wraps is of odd width: pixels of one colour
    would meet there.
    """
    width, shorter, count = grid.width, min(grid.size), 1
    while shorter >= 2 * parameters.coarsest and not (grid.wraps and width % 4):
        width, shorter, count = width // 2, shorter // 2, count + 1
    return count


def search_room(reach: float, grid: Border, parameters: FlowParameters) -> int:
    """Bytes that the search of `solve` takes at most: of images on a grid, for motion of up to `reach` px."""
    count, how = levels(grid, parameters), parameters.search
    return search.most_room(reach, count, grid, how, finest=parameters.decide_on)


def finest_features(device: Device, images: Sequence[Level], parameters: FlowParameters) -> Buffer:
    """What the solver sees of images on its finest level: float32 (images, height, width, 4), see flow.cl."""
    return _features(device, [(image, pyramid.reduce(device, image)) for image in images], parameters)


def adopt(
    device: Device, images: Sequence[Level], trusted: Sequence[Buffer], parameters: FlowParameters
) -> list[Buffer]:
    """`trusted`, of both ways, where each pixel that is not has taken over the flow of one around that is, if
    it fits what the images show (search.py).

    images: log brightness with masks. trusted: float32 (height, width, 4), flow to the other image in px,
    trust 0..1, and something that stays.
    """
    how, grid = parameters.search, images[0].grid
    features = (finest_features(device, [image], parameters) for image in images)
    a, b = (search.descriptor(device, one, grid, how) for one in features)
    return [
        search.adopt(device, here, there, its, grid, how)
        for here, there, its in ((a, b, trusted[0]), (b, a, trusted[1]))
    ]


def _choose(
    device: Device,
    features: Buffer,
    stacked: Buffer,
    grid: Border,
    level: int,
    reach: int,
    parameters: FlowParameters,
) -> Buffer:
    """The flows with which a level starts: each pixel's own, found by search, or from beside it.

    reach: px of the level up to which motion is searched; 0: not at all.
    """
    how = parameters.search
    descriptors = a, b = [search.descriptor(device, one, grid, how) for one in _unstacked(device, features)]
    flows = others = _unstacked(device, stacked)
    if reach:
        others = search.exhaustive(device, a, b, flows, grid, reach, how)
    return _stacked(
        device,
        [
            search.choose(device, descriptors[i], descriptors[1 - i], flow, others[i], grid, level, how)
            for i, flow in enumerate(flows)
        ],
    )


def _decide(
    device: Device,
    features: Buffer,
    flows: list[Buffer],
    grid: Border,
    level: int,
    bearings: Bearings | None,
    parameters: FlowParameters,
) -> tuple[list[Buffer], tuple[Refused, ...]]:
    """Of flows without and with what was searched, those that are left after a level, in the end one; and
    what was refused.
    """
    plain, found = (Candidate(one.get(), misfit(device, features, one, grid, parameters)) for one in flows)
    how, last_level, wraps = parameters.search, parameters.decide_on, bool(grid.wraps)

    def textured() -> decision.Mask:
        slopes: npt.NDArray[np.float32] = features.get()[..., 1:3]
        clear: decision.Mask = (slopes**2).sum(-1) > how.textured**2
        return clear

    decided = decision.decide(plain, found, level, last_level, textured, bearings, wraps, how)
    if not decided.found:
        return flows[:1], decided.refused
    if level > last_level:
        return flows, ()
    worse = decision.worse(plain, found, wraps)
    if not worse.any():
        return flows[1:], ()
    return [device.upload(np.where(worse[..., None], plain.flows, found.flows))], ()


def misfit(
    device: Device, features: Buffer, flows: Buffer, grid: Border, parameters: FlowParameters
) -> npt.NDArray[np.float32]:
    """What flows both ways, (2, height, width, 2) px, leave unexplained, (2, height, width), where both
    images show something; else -1. features: of both.
    """
    result = device.empty((2, grid.height, grid.width))
    device.run("flow", "flow_misfit", (*grid.size, 2), features, flows, grid, parameters.misfit, result)
    return result.get()


def _unstacked(device: Device, stacked: Buffer) -> list[Buffer]:
    """Copies of the arrays that are stacked in a buffer."""
    shape = stacked.shape[1:]
    parts, count = [device.empty(shape) for _ in range(stacked.shape[0])], math.prod(shape[:-1])
    for index, part in enumerate(parts):
        part.copy(0, stacked, index * count, count)
    return parts


def _stacked(device: Device, parts: Sequence[Buffer]) -> Buffer:
    """The opposite of `_unstacked`."""
    shape = parts[0].shape
    stacked, count = device.empty((len(parts), *shape)), math.prod(shape[:-1])
    for index, part in enumerate(parts):
        stacked.copy(index * count, part, 0, count)
    return stacked


def pair_flow(
    device: Device, a: Level, b: Level, parameters: FlowParameters | None = None, start: Start | None = None
) -> tuple[Buffer, Buffer]:
    """What `solve` finds: flow from a to b and from b to a."""
    solution = solve(device, a, b, parameters, start)
    return solution.forward, solution.backward


def solve(
    device: Device,
    a: Level,
    b: Level,
    parameters: FlowParameters | None = None,
    start: Start | None = None,
    reach: float | None = None,
    bearings: Bearings | None = None,
) -> Solution:
    """Flow from a to b and from b to a, in px of the grid.

    a, b: log brightness with masks, 0 outside them. start: nothing else is searched. reach: the largest
    motion that is searched, px, 0: none; if it is None, `parameters.reach` of the longer side. It is less
    where the masks overlap little: in a small corner of a floor of tiles every tile fits. bearings: what
    direction a place on the grid is seen in, if that is known. Raises `DeviceError` if the device fails.

    decision.py tells what of motion beyond warping's reach is kept.
    """
    parameters = parameters or FlowParameters()
    count = start.level + 1 if start else levels(a.grid, parameters)
    searched = {} if start else _searched(a, b, count, reach, parameters)
    pyramids = [pyramid.build(device, image, count + 1) for image in (a, b)]
    pulls = start.pulls if start else (None, None)
    refused: list[Refused] = []
    flows: list[Buffer] = []  # without what a search found, and with it, as long as both may be taken
    for level in reversed(range(count)):
        features = _features(device, [(p[level], p[level + 1]) for p in pyramids], parameters)
        grid = pyramids[0][level].grid
        if flows:
            flows = [_expand(device, one, grid) for one in flows]
        elif start:
            flows = [_stacked(device, start.flows)]
        else:
            flows = [device.zeros((2, grid.height, grid.width, 2))]
        flows = _with_found(device, features, flows, grid, level, searched, parameters)
        flows = [_refine(device, features, one, grid, level, parameters, pulls) for one in flows]
        if len(flows) > 1:
            flows, dropped = _decide(device, features, flows, grid, level, bearings, parameters)
            refused += dropped
    forward, backward = _unstacked(device, flows[0])
    return Solution(forward, backward, tuple(refused))


def _searched(
    a: Level, b: Level, count: int, reach: float | None, parameters: FlowParameters
) -> dict[int, int]:
    """On which of `count` levels how many of their px are tried (`search.reaches`); reach: of `solve`."""
    reach = parameters.reach * max(a.grid.size) if reach is None else reach
    if reach <= 0:
        return {}
    common = np.count_nonzero(a.mask.get() * b.mask.get())
    reach = min(reach, parameters.overlap * math.sqrt(common))
    return search.reaches(reach, count, a.grid, parameters.search, finest=parameters.decide_on)


def _with_found(
    device: Device,
    features: Buffer,
    flows: list[Buffer],
    grid: Border,
    level: int,
    searched: Mapping[int, int],
    parameters: FlowParameters,
) -> list[Buffer]:
    """The flows with which a level starts: beside that without a search, or in its place if what is found is
    always kept, that with what is found on this level or was on coarser ones.
    """
    always = parameters.search.always and level <= max(searched, default=-1)
    followed = (always or len(flows) > 1) and level >= parameters.choose_from
    if level not in searched and not followed:
        return flows
    chosen = _choose(device, features, flows[-1], grid, level, searched.get(level, 0), parameters)
    return [chosen] if always else [flows[0], chosen]


def refine(
    device: Device, a: Level, b: Level, forward: Buffer, backward: Buffer, parameters: FlowParameters
) -> tuple[Buffer, Buffer]:
    """Flow from a to b and back, of which `forward` and `backward` are known on a grid of half the
    resolution, px of that. Each pixel may take over a flow from beside it.
    """
    how = parameters.search
    how = replace(how, steps=(how.refined_steps,), patience=how.refined_patience)
    features = finest_features(device, (a, b), parameters)
    start = _expand(device, _stacked(device, (forward, backward)), a.grid)
    chosen = _choose(device, features, start, a.grid, 0, 0, replace(parameters, search=how))
    flows = _unstacked(device, _refine(device, features, chosen, a.grid, 0, parameters, (None, None)))
    return flows[0], flows[1]


def _expand(device: Device, flows: Buffer, grid: Border) -> Buffer:
    """Flows of both ways on the next finer level's grid."""
    ways, height, width, _ = flows.shape
    fine = device.empty((ways, grid.height, grid.width, 2))
    size = (*grid.size, ways)
    device.run("flow", "flow_expand", size, flows, Border(width, height, grid.wraps), fine, grid.size)
    return fine

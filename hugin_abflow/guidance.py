"""Flow that guides lead where it cannot find its way alone (kernels/guidance.cl).

The flow is found without them first; guides that agree with it hold it (relay.py). Around the others the flow
starts once more, on a coarse level, from where they send it, held there by a spring that slackens from level
to level and is gone on the finest. Then each pixel keeps the flow that explains the images better: guides
decide only where the images do not.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hugin_abflow import flow
from hugin_abflow.cells import Flows, pixels_at
from hugin_abflow.chart import Chart
from hugin_abflow.flow import Board, FlowParameters, Start
from hugin_abflow.grid import Border, Grid
from hugin_abflow.guides import Guide, Points, distances, doubts
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.pyramid import Level

_log = logging.getLogger(__name__)

Values = npt.NDArray[np.float64]

# Guides are on one thing if their moves differ by less than this share of what the flow lacks.
_ALIKE = 0.3


@dataclass(frozen=True)
class GuidanceParameters:
    """How guides lead."""

    agreement: float = 3.0  # chart px: a guide so near to the flow changes nothing
    radius: float = 0.08  # of the canvas's width: how far away neighbours confirm a guide
    pulls: tuple[float, ...] = (0.0, 2.0, 8.0)  # strength of the spring per level, finest first
    # Sigma, chart px, within which a guide leads: its distance from the flow, because smaller things are
    # found without it, or this share of the distance to a guide that moves alike, if that is more
    least_sigma: float = 32.0
    most_sigma: float = 128.0
    spacing: float = 0.6
    evidence: float = 20.0  # weight of a difference in cost beside a link of neighbours
    trust: float = 20.0  # weight of a guide's own place beside a link of neighbours
    contrast: float = 0.05  # step of h across which a link falls to 1/e
    sweeps: int = 200  # of the vote
    relaxation: float = 1.9  # of its sweeps, 1 to 2
    # The images confirm a guide if, in a window around it, the new flow costs less than `gain` of the old one
    # and `misfit` of the contrast there, or less than `fit` of the contrast, or if that is less than `blank`
    window: float = 6.0  # px: sigma
    gain: float = 0.75
    misfit: float = 1.25
    fit: float = 0.5
    blank: float = 0.06
    seen: float = 0.25  # the share of the window that both images must show to confirm anything


@dataclass(frozen=True)
class ChartGuides:
    """The guides of one pair: at_a, at_b float64 (n, 2), their ends on its chart, px. period: px after which
    places there repeat, on the chart or beside it; 0: never.
    """

    at_a: Points
    at_b: Points
    names: tuple[str, ...]
    period: float = 0.0

    def __len__(self) -> int:
        return len(self.names)

    def only(self, chosen: npt.NDArray[np.bool_]) -> ChartGuides:
        """The chosen ones, a mask (n,)."""
        names = tuple(name for name, used in zip(self.names, chosen, strict=True) if used)
        return ChartGuides(self.at_a[chosen], self.at_b[chosen], names, self.period)


def on_chart(guides: Sequence[Guide], chart: Chart, grid: Grid) -> ChartGuides:
    """The guides of one pair of layers, all from a to b, on its chart.

    grid    the working grid.
    """
    places = np.array([(guide.at_a, guide.at_b) for guide in guides], np.float64).reshape(-1, 2, 2)
    at_a, at_b = (chart.positions(grid.points(places[:, end])) for end in (0, 1))
    return ChartGuides(at_a, at_b, tuple(guide.name for guide in guides), chart.period)


def lead(
    device: Device,
    images: tuple[Level, Level],
    flows: tuple[Buffer, Buffer],
    guides: ChartGuides,
    circumference: float,
    parameters: GuidanceParameters | None = None,
) -> tuple[Buffer, Buffer]:
    """The flows of a pair, made better in place where guides contradict them.

    images          a and b as `flow.pair_flow` takes them; flows: what it found.
    circumference   of the canvas in px of the chart.
    """
    parameters, count = parameters or GuidanceParameters(), len(guides)
    directed = _directed(images[0].grid, (flows[0].get(), flows[1].get()), guides)
    leading = _leading(guides, directed, parameters.radius * circumference, parameters)
    if not leading.any():
        return flows
    guides, directed = guides.only(leading), (directed[0].only(leading), directed[1].only(leading))
    rivals = _rivals(device, images, flows, directed, parameters)
    kept = _confirmed(guides, rivals, directed, parameters)
    if not kept.any():
        return flows
    _log.info("%d of %d control points of a pair lead its flow", np.count_nonzero(kept), count)
    nearness = [
        _Springs(device, images[0], rival.old, its.only(kept), parameters).at(0)[1]
        for rival, its in zip(rivals, directed, strict=True)
    ]
    for rival, near in zip(rivals, nearness, strict=True):
        _choose(device, rival, near, parameters)
    refined = flow.pair_flow(device, *images, FlowParameters(), Start(0, (rivals[0].old, rivals[1].old)))
    for one, near, result in zip(refined, nearness, flows, strict=True):
        grid = images[0].grid
        device.run("guidance", "guidance_blend", grid.size, one, near, grid, result)
    return flows


def _leading(
    guides: ChartGuides,
    directed: Sequence[_DirectedGuides],
    radius: float,
    parameters: GuidanceParameters,
) -> npt.NDArray[np.bool_]:
    """Which guides contradict the flow, and are not to be doubted. radius: as of `guides.doubts`."""
    wrong = _wrong(directed, parameters.agreement)
    if not wrong.any():
        return wrong
    reasons = doubts(guides.at_a, directed[0].moves, radius, guides.period or math.inf)
    for name, reason, counts in zip(guides.names, reasons, wrong, strict=True):
        if reason and counts:
            _log.info("%s is ignored: %s", name, reason)
    return np.asarray(wrong & [not reason for reason in reasons])


def _rivals(
    device: Device,
    images: tuple[Level, Level],
    flows: tuple[Buffer, Buffer],
    directed: tuple[_DirectedGuides, _DirectedGuides],
    parameters: GuidanceParameters,
) -> list[_Rivals]:
    """In both directions, copies of the flow as it is, and the flow that starts where guides send it."""
    solver = FlowParameters()
    level = min(len(parameters.pulls), flow.levels(images[0].grid, solver)) - 1
    old = [device.copy(one) for one in flows]  # what wins is put into them
    springs = [_Springs(device, images[0], *pair, parameters) for pair in zip(old, directed, strict=True)]
    start = Start(
        level, (springs[0].start(level), springs[1].start(level)), (springs[0].pull, springs[1].pull)
    )
    new = flow.pair_flow(device, *images, solver, start)
    features = [flow.finest_features(device, [image], solver) for image in images]
    return [_Rivals.of(device, features[i], features[1 - i], images[i].grid, old[i], new[i]) for i in (0, 1)]


def _confirmed(
    guides: ChartGuides,
    rivals: Sequence[_Rivals],
    directed: Sequence[_DirectedGuides],
    parameters: GuidanceParameters,
) -> npt.NDArray[np.bool_]:
    """Which guides the images confirm."""
    reasons = _refusals(rivals, directed, parameters)
    for name, reason in zip(guides.names, reasons, strict=True):
        if reason:
            _log.info("%s is ignored: %s", name, reason)
    return np.array([not reason for reason in reasons])


def contradict(
    chart: Chart,
    flows: Flows,
    guides: ChartGuides,
    times: int,
) -> bool:
    """Whether guides of a pair say something else than its flows, a to b and back, as `lead` sees it.

    chart       of both, `times` as fine as that on which guides lead.
    """
    agreement = times * GuidanceParameters().agreement
    return bool(_wrong(_directed(chart.border, flows, guides), agreement).any())


def held(
    images: tuple[Level, Level],
    flows: tuple[Buffer, Buffer],
    guides: ChartGuides,
) -> tuple[Values, Values]:
    """The guides that both images show and both flows agree with: their places and moves, (n, 4) px, from a
    to b and back.
    """
    directed = _directed(images[0].grid, (flows[0].get(), flows[1].get()), guides)
    agree = np.ones(len(guides), bool)
    for image, its in zip(images, directed, strict=True):
        inside, (row, column) = pixels_at(its.places, image.grid)
        agree &= inside & (image.mask.get()[row * inside, column * inside] > 0)
        agree &= np.linalg.norm(its.residuals, axis=1) <= GuidanceParameters().agreement
    there, back = (np.hstack([its.places, its.moves])[agree] for its in directed)
    return there, back


@dataclass(frozen=True)
class _DirectedGuides:
    """The guides in one direction, (n, 2) px.

    places      on the image on which the flow starts.
    moves       from there to the place on the other image.
    residuals   moves less the flow there; 0 where the place is not on the chart.
    """

    places: Points
    moves: Points
    residuals: Points

    def only(self, chosen: npt.NDArray[np.bool_]) -> _DirectedGuides:
        return _DirectedGuides(self.places[chosen], self.moves[chosen], self.residuals[chosen])


def _wrong(directed: Sequence[_DirectedGuides], agreement: float) -> npt.NDArray[np.bool_]:
    """Which guides lie farther than that from the flow in one direction."""
    far = [np.linalg.norm(its.residuals, axis=1) > agreement for its in directed]
    return np.asarray(np.any(far, axis=0))


def _directed(grid: Border, flows: Flows, guides: ChartGuides) -> tuple[_DirectedGuides, _DirectedGuides]:
    moves = guides.at_b - guides.at_a
    if guides.period:  # the shorter way round
        moves[:, 0] -= guides.period * np.rint(moves[:, 0] / guides.period)
    directed = []
    for field, places, its in zip(flows, (guides.at_a, guides.at_b), (moves, -moves), strict=True):
        inside, (row, column) = pixels_at(places, grid)
        found = field[row * inside, column * inside]
        directed.append(_DirectedGuides(places, its, np.where(inside[:, None], its - found, 0.0)))
    return directed[0], directed[1]


class _Springs:
    """Start and springs of one direction, on any level."""

    def __init__(
        self,
        device: Device,
        image: Level,
        found: Buffer,
        guides: _DirectedGuides,
        parameters: GuidanceParameters,
    ) -> None:
        self._device, self._image, self._found, self._parameters = device, image, found, parameters
        guides = guides.only(np.any(guides.residuals, axis=1))  # the others are not on the chart
        table = np.concatenate([guides.places, guides.residuals], 1)
        self._guides = device.upload(table, np.float32)
        sigmas = _sigmas(guides, _period(image.grid), parameters)
        self._sigmas = device.upload(sigmas, np.float32)

    def at(self, level: int) -> tuple[Buffer, Buffer]:
        """Start (height, width, 2) and nearness (height, width) on a level."""
        width, height = self._image.grid.size
        for _ in range(level):
            width, height = (width + 1) // 2, (height + 1) // 2
        start, near = self._device.empty((height, width, 2)), self._device.empty((height, width))
        self._device.run(
            "guidance", "guidance_start", (width, height), self._found, self._image.grid, self._guides,
            self._sigmas, self._sigmas.shape[0], float(1 << level), start, near, (width, height),
        )  # fmt: skip
        return start, near

    def start(self, level: int) -> Buffer:
        return self.at(level)[0]

    def pull(self, level: int, board: Board, way: int) -> None:
        strength = self._parameters.pulls[level]
        if not strength:
            return
        start, near = self.at(level)
        self._device.run(
            "guidance", "guidance_pull", board.grid.size, start, near, board.grid, board.pitch, strength, way,
            board.planes,
        )  # fmt: skip


def _sigmas(guides: _DirectedGuides, period: float, parameters: GuidanceParameters) -> Values:
    """How far each guide leads, px; `period`: as of `guides.doubts`."""
    lengths = np.linalg.norm(guides.residuals, axis=1)
    sigmas = lengths.copy()
    for i in range(len(lengths)):
        alike = np.linalg.norm(guides.moves - guides.moves[i], axis=1) < _ALIKE * lengths[i]
        alike[i] = False
        spaced = parameters.spacing * distances(guides.places, i, period)[alike].min(initial=np.inf)
        if spaced <= parameters.most_sigma:  # one that is farther away is on something else
            sigmas[i] = max(sigmas[i], spaced)
    clipped: Values = np.clip(sigmas, parameters.least_sigma, parameters.most_sigma)
    return clipped


def _period(grid: Border) -> float:
    """Px after which columns repeat; infinity: they do not."""
    width, _, wraps, _ = grid
    return width if wraps else math.inf


@dataclass(frozen=True)
class _Rivals:
    """Two flows of one direction, and what of the other image each brings to the pixels of this one.

    feature, brought    float32 (1, height, width, 4), see kernels/flow.cl.
    """

    grid: Border
    feature: Buffer
    old: Buffer
    new: Buffer
    brought: tuple[Buffer, Buffer]

    @classmethod
    def of(
        cls, device: Device, feature: Buffer, other: Buffer, grid: Border,
        old: Buffer, new: Buffer,
    ) -> _Rivals:  # fmt: skip
        brought = device.empty(feature.shape), device.empty(feature.shape)
        for field, target in zip((old, new), brought, strict=True):
            device.run("guidance", "guidance_bring", grid.size, other, field, grid, target)
        return cls(grid, feature, old, new, brought)


def _refusals(
    rivals: Sequence[_Rivals], directed: Sequence[_DirectedGuides], parameters: GuidanceParameters
) -> list[str]:
    """Why guides are ignored after all, "" where they are not: what the images say around each of them."""
    radius = math.ceil(2 * parameters.window)
    steps = np.arange(-radius, radius + 1)
    weights = np.exp(-0.5 * (steps / parameters.window) ** 2)
    window = weights[:, None] * weights
    count = len(directed[0].places)
    costs, contrast, moved, shown = np.zeros((count, 2)), np.zeros(count), np.zeros(count), np.zeros(count)
    for rival, its in zip(rivals, directed, strict=True):
        feature, *brought = (buffer.get()[0] for buffer in (rival.feature, *rival.brought))
        shift = np.linalg.norm(rival.new.get() - rival.old.get(), axis=-1)
        width, height, wraps, _ = rival.grid
        for i in np.flatnonzero(its.residuals.any(1)):
            column, row = np.floor(its.places[i]).astype(int)
            columns, rows = column + steps, row + steps
            inside = (rows[:, None] >= 0) & (rows[:, None] < height)
            inside = inside & (bool(wraps) | ((columns >= 0) & (columns < width)))
            at = np.ix_(np.clip(rows, 0, height - 1), columns % width)
            seen = inside & (feature[at][..., 3] * brought[0][at][..., 3] * brought[1][at][..., 3] > 0)
            share = window * seen
            shown[i] = max(shown[i], share.sum() / window.sum())
            contrast[i] += (share * _cost(feature[at], 0 * feature[at])).sum() / max(share.sum(), 1.0)
            for k in (0, 1):
                costs[i, k] += (share * _cost(feature[at], brought[k][at])).sum() / max(share.sum(), 1.0)
            moved[i] = max(moved[i], shift[row, column % width])
    old, new = costs.T
    better = (new < parameters.gain * old) & (new < parameters.misfit * contrast)
    fits = new < parameters.fit * contrast
    plain = contrast < parameters.blank
    reasons = np.where(better | fits | plain, "", "the images do not confirm it")
    reasons = np.where(moved < parameters.agreement, "the images lead back", reasons)
    # a place that one photo does not show has no contrast, but is not plain
    reasons = np.where(shown < parameters.seen, "one of the photos does not show the place", reasons)
    return [str(reason) for reason in reasons]


def _cost(a: npt.NDArray[np.float32], b: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """How badly features fit: `guidance_cost` of the kernel, which never stores what it finds."""
    off = np.abs(a - b)
    cost: npt.NDArray[np.float32] = np.minimum(off[..., 0] + 2 * (off[..., 1] + off[..., 2]), 0.5)
    return cost


def _choose(device: Device, rivals: _Rivals, near: Buffer, parameters: GuidanceParameters) -> None:
    """Put the new flow into the old one where it explains the images better."""
    grid, size = rivals.grid, rivals.grid.size
    board = Board.of(device, 1, grid)
    device.run(
        "guidance", "guidance_vote", size, rivals.feature, *rivals.brought, near, grid, board.pitch,
        parameters.evidence, parameters.trust, parameters.contrast, board.planes,
    )  # fmt: skip
    board.relax(device, parameters.sweeps, parameters.relaxation)
    vote = board.solution(device, device.empty(rivals.old.shape))
    device.run("guidance", "guidance_choose", size, vote, rivals.new, grid, rivals.old)

"""Flow of every pair of layers: the steps in their order.

All that tells of what a pair shows (search, guides, movers, foreground) is found on its chart. Where that is
coarse and there is time for it, its flow is then refined on one of twice the resolution, on which rails and
bars are as wide as on the working canvas.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from hugin_abflow import chart, consistency, figures, flow, guidance, quality, relay, single
from hugin_abflow.abreast import side_by_side
from hugin_abflow.cells import View, Whole
from hugin_abflow.chart import Chart
from hugin_abflow.consistency import Weighed
from hugin_abflow.geometry import Pair, PairFlow
from hugin_abflow.guides import Guide
from hugin_abflow.opencl import Device
from hugin_abflow.progress import Advance, Progress
from hugin_abflow.pyramid import Level
from hugin_abflow.settings import Settings
from hugin_abflow.working import Grid, WorkingLayer

_log = logging.getLogger(__name__)

# Motion that is looked for, as a share of the canvas's width.
_REACH = 0.1
# The share of an overlap that others have to know if its flow is not found.
_ENOUGH = 0.7
# Pairs whose flow is found at a time, at most: small grids and steps on the host leave cores idle, and memory
# is needed for each.
ABREAST = 2


def charts(
    overlaps: Sequence[npt.NDArray[np.bool_]], masks: Grid, grid: Grid, settings: Settings
) -> list[Chart]:
    """The charts on which flow of all pairs is found.

    overlaps    where they overlap, on the grid `masks`; grid: the working grid.
    """
    coarse = quality.coarseness(settings.flow_quality, grid.width * grid.height)
    draw = partial(chart.pair_chart, mask_grid=masks, grid=grid, coarse=coarse)
    with ThreadPoolExecutor(settings.cores, "chart") as drawing:
        return list(drawing.map(lambda index: draw(overlaps[index]), range(len(overlaps))))


def finest(drawn: Sequence[Chart], grid: Grid, settings: Settings) -> Sequence[Chart]:
    """The charts on which the flow of a merge ends up: `drawn`, or, if all of it is refined, those of twice
    the resolution.
    """
    fine = [one.finer() for one in drawn if one.coarse > 1]
    pixels = sum(one.width * one.height for one in fine)
    return fine if quality.refined(settings.flow_quality, grid.width * grid.height, pixels) else drawn


def solve(
    device: Device,
    layers: Sequence[WorkingLayer],
    pairs: Sequence[Pair],
    drawn: Sequence[Chart],
    grid: Grid,
    progress: Progress,
    settings: Settings,
    guides: Mapping[tuple[int, int], Sequence[Guide]],
    numbers: Sequence[int],
    abreast: int,
    relayed: Callable[[], Sequence[bool]],
) -> tuple[list[PairFlow], list[figures.Parallax], list[Whole | None]]:
    """Flow of every pair of layers, mended; figures of it, if somebody listens; and what is taken from one of
    them, whole, by cells of the flow's chart.

    drawn       the charts of `pairs`, on which flow is found.
    guides      of each two layers, by their numbers; numbers: what guides call each of `layers`.
    abreast     how many pairs are worked on at a time; no flow depends on it.
    relayed     gives of which pairs other layers should know the flow, so that it need not be found.
    """
    compared = bool(settings.relay and relay.triangles(pairs))
    solver = _Solver(device, layers, grid, settings, guides, numbers, compared, abreast)
    jobs = dict(enumerate(zip(pairs, drawn, finest(drawn, grid, settings), strict=True)))
    left = relayed() if compared else [False] * len(pairs)
    others = {i: job for i, job in jobs.items() if left[i]}
    with progress("flow", len(pairs)) as advance:
        solved = solver.solve_all({i: job for i, job in jobs.items() if i not in others}, advance)
        if compared:
            _relay(solver, solved, others, advance)
        found = [solved.pop(i) for i in jobs]
        heard = _log.isEnabledFor(logging.INFO)
        shifts = [figures.parallax(one.weighed, grid) for one in found] if heard else []
        singles = [one.single for one in found]
        mending = (partial(consistency.mend, device, found.pop(0).weighed) for _ in range(len(found)))
        result = list(side_by_side(device, mending, abreast))
        device.give_back()  # it waits: else the time of one pair at a time would be told as what follows
    return result, shifts, singles


def _relay(solver: _Solver, solved: dict[int, _Solved], others: Mapping[int, _Job], advance: Advance) -> None:
    """Have flow that other layers contradict, or know better, go by way of them; and that of `others`, pairs
    of which they should know enough. These are added to `solved`; those of which they do not are solved.
    """
    device = solver.device
    compared = relay.compare(device, _weighed(solved))
    changed = _mend(device, solved, compared)
    told = {i: solver.leave(*job) for i, job in others.items()}
    if told:
        if changed:
            compared = relay.compare(device, _weighed(solved))
        relay.tell(device, compared, _weighed(told))
    told = {i: one for i, one in told.items() if solver.suffices(one.weighed, others[i][1])}
    missed = {i: job for i, job in others.items() if i not in told}
    if missed:
        solved |= solver.solve_all(missed, advance)
        changed |= _mend(device, solved, relay.compare(device, _weighed(solved)))
    solved |= told
    advance(len(told))
    alone = {(one.weighed.a, one.weighed.b) for one in told.values()}
    for a, b in sorted(changed | alone):
        _log.info(
            "flow of %s and %s: by way of other layers, which %s",
            solver.layers[a].layer.name, solver.layers[b].layer.name,
            "show what they share" if (a, b) in alone else "contradict it or know more",
        )  # fmt: skip


@dataclass(frozen=True)
class _Solved:
    """A pair's flow as it was found.

    single  what is taken from one of both, whole.
    held    what guides hold, both ways, on the chart of the flow; none: nothing.
    """

    weighed: Weighed
    single: Whole | None = None
    held: tuple[guidance.Values, ...] = ()


def _weighed(solved: Mapping[int, _Solved]) -> list[Weighed]:
    return [one.weighed for one in solved.values()]


def _mend(device: Device, solved: Mapping[int, _Solved], compared: relay.Compared) -> set[relay.Key]:
    """Have flow that others contradict, or know better, go by way of them; of which pairs that is."""
    held: dict[relay.Key, guidance.Values] = {}
    for pair, its in ((one.weighed, one.held) for one in solved.values() if one.held):
        held[pair.a, pair.b], held[pair.b, pair.a] = its
    return set(relay.mend(device, _weighed(solved), compared, held))


# A pair, the chart on which its flow is found, and that on which it ends up.
_Job = tuple[Pair, Chart, Chart]


@dataclass(frozen=True)
class _Solver:
    """Finds the flow of pairs; the fields are arguments of `solve`. compared: whether other pairs' flow is
    asked afterwards.
    """

    device: Device
    layers: Sequence[WorkingLayer]
    grid: Grid
    settings: Settings
    guides: Mapping[tuple[int, int], Sequence[Guide]]
    numbers: Sequence[int]
    compared: bool
    abreast: int

    def solve_all(self, jobs: Mapping[int, _Job], advance: Advance) -> dict[int, _Solved]:
        """The flows of pairs, so many at a time."""
        result = dict[int, _Solved]()
        work = (partial(self.solve, *job) for job in jobs.values())
        with closing(side_by_side(self.device, work, self.abreast)) as solved:
            for index, one in zip(jobs, solved, strict=True):
                result[index] = one
                advance(1)
        return result

    def solve(self, pair: Pair, its_chart: Chart, its_finest: Chart) -> _Solved:
        """The flow of a pair, found on one chart and refined on another."""
        device, grid, settings = self.device, self.grid, self.settings
        parameters = quality.flow_parameters(settings.flow_quality, settings.large_motion)
        images = self._images(pair, its_chart)
        bearings = its_chart.projection.bearings if its_chart.projection else None
        solved = flow.solve(device, *images, parameters, reach=self._reach(its_chart), bearings=bearings)
        found = (solved.forward, solved.backward)
        placed, held = self._guides(pair, its_chart), tuple[guidance.Values, ...]()
        if placed:
            found = guidance.lead(device, images, found, placed, its_chart.circumference(grid))
        if placed and self.compared:
            scale = its_finest.width / its_chart.width
            held = tuple(scale * way for way in guidance.held(images, found, placed))
        one = None
        if settings.seam and (settings.foreground or (settings.movers and its_chart.projection)):
            views = (View.of(images[0]), View.of(images[1]))
            arrays, points = (found[0].get(), found[1].get()), (placed.at_a, placed.at_b)
            one = single.find(its_chart, arrays, views, points, solved.refused, settings)
        its_flow = PairFlow(pair.a, pair.b, its_chart, *found)
        if its_finest is not its_chart:
            images = self._images(pair, its_finest)
            found = flow.refine(device, *images, *found, parameters)
            its_flow = PairFlow(pair.a, pair.b, its_finest, *found)
            one = one and one.finer()
        return _Solved(consistency.weigh(device, its_flow, images, one), one, held)

    def leave(self, pair: Pair, _: Chart, its_finest: Chart) -> _Solved:
        """A pair whose flow is not found: others are to tell it."""
        images = self._images(pair, its_finest)
        return _Solved(consistency.unknown(self.device, pair, its_finest, images))

    def suffices(self, found: Weighed, its_chart: Chart) -> bool:
        """Whether what others told of a pair is enough, and no guide says something else."""
        if consistency.known(found) < _ENOUGH:
            return False
        placed = self._guides(found, found.chart)
        if not placed:
            return True
        flows = found.forward.get()[..., :2], found.backward.get()[..., :2]
        times = its_chart.coarse // found.chart.coarse
        return not guidance.contradict(found.chart, flows, placed, times)

    def _guides(self, pair: Pair, its_chart: Chart) -> guidance.ChartGuides:
        first, second = self.numbers[pair.a], self.numbers[pair.b]
        its_guides = self.guides.get((min(first, second), max(first, second)), ())
        return guidance.on_chart(its_guides, first, its_chart, self.grid)

    def _reach(self, its_chart: Chart) -> float:
        """Px of a chart up to which motion is searched."""
        if self.settings.large_motion == "off":
            return 0.0
        grid = self.grid
        width = (grid.canvas_width or grid.region.width) * grid.width / grid.region.width
        return _REACH * width / its_chart.coarse

    def _images(self, pair: Pair, its_chart: Chart) -> tuple[Level, Level]:
        """What both layers of a pair show on a chart."""
        a, b = (
            chart.sample(self.device, self.layers[index], self.grid, its_chart) for index in (pair.a, pair.b)
        )
        return a, b

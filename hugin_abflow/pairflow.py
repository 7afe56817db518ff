"""Flow of every pair of layers: the steps in their order.

Search, guides, movers and foreground work on a pair's chart. Where that is coarse and there is time for it,
flow is then refined on a chart of twice the resolution, on which rails and bars are as wide as on the working
canvas.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from hugin_abflow import chart, consistency, figures, flow, guidance, quality, relay, repeats, single
from hugin_abflow.abreast import side_by_side
from hugin_abflow.cells import SingleSource, View
from hugin_abflow.chart import Chart
from hugin_abflow.consistency import WeightedFlow
from hugin_abflow.decision import Refused
from hugin_abflow.geometry import Pair, PairFlow
from hugin_abflow.grid import Grid
from hugin_abflow.guides import Guide
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.progress import Advance, Progress
from hugin_abflow.pyramid import Level
from hugin_abflow.settings import Settings
from hugin_abflow.working import WorkingLayer

_log = logging.getLogger(__name__)

# Motion that is looked for, as a share of the canvas's width.
_REACH = 0.1
# The share of an overlap whose flow others have to know, for it not to be found.
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


def reach(drawn: Chart, grid: Grid, settings: Settings) -> float:
    """Px of a chart up to which motion is searched."""
    if settings.large_motion == "off":
        return 0.0
    width = (grid.canvas_width or grid.region.width) * grid.width / grid.region.width
    return _REACH * width / drawn.coarse


def search_room(drawn: Chart, grid: Grid, settings: Settings) -> int:
    """Bytes that the search for large motion takes, at most, of a pair that is `drawn` so."""
    parameters = quality.flow_parameters(settings.flow_quality, settings.large_motion)
    return flow.search_room(reach(drawn, grid, settings), drawn.border, parameters)


class Solution(NamedTuple):
    """What is found of all pairs, in their order.

    flows       filled.
    parallaxes  for messages and reports; empty if nobody listens.
    singles     what is taken from a single layer of each, by cells of the flow's chart.
    """

    flows: list[PairFlow]
    parallaxes: list[figures.Parallax]
    singles: list[SingleSource | None]


def solve(
    device: Device,
    layers: Sequence[WorkingLayer],
    pairs: Sequence[Pair],
    drawn: Sequence[Chart],
    grid: Grid,
    progress: Progress,
    settings: Settings,
    guides: Mapping[tuple[int, int], Sequence[Guide]],
    abreast: int,
    inferable: Callable[[], Sequence[bool]],
) -> Solution:
    """Flow of every pair of layers, and what is told by it.

    drawn       the charts of `pairs`, on which flow is found.
    guides      of each pair (a, b), as `guides.by_pair` gives them.
    abreast     how many pairs are worked on at a time; no flow depends on it.
    inferable   gives of which pairs others should know the flow, so that it need not be found.
    """
    compared = bool(settings.relay and relay.triangles(pairs))
    solver = _Solver(device, layers, grid, settings, guides, compared, abreast)
    ends = finest(drawn, grid, settings)
    jobs = {i: _Job(*one) for i, one in enumerate(zip(pairs, drawn, ends, strict=True))}
    left_out = inferable() if compared else [False] * len(pairs)
    postponed = {i: job for i, job in jobs.items() if left_out[i]}
    with progress("flow", len(pairs)) as advance:
        solved = solver.solve_all({i: job for i, job in jobs.items() if i not in postponed}, advance)
        if compared:
            _relay(solver, solved, postponed, advance)
        found = [solved.pop(i) for i in jobs]
        heard = _log.isEnabledFor(logging.INFO)
        parallaxes = [figures.parallax(one.flow, grid) for one in found] if heard else []
        singles = [one.single for one in found]
        filling = (partial(consistency.fill, device, found.pop(0).flow) for _ in range(len(found)))
        flows = list(side_by_side(device, filling, abreast))
        device.give_back()  # it waits: else the time of one pair at a time would be told as what follows
    return Solution(flows, parallaxes, singles)


def _relay(
    solver: _Solver, solved: dict[int, _Solved], postponed: Mapping[int, _Job], advance: Advance
) -> None:
    """Mend flow that other pairs contradict, or know better, and infer that of the pairs that were postponed.
    These are added to `solved`; those of which others do not know enough are solved after all.
    """
    device = solver.device
    compared = relay.compare(device, _flows(solved))
    mended = _mend(device, solved, compared)
    inferred = {i: solver.unsolved(job) for i, job in postponed.items()}
    if inferred:
        if mended:
            compared = relay.compare(device, _flows(solved))
        relay.infer(device, compared, _flows(inferred))
    inferred = {i: one for i, one in inferred.items() if solver.suffices(one.flow, postponed[i])}
    missed = {i: job for i, job in postponed.items() if i not in inferred}
    if missed:
        solved |= solver.solve_all(missed, advance)
        mended |= _mend(device, solved, relay.compare(device, _flows(solved)))
    solved |= inferred
    advance(len(inferred))
    known_by_others = {(one.flow.a, one.flow.b) for one in inferred.values()}
    for a, b in sorted(mended | known_by_others):
        _log.info(
            "flow of %s and %s: by way of other layers, which %s",
            solver.layers[a].layer.called, solver.layers[b].layer.called,
            "show what they share" if (a, b) in known_by_others else "contradict it or know more",
        )  # fmt: skip


@dataclass(frozen=True)
class _Solved:
    """A pair's flow as it was found.

    single  what is taken from a single one of both, whole.
    held    what guides hold, in both directions, on the chart of the flow; none: nothing.
    """

    flow: WeightedFlow
    single: SingleSource | None = None
    held: tuple[guidance.Values, ...] = ()


def _flows(solved: Mapping[int, _Solved]) -> list[WeightedFlow]:
    return [one.flow for one in solved.values()]


def _mend(device: Device, solved: Mapping[int, _Solved], compared: relay.Compared) -> set[relay.Key]:
    """Mend flow that others contradict, or know better; of which pairs that is."""
    held: dict[relay.Key, guidance.Values] = {}
    for pair, both in ((one.flow, one.held) for one in solved.values() if one.held):
        held[pair.a, pair.b], held[pair.b, pair.a] = both
    return set(relay.mend(device, _flows(solved), compared, held))


@dataclass(frozen=True)
class _Job:
    """A pair, the chart on which its flow is found, and that on which it ends up."""

    pair: Pair
    chart: Chart
    finest: Chart


@dataclass(frozen=True)
class _Solver:
    """Finds the flow of pairs; the fields are arguments of `solve`. compared: whether flows of different
    pairs are compared afterwards.
    """

    device: Device
    layers: Sequence[WorkingLayer]
    grid: Grid
    settings: Settings
    guides: Mapping[tuple[int, int], Sequence[Guide]]
    compared: bool
    abreast: int

    def solve_all(self, jobs: Mapping[int, _Job], advance: Advance) -> dict[int, _Solved]:
        """The flows of pairs, `abreast` of them at a time."""
        result = dict[int, _Solved]()
        work = (partial(self.solve, job) for job in jobs.values())
        with closing(side_by_side(self.device, work, self.abreast)) as solved:
            for index, one in zip(jobs, solved, strict=True):
                result[index] = one
                advance(1)
        return result

    def solve(self, job: _Job) -> _Solved:
        """The flow of a pair, found on one chart and refined on another."""
        device, pair, its_chart, settings = self.device, job.pair, job.chart, self.settings
        parameters = quality.flow_parameters(settings.flow_quality, settings.large_motion)
        images, guides = self._images(pair, its_chart), self._guides(pair, its_chart)
        bearings = its_chart.projection.bearings if its_chart.projection else None
        furthest = reach(its_chart, self.grid, settings)
        solved = flow.solve(device, *images, parameters, reach=furthest, bearings=bearings)
        flows = repeats.mend(device, images, (solved.forward, solved.backward), parameters)
        flows, held = self._led(job, images, flows, guides)
        from_one = self._single(its_chart, images, flows, guides, solved.refused)
        if job.finest is not its_chart:
            images = self._images(pair, job.finest)
            flows = flow.refine(device, *images, *flows, parameters)
            from_one = from_one and from_one.finer()
        its_flow = PairFlow(pair.a, pair.b, job.finest, *flows)
        return _Solved(consistency.weigh(device, its_flow, images, parameters, from_one), from_one, held)

    def _led(
        self,
        job: _Job,
        images: tuple[Level, Level],
        flows: tuple[Buffer, Buffer],
        guides: guidance.ChartGuides,
    ) -> tuple[tuple[Buffer, Buffer], tuple[guidance.Values, ...]]:
        """A pair's flows, led by its guides, and what these hold (`_Solved.held`)."""
        if not guides:
            return flows, ()
        flows = guidance.lead(self.device, images, flows, guides, job.chart.circumference(self.grid))
        if not self.compared:
            return flows, ()
        scale = job.finest.width / job.chart.width
        return flows, tuple(scale * one for one in guidance.held(images, flows, guides))

    def _single(
        self,
        its_chart: Chart,
        images: tuple[Level, Level],
        flows: tuple[Buffer, Buffer],
        guides: guidance.ChartGuides,
        refused: Sequence[Refused],
    ) -> SingleSource | None:
        """What is taken from a single layer of a pair. refused: flow that a search found and nothing uses."""
        settings = self.settings
        if not (settings.seam and (settings.foreground or (settings.movers and its_chart.projection))):
            return None
        views, arrays = (View.of(images[0]), View.of(images[1])), (flows[0].get(), flows[1].get())
        return single.find(its_chart, arrays, views, (guides.at_a, guides.at_b), refused, settings)

    def unsolved(self, job: _Job) -> _Solved:
        """A pair whose flow is not found: it is to be inferred from others."""
        images = self._images(job.pair, job.finest)
        return _Solved(consistency.unknown(self.device, job.pair, job.finest, images))

    def suffices(self, inferred: WeightedFlow, job: _Job) -> bool:
        """Whether what others tell of a pair's flow is enough, and no guide says something else."""
        if consistency.known(inferred) < _ENOUGH:
            return False
        guides = self._guides(inferred, inferred.chart)
        if not guides:
            return True
        flows = inferred.forward.get()[..., :2], inferred.backward.get()[..., :2]
        times = job.chart.coarse // inferred.chart.coarse
        return not guidance.contradict(inferred.chart, flows, guides, times)

    def _guides(self, pair: Pair, its_chart: Chart) -> guidance.ChartGuides:
        return guidance.on_chart(self.guides.get((pair.a, pair.b), ()), its_chart, self.grid)

    def _images(self, pair: Pair, its_chart: Chart) -> tuple[Level, Level]:
        """What both layers of a pair show on a chart."""
        a, b = (
            chart.sample(self.device, self.layers[index], self.grid, its_chart) for index in (pair.a, pair.b)
        )
        return a, b

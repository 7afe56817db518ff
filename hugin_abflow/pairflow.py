"""Flow of every pair of layers: the steps in their order.

All that tells of what a pair shows (search, guides, movers, foreground) is found on its chart. Where that is
coarse and there is time for it, its flow is then refined on one of twice the resolution, on which rails and
bars are as wide as on the working canvas.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial

import numpy as np
import numpy.typing as npt

from hugin_abflow import chart, consistency, figures, flow, guidance, quality, relay, single
from hugin_abflow.cells import View, Whole
from hugin_abflow.chart import Chart
from hugin_abflow.consistency import Weighed
from hugin_abflow.geometry import Pair, PairFlow
from hugin_abflow.guides import Guide
from hugin_abflow.opencl import Device
from hugin_abflow.progress import Progress
from hugin_abflow.pyramid import Level
from hugin_abflow.settings import Settings
from hugin_abflow.working import Grid, WorkingLayer

_log = logging.getLogger(__name__)

# Motion that is looked for, as a share of the canvas's width.
_REACH = 0.1


def charts(
    overlaps: Sequence[npt.NDArray[np.bool_]], masks: Grid, grid: Grid, settings: Settings
) -> list[Chart]:
    """The charts on which flow of all pairs is found.

    overlaps    where they overlap, on the grid `masks`; grid: the working grid.
    """
    coarse = quality.coarseness(settings.flow_quality, grid.width * grid.height)
    draw = partial(chart.pair_chart, mask_grid=masks, grid=grid, coarse=coarse)
    with ThreadPoolExecutor(settings.cores, "chart") as drawing:
        return list(drawing.map(draw, overlaps))


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
) -> tuple[list[PairFlow], list[figures.Parallax], list[Whole | None]]:
    """Flow of every pair of layers, mended; figures of it, if somebody listens; and what is taken from one of
    them, whole, by cells of the flow's chart.

    drawn       the charts of `pairs`, on which flow is found.
    guides      of each two layers, by their numbers; numbers: what guides call each of `layers`.
    """
    parameters = quality.flow_parameters(settings.flow_quality, settings.large_motion)
    largest = _REACH * (grid.canvas_width or grid.region.width) * grid.width / grid.region.width
    ends = finest(drawn, grid, settings)
    weighed, singles, shifts = list[Weighed](), list[Whole | None](), list[figures.Parallax]()
    waiting: list[tuple[PairFlow, tuple[Level, Level], Future[Whole | None] | None]] = []
    held: dict[tuple[int, int], guidance.Values] = {}
    compared = settings.relay and relay.triangles(pairs)

    def weigh() -> None:
        while waiting:  # one at most: a pair's images are large
            pair, images, job = waiting.pop()
            found = job.result() if job else None
            singles.append(found.finer() if found and ends is not drawn else found)
            weighed.append(consistency.weigh(device, pair, images, singles[-1]))

    with ThreadPoolExecutor(1, "single") as looking, progress("flow", len(pairs)) as advance:
        for pair, its_chart, its_finest in zip(pairs, drawn, ends, strict=True):
            images = _images(device, layers, pair, its_chart, grid)
            bearings = its_chart.eye.bearings if its_chart.eye else None
            reach = largest / its_chart.coarse if settings.large_motion != "off" else 0.0
            solved = flow.solve(device, *images, parameters, reach=reach, bearings=bearings)
            found = (solved.forward, solved.backward)
            first, second = numbers[pair.a], numbers[pair.b]
            its_guides = guides.get((min(first, second), max(first, second)), ())
            placed = guidance.on_chart(its_guides, first, its_chart, grid)
            if its_guides:
                found = guidance.lead(device, images, found, placed, its_chart.around(grid))
            if its_guides and compared:
                scale, ways = its_finest.width / its_chart.width, guidance.held(images, found, placed)
                held[pair.a, pair.b], held[pair.b, pair.a] = (scale * way for way in ways)
            weigh()
            job = None
            if settings.seam and (settings.foreground or (settings.movers and its_chart.eye)):
                views = (View.of(images[0]), View.of(images[1]))
                arrays, vouched = (found[0].get(), found[1].get()), (placed.at_a, placed.at_b)
                job = looking.submit(single.find, its_chart, arrays, views, vouched, solved.refused, settings)
            its_flow = PairFlow(pair.a, pair.b, its_chart, *found)
            if _log.isEnabledFor(logging.INFO):
                shifts.append(figures.parallax(device, its_flow, images, grid))
            if its_finest is not its_chart:
                images = _images(device, layers, pair, its_finest, grid)
                found = flow.refine(device, *images, *found, parameters)
                its_flow = PairFlow(pair.a, pair.b, its_finest, *found)
            waiting.append((its_flow, images, job))
            advance(1)
        weigh()
        if compared:
            for a, b in relay.mend(device, weighed, held):
                _log.info(
                    "flow of %s and %s: by way of other layers, which contradict it or know more",
                    layers[a].layer.name, layers[b].layer.name,
                )  # fmt: skip
        result = [consistency.mend(device, weighed.pop(0)) for _ in range(len(weighed))]
        device.give_back()  # it waits: else the last pair's time would be told as that of what follows
    return result, shifts, singles


def _images(
    device: Device, layers: Sequence[WorkingLayer], pair: Pair, its_chart: Chart, grid: Grid
) -> tuple[Level, Level]:
    """What both layers of a pair show on its chart."""
    a, b = (chart.sample(device, layers[index], grid, its_chart) for index in (pair.a, pair.b))
    return a, b

"""Scenes on charts in which things move, for movers.py: every point is known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from grids import sphere
from rooms import ROOM, Thing, hit, pattern, unit

from hugin_abflow import movers
from hugin_abflow.cells import SingleSource, View
from hugin_abflow.chart import Chart, pair_chart
from hugin_abflow.decision import Refused

Array = np.ndarray

CANVAS = sphere(720, 360)
SCALE = 360 / np.pi  # px per radian
LEFT, UP = np.array([-0.12, 0, 0]), np.array([0, 0, 0.12])
NOBODY = np.zeros((0, 2)), np.zeros((0, 2))


def chart_of(wraps: bool) -> Chart:
    """A ring, or a part of it, around the horizon."""
    overlap = np.zeros(CANVAS.shape, bool)
    overlap[150:211, :] = wraps
    overlap[130:231, 300:421] = True
    found = pair_chart(overlap, CANVAS, CANVAS)
    assert found.wraps == wraps
    return found


CHARTS = {wraps: chart_of(wraps) for wraps in (False, True)}


def places(chart: Chart, rays: Array) -> Array:
    """Of rays in the axes of the chart, (..., 2) px."""
    plain = replace(chart, transform=np.concatenate([np.eye(3).ravel(), chart.transform[9:]]))
    return plain.positions(rays.reshape(-1, 3)).reshape(*rays.shape[:-1], 2)


@dataclass(frozen=True)
class Scene:
    """What `find` takes, and the pixels of both photos that show each thing."""

    chart: Chart
    flows: tuple[Array, Array]
    views: tuple[View, View]
    shown: tuple[tuple[Array, Array], ...]

    def found(
        self, points: tuple[Array, Array] = NOBODY, refused: tuple[Array, Array] | None = None
    ) -> SingleSource | None:
        return movers.find(
            self.chart, self.flows, self.views, points, [Refused(0, np.stack(refused))] if refused else ()
        )

    def vouch(self, thing: int, off: tuple[float, float] = (0, 0)) -> tuple[Array, Array]:
        """Points of a thing, each a point of it in the second photo, too, but for an error."""
        rows, columns = np.nonzero(self.shown[thing][0])
        chosen = slice(len(rows) // 3, None, len(rows) // 3)
        starts = np.stack([columns, rows], 1)[chosen] + 0.5
        return starts, starts + self.flows[0][rows[chosen], columns[chosen]] + off


def scene(
    *things: Thing, wraps: bool = False, move: Array = LEFT, textured: tuple[bool, bool] = (True, True)
) -> Scene:
    """A room and things in it, seen before and after a move. textured: the room, the things."""
    chart = CHARTS[wraps]
    rows, columns = np.mgrid[: chart.height, : chart.width]
    starts = np.stack([columns, rows], -1) + 0.5
    rays = chart.projection.bearings(starts.reshape(-1, 2)).reshape(*starts.shape[:2], 3)
    flows, images, shown = [], [], []
    for second in (False, True):
        here, there = (move, 0 * move) if second else (0 * move, move)
        points = hit(ROOM, here, rays)
        ends, image = points - there, textured[0] * pattern(unit(points), 1, SCALE)
        its = []
        for number, thing in enumerate(things):
            points, near = thing.seen(here, rays, second)
            ends = np.where(near[..., None], points + thing.step * (not second) - there, ends)
            image = np.where(near, textured[1] * pattern(unit(points), 2 + number, SCALE), image)
            its.append(near)
        flow = places(chart, ends) - starts
        if wraps:
            flow[..., 0] = (flow[..., 0] + chart.width / 2) % chart.width - chart.width / 2
        flows.append(flow.astype(np.float32))
        images.append(View(image.astype(np.float32), np.ones((chart.height, chart.width), np.float32)))
        shown.append(its)
    return Scene(chart, tuple(flows), tuple(images), tuple(zip(*shown, strict=True)))

"""Scenes in which each layer shows the same, moved by so many px, for tests of relay.py."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np
from reference import common

from hugin_abflow import relay
from hugin_abflow.chart import Chart, pair_chart
from hugin_abflow.consistency import WeightedFlow
from hugin_abflow.grid import Grid
from hugin_abflow.opencl import Device


class Scene:
    """Layers that lie apart, on a canvas; flows of all pairs, which can be spoilt."""

    def __init__(
        self,
        device: Device,
        canvas: Grid,
        shifts: Sequence[float],
        overlaps: dict[tuple[int, int], np.ndarray] | None = None,
        texture: float = 0.2,
        shown: Sequence[np.ndarray] | None = None,
    ) -> None:
        """shown: what each layer shows of the canvas; default: all."""
        self.shown = shown
        self.device, self.canvas, self.shifts, self.texture = device, canvas, shifts, texture
        everywhere = np.ones(canvas.shape, bool)
        pairs = overlaps or dict.fromkeys(combinations(range(len(shifts)), 2), everywhere)
        self.charts = {pair: pair_chart(overlap, canvas, canvas) for pair, overlap in pairs.items()}
        self.found = [self._weighed(a, b, chart) for (a, b), chart in self.charts.items()]

    def _moved(self, points: np.ndarray, by: float) -> np.ndarray:
        """Points of the scene, to the right."""
        if not self.canvas.lonlat[1]:
            return points + np.array([by, 0, 0])
        turn = by * self.canvas.lonlat[1]
        x, y, z = np.moveaxis(points, -1, 0)
        return np.stack(
            [x * math.cos(turn) + y * math.sin(turn), y * math.cos(turn) - x * math.sin(turn), z], -1
        )

    def flow(self, a: int, b: int) -> np.ndarray:
        """The true one, (height, width, 2)."""
        chart = self.charts[min(a, b), max(a, b)]
        t = chart.transform
        x, y = np.meshgrid(np.arange(chart.width) + 0.5, np.arange(chart.height) + 0.5)
        points = self._moved(common.chart_point(x, y, t), self.shifts[b] - self.shifts[a])
        u, v = common.chart_position(points, t)
        period = 2 * math.pi * t[9] if t[13] else t[14] * t[9]
        across = (u - x + period / 2) % period - period / 2 if period else u - x
        return np.stack([across, v - y], -1)

    def _brightness(self, layer: int, chart: Chart) -> np.ndarray:
        x, y = np.meshgrid(np.arange(chart.width) + 0.5, np.arange(chart.height) + 0.5)
        points = self._moved(common.chart_point(x, y, chart.transform), -self.shifts[layer])
        scale = 0.7 if not self.canvas.lonlat[1] else 0.7 / self.canvas.lonlat[1]
        waves = np.sin(scale * points @ [1.0, 0.31, 0.17]) + np.cos(scale * points @ [-0.23, 0.9, 0.71])
        # periods that the cylinder's are not matter little
        brightness = 1 + self.texture * waves
        if self.shown is not None:
            px, py = common.canvas_position(
                common.chart_point(x, y, chart.transform), np.asarray(self.canvas.lonlat)
            )
            column = np.clip(px.astype(int), 0, self.canvas.width - 1)
            row = np.clip(py.astype(int), 0, self.canvas.height - 1)
            brightness = np.where(self.shown[layer][row, column], brightness, 0)
        return brightness

    def _weighed(self, a: int, b: int, chart: Chart) -> WeightedFlow:
        ways = []
        for start, end in ((a, b), (b, a)):
            trust = np.ones((chart.height, chart.width))
            values = [*np.moveaxis(self.flow(start, end), -1, 0), trust, self._brightness(start, chart)]
            ways.append(self.device.upload(np.stack(values, -1).astype(np.float32)))
        return WeightedFlow(a, b, chart, *ways, False)

    def change(self, a: int, b: int, edit: Callable[[np.ndarray, int], None]) -> None:
        """Edit a pair's found flow in place, that from a to b with 1, and back with -1."""
        for buffer, sign in zip(self.buffers(a, b), (1, -1), strict=True):
            values = buffer.get()
            edit(values, sign)
            buffer.set(values)

    def spoil(self, a: int, b: int, by: float, where: slice = slice(None)) -> None:
        """Flow of a pair that leads elsewhere, and back, in some columns."""

        def move(values: np.ndarray, sign: int) -> None:
            values[:, where, 0] += sign * by

        self.change(a, b, move)

    def forget(self, a: int, b: int, where: slice) -> None:
        """Flow of a pair that is not trusted, and wrong, in some columns."""

        def lose(values: np.ndarray, _: int) -> None:
            values[:, where, :2], values[:, where, 2] = 7, 0

        self.change(a, b, lose)

    def buffers(self, a: int, b: int) -> tuple:
        (pair,) = (one for one in self.found if (one.a, one.b) == (a, b))
        return pair.forward, pair.backward

    def off(self, a: int, b: int) -> float:
        """By how much a pair's flow is wrong, px: the median of both ways, where it is trusted."""
        forward, backward = (buffer.get() for buffer in self.buffers(a, b))
        wrong = [
            np.linalg.norm(values[..., :2] - self.flow(*way), axis=-1)[values[..., 2] > 0.3]
            for values, way in ((forward, (a, b)), (backward, (b, a)))
        ]
        return float(np.median(np.concatenate(wrong)))

    def mend(self, held: dict[tuple[int, int], np.ndarray] | None = None) -> list[tuple[int, int]]:
        return relay.mend(self.device, self.found, relay.compare(self.device, self.found), held or {})

    def stays(self) -> bool:
        """Whether mending it changes nothing."""
        before = self.state()
        return self.mend() == [] and all(map(np.array_equal, before, self.state()))

    def state(self) -> list[np.ndarray]:
        return [buffer.get() for one in self.found for buffer in (one.forward, one.backward)]

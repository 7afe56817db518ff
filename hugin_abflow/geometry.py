"""Where each layer is sampled and how much its colour counts (kernels/geometry.cl).

x_k(p) = p + sum_j w_j(p) F_jk(p), and the softmax of Code 1 of Meng & Liu 2020, for any number of layers;
F_jk as it passes through p (intermediate.py), or, as published, as it starts there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hugin_abflow.chart import Chart
from hugin_abflow.grid import Grid
from hugin_abflow.opencl import MUCH, Buffer, Device
from hugin_abflow.settings import Settings
from hugin_abflow.working import WorkingLayer

# Flow longer than this share of the canvas's width is implausible; it does not sharpen the softmax further.
_PLAUSIBLE = 0.1
_FOLLOWING_STEPS = 8
# Pixels of a row that a work item takes: GEOMETRY_CHUNK of kernels/geometry.cl.
_CHUNK = 4
# By how much a weight's logarithm falls for each working pixel that a displacement is shortened by: where
# another layer takes over both still lie on each other.
SHORTENED = 10.0


@dataclass(frozen=True)
class Pair:
    """Layers a and b (indices) that overlap and differ there."""

    a: int
    b: int


@dataclass(frozen=True)
class PairFlow(Pair):
    """Flow between the layers of a pair on their chart: float32 (height, width, 2), chart px.

    `forward` is F_ab: what a shows at q, b shows at q + F_ab(q); `backward` is F_ba. After intermediate.py
    both are of what passes through q, no longer of what starts there.
    """

    chart: Chart
    forward: Buffer
    backward: Buffer

    def starting_on(self, source: int) -> Buffer:
        """Flow that starts on layer `source` of the pair."""
        return self.forward if source == self.a else self.backward


def fields(
    device: Device,
    layers: Sequence[WorkingLayer],
    coefficients: Sequence[Buffer],
    flows: list[PairFlow],
    grid: Grid,
    settings: Settings,
) -> list[Buffer]:
    """Per layer, on its box: float32 (height, width, 4), the displacement of x_k as a difference of points
    (sphere: of unit vectors; plane: working px) and the colour weight s_k, not yet normalised.

    `flows` is emptied: all of them and all fields together would be most of what working resolution takes.
    """
    result = list[Buffer]()
    for index in range(len(layers)):
        result.append(_displacement(device, index, layers, coefficients, flows, grid))
        flows[:] = [flow for flow in flows if max(flow.a, flow.b) > index]
        device.give_back(MUCH)
    highest = device.zeros(grid.shape)
    furthest = _PLAUSIBLE * grid.circumference
    for layer, field, coefficient in zip(layers, result, coefficients, strict=True):
        device.run(
            "geometry", "geometry_activation", layer.box[2:],
            field, coefficient, layer.box, grid.border,
            settings.softmax_sharpness, settings.flow_magnitude, float(grid.circumference),
            furthest, highest,
        )  # fmt: skip
    for layer, field, coefficient in zip(layers, result, coefficients, strict=True):
        device.run(
            "geometry", "geometry_softmax", layer.box[2:], field, coefficient, layer.box, grid.border,
            highest,
        )  # fmt: skip
    return result


def keep_within(
    device: Device,
    layers: Sequence[WorkingLayer],
    fields: Sequence[Buffer],
    grid: Grid,
    fade: float = SHORTENED,
) -> None:
    """Limit displacements of layers towards a border of the canvas to half of the way there (fields, in
    place): what lies beyond is cut off from all of them.

    fade    how much less, of its logarithm, a layer weighs for each working px that it is shortened by.
    """
    if grid.wraps and grid.poles == 3:  # nothing lies beyond
        return
    for layer, field in zip(layers, fields, strict=True):
        device.run(
            "geometry", "geometry_within", layer.box[2:],
            field, layer.box, grid.border, grid.lonlat, fade,
        )  # fmt: skip


def _displacement(
    device: Device,
    index: int,
    layers: Sequence[WorkingLayer],
    coefficients: Sequence[Buffer],
    flows: Sequence[PairFlow],
    grid: Grid,
) -> Buffer:
    """One layer's field, in which the fourth component is 0."""
    layer = layers[index]
    width, height = layer.box[2:]
    chunks = (-(-width // _CHUNK), height)
    its = [pair for pair in flows if index in (pair.a, pair.b)]
    if not its:
        return device.zeros((height, width, 4))
    field = device.empty((height, width, 4))
    for number, pair in enumerate(its):
        other = pair.b if index == pair.a else pair.a
        device.run(
            "geometry", "geometry_add", chunks, coefficients[other], layers[other].box, layer.pixels,
            layer.box, grid.lonlat, pair.starting_on(other), pair.chart.border,
            pair.chart.transform, number == 0, field,
        )  # fmt: skip
    return field


def shown_at(
    box: tuple[int, int, int, int], field: Buffer, grid: Grid, places: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Where the panorama shows what a layer has at `places`: both float64 (n, 2), canvas px.

    box     place of the layer's field on the working grid.

    x_k(p) = q, solved for p by a fixed point, which is good where displacements are smooth.
    """
    displacements = field.get()[..., :3].astype(np.float64)
    left, top, width, height = box
    points = grid.points(places)
    shown = places
    for _ in range(_FOLLOWING_STEPS):
        column, row = np.floor((shown - (grid.region.left, grid.region.top)) * grid.ratios).astype(int).T
        column = column % grid.width if grid.wraps else column
        inside = (column >= left) & (column < left + width) & (row >= top) & (row < top + height)
        moved = displacements[np.where(inside, row - top, 0), np.where(inside, column - left, 0)]
        shown = grid.places(points - np.where(inside[:, None], moved, 0.0))
    return shown


def reach(device: Device, layer: WorkingLayer, field: Buffer, grid: Grid) -> list[float]:
    """For each row of the layer's box, a bound in working px of how many rows away the layer is sampled for
    places between it and the rows beside it, or at the box's rim.
    """
    found = device.empty((layer.box[3], 2))
    device.run("geometry", "geometry_reach", (layer.box[3], 1), field, layer.box, grid.lonlat, found)
    longest, furthest = found.get().astype(np.float64).T
    rows: list[float] = furthest.tolist()
    if not grid.spherical:
        return rows
    # a vector of length v, added to a unit vector, turns it by asin(v) at most
    angles = np.where(longest < 1, np.arcsin(np.minimum(longest, 1)), math.pi)
    latitudes = np.abs(grid.latitudes[layer.box[1] :][: len(longest)])
    # but most lead to the side. Displacements of pixels are added to places beside them, too, and their means
    changes = furthest * grid.lonlat[3] + (1 + 2 * longest) * max(grid.lonlat[1], grid.lonlat[3])
    far_from_poles = 2 * longest < np.cos(latitudes)
    aside = np.where(far_from_poles, longest / np.cos(latitudes), 0)  # sine of the change of longitude
    beyond = np.maximum(_beyond(latitudes + changes, aside), _beyond(changes - latitudes, aside))
    angles = np.where(far_from_poles, np.minimum(angles, changes + beyond), angles)
    # a row beyond a pole is seen where its directions are, on the pole's other side
    angles += 2 * np.maximum(latitudes + 1.5 * grid.lonlat[3] - math.pi / 2, 0)
    rows = (angles / grid.lonlat[3]).tolist()
    return rows


def _beyond(latitudes: npt.NDArray[np.float64], aside: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """How far beyond a latitude the mean of points may lie, none of which lies beyond it.

    aside       sine of how far in longitude the points lie from its meridian, at most.

    The mean is as high as the points, but nearer to the axis, by the cosine of that angle at most.
    """
    tangents = np.tan(latitudes) / np.sqrt(1 - aside**2)
    return np.where(latitudes < math.pi / 2, np.maximum(np.arctan(tangents) - latitudes, 0), math.inf)

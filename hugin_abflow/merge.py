"""From layers, or a Hugin project, to a panorama."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from hugin_abflow import blend, chart, coefficient, colour, flow, geometry, working
from hugin_abflow.coefficient import Masks
from hugin_abflow.geometry import PairFlow
from hugin_abflow.layer import Box, Canvas, Layer
from hugin_abflow.opencl import Device
from hugin_abflow.progress import Progress, silent
from hugin_abflow.settings import Settings
from hugin_abflow.working import Grid, WorkingLayer

_log = logging.getLogger(__name__)


def merge_layers(
    layers: Sequence[Layer], canvas: Canvas, settings: Settings | None = None, *, progress: Progress = silent
) -> npt.NDArray[Any]:
    settings = settings or Settings()
    device = Device(settings.device)
    return np.concatenate(list(_panorama(device, layers, canvas, settings, progress)))


def _panorama(device, layers, canvas, settings, progress):
    full = working.full_grid(canvas, layers)
    grid = working.working_grid(full, settings)
    reduced = _reduce(device, layers, grid, progress)
    masks = coefficient.masks(device, reduced, grid)
    coefficients = coefficient.coefficients(device, reduced, masks, grid, settings)
    flows = _flows(device, reduced, masks, grid, progress)
    fields = geometry.fields(device, reduced, coefficients, flows, grid, settings)
    correction = None
    if settings.exposure:
        correction = colour.correction(device, reduced, fields, flows, grid, masks.host)
    final = [
        blend.BlendLayer(l, f, geometry.reach(device, l, f, grid), correction.gains[i] if correction else None)
        for i, (l, f) in enumerate(zip(reduced, fields, strict=True))
    ]
    with progress("Blending", canvas.crop.height) as advance:
        yield from blend.bands(device, final, full, grid, correction.grid if correction else None, canvas.crop, settings, advance)


def _reduce(device, layers, grid, progress):
    with progress("Reading layers", sum(layer.box.height for layer in layers)) as advance:
        return [working.reduce_layer(device, layer, grid, advance) for layer in layers]


def _flows(device, layers, masks, grid, progress):
    pairs = [(a, b) for a in range(len(layers)) for b in range(a + 1, len(layers)) if (masks.host[a] & masks.host[b]).any()]
    result = []
    with progress("Finding flow", len(pairs)) as advance:
        for a, b in pairs:
            overlap = masks.host[a] & masks.host[b]
            c = chart.pair_chart(overlap, masks.grid, grid)
            if working.same_where_both(device, layers[a], layers[b]):
                zero = device.zeros((c.height, c.width, 2))
                result.append(PairFlow(a, b, c, zero, zero))
            else:
                levels = [chart.sample(device, layers[i], grid, c) for i in (a, b)]
                result.append(PairFlow(a, b, c, *flow.pair_flow(device, *levels)))
            advance(1)
    return result

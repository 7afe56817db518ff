"""What the working resolution takes of the memory that a run may take, and what that allows."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from hugin_abflow import memory, pairflow, seam
from hugin_abflow.chart import Chart
from hugin_abflow.coefficient import Masks
from hugin_abflow.errors import SettingsError
from hugin_abflow.grid import Grid, working_grid
from hugin_abflow.opencl import Device
from hugin_abflow.settings import FlowQuality, Settings
from hugin_abflow.working import WorkingLayer

_log = logging.getLogger(__name__)

# Bytes for each working pixel of a layer, of what is made from flow: a field, an array of coefficients, and
# offsets with what they are made from. While layers are cut there are fields alone.
_FIELD_BYTES = 16
_STEP_BYTES = _FIELD_BYTES + 4 + 9
# Bytes for each pixel of a chart, of all charts, for flow both ways.
_FLOW_BYTES = 16
# The same until flow is filled: with trust and brightness.
_FOUND_BYTES = 32
# Bytes for each pixel of a chart while its flow is found, if the search for large motion takes no more: of
# the largest charts, as many as are worked on at once.
_SOLVER_BYTES = 250
# Bytes that libraries take which are still being loaded meanwhile.
_LIBRARY_BYTES = 50 << 20


@dataclass(frozen=True)
class Work:
    """What is calculated at working resolution.

    charts  on which flow is found; none if there is no flow.
    layers  how many. shared: the share of the grid that several of them cover.
    """

    charts: Sequence[Chart]
    grid: Grid
    settings: Settings
    layers: int
    shared: float

    @classmethod
    def of_quality(
        cls,
        quality: FlowQuality,
        full: Grid,
        overlaps: Sequence[npt.NDArray[np.bool_]],
        masks: Masks,
        settings: Settings,
    ) -> Work:
        """The work of another `--flow-quality`.

        overlaps    of pairs whose flow is found, (height, width) on the grid of the layers' `masks`.
        """
        settings = replace(settings, flow_quality=quality)
        grid = working_grid(full, settings)
        charts = pairflow.charts(overlaps, masks.grid, grid, settings)
        return cls(charts, grid, settings, len(masks.host), masks.shared)

    def bytes(self, pixels: int, abreast: int = 1) -> int:
        """What flow, and what is found from it, take, or cuts where layers are many.

        pixels: of all layers. abreast: how many pairs' flow is found at a time.
        """
        finest = pairflow.finest(self.charts, self.grid, self.settings)
        size = sum(chart.width * chart.height for chart in finest)
        solvers = sorted(map(self._solver_bytes, self.charts, finest))
        while_found = _FOUND_BYTES * size + sum(solvers[-abreast:])
        cuts = seam.room(self.grid, self.settings.flow, self.layers, self.shared) if self.settings.seam else 0
        return max(_FLOW_BYTES * size + _STEP_BYTES * pixels, while_found, _FIELD_BYTES * pixels + cuts)

    def _solver_bytes(self, drawn: Chart, finest: Chart) -> int:
        """What a pair's flow takes while it is found on one chart and ends up on another."""
        searched = pairflow.search_room(drawn, self.grid, self.settings)
        return max(_SOLVER_BYTES * finest.width * finest.height, searched)


def abreast(
    device: Device, layers: Sequence[WorkingLayer], work: Work, fast: Callable[[], Work], most: int
) -> int:
    """How many pairs' flow may be found at a time, `most` at most.

    fast        gives the work of `--flow-quality fast`.

    Raises `SettingsError` if a limit that the user gave is too low even for one: the working canvas must not
    depend on it. Where it is the machine's, a warning is all.
    """
    taken = memory.resident() + device.own_memory + _LIBRARY_BYTES
    pixels = sum(layer.box[2] * layer.box[3] for layer in layers)
    limit = memory.limit(work.settings.max_memory)
    for pairs in range(most, 0, -1):
        needed = taken + work.bytes(pixels, pairs)
        if needed <= limit:
            break
    _log.info("memory: about %s of %s at working resolution", memory.size(needed), memory.size(limit))
    if needed > limit:
        _say_too_little(layers, work, fast, needed, taken)
    return pairs


def _say_too_little(
    layers: Sequence[WorkingLayer], work: Work, fast: Callable[[], Work], needed: int, taken: int
) -> None:
    """Refuse the limit, or warn of it, as `abreast` does. taken: bytes of what is there already."""
    settings = work.settings
    given, remedy = memory.shortage(settings.max_memory, needed)
    what = "whose flow takes" if settings.flow else "which take"
    said = f"{given} is too little for these layers, {what} about {memory.size(needed)}"
    if not settings.max_memory:
        _log.warning("%s; going on with that", said)
        return
    faster = fast()
    share = faster.grid.width * faster.grid.height / (work.grid.width * work.grid.height)
    taken -= round((1 - share) * sum(layer.pixels.nbytes for layer in layers))
    pixels = round(share * sum(layer.box[2] * layer.box[3] for layer in layers))
    would_do = taken + faster.bytes(pixels) <= memory.limit(settings.max_memory)
    raise SettingsError(f"{said}; {remedy}{', or choose --flow-quality fast' if would_do else ''}")

"""Merge all layers at once: the steps in their order."""

from __future__ import annotations

import importlib
import logging
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt

from hugin_abflow import (
    alignment,
    blend,
    coefficient,
    figures,
    flow,
    memory,
    multiband,
    pairflow,
    reading,
    relay,
    saturation,
    seam,
    single,
    working,
)
from hugin_abflow.blend import BlendLayer, Prepared
from hugin_abflow.cells import SingleSource
from hugin_abflow.chart import Chart
from hugin_abflow.coefficient import Masks
from hugin_abflow.errors import SettingsError
from hugin_abflow.geometry import Pair, PairFlow
from hugin_abflow.guides import Guide, by_pair
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.opencl import Device, DeviceMemoryError
from hugin_abflow.progress import Progress
from hugin_abflow.settings import FlowQuality, Settings
from hugin_abflow.working import Grid, WorkingLayer

_log = logging.getLogger(__name__)
# Of layers that take no part; abflow-enblend shows this, and of the rest warnings alone.
_unused_log = logging.getLogger("hugin_abflow.unused")

# Overlaps of fewer pixels of the masks' grid than this have nothing to match.
_LEAST_OVERLAP = 64
# Every so many rows and columns of a mask are looked at first.
_SAMPLED = 16
# Bytes that are to come for each working pixel of a layer: a field, an array of coefficients, offsets
# and what they are made from; for each pixel of charts: flow both ways, and before that as it was found; and
# of the largest, to solve it.
_STEP_BYTES, _FLOW_BYTES, _FOUND_BYTES, _SOLVER_BYTES = 16 + 4 + 9, 16, 32, 250
# What libraries take that are still being loaded (`_loading_ahead`).
_LIBRARY_BYTES = 50 << 20
# A weight that nothing brings above 0 (blend.cl lets hidden layers weigh something after all).
_NEVER = -1e30
# Below this a working canvas is too small to be worth another attempt.
_LEAST_WORKING_PIXELS = 20_000


def merge(
    device: Device,
    layers: Sequence[Layer],
    canvas: Canvas,
    settings: Settings,
    progress: Progress,
    guides: Sequence[Guide] = (),
) -> Generator[npt.NDArray[Any], None, None]:
    """Bands of the panorama's crop from top to bottom, as `blend.bands` gives them.

    The result does not depend on the order of `layers`, which `guides` are about.
    """
    prepared = prepare_in_memory(device, layers, canvas, settings, progress, guides)
    yield from bands(device, prepared, canvas, settings, progress)


def bands(
    device: Device, prepared: Prepared, canvas: Canvas, settings: Settings, progress: Progress
) -> Iterator[npt.NDArray[Any]]:
    """The full-resolution pass."""
    with progress("blend", canvas.crop.height) as advance:
        yield from blend.bands(device, prepared, canvas.crop, settings, advance)


def prepare_in_memory(
    device: Device,
    layers: Sequence[Layer],
    canvas: Canvas,
    settings: Settings,
    progress: Progress,
    guides: Sequence[Guide],
) -> Prepared:
    """`prepare`, one pair of layers at a time where the device's memory does not hold more, and on a smaller
    working canvas where it does not hold that.
    """
    region = working.full_grid(canvas, layers).region
    abreast = min(pairflow.ABREAST, settings.cores) if settings.flow else 1
    with _loading_ahead(device, layers[0], settings):
        while True:
            try:
                return prepare(device, layers, canvas, settings, progress, guides, abreast)
            except DeviceMemoryError:
                fewer = min(settings.working_limit, region.width * region.height) // 2
                if abreast == 1:
                    if fewer < _LEAST_WORKING_PIXELS:
                        raise
                    _log.warning("the device's memory is too small; now at a lower working resolution")
                    settings = replace(settings, working_pixels=fewer)
                abreast = 1
            device.give_back()


def prepare(
    device: Device,
    layers: Sequence[Layer],
    canvas: Canvas,
    settings: Settings,
    progress: Progress,
    guides: Sequence[Guide] = (),
    abreast: int = 1,
) -> Prepared:
    """Everything that sees far, at working resolution: flow, coefficients, geometry, colour, low bands.

    abreast: pairs of layers whose flow is found at a time, at most; nothing else depends on it.
    """
    full = working.full_grid(canvas, layers)
    grid = working.working_grid(full, settings)
    reduced = reading.read(device, layers, grid, progress, settings)
    masks = coefficient.masks(device, reduced, grid)
    used = [i for i in range(len(reduced)) if not _redundant(i, reduced, masks)]
    blended = [reduced[i] for i in used]
    masks = masks.only(used)
    order = {id(layer): index for index, layer in enumerate(layers)}
    numbers = [order[id(one.layer)] for one in blended]  # the caller's, which guides have
    pairs = _overlapping(device, blended, masks)
    overlaps = coefficient.Overlaps(masks, [(pair.a, pair.b) for pair in pairs])
    blended = saturation.with_whites(device, blended, pairs)
    flow_overlaps = overlaps if settings.flow else ()
    charts = pairflow.charts(flow_overlaps, masks.grid, grid, settings)
    fast = partial(_work_of_quality, "fast", full, flow_overlaps, masks.grid, settings)
    abreast = _check_memory(device, blended, _Work(charts, grid, settings), fast, abreast)
    pair_guides = by_pair(guides if settings.guides else ())
    flows, parallaxes, singles = list[PairFlow](), list[figures.Parallax](), list[SingleSource | None]()
    if settings.flow:
        flows, parallaxes, singles = pairflow.solve(
            device, blended, pairs, charts, grid, progress, settings, pair_guides, numbers, abreast,
            partial(relay.inferable, pairs, flow_overlaps, masks.grid),
        )  # fmt: skip
    with progress("align", 1) as advance:
        from_one = single.on_canvas(singles, [one.chart for one in flows], seam.seam_grid(grid))
        aligned = alignment.align(device, blended, pairs, flows, from_one, masks, grid, settings)
        if _log.isEnabledFor(logging.INFO):
            figures.report(blended, pairs, overlaps, parallaxes, seam.seam_grid(grid), aligned.whole)
        del masks, overlaps, flow_overlaps, fast  # what comes takes the most memory
        offsets, correction = multiband.none(grid, len(blended)), aligned.correction
        if settings.exposure and pairs:
            offsets = multiband.offsets(device, blended, aligned.fields, correction, grid, aligned.unlike)
        final = [
            BlendLayer(layer.layer, layer.box, field, reach, gain, offset)
            for layer, field, reach, gain, offset in zip(
                blended, aligned.fields, aligned.reaches, correction.gains, offsets.layers, strict=True
            )
        ]
        advance(1)
    final += [_unblended(device, reduced[i]) for i in range(len(reduced)) if i not in used]
    return Prepared(
        tuple(final), full, grid, correction.grid, offsets.grid, correction.shoulder, aligned.unlike
    )


@contextmanager
def _loading_ahead(device: Device, first: Layer, settings: Settings) -> Iterator[None]:
    """Load libraries and build kernels for what comes after reading, on another thread: that takes half a
    second, and several where kernels are compiled for the first time. A process that is to end waits for one
    step at most.
    """
    libraries = ("scipy.ndimage", "scipy.sparse.csgraph", "scipy.sparse.linalg")
    steps: list[Callable[[], object]] = [partial(device.build, "coefficient")]  # and all without options
    steps += [partial(device.build, "flow", flow.board_options(wraps=False))] if settings.flow else []
    steps += [partial(importlib.import_module, name) for name in libraries]
    steps.append(partial(device.build, "blend", blend.build_options(device, first)))
    device.build("working", working.pixel_options(first)[0])  # else reading would wait for all the others
    done = threading.Event()

    def load() -> None:
        for step in steps:
            # raised again where it is needed; imports fail if another thread's is interrupted
            with suppress(Exception):
                if not done.is_set():
                    step()

    threading.Thread(target=load, name="loader").start()
    try:
        yield
    finally:
        done.set()


def _redundant(index: int, layers: Sequence[WorkingLayer], masks: Masks) -> bool:
    """A layer wholly inside another has no area of its own; equal ones share."""
    own, name = masks.host[index], layers[index].layer.name
    some = own[::_SAMPLED, ::_SAMPLED]  # of 300 layers nearly all can be told apart by them
    for other, mask in enumerate(masks.host):
        if other == index or (some & ~mask[::_SAMPLED, ::_SAMPLED]).any():
            continue
        if not (own & ~mask).any() and (mask & ~own).any():
            if own.any():
                _unused_log.info(
                    "%s is not used: it lies wholly inside %s, so nothing is its own; where it shall show, "
                    "mask the other photos in Hugin",
                    name, layers[other].layer.name,
                )  # fmt: skip
            else:
                _unused_log.info("%s is not used: it shows nothing, or next to nothing", name)
            return True
    return False


def _unblended(device: Device, layer: WorkingLayer) -> BlendLayer:
    """A layer that weighs less than nothing: it shows only where no other layer is."""
    field = device.upload(np.array([[[0, 0, 0, _NEVER]]], np.float32))
    return BlendLayer(layer.layer, (*layer.box[:2], 1, 1), field, [0.0], None, None)


def _overlapping(device: Device, layers: Sequence[WorkingLayer], masks: Masks) -> list[Pair]:
    """The pairs of layers that overlap and differ there."""
    result = []
    for a, b in combinations(range(len(layers)), 2):
        shared = working.shared_box(layers[a], layers[b])
        if not (shared.width and shared.height):  # of 300 layers nearly all
            continue
        if np.count_nonzero(masks.overlap(a, b)) < _LEAST_OVERLAP:
            continue
        # without it, the borders of the masks would differ from the middle by rounding
        if not working.same_where_both(device, layers[a], layers[b]):
            result.append(Pair(a, b))
    return result


@dataclass(frozen=True)
class _Work:
    """What is calculated at working resolution. charts: on which flow is found; none if there is no flow."""

    charts: Sequence[Chart]
    grid: Grid
    settings: Settings

    def bytes(self, pixels: int, abreast: int = 1) -> int:
        """What flow, and what is found from it, take.

        pixels: of all layers. abreast: how many pairs' flow is found at a time.
        """
        finest = pairflow.finest(self.charts, self.grid, self.settings)
        sizes = sorted(chart.width * chart.height for chart in finest)
        at_last, meanwhile = _STEP_BYTES * pixels, _SOLVER_BYTES * sum(sizes[-abreast:])
        return max(_FLOW_BYTES * sum(sizes) + at_last, _FOUND_BYTES * sum(sizes) + meanwhile)


def _work_of_quality(
    quality: FlowQuality,
    full: Grid,
    overlaps: Sequence[npt.NDArray[np.bool_]],
    masks: Grid,
    settings: Settings,
) -> _Work:
    """The work of another quality."""
    settings = replace(settings, flow_quality=quality)
    grid = working.working_grid(full, settings)
    return _Work(pairflow.charts(overlaps, masks, grid, settings), grid, settings)


def _check_memory(
    device: Device,
    layers: Sequence[WorkingLayer],
    work: _Work,
    fast: Callable[[], _Work],
    most: int,
) -> int:
    """How many pairs' flow may be found at a time, `most` at most. A limit that is too low even for one is
    refused: the working canvas must not depend on it.

    fast        gives the work of `--flow-quality fast`.
    """
    settings = work.settings
    taken = memory.resident() + device.own_memory + _LIBRARY_BYTES
    pixels = sum(layer.box[2] * layer.box[3] for layer in layers)
    limit = memory.limit(settings.max_memory)
    for abreast in range(most, 0, -1):
        needed = taken + work.bytes(pixels, abreast)
        if needed <= limit:
            break
    _log.info("memory: about %s of %s at working resolution", memory.size(needed), memory.size(limit))
    if needed <= limit:
        return abreast
    given, remedy = memory.shortage(settings.max_memory, needed)
    what = "whose flow takes" if settings.flow else "which take"
    said = f"{given} is too little for these layers, {what} about {memory.size(needed)}"
    if settings.max_memory:
        faster = fast()
        share = faster.grid.width * faster.grid.height / (work.grid.width * work.grid.height)
        taken -= round((1 - share) * sum(layer.pixels.nbytes for layer in layers))
        would_do = taken + faster.bytes(round(share * pixels)) <= limit
        raise SettingsError(f"{said}; {remedy}{', or choose --flow-quality fast' if would_do else ''}")
    _log.warning("%s; going on with that", said)
    return abreast

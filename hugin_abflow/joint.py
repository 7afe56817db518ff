"""Merge all layers at once: the steps in their order."""

from __future__ import annotations

import importlib
import logging
import threading
from collections import defaultdict
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, compress
from typing import Any

import numpy as np
import numpy.typing as npt

from hugin_abflow import (
    alignment,
    blend,
    budget,
    coefficient,
    figures,
    flow,
    multiband,
    pairflow,
    reading,
    relay,
    saturation,
    seam,
    single,
    unit,
    working,
)
from hugin_abflow.blend import NEVER, BlendLayer, Prepared
from hugin_abflow.coefficient import Masks
from hugin_abflow.geometry import Pair
from hugin_abflow.grid import Grid, full_grid, working_grid
from hugin_abflow.guides import Guide, by_pair
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.opencl import Device, DeviceMemoryError
from hugin_abflow.progress import Progress
from hugin_abflow.settings import Settings
from hugin_abflow.working import WorkingLayer

_log = logging.getLogger(__name__)
# Of layers that take no part; abflow-enblend shows this, and of the rest warnings alone.
_unused_log = logging.getLogger("hugin_abflow.unused")

# Overlaps of fewer pixels of the masks' grid than this have nothing to match.
_LEAST_OVERLAP = 64
# Every so many rows and columns of a mask are looked at first.
_SAMPLED = 16
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
    region = full_grid(canvas, layers).region
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
    full = full_grid(canvas, layers)
    grid = working_grid(full, settings)
    reduced = reading.read(device, layers, grid, progress, settings)
    light_unit = unit.code_floats(device, reduced)
    used, unused = _parted(device, reduced, layers, grid)
    flows, parallaxes, singles = _flow(device, used, full, grid, guides, settings, progress, abreast)
    with progress("align", 1) as advance:
        from_one = single.on_canvas(singles, [one.chart for one in flows], seam.seam_grid(grid))
        blended, pairs = used.layers, used.pairs
        aligned = alignment.align(device, blended, pairs, flows, from_one, used.masks, grid, settings)
        if _log.isEnabledFor(logging.INFO):
            figures.report(blended, pairs, used.overlaps, parallaxes, seam.seam_grid(grid), aligned.whole)
        del used  # what comes takes the most memory: its masks make room
        offsets = _offsets(device, blended, pairs, aligned, grid, settings)
        final = _blend_layers(blended, aligned, offsets) + [_unblended(device, one) for one in unused]
        advance(1)
    gains = aligned.correction
    return Prepared(
        layers=tuple(final),
        full=full,
        grid=grid,
        gain_grid=gains.grid,
        offset_grid=offsets.grid,
        shoulder=gains.shoulder,
        light_unit=light_unit,
        unlike=aligned.unlike,
        carried=aligned.carried,
    )


@dataclass(frozen=True)
class _Used:
    """The layers that are blended, and where they overlap.

    layers      each of which has an area of its own.
    numbers     of each among the caller's layers: guides have these.
    masks       of `layers`.
    pairs       those of `layers` that overlap, and differ there.
    """

    layers: Sequence[WorkingLayer]
    numbers: Sequence[int]
    masks: Masks
    pairs: Sequence[Pair]

    @property
    def overlaps(self) -> coefficient.Overlaps:
        """Of `pairs`, on the masks' grid."""
        return coefficient.Overlaps(self.masks, [(pair.a, pair.b) for pair in self.pairs])


def _parted(
    device: Device, reduced: Sequence[WorkingLayer], layers: Sequence[Layer], grid: Grid
) -> tuple[_Used, list[WorkingLayer]]:
    """The layers that are blended, and those that are not, since nothing is their own.

    layers      the caller's, in the order that guides know.
    """
    masks = coefficient.masks(device, reduced, grid)
    kept = [not _redundant(i, reduced, masks) for i in range(len(reduced))]
    blended = list(compress(reduced, kept))
    masks = masks.only(np.flatnonzero(kept).tolist())
    pairs = _overlapping(device, blended, masks)
    order = defaultdict[int, list[int]](list)
    for index, layer in enumerate(layers):  # which may be one, given twice
        order[id(layer)].append(index)
    numbers = [order[id(one.layer)].pop(0) for one in reduced]
    whites = saturation.with_whites(device, blended, pairs)
    used = _Used(whites, list(compress(numbers, kept)), masks, pairs)
    return used, [one for one, its in zip(reduced, kept, strict=True) if not its]


def _flow(
    device: Device,
    used: _Used,
    full: Grid,
    grid: Grid,
    guides: Sequence[Guide],
    settings: Settings,
    progress: Progress,
    most: int,
) -> pairflow.Solution:
    """Flow of all pairs, of at most `most` at a time, if there is the memory for that; nothing without flow.

    Raises `SettingsError` where a limit of memory is too low.
    """
    overlaps = used.overlaps if settings.flow else ()
    charts = pairflow.charts(overlaps, used.masks.grid, grid, settings)
    work = budget.Work(charts, grid, settings, len(used.layers), used.masks.shared)
    fast = partial(budget.Work.of_quality, "fast", full, overlaps, used.masks, settings)
    abreast = budget.abreast(device, used.layers, work, fast, most)
    if not settings.flow:
        return pairflow.Solution([], [], [])
    return pairflow.solve(
        device, used.layers, used.pairs, charts, grid, progress, settings,
        by_pair(guides if settings.guides else (), used.numbers), abreast,
        partial(relay.inferable, used.pairs, overlaps, used.masks.grid),
    )  # fmt: skip


def _offsets(
    device: Device,
    layers: Sequence[WorkingLayer],
    pairs: Sequence[Pair],
    aligned: alignment.Aligned,
    grid: Grid,
    settings: Settings,
) -> multiband.Offsets:
    """What is added to each layer for low frequencies to agree; nothing if exposure is to stay as it is."""
    if not (settings.exposure and pairs):
        return multiband.none(grid, len(layers))
    return multiband.offsets(device, layers, aligned.fields, aligned.correction, grid, aligned.unlike)


def _blend_layers(
    layers: Sequence[WorkingLayer], aligned: alignment.Aligned, offsets: multiband.Offsets
) -> list[BlendLayer]:
    """Each layer with all that its pixels are corrected by."""
    found = zip(
        layers, aligned.fields, aligned.reaches, aligned.correction.gains, offsets.layers, strict=True
    )
    return [
        BlendLayer(layer.layer, layer.box, field, reach, gain, offset)
        for layer, field, reach, gain, offset in found
    ]


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
    own, name = masks.host[index], layers[index].layer.called
    some = own[::_SAMPLED, ::_SAMPLED]  # of 300 layers nearly all can be told apart by them
    for other, mask in enumerate(masks.host):
        if other == index or (some & ~mask[::_SAMPLED, ::_SAMPLED]).any():
            continue
        if not (own & ~mask).any() and (mask & ~own).any():
            if own.any():
                _unused_log.warning(
                    "%s is not used: it lies wholly inside %s, so nothing is its own; where it shall show, "
                    "mask the other photos in Hugin",
                    name, layers[other].layer.called,
                )  # fmt: skip
            else:
                _unused_log.info("%s is not used: it shows nothing, or next to nothing", name)
            return True
    return False


def _unblended(device: Device, layer: WorkingLayer) -> BlendLayer:
    """A layer that weighs less than nothing: it shows only where no other layer is."""
    field = device.upload(np.array([[[0, 0, 0, NEVER]]], np.float32))
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

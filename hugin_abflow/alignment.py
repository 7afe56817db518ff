"""Makes layers agree: by geometry and colour, and where neither can, by taking one layer, whole.

What flow cannot explain, such as people, would be taken for a difference of exposure. So regions of it are
found after a first, stricter correction of exposure, and the final correction leaves them out.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from hugin_abflow import (
    clones,
    coefficient,
    colour,
    geometry,
    ghosts,
    highlights,
    intermediate,
    membrane,
    rim,
    seam,
    shadows,
    tears,
    transition,
)
from hugin_abflow.coefficient import Masks
from hugin_abflow.colour import Correction
from hugin_abflow.content import Unlike
from hugin_abflow.gains import Measured
from hugin_abflow.geometry import Pair, PairFlow
from hugin_abflow.grid import Grid
from hugin_abflow.highlights import Clipped, PerLayer
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.regions import Cells, Residuals
from hugin_abflow.scene import Scene
from hugin_abflow.settings import Settings
from hugin_abflow.working import WorkingLayer

# What only one layer shows first passes for exposure in part: its region grows to its size in a few rounds.
_SEAM_ROUNDS = 2


@dataclass(frozen=True)
class Aligned:
    """Layers that agree.

    fields      where each is sampled, and its weight. reaches: how far from there, by rows (geometry.py).
    whole       where one layer was taken, on the seam grid; None: nowhere, or, without flow, everywhere.
    unlike      where they show different things, with flow there alone; None: nowhere.
    carried     on a grid, as `rim.carry` gives it: where geometry was carried into strips that one layer
                alone may show; None: nowhere.
    """

    fields: Sequence[Buffer]
    reaches: list[list[float]]
    correction: Correction
    whole: Cells | None
    unlike: Unlike | None
    carried: tuple[Grid, Buffer] | None = None


def align(
    device: Device,
    layers: Sequence[WorkingLayer],
    pairs: Sequence[Pair],
    flows: list[PairFlow],
    single: Cells | None,
    masks: Masks,
    grid: Grid,
    settings: Settings,
) -> Aligned:
    """Align layers by flow and exposure, without flow by cuts alone.

    flows       of `pairs`; emptied.
    single      what single.py found, on the seam grid, to which shadows are added; None: nothing.
    """
    strips = rim.find(masks) if transition.wanted(flows, settings) else None
    aligned = _align(device, layers, pairs, flows, single, masks, strips, grid, settings)
    if strips is None:
        return aligned
    fields, reaches = aligned.fields, list(aligned.reaches)
    # as they are at last, also beside cuts
    carried, changed = rim.carry(device, layers, fields, strips, grid)
    _keep_within(device, layers, fields, changed, reaches, grid)
    return replace(aligned, reaches=reaches, carried=(masks.grid, carried))


def _align(
    device: Device,
    layers: Sequence[WorkingLayer],
    pairs: Sequence[Pair],
    flows: list[PairFlow],
    single: Cells | None,
    masks: Masks,
    strips: rim.Rim | None,
    grid: Grid,
    settings: Settings,
) -> Aligned:
    """`align`, but for what is carried into strips."""
    clipped = highlights.measure(device, layers, masks, grid, settings)
    fields = _fields(device, layers, flows, clipped, masks, strips, grid, settings)
    extra = highlights.reduce_weights(device, layers, fields, clipped, masks, grid)
    measured = colour.measure(device, layers, fields, pairs, grid, masks.host)
    if settings.flow and settings.seam:
        shaded = shadows.find(measured, seam.seam_grid(grid))
        if shaded is not None:
            single = shaded if single is None else single | shaded
    device.give_back()  # two solutions at a time take the most memory
    scene = Scene(device, layers, pairs, fields, masks, grid)
    with ThreadPoolExecutor(2, "gains") as threads:  # each on one core: the device goes on meanwhile
        gains = _Gains(threads, device, measured, settings)
        if not settings.seam:
            return _uncut(scene, gains)
        if not settings.flow:
            return _cut_overlaps(scene, gains, single, settings)
        return _cut_regions(scene, gains, single, clipped, extra, settings)


def _fields(
    device: Device,
    layers: Sequence[WorkingLayer],
    flows: list[PairFlow],
    clipped: Clipped,
    masks: Masks,
    strips: rim.Rim | None,
    grid: Grid,
    settings: Settings,
) -> list[Buffer]:
    """Where each layer is sampled, and its weight (`geometry.fields`). `flows` is emptied."""
    least_strain = transition.wanted(flows, settings)
    coefficients = coefficient.coefficients(device, layers, masks, grid, even=least_strain)
    if least_strain:
        uneven = clipped.excess.max(0)
        transition.minimise_strain(device, layers, coefficients, flows, masks, grid, settings, uneven, strips)
    intermediate.replace_flows(device, layers, coefficients, flows, grid, settings)
    fields = geometry.fields(device, layers, coefficients, flows, grid, settings)
    if settings.flow and settings.intermediate:  # else nothing is displaced, or as published
        geometry.keep_within(device, layers, fields, grid)
    del coefficients
    device.give_back()
    return fields


@dataclass(frozen=True)
class _Gains:
    """Solves for corrections, each on a thread of its own."""

    threads: ThreadPoolExecutor
    device: Device
    measured: Measured
    settings: Settings

    def strict(self, ignored: Cells | None) -> Future[Correction]:
        """That by which regions are found: exposure explains a difference whether it is corrected or not."""
        return self._solve(replace(self.settings, exposure=True), ignored, True)

    def final(self, ignored: Cells | None) -> Future[Correction]:
        """That which the layers get."""
        return self._solve(self.settings, ignored, False)

    def none(self) -> Future[Correction]:
        """No correction."""
        return self._solve(replace(self.settings, exposure=False), None, False)

    def _solve(self, settings: Settings, ignored: Cells | None, strict: bool) -> Future[Correction]:
        return self.threads.submit(colour.correction, self.device, self.measured, settings, ignored, strict)


@dataclass(frozen=True)
class _Regions:
    """Where layers differ though they are aligned.

    whole       the cells of all regions; None: there are none.
    residual    how far layers differ. correction: the strict one after which they do.
    """

    whole: Cells | None
    residual: Residuals
    correction: Correction


def _uncut(scene: Scene, gains: _Gains) -> Aligned:
    """Layers that are blended wherever they overlap."""
    final = gains.final(None)
    return Aligned(scene.fields, _reaches(scene), final.result(), None, None)


def _cut_overlaps(scene: Scene, gains: _Gains, single: Cells | None, settings: Settings) -> Aligned:
    """Layers that nothing has aligned, cut in all of their overlaps."""
    strict = gains.strict(None)
    reaches = _reaches(scene)
    correction = _find_regions(scene, gains, strict, single, settings).correction
    unlike = seam.unlike(scene, correction)
    seam.cut_unaligned(scene, correction)
    # what is not aligned tells little of exposures: that is left to bands of frequencies
    return Aligned(scene.fields, reaches, gains.none().result(), None, unlike)


def _cut_regions(
    scene: Scene, gains: _Gains, single: Cells | None, clipped: Clipped, extra: PerLayer, settings: Settings
) -> Aligned:
    """Layers that flow has aligned, cut where they differ all the same."""
    strict = gains.strict(None)
    # before it is known whether there are regions, which is rare
    early = gains.final(None) if single is None and settings.cores > 1 else None
    reaches = _reaches(scene)
    regions = _find_regions(scene, gains, strict, single, settings)
    if regions.whole is None:
        _sharpen(scene, regions)
        return Aligned(scene.fields, reaches, (early or gains.final(None)).result(), None, None)
    final = gains.final(regions.whole)
    unlike = _cut(scene, regions, regions.whole, single, clipped, extra, reaches, settings)
    _sharpen(scene, regions)
    return Aligned(scene.fields, reaches, final.result(), regions.whole, unlike)


def _sharpen(scene: Scene, regions: _Regions) -> None:
    """Have layers change over quickly where they differ in fine detail, beside what is taken whole."""
    device, layers, fields, grid = scene.device, scene.layers, scene.fields, scene.grid
    if regions.residual.fine is not None:
        fine, cells = regions.residual.fine, seam.seam_grid(grid)
        ghosts.sharpen(device, layers, fields, fine, regions.whole, grid, cells)


def _reaches(scene: Scene) -> list[list[float]]:
    """How far fields lead from where their layers are sampled, by rows (`Aligned.reaches`)."""
    layers = zip(scene.layers, scene.fields, strict=True)
    return [geometry.reach(scene.device, layer, field, scene.grid) for layer, field in layers]


def _find_regions(
    scene: Scene, gains: _Gains, first: Future[Correction], single: Cells | None, settings: Settings
) -> _Regions:
    """Regions, found in rounds, each after a correction that ignores those found before.

    first       the correction that ignores none.
    """
    whole: Cells | None = None
    known = [difference.known for difference in gains.measured.differences]
    for _ in range(_SEAM_ROUNDS):
        correction = (first if whole is None else gains.strict(whole)).result()
        scene.device.give_back()
        residual = seam.residuals(scene, correction, known, single)
        found = seam.regions(residual, scene.grid, aligned=settings.flow, single=single)
        grown = found if whole is None else found | whole
        if not grown.any() or (whole is not None and np.array_equal(grown, whole)):
            break
        whole = grown
    return _Regions(whole, residual, correction)


def _cut(
    scene: Scene,
    regions: _Regions,
    whole: Cells,
    single: Cells | None,
    clipped: Clipped,
    extra: PerLayer,
    reaches: list[list[float]],
    settings: Settings,
) -> Unlike:
    """Take the regions `whole` from one layer each, smoothly displaced: fields change, and with them
    `reaches`.

    extra       of `highlights.reduce_weights`: there is none where one layer is taken.
    """
    device, layers, fields, masks, grid = scene.device, scene.layers, scene.fields, scene.masks, scene.grid
    cells = seam.seam_grid(grid)
    price = seam.clipping_prices(scene, regions.correction, clipped.excess, whole)
    highlights.restore_weights(device, layers, fields, extra, whole, grid, cells)
    torn = tears.find(device, layers, fields, whole, grid, cells)
    owner, gone = seam.cut(
        scene, regions.residual, whole, single, price, torn,
        choose=partial(clones.owners, scene, regions.correction, cells) if settings.clones else None,
    )  # fmt: skip
    moved = [*gone.values()] + ([] if single is None else [single])
    unlike = Unlike.of(cells, regions.residual.mean, whole, np.any(moved, 0) if moved else None)
    stretched = membrane.stretch(device, layers, fields, owner, whole, unlike.anywhere, masks, grid, cells)
    _keep_within(device, layers, fields, stretched, reaches, grid)  # nothing else is to be seen in a region
    seam.clamp_displacements(scene, owner, whole)
    return unlike


def _keep_within(
    device: Device,
    layers: Sequence[WorkingLayer],
    fields: Sequence[Buffer],
    changed: Sequence[int],
    reaches: list[list[float]],
    grid: Grid,
) -> None:
    """Keep layers whose displacements have changed within the canvas, as heavy as they are, and say in
    `reaches` how far these lead now.
    """
    geometry.keep_within(device, [layers[k] for k in changed], [fields[k] for k in changed], grid, fade=0.0)
    for k in changed:
        reaches[k] = geometry.reach(device, layers[k], fields[k], grid)

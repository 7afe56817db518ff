"""Thin strips along the panorama's rim that a layer does not reach (kernels/rim.cl).

Photos that overlap by much end at the rim one beside the other, and their borders cross there at a flat
angle. Beyond a layer's border is a strip a few pixels high that others show, and beyond that nothing. If the
geometry belonged to these alone in the strip, a transition would narrow to a point where the borders cross:
bars would be squeezed together there. So such strips count as if the layer reached to the rim: the
transition goes on over them, and geometry is carried into them from beside them. What is shown there comes
from those that are there; the layer that ends fades out before.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from hugin_abflow.cells import Mask
from hugin_abflow.coefficient import Masks
from hugin_abflow.grid import Grid, any_around
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.working import WorkingLayer

# How thick a strip is at most, of the panorama's smaller side. Where it is thicker, borders that cross have
# left room for a transition.
_THICK = 0.02
# Working pixels over which a layer fades out towards strips.
_FADE = 8.0

Distances = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Rim:
    """On the masks' grid.

    covered     what any layer covers, (height, width).
    strips      of it, thin strips beyond a layer's border, of those of `Masks` that have some: of many they
                are few, and all would take as much memory as the masks.
    """

    grid: Grid
    covered: Mask
    strips: Mapping[int, Mask]

    @property
    def anywhere(self) -> Mask:
        """The strips of all layers, (height, width)."""
        found = np.zeros_like(self.covered)
        for strip in self.strips.values():
            found |= strip
        return found

    def reached(self, masks: Masks) -> Mask:
        """What layers cover, with their strips, (layers, height, width)."""
        cover = masks.host.copy()
        for k, strip in self.strips.items():
            cover[k] |= strip
        return cover


def find(masks: Masks) -> Rim | None:
    """The strips of all layers; None: there are none.

    Of what a layer does not cover they are what no disc fits into (an opening), beside both the layer and the
    rim. Where these meet at the sides of photos that is a few pixels.
    """
    grid, covered = masks.grid, np.asarray(masks.host.any(0))
    if covered.all() and grid.wraps and grid.poles == 3:
        return None  # nothing ends
    thick = _THICK * min(grid.shape)
    around = math.ceil(thick) + 2
    strips: dict[int, Mask] = {}
    inner = slice(around, around + grid.height), slice(around, around + grid.width)
    anything = _padded(covered, grid, around)
    for k, mask in enumerate(masks.host):
        its = _padded(mask, grid, around)
        if not its.any():
            continue
        rows, columns = (np.flatnonzero(its.any(axis)) for axis in (1, 0))
        part = tuple(slice(max(at[0] - around, 0), at[-1] + around + 1) for at in (rows, columns))
        found = np.zeros_like(its)
        found[part] = _thin(its[part], anything[part], thick)
        if found[inner].any():
            strips[k] = found[inner].copy()
    return Rim(grid, covered, strips) if strips else None


def _thin(mask: Mask, covered: Mask, thick: float) -> Mask:
    """Thin strips beyond a layer; mask and covered: what it covers, and what any does."""
    rest = covered & ~mask
    if not rest.any() or covered.all():
        return np.zeros_like(rest)
    discs = _distances(rest) > thick / 2
    near = rest & _within(~covered, thick) & _within(mask, thick)
    return near & ~_within(discs, thick / 2)


def _distances(mask: Mask) -> Distances:
    """How far it is from each cell of a mask to the nearest that is not in it; 0 there."""
    distances: Distances = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return distances


def _within(mask: Mask, distance: float) -> Mask:
    """What is at most that far from a mask; nothing, if that is empty."""
    return np.asarray(_distances(~mask) <= distance) if mask.any() else mask


def _ways(mask: Mask) -> Distances:
    """From each cell to the nearest of a mask, rows and columns: (2, height, width)."""
    nearest = _nearest(mask)
    here = np.indices(mask.shape, np.float32)
    ways: Distances = (np.stack(np.unravel_index(nearest, mask.shape)) - here).astype(np.float32)
    return ways


def _nearest(mask: Mask) -> npt.NDArray[np.intp]:
    """The number of the nearest cell of a mask, in which one is at least, (height, width)."""
    _, labels = cv2.distanceTransformWithLabels(
        (~mask).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    numbers = np.zeros(labels.max() + 1, np.intp)
    numbers[labels[mask]] = np.flatnonzero(mask)
    return np.asarray(numbers[labels])


def _padded(mask: Mask, grid: Grid, around: int) -> Mask:
    """With that many cells on all sides: those of the other side where the grid wraps, those of the border at
    a pole, where nothing ends, and nothing beyond other borders.
    """
    for pole, width in ((1, (around, 0)), (2, (0, around))):
        mask = np.pad(mask, (width, (0, 0)), "edge" if grid.poles & pole else "constant")
    return np.pad(mask, ((0, 0), (around, around)), "wrap" if grid.wraps else "constant")


def carry(
    device: Device, layers: Sequence[WorkingLayer], fields: Sequence[Buffer], rim: Rim, grid: Grid
) -> tuple[Buffer, list[int]]:
    """Carry fields (in place) from beside strips into them, and have each layer fade out towards its own.

    Returns uint8 (height, width) on the rim's grid: 1 where fields were carried to; and which layers are
    there.
    """
    source, outward = _sources(rim, grid)
    into = source >= 0
    told = device.upload(source), device.upload(outward)
    for k, strip in rim.strips.items():
        box, left = layers[k].box, device.upload(_fading(strip, rim.grid, grid))
        device.run("rim", "rim_fade", box[2:], fields[k], box, grid.border, left, rim.grid.border)
    beside = [k for k, layer in enumerate(layers) if any_around(into, layer.box, grid, rim.grid)]
    for k in beside:  # of many layers few
        layer = layers[k]
        device.run(
            "rim", "rim_carry", layer.box[2:], fields[k], layer.pixels, layer.box, grid.border, grid.lonlat,
            *told, rim.grid.border,
        )  # fmt: skip
    return device.upload(into, np.uint8), beside


def _sources(rim: Rim, grid: Grid) -> tuple[npt.NDArray[np.int32], Distances]:
    """For each cell of a strip the number of the nearest covered one in none, else -1, (height, width); and
    where the rim is: (height, width, 4), as rim.cl takes it.

    Cells beside strips that layers cover in part only have one as well.
    """
    height, width = rim.grid.shape
    around = min(math.ceil(2 * _THICK * min(height, width)) + 2, width)
    inner = slice(around, around + height), slice(around, around + width)
    strip, covered = (_padded(mask, rim.grid, around) for mask in (rim.anywhere, rim.covered))
    into = strip | ((cv2.dilate(strip.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & ~covered)
    free = covered & ~into
    if not free.any():
        return np.full((height, width), -1, np.int32), np.zeros((height, width, 4), np.float32)
    nearest = _nearest(free)
    rows, columns = np.unravel_index(nearest[inner], free.shape)
    numbers = np.clip(rows - around, 0, height - 1) * width + (columns - around) % width
    way, inside = (_ways(mask)[:, *inner] for mask in (~covered, free))
    length = np.hypot(*way)
    thick = length + np.hypot(*inside) - 1
    share = np.clip((length - 0.5) / np.maximum(thick, 1), 0, 1)
    there = np.stack(
        [*(way[::-1] / np.maximum(length, 1)), share, thick * (grid.height / rim.grid.height)], -1
    )
    source = np.where(into[inner], numbers, -1).astype(np.int32)
    return source, np.where(into[inner][..., None], there, 0).astype(np.float32)


def _fading(strip: Mask, cells: Grid, grid: Grid) -> Distances:
    """What is left of a layer's weight, 0..1, (height, width): less towards its strips."""
    around = math.ceil(_FADE) + 1
    distances = _distances(~_padded(strip, cells, around))
    distances = distances[around : around + cells.height, around : around + cells.width]
    share = np.clip((distances * (grid.height / cells.height) - 0.5) / _FADE, 0, 1)
    return np.asarray(share * share * (3 - 2 * share), np.float32)

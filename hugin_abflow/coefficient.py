"""Distances and blend coefficients (kernels/coefficient.cl).

D_k(p) is the distance from p to the nearest union pixel that layer k does not cover, on the sphere as an
angle; w_k = D_k / sum_j D_j. For two layers this is Eq. 1 of Meng & Liu 2020.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import repeat
from typing import Any

import numpy as np
import numpy.typing as npt

from hugin_abflow.grid import Grid, Place
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.working import WorkingLayer

# Distances are smooth: a mask grid of this many pixels is fine enough, and four times faster.
_FINE_PIXELS = 600_000


@dataclass(frozen=True)
class Masks:
    """Which layer covers what, on the mask grid: uint8 (height, width), on the device and the host."""

    grid: Grid
    buffers: tuple[Buffer, ...]
    host: npt.NDArray[np.bool_]  # (layers, height, width)

    def only(self, indices: Sequence[int]) -> Masks:
        """The masks of some of the layers."""
        return Masks(self.grid, tuple(self.buffers[i] for i in indices), self.host[list(indices)])

    @property
    def shared(self) -> float:
        """The share of the grid that several layers cover."""
        return float((self.host.sum(0, dtype=np.uint16) > 1).mean())

    def overlap(self, first: int, second: int) -> npt.NDArray[np.bool_]:
        """What two layers both cover, (height, width)."""
        return np.asarray(self.host[first] & self.host[second])


class Overlaps(Sequence[npt.NDArray[np.bool_]]):
    """Where pairs of layers overlap, (height, width) on the mask grid. Each is made when it is asked for: all
    of 300 layers take gigabytes.
    """

    def __init__(self, masks: Masks, pairs: Sequence[tuple[int, int]]) -> None:
        self._masks, self._pairs = masks, pairs

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, index: Any) -> Any:  # of numbers only
        return self._masks.overlap(*self._pairs[index])


def masks(device: Device, layers: Sequence[WorkingLayer], grid: Grid) -> Masks:
    """The layers' masks; a mask pixel is covered if every working pixel under it is."""
    factor = 1 if grid.width * grid.height <= _FINE_PIXELS else 2
    mask_grid = grid.reduced(-(-grid.width // factor), -(-grid.height // factor))
    buffers = []
    for layer in layers:
        mask = device.empty(mask_grid.shape, np.uint8)
        device.run(
            "coefficient", "coefficient_mask", mask_grid.border.size, layer.pixels, layer.box, grid.border,
            mask_grid.border, mask,
        )  # fmt: skip
        buffers.append(mask)
    return Masks(mask_grid, tuple(buffers), np.stack([b.get() for b in buffers]).astype(bool))


def _table(grid: Grid) -> npt.NDArray[np.float32]:
    """Parts of the distance between two pixels of the mask grid, as coefficient.cl takes them."""
    rows, columns = np.arange(grid.height), np.arange(grid.width)
    if not grid.spherical:
        return np.concatenate([rows, columns, np.ones(grid.height)]).astype(np.float32)
    _, dlon, _, dlat = grid.lonlat
    parts = [np.sin(rows * dlat / 2), np.sin(columns * dlon / 2), grid.row_widths]
    return np.concatenate(parts).astype(np.float32)


def distance(device: Device, masks_: Masks, index: int, cover: Buffer, working: Grid) -> Buffer:
    """D_k of layer `index` in working pixels, float32 on the mask grid; `cover` is the union's mask."""
    grid = masks_.grid
    size = grid.border.size
    table = device.upload(_table(grid))
    seed, flooded = (device.empty(grid.shape, np.int32) for _ in range(2))
    mask = masks_.buffers[index]
    device.run("coefficient", "coefficient_seed", size, mask, cover, grid.border, seed)
    step = 1 << max(0, math.ceil(math.log2(max(size))) - 1)
    steps = [1]  # one fine pass first and two last mend nearly all that jump flooding misses
    while step:
        steps.append(step)
        step //= 2
    for jump in [*steps, 2, 1]:
        device.run("coefficient", "coefficient_flood", size, seed, grid.border, table, jump, flooded)
        seed, flooded = flooded, seed
    unit = 1 / working.lonlat[1] if working.spherical else working.width / grid.width
    furthest = math.pi / working.lonlat[1] if working.spherical else math.hypot(*working.shape)
    result = device.empty(grid.shape)
    device.run(
        "coefficient", "coefficient_distance", size,
        seed, mask, grid.border, table, int(working.spherical), unit, furthest, result,
    )  # fmt: skip
    return result


def _distances(device: Device, masks_: Masks, grid: Grid) -> Iterator[Buffer]:
    """D_k of each layer in turn."""
    cover = device.upload(np.logical_or.reduce(masks_.host, 0), np.uint8)
    for index in range(len(masks_.buffers)):
        yield distance(device, masks_, index, cover, grid)


def coefficients(
    device: Device, layers: Sequence[WorkingLayer], masks_: Masks, grid: Grid, even: bool = False
) -> list[Buffer]:
    """The blend coefficients w_k of all layers, float32 on their boxes of the working grid: 0 outside the
    layer, 1 where it is alone.

    even    equal shares where several layers are: enough where `transition.minimise_strain` then finds them,
            and done without distances, which take time.
    """
    total = device.zeros(grid.shape)
    ratio = (masks_.grid.width / grid.width, masks_.grid.height / grid.height)
    if even:
        maps: Iterable[Buffer] = repeat(device.empty(masks_.grid.shape).fill(1), len(layers))
    else:
        maps = _distances(device, masks_, grid)
    result = []
    for layer, on_masks in zip(layers, maps, strict=True):
        blend = device.empty(layer.pixels.shape[:2])
        device.run(
            "coefficient", "coefficient_expand", layer.box[2:], on_masks, masks_.grid.border, ratio,
            layer.pixels, layer.box, grid.border, blend, total,
        )  # fmt: skip
        result.append(blend)
    divide(device, [(layer.box, blend) for layer, blend in zip(layers, result, strict=True)], total, grid)
    return result


def divide(device: Device, values: Sequence[tuple[Place, Buffer]], total: Buffer, grid: Grid) -> None:
    """Divide what layers have, in place, by the sum of all: it sums to 1 then, where there is any.

    values      each layer's place on `grid`, and float32 (height, width) on it, 0 or more.
    total       float32 (height, width) on all of the grid.
    """
    for box, one in values:
        device.run("coefficient", "coefficient_ratio", box[2:], one, box, grid.border, total)

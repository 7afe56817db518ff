"""Where, and how quickly, the geometry changes over from one layer to the next (kernels/transition.cl).

Changing over bends the picture: a transition of width t that crosses a parallax of P px stretches or
squeezes it by P / t, its strain. The published coefficient changes over across the whole overlap, whatever
near things are in it. These are then shown between their places in the photos, and only as sharp and
straight as the flow is right. A retoucher would lead the transition around them. So the coefficients are
those that minimise

    sum_k  integral  (P^2 + P0^2) |grad w_k|^2  +  ((2 strain)^2 + b |grad f|^2) w_k (1 - w_k),

of all that sum to 1 and are 0 where layer k is not.

The first term is the strain. The second, a double well, is the price of each place that no photo shows as it
is. It is higher where flow f itself bends what is shown between its places in the photos, as along outlines
of near things and where f is wrong. Both together are a phase field (Modica and Mortola 1977; with this well
Blowey and Elliott 1991). A transition costs about the parallax that it meets along its length, so it runs
where there is little. It is pi P / (2 strain) wide, at which the strain is what is wanted, if f bends
nothing there and the overlap has room.

Exceptions:

- What shows nothing, such as a sky or a wall, counts as without parallax: flow spreads over it from what is
  beside it, but nobody sees it bend. So transitions run there, round posts and letters.
- Near things that end within an overlap are left to one photo.
- Where layers cannot be brought to one brightness (highlights.py) there is no well, and transitions of
  layers that reach beyond each other are as wide as the overlap.
- Layers of one and the same mask share it evenly.
- Where a layer ends shortly before the panorama's rim the strip beyond counts as if it were there (rim.py).
- In overlaps that are thinner than a cell, as in holes of masks, layers end hard at their borders.

The sum is minimised by relaxation on a pyramid of cells. On the coarsest the well is deepened step by step,
since without it there is a single minimum; the finer ones start from what the coarser ones have found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from hugin_abflow.cells import Mask
from hugin_abflow.coefficient import Masks, divide
from hugin_abflow.geometry import PairFlow
from hugin_abflow.grid import Grid, Place, cells_under, on_cells
from hugin_abflow.layer import Box
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.rim import Rim
from hugin_abflow.settings import Settings
from hugin_abflow.working import WorkingLayer

# Working pixels per cell of the grids on which transitions are found, from the coarsest to the finest.
_CELLS = (32, 16, 8, 4)
# P0, working pixels: flow is hardly more exact, and no transition is to be narrower.
_LEAST_PARALLAX = 2.0
# b: of the squared strain of the flow itself. With 1, which it would be if colours changed over as w does,
# transitions get so narrow that they are seen where there is no way around.
_BENT = 0.25
# Cells of the finest grid over which parallax and strain are averaged.
_SIGMA = 1.0
# Sweeps on each grid, at last with all of the well's depth.
_SWEEPS = 20
# How far each sweep goes: 1 to the least of a cell's parabola, more beyond it (over-relaxation).
_RELAXATION = 1.8
# Sweeps on the coarsest grid before there is a well.
_FIRST_SWEEPS = 100
# Parts of the well's depth that follow there, one after the other.
_DEPTHS = (0.25, 0.5, 0.75)
# Sweeps for each of these.
_DEEPER_SWEEPS = 30

Values = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Shares:
    """Coefficients by cells: of the layers that cover a cell wholly, if any does, else of those that reach
    into it. They are stored as compressed rows (kernels/transition.cl).

    first   where the shares of each cell begin; owner: the layer of each share.
    """

    cells: Grid
    first: Buffer
    owner: Buffer
    share: Buffer

    @classmethod
    def equal(cls, device: Device, cells: Grid, cover: Mask) -> Shares:
        """The same for all layers of a cell. cover: (layers, height, width)."""
        counts = cover.sum(0, dtype=np.int64).ravel()
        first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        owner = np.nonzero(cover.reshape(len(cover), -1).T)[1].astype(np.int32)
        share = np.repeat(1 / np.maximum(counts, 1), counts).astype(np.float32)
        return cls(cells, *(device.upload(one) for one in (first, owner, share)))


def wanted(flows: Sequence[PairFlow], settings: Settings) -> bool:
    """Whether coefficients of least strain are wanted: not without flow, nor with a strain of 0."""
    return settings.transition_strain > 0 and len(flows) > 0


def minimise_strain(
    device: Device,
    layers: Sequence[WorkingLayer],
    coefficients: Sequence[Buffer],
    flows: Sequence[PairFlow],
    masks: Masks,
    grid: Grid,
    settings: Settings,
    uneven: Values,
    rim: Rim | None = None,
) -> None:
    """Make coefficients those of least strain, in place; see `wanted`. What they were where several layers
    overlap does not count.

    uneven      where layers cannot be brought to one brightness, 0..1: (height, width) on any coarse grid
                over the same region.
    rim         strips that count as if layers reached over them; None: there are none.
    """
    grids = [grid.coarser(pixels) for pixels in _CELLS]
    covers = _covers(masks.host if rim is None else rim.reached(masks), grids)
    price, bent = _prices(device, layers, flows, masks, grid, grids[-1], covers[-1])
    if rim is not None:
        price, bent = _over_strips((price, bent), rim, grids[-1])
    shares: Shares | None = None
    for cells, cover in zip(grids, covers, strict=True):
        finer = Shares.equal(device, cells, cover)
        east, south = links(_means(price, cells), cover.max(0), cells)
        well = wells(cells, grid, settings.transition_strain, bent, uneven)
        system = tuple(device.upload(one) for one in (east, south, well))
        if shares is None:
            relax(device, finer, system, 0.0, _FIRST_SWEEPS)
            for depth in _DEPTHS:
                relax(device, finer, system, depth, _DEEPER_SWEEPS)
        else:
            device.run(
                "transition", "transition_refine", cells.border.size, shares.share, shares.first,
                shares.owner, shares.cells.border, finer.first, finer.owner, cells.border, finer.share,
            )  # fmt: skip
        shares = finer
        relax(device, shares, system, 1.0, _SWEEPS)
    assert shares is not None
    _expand(device, layers, coefficients, shares, grid)


def _covers(cover: Mask, grids: Sequence[Grid]) -> list[Mask]:
    """Which layers have a share in which cells of each grid, (layers, height, width).

    cover       where they are, on the masks' grid.
    """
    whole = part = cover
    result = []
    for cells in reversed(grids):
        whole, part = on_cells(whole, cells, np.logical_and), on_cells(part, cells, np.logical_or)
        result.append(np.where(whole.any(0), whole, part))
    return result[::-1]


def _prices(
    device: Device,
    layers: Sequence[WorkingLayer],
    flows: Sequence[PairFlow],
    masks: Masks,
    grid: Grid,
    cells: Grid,
    cover: Mask,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """P^2 + P0^2, in squared working px, and b |grad f|^2 in cells, (height, width); P and |grad f| are 0
    where no layer shows anything that may be seen there.
    """
    parallax, strain = (device.zeros(cells.shape) for _ in range(2))
    textures = [_texture(device, layer, grid, cells) for layer in layers]
    for flow in flows:
        chart = flow.chart
        device.run(
            "transition", "transition_parallax", cells.border.size, flow.forward, flow.backward,
            chart.border, chart.transform, masks.buffers[flow.a],
            masks.buffers[flow.b], masks.grid.border, *textures[flow.a], *textures[flow.b],
            grid.border, grid.lonlat, cells.border, parallax, strain,
        )  # fmt: skip
    several = (cover.sum(0) > 1).astype(np.float64)
    modes = ("nearest", "wrap" if cells.wraps else "nearest")
    around, length, bent = (
        scipy.ndimage.gaussian_filter(one * several, _SIGMA, mode=modes)
        for one in (1.0, np.sqrt(parallax.get().astype(np.float64)), strain.get())
    )
    counts = np.maximum(around, 1e-6)
    return np.square(length / counts) + _LEAST_PARALLAX**2, _BENT * (bent / counts)


def _over_strips(
    prices: tuple[npt.NDArray[np.float64], ...], rim: Rim, cells: Grid
) -> tuple[npt.NDArray[np.float64], ...]:
    """Prices (height, width) in strips as they are beside them: flow is not known there, and nothing would
    cost less than to lead a transition along a strip.
    """
    covered = on_cells(rim.covered[None], cells, np.logical_or)[0]
    unknown = on_cells(rim.anywhere[None], cells, np.logical_or)[0] | ~covered
    if unknown.all():
        return prices
    near = scipy.ndimage.distance_transform_edt(unknown, return_distances=False, return_indices=True)
    return tuple(np.where(unknown & covered, price[tuple(near)], price) for price in prices)


def _texture(device: Device, layer: WorkingLayer, grid: Grid, cells: Grid) -> tuple[Buffer, Place]:
    """The steepest slope of r, g or b in each cell that a layer is in, full scales per working px: float32
    (height, width); and which cells these are.
    """
    its = cells_under(Box.at(*layer.box), grid, cells)
    texture = device.empty((its.height, its.width))
    device.run(
        "transition", "transition_texture", (its.width, its.height), layer.pixels, layer.box, grid.border,
        cells.border, its.place, texture,
    )  # fmt: skip
    return texture, its.place


def _means(values: npt.NDArray[np.floating], cells: Grid) -> npt.NDArray[np.float64]:
    """Means, in cells, of values on another grid over the same region; of a coarser one the cell's own."""
    sums, counts = on_cells(np.stack([values, np.ones_like(values)]).astype(np.float64), cells, np.add)
    means: npt.NDArray[np.float64] = sums / counts
    return means


def links(price: npt.NDArray[np.float64], union: Mask, cells: Grid) -> tuple[Values, Values]:
    """What a difference of shares costs between a cell and the next column's, and the next row's: (height,
    width).

    By how long the border between them is over how far they lie apart, and the harmonic mean of the price.
    """
    rows = np.arange(cells.height)
    if cells.spherical:
        _, across, latitude, down = cells.lonlat
        heights = down / (across * cells.bounded_widths)
        widths = across / down * np.maximum(np.cos(latitude - (rows + 1) * down), 0.0)
    else:
        shape = cells.region.height / cells.height * cells.width / cells.region.width
        heights, widths = np.full(cells.height, shape), np.full(cells.height, 1 / shape)
    result = []
    for axis, ratio in ((1, heights), (0, widths)):
        there = union & np.roll(union, -1, axis)
        if axis == 0:
            there[-1] = False
        elif not cells.wraps:
            there[:, -1] = False
        mean = 2 / (1 / price + 1 / np.roll(price, -1, axis))
        result.append(np.where(there, ratio[:, None] * mean, 0.0).astype(np.float32))
    return result[0], result[1]


def wells(
    cells: Grid, grid: Grid, strain: float, bent: npt.NDArray[np.floating], uneven: npt.NDArray[np.floating]
) -> Values:
    """The sum of (2 strain)^2 and b |grad f|^2, times the area of each cell, in squared working px, (height,
    width); less where layers are uneven.

    bent    b |grad f|^2. uneven: 0..1. Both are (height, width) on any grid over the same region.
    """
    area = grid.width / cells.width * grid.height / cells.height * cells.bounded_widths
    alike = 1 - _means(uneven, cells)
    prices: Values = (((2 * strain) ** 2 + _means(bent, cells)) * area[:, None] * alike).astype(np.float32)
    return prices


def relax(device: Device, shares: Shares, system: tuple[Buffer, ...], depth: float, sweeps: int) -> None:
    """Sweeps over all cells, in place. system: links and wells; depth: the part of the wells that counts."""
    cells = shares.cells
    calls = [
        (shares.share, shares.first, shares.owner, cells.border, *system, depth, colour, _RELAXATION)
        for colour in (0, 1)
    ]
    size = (-(-cells.width // 2), cells.height)
    device.repeat("transition", "transition_relax", size, calls, sweeps)


def _expand(
    device: Device,
    layers: Sequence[WorkingLayer],
    coefficients: Sequence[Buffer],
    shares: Shares,
    grid: Grid,
) -> None:
    """The coefficients on the working grid, in place."""
    total = device.zeros(grid.shape)
    for index, (layer, one) in enumerate(zip(layers, coefficients, strict=True)):
        device.run(
            "transition", "transition_expand", layer.box[2:], one, layer.box, grid.border,
            shares.share, shares.first, shares.owner, shares.cells.border, index, total,
        )  # fmt: skip
    divide(device, [(layer.box, one) for layer, one in zip(layers, coefficients, strict=True)], total, grid)

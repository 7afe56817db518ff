"""The paper's iteration: layers are merged two at a time onto a growing mosaic (Code 1 of Meng & Liu 2020).

For comparison. The mosaic is resampled again with each layer, and the result depends on the order:
the pair that overlaps most comes first, then always the layer that overlaps the mosaic most.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from hugin_abflow import coefficient, geometry, joint, working
from hugin_abflow.blend import Prepared
from hugin_abflow.grid import full_grid, working_grid
from hugin_abflow.guides import Guide
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.opencl import Device
from hugin_abflow.progress import Progress, silent
from hugin_abflow.settings import Settings


def merge(
    device: Device,
    layers: Sequence[Layer],
    canvas: Canvas,
    settings: Settings,
    progress: Progress,
    guides: Sequence[Guide] = (),
) -> Generator[npt.NDArray[Any], None, None]:
    """The panorama's crop, in bands as `joint.merge` gives them."""
    layers = [replace(layer) for layer in layers]  # one may be given twice, and each is told by what it is
    order = _order(device, layers, canvas, settings)
    if len(order) > 2:  # a mosaic was seen from several places: what stands still moves in several ways
        settings = replace(settings, movers=False, foreground=False)
    mosaic = layers[order[0]]
    guides = list(guides) if settings.guides else []
    with progress("merge", len(order) - 1) as advance:
        for step in range(1, len(order) - 1):
            inside, index = order[:step], order[step]
            mosaic, guides = _merge_two(
                device, mosaic, layers[index], canvas, settings, guides, inside, index
            )
            advance(1)
    last = [mosaic] if len(order) == 1 else [mosaic, layers[order[-1]]]
    between = _between(guides, order[:-1], order[-1])
    yield from joint.merge(device, last, canvas, settings, progress, between)


def _order(device: Device, layers: Sequence[Layer], canvas: Canvas, settings: Settings) -> list[int]:
    """Indices of the layers by overlap."""
    grid = working_grid(full_grid(canvas, layers), settings)
    reduced = [working.reduce_layer(device, layer, grid, lambda rows: None) for layer in layers]
    masks = coefficient.masks(device, reduced, grid).host.reshape(len(layers), -1).astype(np.float32)
    shared = masks @ masks.T
    np.fill_diagonal(shared, -1)
    first = int(np.argmax(shared.max(1)))
    order, rest = [first], set(range(len(layers))) - {first}
    mosaic = masks[first] > 0
    while rest:
        best = max(sorted(rest), key=lambda i: float(np.count_nonzero(mosaic & (masks[i] > 0))))
        order.append(best)
        rest.remove(best)
        mosaic |= masks[best] > 0
    return order


def _between(guides: Sequence[Guide], inside: Sequence[int], index: int) -> list[Guide]:
    """Guides between the layers of the mosaic and layer `index`, as those of layers 0 and 1."""
    turned = [replace(g, a=g.b, b=g.a, at_a=g.at_b, at_b=g.at_a) if g.a == index else g for g in guides]
    return [replace(g, a=0, b=1) for g in turned if g.a in inside and g.b == index]


def _merge_two(
    device: Device,
    mosaic: Layer,
    layer: Layer,
    canvas: Canvas,
    settings: Settings,
    guides: Sequence[Guide],
    inside: Sequence[int],
    index: int,
) -> tuple[Layer, list[Guide]]:
    """Two layers as one, over their common bounding box; and the guides, moved with what they are on.

    inside, index   numbers of the layers in the mosaic, and of the other, as guides have them.
    """
    region = full_grid(canvas, [mosaic, layer]).region
    whole = replace(canvas, crop=region)
    between = _between(guides, inside, index)
    prepared = joint.prepare_in_memory(device, [mosaic, layer], whole, settings, silent, between)
    pixels = np.concatenate(list(joint.bands(device, prepared, whole, settings, silent)))
    merged = Layer.from_array(f"{mosaic.name}+{layer.name}", pixels, region.left, region.top, mosaic.icc)
    for numbers, one in ((inside, mosaic), ([index], layer)):
        guides = _moved(guides, numbers, one, prepared)
    return merged, list(guides)


def _moved(guides: Sequence[Guide], numbers: Sequence[int], layer: Layer, prepared: Prepared) -> list[Guide]:
    """The guides, with the ends on `layer` (one of `numbers`) where the mosaic shows them."""
    (placed,) = (one for one in prepared.layers if one.layer is layer)
    ends = [end for g in guides for end, number in ((g.at_a, g.a), (g.at_b, g.b)) if number in numbers]
    if not ends:
        return list(guides)
    shown = iter(geometry.shown_at(placed.box, placed.field, prepared.grid, np.array(ends)).tolist())
    return [
        replace(
            g,
            at_a=tuple(next(shown)) if g.a in numbers else g.at_a,
            at_b=tuple(next(shown)) if g.b in numbers else g.at_b,
        )
        for g in guides
    ]

"""The paper's iteration: layers are merged two at a time onto a growing mosaic (Code 1 of Meng & Liu 2020).

For comparison. The mosaic is resampled again with each layer, and the result depends on the order:
the pair that overlaps most comes first, then always the layer that overlaps the mosaic most.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from hugin_abflow import coefficient, joint, working
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.opencl import Device
from hugin_abflow.progress import Progress, silent
from hugin_abflow.settings import Settings


def merge(
    device: Device, layers: Sequence[Layer], canvas: Canvas, settings: Settings, progress: Progress
) -> Iterator[npt.NDArray[Any]]:
    """The panorama's crop, in bands as `joint.merge` gives them."""
    order = _order(device, layers, canvas, settings)
    mosaic = layers[order[0]]
    with progress("merge", len(order) - 1) as advance:
        for index in order[1:-1]:
            mosaic = _merge_two(device, mosaic, layers[index], canvas, settings)
            advance(1)
    last = [mosaic] if len(order) == 1 else [mosaic, layers[order[-1]]]
    yield from joint.merge(device, last, canvas, settings, progress)


def _order(device: Device, layers: Sequence[Layer], canvas: Canvas, settings: Settings) -> list[int]:
    """Indices of the layers by overlap."""
    grid = working.working_grid(working.full_grid(canvas, layers), settings)
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


def _merge_two(device: Device, mosaic: Layer, layer: Layer, canvas: Canvas, settings: Settings) -> Layer:
    """Two layers as one, over their common bounding box."""
    region = working.full_grid(canvas, [mosaic, layer]).region
    whole = replace(canvas, crop=region)
    pixels = np.concatenate(list(joint.merge(device, [mosaic, layer], whole, settings, silent)))
    return Layer.from_array(f"{mosaic.name}+{layer.name}", pixels, region.left, region.top, mosaic.icc)

"""What cuts take of the memory where layers are many: no more than is reckoned (budget.py)."""

from __future__ import annotations

import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.ndimage
import scipy.sparse.csgraph  # noqa: F401  (it is loaded where it is needed, and would count)
from grids import plane

from hugin_abflow import coefficient, seam
from hugin_abflow.colour import Correction
from hugin_abflow.geometry import Pair
from hugin_abflow.grid import on_cells
from hugin_abflow.opencl import Device
from hugin_abflow.regions import Residuals
from hugin_abflow.scene import Scene

COLUMNS, ROWS = 12, 8
SIDE, STEP = 72, 48  # px of layers


def scene(device: Device) -> Scene:
    """Layers in rows and columns that overlap by a third, in which they differ."""
    grid = plane(STEP * (COLUMNS - 1) + SIDE, STEP * (ROWS - 1) + SIDE)
    random = np.random.default_rng(1)
    layers, fields = [], []
    for k in range(COLUMNS * ROWS):
        box = STEP * (k % COLUMNS), STEP * (k // COLUMNS), SIDE, SIDE
        pixels, field = random.random((2, SIDE, SIDE, 4), np.float32)
        pixels[..., 3], field[..., :3] = 1, 0
        layers.append(SimpleNamespace(box=box, pixels=device.upload(pixels), clips_at=(1.0, 1.0, 1.0)))
        fields.append(device.upload(field))
    pairs = [
        Pair(k, k + more)
        for k in range(COLUMNS * ROWS)
        for more in (1, COLUMNS)
        if k + more < len(layers) and (more > 1 or (k + 1) % COLUMNS)
    ]
    return Scene(device, layers, pairs, fields, coefficient.masks(device, layers, grid), grid)


@pytest.mark.parametrize("aligned", [True, False])
def test_cuts_take_no_more_memory_than_is_reckoned(device: Device, aligned: bool) -> None:
    """Of the host's: tracemalloc knows what NumPy takes."""
    its = scene(device)
    cells = seam.seam_grid(its.grid)
    correction = Correction(its.grid.resized(4, 4), 1.0, (None,) * len(its.layers))
    room = seam.room(its.grid, aligned, len(its.layers), its.masks.shared)
    whole = on_cells(its.masks.host, cells, np.logical_or).sum(0) > 1
    residual = Residuals(*np.random.default_rng(2).random((2, *cells.shape)))
    tracemalloc.start()
    try:
        if aligned:
            seam.cut(its, residual, whole)
        else:
            seam.cut_unaligned(its, correction)
        taken = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert 0.5 * room < taken < room

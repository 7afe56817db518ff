"""Rows of coarse arrays: what a band reads is there, and nothing else is copied."""

from __future__ import annotations

import math

import numpy as np
import pytest
from bands import blend_layer, merged, stored_pixels
from grids import plane

from hugin_abflow.blend import BlendLayer
from hugin_abflow.layer import Box
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.slices import Band, Slices, coarse_rows

GRID = plane(40, 30).reduced(20, 15)  # two rows of the panorama each
BOXES = [(3, 0, 5, 4), (0, 3, 20, 12), None, (7, 11, 2, 3), (1, 14, 1, 1)]


def read(first: int, last: int, box: tuple[int, int, int, int]) -> bool:
    """Whether any row of an array is one that a band of rows reads between."""
    return any(first // 2 - 1 <= row < math.ceil(last / 2) + 2 for row in range(box[1], box[1] + box[3]))


@pytest.mark.parametrize("everywhere", [False, True])
@pytest.mark.parametrize("height", [1, 3, 8, 30])
def test_a_band_has_the_rows_that_it_reads(device: Device, everywhere: bool, height: int) -> None:
    """Of layers that it samples at least one, however far their arrays are; of others where it needs any."""
    random = np.random.default_rng(height)
    arrays = [None if box is None else random.random((box[3], box[2], 4), np.float32) for box in BOXES]
    plan = [
        Band(Box.at(0, top, 40, min(height, 30 - top)), tuple((0, int(n)) for n in random.integers(0, 2, 5)))
        for top in range(0, 30, height)
    ]
    given = [box and (box, device.upload(array)) for box, array in zip(BOXES, arrays, strict=True)]
    slices = Slices(device, given, GRID, plan, everywhere)
    for band in plan:
        places, values = slices.take(band), slices.values.get()
        assert places.dtype == np.int32 and not places[:, 5:].any()
        for place, box, array, (_, sampled) in zip(places.tolist(), BOXES, arrays, band.rows, strict=True):
            if box is None:
                assert place[3:5] == [0, -1]
                continue
            if not (sampled or (everywhere and read(band.part.top, band.part.bottom, box))):
                assert place[3] == 0
                continue
            first, last = coarse_rows(box, band.part, 2.0)
            assert place[:4] == [box[0], first, box[2], last - first] and last > first
            found = values[place[4] : place[4] + box[2] * (last - first)]
            assert np.array_equal(found.reshape(-1, box[2], 4), array[first - box[1] : last - box[1]])


def column(device: Device, count: int) -> list[BlendLayer]:
    """Layers of 12 rows, each beginning 8 rows below the one before; with gains and offsets."""
    full = plane(64, 8 * count + 4)
    gain, offset = np.full((5, 7, 4), 0.1, np.float32), np.full((13, 24, 4), 0.01, np.float32)
    return [
        blend_layer(
            device, stored_pixels(k, 64, 12, np.uint8, 3, 1.0), 0, 8 * k, full, full,
            gain=gain, offset=offset,
        )
        for k in range(count)
    ]  # fmt: skip


def test_nothing_is_copied_of_layers_that_are_not_near(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For each band three arrays of each layer were, of 300 layers on a large canvas for minutes."""
    count, copies, real = 20, 0, Buffer.copy

    def counted(self: Buffer, *places: object) -> None:
        nonlocal copies
        copies += 1
        real(self, *places)

    layers, full = column(device, count), plane(64, 8 * count + 4)
    monkeypatch.setattr(Buffer, "copy", counted)
    merged(device, layers, full, full, rows=4)
    bands = -(-full.height // 4)
    assert 3 * bands <= copies <= 3 * 3 * bands


@pytest.mark.parametrize("rows", [4, 7, 19])
def test_what_a_layer_with_nothing_of_its_own_shows_does_not_depend_on_bands(
    device: Device, rows: int
) -> None:
    """Its field is a single value, at its top, that bands far below read as well."""
    full = plane(64, 84)
    layers = column(device, 10)
    alone = blend_layer(device, stored_pixels(3, 64, 84, np.uint8, 3, 1.0), 0, 0, full, full)
    field = device.upload(np.array([[[0, 0, 0, -1e30]]], np.float32))
    for k in (3, 6):  # gaps, in which it is all there is
        layers[k] = blend_layer(device, 0 * stored_pixels(k, 64, 12, np.uint8, 3, 1.0), 0, 8 * k, full, full)
    layers.append(BlendLayer(alone.layer, (0, 0, 1, 1), field, [0.0], None, None))
    whole = merged(device, layers, full, full, rows=84)
    assert whole[..., 3].all()
    assert np.array_equal(merged(device, layers, full, full, rows=rows), whole)

"""The full-resolution pass: which rows it holds, and how many."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from bands import blend_layer, merged, stored_pixels
from grids import plane

from hugin_abflow import blend
from hugin_abflow.blend import Prepared
from hugin_abflow.layer import Layer
from hugin_abflow.opencl import Device
from hugin_abflow.settings import Settings


def test_bands_are_as_high_as_memory_allows(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """The result is the same; what cannot be kept is told."""
    full = plane(500, 400)
    grid = full.resized(50, 40)
    pixels = stored_pixels(30, 500, 400, np.uint8, 3, 0.9)
    layers = [blend_layer(device, pixels, 0, 0, full, grid)] * 2
    cells = grid.resized(7, 5)
    heights, results, warnings = [], [], []
    monkeypatch.setattr(blend, "_SLACK", 0)
    monkeypatch.setattr(blend.memory, "resident", lambda: 0)
    monkeypatch.setattr(blend._log, "warning", lambda *said: warnings.append(said))
    for limit in (0, 6 << 20, 3 << 20, 1 << 18):
        settings = Settings(max_memory=limit)
        prepared = Prepared(tuple(layers), full, grid, cells, cells, 1.0)
        parts = list(blend.bands(device, prepared, full.region, settings, lambda units: None))
        heights.append(len(parts[0]))
        results.append(np.concatenate(parts))
    assert heights[0] == 400 > heights[1] > heights[2] > heights[3] == blend._LEAST_ROWS
    assert all(np.array_equal(result, results[0]) for result in results)
    assert len(warnings) == 1


@pytest.mark.parametrize(("kind", "rows"), [("CPU", 8), ("GPU", 32)])
def test_bands_are_higher_on_graphics_cards(
    device: Device, kind: str, rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which start slowly; the same bytes."""
    full = plane(77, 53)
    grid = full.resized(31, 23)
    layers = [blend_layer(device, stored_pixels(31, 77, 53, np.uint8, 3, 0.9), 0, 0, full, grid)]
    monkeypatch.setattr(Device, "kind", kind)
    for name, per_row in (("_BAND_PIXELS", 8), ("_BAND_PIXELS_ON_CARD", 32)):
        monkeypatch.setattr(blend, name, per_row * 77)

    def parts(settings: Settings) -> list[np.ndarray]:
        cells = grid.resized(7, 5)
        prepared = Prepared(tuple(layers), full, grid, cells, cells, 1.0)
        return list(blend.bands(device, prepared, full.region, settings, lambda units: None))

    result = parts(Settings())
    assert len(result[0]) == rows
    assert np.array_equal(np.concatenate(result), np.concatenate(parts(Settings(band_rows=5))))


def test_layers_that_no_band_needs_together_share_memory() -> None:
    """A column of many small layers takes no more than those that meet; none lies over another in use."""
    pixels = np.zeros((20, 30, 4), np.uint8)
    layers = [Layer.from_array("l", pixels, 0, 15 * k) for k in range(40)]
    spans = [
        [(max(0, top - layer.box.top), max(0, min(20, top + 10 - layer.box.top))) for layer in layers]
        for top in range(0, 605, 10)
    ]
    spans = [[(a, b) if a < b else (0, 0) for a, b in band] for band in spans]
    shelves = blend._shelves(layers, spans)
    assert shelves.total <= 3 * 20 * 30
    for band in spans:
        used = [k for k, (start, end) in enumerate(band) if start < end]
        taken = sorted((shelves.rings[k].start, shelves.rings[k].rows * 30) for k in used)
        assert all(a + size <= b for (a, size), (b, _) in pairwise(taken))
        assert all(shelves.rings[k].rows >= band[k][1] - band[k][0] for k in used)


@pytest.mark.parametrize("share", [1.0, 0.9])
def test_bands_hold_the_rows_around_those_that_are_sampled(device: Device, share: float) -> None:
    """All moves sideways, so that displacements reach no other row, but what lies between pixels does."""
    full = plane(77, 53)
    grid = full.resized(39, 27)
    field = np.zeros((27, 39, 4), np.float32)
    field[..., 0], field[..., 3] = 1.3, 1
    layer = blend_layer(device, stored_pixels(31, 77, 53, np.uint8, 3, share), 0, 0, full, grid, field)
    assert not any(layer.reach)
    whole = merged(device, [layer, layer], full, grid)
    for rows in (1, 2, 7):
        assert np.array_equal(merged(device, [layer, layer], full, grid, rows=rows), whole), rows


@pytest.mark.parametrize(
    ("dtype", "alphas"),
    [
        (np.uint8, ([0, 80, 127], [128, 150, 255])),
        (np.uint16, ([0, 20_000, 32_767], [32_768, 40_000, 65_535])),
        (np.float32, ([0, 0.3, 0.499], [0.5, 0.6, 1])),
    ],
)
@pytest.mark.parametrize("moved", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("count", [1, 2])
def test_pixels_count_from_half_of_full_alpha_on(
    device: Device, dtype: type, alphas: tuple[list[float], list[float]], moved: float, count: int
) -> None:
    """As if it were binary, whether rows are copied or sampled, and whether another layer is there."""
    full = plane(77, 53)
    field = np.zeros((53, 77, 4), np.float32)
    field[..., 0], field[..., 3] = moved, 1
    pixels = [stored_pixels(40 + k, 77, 53, dtype, 3, 0.9) for k in range(count)]
    expected = merged(
        device, [blend_layer(device, own, 0, 0, full, full, field) for own in pixels], full, full
    )
    for own in pixels:
        outside, inside = (np.random.default_rng(50).choice(some, (53, 77)) for some in alphas)
        own[..., 3] = np.where(own[..., 3] > 0, inside, outside)
    soft = [blend_layer(device, own, 0, 0, full, full, field) for own in pixels]
    assert np.array_equal(merged(device, soft, full, full), expected)


@pytest.mark.parametrize(("far", "strip"), [(0.0, 1), (9.0, 1), (9.0, 16)])
def test_a_band_reads_only_rows_that_it_needs(device: Device, far: float, strip: int) -> None:
    """Memory grows with the band, not with the picture; and no row is read twice, where one band reaches far
    back either. Where a file decodes strips, whole ones are asked for."""
    full = plane(77, 300)
    grid = full.resized(39, 150)
    pixels = stored_pixels(14, 77, 300, np.uint8, 3, 1)
    asked: list[tuple[int, int]] = []
    field = np.zeros((150, 39, 4), np.float32)
    field[..., 3] = 1
    field[70, :, 1] = -far
    layer = blend_layer(device, pixels, 0, 0, full, grid, field)
    watched = Layer(
        "w", layer.layer.box, np.dtype(np.uint8), 3,
        lambda top, bottom: (asked.append((top, bottom)), pixels[top:bottom])[1], strip=strip,
    )  # fmt: skip
    layers = [replace(layer, layer=watched)] * 2
    assert np.array_equal(merged(device, layers, full, grid, rows=10), pixels) == (far == 0)
    assert max(bottom - top for top, bottom in asked) <= 10 + 2 * (3 + 2 * far) + strip - 1
    assert all(top % strip == 0 for top, _ in asked)
    rows = [row for top, bottom in asked for row in range(top, bottom)]
    assert sorted(rows) == sorted([*range(300)] * 2)

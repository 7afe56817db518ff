"""The full-resolution pass: kernels against twins, twins against loops, bands against the whole."""

from __future__ import annotations

import math

import numpy as np
import pytest
from bands import blend_layer, field_of, merged, stored_pixels
from grids import patches, plane, sphere
from reference import blend as twin
from reference import common
from reference.hidden import hidden_mark
from scipy import ndimage
from tolerances import DECISIONS, POSITION, assert_close

from hugin_abflow import blend, working
from hugin_abflow.grid import Grid
from hugin_abflow.layer import Box, Layer, full_scale
from hugin_abflow.opencl import Device

STORED = [(dtype, channels) for dtype in (np.uint8, np.uint16, np.float32) for channels in (1, 3)]
GRIDS = {"plane": plane(), "cylinder": plane(wraps=True), "sphere": sphere(), "odd sphere": sphere(77, 39)}
BLOCK = 16
MARK = 0xABAD1DEA  # where nothing is written


def options_of(layer: Layer, together: int) -> tuple[str, float]:
    pixel, white = working.pixel_options(layer)
    integer = int(layer.dtype.kind == "u")
    return f"{pixel} -DWHITE={white:.1f}f -DINTEGER={integer} -DPIXELS={together} -DBLOCK={BLOCK}", white


def test_twin_of_sample_is_what_its_words_say() -> None:
    """Bicubic where 16 taps are valid, else the mean of the valid ones of four and their share."""
    rows = stored_pixels(0, 40, 30, np.uint8, 3, 0.9)
    pixels = twin.opaque(rows, 255.0)
    random = np.random.default_rng(1)
    x, y = random.random((2, 300)) * [[44], [34]] - 2
    result = twin.sample(pixels, (0, 0, 40, 30), x, y, (40, 30, 0, 0), 0, 255)
    kinds = set()
    for u, v, value in zip(x - 0.5, y - 0.5, result, strict=True):
        taps, near = {}, []
        for j in range(math.floor(v) - 1, math.floor(v) + 3):
            for i in range(math.floor(u) - 1, math.floor(u) + 3):
                if 0 <= i < 40 and 0 <= j < 30 and pixels[j, i, 3]:
                    taps[i, j] = pixels[j, i, :3]
                    if abs(i - u) < 1 and abs(j - v) < 1:
                        near.append(((1 - abs(i - u)) * (1 - abs(j - v)), pixels[j, i, :3]))
        share = sum(weight for weight, _ in near)
        if len(taps) == 16:
            ax = common.cubic_taps(np.array(u - math.floor(u)), twin.SLOPE)
            ay = common.cubic_taps(np.array(v - math.floor(v)), twin.SLOPE)
            expected = sum(
                ax[i - math.floor(u) + 1] * ay[j - math.floor(v) + 1] * colour
                for (i, j), colour in taps.items()
            )
            assert np.allclose(value, [*expected, 1])
        elif share > 0:
            assert np.allclose(value, [*(sum(w * c for w, c in near) / share), share])
        else:
            assert not value.any()
        kinds.add((len(taps) == 16, share > 0))
    assert kinds == {(True, True), (False, True), (False, False)}


def test_twin_of_field_reading_is_scipys() -> None:
    """One turn wide it wraps, else it repeats its rim."""
    field = np.random.default_rng(2).normal(size=(31, 41, 4))
    x, y = np.random.default_rng(3).random((2, 400)) * [[45], [35]] - 2
    for wraps, width in ((1, 41), (0, 41), (1, 60)):
        left = 0 if width == 41 else 7
        read = twin.read_field(field, (left, 0, 41, 31), x + left, y, (width, 31, wraps, 0))
        wide = np.pad(field, ((4, 4), (0, 0), (0, 0)), mode="edge")
        wide = np.pad(wide, ((0, 0), (4, 4), (0, 0)), mode="wrap" if wraps and width == 41 else "edge")
        for i in range(4):
            assert np.allclose(read[:, i], ndimage.map_coordinates(wide[..., i], [y + 3.5, x + 3.5], order=1))


def test_twin_of_position_turns_by_an_angle() -> None:
    """Half a pixel of longitude is half a pixel; over the pole the way goes on, half a turn further."""
    lonlat = sphere(402, 201).lonlat
    x, y = np.array([10.5, 200.5, 401.9, 33.0]), np.array([100.5, 3.0, 100.5, 2.0])
    there = np.array([11.0, 200.5, 402.4, 33.0]), np.array([100.5, 9.0, 100.0, -3.0])
    way = common.canvas_point(*there, lonlat) - common.canvas_point(x, y, lonlat)
    u, v = twin.position(x, y, way, (1, 1), lonlat)
    assert np.allclose(np.mod(u, 402), [11.0, 200.5, 0.4, 33 + 201])
    assert np.allclose(v, [100.5, 9.0, 100.0, 3.0])
    assert np.allclose(
        twin.position(x, y, way, (1.5, 2), (0, 0, 0, 0)), [x + 1.5 * way[:, 0], y + 2 * way[:, 1]]
    )


@pytest.mark.parametrize(("dtype", "channels"), STORED)
@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize(("nearest", "together", "width"), [(0, 2, 71), (0, 4, 71), (0, 4, 69), (1, 4, 70)])
def test_a_band_of_three_layers_equals_its_twin(
    device: Device, dtype: type, channels: int, name: str, nearest: int, together: int, width: int
) -> None:
    """They overlap in part, reach across the border, differ in exposure and are raised; some is hidden."""
    full = GRIDS[name]
    grid, cells, halves = full.resized(48, 25), full.resized(7, 5), full.resized(24, 13)
    places = [(3, 0, 50, 37), (0, 5, full.width, 34), (21, 2, 40, 30)]
    boxes = [(2, 0, 31, 24), (0, 3, 48, 22), (12, 1, 26, 20)]
    band, origin, share = (2, 1, width, 36), (1301, 77), 0.05
    shoulder, unit = (0.0, 0.3) if dtype == np.float32 else (0.75, 1.0)
    fields = [field_of(7 + i, grid, box, 1.5) for i, box in enumerate(boxes)]
    fields[2][..., 3] *= 0.02
    gains: list[np.ndarray | None] = [None]
    for seed in (9, 10):
        gain = np.random.default_rng(seed).normal(size=(5, 7, 4)).astype(np.float32) * 0.2
        gain[:, :3] = 0
        gains.append(gain)
    spans = [(0, 0, 24, 13), (9, 1, 15, 11)]
    offsets = [np.random.default_rng(20 + i).normal(size=(box[3], box[2], 4)) for i, box in enumerate(spans)]
    offsets = [(0.15 * offset).astype(np.float32) for offset in offsets]
    for offset in offsets:
        offset[:, :4] = 0
    stored = [stored_pixels(5 + i, p[2], p[3], dtype, channels, 0.95) for i, p in enumerate(places)]
    for rows in stored:
        rows[12:24, 20:34, :-1] = 0.02 * full_scale(dtype)  # beside this the cubic swings below it
        if dtype == np.float32:
            rows[26:29, 5:36, :-1] -= 0.8
    options, white = options_of(Layer.from_array("a", stored[0]), together)
    marked_fields = [field.astype(np.float32) for field in hidden_mark(fields, boxes, share)]

    table = np.zeros((3, 24), np.int32)
    table[:, :4], table[:, 4:8], table[:, 8:12] = places, boxes, (0, 0, 7, 5)
    table[:, 12:16] = spans[0], (0, 0, 0, 0), spans[1]  # the second layer has none
    table[:, 16] = np.cumsum([0, *(box[2] * box[3] for box in boxes)])[:3]
    table[:, 17] = -1, 0, 7 * 5
    table[:, 18] = 0, -1, 24 * 13
    # rings of as many rows as there are, or more; they begin anywhere
    rings, turns = [p[3] + spare for p, spare in zip(places, (0, 3, 1), strict=True)], (0, 30, 17)
    table[:, 19:21] = list(zip(rings, turns, strict=True))
    table[:, 22] = np.cumsum([0, *(p[2] * ring for p, ring in zip(places, rings, strict=True))])[:3]
    turned = [
        np.roll(np.pad(rows, ((0, ring - len(rows)), (0, 0), (0, 0))), turn, 0)
        for rows, ring, turn in zip(stored, rings, turns, strict=True)
    ]
    x, y = (a + 0.5 for a in (np.arange(2, 2 + width), np.arange(1, 37)))
    angles = full.lonlat[0] + x * full.lonlat[1], full.lonlat[2] - y * full.lonlat[3]
    axes = [device.upload(np.stack([np.sin(a), np.cos(a)], -1).astype(np.float32)) for a in angles]
    out = device.zeros((37, width, channels + 1), dtype)  # a row more than is made
    packed = [
        np.concatenate([a.reshape(-1, a.shape[-1]) for a in arrays])
        for arrays in (turned, marked_fields, gains[1:], offsets)
    ]
    rows, lines, factors, summands = (device.upload(a) for a in packed)
    touched, blocks = device.upload(table), -(-width // BLOCK)
    marks = device.empty((band[3] + 1, blocks, 2, 1), np.uint32).fill(MARK)
    device.run(
        "blend", "blend_mark", (blocks, band[3]), rows, touched, 3, lines, full.border, grid.border, band, 1,
        marks, options=options,
    )  # fmt: skip
    marked = [
        twin.blend_mark(stored, places, marked_fields, boxes, full.border, grid.border, band, BLOCK, white),
        np.full((36, blocks, 2, 1), 0b111),
    ]
    assert np.array_equal(marks.get(), np.concatenate([marked[0], np.full((1, blocks, 2, 1), MARK)]))
    assert 0 < (marked[0] != 0b111).mean() < 1
    strips = full.resized(39, 20)
    told = np.zeros(strips.shape, np.uint8)
    told[:, 9:17] = 1
    carried = device.upload(told)
    made = []
    for given in marked:
        device.run(
            "blend", "blend_band", (-(-width // together), band[3]), rows, touched, 3, lines, factors,
            summands, *axes, full.border, full.lonlat, grid.border, cells.border, halves.border, band, origin,
            shoulder, unit**0.5, nearest, share, device.upload(given.astype(np.uint32)), 1,
            carried, strips.border, out, options=options,
        )  # fmt: skip
        made.append(out.get())
    assert np.array_equal(*made)  # what is not marked changes nothing
    raised = [(spans[0], offsets[0]), None, (spans[1], offsets[1])]
    expected = twin.blend_band(
        stored, places, marked_fields, boxes, gains, raised, full.border, full.lonlat, grid.border,
        cells.border, halves.border, band, origin, shoulder, unit, nearest, share, white, told,
    )  # fmt: skip
    result, beyond = np.split(made[0], [36])
    assert not beyond.any()
    assert 0.6 < (expected[..., -1] > 0).mean() < 1
    assert np.array_equal(result[..., -1] > 0, expected[..., -1] > 0)
    # smooth pixels change by a third of full scale from one to the next; nearest ones by a step
    if white == 1:
        assert_close(result, expected, 10 * POSITION, 2 * DECISIONS)
    else:  # what is halfway between two levels may go to either
        off = np.abs(result - expected)
        assert (off > max(1, 10 * POSITION * white)).mean() <= 2 * DECISIONS
        assert (off > 0).mean() <= (5 * DECISIONS if white == 255 else 0.3)


def test_what_nobody_sees_changes_nothing(device: Device) -> None:
    """A share below a quarter of a level; one that is seen counts in full."""
    full = plane()
    grid = full.resized(31, 17)
    dark, bright = (np.full((53, 77, 4), value, np.uint16) for value in (20_000, 60_000))
    for pixels in dark, bright:
        pixels[..., 3] = 65535
    for share, expected in ((3e-6, 20_000), (1e-4, 20_004)):
        field = np.zeros((17, 31, 4), np.float32)
        field[..., 3] = 1
        layers = [blend_layer(device, dark, 0, 0, full, grid, field)]
        layers.append(blend_layer(device, bright, 0, 0, full, grid, field * share))
        assert (merged(device, layers, full, grid)[..., 0] == expected).all()


def test_what_is_hidden_shows_where_nothing_else_does(device: Device) -> None:
    """The layer that counts is sampled outside itself: there the one under it is seen, moved as it says."""
    full = plane()
    grid = full.resized(77, 53)
    pixels = [stored_pixels(40 + i, 77, 53, np.uint8, 3, 1) for i in (0, 1)]
    lost, under = (np.zeros((53, 77, 4), np.float32) for _ in range(2))
    lost[...] = 500, 0, 0, 1
    under[...] = 3, 0, 0, 1e-5
    layers = [blend_layer(device, p, 0, 0, full, grid, f) for p, f in zip(pixels, (lost, under), strict=True)]
    np.testing.assert_array_equal(merged(device, layers, full, grid)[:, :73], pixels[1][:, 3:76])


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_bands_of_any_height_give_the_same(device: Device, name: str, dtype: type) -> None:
    """Bit for bit: a band gets all rows that its own displacements reach, over poles too."""
    full = GRIDS[name]
    grid = full.resized(48, 25)
    field = field_of(10, grid, (0, 0, 48, 25), 4.0)
    faint = field * np.float32([1, 1, 1, 2e-3 if dtype == np.uint8 else 3e-5])  # some hidden, some not
    gain = np.random.default_rng(11).normal(size=(5, 7, 4)).astype(np.float32) * 0.2
    offset = np.random.default_rng(14).normal(size=(13, 24, 4)).astype(np.float32) * 0.1
    layers = [
        blend_layer(
            device, stored_pixels(12, full.width, full.height, dtype, 3, 0.9), 0, 0, full, grid, field
        ),
        blend_layer(device, stored_pixels(13, 50, 31, dtype, 3, 0.9), 9, 3, full, grid, -field, gain, offset),
        blend_layer(device, stored_pixels(15, 40, 29, dtype, 3, 0.9), 20, 2, full, grid, faint),
    ]
    whole = merged(device, layers, full, grid)
    assert whole.shape == (full.height, full.width, 4)
    for rows in (1, 2, 5, 13, 38):
        assert np.array_equal(merged(device, layers, full, grid, rows=rows), whole), rows


def test_what_nobody_sees_is_marked_in_the_rows_that_a_band_reads(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    full, parts = GRIDS["sphere"], []
    grid = full.resized(48, 25)
    layer = blend_layer(device, stored_pixels(1, 78, 39, np.uint8, 3, 1.0), 0, 0, full, grid)
    monkeypatch.setattr(blend.hidden, "mark", lambda *given: parts.append(given[3]))
    merged(device, [layer], full, grid, rows=10)
    for (left, first, width, height), top in zip(parts, (0, 10, 20, 30), strict=True):
        begin, end = (np.array([top, min(top + 10, 39) - 1]) + 0.5) * 25 / 39 - 0.5  # between coarse rows
        assert (left, width) == (0, 48)
        assert first <= max(0, begin) and first + height >= min(25, math.floor(end) + 2)


def test_a_band_sees_the_next_rows_displacements(device: Device) -> None:
    """Only one working row moves, far; rows of the picture beside it move by a share of that."""
    full = plane(60, 120)
    grid = full.resized(20, 40)
    pixels = stored_pixels(22, 60, 120, np.uint8, 3, 1)
    field = np.zeros((40, 20, 4), np.float32)
    field[..., 3] = 1
    field[17, :, 1], field[22, :, 1] = 9, -9
    layer = blend_layer(device, pixels, 0, 0, full, grid, field)
    whole = merged(device, [layer, layer], full, grid)
    assert not np.array_equal(whole, pixels)
    for rows in (1, 2, 3):
        assert np.array_equal(merged(device, [layer, layer], full, grid, rows=rows), whole)


@pytest.mark.parametrize(("dtype", "channels"), [*STORED, (np.float16, 3)])
@pytest.mark.parametrize("name", ["plane", "sphere"])
def test_layers_cut_from_one_picture_come_back(device: Device, dtype: type, channels: int, name: str) -> None:
    """Bit for bit, with ragged masks; a pixel is opaque where a layer covers it, transparent elsewhere."""
    full = GRIDS[name]
    grid = full.resized(31, 17)
    stored = np.float32 if dtype == np.float16 else dtype
    picture = stored_pixels(15, full.width, full.height, stored, channels, 1).astype(dtype)
    boxes = [(0, 0, 50, 39), (20, 5, full.width, 30), (0, 2, full.width, full.height)]
    layers, covered = [], np.zeros(full.shape, bool)
    for i, (left, top, right, bottom) in enumerate(boxes):
        cut = picture[top:bottom, left:right].copy()
        mask = patches(16 + i, right - left, bottom - top, 0.5)
        cut[..., -1] = np.where(mask, cut[..., -1], 0)
        cut[mask == 0, :-1] = 0
        covered[top:bottom, left:right] |= mask > 0
        layers.append(blend_layer(device, cut, left, top, full, grid))
    assert 0.6 < covered.mean() < 1
    out = merged(device, layers, full, grid)
    assert out.dtype == dtype
    assert np.array_equal(out[..., -1] > 0, covered)
    assert np.array_equal(out[covered], picture[covered])
    assert not out[~covered].any()


@pytest.mark.parametrize("count", [32, 33, 70])
def test_more_layers_than_a_word_has_bits_come_back(device: Device, count: int) -> None:
    """Which of them a block shows is kept in bits: the first and the last of a word, and the next word's."""
    full = plane()
    grid = full.resized(31, 17)
    picture = stored_pixels(41, 77, 53, np.uint8, 3, 1)
    covered, layers = np.zeros((53, 77), bool), []
    for left, top in np.random.default_rng(42).integers(0, (66, 44), (count, 2)).tolist():
        covered[top : top + 9, left : left + 11] = True
        layers.append(blend_layer(device, picture[top : top + 9, left : left + 11], left, top, full, grid))
    out = merged(device, layers, full, grid)
    assert 0.3 < covered.mean() < 1
    np.testing.assert_array_equal(out, np.where(covered[..., None], picture, 0))


@pytest.mark.parametrize("floats", [1, 4, 8, 16])
def test_pixels_that_are_made_together_are_the_same(
    device: Device, monkeypatch: pytest.MonkeyPatch, floats: int
) -> None:
    """As many as fit a processor's vectors."""
    full = GRIDS["sphere"]
    grid = full.resized(31, 17)
    layers = [
        blend_layer(
            device, stored_pixels(43 + i, full.width, full.height, np.uint8, 3, 0.9), 0, 0, full, grid,
            field_of(45 + i, grid, (0, 0, 31, 17), 2.0),
        )
        for i in (0, 1)
    ]  # fmt: skip
    usual = merged(device, layers, full, grid)
    monkeypatch.setattr(type(device), "vector_floats", floats)
    assert blend._pixels_together(device) == (2 if floats < 8 else 4)
    off = merged(device, layers, full, grid) != usual
    assert off.mean() <= DECISIONS  # compilers may contract sums in another way


@pytest.mark.parametrize(("width", "columns"), [(64, 64), (30, 30), (76, 8), (94, 2), (77, 3)])
def test_a_block_that_goes_round_the_canvas_finds_all_weights(
    device: Device, monkeypatch: pytest.MonkeyPatch, width: int, columns: int
) -> None:
    """Its first column and its last may be the same, or in order, and yet all are read between them."""
    full = Grid(Box(0, 0, width, 12), width, 12, True, 0, (0.0, 0.0, 0.0, 0.0))
    grid = full.resized(columns, 12)
    fields = np.zeros((2, 12, columns, 4), np.float32)
    fields[0, :, 0, 3] = fields[1, :, 1:, 3] = 1
    layers = [
        blend_layer(device, np.full((12, width, 4), (*[value] * 3, 255), np.uint8), 0, 0, full, grid, field)
        for value, field in zip((50, 200), fields, strict=True)
    ]
    crop = Box(-20, 0, width + 20, 12)
    found = merged(device, layers, full, grid, crop)
    real = blend._mark
    monkeypatch.setattr(blend, "_mark", lambda *told: real(*told).fill(0xFFFFFFFF))
    assert np.array_equal(merged(device, layers, full, grid, crop), found)
    assert found[5, 20:-20, 0].min() < 80 < 180 < found[5, 20:-20, 0].max()


def test_a_layer_of_one_column_is_found_anywhere_in_a_block(device: Device) -> None:
    full = plane()
    grid = full.resized(31, 17)
    pixels = stored_pixels(47, 1, 53, np.uint8, 3, 1)
    for column in (0, 1, 62, 63, 64, 65, 76):
        out = merged(device, [blend_layer(device, pixels, column, 0, full, grid)], full, grid)
        assert np.array_equal(out[:, column : column + 1], pixels)
        assert not np.delete(out, column, 1).any()


def test_one_sample_that_counts_is_the_pixel(device: Device) -> None:
    """To the bit, where an earlier layer weighs something too, but is sampled outside itself."""
    full = plane()
    grid = full.resized(77, 53)
    pixels = [stored_pixels(48 + i, 77, 53, np.float32, 3, 1) for i in (0, 1)]
    lost = np.zeros((53, 77, 4), np.float32)
    lost[...] = 500, 0, 0, 0.3
    still = np.float32([0, 0, 0, 0.7]) + np.zeros_like(lost)
    layers = [blend_layer(device, p, 0, 0, full, grid, f) for p, f in zip(pixels, (lost, still), strict=True)]
    assert np.array_equal(merged(device, layers, full, grid), pixels[1])


def test_a_union_pixel_is_never_transparent(device: Device) -> None:
    """Even where both layers are sampled far outside themselves, or nobody has any weight."""
    full = plane()
    grid = full.resized(31, 17)
    lost = np.zeros((17, 31, 4), np.float32)
    lost[..., 0], lost[..., 3] = 500, 1
    lost[:, 15:, 3] = 0
    pixels = [stored_pixels(17 + i, 77, 53, np.uint8, 3, 1) for i in (0, 1)]
    layers = [blend_layer(device, p, 0, 0, full, grid, lost) for p in pixels]
    assert np.array_equal(merged(device, layers, full, grid), pixels[0])


def test_the_crop_may_reach_beyond_the_region_and_cut_it(device: Device) -> None:
    full = Grid(Box(30, 20, 107, 73), 77, 53, False, 0, (0.0, 0.0, 0.0, 0.0))
    grid = full.resized(40, 27)
    pixels = stored_pixels(19, 77, 53, np.uint8, 3, 0.9)
    pixels[pixels[..., 3] == 0] = 0
    out = merged(device, [blend_layer(device, pixels, 0, 0, full, grid)], full, grid, Box(10, 50, 120, 90), 7)
    expected = np.zeros((40, 110, 4), np.uint8)
    expected[:23, 20:97] = pixels[30:]
    assert np.array_equal(out, expected)


@pytest.mark.parametrize("shift", [(4, 0), (0, 3), (-5, 2)])
@pytest.mark.parametrize("name", ["plane", "cylinder"])
def test_a_whole_pixels_displacement_copies(device: Device, shift: tuple[int, int], name: str) -> None:
    """Working pixels are two pixels wide here, so displacements count double; the cylinder's border too."""
    full = Grid(Box(0, 0, 78, 54), 78, 54, name == "cylinder", 0, (0.0, 0.0, 0.0, 0.0))
    grid = full.resized(39, 27)
    pixels = stored_pixels(20, 78, 54, np.uint16, 3, 1)
    field = np.zeros((27, 39, 4), np.float32)
    field[...] = (shift[0] / 2, shift[1] / 2, 0, 1)
    layer = blend_layer(device, pixels, 0, 0, full, grid, field)
    out = merged(device, [layer, layer], full, grid, rows=20)
    columns, rows = common.pixels(78, 54)
    x, y, inside = common.grid_border(columns + shift[0], rows + shift[1], full.border)
    assert np.array_equal(out[inside], pixels[y[inside], x[inside]])


@pytest.mark.parametrize("size", [(47, 29), (31, 17), (77, 53)])
def test_linear_flow_is_carried_to_full_resolution(device: Device, size: tuple[int, int]) -> None:
    """By factors that divide nothing, x and y apart, within 1e-3 px: seen on a picture of positions, as the
    cubic samples it."""
    full = plane()
    grid = full.resized(*size)
    scale = 77 / size[0], 53 / size[1]
    x, y = (places + 0.5 for places in common.pixels(77, 53))
    picture = np.stack([x, y, x - y, np.ones_like(x)], -1).astype(np.float32)
    columns, rows = ((places + 0.5) * s for places, s in zip(common.pixels(*size), scale, strict=True))

    def way(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return 0.05 * u - 0.03 * v + 1.5, 0.02 * u + 0.04 * v - 2

    across, down = way(columns, rows)
    field = np.zeros((*grid.shape, 4), np.float32)
    field[..., 0], field[..., 1], field[..., 3] = across / scale[0], down / scale[1], 1
    layer = blend_layer(device, picture, 0, 0, full, grid, field)
    out = merged(device, [layer, layer], full, grid)

    def sampled(q: np.ndarray) -> np.ndarray:
        middle = np.floor(q - 0.5)
        taps = common.cubic_taps(q - 0.5 - middle, twin.SLOPE)
        return middle + 0.5 + np.tensordot(np.arange(-1, 3), taps, 1)

    for found, start, moved in zip((out[..., 0], out[..., 1]), (x, y), way(x, y), strict=True):
        assert np.abs(found - sampled(start + moved))[8:-8, 8:-12].max() < 1e-3

"""Reduction of layers to the working grid: kernels against twins, twins against brute force."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from reference.working import working_compare, working_reduce
from tolerances import SUM, assert_close

from hugin_abflow import working
from hugin_abflow.grid import Grid
from hugin_abflow.layer import Box, Layer, full_scale
from hugin_abflow.opencl import Device
from hugin_abflow.working import WorkingLayer

DTYPES = (np.uint8, np.uint16, np.float32)
PLANE = (0.0, 0.0, 0.0, 0.0)


def random_pixels(seed: int, width: int, height: int, dtype: type, channels: int, holes: float) -> np.ndarray:
    """(height, width, channels + 1) with a share of transparent pixels, which are not black."""
    random = np.random.default_rng(seed)
    white = full_scale(dtype)
    pixels = random.random((height, width, channels + 1)) * white
    pixels[..., -1] = np.where(random.random((height, width)) < holes, 0, white)
    return pixels.astype(dtype)


def nothing(units: int) -> None:
    """Progress that nobody watches."""


def grid_over(region: Box, width: int, height: int, wraps: bool = False) -> Grid:
    return Grid(region, width, height, wraps, 0, PLANE)


def test_twin_of_reduce_is_the_mean_of_repeated_pixels() -> None:
    """With every pixel repeated (working size) times, working pixels are blocks of whole copies."""
    pixels = random_pixels(0, 77, 53, np.uint8, 3, 0.02)
    small = working_reduce(
        pixels, (0, 0, 77, 53), (77, 31, 53, 20), (0, 0, 31, 20), 0, (31, 20), 255.0
    )  # fmt: skip
    blocks = np.repeat(np.repeat(pixels / 255.0, 31, 1), 20, 0).reshape(20, 53, 31, 77, 4)
    valid = blocks[..., 3].min((1, 3)) == 1
    assert 0 < valid.sum() < valid.size
    assert np.array_equal(small[..., 3] == 1, valid)
    assert np.allclose(small[valid][:, :3], blocks.mean((1, 3))[valid][:, :3], atol=1e-12)
    assert not small[~valid].any()


def rows_at_a_time(patch: pytest.MonkeyPatch, rows: int) -> None:
    for name in ("_ROWS", "_ROWS_FOR_CARD"):
        patch.setattr(working, name, rows)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("channels", [1, 3])
def test_reduce_equals_its_twin(device: Device, dtype: type, channels: int) -> None:
    """A layer whose box is aligned with nothing, on a grid whose size divides nothing, in several bands."""
    pixels = random_pixels(1, 77, 53, dtype, channels, 0.01)
    layer = Layer.from_array("a", pixels, left=13, top=7)
    grid = grid_over(Box(2, 3, 110, 88), 47, 29)
    with pytest.MonkeyPatch.context() as patch:
        rows_at_a_time(patch, 20)
        reduced = working.reduce_layer(device, layer, grid, nothing)
    kernel = reduced.pixels.get()
    left, top, width, height = reduced.box
    assert (left, top) == (math.ceil(11 * 47 / 108), math.ceil(4 * 29 / 85))
    assert (left + width, top + height) == (88 * 47 // 108, 57 * 29 // 85)
    twin = working_reduce(
        pixels, (11, 4, 77, 53), (108, 47, 85, 29), reduced.box, 0, (width, height), full_scale(dtype)
    )
    assert 0.5 < twin[..., 3].mean() < 1
    assert np.array_equal(kernel[..., 3], twin[..., 3])
    assert_close(kernel, twin, SUM)


@pytest.mark.parametrize("rows", [1, 20, 256])
def test_reduce_does_not_depend_on_how_rows_are_read(device: Device, rows: int) -> None:
    pixels = random_pixels(2, 77, 53, np.uint16, 3, 0.005)
    layer = Layer.from_array("a", pixels, left=5, top=9)
    grid = grid_over(Box(0, 0, 90, 70), 41, 33)
    whole = working.reduce_layer(device, layer, grid, nothing).pixels.get()
    with pytest.MonkeyPatch.context() as patch:
        rows_at_a_time(patch, rows)
        assert np.array_equal(working.reduce_layer(device, layer, grid, nothing).pixels.get(), whole)


@pytest.mark.parametrize("count", [2, 5, 99])
def test_parts_in_any_order_are_the_layer(
    device: Device, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows_at_a_time(monkeypatch, 7)
    monkeypatch.setattr(working, "_PART_STRIPS", 1)
    layer = Layer.from_array("a", random_pixels(2, 77, 53, np.uint16, 3, 0.005), left=5, top=9)
    layer = replace(layer, strip=4)
    grid = grid_over(Box(0, 0, 90, 70), 41, 33)
    whole = working.reduce_layer(device, layer, grid, nothing)
    reduction, seen = working.Reduction(device, layer, grid), list[int]()
    parts = reduction.parts(count)
    assert len(parts) == min(count, 8)  # bands of three rows of the grid
    assert [first for first, _ in parts[1:]] == [end for _, end in parts[:-1]]
    for first, end in parts[::-1]:
        reduction.read(first, end, seen.append)
    assert sum(seen) == 53
    result = reduction.result()
    assert np.array_equal(result.pixels.get(), whole.pixels.get())
    assert result.checksum == whole.checksum


@pytest.mark.parametrize(("strip", "parts"), [(1, 1), (2, 4), (4, 2), (5, 1), (64, 1)])
def test_each_part_has_several_strips(
    device: Device, strip: int, parts: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which two parts may share; what is decoded from its top alone (1) is one."""
    rows_at_a_time(monkeypatch, 8)
    layer = replace(Layer.from_array("a", random_pixels(2, 77, 64, np.uint8, 3, 0)), strip=strip)
    reduction = working.Reduction(device, layer, grid_over(Box(0, 0, 77, 64), 77, 64))
    found = reduction.parts(8)
    assert len(found) == parts and (found[0][0], found[-1][1]) == (0, 64)


@pytest.mark.parametrize(("kind", "rows"), [("CPU", 64), ("GPU", 256)])
def test_graphics_cards_get_more_rows_at_a_time(
    device: Device, kind: str, rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """But of wide layers no more than 8 MiB."""
    monkeypatch.setattr(Device, "kind", kind)
    layer = Layer.from_array("a", random_pixels(2, 77, 53, np.uint8, 3, 0))
    assert working.rows_at_a_time(device, layer) == rows
    for width, fitting in ((1 << 17, 16), (1 << 23, 1)):
        wide = replace(layer, box=Box(0, 0, width, 53))
        assert working.rows_at_a_time(device, wide) == fitting


def test_a_layer_without_a_row_of_the_grid_is_counted_too(device: Device) -> None:
    seen = list[int]()
    layer = Layer.from_array("a", random_pixels(2, 77, 3, np.uint8, 3, 0), top=1)
    result = working.reduce_layer(device, layer, grid_over(Box(0, 0, 90, 70), 9, 7), seen.append)
    assert seen == [3] and result.checksum


@pytest.mark.parametrize("row", [0, 46])
def test_checksums_tell_rows_that_no_row_of_the_grid_covers(device: Device, row: int) -> None:
    """Rows 100 to 147 of a canvas, of which rows 102 to 144 lie under whole rows of the grid."""
    grid = grid_over(Box(0, 0, 300, 300), 100, 100)
    rows = np.full((47, 1, 4), 255, np.uint8)
    sums = set()
    for value in (20, 57):
        rows[row, :, :3] = value
        layer = Layer.from_array("a", rows.copy(), 100, 100)
        sums.add(working.reduce_layer(device, layer, grid, nothing).checksum)
    assert len(sums) == 2


def test_checksums_tell_bands_that_are_exchanged(device: Device) -> None:
    pixels = random_pixels(2, 40, 128, np.uint8, 3, 0)
    grid = grid_over(Box(0, 0, 40, 128), 40, 128)
    one, other = (
        working.reduce_layer(device, Layer.from_array("a", rows), grid, nothing).checksum
        for rows in (pixels, np.concatenate([pixels[64:], pixels[:64]]))
    )
    assert one != other


def test_layers_cut_from_one_picture_agree_to_the_bit(device: Device) -> None:
    picture = random_pixels(3, 101, 67, np.uint8, 3, 0.0)
    grid = grid_over(Box(0, 0, 101, 67), 43, 31)
    a = working.reduce_layer(device, Layer.from_array("a", picture[:50, :64]), grid, nothing)
    b = working.reduce_layer(device, Layer.from_array("b", picture[11:, 23:], 23, 11), grid, nothing)
    common = [
        p.pixels.get()[b.box[1] - p.box[1] :, b.box[0] - p.box[0] :][
            : a.box[3] - b.box[1], : a.box[2] - b.box[0]
        ]
        for p in (a, b)
    ]
    assert common[0].shape == common[1].shape
    assert common[0][..., 3].all()
    assert np.array_equal(*common)


def test_full_resolution_is_copied(device: Device) -> None:
    pixels = random_pixels(4, 77, 53, np.uint8, 3, 0.1)
    layer = Layer.from_array("a", pixels, left=3, top=2)
    reduced = working.reduce_layer(device, layer, grid_over(Box(0, 0, 90, 60), 90, 60), nothing)
    kernel = reduced.pixels.get()
    valid = pixels[..., 3] > 0
    assert reduced.box == (3, 2, 77, 53)
    assert np.array_equal(kernel[..., 3] > 0, valid)
    assert np.allclose(kernel[valid][:, :3] * 255, pixels[valid][:, :3], atol=1e-4)


@pytest.mark.parametrize(("left", "top"), [(119, 40), (60, 79), (119, 79), (41, 41)])
def test_a_layer_smaller_than_a_working_pixel_stays_on_the_grid(device: Device, left: int, top: int) -> None:
    """Its box must lie on the grid, or kernels write outside their arrays."""
    layer = Layer.from_array("dot", np.full((1, 1, 4), 255, np.uint8), left, top)
    grid = grid_over(Box(0, 0, 120, 80), 30, 20)
    reduced = working.reduce_layer(device, layer, grid, nothing)
    x, y, width, height = reduced.box
    assert 0 <= x <= 30 - width
    assert 0 <= y <= 20 - height
    assert not reduced.pixels.get().any()


@pytest.mark.parametrize(("width", "height"), [(1, 60), (90, 2)])
def test_a_layer_narrower_than_a_working_pixel_covers_none(device: Device, width: int, height: int) -> None:
    layer = Layer.from_array("line", np.full((height, width, 4), 255, np.uint8), 25, 17)
    reduced = working.reduce_layer(device, layer, grid_over(Box(0, 0, 120, 80), 30, 20), nothing)
    assert not reduced.pixels.get().any()


@pytest.mark.parametrize(
    ("dtype", "alphas"), [(np.uint8, (127, 128)), (np.uint16, (32767, 32768)), (np.float32, (0.499, 0.5))]
)
def test_half_alpha_is_valid(device: Device, dtype: type, alphas: tuple[float, float]) -> None:
    pixels = np.ones((2, 2, 2), dtype)
    pixels[0, :, 1], pixels[1, :, 1] = alphas
    layer = Layer.from_array("half", pixels)
    kernel = working.reduce_layer(device, layer, grid_over(Box(0, 0, 2, 2), 2, 2), nothing).pixels.get()
    twin = working_reduce(pixels, (0, 0, 2, 2), (2, 2, 2, 2), (0, 0, 2, 2), 0, (2, 2), full_scale(dtype))
    assert kernel[..., 3].tolist() == twin[..., 3].tolist() == [[0, 0], [1, 1]]


def test_advance_counts_every_row_of_a_layer_once(device: Device) -> None:
    seen: list[int] = []
    layer = Layer.from_array("a", random_pixels(5, 77, 53, np.uint8, 1, 0), left=1, top=2)
    with pytest.MonkeyPatch.context() as patch:
        rows_at_a_time(patch, 16)
        working.reduce_layer(device, layer, grid_over(Box(0, 0, 90, 60), 37, 23), seen.append)
    assert sum(seen) == 53


def place(device: Device, pixels: np.ndarray, left: int, top: int) -> WorkingLayer:
    layer = Layer.from_array("w", np.zeros((1, 1, 4), np.uint8))
    return WorkingLayer(layer, (left, top, pixels.shape[1], pixels.shape[0]), device.upload(pixels), 0)


@pytest.mark.parametrize("change", ["nothing", "colour", "outside", "invisible"])
def test_compare_equals_its_twin(device: Device, change: str) -> None:
    picture = random_pixels(6, 77, 53, np.float32, 3, 0.2)
    picture[..., :3] *= picture[..., 3:]
    a, b = picture[:40, :50].copy(), picture[20:, 30:].copy()
    y, x = np.argwhere(a[20:40, 30:50, 3] > 0)[7]
    if change == "colour":
        b[y, x, 1] += 1e-6
    elif change == "outside":
        b[-1, -1] += 0.5
    elif change == "invisible":
        b[y, x] = 0
    kernel = not working.same_where_both(device, place(device, a, 3, 4), place(device, b, 33, 24))
    assert kernel == working_compare(a, (3, 4, 50, 40), b, (33, 24, 47, 33)) == (change == "colour")


def test_layers_that_do_not_touch_are_the_same(device: Device) -> None:
    picture = random_pixels(7, 20, 10, np.float32, 3, 0)
    assert working.same_where_both(device, place(device, picture, 0, 0), place(device, 1 - picture, 40, 0))


def test_half_is_read_as_float(device: Device) -> None:
    pixels = random_pixels(8, 33, 21, np.float16, 3, 0)
    layer = Layer.from_array("half", pixels)
    assert working.pixel_options(layer) == ("-DPIXEL=float -DSAMPLES=4", 1.0)
    assert working.device_rows(layer, 3, 9).dtype == np.float32
    assert np.array_equal(working.device_rows(layer, 3, 9), pixels[3:9].astype(np.float32))

"""Thin strips along the rim: kernels against twins, which strips, and that geometry goes on over them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from bands import blend_layer
from grids import GRIDS, on_device, plane, random_layer, sphere
from reference import rim as twin
from tolerances import POSITION, SUM, assert_close

from hugin_abflow import blend, coefficient, rim, transition
from hugin_abflow.blend import Prepared
from hugin_abflow.chart import pair_chart
from hugin_abflow.coefficient import Masks
from hugin_abflow.geometry import PairFlow
from hugin_abflow.grid import Grid
from hugin_abflow.opencl import Device
from hugin_abflow.rim import Rim
from hugin_abflow.settings import Settings

# Of 300 x 200 px strips are thin up to 4 px.
WIDTH, HEIGHT = 300, 200


def box_of(grid: Grid) -> tuple[int, int, int, int]:
    return 9, 1, 60, grid.height - 2


def random_field(seed: int, box: tuple[int, int, int, int]) -> np.ndarray:
    return np.random.default_rng(seed).random((box[3], box[2], 4)).astype(np.float32)


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize("size", [None, (39, 21)])
def test_fading_equals_its_twin(device: Device, name: str, size: tuple[int, int] | None) -> None:
    grid, box = GRIDS[name], box_of(GRIDS[name])
    cells = grid if size is None else grid.resized(*size)
    field, left = random_field(1, box), np.random.default_rng(2).random(cells.shape).astype(np.float32)
    found = device.upload(field)
    device.run("rim", "rim_fade", box[2:], found, box, grid.border, device.upload(left), cells.border)
    assert_close(found.get(), twin.rim_fade(field, box, grid.border, left, cells.border), SUM)


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize("size", [None, (39, 21)])
def test_carrying_equals_its_twin(device: Device, name: str, size: tuple[int, int] | None) -> None:
    """Also from cells beside the layer's box, and from where it shows nothing."""
    grid, box = GRIDS[name], box_of(GRIDS[name])
    cells = grid if size is None else grid.resized(*size)
    random = np.random.default_rng(3)
    into = random.random(cells.shape) < 0.3
    free = np.flatnonzero(~into)
    source = np.where(into, free[random.integers(free.size, size=cells.shape)], -1).astype(np.int32)
    field, layer = random_field(4, box), random_layer(5, *box[2:])
    field[..., :3] = (field[..., :3] - 0.5) * (0.2 if grid.spherical else 9)
    angle, share, thick = random.random((3, *cells.shape))
    outward = np.stack([np.cos(7 * angle), np.sin(7 * angle), share, 5 * thick], -1).astype(np.float32)
    found = device.upload(field)
    device.run(
        "rim", "rim_carry", box[2:], found, device.upload(layer), box, grid.border, grid.lonlat,
        device.upload(source), device.upload(outward), cells.border,
    )  # fmt: skip
    expected = twin.rim_carry(field, layer, box, grid.border, grid.lonlat, source, outward, cells.border)
    assert 0.05 < (expected != field).any(-1).mean() < 0.3
    assert_close(found.get(), expected, POSITION)


def masks_of(device: Device, grid: Grid, host: np.ndarray) -> Masks:
    return Masks(grid, tuple(device.upload(mask, np.uint8) for mask in host), host)


def below(height: int, left: int = 40, right: int = 260) -> np.ndarray:
    """A layer that covers all columns, and one that ends `height` px above the canvas's lower border."""
    host = np.ones((2, HEIGHT, WIDTH), bool)
    host[1, :, :left] = host[1, :, right:] = host[1, HEIGHT - height :] = False
    return host


def test_strips_are_thin(device: Device) -> None:
    """Beside a layer's sides all is as high as the canvas."""
    grid = plane(WIDTH, HEIGHT)
    found = rim.find(masks_of(device, grid, below(3)))
    assert found is not None
    assert found.strips[1][-3:, 50:250].all() and not found.strips[1][3:-3].any() and 0 not in found.strips
    assert not found.strips[1][:, :36].any() and not found.strips[1][:, 264:].any()
    thicker = rim.find(masks_of(device, grid, below(8)))
    assert thicker is None or not thicker.strips[1][:, 50:250].any()


def test_what_is_between_layers_is_no_strip(device: Device) -> None:
    """A gap of a few px in one layer, far from the rim, is a border as any other."""
    host = np.ones((2, HEIGHT, WIDTH), bool)
    host[1, 100:103, 20:-20] = False
    assert rim.find(masks_of(device, plane(WIDTH, HEIGHT), host)) is None


def test_where_nothing_ends_is_no_rim(device: Device) -> None:
    """Beside a pole, and across the border of a canvas of 360 degrees."""
    grid = sphere(WIDTH, WIDTH // 2)
    host = np.ones((2, *grid.shape), bool)
    host[1, -2:] = host[1, :, :2] = False
    assert rim.find(masks_of(device, grid, host)) is None
    found = rim.find(masks_of(device, replace(grid, poles=0), host))
    assert found is not None and found.strips[1][-2:, 20:-20].all()


def crossing(slope: float) -> np.ndarray:
    """Two layers whose lower borders cross in the middle; at the sides there is one of them."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    falls = slope * (x - WIDTH / 2)
    ends = HEIGHT - np.stack([np.maximum(-falls, 0), np.maximum(falls, 0)])
    return (y < ends) & np.stack([x > 20, x < WIDTH - 20])


def shares(device: Device, host: np.ndarray, parallax: float) -> np.ndarray:
    """w of the first of two layers that everywhere shift by so much, (height, width), with strips."""
    grid = plane(WIDTH, HEIGHT)
    noise = np.random.default_rng(1).random((HEIGHT, WIDTH, 4)).astype(np.float32)
    layers = [on_device(device, np.where(m[..., None], np.maximum(noise, [0, 0, 0, 1]), 0)) for m in host]
    masks = coefficient.masks(device, layers, grid)
    chart = pair_chart(host.all(0), grid, grid)
    flow = np.zeros((chart.height, chart.width, 2), np.float32)
    flow[..., 0] = parallax
    flows = [PairFlow(0, 1, chart, device.upload(flow), device.upload(-flow))]
    found = coefficient.coefficients(device, layers, masks, grid, even=True)
    transition.minimise_strain(
        device, layers, found, flows, masks, grid, Settings(), np.zeros((9, 9), np.float32), rim.find(masks)
    )
    return np.asarray(found[0].get())


def test_transitions_are_as_wide_where_borders_cross(device: Device) -> None:
    """Beside a flat crossing they are as wide as above it; they would narrow to a point there."""
    w = shares(device, crossing(0.02), 8)
    width = [np.count_nonzero((row > 0.2) & (row < 0.8)) for row in w[[100, 180, 194]]]
    assert min(width) > 0.7 * max(width) > 40


def test_geometry_goes_on_into_strips(device: Device) -> None:
    """What is displaced beside a strip is so in it, up to the rim; the layer that ends fades out."""
    grid, host = plane(WIDTH, HEIGHT), below(3)
    layers = [on_device(device, np.repeat(mask[..., None].astype(np.float32), 4, -1)) for mask in host]
    field = np.zeros((HEIGHT, WIDTH, 4), np.float32)
    field[:-3] = np.arange(WIDTH)[:, None] * [0.1, 0, 0, 0] + [0, 0, 0, 1]
    fields = [device.upload(field) for _ in host]
    found = rim.find(masks_of(device, grid, host))
    assert found is not None
    carried = rim.carry(device, layers, fields, found, grid)[0].get()
    first, second = (one.get() for one in fields)
    assert carried[-3:, 50:250].all() and not carried[3:-3].any()
    assert_close(first[-3:, 50:250], np.broadcast_to(field[100, 50:250], (3, 200, 4)), SUM)
    faded = second[-12:-3, 150, 3]
    assert faded[0] == 1 and faded[-1] < 0.05 and (np.diff(faded) <= 0).all()
    assert np.array_equal(second[:-12, 50:250], field[:-12, 50:250])


def test_nothing_is_shown_from_beyond_the_rim(device: Device) -> None:
    """Displacements towards it get less in a strip, evenly; along it they stay."""
    grid, host = plane(WIDTH, HEIGHT), below(3)
    layer = on_device(device, np.ones((HEIGHT, WIDTH, 4)))
    fields = [device.upload(np.broadcast_to(np.float32([7, 2, 0, 1]), (HEIGHT, WIDTH, 4))) for _ in host]
    found = rim.find(masks_of(device, grid, host))
    assert found is not None
    rim.carry(device, [layer, layer], fields, found, grid)
    strip = fields[0].get()[-4:, 150]
    assert (strip[:, 0] == 7).all()
    assert_close(strip[:, 1], np.array([2, 5 / 3, 1, 1 / 3]), POSITION)


def test_what_one_layer_alone_shows_is_displaced_where_it_is_told(device: Device) -> None:
    """And copied elsewhere."""
    full = plane()
    pixels = np.random.default_rng(5).integers(0, 255, (53, 77, 4)).astype(np.uint8)
    pixels[..., 3] = 255
    field = np.zeros((53, 77, 4), np.float32)
    field[...] = 3, 0, 0, 1
    carried = np.zeros((27, 39), np.uint8)
    carried[20:] = 1
    prepared = Prepared(
        (blend_layer(device, pixels, 0, 0, full, full, field),), full, full, full.resized(7, 5),
        full.resized(24, 13), 1.0, carried=(full.resized(39, 27), device.upload(carried)),
    )  # fmt: skip
    out = np.concatenate(list(blend.bands(device, prepared, full.region, Settings(), lambda units: None)))
    first = math.ceil(20 * 53 / 27 - 0.5)
    assert np.array_equal(out[:first], pixels[:first])
    assert np.array_equal(out[first:, :-3], pixels[first:, 3:])


def test_a_rim_of_strips_alone_is_left_as_it_is(device: Device) -> None:
    grid = plane(40, 30)
    everywhere = np.ones((1, 30, 40), bool)
    layer, field = on_device(device, np.ones((30, 40, 4))), np.zeros((30, 40, 4), np.float32)
    found = device.upload(field)
    assert (
        not rim.carry(device, [layer], [found], Rim(grid, everywhere[0], {0: everywhere[0]}), grid)[0]
        .get()
        .any()
    )
    assert np.array_equal(found.get()[..., :3], field[..., :3])

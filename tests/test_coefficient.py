"""Distances and blend coefficients: kernels against twins, twins against SciPy and brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest
from grids import GRIDS, on_device, patches, plane, random_layer, sphere
from reference import coefficient as twin
from reference.common import grid_border
from scipy import ndimage
from tolerances import POSITION, SUM, TRIGONOMETRY, assert_close

from hugin_abflow import coefficient
from hugin_abflow.coefficient import Masks
from hugin_abflow.grid import Grid
from hugin_abflow.opencl import Buffer, Device

NAMES = list(GRIDS)


def cover_masks(device: Device, masks: list[np.ndarray], grid: Grid) -> Masks:
    """Masks of layers on a grid that is mask grid and working grid in one."""
    buffers = tuple(device.upload(mask, np.uint8) for mask in masks)
    return Masks(grid, buffers, np.stack(masks).astype(bool))


def brute_force(mask: np.ndarray, cover: np.ndarray, grid: Grid) -> np.ndarray:
    """Distance from every covered pixel to every seed, the nearest taken; in columns."""
    seeds = np.argwhere((cover > 0) & (mask == 0))
    pixels = np.argwhere(mask > 0)
    if grid.lonlat[1]:
        lon0, across, lat0, down = grid.lonlat

        def vectors(places: np.ndarray) -> np.ndarray:
            lon, lat = lon0 + (places[:, 1] + 0.5) * across, lat0 - (places[:, 0] + 0.5) * down
            return np.stack([np.cos(lon) * np.cos(lat), np.sin(lon) * np.cos(lat), np.sin(lat)])

        far = np.arccos(np.clip(vectors(pixels).T @ vectors(seeds), -1, 1)) / across
    else:
        dx = np.abs(pixels[:, None, 1] - seeds[None, :, 1])
        far = np.hypot(
            np.minimum(dx, grid.width - dx) if grid.wraps else dx, pixels[:, :1] - seeds[None, :, 0]
        )
    result = np.zeros(mask.shape)
    result[tuple(pixels.T)] = far.min(1)
    return result


def kernel_distance(device: Device, masks: list[np.ndarray], index: int, grid: Grid) -> np.ndarray:
    cover = np.maximum.reduce(masks)
    covers = cover_masks(device, masks, grid)
    return coefficient.distance(device, covers, index, device.upload(cover, np.uint8), grid).get()


def unit(grid: Grid) -> float:
    """Columns per unit of distance, which is the radian on a sphere."""
    return 1 / grid.lonlat[1] if grid.lonlat[1] else 1.0


def table(device: Device, grid: Grid) -> Buffer:
    """The host's table of parts of distances."""
    return device.upload(coefficient._table(grid))


def two_masks(seed: int, grid: Grid) -> list[np.ndarray]:
    """Two big overlapping layers, ragged, with some pixels that nobody covers."""
    y, x = np.mgrid[0 : grid.height, 0 : grid.width] / [[[grid.height]], [[grid.width]]]
    ragged = patches(seed, grid.width, grid.height, 0.92)
    left, right = (x < 0.55 + 0.1 * np.sin(9 * y)), (x > 0.35) & (y < 0.9)
    return [(part * ragged).astype(np.uint8) for part in (left, right)]


@pytest.mark.parametrize("wraps", [False, True])
def test_brute_force_on_a_plane_is_scipy(wraps: bool) -> None:
    grid = plane(wraps=wraps)
    masks = two_masks(0, grid)
    cover = np.maximum(*masks)
    turns = 3 if wraps else 1
    far = ndimage.distance_transform_edt(np.tile((cover == 0) | (masks[0] > 0), turns))
    far = far[:, grid.width * (turns // 2) :][:, : grid.width] * masks[0]
    assert np.allclose(brute_force(masks[0], cover, grid), far)


@pytest.mark.parametrize("name", NAMES)
def test_twin_of_distance_is_brute_force(name: str) -> None:
    """With the nearest seed known, the twin's distance is the brute force's."""
    grid = GRIDS[name]
    masks = two_masks(1, grid)
    cover = np.maximum(*masks)
    seed = twin.coefficient_seed(masks[0], cover)
    assert np.array_equal(seed >= 0, (cover > 0) & (masks[0] == 0))
    everything = seed[seed >= 0]
    columns, rows = np.meshgrid(np.arange(grid.width), np.arange(grid.height))
    far = np.stack([twin.between(columns, rows, s, grid.border, grid.lonlat) for s in everything])
    nearest = everything[far.argmin(0)]
    result = twin.coefficient_distance(nearest, masks[0], grid.border, grid.lonlat, unit(grid), 1e9)
    assert np.allclose(result, brute_force(masks[0], cover, grid), atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("step", [1, 7, 32])
def test_flood_equals_its_twin(device: Device, name: str, step: int) -> None:
    """Seeds at equal distance may be told apart by rounding, so distances are compared, not seeds."""
    grid = GRIDS[name]
    random = np.random.default_rng(step)
    known = random.random(grid.shape) < (0.1 if step == 1 else 0.03)
    seed = np.where(known, twin.packed(grid.shape), -1).astype(np.int32)
    flooded = device.empty(grid.shape, np.int32)
    device.run(
        "coefficient", "coefficient_flood", grid.border[:2],
        device.upload(seed), grid.border, table(device, grid), step, flooded,
    )  # fmt: skip
    kernel, expected = flooded.get(), twin.coefficient_flood(seed, grid.border, grid.lonlat, step)
    assert np.array_equal(kernel < 0, expected < 0)
    assert 0.05 < (kernel >= 0).mean() < 1
    if not grid.lonlat[1]:
        assert np.array_equal(kernel, expected)
    full = np.ones(grid.shape)
    seeds = (kernel, expected)
    far = [twin.coefficient_distance(s, full, grid.border, grid.lonlat, unit(grid), 0.0) for s in seeds]
    assert_close(far[0], far[1], TRIGONOMETRY)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("index", [0, 1])
def test_distances_are_those_of_brute_force(device: Device, name: str, index: int) -> None:
    """Jump flooding is not exact: a few pixels may be off by less than one, with masks as ragged as here."""
    grid = GRIDS[name]
    masks = two_masks(2, grid)
    kernel = kernel_distance(device, masks, index, grid)
    expected = brute_force(masks[index], np.maximum(*masks), grid)
    off = np.abs(kernel - expected)
    assert expected.max() > 10
    assert (off > 1e-3).mean() < 0.02
    assert off.max() < 1


@pytest.mark.parametrize("name", NAMES)
def test_distance_equals_its_twin(device: Device, name: str) -> None:
    grid = GRIDS[name]
    random = np.random.default_rng(3)
    mask = patches(4, grid.width, grid.height, 0.7).astype(np.uint8)
    seed = random.permutation(twin.packed(grid.shape).ravel()).reshape(grid.shape).astype(np.int32)
    seed[random.random(grid.shape) < 0.1] = -1
    result = device.empty(grid.shape)
    device.run(
        "coefficient", "coefficient_distance", grid.border[:2],
        device.upload(seed), device.upload(mask), grid.border, table(device, grid), int(grid.lonlat[1] > 0),
        unit(grid), 321.5, result,
    )  # fmt: skip
    expected = twin.coefficient_distance(seed, mask, grid.border, grid.lonlat, unit(grid), 321.5)
    assert 321.5 in expected
    # opposite points of the sphere: their chord's square is all but 1, where asin magnifies rounding
    opposite = (expected > 3 * unit(grid)) & (expected < 321) & (grid.lonlat[1] > 0)
    assert opposite.mean() < 0.1
    assert_close(result.get()[~opposite], expected[~opposite], TRIGONOMETRY)
    assert np.allclose(result.get()[opposite], expected[opposite], rtol=1e-3)


def test_near_the_pole_distance_is_an_angle(device: Device) -> None:
    """A layer that covers the cap: from the pole it is as far to the cap's rim in all directions."""
    grid = sphere(720, 360)
    rows = np.arange(360)[:, None] * np.ones((1, 720))
    cap, rest = (rows < 60).astype(np.uint8), (rows >= 40).astype(np.uint8)
    kernel = kernel_distance(device, [cap, rest], 0, grid)
    away = (60.5 - (np.arange(60) + 0.5)) * np.ones((720, 1))  # half a degree per row
    assert np.allclose(kernel[:60].T, away, atol=2e-2)


@pytest.mark.parametrize("name", NAMES)
def test_furthest_where_nothing_lies_outside(device: Device, name: str) -> None:
    grid = GRIDS[name]
    mask = patches(5, grid.width, grid.height, 0.8).astype(np.uint8)
    kernel = kernel_distance(device, [mask, mask], 0, grid)
    furthest = math.pi / grid.lonlat[1] if grid.lonlat[1] else math.hypot(grid.width, grid.height)
    assert np.allclose(kernel, mask * furthest, rtol=1e-6)


def test_a_mask_pixel_needs_all_pixels_under_it() -> None:
    """The twin against every working pixel's overlap with every mask pixel, one by one."""
    layer = random_layer(6, 31, 23, 0.9)
    result = twin.coefficient_mask(layer, (5, 3, 31, 23), (41, 29, 0, 0), (21, 15, 0, 0))
    for j, i in np.ndindex(15, 21):
        under = [
            (x, y)
            for y, x in np.ndindex(29, 41)
            if max(x * 21, i * 41) < min((x + 1) * 21, (i + 1) * 41)
            and max(y * 15, j * 29) < min((y + 1) * 15, (j + 1) * 29)
        ]
        assert result[j, i] == all(5 <= x < 36 and 3 <= y < 26 and layer[y - 3, x - 5, 3] for x, y in under)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("factor", [1, 2])
def test_masks_equal_their_twin(device: Device, name: str, factor: int) -> None:
    """Also on a mask grid that is not half the working grid, as that of an odd size is."""
    grid = GRIDS[name]
    pixels = random_layer(7, 51, 19, 0.9)
    layer = on_device(device, pixels, 9, 2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(coefficient, "_FINE_PIXELS", 10**6 if factor == 1 else 0)
        masks = coefficient.masks(device, [layer], grid)
    width, height = -(-grid.width // factor), -(-grid.height // factor)
    assert masks.grid.height == height
    assert masks.grid.width in (width, width + width % 2)
    assert not masks.grid.poles or masks.grid.width % 2 == 0
    expected = twin.coefficient_mask(pixels, layer.box, grid.border, masks.grid.border)
    assert 0.05 < expected.mean() < 0.9
    assert np.array_equal(masks.host[0], expected)
    assert np.array_equal(masks.buffers[0].get(), expected)
    assert np.array_equal(masks.only([0]).host, masks.host)


@pytest.mark.parametrize("name", NAMES)
def test_expand_and_ratio_equal_their_twins(device: Device, name: str) -> None:
    grid = GRIDS[name]
    half = grid.resized(-(-grid.width // 4) * 2, -(-grid.height // 2))
    ratio = (half.width / grid.width, half.height / grid.height)
    random = np.random.default_rng(8)
    distance = (random.random(half.shape) * 20).astype(np.float32)
    distance[random.random(half.shape) < 0.3] = 0
    total = (random.random(grid.shape) * 5 + 1).astype(np.float32)
    pixels, box = random_layer(9, 51, 19), (9, 2, 51, 19)
    expanded, sums = device.empty((19, 51)), device.upload(total)
    device.run(
        "coefficient", "coefficient_expand", box[2:], device.upload(distance), half.border, ratio,
        device.upload(pixels), box, grid.border, expanded, sums,
    )  # fmt: skip
    expected, expected_sums = twin.coefficient_expand(distance, half.border, ratio, pixels, box, total)
    assert 0 in expected
    assert 1e-3 in expected
    assert_close(expanded.get(), expected, POSITION)
    assert_close(sums.get(), expected_sums, POSITION)
    blend = device.upload(expected.astype(np.float32))
    device.run(
        "coefficient", "coefficient_ratio", box[2:], blend, box, grid.border,
        device.upload(expected_sums.astype(np.float32)),
    )  # fmt: skip
    assert_close(blend.get(), twin.coefficient_ratio(expected, box, expected_sums), SUM)


def test_twin_of_expand_is_linear_interpolation() -> None:
    """Against SciPy, on positions that lie between the mask pixels' centres."""
    random = np.random.default_rng(10)
    distance = random.random((27, 39)) + 0.5
    layer = np.ones((53, 77, 4))
    ratio = (39 / 77, 27 / 53)
    expanded, _ = twin.coefficient_expand(
        distance, (39, 27, 0, 0), ratio, layer, (0, 0, 77, 53), np.zeros((53, 77))
    )
    y, x = np.mgrid[0:53, 0:77] + 0.5
    places = [y * ratio[1] - 0.5, x * ratio[0] - 0.5]
    assert np.allclose(expanded, ndimage.map_coordinates(distance, places, order=1, mode="nearest"))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("factor", "even"), [(1, False), (2, False), (1, True)])
def test_coefficients_sum_to_one(device: Device, name: str, factor: int, even: bool) -> None:
    grid = GRIDS[name]
    layers = [
        on_device(device, random_layer(11, 41, grid.height), 0, 0),
        on_device(device, random_layer(12, grid.width - 20, 20), 20, 1),
        on_device(device, random_layer(13, grid.width, grid.height)),
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(coefficient, "_FINE_PIXELS", 10**6 if factor == 1 else 0)
        masks = coefficient.masks(device, layers, grid)
        result = coefficient.coefficients(device, layers, masks, grid, even)
    total, count = np.zeros(grid.shape), np.zeros(grid.shape)
    for layer, one in zip(layers, result, strict=True):
        left, top, width, height = layer.box
        blend, valid = one.get(), layer.pixels.get()[..., 3] > 0
        assert np.array_equal(blend > 0, valid)
        total[top : top + height, left : left + width] += blend
        count[top : top + height, left : left + width] += valid
        assert (blend[(count[top : top + height, left : left + width] == 1) & valid] <= 1).all()
    assert {0, 1, 2, 3} <= set(count.ravel())
    assert np.allclose(total[count > 0], 1, atol=3e-7)
    assert (total[count == 0] == 0).all()


def test_a_lone_layer_has_coefficient_one(device: Device) -> None:
    grid = plane()
    layer = on_device(device, random_layer(14, 50, 40), 7, 5)
    masks = coefficient.masks(device, [layer], grid)
    (result,) = coefficient.coefficients(device, [layer], masks, grid)
    assert np.array_equal(result.get(), layer.pixels.get()[..., 3])


def test_two_layers_are_blended_as_published(device: Device) -> None:
    """BlendR = Lmin / (Lmin + Rmin), with distances to the areas that only L or only R covers (Eq. 1)."""
    grid = plane()
    left, right = np.ones((53, 50, 4), np.float32), np.ones((53, 47, 4), np.float32)
    layers = [on_device(device, left, 0), on_device(device, right, 30)]
    masks = coefficient.masks(device, layers, grid)
    blends = coefficient.coefficients(device, layers, masks, grid)
    x = np.arange(30, 50)
    to_area1, to_area2 = x - 29, 50 - x
    assert np.allclose(blends[1].get()[:, :20], to_area1 / (to_area1 + to_area2), atol=1e-6)
    assert np.allclose(blends[0].get()[:, 30:], to_area2 / (to_area1 + to_area2), atol=1e-6)
    halves = coefficient.coefficients(device, layers, masks, grid, even=True)
    assert all((one.get()[:, both] == 0.5).all() for one, both in zip(halves, (x, x - 30), strict=True))


@pytest.mark.parametrize("shift", [1, 20, 39])
def test_turning_a_sphere_turns_the_distances(device: Device, shift: int) -> None:
    grid = sphere()
    masks = two_masks(15, grid)
    straight = kernel_distance(device, masks, 0, grid)
    turned = kernel_distance(device, [np.roll(m, shift, 1) for m in masks], 0, grid)
    assert np.allclose(np.roll(straight, shift, 1), turned, atol=0.3)
    assert (np.abs(np.roll(straight, shift, 1) - turned) > 1e-3).mean() < 0.01


def test_rows_beyond_a_pole_are_half_a_turn_further() -> None:
    """The twin of the border rule, against the sphere: the pixel beyond is where the direction leads."""
    grid = sphere(78, 39)
    lon0, across, lat0, down = grid.lonlat
    x, y = np.meshgrid(np.arange(-80, 160), np.r_[-39:0, 39:78])
    columns, rows, inside = grid_border(x, y, grid.border)
    assert inside.all()

    def direction(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        lon, lat = lon0 + (x + 0.5) * across, lat0 - (y + 0.5) * down
        return np.stack([np.cos(lat) * np.sin(lon), np.cos(lat) * np.cos(lon), np.sin(lat)])

    assert np.allclose(direction(x, y), direction(columns, rows), atol=1e-12)
    assert not grid_border(x, y, (78, 39, 1, 0))[2].any()
    assert np.array_equal(grid_border(x, y, (78, 39, 1, 1))[2], y < 0)

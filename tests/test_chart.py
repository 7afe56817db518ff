"""Charts of overlaps: transforms against SciPy's Rotation, sampling against its twin, twin against loops."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from grids import GRIDS, on_device, patches, plane, random_layer, sphere, window
from reference import common
from reference.chart import chart_sample, tent
from scipy import ndimage
from scipy.spatial.transform import Rotation
from tolerances import DECISIONS, POSITION, TRIGONOMETRY, assert_close

from hugin_abflow import chart
from hugin_abflow.chart import Chart, pair_chart
from hugin_abflow.grid import Grid
from hugin_abflow.opencl import Device

FLOOR = 0.05


def disc(grid: Grid, x: float, y: float, radius: float) -> np.ndarray:
    """An overlap: pixels within a radius (columns) of a place, on the sphere by angle."""
    columns, rows = common.pixels(grid.width, grid.height)
    points = common.canvas_point(columns + 0.5, rows + 0.5, grid.lonlat)
    centre = common.canvas_point(np.array(x), np.array(y), grid.lonlat)
    if grid.lonlat[1]:
        return np.arccos(np.clip(points @ centre, -1, 1)) < radius * grid.lonlat[1]
    dx = np.abs(points[..., 0] - x)
    return np.hypot(np.minimum(dx, grid.width - dx) if grid.wraps else dx, points[..., 1] - y) < radius


def ring(grid: Grid, rows: slice) -> np.ndarray:
    overlap = np.zeros(grid.shape, bool)
    overlap[rows] = True
    return overlap


OVERLAPS = {
    "plane": (plane(), disc(plane(), 30, 20, 8)),
    "plane corner": (plane(), disc(plane(), 76, 1, 8)),
    "cylinder": (plane(wraps=True), disc(plane(wraps=True), 30, 20, 8)),
    "cylinder border": (plane(wraps=True), disc(plane(wraps=True), 2, 20, 8)),
    "cylinder ring": (plane(wraps=True), ring(plane(wraps=True), slice(10, 30))),
    "sphere": (sphere(), disc(sphere(), 30, 20, 8)),
    "sphere border": (sphere(), disc(sphere(), 77, 15, 8)),
    "sphere pole": (sphere(), disc(sphere(), 20, 3, 9)),
    "sphere south": (sphere(), disc(sphere(), 20, 39, 5)),
    "sphere ring": (sphere(), ring(sphere(), slice(15, 25))),
    "sphere meridian": (sphere(), np.abs(np.mod(np.arange(78), 39) - 20) * np.ones((39, 1)) < 3),
    "odd sphere": (sphere(77, 39), disc(sphere(77, 39), 0, 12, 8)),
    "window": (window(), disc(window(), 30, 20, 8)),
    "everything": (sphere(), ring(sphere(), slice(0, 39))),
}  # fmt: skip


@pytest.fixture(params=[(name, coarse) for name in OVERLAPS for coarse in (1, 2)], ids=str)
def overlap(request: pytest.FixtureRequest) -> tuple[Grid, np.ndarray, Chart]:
    name, coarse = request.param
    grid, mask = OVERLAPS[name]
    return grid, mask, pair_chart(mask, grid, grid, coarse)


def test_twins_of_the_transforms_are_scipys_rotation() -> None:
    """A chart is the canvas's equirectangular projection after a rotation of the scene."""
    rotation = Rotation.from_euler("zyx", [0.7, -1.1, 2.3])
    transform = np.zeros(16)
    transform[:9] = rotation.as_matrix().ravel()
    transform[9:14] = 12.5, 11.5, 40, 20, 1
    u, v = np.meshgrid(np.linspace(2, 78, 23), np.linspace(3, 37, 17))
    lon, lat = (u - 40) / 12.5, (20 - v) / 11.5
    # SciPy's own way to a direction: turn the forward axis up by lat, then around z to the right by lon
    straight = Rotation.from_euler("ZX", np.stack([-lon.ravel(), lat.ravel()], 1)).apply([0, 1, 0])
    points = common.chart_point(u, v, transform)
    assert np.allclose(points.reshape(-1, 3), rotation.inv().apply(straight))
    assert np.allclose(common.chart_position(points, transform), [u, v])


@pytest.mark.parametrize("name", list(GRIDS))
def test_twins_of_the_canvas_transforms_are_inverse(name: str) -> None:
    grid = GRIDS[name]
    x, y = (places + 0.3 for places in common.pixels(grid.width, grid.height))
    point = common.canvas_point(x, y, grid.lonlat)
    assert np.allclose(common.canvas_position(point, grid.lonlat), [x, y])
    if grid.lonlat[1]:
        lon, lat = grid.lonlat[0] + x * grid.lonlat[1], grid.lonlat[2] - y * grid.lonlat[3]
        back = Rotation.from_euler("ZX", np.stack([-lon.ravel(), lat.ravel()], 1))
        assert np.allclose(back.apply([0, 1, 0]).reshape(point.shape), point)


def test_a_chart_holds_its_overlap_with_a_margin(overlap: tuple[Grid, np.ndarray, Chart]) -> None:
    """Every overlap pixel lies on the chart, and on a plane so does what lies up to 16 px beside it."""
    grid, mask, found = overlap
    assert found.transform.dtype == np.float32
    columns, rows = common.pixels(grid.width, grid.height)
    near = ndimage.binary_dilation(mask, iterations=3) if not grid.wraps else mask
    u, v = common.chart_position(
        common.canvas_point(columns[near] + 0.5, rows[near] + 0.5, grid.lonlat), found.transform
    )
    assert (u >= 0).all()
    assert (u <= found.width).all()
    assert (v >= 0).all()
    assert (v <= found.height).all()
    if found.wraps:
        assert found.width % 128 == 0


@pytest.mark.parametrize("name", ["sphere", "sphere border", "sphere pole", "sphere south", "odd sphere"])
@pytest.mark.parametrize("coarse", [1, 2])
def test_a_chart_has_hardly_any_stretch(name: str, coarse: int) -> None:
    """On a round overlap anywhere, over a pole too, a chart pixel is about one working pixel, or two."""
    grid, mask = OVERLAPS[name]
    found = pair_chart(mask, grid, grid, coarse)
    columns, rows = common.pixels(grid.width, grid.height)
    point = common.canvas_point(columns[mask] + 0.5, rows[mask] + 0.5, grid.lonlat)
    _, v = common.chart_position(point, found.transform)
    stretch = 1 / np.cos((found.transform[12] - v) / found.transform[10])
    assert stretch.max() < 1.5
    # chart px per working px along the chart's meridians
    assert found.transform[10] * grid.lonlat[1] == pytest.approx(1 / coarse)


@pytest.mark.parametrize("name", ["sphere ring", "everything", "cylinder ring"])
def test_a_chart_around_everything_wraps(name: str) -> None:
    grid, mask = OVERLAPS[name]
    assert pair_chart(mask, grid, grid).wraps


@pytest.mark.parametrize("name", ["cylinder", "cylinder border", "plane", "window"])
def test_a_chart_of_a_patch_does_not_wrap(name: str) -> None:
    grid, mask = OVERLAPS[name]
    assert not pair_chart(mask, grid, grid).wraps


@pytest.mark.parametrize("name", [name for name in OVERLAPS if name.startswith("sphere")])
def test_bearings_are_what_positions_are_of(name: str) -> None:
    """In the chart's own axes."""
    grid, mask = OVERLAPS[name]
    found = pair_chart(mask, grid, grid)
    rng = np.random.default_rng(5)
    places = rng.uniform((1, 1), (found.width - 1, found.height - 1), (50, 2))
    points = found.projection.bearings(places) @ found.transform[:9].reshape(3, 3).astype(np.float64)
    assert np.allclose(np.linalg.norm(points, axis=1), 1)
    assert np.allclose(found.positions(points), places, atol=1e-3)


@pytest.mark.parametrize("name", OVERLAPS)
def test_a_finer_chart_shows_the_same_places(name: str) -> None:
    """In twice as many pixels each way; what is seen in a direction, too."""
    grid, mask = OVERLAPS[name]
    coarse = pair_chart(mask, grid, grid, 2)
    fine = coarse.finer()
    assert (fine.width, fine.height, fine.wraps) == (2 * coarse.width, 2 * coarse.height, coarse.wraps)
    assert (coarse.coarse, fine.coarse) == (2, 1)
    columns, rows = common.pixels(grid.width, grid.height)
    points = common.canvas_point(columns + 0.5, rows + 0.5, grid.lonlat)[mask]
    assert np.allclose(fine.positions(points), 2 * coarse.positions(points), atol=1e-4)
    assert fine.circumference(grid) == pytest.approx(2 * coarse.circumference(grid))
    for one in (coarse, fine):
        around = one.circumference(grid) if grid.wraps else 2 * np.pi * one.transform[9] * one.spherical
        assert one.period == pytest.approx(around)
    if coarse.projection:
        places = np.random.default_rng(1).uniform(0, coarse.height, (50, 2))
        assert np.allclose(fine.projection.bearings(2 * places), coarse.projection.bearings(places))


def test_a_wrapped_plane_has_one_copy_of_each_point() -> None:
    """On a cylinder positions one turn apart are the same chart position, and within the first period."""
    grid, mask = OVERLAPS["cylinder border"]
    found = pair_chart(mask, grid, grid)
    x = np.linspace(-70, 150, 441)
    here = common.canvas_point(x, np.full_like(x, 20.0), grid.lonlat)
    there = common.canvas_point(x + 77, np.full_like(x, 20.0), grid.lonlat)
    u = common.chart_position(here, found.transform)[0]
    assert np.allclose(u, common.chart_position(there, found.transform)[0])
    assert u.min() >= 0
    assert u.max() < 77


def test_a_finer_mask_grid_gives_the_same_chart() -> None:
    """The overlap may be known on another grid over the same region."""
    grid = plane(154, 106)
    small = plane()
    mask = disc(small, 30, 20, 8)
    coarse = pair_chart(mask, small, grid)
    fine = pair_chart(np.kron(mask, np.ones((2, 2), bool)), grid, grid)
    assert (coarse.width, coarse.height) == (fine.width, fine.height)
    assert np.array_equal(coarse.transform, fine.transform)


def brute_force_bicubic(layer: np.ndarray, x: float, y: float) -> np.ndarray:
    """Keys' cubic (a = -1/2) at a position, tap by tap; the caller stays inside."""

    def weight(distance: float) -> float:
        d = abs(distance)
        if d < 1:
            return 1.5 * d**3 - 2.5 * d**2 + 1
        return -0.5 * d**3 + 2.5 * d**2 - 4 * d + 2 if d < 2 else 0.0

    total = np.zeros(4)
    for j in range(math.floor(y) - 1, math.floor(y) + 3):
        for i in range(math.floor(x) - 1, math.floor(x) + 3):
            total += weight(x - i) * weight(y - j) * layer[j, i]
    return total


def test_twin_of_sample_is_bicubic() -> None:
    layer = random_layer(0, 77, 53).astype(np.float64)
    layer[..., 3] = 1
    transform = np.zeros(16)
    transform[9:13] = 1.3, 1.2, -11.7, -9.1
    image, mask = chart_sample(
        layer, (0, 0, 77, 53), plane().border, plane().lonlat, transform, (59, 31), FLOOR
    )
    assert mask.all()
    for j, i in np.ndindex(31, 59):
        colour = brute_force_bicubic(layer, (i + 0.5 + 11.7) / 1.3 - 0.5, (j + 0.5 + 9.1) / 1.2 - 0.5)
        brightness = max(colour[0], 0) * 0.299 + max(colour[1], 0) * 0.587 + max(colour[2], 0) * 0.114
        assert image[j, i] == pytest.approx(math.log(brightness + FLOOR), abs=1e-9)


@pytest.mark.parametrize("a", [-0.5, -2 / 3])
def test_cubic_is_exact_on_constants_and_on_pixels_and_near_it_on_parabolas(a: float) -> None:
    """With a slope of -1/2, Catmull and Rom's, on parabolas as well."""
    t = np.linspace(0, 1, 17)
    taps = common.cubic_taps(t, a)
    assert np.allclose(taps.sum(0), 1)
    for power, off in ((1, 0.2), (2, 0.6)):
        assert np.allclose(np.arange(-1, 3) ** power @ taps, t**power, atol=off * abs(a + 0.5) + 1e-9)
    assert np.array_equal(common.cubic_taps(np.array([0.0]), a)[:, 0], [0, 1, 0, 0])


def test_tent_averages_what_is_finer_than_every_second_pixel() -> None:
    """It keeps what is even or sloping, and nothing of what changes from pixel to pixel."""
    t = np.linspace(0, 1, 17)
    taps = tent(t)
    assert np.allclose(taps.sum(0), 1)
    assert np.allclose(np.arange(-1, 3) @ taps, t)
    assert np.allclose([1, -1, 1, -1] @ taps, 0)
    assert np.array_equal(tent(np.array([0.0]))[:, 0], [0.25, 0.5, 0.25, 0])


def test_sample_equals_its_twin(device: Device, overlap: tuple[Grid, np.ndarray, Chart]) -> None:
    """On ragged layers; the mask's decisions may fall either way where a tap's weight is all but 0."""
    grid, _, found = overlap
    pixels = random_layer(1, grid.width, grid.height, 0.9)
    level = chart.sample(device, on_device(device, pixels), grid, found)
    size = (found.width, found.height)
    image, mask = chart_sample(
        pixels, (0, 0, grid.width, grid.height), grid.border, grid.lonlat, found.transform, size, FLOOR,
        found.coarse,
    )  # fmt: skip
    assert level.grid == (*size, int(found.wraps), 0)
    assert 0.2 < mask.mean() < 1
    kernel = level.mask.get()
    assert (kernel != mask).mean() <= DECISIONS
    same = kernel == mask
    # random pixels change by their whole range from one to the next: positions' rounding shows
    assert_close(level.image.get()[same], image[same], 10 * POSITION, DECISIONS)


def test_sample_of_a_layer_with_a_box_equals_its_twin(device: Device) -> None:
    grid, mask = OVERLAPS["sphere pole"]
    found = pair_chart(mask, grid, grid)
    pixels = random_layer(2, 41, 23, 0.9)
    level = chart.sample(device, on_device(device, pixels, 9, 0), grid, found)
    image, expected = chart_sample(
        pixels, (9, 0, 41, 23), grid.border, grid.lonlat, found.transform, (found.width, found.height), FLOOR
    )
    same = level.mask.get() == expected
    assert (~same).mean() <= DECISIONS
    assert_close(level.image.get()[same], image[same], 10 * POSITION, DECISIONS)


def test_on_a_plane_a_chart_copies_pixels(device: Device) -> None:
    """No interpolation between equal grids: flow between equal layers must be exactly zero."""
    pixels = random_layer(3, 77, 53)
    grid = plane()
    found = pair_chart(disc(grid, 40, 30, 12), grid, grid)
    level = chart.sample(device, on_device(device, pixels), grid, found)
    left, top = (-found.transform[11:13]).astype(int)
    part = pixels[top : top + found.height, left : left + found.width]
    assert np.array_equal(level.mask.get(), part[..., 3])
    grey = np.log(part[..., :3] @ [0.299, 0.587, 0.114] + FLOOR) * part[..., 3]
    assert_close(level.image.get(), grey, TRIGONOMETRY)


@pytest.mark.parametrize("rounding", [-1e-6, 0.0, 1e-6])
def test_whole_pixels_but_for_rounding_are_copies(device: Device, rounding: float) -> None:
    """A tap whose weight is only rounding neither changes a colour nor fails a mask."""
    pixels = random_layer(7, 154, 106, 0.8)
    grid = plane(154, 106)
    found = Chart(
        np.array([0] * 9 + [(1 + rounding) / 3, (1 + rounding) / 3, 0, 0, 0, 0, 0], np.float32), 50, 34, False
    )
    level = chart.sample(device, on_device(device, pixels), grid, found)
    part = pixels[1:102:3, 1:150:3]
    assert np.array_equal(level.mask.get(), part[..., 3])
    grey = np.log(part[..., :3] @ [0.299, 0.587, 0.114] + FLOOR) * part[..., 3]
    assert_close(level.image.get(), grey, TRIGONOMETRY)


def test_over_a_pole_a_chart_is_smooth(device: Device) -> None:
    """A scene that is smooth on the sphere is smooth on a chart over its pole: every tap was right."""
    grid = sphere(402, 201)
    columns, rows = common.pixels(grid.width, grid.height)
    point = common.canvas_point(columns + 0.5, rows + 0.5, grid.lonlat)
    brightness = 0.5 + 0.2 * point[..., 0] - 0.15 * point[..., 1] + 0.1 * point[..., 2]
    pixels = np.stack([brightness] * 3 + [np.ones_like(brightness)], -1).astype(np.float32)
    for y in (2, 199):
        found = pair_chart(disc(grid, 50, y, 30), grid, grid)
        level = chart.sample(device, on_device(device, pixels), grid, found)
        assert level.mask.get().all()
        u, v = common.pixels(found.width, found.height)
        there = common.chart_point(u + 0.5, v + 0.5, found.transform)
        expected = 0.5 + 0.2 * there[..., 0] - 0.15 * there[..., 1] + 0.1 * there[..., 2]
        assert np.allclose(np.exp(level.image.get()) - FLOOR, expected, atol=2e-5)


def test_a_grid_without_poles_ends_at_its_rows(device: Device) -> None:
    """The same layer on the same rows, but the grid says that there is no pole beyond row 0."""
    grid = sphere()
    pixels = random_layer(4, 78, 39)
    pixels[..., 3] = 1
    found = pair_chart(disc(grid, 20, 2, 9), grid, grid)
    beyond = [
        chart.sample(device, on_device(device, pixels), g, found).mask.get()
        for g in (grid, replace(grid, poles=0))
    ]
    assert beyond[0].all()
    assert 0 < (beyond[1] == 0).sum() < 60


def test_margins_of_masks_keep_black_out(device: Device) -> None:
    """What lies outside a mask never counts: the same with other values there."""
    mask = patches(5, 77, 53, 0.8)
    grid = plane(wraps=True)
    found = Chart(np.array([0] * 9 + [1.3, 1.2, 4.4, 3.3, 0, 77, 0], np.float32), 90, 60, False)
    images = []
    for outside in (0.0, 7.0):
        pixels = random_layer(6, 77, 53, 1.0)
        pixels[mask == 0] = outside
        pixels[..., 3] = mask
        images.append(chart.sample(device, on_device(device, pixels), grid, found).image.get())
    assert np.array_equal(*images)


@pytest.mark.parametrize("wraps", [False, True])
@pytest.mark.parametrize("across", [False, True])
@pytest.mark.parametrize("place", [0, 41, 42, 100])
def test_a_strip_of_a_pixel_has_a_chart(wraps: bool, across: bool, place: int) -> None:
    """On charts of half the resolution as well, of an odd size: it lies within."""
    grid = plane(101, 101, wraps=wraps)
    overlap = np.zeros(grid.shape, bool)
    overlap[(place, slice(None)) if across else (slice(None), place)] = True
    for coarse in (1, 2):
        found = pair_chart(overlap, grid, grid, coarse)
        points = np.argwhere(overlap)[:, ::-1] + 0.5
        x, y = found.positions(np.column_stack([points, np.zeros(len(points))])).T
        assert (x >= 0).all() and (x <= found.width).all() and (y >= 0).all() and (y <= found.height).all()

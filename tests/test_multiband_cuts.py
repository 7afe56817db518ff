"""A multi-band blend of layers that were cut: what is seen along the cuts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from grids import GRIDS, boxes, on_device, patches, plane, random_layer, sphere
from pictures import masked, merged, one_device
from reference import multiband as twin
from reference.blend import read_field
from reference.common import EXPOSURE_FLOOR, Array
from scipy import ndimage
from tolerances import SUM, assert_close

from hugin_abflow import multiband
from hugin_abflow.colour import Correction
from hugin_abflow.content import Unlike
from hugin_abflow.grid import Grid
from hugin_abflow.layer import Canvas
from hugin_abflow.opencl import Device

shared_device = pytest.mark.usefixtures(one_device.__name__)


def flat(grid: Grid, *colour: float) -> Array:
    pixels = np.ones((*grid.shape, 4), np.float32)
    pixels[..., :3] = colour
    return pixels


def offsets(
    device: Device,
    grid: Grid,
    pictures: Sequence[Array],
    weights: Sequence[Array],
    places: Sequence[tuple[int, int, int, int]] | None = None,
    dtype: type = np.uint8,
    unlike: Unlike | None = None,
) -> list[Array]:
    """What is added to each layer, (height, width, 3) on its box, as it is read there. pictures: on the whole
    grid."""
    layers, fields = [], []
    for k, (picture, weight) in enumerate(zip(pictures, weights, strict=True)):
        left, top, width, height = places[k] if places else (0, 0, grid.width, grid.height)
        part = np.s_[top : top + height, left : left + width]
        layers.append(on_device(device, picture[part], left, top, dtype))
        field = np.zeros((height, width, 4), np.float32)
        field[..., 3] = weight[part]
        fields.append(device.upload(field))
    gains = Correction(grid.resized(7, 5), float(np.dtype(dtype).kind == "u"), (None,) * len(layers))
    found = multiband.offsets(device, layers, fields, gains, grid, unlike)
    result = []
    for layer, offset in zip(layers, found.layers, strict=True):
        assert offset is not None
        places_ = twin.place(layer.box, grid.border, found.grid.border)
        read = read_field(offset[1].get(), offset[0], *places_, found.grid.border)
        result.append(read[..., :3].astype(np.float32))
    return result


def noise(grid: Grid, seed: int) -> Array:
    return np.random.default_rng(seed).normal(size=grid.shape)


def sides_of(grid: Grid, column: int) -> list[Array]:
    """Weights of two layers that are cut at a column."""
    left = np.broadcast_to((np.arange(grid.width) < column)[None], grid.shape).astype(np.float32)
    return [left, 1 - left]


def blended(pictures: Sequence[Array], found: Sequence[Array], weights: Sequence[Array]) -> Array:
    """The weighted mean of layers on the whole grid, each with its offset."""
    shown = [p[..., :3] + o for p, o in zip(pictures, found, strict=True)]
    return sum(s * w[..., None] for s, w in zip(shown, weights, strict=True)) / sum(weights)[..., None]


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_equal_layers_are_left_alone(device: Device, name: str, dtype: type) -> None:
    """However they are weighed, exactly."""
    grid = GRIDS[name]
    picture = random_layer(1, grid.width, grid.height, 0.8)
    weights = [np.random.default_rng(k).random(grid.shape) ** 8 for k in range(3)]
    weights[1] *= patches(3, grid.width, grid.height, 0.4)
    found = offsets(device, grid, [picture] * 3, weights, dtype=dtype)
    assert len(found) == 3
    assert not np.any(found)


@pytest.mark.parametrize("wraps", [False, True])
@pytest.mark.parametrize("overlap", [4, 16, 64])
def test_layers_that_agree_where_both_are_do_not_change(device: Device, wraps: bool, overlap: int) -> None:
    """However narrow their overlap, although none of them knows what lies beside it."""
    grid = plane(256, 128, wraps)
    picture = flat(grid, 0)
    smooth = ndimage.gaussian_filter(
        noise(grid, 1), (12, 12), mode=("nearest", "wrap" if wraps else "nearest")
    )
    picture[..., :3] = (0.5 + 0.15 * smooth / smooth.std())[..., None]
    column = np.arange(256)[None]
    inner = (column >= 64 - overlap // 2) & (column < 192 + overlap // 2)
    outer = (column < 64 + overlap // 2) | (column >= 192 - overlap // 2)
    own = np.broadcast_to((column >= 64) & (column < 192), grid.shape).astype(np.float32)
    found = offsets(device, grid, [picture * c[..., None] for c in (inner, outer)], [own, 1 - own])
    assert not any(offset.any() for offset in found)


@shared_device
@pytest.mark.parametrize("sphere", [True, False])
def test_photos_that_agree_stay_as_they_are_beside_the_tip_of_an_overlap(sphere: bool) -> None:
    """Where two end in a V, each is smoothed along rows by itself: not before it is compared."""
    width, height = 401, 201
    picture = np.random.default_rng(5).normal(size=(height, width, 3))
    picture = ndimage.gaussian_filter(picture, (2, 2, 0))
    picture = np.clip(128 + 60 * picture / picture.std(), 16, 239).round()
    y, x = np.mgrid[:height, :width]
    covered = [(x > 100) & (x - 200 < (146 - y) * 0.7), (x < 300) & (200 - x < (146 - y) * 0.7)]
    layers = []
    for seed, part in enumerate(covered):
        photo = picture + np.random.default_rng(seed).integers(-1, 2, picture.shape)
        opaque = np.dstack([photo, np.full((height, width), 255)]).astype(np.uint8)
        layers.append(masked(opaque, part & (y < 150)))
    canvas = Canvas.sphere(width, height) if sphere else Canvas.plane(width, height)
    result = merged(layers, canvas, flow=False)
    off = np.abs(result[..., :3] - picture).max(-1)[(covered[0] | covered[1]) & (y < 150)]
    assert off.max() < 4


def test_weights_that_are_the_same_everywhere_give_the_weighted_mean(device: Device) -> None:
    """Of what each layer shows, for every frequency that half the grid has; both layers become the blend."""
    grid = plane(256, 128, wraps=True)
    pictures = [random_layer(k, grid.width, grid.height, 2) for k in (1, 2)]
    for picture in pictures:
        smooth = ndimage.gaussian_filter(picture[..., :3], (9, 9, 0), mode=("nearest", "wrap", "nearest"))
        picture[..., :3] = 0.5 + 0.1 * (smooth - 0.5) / smooth.std()
    weights = [np.full(grid.shape, w, np.float32) for w in (0.5, 1.5)]
    found = offsets(device, grid, pictures, weights)
    mean = 0.25 * pictures[0][..., :3] + 0.75 * pictures[1][..., :3]
    for picture, offset in zip(pictures, found, strict=True):
        assert np.abs(picture[..., :3] - mean).max() > 0.2
        assert np.abs(picture[..., :3] + offset - mean).max() < 0.05


@pytest.mark.parametrize("overlap", [256, 64])
def test_a_step_between_two_layers_is_spread(device: Device, overlap: int) -> None:
    """Flat ones, cut in the middle, which overlap wholly or in part: from one colour to the other
    with no step to be seen nor way back."""
    grid = plane(256, 128)
    pictures, weights = [flat(grid, 0.3, 0.5, 0.6), flat(grid, 0.5, 0.3, 0.6)], sides_of(grid, 128)
    wide = 128 + overlap // 2
    places = [(0, 0, wide, 128), (256 - wide, 0, wide, 128)]
    found = [np.zeros((*grid.shape, 3), np.float32) for _ in places]
    for whole, place, part in zip(
        found, places, offsets(device, grid, pictures, weights, places), strict=True
    ):
        whole[:, place[0] : place[0] + place[2]] = part
    result = blended(pictures, found, weights)
    steps = np.diff(result, axis=1)
    assert np.abs(steps).max() < 0.01
    assert steps[..., 0].min() > -10 * SUM and steps[..., 1].max() < 10 * SUM
    assert np.abs(result[..., 2] - 0.6).max() < 10 * SUM
    assert np.abs(result[:, 0] - pictures[0][:, 0, :3]).max() < 0.01
    assert np.abs(result[:, -1] - pictures[1][:, -1, :3]).max() < 0.01
    middle = np.abs(result[..., 0] - 0.4) < 0.06
    assert middle.sum(1).min() > 30  # it is spread widely


def fine(picture: Array) -> Array:
    """The texture of pixels (height, width, 3) that is finer than some pixels."""
    return picture - ndimage.gaussian_filter(picture, (1.5, 1.5, 0))


@pytest.mark.parametrize("kind", ["checkerboard", "noise"])
def test_fine_texture_changes_over_at_the_cut(device: Device, kind: str) -> None:
    """Texture that the layers do not share is as it was 8 px from the cut, neither mixed nor paler; their
    brightness is spread."""
    grid = plane(256, 128)
    contrasts, pictures = (0.2, 0.1), []
    for k, contrast in enumerate(contrasts):
        one = noise(grid, k) if kind == "noise" else np.indices(grid.shape).sum(0) % 2 * 2.0 - 1
        own = fine(one[..., None])
        pictures.append(flat(grid, 0))
        pictures[-1][..., :3] = (0.45, 0.55)[k] + (-1) ** k * contrast * own / own.std()
    weights = sides_of(grid, 128)
    found = offsets(device, grid, pictures, weights)
    away = [np.s_[:, :120], np.s_[:, 136:]]
    for picture, offset, contrast, there in zip(pictures, found, contrasts, away, strict=True):
        mixed = fine(picture[..., :3] + offset) - fine(picture[..., :3])
        assert np.abs(offset[there]).max() > 0.02
        assert mixed[there].std() < 0.01 * contrast
    bright = ndimage.uniform_filter1d(blended(pictures, found, weights)[..., 0].mean(0), 8)
    assert np.abs(np.diff(bright)).max() < 0.01


@pytest.mark.parametrize("name", ["cylinder", "sphere"])
def test_a_turned_canvas_gives_the_turned_result(device: Device, name: str) -> None:
    """By a whole number of pixels of the coarsest level."""
    grid = sphere(256, 128) if name == "sphere" else plane(256, 128, wraps=True)
    pictures = [random_layer(k, 256, 128, 0.9) for k in (1, 2, 3)]
    weights = [np.random.default_rng(k).random(grid.shape).astype(np.float32) ** 8 for k in range(3)]
    first = offsets(device, grid, pictures, weights)
    turn = 2 ** (len(multiband.levels(grid)) - 1)
    assert turn == 32
    for columns in turn, 5 * turn:
        turned = [[np.roll(one, columns, 1) for one in ones] for ones in (pictures, weights)]
        for one, other in zip(first, offsets(device, grid, *turned), strict=True):
            assert np.abs(one).max() > 0.2
            assert_close(other, np.roll(one, columns, 1), 10 * SUM)


@pytest.mark.parametrize("name", list(GRIDS))
def test_the_order_of_layers_does_not_matter(device: Device, name: str) -> None:
    grid = GRIDS[name]
    places = boxes(grid)
    pictures = [random_layer(k, grid.width, grid.height, 0.9) for k in (1, 2, 3)]
    weights = [np.random.default_rng(k).random(grid.shape).astype(np.float32) for k in range(3)]
    first = offsets(device, grid, pictures, weights, places)
    second = offsets(device, grid, pictures[::-1], weights[::-1], places[::-1])
    for one, other in zip(first, second[::-1], strict=True):
        assert_close(other, one, 10 * SUM)


def star(device: Device) -> tuple[float, float]:
    """How much of the layers' difference is seen along the first row, at the pole, and along the last."""
    grid = sphere(256, 128)
    quarter = np.broadcast_to(np.arange(256) // 64 == 1, grid.shape).astype(np.float32)
    pictures, weights = [flat(grid, 0.3), flat(grid, 0.5)], [quarter, 1 - quarter]
    result = blended(pictures, offsets(device, grid, pictures, weights), weights)[..., 0]
    assert np.ptp(result[64]) > 0.14  # both are seen at the equator
    return np.ptp(result[0]) / 0.2, np.ptp(result[-1]) / 0.2


def test_at_a_pole_there_is_no_star(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two layers that are cut along meridians, a quarter and the rest: what the pole's pixels show, which are
    one place, differs by 4 % of the layers' difference; by 29 % if no level is spread along its rows."""
    assert max(star(device)) < 0.1
    monkeypatch.setattr(multiband, "_widths", lambda grid: np.full(grid.height, 0.7, np.float32))
    assert min(star(device)) > 0.2


@pytest.mark.parametrize("light", [0.5, 20.0])
def test_floats_change_over_by_factors(device: Device, light: float) -> None:
    """From one to double of it, through what is between, with steps of few percent."""
    grid = plane(256, 128)
    pictures, weights = [flat(grid, light), flat(grid, 2 * light)], sides_of(grid, 128)
    found = offsets(device, grid, pictures, weights, dtype=np.float32)
    result = sum(
        ((p[..., 0] + EXPOSURE_FLOOR) * np.exp(o[..., 0]) - EXPOSURE_FLOOR) * w
        for p, o, w in zip(pictures, found, weights, strict=True)
    )
    assert light * 0.999 <= result.min() < light * 1.05
    assert light * 2.001 >= result.max() > light * 1.9
    steps = np.diff(np.log(result), axis=1)
    assert steps.min() > -10 * SUM and steps.max() < 0.04


def test_offsets_do_not_drop_beside_what_a_layer_shows(device: Device) -> None:
    """They are read between pixels, so there are some beside it as well: around a hole they are as smooth as
    elsewhere, to the last pixel."""
    grid = plane(256, 128)
    pictures, weights = [flat(grid, 0.3), flat(grid, 0.5)], sides_of(grid, 128)
    hole = np.zeros(grid.shape, bool)
    hole[50:60, 101:120] = True
    pictures[0][hole] = 0
    weights[1][hole] = 1
    offset = offsets(device, grid, pictures, weights)[0][..., 0]
    rim = ndimage.binary_dilation(hole) & ~hole
    around = ndimage.binary_dilation(hole, iterations=3) & ~hole
    beyond = around & ~rim
    sums, counts = (ndimage.convolve(v * 1.0, np.ones((5, 5))) for v in (offset * beyond, beyond))
    nearby = sums / np.maximum(counts, 1)
    assert offset[rim].max() > 0.03
    assert np.abs(offset - nearby)[rim].max() < 0.02


@pytest.mark.parametrize("turned", [0, 70])
@pytest.mark.parametrize("ends", [88, 160])
def test_a_layer_that_is_seen_up_to_its_border_ends_without_a_step(
    device: Device, turned: int, ends: int
) -> None:
    """Such as one that is not clipped, before a brighter one that goes on. However wide the overlap is."""
    grid = plane(256, 128, wraps=True)
    columns = np.broadcast_to(np.arange(256), grid.shape)
    first, second = (columns >= 10) & (columns < ends), (columns < 16) | (columns >= 80)
    pictures = [flat(grid, light) * mask[..., None] for light, mask in ((0.6, first), (0.5, second))]
    weights = [first * 1.0, (second & ~first) * 1.0]
    pictures, weights = ([np.roll(one, turned, 1) for one in ones] for ones in (pictures, weights))
    result = np.roll(blended(pictures, offsets(device, grid, pictures, weights), weights), -turned, 1)[..., 0]
    assert np.abs(np.diff(result, axis=1)).max() < 0.02
    assert result[64, 48] > 0.57 and result[64, 208] < 0.53


@pytest.mark.parametrize("turned", [0, 96])
@pytest.mark.parametrize("flow_tells", [True, False])
def test_a_thing_leaves_no_shade_beside_it(device: Device, turned: int, flow_tells: bool) -> None:
    """Which one of two layers shows, beside the cut, and which is not taken from it; the layers differ by a
    little else, which is spread as ever, also across the thing."""
    grid = plane(256, 128, wraps=True)
    pictures, weights = [flat(grid, 0.6), flat(grid, 0.65)], sides_of(grid, 128)
    weights = [np.roll(one, turned, 1) for one in weights]
    cells = np.zeros((16, 32), bool)
    cells[5:11, (np.arange(16, 22) + turned // 8) % 32] = True  # beside the cut, or across the border
    thing = np.kron(ndimage.binary_erosion(np.tile(cells, 3))[:, 32:64], np.ones((8, 8), bool))
    assert thing.any()
    shown = [pictures[0].copy(), pictures[1]]
    shown[0][thing, :3] = 0.2
    clean = blended(pictures, offsets(device, grid, pictures, weights), weights)
    values = cells.astype(np.float32), 0 * cells.astype(np.float32)
    left = []
    for unlike in (Unlike(grid.coarser(8), *values[:: 1 if flow_tells else -1]), None):
        result = blended(shown, offsets(device, grid, shown, weights, unlike=unlike), weights)
        left.append(np.abs(result - clean).max())
    assert left[0] < 0.003 < 0.03 < left[1]


def test_what_is_too_small_to_be_halved_is_left_alone(device: Device) -> None:
    grid = plane(40, 7)
    layers = [on_device(device, flat(grid, c)) for c in (0.3, 0.5)]
    fields = [device.zeros((*grid.shape, 4))] * 2
    found = multiband.offsets(device, layers, fields, Correction(grid, 1.0, (None, None)), grid)
    assert found == multiband.none(grid, 2)
    assert found.layers == (None, None)

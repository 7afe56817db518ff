"""One layer, whole, where flow explains nothing: the kernels, residuals, what yields."""

from __future__ import annotations

import math
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from grids import GRIDS, patches, plane, random_layer
from labels import label
from reference.seam import seam_clamp, seam_difference, seam_shown, seam_weights, seam_yield
from scipy import ndimage
from tolerances import POSITION, SUM, assert_close

from hugin_abflow import seam
from hugin_abflow.cells import averaged, centres
from hugin_abflow.geometry import Pair
from hugin_abflow.grid import Grid, on_cells
from hugin_abflow.opencl import Device
from hugin_abflow.regions import Residuals, seen
from hugin_abflow.scene import Scene

WRAPS = [False, True]


def whole_layer(device: Device, width: int, height: int) -> SimpleNamespace:
    """A white working layer without holes."""
    return SimpleNamespace(
        box=(0, 0, width, height), pixels=device.upload(np.ones((height, width, 4), np.float32))
    )


# The kernel


def test_twin_of_yield_reads_scipys_zoom() -> None:
    """A layer's weight to the power 1 - s, times (1 - y) ** 4, with y and s between the cells' centres; never
    quite nothing.
    """
    yields, same = (patches(k, 13, 9, 0.5, 3).astype(np.float64) for k in (0, 1))
    field = np.random.default_rng(1).random((40, 60, 4))
    for wraps in WRAPS:
        result = seam_yield(
            field, (11, 7, 60, 40), (77, 53, int(wraps), 0), yields, same, (13, 9, int(wraps), 0), seam._TRACE
        )  # fmt: skip
        y, x = np.mgrid[7:47, 11:71] + 0.5
        read, alike = (
            ndimage.map_coordinates(
                np.pad(np.pad(one, ((1, 1), (0, 0)), "edge"), ((0, 0), (1, 1)), "wrap" if wraps else "edge"),
                [y * 9 / 53 + 0.5, x * 13 / 77 + 0.5],
                order=1,
            )
            for one in (yields, same)
        )
        assert (read == 0).any() and (alike == 0).any() and (alike == 1).any()
        assert np.allclose(
            result[..., 3],
            field[..., 3] ** (1 - alike) * np.maximum((1 - read) ** 4, 1e-12),
            rtol=1e-9,
            atol=0,
        )
        assert np.array_equal(result[..., :3], field[..., :3])
        assert result[..., 3].min() > 0


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize("shoulder", [0.0, 0.5, 1.0])
@pytest.mark.parametrize(("clipped", "darker"), [
    (((0.8, 0.85, 0.9, 1.0), (0.85, 0.8, 0.75, 1.0)), 0.1),
    (((0.8, 0.85, 0.9, 1.0), (0.85, 0.8, 0.75, 1.0)), 1e6), (((math.inf,) * 4,) * 2, 1e6),
])  # fmt: skip
def test_difference_equals_its_twin(
    device: Device, name: str, shoulder: float, clipped: tuple, darker: float
) -> None:
    grid = GRIDS[name]
    cells, colours = grid.resized(10, 7).border, grid.resized(5, 3).border
    sides: list = []
    for k, box in enumerate(((0, 0, 60, grid.height), (9, 1, grid.width - 9, grid.height - 1))):
        pixels = random_layer(20 + k, box[2], box[3], 0.9)
        field = ndimage.gaussian_filter(np.random.default_rng(k).normal(size=(box[3], box[2], 4)), (4, 4, 0))
        field = (3 * field * (grid.lonlat[1] or 1)).astype(np.float32)
        if not grid.lonlat[1]:
            field[..., 2] = 0
        gain = np.random.default_rng(9 + k).normal(size=(3, 5, 4)).astype(np.float32)
        sides += [pixels, field, box, gain]
    part, of_part = (2, 1, 7, 5), np.s_[1:6, 2:9]
    out, square, texture = device.empty((5, 7, 4)), device.empty((5, 7)), device.empty((5, 7, 8))
    uploaded = [device.upload(one) if isinstance(one, np.ndarray) else one for one in sides]
    device.run(
        "seam", "seam_difference", part[2:], *uploaded, grid.border, grid.lonlat, colours, cells, part,
        shoulder, *clipped, darker, out, square, texture,
    )  # fmt: skip
    expected, squares, textures = seam_difference(
        *sides, grid.border, grid.lonlat, colours, cells, shoulder, *clipped, darker
    )
    assert (expected[..., 3] > 0).mean() > 0.4
    assert (squares > 1.5 * np.square(expected[..., :3]).max(-1)).any()
    # a pixel more or less at a mask's rim is one of some ten of a cell
    assert_close(out.get(), expected[of_part], 10 * POSITION, decisions=0.05)
    assert_close(square.get(), squares[of_part], 10 * POSITION, decisions=0.05)
    assert_close(texture.get(), textures[of_part], 10 * POSITION, decisions=0.05)
    assert (textures[..., 2:4] < 0.7 * textures[..., :2]).mean() > 0.3


@pytest.mark.parametrize("name", list(GRIDS))
def test_yield_equals_its_twin(device: Device, name: str) -> None:
    """On grids of cells that divide nothing, over poles and borders."""
    grid = GRIDS[name]
    cells = grid.resized(10, 7).border
    box = (5, 0, grid.width - 5, grid.height - 2)
    yields = (patches(2, 10, 7, 0.5, 2) * np.random.default_rng(3).random((7, 10)).clip(0.3)).astype(
        np.float32
    )
    same = patches(5, 10, 7, 0.5, 2).astype(np.float32)
    field = np.random.default_rng(4).normal(size=(box[3], box[2], 4)).astype(np.float32)
    # as the softmax's; nothing where the layer is not
    field[..., 3] = np.where(field[..., 3] > -1, np.exp(20 * np.minimum(field[..., 3], 0)), 0)
    out = device.upload(field)
    device.run(
        "seam", "seam_yield", box[2:], out, box, grid.border, device.upload(yields), device.upload(same),
        cells, 1e-3,
    )  # fmt: skip
    expected = seam_yield(field, box, grid.border, yields, same, cells, 1e-3)
    assert_close(out.get(), expected, 10 * SUM)
    assert np.array_equal(out.get()[..., :3], field[..., :3])
    assert ((out.get()[..., 3] == 0) == (field[..., 3] == 0)).all()
    assert (expected[..., 3] == field[..., 3]).any()
    assert (expected[..., 3] != field[..., 3]).any()


@pytest.mark.parametrize("size", [(7, 5), (24, 18), (1, 1)])
def test_cells_read_what_lies_at_their_centres(size: tuple[int, int]) -> None:
    cells = plane(96, 72).resized(24, 18)
    values = np.arange(2 * size[0] * size[1], dtype=np.float32).reshape(2, size[1], size[0])
    rows, columns = centres(cells, values.shape)
    found = values[:, rows[:, None], columns]
    for y, x in ((0, 0), (3, 23), (17, 11)):
        row, column = int((y + 0.5) / 18 * size[1]), int((x + 0.5) / 24 * size[0])
        assert found[:, y, x].tolist() == values[:, row, column].tolist()
    assert found.shape == (2, 18, 24)


@pytest.mark.parametrize("name", list(GRIDS))
def test_what_stays_equals_its_twin(device: Device, name: str) -> None:
    """Of a layer with holes, displaced by up to some pixels, also beyond itself."""
    grid = GRIDS[name]
    cells = grid.resized(10, 7)
    box = (0, 0, grid.width, grid.height)
    layer = random_layer(20, grid.width, grid.height, 0.9)
    field = ndimage.gaussian_filter(np.random.default_rng(3).normal(size=(*grid.shape, 4)), (4, 4, 0))
    field = (60 * field * (grid.lonlat[1] or 1)).astype(np.float32)
    if not grid.lonlat[1]:
        field[..., 2] = 0
    taken = (patches(2, 10, 7, 0.7, 2) > 0).astype(np.uint8)
    out = device.upload(field)
    device.run(
        "seam", "seam_clamp", box[2:], device.upload(layer), out, box, grid.border, grid.lonlat,
        device.upload(taken), cells.border,
    )  # fmt: skip
    expected = seam_clamp(layer, field, box, grid.border, grid.lonlat, taken, cells.border)
    scale = grid.lonlat[1] or 1
    assert_close(out.get() / scale, expected / scale, 10 * POSITION, decisions=0.02)
    changed = (np.abs(expected - field)[..., :3] > 0.1 * scale).any(-1)
    assert 0.01 < changed.mean() < 0.5
    assert np.array_equal(out.get()[..., 3], field[..., 3])


@pytest.mark.parametrize("name", list(GRIDS))
def test_what_is_shown_equals_its_twin(device: Device, name: str) -> None:
    """Of a layer with holes, displaced by some pixels."""
    grid = GRIDS[name]
    cells = grid.resized(19, 13)
    box = (9, 1, grid.width - 9, grid.height - 1)
    layer = random_layer(20, box[2], box[3], 0.9)
    field = ndimage.gaussian_filter(np.random.default_rng(3).normal(size=(box[3], box[2], 4)), (4, 4, 0))
    field = (60 * field * (grid.lonlat[1] or 1)).astype(np.float32)
    if not grid.lonlat[1]:
        field[..., 2] = 0
    out = device.empty(cells.shape, np.uint8)
    device.run(
        "seam", "seam_shown", cells.border[:2], device.upload(layer), device.upload(field), box, grid.border,
        grid.lonlat, cells.border, out,
    )  # fmt: skip
    expected = seam_shown(layer, field, box, grid.border, grid.lonlat, cells.border)
    assert 0.1 < expected.mean() < 0.9
    assert (out.get() != expected).mean() < 0.02


@pytest.mark.parametrize(
    ("ends", "first", "moved"), [(80, 8, -12), (28, 7, -12), (80, 5, -0.4), (80, 6, -0.6)]
)
def test_nothing_is_taken_from_beyond_a_border(device: Device, ends: int, first: int, moved: float) -> None:
    """Two layers, of which the second one begins at column 20 and is displaced to the left there: it cannot
    be taken from cells that would show what is beyond, unless the first one ends before, or by less than
    half a pixel.
    """
    grid = plane(80, 24)
    cells = grid.coarser(4)
    masks = np.zeros((2, *grid.shape), bool)
    masks[0, :, :ends] = masks[1, :, 20:] = True
    layers, fields = [], []
    for mask, left, width in zip(masks, (0, 20), (80, 60), strict=True):
        box = (left, 0, width, 24)
        pixels = np.ones((24, width, 4), np.float32) * mask[:, left : left + width, None]
        field = np.zeros((24, width, 4), np.float32)
        if left:
            field[..., 0] = moved
        layers.append(SimpleNamespace(box=box, pixels=device.upload(pixels)))
        fields.append(device.upload(field))
    scene = Scene(device, layers, [Pair(0, 1)], fields, SimpleNamespace(host=masks), grid)
    shown = seam._shown(scene, cells)
    assert shown.shape == (2, 6, 20)
    assert np.array_equal(shown[0], np.broadcast_to(np.arange(20) < ends // 4, (6, 20)))
    assert np.array_equal(shown[1], np.broadcast_to(np.arange(20) >= first, (6, 20)))


@pytest.mark.parametrize("place", [(0, 0, 60, 40), (11, 7, 31, 23), (29, 0, 31, 40)])
def test_weights_equal_their_twin(device: Device, place: tuple[int, int, int, int]) -> None:
    grid = plane(60, 40)
    cells = grid.resized(13, 7)
    field = np.random.default_rng(4).random((place[3], place[2], 4)).astype(np.float32)
    rows, columns = centres(cells, grid.shape)
    layers = [SimpleNamespace(box=place)]
    found = seam._weights(Scene(device, layers, [], [device.upload(field)], None, grid), cells)
    assert found.shape == (1, 7, 13) and 0 < (found > 0).mean() <= 1
    assert np.array_equal(found[0], seam_weights(field, place, rows, columns))


# Residuals

LAYERS = [SimpleNamespace(clips_at=(1.0, 1.0, 1.0))] * 2


def scene_of(grid: Grid, pairs: list[Pair]) -> Scene:
    """Two layers whose differences are given."""
    return Scene(None, LAYERS, pairs, [], None, grid)


def test_a_cell_of_which_little_is_seen_tells_as_much_less(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of those around; a cut through it crosses what is seen."""
    found = np.zeros((9, 12, 10))
    found[..., -1] = 1
    found[4, 6] = 0.5, -0.6, 0.1, 0.4, 0, 0, 0, 0, 0, 0.1
    found[4, 7] = 0
    monkeypatch.setattr(seam, "_differences", lambda *_: [(np.s_[0:9, 0:12], found)])
    residual = seam.residuals(scene_of(plane(96, 72), [Pair(0, 1)]), None)
    y, x = np.mgrid[0:9, 0:12]
    weight = np.exp(-0.5 * ((y - 4) ** 2 + (x - 6) ** 2)) * found[..., -1]
    assert np.isclose(residual.mean[4, 6], 0.6 * 0.1 / weight.sum(), rtol=0.01)
    assert residual.smooth_rms is not None
    assert np.isclose(residual.smooth_rms[4, 6], np.sqrt(0.4 * 0.1 / weight.sum()), rtol=0.01)
    assert residual.mean[4, 7] == residual.smooth_rms[4, 7] == residual.rms[4, 7] == 0
    assert residual.rms[4, 6] == residual.rms.sum() == np.sqrt(0.4)
    assert residual.measured is not None and residual.measured.sum() == 107 and not residual.measured[4, 7]


def test_a_cut_goes_through_a_gap_of_one_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    """Between somebody's head, which one layer shows whole, and his body, which it cuts off: also where the
    head is as bright as what is behind.
    """
    found = np.zeros((14, 12, 10))
    found[..., -1] = 1
    found[:7, 2:10, :3], found[:7, 2:10, 3] = 0.1, 0.02
    found[7, 2:10, :3], found[7, 2:10, 3] = 0.01, 0.001
    found[8:, 2:10, :3], found[8:, 2:10, 3] = 0.5, 0.3
    monkeypatch.setattr(seam, "_differences", lambda *_: [(np.s_[0:14, 0:12], found)])
    residual = seam.residuals(scene_of(plane(96, 112), [Pair(0, 1)]), None)
    cover = np.ones((2, 16, 12), bool)
    cover[0, 14:] = cover[1, 0] = False
    rows, columns = np.nonzero(np.ones((14, 12)))
    padded = Residuals(*(np.pad(one, [(0, 2), (0, 0)]) for one in (residual.mean, residual.rms)))
    owner = label(rows, columns, padded, np.full((2, 16, 12), 0.5), cover, False).reshape(14, 12)
    assert (owner[1:7, 2:10] == 0).all() and (owner[8:, 2:10] == 1).all()


def test_residuals_are_smoothed_across_the_border(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a canvas that wraps, by what is compared all along it; the same at each column."""
    found = np.random.default_rng(4).random((9, 12, 10))
    found[..., 8] = 0  # what they show has nothing in common
    means = []
    for wraps in (True, False):
        for shift in (0, 5):
            turned = np.roll(found, shift, 1)
            monkeypatch.setattr(seam, "_differences", lambda *_, its=turned: [(np.s_[0:9, 0:12], its)])
            residual = seam.residuals(scene_of(plane(96, 72, wraps), [Pair(0, 1)]), None)
            means.append(np.roll(residual.mean, -shift, 1))
    assert np.array_equal(means[0], means[1])
    assert not np.array_equal(means[2], means[3]) and not np.array_equal(means[0], means[2])


def test_a_cell_is_told_of_by_any_pair(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is as bright as clipped pixels are is not compared, but without flow."""
    found = np.zeros((2, 9, 12, 10))
    found[0, :, :5, -1], found[1, 3, 3:, -1] = 0.2, 1
    found[0, 3, 3, 3], found[1, 3, 3, 3], found[1, 3, 8, 3] = 0.09, 0.01, 0.04
    asked = []
    everywhere = [(np.s_[0:9, 0:12], one) for one in found]
    monkeypatch.setattr(seam, "_differences", lambda *given: asked.append(given[3]) or iter(everywhere))
    residual = seam.residuals(scene_of(plane(96, 72), [Pair(0, 1)] * 2), None)
    assert np.array_equal(residual.measured, (found[..., -1] > 0).any(0)) and asked == [
        [(0.98, 0.98, 0.98, 1.0)] * 2
    ]
    assert np.isclose(residual.rms[3, [3, 8]], [0.3, 0.2]).all()
    assert residual.smooth_rms is not None and (residual.smooth_rms[3, [3, 8]] > 0.05).all()


@pytest.mark.parametrize(
    ("square", "variances", "covariance", "unrelated"),
    [
        (0.01, (0.0095, 0.002), 0.0005, True),  # trousers before paving: neither tells anything of the other
        (0.01, (0.002, 0.0095), 0.0005, True),
        (0.01, (0.0055, 0.0055), 0.0005, False),  # paving that is not aligned
        (0.01, (0.016, 0.004), 0.005, False),  # partly alike
        (0.01, (0.0117, 0.0017), 0.0017, False),  # the same paving, less sharp
        (0.003, (0.003, 0.0005), 0.0, False),  # noise, hardly to be seen
    ],
)
def test_things_that_have_nothing_in_common_are_told(
    monkeypatch: pytest.MonkeyPatch,
    square: float,
    variances: tuple[float, float],
    covariance: float,
    unrelated: bool,
) -> None:
    """As bright as each other, by any pair; they join a region that differs, and make none."""
    found = np.zeros((2, 19, 22, 10))
    found[..., -1] = 1
    found[0, 7:, 8:14, 3] = square
    found[0, 7:, 8:14, 4:9] = *variances, *variances, covariance
    found[1, 2:6, 8:14, :3] = 0.5
    everywhere = [(np.s_[0:19, 0:22], one) for one in found]
    monkeypatch.setattr(seam, "_differences", lambda *_: iter(everywhere))
    grid = plane(176, 152)
    residual = seam.residuals(scene_of(grid, [Pair(0, 1)] * 2), None)
    assert residual.unrelated is not None and residual.unrelated[9:, 9:13].all() == unrelated
    assert residual.unrelated.any() == unrelated and not residual.unrelated[:5].any()
    whole = seam.regions(residual, grid)
    assert whole[3:5, 9:13].all() and whole[10:, 9:13].all() == whole[12:].any() == unrelated
    monkeypatch.setattr(seam, "_differences", lambda *_: iter(everywhere[:1]))
    assert not seam.regions(seam.residuals(scene_of(grid, [Pair(0, 1)]), None), grid).any()


# Yields


@pytest.mark.parametrize("wraps", WRAPS)
def test_outlines_are_blurred_over_a_cell(wraps: bool) -> None:
    mask = patches(5, 17, 12, 0.5, 4)
    mask[:, :3] = mask[:, -1:]  # something to see across the border
    mask[3] = 1 - mask[3]
    expected = ndimage.uniform_filter(
        mask.astype(np.float64), 3, mode=("nearest", "wrap" if wraps else "nearest")
    )
    assert np.allclose(averaged(mask, wraps), expected, atol=1e-6)


@pytest.mark.parametrize("columns", [0, 9])
def test_a_layer_yields_all_of_a_region_that_is_not_its_own(columns: int) -> None:
    whole, owner = np.zeros((13, 19), bool), np.zeros((13, 19), int)
    whole[4:9, 5:15] = True
    owner[:, :10] = 1
    whole, owner = (np.roll(one, columns, 1) for one in (whole, owner))  # also across the border
    first, second = (np.roll(seam.yielded(whole, owner, k, columns > 0), -columns, 1) for k in (0, 1))
    assert first.dtype == second.dtype == np.float32
    # from a cell beyond the region, less and less, as far as the next; at the cut half in each layer
    third = 1 / 3
    assert np.allclose(first[6, 2:12], [0, third, 2 * third, 1, 1, 1, 1, 2 * third, third, 0])
    assert np.allclose(second[6, 8:18], [0, third, 2 * third, 1, 1, 1, 1, 2 * third, third, 0])
    assert np.allclose(first[:7, 7], [0, 0, third, 2 * third, 1, 1, 1])
    assert not first[:, 13:].any() and not second[:, :7].any()


@pytest.mark.parametrize("weight", [1.0, 1e-4, 1e-30])
def test_a_cut_is_where_it_was_chosen(device: Device, weight: float) -> None:
    """However little the softmax knows the layer that is taken: what the other one shows beside it is gone. A
    layer that covers less stays nothing where it is not.
    """
    grid = plane(184, 104)
    shape = seam.seam_grid(grid).shape
    whole = np.zeros(shape, bool)
    whole[2:-2, 2:17] = True
    owner = np.zeros(shape, int)
    owner[:, :10] = 1
    fields = [np.full((104, 184, 4), one, np.float32) for one in (1.0, weight)]
    fields[1][60:, :60, 3] = 0
    fields = [device.upload(field) for field in fields]
    layers = [whole_layer(device, 184, 104)] * 2
    masks = SimpleNamespace(host=np.ones((2, 104, 184), bool))
    nothing = Residuals(np.zeros(shape), np.zeros(shape))
    scene = Scene(device, layers, [], fields, masks, grid)
    seam.cut(scene, nothing, whole, choose=lambda _: (owner, {}))
    first, second = (field.get()[..., 3].astype(np.float64) for field in fields)
    share = first / (first + second)
    assert (share[20:56, 20:75] < 0.05).all() and (share[20:84, 85:132] > 0.95).all()
    assert np.allclose(share[20:84, 79:81].mean(1), 0.5, atol=1e-3)
    assert np.allclose(share[:, 160:], 1 / (1 + weight), rtol=1e-5)
    assert (first[60:, :60] > 0).all() and (second[60:, :60] == 0).all()


def test_who_is_gone_is_wholly_gone(device: Device) -> None:
    """A cell beyond him as well, where another layer is taken; what only gives way has a rest there."""
    grid = plane(184, 104)
    shape = seam.seam_grid(grid).shape
    whole, owner = np.zeros(shape, bool), np.ones(shape, int)
    whole[3:9, 4:12] = True
    gone = np.zeros(shape, bool)
    gone[3:9, 4:7] = True
    fields = [device.upload(np.ones((104, 184, 4), np.float32)) for _ in range(2)]
    layers = [whole_layer(device, 184, 104)] * 2
    nothing = Residuals(np.zeros(shape), np.zeros(shape))
    scene = Scene(device, layers, [], fields, SimpleNamespace(host=np.ones((2, 104, 184), bool)), grid)
    seam.cut(scene, nothing, whole, choose=lambda _: (owner, {0: gone}))
    first, second = (field.get()[..., 3] for field in fields)
    assert (second == 1).all()
    rows, beside, beyond = slice(40, 56), slice(26, 30), slice(98, 102)  # centres of cells at each side
    assert (first[rows, beside] < 1e-3).all() and (first[rows, beyond] > 5e-3).all()


def test_longer_cuts_are_dearer_and_priced_by_the_residual_itself(device: Device) -> None:
    grid = plane(184, 104)
    shape = seam.seam_grid(grid).shape
    whole, residual = np.ones(shape, bool), Residuals(*np.random.default_rng(1).random((2, *shape)))
    fields, layers = [device.zeros((104, 184, 4))] * 2, [whole_layer(device, 184, 104)] * 2
    scene = Scene(device, layers, [], fields, SimpleNamespace(host=np.ones((2, 104, 184), bool)), grid)
    choose = Mock(return_value=(np.zeros(shape, int), {}))
    seam.cut(scene, residual, whole, choose=choose)
    [choice] = choose.call_args.args
    assert choice.otherwise.cut_price > choice.cut_price and choice.otherwise.cut_share > choice.cut_share
    assert np.array_equal(choice.otherwise.residual.rms, residual.rms)
    assert np.array_equal(choice.residual.rms, seen(residual).rms)


def test_no_cell_comes_from_a_layer_that_covers_a_part_of_it(device: Device) -> None:
    grid = plane(184, 104)
    masks = np.ones((2, 104, 184), bool)
    masks[0, 50, 90] = False
    fields = [device.zeros((104, 184, 4))] * 2
    layers = [whole_layer(device, 184, 104)] * 2
    scene = Scene(device, layers, [], fields, SimpleNamespace(host=masks), grid)
    assert np.argwhere(~seam._shown(scene, seam.seam_grid(grid))).tolist() == [[0, 50 // 8, 90 // 8]]


def test_cells_that_a_layer_covers_whole() -> None:
    covered = np.ones((2, 53, 77), bool)
    covered[0, 12, 20] = covered[1, 52, 76] = False
    whole = on_cells(covered, plane(110, 70).resized(9, 5), np.logical_and)
    assert np.argwhere(~whole).tolist() == [[0, 1, 2], [1, 4, 8]]

"""Less weight where only one layer is clipped: kernels against twins, which cells, and the panorama."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from grids import GRIDS, on_device, patches, random_layer
from pictures import merged, one_device
from reference.highlights import highlights_reduce, highlights_restore, highlights_share
from scipy import ndimage
from tolerances import SUM, assert_close

from hugin_abflow import coefficient, highlights, seam
from hugin_abflow.colour import Correction
from hugin_abflow.geometry import Pair
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.regions import Residuals
from hugin_abflow.scene import Scene
from hugin_abflow.settings import Settings

__all__ = ["one_device"]

# The kernels

WHITE = (1.0, 0.95, 1.2, 1.0)


@pytest.mark.parametrize("name", list(GRIDS))
def test_share_equals_its_twin(device: Device, name: str) -> None:
    """On cells that divide nothing, for a box that begins and ends inside cells."""
    grid = GRIDS[name]
    cells = grid.resized(10, 7).border
    box = (9, 1, grid.width - 12, grid.height - 3)
    layer = random_layer(1, box[2], box[3], 0.7)
    layer[..., :3] *= patches(2, box[2], box[3], 0.4, 9)[..., None]
    share = device.empty((7, 10))
    device.run(
        "highlights", "highlights_share", (10, 7), device.upload(layer), box, grid.border, cells, WHITE,
        0.6, 0.9, share,
    )  # fmt: skip
    expected = highlights_share(layer, box, grid.border, cells, WHITE, 0.6, 0.9)
    assert (expected > 0).mean() > 0.3
    assert (expected < 1).all()
    assert_close(share.get(), expected, 10 * SUM)


@pytest.mark.parametrize("name", list(GRIDS))
def test_yield_equals_its_twin(device: Device, name: str) -> None:
    grid = GRIDS[name]
    cells = grid.resized(10, 7).border
    box = (5, 0, grid.width - 5, grid.height - 2)
    logarithms = (7 * patches(2, 10, 7, 0.5, 2) * np.random.default_rng(3).random((7, 10))).astype(np.float32)
    field = np.random.default_rng(4).normal(size=(box[3], box[2], 4)).astype(np.float32)
    out = device.upload(field)
    device.run(
        "highlights", "highlights_reduce", box[2:], out, box, grid.border, device.upload(logarithms), cells
    )
    expected = highlights_reduce(field, box, grid.border, logarithms, cells)
    assert_close(out.get(), expected, 100 * SUM)
    assert np.array_equal(out.get()[..., :3], field[..., :3])
    assert (expected[..., 3] != field[..., 3]).any()


@pytest.mark.parametrize("name", list(GRIDS))
def test_regain_equals_its_twin(device: Device, name: str) -> None:
    """And is the reverse of yielding, where all is to be regained."""
    grid = GRIDS[name]
    cells, part_cells = grid.resized(10, 7).border, grid.resized(19, 15).border
    box = (5, 0, grid.width - 5, grid.height - 2)
    logarithms = (20 * np.random.default_rng(3).random((7, 10))).astype(np.float32)
    field = np.random.default_rng(4).normal(size=(box[3], box[2], 4)).astype(np.float32)
    some = patches(5, 19, 15, 0.5, 3).astype(np.float32)
    for part in (some, np.ones_like(some)):
        out, on_cells = device.upload(field), device.upload(logarithms)
        device.run("highlights", "highlights_reduce", box[2:], out, box, grid.border, on_cells, cells)
        yielded = out.get()
        device.run(
            "highlights", "highlights_restore", box[2:], out, box, grid.border, on_cells, cells,
            device.upload(part), part_cells,
        )  # fmt: skip
        expected = highlights_restore(yielded, box, grid.border, logarithms, cells, part, part_cells)
        assert np.allclose(out.get(), expected, 1e-4, 0)
    assert (yielded[..., 3] != field[..., 3]).all()
    assert np.allclose(out.get(), field, 1e-4, 0)


# Which cells


def white_and_grey(device: Device) -> tuple[list, coefficient.Masks]:
    """Two layers of a plane: one from column 16 on, white there; one up to column 48, grey, with a white
    corner."""
    grid = GRIDS["plane"]
    grey, white = (np.zeros((53, 77, 4), np.float32) for _ in range(2))
    grey[:, :48] = (0.5, 0.5, 0.5, 1)
    grey[:17, 16:48, 0] = 1
    white[:, 16:] = 1
    layers = [on_device(device, grey), on_device(device, white)]
    return layers, coefficient.masks(device, layers, grid)


def test_only_what_another_layer_shows_better_gives_way(device: Device) -> None:
    layers, masks = white_and_grey(device)
    grid = GRIDS["plane"]
    found = highlights.measure(device, layers, masks, grid, Settings()).excess
    assert found.shape == (2, 3, 5)  # cells of 15.4 x 17.7 px
    assert not found[0].any()
    assert (found[1, 1:, 2] == 1).all()  # both, one of them white
    assert not found[1, 0, 2]  # both white: one channel is enough
    assert not found[1, :, 4].any()  # alone


def test_what_counts_is_how_much_is_lost_of_what_the_darkest_shows(device: Device) -> None:
    """White with dark specks, a sixteenth of it: all layers clip most, one the specks as well, one half of
    them. Where nothing but noise is left, it is no such share."""
    grid = GRIDS["plane"]
    pixels = np.ones((3, 53, 77, 4), np.float32)
    pixels[0, ::4, ::4, :3] = 0.5
    pixels[2, ::8, ::4, :3] = 0.7
    layers = [on_device(device, one) for one in pixels]
    masks = coefficient.masks(device, layers, grid)
    excess = highlights.measure(device, layers, masks, grid, Settings()).excess
    assert not excess[0].any()
    assert excess[1] == pytest.approx(1, abs=1e-5)
    assert (np.abs(excess[2] - 0.5) < 0.15).all()  # cells have three specks more or less
    pixels[0, ..., :3] = 1
    pixels[0, 0, 0, :3] = 0.5  # one of 270 pixels
    layers = [on_device(device, one) for one in pixels[[0, 1, 1]]]
    excess = highlights.measure(device, layers, masks, grid, Settings()).excess
    assert excess[1, 0, 0] == pytest.approx(1 / (15.4 * 17.7) / highlights._SHOWN, rel=0.2)


def strips(device: Device, *shown: tuple[int, int, float]) -> tuple[list, coefficient.Masks]:
    """Layers of one brightness each, of the plane's columns from one on up to another."""
    layers = []
    for left, right, value in shown:
        pixels = np.zeros((53, 77, 4), np.float32)
        pixels[:, left:right] = (value, value, value, 1)
        layers.append(on_device(device, pixels))
    return layers, coefficient.masks(device, layers, GRIDS["plane"])


def weighted(device: Device, layers: list, weights: Sequence[float]) -> list[Buffer]:
    """Fields of layers that stay where they are, with one weight each."""
    fields = []
    for layer, weight in zip(layers, weights, strict=True):
        field = np.zeros((*layer.pixels.shape[:2], 4), np.float32)
        field[..., 3] = weight
        fields.append(device.upload(field))
    return fields


def yielding(device: Device, layers: list, masks: coefficient.Masks) -> tuple[np.ndarray, ...]:
    """By how much more layers give way, and how much more they clip, per cell; and the logarithms of weights
    that were 1.
    """
    grid = GRIDS["plane"]
    clipped = highlights.measure(device, layers, masks, grid, Settings())
    fields = weighted(device, layers, [1.0] * len(layers))
    extra = highlights.reduce_weights(device, layers, fields, clipped, masks, grid)
    return extra, clipped.excess, np.log([field.get()[..., 3] for field in fields])


MORE = highlights._FULL_STRENGTH - highlights._STRENGTH


def test_what_is_clipped_yields_less_near_what_has_to_be_shown_white(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """White is alone from column 48 on, in the fourth of the cells of 15.4 px."""
    for far, share in ((40.0, 15.4 / 40), (10.0, 1.0)):
        monkeypatch.setattr(highlights, "_FAR", far)
        extra, _, weights = yielding(device, *strips(device, (0, 48, 0.5), (16, 77, 1.0)))
        assert not extra[0].any()
        assert extra[1, :, 2] == pytest.approx(MORE * share * share * (3 - 2 * share))
        assert (extra[1, :, 1] > extra[1, :, 2] - (share == 1)).all()
        assert not extra[1, :, 3:].any()
        # at the centre of a cell
        assert weights[1, 26, 38] == pytest.approx(-highlights._STRENGTH - extra[1, 1, 2], rel=1e-3)


@pytest.mark.parametrize("third", [(32, 77, 0.4), (40, 77, 0.94)])
def test_what_is_clipped_yields_most_where_others_show_all(
    device: Device, third: tuple[int, int, float]
) -> None:
    """Also where a layer is clipped itself, but less: half; all of what it still shows is lost in white."""
    extra, _, _ = yielding(device, *strips(device, (0, 48, 0.5), (16, 77, 1.0), third))
    assert extra[1, :, [1, 2, 4]] == pytest.approx(MORE, rel=1e-5)
    assert not extra[0].any()


@pytest.mark.parametrize("third", [(32, 77, 1.0), (32, 77, 0.975), (70, 77, 0.4)])
def test_layers_that_clip_as_much_or_do_not_reach_far_enough_replace_no_white(
    device: Device, third: tuple[int, int, float]
) -> None:
    """Or nearly as much: it must not depend on noise."""
    extra, _, _ = yielding(device, *strips(device, (0, 48, 0.5), (16, 77, 1.0), third))
    assert (extra[1] < 0.5 * MORE).all()
    assert not extra[1, :, 3].any()


def test_what_is_alone_but_not_white_holds_no_yield_back(device: Device) -> None:
    """A quarter of it is clipped."""
    layers, masks = strips(device, (0, 48, 0.5), (16, 77, 0.92))
    white = np.zeros((53, 77, 4), np.float32)
    white[:, 16:] = (0.92, 0.92, 0.92, 1)
    white[:, 16:40, :3] = 1
    layers[1] = on_device(device, white)
    extra, excess, _ = yielding(device, layers, masks)
    assert extra[1] == pytest.approx(MORE * excess[1])
    assert ((excess[1] > 0.1) & (excess[1] < 0.9)).any()


def test_not_of_floats_and_not_when_off(device: Device) -> None:
    layers, masks = white_and_grey(device)
    grid = GRIDS["plane"]
    assert not highlights.measure(device, layers, masks, grid, Settings(highlights=False)).shares.any()
    floats = [replace(one, layer=replace(one.layer, dtype=np.dtype(np.float32))) for one in layers]
    assert not highlights.measure(device, floats, masks, grid, Settings()).shares.any()


# The panorama

WIDTH, HEIGHT = 301, 91


def shot(scene: np.ndarray, light: float, left: int, right: int) -> Layer:
    pixels = np.full((HEIGHT, right - left, 4), 255, np.uint8)
    pixels[..., :3] = np.rint(np.minimum(255, 255 * light * scene[:, left:right, None]))
    return Layer.from_array(f"light {light}", pixels, left)


@pytest.mark.usefixtures(one_device.__name__)
def test_what_is_blown_out_comes_from_the_darker_photo() -> None:
    """A bright wall with stains; the photo of twice the light shows it white. Stains are seen nearly up to
    the darker photo's border, which is no visible edge; white far from it stays white."""
    noise = ndimage.gaussian_filter(np.random.default_rng(5).normal(size=(HEIGHT, WIDTH)), 3)
    scene = np.clip(0.65 + 0.1 * noise / noise.std(), 0.55, 0.8)
    layers = [shot(scene, 1.0, 0, 200), shot(scene, 2.0, 100, WIDTH)]
    canvas = Canvas.plane(WIDTH, HEIGHT)

    def stains(values: np.ndarray) -> np.ndarray:
        return (values - values.mean(0)).ravel()

    def likeness(result: np.ndarray, left: int, right: int) -> float:
        seen = result[:, left:right, 1].astype(float)
        return float(np.corrcoef(stains(seen), stains(scene[:, left:right]))[0, 1])

    result, without = (merged(layers, canvas, highlights=on) for on in (True, False))
    assert likeness(result, 100, 190) > 0.9
    assert likeness(without, 180, 190) < 0.5
    assert (result[:, 240:, :3] == 255).all()
    means = result[..., 1].mean(0)
    assert np.abs(np.diff(ndimage.uniform_filter1d(means, 5))).max() < 12


@pytest.mark.usefixtures(one_device.__name__)
def test_white_is_not_seen_where_two_darker_photos_meet() -> None:
    """Whose shared overlap is narrow: the white photo, of the middle, weighs most there. Weights span more
    than by themselves, as they do where things shift."""
    noise = ndimage.gaussian_filter(np.random.default_rng(6).normal(size=(HEIGHT, WIDTH)), 3)
    scene = np.clip(0.65 + 0.1 * noise / noise.std(), 0.55, 0.8)
    layers = [shot(scene, 1.0, 0, 160), shot(scene, 2.0, 60, 240), shot(scene, 1.0, 145, WIDTH)]
    result = merged(layers, Canvas.plane(WIDTH, HEIGHT), softmax_sharpness=20.0)[..., 1].astype(float)
    for left in range(0, WIDTH - 20, 10):
        here = scene[:, left : left + 20], result[:, left : left + 20]
        deviations = [one - one.mean(0) for one in here]
        assert np.corrcoef(*(one.ravel() for one in deviations))[0, 1] > 0.99
        assert deviations[1].std() > 0.97 * 255 * deviations[0].std()


@pytest.mark.parametrize("light", [0.8, 1.3])
def test_what_flow_cannot_explain_is_not_taken_from_the_photo_that_clips_it(
    device: Device, light: float
) -> None:
    """The clipped layer has all the softmax's weight, and yields to a grey that is as bright once exposure is
    corrected; if that is darker it is something else, and stays where it was."""
    layers, masks = white_and_grey(device)
    grid = GRIDS["plane"]
    cells = seam.seam_grid(grid)
    fields = weighted(device, layers, (1e-3, 1.0))
    gains = []
    for gain in (2 * light, 1.0):
        values = np.zeros((*highlights.highlights_grid(grid).shape, 4), np.float32)
        values[..., :3] = np.log(gain)
        gains.append(device.upload(values))
    correction = Correction(highlights.highlights_grid(grid), 0.0, tuple(gains))
    clipped = highlights.measure(device, layers, masks, grid, Settings()).excess
    given = Scene(device, layers, [Pair(0, 1)], fields, masks, grid), correction
    everywhere = np.ones(cells.shape, bool)
    prices = seam.clipping_prices(*given, clipped, everywhere)
    assert not prices[0].any()  # grey is never clipped
    assert (prices[1, 4:, 3:5] == (seam._CLIPPED if light > 1 else 0)).all()
    assert not prices[1, :, 7:].any()  # alone
    assert seam.clipping_prices(*given, 0 * clipped, everywhere) is None
    whole = np.zeros(cells.shape, bool)
    whole[3:, 2:6] = True  # columns 15 to 46, below the white corner
    there = seam.clipping_prices(*given, clipped, whole)
    assert np.array_equal(there, prices * whole) and there.any() == (light > 1)
    whole[:] = np.arange(cells.width) >= 9  # alone
    assert seam.clipping_prices(*given, clipped, whole) is None
    whole[:] = False
    whole[3:, 2:6] = True
    residual = Residuals(np.full(cells.shape, 0.3), np.zeros(cells.shape))
    seam.cut(given[0], residual, whole, clipping_price=prices)
    # both cover all of it, and a cut beside the border of the white one is more than a cell away
    grey, white = (field.get()[38:48, 32:38, 3] for field in fields)
    assert (grey > 10 * white).all() if light > 1 else (grey < 1e-3 * white).all()


def test_what_is_cut_out_of_a_layer_that_gave_way_is_that_layers(device: Device) -> None:
    """A region that goes to the clipped layer, since what the other one shows is darker: no ghost of that."""
    layers, masks = strips(device, (0, 48, 0.5), (16, 77, 1.0), (32, 77, 0.4))
    grid = GRIDS["plane"]
    cells = seam.seam_grid(grid)
    whole = np.zeros(cells.shape, bool)
    whole[3:, 2:6] = True
    residual = Residuals(np.full(cells.shape, 0.3), np.zeros(cells.shape))
    fields = weighted(device, layers, (1.0, 1.0, 0.0))
    clipped = highlights.measure(device, layers, masks, grid, Settings())
    extra = highlights.reduce_weights(device, layers, fields, clipped, masks, grid)
    prices = np.zeros((3, *cells.shape))
    prices[[0, 2]] = 5
    highlights.restore_weights(device, layers, fields, extra, whole, grid, seam.seam_grid(grid))
    scene = Scene(device, layers, [], fields, masks, grid)
    seam.cut(scene, residual, whole, clipping_price=prices)
    grey, white, _ = (field.get()[38:48, 34, 3] for field in fields)
    assert (white > 100 * grey).all()

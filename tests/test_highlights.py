"""Less weight where only one layer is clipped: kernels against twins, which cells, and the panorama."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from grids import GRIDS, on_device, patches, random_layer
from pictures import merged, one_device
from reference.highlights import highlights_share, highlights_yield
from scipy import ndimage
from tolerances import SUM, assert_close

from hugin_abflow import coefficient, highlights, seam
from hugin_abflow.colour import Correction
from hugin_abflow.geometry import Pair
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.opencl import Device
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
        "highlights", "highlights_yield", box[2:], out, box, grid.border, device.upload(logarithms), cells
    )
    expected = highlights_yield(field, box, grid.border, logarithms, cells)
    assert_close(out.get(), expected, 100 * SUM)
    assert np.array_equal(out.get()[..., :3], field[..., :3])
    assert (expected[..., 3] != field[..., 3]).any()


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


def test_what_is_clipped_yields_most_where_it_need_not_be_shown(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside what only the white layer shows it yields less, the nearer the less; with another grey one that
    reaches further, and is seen over it, nowhere. What it yields by is what its weight is divided by."""
    monkeypatch.setattr(highlights, "_FAR", 40.0)
    grid = GRIDS["plane"]
    grey, white, further = (np.zeros((53, 77, 4), np.float32) for _ in range(3))
    grey[:, :48], white[:, 16:], further[:, 32:] = (0.5, 0.5, 0.5, 1), 1, (0.4, 0.4, 0.4, 1)
    for shown in ([grey, white], [grey, white, further]):
        layers = [on_device(device, one) for one in shown]
        masks = coefficient.masks(device, layers, grid)
        clipped = highlights.measure(device, layers, masks, grid, Settings())
        fields = [device.upload(np.ones((*one.pixels.shape[:2], 4), np.float32)) for one in layers]
        found = highlights.give_way(device, layers, fields, clipped, masks, grid)
        assert not found[[0, *range(2, len(layers))]].any()
        strength = found[1, :, 1:] / np.maximum(clipped.excess[1, :, 1:], 1e-9)
        if len(layers) == 3:
            assert (strength == highlights._FULL_STRENGTH).all()
        else:  # white is alone from the fourth column of cells on, 15.4 px wide: its centre is that far away
            share = 15.4 / 40
            smooth = share * share * (3 - 2 * share)
            between = highlights._STRENGTH * (1 - smooth) + highlights._FULL_STRENGTH * smooth
            assert strength[:, 1] == pytest.approx(between)
            assert (strength[:, 0] > between).all()
            assert (strength[:, 2] == highlights._STRENGTH).all()
            assert not strength[:, 3].any()
        middle = fields[1].get()[26, 38, 3]  # a cell's centre
        assert np.log(middle) == pytest.approx(-found[1, 1, 2], rel=1e-3)


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
    fields = []
    for layer, weight in zip(layers, (1e-3, 1.0), strict=True):
        field = np.zeros((*layer.pixels.shape[:2], 4), np.float32)
        field[..., 3] = weight
        fields.append(device.upload(field))
    gains = []
    for gain in (2 * light, 1.0):
        values = np.zeros((*highlights.highlights_grid(grid).shape, 4), np.float32)
        values[..., :3] = np.log(gain)
        gains.append(device.upload(values))
    correction = Correction(highlights.highlights_grid(grid), 0.0, tuple(gains))
    clipped = highlights.measure(device, layers, masks, grid, Settings()).excess
    prices = seam.lost(device, layers, fields, [Pair(0, 1)], correction, clipped, grid)
    assert not prices[0].any()  # grey is never clipped
    assert (prices[1, 4:, 3:5] == (seam._CLIPPED if light > 1 else 0)).all()
    assert not prices[1, :, 7:].any()  # alone
    assert seam.lost(device, layers, fields, [Pair(0, 1)], correction, 0 * clipped, grid) is None
    whole = np.zeros(cells.shape, bool)
    whole[3:, 2:6] = True  # columns 15 to 46, below the white corner
    residual = seam.Residuals(np.full(cells.shape, 0.3), np.zeros(cells.shape))
    seam.cut(device, layers, fields, residual, whole, masks, grid, lost=prices)
    grey, white = (field.get()[38:48, 29:33, 3] for field in fields)  # both cover all of the grid
    assert (grey > 10 * white).all() if light > 1 else (grey < 1e-3 * white).all()


def test_a_cut_counts_weights_as_they_were_before_layers_gave_way(device: Device) -> None:
    """What clipped layers lose by there is in `lost`; else they would be left twice."""
    layers, masks = white_and_grey(device)
    grid = GRIDS["plane"]
    cells = seam.seam_grid(grid)
    whole = np.zeros(cells.shape, bool)
    whole[3:, 2:6] = True
    residual = seam.Residuals(np.full(cells.shape, 0.3), np.zeros(cells.shape))
    yielded = np.zeros((2, *highlights.highlights_grid(grid).shape), np.float32)
    yielded[1] = 5
    for given in (None, yielded):
        fields = [device.upload(np.ones((*one.pixels.shape[:2], 4), np.float32)) for one in layers]
        for field, weight in zip(fields, (0.1, np.exp(-5)), strict=True):
            values = field.get()
            values[..., 3] = weight
            field.set(values)
        seam.cut(device, layers, fields, residual, whole, masks, grid, yielded=given)
        grey, white = (field.get()[38:48, 29:33, 3] for field in fields)
        assert (grey > white).all() if given is None else (grey < white).all()

"""Whole panoramas of layers that do not show the same: each thing whole, from one layer, or absent."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pictures import masked, merged, one_device, pixel_places, texture
from scipy import ndimage

from hugin_abflow import colour, geometry, joint, seam
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.opencl import Device
from hugin_abflow.progress import silent
from hugin_abflow.settings import Settings

# Whole panoramas: a dark disc in one of two layers that show the same wall
RADIUS, LAP = 28, 90  # px; overlaps are 2 LAP wide
DISC = (24, 16, 12)
# Levels that the disc's rim may be off: it is 100 darker than the wall, and flow may move it by half a pixel.
RIM = 48
CANVASES = {
    "plane": (Canvas.plane(480, 208), 240, 100),
    "across the border": (Canvas.plane(480, 208, wraps=True), 0, 100),
    "beside the border": (Canvas.plane(480, 208, wraps=True), 466, 80),
    "sphere": (Canvas.sphere(480, 240), 0, 100),
    "near a pole": (Canvas.sphere(480, 240), 2, 40),
}


def wall(canvas: Canvas, dx: float = 0.0) -> np.ndarray:
    """Mid tones everywhere, brighter than the disc."""
    y, x = pixel_places(canvas.height, canvas.width)
    picture = texture(y, x - dx, np.uint8, canvas.width if canvas.wraps else 0)
    picture[..., :3] = 64 + picture[..., :3] // 2
    return picture


def distance(canvas: Canvas, x: float, y: float) -> np.ndarray:
    """Of every pixel from a place, in px, on the sphere by angle."""
    rows, columns = (place + 0.5 for place in pixel_places(canvas.height, canvas.width))
    across = np.abs(columns - x)
    if canvas.wraps:
        across = np.minimum(across, canvas.width - across)
    if not canvas.spherical:
        return np.hypot(across, rows - y)
    step = np.pi / canvas.height
    lat, its, lon = np.pi / 2 - rows * step, np.pi / 2 - y * step, across * 2 * np.pi / canvas.width
    cosine = np.sin(lat) * np.sin(its) + np.cos(lat) * np.cos(its) * np.cos(lon)
    return np.arccos(np.clip(cosine, -1, 1)) / step


def halves(canvas: Canvas, x: int) -> tuple[np.ndarray, np.ndarray]:
    """Masks of two layers that overlap around column x, and opposite of it on a canvas that wraps."""
    columns = pixel_places(canvas.height, canvas.width)[1]
    if not canvas.wraps:
        return columns < x + LAP, columns >= x - LAP
    around, half = (columns - x) % canvas.width, canvas.width // 2
    return (around < half + LAP) | (around >= canvas.width - LAP), (around < LAP) | (around >= half - LAP)


def scene(
    name: str, who: int | None, light: float = 1.0, dx: float = 0.0
) -> tuple[list[Layer], Canvas, np.ndarray, np.ndarray]:
    """Two layers of the wall, of which `who` shows the disc and the second is darker and moved; the canvas;
    how far each pixel is from the disc's centre; the wall."""
    canvas, x, y = CANVASES[name]
    away, plain = distance(canvas, x, y), wall(canvas)
    layers = []
    for index, mask in enumerate(halves(canvas, x)):
        picture = wall(canvas, dx * index)
        if index == who:
            picture[away < RADIUS, :3] = DISC
        if index == 1:
            picture[..., :3] = np.rint(picture[..., :3] * light)
        layers.append(masked(picture, mask))
    return layers, canvas, away, plain


def off(result: np.ndarray, colours: np.ndarray | tuple[int, ...]) -> np.ndarray:
    """Largest difference of a channel, per pixel, in levels."""
    return np.abs(result[..., :3].astype(int) - np.asarray(colours)[..., :3]).max(-1)


def doubt(result: np.ndarray, plain: np.ndarray, away: np.ndarray) -> np.ndarray:
    """How far each pixel is from what either layer shows, in levels."""
    shown = plain.copy()
    shown[away < RADIUS, :3] = DISC
    return np.minimum(off(result, plain), off(result, shown))


THINGS = pytest.mark.parametrize(
    ("name", "who"),
    [("plane", 0), ("plane", 1), ("across the border", 0), ("across the border", 1), ("beside the border", 0),
     ("sphere", 1), ("near a pole", 0)],
)  # fmt: skip


@pytest.mark.usefixtures(one_device.__name__)
@THINGS
def test_what_only_one_layer_shows_is_whole_or_absent(name: str, who: int) -> None:
    """As it is stored, where exposures are left as they are."""
    layers, canvas, away, plain = scene(name, who)
    result = merged(layers, canvas, seam=True, exposure=False)
    unsure = doubt(result, plain, away)  # every pixel is one layer's, but for what flow moves a little
    assert (unsure > 8).mean() < 3e-3
    assert unsure.max() <= RIM and unsure[np.abs(away - RADIUS) >= 1].max() <= 32
    assert (off(result, DISC)[away < RADIUS - 1] <= 8).mean() in (0, 1)
    assert off(result, plain)[away >= RADIUS + 16].max() <= 8
    assert (result[..., 3] == 255).all()


@pytest.mark.usefixtures(one_device.__name__)
@THINGS
def test_what_only_one_layer_shows_leaves_a_faint_halo(name: str, who: int) -> None:
    """The lower bands of frequencies change over beside the disc, too, which is 100 levels darker: around it
    brightness changes by some levels in the mean, and within 64 px only."""
    layers, canvas, away, plain = scene(name, who)
    result = merged(layers, canvas, seam=True)
    unsure = doubt(result, plain, away)
    assert unsure.max() <= RIM and unsure[np.abs(away - RADIUS) >= 1].max() <= 32
    assert (off(result, DISC)[away < RADIUS - 1] <= 32).mean() in (0, 1)
    difference = result[..., 1].astype(float) - plain[..., 1]
    for inner, outer, most in ((4, 16, 4), (16, 32, 3), (32, 64, 1)):
        assert abs(difference[(away >= RADIUS + inner) & (away < RADIUS + outer)].mean()) < most
    assert off(result, plain)[away >= RADIUS + 4].max() <= 20
    assert off(result, plain)[away >= RADIUS + 64].max() <= 5


@pytest.mark.usefixtures(one_device.__name__)
@pytest.mark.parametrize("name", ["plane", "across the border"])
@pytest.mark.parametrize("who", [0, 1])
def test_somebody_who_wears_the_walls_brightness_is_not_cut_in_two(name: str, who: int) -> None:
    """Down the middle of a large disc, where the coefficients are equal, go fine checks that are as bright as
    the wall in the mean."""
    radius = 2 * RADIUS
    layers, canvas, away, plain = scene(name, who)
    rows, columns = pixel_places(canvas.height, canvas.width)
    across = (columns - CANVASES[name][1] + canvas.width // 2) % canvas.width - canvas.width // 2
    checks = np.where((rows // 3 + columns // 3) % 2 < 1, 60, -60)
    bright = ndimage.gaussian_filter(plain.astype(float), (8, 8, 0), mode="wrap") + checks[..., None]
    shown = plain.copy()
    shown[away < radius, :3] = DISC
    middle = (away < radius) & (np.abs(across) < 24)
    shown[middle, :3] = np.rint(bright[middle, :3])
    layers[who] = masked(shown, halves(canvas, CANVASES[name][1])[who])
    result = merged(layers, canvas, exposure=False)
    different = (away < radius - 2) & (off(shown, plain) > 30)
    there = off(result, shown)[different] < off(result, plain)[different]
    assert there.mean() > 0.98 or there.mean() < 0.02


@pytest.mark.usefixtures(one_device.__name__)
@pytest.mark.parametrize("name", ["plane", "across the border"])
def test_without_seam_it_is_half_transparent(name: str) -> None:
    layers, canvas, away, plain = scene(name, 0)
    result = merged(layers, canvas, seam=False, transition_strain=0)
    assert (doubt(result, plain, away)[away < RADIUS] > 20).mean() > 0.4


@pytest.mark.usefixtures(one_device.__name__)
@pytest.mark.parametrize("who", [0, 1])
@pytest.mark.parametrize("name", ["plane", "across the border"])
def test_what_only_one_layer_shows_does_not_change_the_exposure_around(name: str, who: int) -> None:
    """With layers of different light, beside the same without the disc; some levels close to it, since the
    lower bands of frequencies change over there. Transitions, which would go round it with what the
    correction leaves, stay as published."""
    layers, canvas, away, _ = scene(name, who, 0.8)
    clean = merged(scene(name, None, 0.8)[0], canvas, transition_strain=0)
    result = merged(layers, canvas, transition_strain=0)
    assert off(result, clean)[away > RADIUS + 32].max() <= 4
    assert off(result, clean)[away > RADIUS + 64].max() <= 2
    # where the disc is absent the wall behind it has its light, but for what the correction fades by over so
    # small a canvas and a shadow of low bands, else the disc is whole; layers differ by some 26 levels, the
    # disc and the wall by 100
    inside = away < RADIUS - 8
    behind = ndimage.gaussian_filter(result[..., 1].astype(float) - clean[..., 1], 3, mode="wrap")[inside]
    absent = np.abs(behind).max() <= 20
    assert absent or off(result, DISC)[inside].max() <= 16


def prepared(device: Device, layers: list[Layer], canvas: Canvas, **chosen) -> joint.Prepared:
    return joint.prepare(device, layers, canvas, Settings(**chosen), silent)


def fields_of(found: joint.Prepared) -> list[np.ndarray]:
    return [layer.field.get() for layer in found.layers]


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("who", [None, 0])
def test_gains_are_those_without_what_is_whole(
    device: Device, monkeypatch: pytest.MonkeyPatch, who: int | None, threads: int
) -> None:
    """Others are found before it is known, so that nobody waits for them where nothing is."""
    solved, correct = list[Any](), colour.correction

    def spy(
        device: Device, measured: Any, settings: Settings, ignored: Any, strict: bool
    ) -> colour.Correction:
        found = correct(device, measured, settings, ignored, strict)
        solved.append((ignored is not None, strict, found))
        return found

    monkeypatch.setattr(colour, "correction", spy)
    layers, canvas, _, _ = scene("plane", who, 0.8)
    found = prepared(device, layers, canvas, threads=threads)
    (last,) = (one for without, strict, one in solved if without == (who is not None) and not strict)
    assert [layer.gain for layer in found.layers] == list(last.gains) and any(last.gains)
    # that by which they are found: without them from the second round on
    assert [without for without, strict, _ in solved if strict] == [False, *[True] * (who is not None)]


def test_each_layer_has_its_own_reach(device: Device) -> None:
    layers, canvas, _, _ = scene("plane", None, dx=4.0)
    found = prepared(device, layers, canvas)
    reaches = [geometry.reach(device, one, one.field, found.grid) for one in found.layers]
    assert [list(one.reach) for one in found.layers] == reaches and reaches[0] != reaches[1]


def test_without_flow_there_are_no_gains(device: Device) -> None:
    layers, canvas, _, _ = scene("plane", None, 0.8)
    assert [one.gain for one in prepared(device, layers, canvas, flow=False).layers] == [None, None]


@pytest.mark.parametrize(
    ("dx", "light", "exposure"),
    [(1.5, 1.0, True), (4.0, 1.0, False), (0.0, 0.5, True), (0.0, 0.5, False), (3.0, 0.8, True)],
)
def test_layers_that_agree_are_blended_as_ever(
    device: Device, dx: float, light: float, exposure: bool
) -> None:
    """No region, and weights and places to the bit, whether the exposure is corrected or only known."""
    layers, canvas, *_ = scene("across the border", None, light, dx)
    with_, without = (prepared(device, layers, canvas, seam=s, exposure=exposure) for s in (True, False))
    for one, other in zip(fields_of(with_), fields_of(without), strict=True):
        np.testing.assert_array_equal(one, other)
    gains = [[layer.gain for layer in found.layers] for found in (with_, without)]
    if exposure:
        for one, other in zip(*gains, strict=True):
            assert (one is None) == (other is None)
            assert one is None or np.array_equal(one.get(), other.get())
    else:
        assert gains == [[None, None]] * 2


def test_identical_layers_have_no_regions(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are no pair, so that nothing is measured; weights and places are the same to the bit."""
    asked = []
    find = seam.regions
    monkeypatch.setattr(seam, "regions", lambda *a, **k: asked.append(find(*a, **k)) or asked[-1])
    layers, canvas, *_ = scene("across the border", None)
    with_, without = (prepared(device, layers, canvas, seam=s) for s in (True, False))
    assert len(asked) == 1 and asked[0].shape == (26, 60) and not asked[0].any()
    for one, other in zip(fields_of(with_), fields_of(without), strict=True):
        np.testing.assert_array_equal(one, other)


def test_weights_outside_the_regions_stay(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """The cut takes weight away only where its cells, grown and blurred by one, reach; a trace is left."""
    seen = {}

    def remember(scene, residual, whole, *rest, original=seam.cut, **named):
        seen["before"], seen["regions"] = [f.get() for f in scene.fields], whole
        result = original(scene, residual, whole, *rest, **named)
        seen["after"] = [f.get() for f in scene.fields]
        return result

    monkeypatch.setattr(seam, "cut", remember)
    layers, canvas, *_ = scene("across the border", 0)
    found = prepared(device, layers, canvas)
    reach = ndimage.binary_dilation(np.tile(seen["regions"], 3), np.ones((3, 3)), 3)[:, 60:120]
    reach = np.kron(reach, np.ones((8, 8), bool))
    changed = 0
    for layer, before, after in zip(found.layers, seen["before"], seen["after"], strict=True):
        left, top, width, height = layer.box
        there = reach[top : top + height, left : left + width]
        assert np.array_equal(before[~there], after[~there])
        assert np.array_equal(before[..., :3], after[..., :3])
        assert ((after[..., 3] > 0) == (before[..., 3] > 0)).all()
        changed += (after[..., 3] < 1e-6 * before[..., 3]).sum()
    assert changed > np.pi * RADIUS**2


# Without flow


def shown_by(result: np.ndarray, layers: list[Layer], canvas: Canvas) -> np.ndarray:
    """Which layers (n, height, width) show exactly what the result does."""
    found = np.zeros((len(layers), canvas.height, canvas.width), bool)
    for own, layer in zip(found, layers, strict=True):
        box, pixels = layer.box, layer.read(0, layer.box.height)
        here = np.s_[box.top : box.bottom, box.left : box.right]
        own[here] = (result[here] == pixels).all(-1)
    return found


@pytest.mark.usefixtures(one_device.__name__)
@pytest.mark.parametrize("name", list(CANVASES))
def test_without_flow_each_pixel_is_one_layers_but_along_narrow_cuts(name: str) -> None:
    """Layers that are 5 px off; blended over the whole overlap, two thirds of it would be doubled."""
    layers, canvas, *_ = scene(name, 0, dx=5)
    result = merged(layers, canvas, flow=False, exposure=False)
    neither = ~shown_by(result, layers, canvas).any(0)
    assert (result[..., 3] == 255).all()
    cuts = 2 if canvas.wraps else 1
    assert neither.sum(1).mean() <= 8 * cuts
    soft = merged(layers, canvas, flow=False, exposure=False, seam=False)
    assert (~shown_by(soft, layers, canvas).any(0)).sum(1).mean() > 60 * cuts


@pytest.mark.usefixtures(one_device.__name__)
@pytest.mark.parametrize("x", [240, 300])
def test_without_flow_a_cut_runs_where_fine_texture_agrees(x: int) -> None:
    """Layers that differ by noise, whose mean is nothing, but on a path that no softmax would choose."""
    canvas = Canvas.plane(480, 208)
    rows, columns = pixel_places(canvas.height, canvas.width)
    path = x + 30 * np.sin(rows / 33)
    noise = np.random.default_rng(1).normal(0, 25, (2, *rows.shape, 1))
    noise[:, np.abs(columns - path) <= 9] = 0
    layers = []
    for one, mask in zip(noise, halves(canvas, 270), strict=True):
        picture = wall(canvas)
        picture[..., :3] = np.clip(picture[..., :3] + one, 0, 255)
        layers.append(masked(picture, mask))
    left, right = shown_by(merged(layers, canvas, flow=False, exposure=False), layers, canvas)
    inside = (rows >= 4) & (rows < canvas.height - 4)  # a cell in a corner has few neighbours to be cut from
    assert left[inside & (columns < path - 9)].all() and right[inside & (columns > path + 9)].all()


@pytest.mark.usefixtures(one_device.__name__)
def test_without_flow_a_canvas_that_is_turned_gives_the_turned_result() -> None:
    """By a whole number of cells of every grid."""
    canvas = CANVASES["across the border"][0]
    layers = scene("across the border", 1, 0.8, 5)[0]
    turned = []
    for layer in layers:
        pixels = np.zeros((canvas.height, canvas.width, 4), np.uint8)
        box = layer.box
        pixels[box.top : box.bottom, box.left : box.right] = layer.read(0, box.height)
        pixels = np.roll(pixels, 96, 1)
        turned.append(masked(pixels, pixels[..., 3] > 0))
    first, second = (merged(ones, canvas, flow=False) for ones in (layers, turned))
    assert off(np.roll(first, 96, 1), second).max() <= 2  # dither is another one there


@pytest.mark.usefixtures(one_device.__name__)
def test_without_flow_exposures_meet_at_the_cut() -> None:
    """Beside each cut, the mean brightness of small patches is as without a difference of exposure."""
    layers, canvas, *_ = scene("plane", None, 0.8, 5)
    clean = merged(scene("plane", None, 1.0, 5)[0], canvas, flow=False)
    ratio = ndimage.gaussian_filter(merged(layers, canvas, flow=False)[..., 1].astype(float), 4)
    ratio /= ndimage.gaussian_filter(clean[..., 1].astype(float), 4)
    slope = np.abs(ratio[:, 12:] - ratio[:, :-12])
    assert np.percentile(slope, 99) < 0.05  # layers differ by 0.2


@pytest.mark.usefixtures(one_device.__name__)
@pytest.mark.parametrize("light", [1.0, 1.3])
def test_without_flow_what_only_one_layer_clips_meets_at_the_cut(light: float) -> None:
    """A sky that is bright in one layer and white in the other, over ground of which they show the same or
    which differs less: no gain makes both agree. Of some 70 levels no step is left."""
    canvas, x, _ = CANVASES["plane"]
    sky, layers = np.s_[: canvas.height // 2], []
    for k, (mask, its) in enumerate(zip(halves(canvas, x), (1.0, light), strict=True)):
        picture = wall(canvas, 5 * k).astype(float)
        picture[..., :3] *= 0.6 * its
        picture[sky][..., :3] += 110 * its + 80 * k
        picture[..., :3] = np.minimum(picture[..., :3], 255)
        layers.append(masked(picture.astype(np.uint8), mask))
    result = merged(layers, canvas, flow=False)[..., 1].astype(float)
    seen = ndimage.gaussian_filter1d(result[8 : canvas.height // 2 - 8].mean(0), 2)
    assert seen[:100].mean() < 195 and seen[-100:].mean() > 245
    assert np.abs(seen[6:] - seen[:-6]).max() < 12


@pytest.mark.usefixtures(one_device.__name__)
def test_without_flow_none_is_looked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(joint.pairflow, "solve", None)
    layers, canvas, *_ = scene("plane", None, dx=5)
    assert (merged(layers, canvas, flow=False)[..., 3] == 255).all()


@pytest.mark.usefixtures(one_device.__name__)
def test_without_flow_an_edge_that_is_elsewhere_leaves_no_shade_at_the_cut() -> None:
    """A post before a bright wall is cut along itself, and is as dark there as both layers have it."""
    canvas = Canvas.plane(480, 208)
    middle = 270
    _, columns = pixel_places(canvas.height, canvas.width)
    layers = []
    for by, mask in zip((-8, 8), halves(canvas, middle), strict=True):
        picture = np.full((canvas.height, canvas.width, 4), 255, np.uint8)
        picture[..., :3] = np.where(np.abs(columns - middle - by) < 15, 60, 150)[..., None]
        layers.append(masked(picture, mask))
    result = merged(layers, canvas, flow=False)[..., 1].astype(int)
    assert np.abs(result[:, middle - 16 : middle + 16] - 60).max() <= 5  # of 90
    assert np.abs(result[:, : middle - 40] - 150).max() <= 2


@pytest.mark.usefixtures(one_device.__name__)
@pytest.mark.parametrize(("wide", "light", "steepest"), [(8, 0.25, 3.0), (24, 0.7, 1.6)])
def test_without_flow_what_differs_all_over_is_exposure(wide: int, light: float, steepest: float) -> None:
    """Texture that is 12 px off, in an overlap that tells no gains: brightness changes without a step."""
    canvas = Canvas.plane(640, 240)
    texture = ndimage.gaussian_filter(np.random.default_rng(1).normal(size=(240, 660)), 3)
    texture = np.clip(0.18 * (texture - texture.mean(0)) / texture.std() + 0.5, 0, 1)
    columns = pixel_places(canvas.height, canvas.width)[1]
    layers = []
    for by, gain, mask in ((0, 1.0, columns < 320 + wide // 2), (12, light, columns >= 320 - wide // 2)):
        picture = np.full((240, 640, 4), 255, np.uint8)
        picture[..., :3] = np.rint(255 * gain * texture[:, by : by + 640, None])
        layers.append(masked(picture, mask))
    seen = ndimage.gaussian_filter1d(merged(layers, canvas, flow=False)[..., 1].mean(0), 4)
    assert np.abs(np.diff(seen)).max() < steepest


@pytest.mark.usefixtures(one_device.__name__)
def test_a_large_person_who_moved_on_by_less_than_his_width_is_there_once() -> None:
    """In layers that show nearly the same, and each of them all of him: half of him would be cheaper to cut
    off than to show what the softmax does not favour.
    """
    y, x = pixel_places(800, 1040)
    plain, rng, layers, photos = texture(y, x, np.uint8), np.random.default_rng(0), [], []
    for place, mask in ((380, x < 1000), (540, x >= 40)):
        picture = plain // 2 + np.uint8(96)
        him = (np.abs(x - place) < 110) & (y > 250) | (np.hypot(x - place, y - 190) < 80)
        coat = rng.integers(0, 120, (70, 40, 3))  # he turned as well
        picture[him, :3] = coat[y[him].astype(int) // 12, (x[him].astype(int) - place + 110) // 12]
        layers.append(masked(picture, mask))
        photos.append((picture, him))
    result = merged(layers, Canvas.plane(1040, 800))
    first, second = sorted((off(result, picture)[him] < 30).mean() for picture, him in photos)
    assert first < 0.1 and second > 0.99

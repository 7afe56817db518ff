"""The paper's iteration against Code 1 of Meng & Liu 2020, written here in NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from pictures import expected_picture, masked, masks_of, merged, noise, one_device, pixel_places, texture
from scipy import ndimage

from hugin_abflow import pairflow
from hugin_abflow.layer import Box, Canvas, Layer
from hugin_abflow.settings import Settings

pytestmark = pytest.mark.usefixtures(one_device.__name__)

PLANE = Canvas.plane(157, 83)
CYLINDER = Canvas.plane(157, 83, wraps=True)

# Code 1 as published: nearest-neighbour sampling, no exposure.
AS_PUBLISHED = {
    "merge": "sequential",
    "interpolation": "nearest",
    "exposure": False,
    "highlights": False,
    "transition_strain": 0.0,
    "intermediate": False,
}

# Where p + F * Blend falls within float32's rounding (2e-5 px) of a pixel's edge, either pixel is nearest;
# with two layers and two axes that is a share of 1e-4. Jump flooding may miss the nearest seed by a fraction
# of a pixel at a few pixels. Elsewhere the sum of two colours may round to the other side of .5.
TIES = 5e-4  # share of pixels that may differ by more than a level; twice that by one


def move(layer: np.ndarray, dx: float, dy: float, period: int = 0) -> np.ndarray:
    y, x = pixel_places(*layer.shape)
    # more motion above than below: no constant flow
    return texture(y - dy, x - dx * (1.5 - y / layer.shape[0]), period=period)


def layers_of(canvas: Canvas, masks: list[np.ndarray]) -> list[Layer]:
    """Layers with parallax."""
    motions = [(0.0, 0.0), (5.0, -2.0), (-3.0, 1.5)]
    period = canvas.width if canvas.wraps else 0
    return [
        masked(move(mask, *motion, period), mask, f"layer {k}")
        for k, (mask, motion) in enumerate(zip(masks, motions, strict=False))
    ]


@pytest.fixture
def flows(monkeypatch):
    """Each merge's two layers, in the engine's order, their flow and the working grid."""
    seen = []
    original = pairflow.solve

    def remember(device, layers, pairs, charts, grid, *rest):
        found = original(device, layers, pairs, charts, grid, *rest)
        ((pair,), *_) = found
        assert (pair.a, pair.b) == (0, 1)
        seen.append((layers[0].layer, layers[1].layer, pair, grid))
        return found

    monkeypatch.setattr(pairflow, "solve", remember)
    return seen


def on_canvas(chart, flow, canvas: Canvas, region: Box) -> np.ndarray:
    """A chart's flow at the canvas's pixels; 0 where the chart does not reach."""
    assert chart.transform[9] == chart.transform[10] == 1  # a pixel of the chart is one of the canvas
    values, result = flow.get(), np.zeros((canvas.height, canvas.width, 2))
    y, x = pixel_places(canvas.height, canvas.width)
    column = x - region.left + int(chart.transform[11])
    row = y - region.top + int(chart.transform[12])
    if canvas.wraps:
        column %= canvas.width
    inside = (column >= 0) & (column < chart.width) & (row >= 0) & (row < chart.height)
    result[inside] = values[row[inside], column[inside]]
    return result


def distance_to(area: np.ndarray, wraps: bool) -> np.ndarray:
    """Distance of each pixel to the nearest pixel of `area`, around the border too."""
    if not wraps:
        return ndimage.distance_transform_edt(~area)
    width = area.shape[1]
    return ndimage.distance_transform_edt(~np.tile(area, 3))[:, width : 2 * width]


def nearest(picture: np.ndarray, y: np.ndarray, x: np.ndarray, wraps: bool) -> tuple[np.ndarray, np.ndarray]:
    """Colours at positions (pixel centres at + 0.5), and whether there are any."""
    height, width = picture.shape[:2]
    row, column = np.floor(y).astype(int), np.floor(x).astype(int)
    if wraps:
        column %= width
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    values = picture[np.where(inside, row, 0), np.where(inside, column, 0)]
    return values[..., :3].astype(float), inside & (values[..., 3] > 0)


def code_1(
    left: np.ndarray,
    right: np.ndarray,
    flow_lr: np.ndarray,
    flow_rl: np.ndarray,
    canvas: Canvas,
    sharpness: float = 10.0,
    magnitude: float = 100.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Code 1 and Eq. 1 on whole canvases (height, width, 4), and where it says anything: a colour from
    outside its layer has no weight, and where that one had nearly all of it the paper knows no answer.
    """
    in_l, in_r = left[..., 3] > 0, right[..., 3] > 0
    l_min, r_min = distance_to(in_l & ~in_r, canvas.wraps), distance_to(in_r & ~in_l, canvas.wraps)
    blend_r = l_min / np.maximum(l_min + r_min, 1e-9)
    blend_l = 1 - blend_r
    y, x = (places + 0.5 for places in pixel_places(canvas.height, canvas.width))
    to_l, to_r = flow_rl * blend_r[..., None], flow_lr * blend_l[..., None]
    colour_l, valid_l = nearest(left, y + to_l[..., 1], x + to_l[..., 0], canvas.wraps)
    colour_r, valid_r = nearest(right, y + to_r[..., 1], x + to_r[..., 0], canvas.wraps)
    length_rl, length_lr = np.linalg.norm(flow_rl, axis=-1), np.linalg.norm(flow_lr, axis=-1)
    weight_l = np.exp(sharpness * blend_l * (1 + magnitude * length_rl / canvas.width))
    weight_r = np.exp(sharpness * blend_r * (1 + magnitude * length_lr / canvas.width))
    exp_l, exp_r = valid_l * weight_l, valid_r * weight_r
    total = np.maximum(exp_l + exp_r, 1e-30)[..., None]
    mixed = (colour_l * exp_l[..., None] + colour_r * exp_r[..., None]) / total
    result = np.zeros(left.shape)
    result[in_l] = left[in_l]
    result[in_r] = right[in_r]
    result[in_l & in_r, :3] = mixed[in_l & in_r]
    lost = np.where(exp_l + exp_r > 0, (exp_l + exp_r) / (weight_l + weight_r), 0) < 1e-9
    return np.rint(result).astype(np.uint8), ~(in_l & in_r & lost)


def spread(layer: Layer, canvas: Canvas) -> np.ndarray:
    """A layer on the whole canvas, transparent black outside it."""
    pixels = np.zeros((canvas.height, canvas.width, 4), layer.dtype)
    box = layer.box
    pixels[box.top : box.bottom, box.left : box.right] = layer.read(0, box.height)
    return expected_picture(pixels, pixels[..., 3] > 0)


def iterate(flows, canvas: Canvas, **parameters) -> tuple[np.ndarray, np.ndarray]:
    """The engine's merges again with Code 1, each onto the mosaic of the last; and where it says anything."""
    mosaic, defined = None, True
    for one, other, pair, grid in flows:
        forward, backward = (
            on_canvas(pair.chart, flow, canvas, grid.region) for flow in (pair.forward, pair.backward)
        )
        # a mosaic's name is made of its layers' names; it is taken from here, not from the engine
        left, right = (mosaic if "+" in layer.name else spread(layer, canvas) for layer in (one, other))
        mosaic, known = code_1(left, right, forward, backward, canvas, **parameters)
        defined = defined & known
    return mosaic, defined


def check(result: np.ndarray, expected: tuple[np.ndarray, np.ndarray]) -> None:
    pixels, defined = expected
    assert defined.mean() > 0.97
    np.testing.assert_array_equal(result[..., 3], pixels[..., 3])
    off = np.abs(result.astype(int) - pixels).max(-1)[defined]
    assert (off > 1).mean() <= TIES
    assert (off > 0).mean() <= 2 * TIES


def two_masks(canvas: Canvas) -> list[np.ndarray]:
    y, x = pixel_places(canvas.height, canvas.width)
    return [(x < 101) & (y < 71) & (x + y > 13), (x >= 49) & (y >= 5) & (x - y < 143)]


@pytest.mark.parametrize("parameters", [(10.0, 100.0), (0.0, 0.0), (3.0, 250.0)])
def test_two_layers_are_code_1(flows, parameters):
    layers = layers_of(PLANE, two_masks(PLANE))
    sharpness, magnitude = parameters
    result = merged(layers, PLANE, **AS_PUBLISHED, softmax_sharpness=sharpness, flow_magnitude=magnitude)
    expected = iterate(flows, PLANE, sharpness=sharpness, magnitude=magnitude)
    overlap = masks_of(layers, PLANE).all(0)
    assert overlap.mean() > 0.2
    check(result, expected)
    # the flow that was found is the layers' motion, so that this tests more than a plain average
    pair = flows[0][2]
    forward = on_canvas(pair.chart, pair.forward, PLANE, flows[0][3].region)
    assert np.median(np.linalg.norm(forward[overlap], axis=-1)) > 3


def test_joint_merging_of_two_layers_is_code_1_too(flows):
    layers = layers_of(PLANE, two_masks(PLANE))
    result = merged(layers, PLANE, **{**AS_PUBLISHED, "merge": "joint"})
    check(result, iterate(flows, PLANE))


def test_two_layers_around_the_border(flows):
    y, x = pixel_places(83, 157)
    masks = [((x - 120) % 157 < 90) & (y > 3), ((x - 11) % 157 < 80) & (y < 77)]
    layers = layers_of(CYLINDER, masks)
    result = merged(layers, CYLINDER, **AS_PUBLISHED)
    assert layers[0].box.width == 157
    check(result, iterate(flows, CYLINDER))


def test_width_is_the_canvas_s(flows):
    """The flow-magnitude term is relative to the canvas, however little of it the layers cover."""
    canvas = Canvas(701, 301, Box(211, 107, 211 + 157, 107 + 83))
    masks = [np.zeros((301, 701), bool) for _ in range(2)]
    for mask, small in zip(masks, two_masks(PLANE), strict=True):
        mask[107:190, 211:368] = small
    result = merged(layers_of(canvas, masks), canvas, **AS_PUBLISHED)
    box = canvas.crop
    expected = tuple(part[box.top : box.bottom, box.left : box.right] for part in iterate(flows, canvas))
    check(result, expected)


def three_masks() -> list[np.ndarray]:
    """The second and third overlap most, so they come first."""
    y, x = pixel_places(83, 157)
    return [(x < 73) & (y > 9), (x >= 41) & (x < 127), (x >= 67) & (y < 80)]


def test_three_layers_are_code_1_twice(flows):
    layers = layers_of(PLANE, three_masks())
    result = merged(layers, PLANE, **AS_PUBLISHED)
    names = {tuple(sorted((one.name, other.name))) for one, other, _, _ in flows}
    assert names == {("layer 1", "layer 2"), ("layer 0", "layer 1+layer 2")}
    check(result, iterate(flows, PLANE))


@pytest.mark.parametrize("count", [2, 3])
def test_a_mosaic_of_several_places_has_no_movers(monkeypatch, count):
    """What stands still moves otherwise for each of them."""
    seen, original = [], pairflow.solve

    def remember(*given):
        seen.append(next(one for one in given if isinstance(one, Settings)).movers)
        return original(*given)

    monkeypatch.setattr(pairflow, "solve", remember)
    merged(layers_of(PLANE, three_masks()[:count]), PLANE, merge="sequential")
    assert seen == [count == 2] * (count - 1)


def test_order_given_by_the_caller_does_not_matter_to_which_come_first(flows):
    layers = layers_of(PLANE, three_masks())
    merged(layers[::-1], PLANE, **AS_PUBLISHED)
    assert {flows[0][0].name, flows[0][1].name} == {"layer 1", "layer 2"}


@pytest.mark.parametrize("canvas", [PLANE, CYLINDER, Canvas.sphere(158, 79)])
def test_cut_picture_comes_back(canvas):
    """One layer after the other changes nothing that they agree on."""
    picture = noise(canvas.height, canvas.width, np.uint16)
    y, x = pixel_places(canvas.height, canvas.width)
    masks = [(x < 61) | (x >= 140), (x >= 43) & (x < 103), (x >= 89) & (y > 11), y < 29]
    result = merged([masked(picture, mask) for mask in masks], canvas, merge="sequential")
    np.testing.assert_array_equal(result, picture)


def test_crop_and_one_layer():
    picture = noise(41, 57)
    canvas = Canvas(101, 83, Box(20, 10, 60, 70))
    result = merged([Layer.from_array("one", picture, 9, 17)], canvas, merge="sequential")
    whole = np.zeros((83, 101, 4), np.uint8)
    whole[17:58, 9:66] = picture
    np.testing.assert_array_equal(result, whole[10:70, 20:60])


def test_a_layer_that_is_given_twice_changes_nothing():
    """As the same object, which is another layer each time."""
    layers = layers_of(PLANE, three_masks()[:2])
    once = merged(layers, PLANE, merge="sequential")
    np.testing.assert_array_equal(merged([layers[0], *layers], PLANE, merge="sequential"), once)

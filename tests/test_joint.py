"""Joint merging keeps what the layers agree on, covers the union and nothing else, and knows no order."""

from __future__ import annotations

import threading
from dataclasses import replace
from itertools import pairwise, permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pictures import (
    DTYPES,
    expected_picture,
    masked,
    masks_of,
    merged,
    noise,
    one_device,
    pixel_places,
    texture,
)

from hugin_abflow import alignment, budget, chart, coefficient, consistency, merge, single
from hugin_abflow.cells import SingleSource
from hugin_abflow.errors import SettingsError
from hugin_abflow.layer import Box, Canvas, Layer
from hugin_abflow.opencl import Device

PLANE = Canvas.plane(301, 151)
CYLINDER = Canvas.plane(301, 151, wraps=True)
SPHERE = Canvas.sphere(302, 151)
CANVASES = {"plane": PLANE, "cylinder": CYLINDER, "sphere": SPHERE}

pytestmark = pytest.mark.usefixtures(one_device.__name__)


def columns(canvas: Canvas, first: int, end: int) -> np.ndarray:
    """The mask of columns [first, end), around the border if the canvas wraps."""
    x = np.arange(canvas.width)
    inside = (x - first) % canvas.width < end - first if canvas.wraps else (x >= first) & (x < end)
    return np.broadcast_to(inside, (canvas.height, canvas.width)).copy()


def ring(canvas: Canvas, parts: int = 4, overlap: int = 29) -> list[np.ndarray]:
    """Masks of strips that overlap; on a canvas that wraps the last overlaps the first. On a sphere two
    more cover the poles."""
    ends = np.linspace(0, canvas.width, parts + 1).astype(int)
    masks = [columns(canvas, a - overlap, b) for a, b in pairwise(ends)]
    if canvas.spherical:
        rows = np.arange(canvas.height)[:, None]
        masks = [mask & (rows >= 31) & (rows < 119) for mask in masks]
        everywhere = columns(canvas, 0, canvas.width)
        masks += [everywhere & (rows < 47), everywhere & (rows >= 101)]
    return masks


def moved(
    canvas: Canvas, mask: np.ndarray, dx: float, dy: float = 0.0, dtype: type = np.uint8, light: float = 1.0,
    black: float = 0.0,
) -> Layer:  # fmt: skip
    """A layer that shows the texture moved by (dx, dy) pixels, darker if light < 1, on top of `black`."""
    y, x = pixel_places(canvas.height, canvas.width)
    picture = texture(y - dy, x - dx, dtype, canvas.width if canvas.wraps else 0)
    picture[..., :3] = (black + picture[..., :3] * light).astype(dtype)
    return masked(picture, mask, f"moved {dx} {dy}")


def moving(canvas: Canvas) -> list[Layer]:
    """Layers with parallax, differently exposed: each shows the scene somewhere else."""
    return [
        moved(canvas, mask, 2.5 * (-1) ** index, 1.5 * (index % 3 - 1), light=1 - 0.2 * (index % 2))
        for index, mask in enumerate(ring(canvas))
    ]


# What layers agree on comes back to the bit


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("flow", [True, False])
def test_identical_layers_come_out_identical(dtype, channels, flow):
    picture = noise(53, 77, dtype, channels)
    layers = [Layer.from_array(str(k), picture, 19, 11) for k in range(3)]
    canvas = Canvas(131, 79, Box(19, 11, 96, 64))
    result = merged(layers, canvas, flow=flow)
    assert result.dtype == dtype
    np.testing.assert_array_equal(result, picture)  # floats too, where 2 ulp would be allowed


@pytest.mark.parametrize("canvas", CANVASES.values(), ids=CANVASES)
@pytest.mark.parametrize(
    "settings", [{}, {"exposure": False}, {"flow": False}], ids=["default", "no exposure", "no flow"]
)
# 7000 working pixels are neither a whole fraction of the canvas nor in step with any layer's box
@pytest.mark.parametrize("working_pixels", [2_100_000, 7_000])
def test_picture_cut_into_layers_comes_back(canvas, settings, working_pixels):
    picture = noise(canvas.height, canvas.width)
    layers = [masked(picture, mask) for mask in ring(canvas)]
    result = merged(layers, canvas, working_pixels=working_pixels, **settings)
    np.testing.assert_array_equal(result, picture)


@pytest.mark.parametrize("dtype", DTYPES[1:])
def test_cut_picture_comes_back_in_every_depth(dtype):
    picture = noise(SPHERE.height, SPHERE.width, dtype)
    layers = [masked(picture, mask) for mask in ring(SPHERE)]
    np.testing.assert_array_equal(merged(layers, SPHERE), picture)


def test_odd_sphere_without_a_pixel_half_a_turn_away():
    """Where the width is odd no column lies opposite another; then the poles are borders."""
    canvas = Canvas.sphere(301, 151)
    picture = noise(canvas.height, canvas.width)
    layers = [masked(picture, mask) for mask in ring(canvas)]
    np.testing.assert_array_equal(merged(layers, canvas), picture)


@st.composite
def shapes(draw, canvas: Canvas, count: int = 3) -> list[np.ndarray]:
    """Random masks of patches, each at least one pixel large."""
    size = draw(st.sampled_from([1, 7, 23]))
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    masks = []
    for _ in range(count):
        share = draw(st.sampled_from([0.05, 0.6, 0.95]))
        coarse = random.random((canvas.height // size + 1, canvas.width // size + 1)) < share
        coarse[0, 0] = True
        masks.append(np.kron(coarse, np.ones((size, size), bool))[: canvas.height, : canvas.width])
    return masks


SMALL = {
    "plane": Canvas.plane(131, 77),
    "cylinder": Canvas.plane(131, 77, True),
    "sphere": Canvas.sphere(130, 65),
}
few_examples = settings(max_examples=8)


@pytest.fixture(scope="module")
def one_device_for_all(device: Device):
    """As `one_device`, for hypothesis, which keeps a fixture for all its examples."""
    patch = pytest.MonkeyPatch()
    patch.setattr(merge, "kept_device", lambda *wanted: device)
    yield
    patch.undo()


@pytest.mark.parametrize("canvas", SMALL.values(), ids=SMALL)
@few_examples
@given(data=st.data())
def test_picture_cut_along_any_shapes_comes_back(canvas, one_device_for_all, data):
    masks = data.draw(shapes(canvas))
    working_pixels = data.draw(st.sampled_from([2_100_000, 1_500]))
    picture = noise(canvas.height, canvas.width)
    result = merged([masked(picture, mask) for mask in masks], canvas, working_pixels=working_pixels)
    np.testing.assert_array_equal(result, expected_picture(picture, np.logical_or.reduce(masks)))


# What is opaque


@pytest.mark.parametrize("canvas", SMALL.values(), ids=SMALL)
@few_examples
@given(data=st.data())
def test_result_is_opaque_where_a_layer_is_and_nowhere_else(canvas, one_device_for_all, data):
    masks = data.draw(shapes(canvas))
    layers = [moved(canvas, mask, 3.0 * k, -2.0 * k, light=0.5, black=64) for k, mask in enumerate(masks)]
    exposure, flow = data.draw(st.booleans()), data.draw(st.booleans())
    working_pixels = data.draw(st.sampled_from([2_100_000, 1_500]))
    result = merged(layers, canvas, exposure=exposure, flow=flow, working_pixels=working_pixels)
    union = np.logical_or.reduce(masks)
    np.testing.assert_array_equal(result[..., 3] == 255, union)
    np.testing.assert_array_equal(result[~union], 0)
    # not darkened by what lies outside a mask either; a multi-band blend and cubics overshoot by some levels
    assert result[union][:, :3].min() >= 64 - 8


@pytest.mark.parametrize("canvas", CANVASES.values(), ids=CANVASES)
def test_whole_canvas_is_covered_with_parallax(canvas):
    layers = moving(canvas)
    result = merged(layers, canvas)
    assert (result[..., 3] == 255).all()
    assert np.ptp(result[..., :3].reshape(-1, 3), axis=0).min() > 150  # and it shows something


# What only one layer covers


@pytest.mark.parametrize("canvas", CANVASES.values(), ids=CANVASES)
@pytest.mark.parametrize(("dtype", "flow"), [(np.uint16, True), (np.float32, True), (np.uint8, False)])
def test_pixels_of_one_layer_are_copied(canvas, dtype, flow):
    layers = [moved(canvas, mask, 4.0 * k, dtype=dtype) for k, mask in enumerate(ring(canvas)[:3])]
    covered = masks_of(layers, canvas)
    result = merged(layers, canvas, exposure=False, flow=flow)
    for layer, own in zip(layers, covered, strict=True):
        alone = own & (covered.sum(0) == 1)
        assert alone.sum() > 1000
        box = layer.box
        pixels = np.zeros(result.shape, dtype)
        pixels[box.top : box.bottom, box.left : box.right] = layer.read(0, box.height)
        np.testing.assert_array_equal(result[alone], pixels[alone])


def test_pixels_of_one_layer_are_copied_where_the_correction_is_zero(monkeypatch):
    """A correction that the overlap asks for fades out, and ends."""
    seen = []
    original = alignment.colour.correction

    def remember(device, measured, settings, ignored, strict):
        found = original(device, measured, settings, ignored, strict)
        seen.extend([] if strict else [found])
        return found

    monkeypatch.setattr(alignment.colour, "correction", remember)
    canvas = Canvas.plane(601, 101)
    masks = [columns(canvas, 0, 131), columns(canvas, 90, 601)]
    pixels = [layer.read(0, 101) for layer in (moved(canvas, masks[0], 0), moved(canvas, masks[1], 0))]
    pixels[0][..., :3] = np.rint(pixels[0][..., :3] * 0.95)
    layers = [Layer.from_array("dark", pixels[0]), Layer.from_array("light", pixels[1], 90)]
    result = merged(layers, canvas)
    (correction,) = seen
    gain = correction.gains[1].get()[..., :3]
    far = [k for k in range(1, gain.shape[1] - 1) if not gain[:, k - 1 : k + 2].any()]
    assert 0 < len(far) < gain.shape[1] - 2  # it is not zero everywhere
    cell = canvas.width / gain.shape[1]
    untouched = np.zeros(canvas.width, bool)
    for k in far:
        untouched[int(np.ceil(k * cell)) : int((k + 1) * cell)] = True
    untouched[:131] = False  # where the other layer is
    assert untouched.sum() > 100
    np.testing.assert_array_equal(result[:, untouched], pixels[1][:, untouched[90:]])
    changed = result[:, 131:200, :3].astype(int) - pixels[1][:, 41:110, :3]
    assert changed.any()  # near the overlap it is corrected


# 360 degrees


# How much a shifted canvas's result may differ, in levels of 8 bit: largest, mean. Its layers come in another
# order, so that sums round otherwise. On the sphere charts have their pixels elsewhere, so that flow differs
# by hundredths of a pixel and colours by the texture's slope times that. Cells of exposure and of
# highlights, of 16 px, lie elsewhere, so that gains and weights are blurred over other pixels; cells of
# transitions as well, so that these lie some px from there, and change over as flow errs; and those, of 8 px,
# by which colours change over sooner (all that is left of it on the cylinder). One of the sphere's pairs goes
# by way of others, whose charts lie elsewhere, too.
SHIFTED = {
    ("cylinder", False, 0.0): (4, 0.003),
    ("cylinder", True, 0.0): (8, 0.8),
    ("sphere", False, 0.0): (7, 0.1),
    ("sphere", True, 0.0): (7, 0.6),
    ("cylinder", True, 0.07): (25, 0.9),
    ("sphere", True, 0.07): (25, 0.9),
}


@pytest.mark.parametrize(("name", "exposure", "strain"), SHIFTED)
def test_shifted_canvas_gives_the_shifted_result(name, exposure, strain):
    canvas = CANVASES[name]
    layers = moving(canvas)
    covered = masks_of(layers, canvas)
    cells = {"exposure": exposure, "highlights": exposure, "transition_strain": strain}
    original = merged(layers, canvas, **cells).astype(int)
    for shift in (1, 64, 237):
        shifted = []
        for layer, mask in zip(layers, covered, strict=True):
            box, pixels = layer.box, np.zeros((*mask.shape, 4), np.uint8)
            pixels[box.top : box.bottom, box.left : box.right] = layer.read(0, box.height)
            shifted.append(masked(np.roll(pixels, shift, 1), np.roll(mask, shift, 1), layer.name))
        result = merged(shifted, canvas, **cells)
        difference = np.abs(np.roll(original, shift, 1) - result)
        largest, mean = SHIFTED[name, exposure, strain]
        assert difference.max() <= largest and difference.mean() <= mean
        # one pixel off would be far beyond
        assert np.abs(np.roll(original, shift + 1, 1) - result).mean() > 5 * max(mean, 0.1)


# Order


@pytest.mark.parametrize("flow", [True, False])
def test_order_does_not_matter(flow):
    layers = moving(SPHERE)
    first = merged(layers, SPHERE, flow=flow)
    random = np.random.default_rng(0)
    for _ in range(2):
        shuffled = [layers[k] for k in random.permutation(len(layers))]
        np.testing.assert_array_equal(merged(shuffled, SPHERE, flow=flow), first)


def test_order_does_not_matter_where_boxes_are_equal():
    """Uncropped layers all lie at the same place with the same size, and these even have one mask."""
    canvas = SMALL["plane"]
    everywhere = columns(canvas, 0, canvas.width)
    layers = [moved(canvas, everywhere, dx, dy) for dx, dy in ((0, 0), (3, 1), (-2, 2))]
    results = [merged(order, canvas) for order in permutations(layers)]
    for result in results[1:]:
        np.testing.assert_array_equal(result, results[0])
    assert len({layer.box for layer in layers}) == 1


def test_order_does_not_matter_for_layers_below_a_working_pixel():
    canvas, speck = Canvas.plane(401, 199), noise(1, 1)
    layers = [
        Layer.from_array("one", speck, 101, 51),
        Layer.from_array("other", speck ^ np.uint8([[[255, 255, 255, 0]]]), 101, 51),
        Layer.from_array("third", noise(51, 47), 301, 101),
    ]
    first, second = (merged(order, canvas, working_pixels=10_000) for order in (layers, layers[::-1]))
    np.testing.assert_array_equal(first, second)


def test_neither_threads_nor_memory_change_a_pixel(monkeypatch):
    """A limit that is too low for the working canvas, which must not depend on it, is refused."""
    canvas = CANVASES["sphere"]
    layers = moving(canvas)
    expected = merged(layers, canvas)
    needed = {}
    # what the process holds by itself changes from run to run
    monkeypatch.setattr(budget.memory, "resident", lambda: 100 << 20)
    monkeypatch.setattr(budget._log, "info", lambda text, *values: needed.setdefault(text, values))
    for other in ({"threads": 1}, {"threads": 2, "band_rows": 7}, {"max_memory": 4 << 30}):
        np.testing.assert_array_equal(merged(layers, canvas, **other), expected)
    ((reckoned, _),) = (values for text, values in needed.items() if text.startswith("memory"))
    with pytest.raises(SettingsError, match=rf"20\.0 MiB is too little.* about {reckoned}; give \d+M$"):
        merged(layers, canvas, max_memory=20 << 20)
    with pytest.raises(SettingsError, match="too little for these layers, which take about"):
        merged(layers, canvas, max_memory=20 << 20, flow=False)


@pytest.mark.parametrize("canvas", ["sphere", "plane"])
@pytest.mark.parametrize("strain", [0.0, 0.07])
def test_only_transitions_do_without_distances(monkeypatch, canvas, strain):
    """With them nobody asks for any, and nothing changes."""
    layers, asked = moving(CANVASES[canvas]), []
    without = merged(layers, CANVASES[canvas], transition_strain=strain)
    find = coefficient.coefficients
    monkeypatch.setattr(
        coefficient, "coefficients", lambda *given, even: asked.append(even) or find(*given, even=False)
    )
    np.testing.assert_array_equal(merged(layers, CANVASES[canvas], transition_strain=strain), without)
    assert asked == [strain > 0]


@pytest.mark.parametrize("looked_for", [True, False])
def test_every_pair_is_mended_with_its_own_images(monkeypatch, looked_for):
    """Each with what is taken whole, whatever others are worked on meanwhile, and told in their order."""
    sampled, weighed, mended, found, given = [], {}, {}, {}, []
    sample, weigh, mend, align = chart.sample, consistency.weigh, consistency.fill, alignment.align

    def spy_sample(device, layer, grid, chart):
        level = sample(device, layer, grid, chart)
        sampled.append((layer, chart, level))
        return level

    def spy_weigh(device, pair, images, parameters, whole=None):
        its = weigh(device, pair, images, parameters, whole)
        weighed[pair.a, pair.b] = pair, images, whole, its
        return its

    def spy_mend(device, found):
        return mended.setdefault(id(found), mend(device, found))

    def spy_find(chart, *_):
        return found.setdefault(id(chart), SingleSource(nowhere, nowhere) if looked_for else None)

    def spy_align(device, layers, pairs, flows, *rest):
        given.append((layers, pairs, list(flows)))
        return align(device, layers, pairs, flows, *rest)

    nowhere = np.zeros((1, 1), bool)
    monkeypatch.setattr(single, "find", spy_find)
    monkeypatch.setattr(single, "on_canvas", lambda *_: None)
    monkeypatch.setattr(chart, "sample", spy_sample)
    monkeypatch.setattr(consistency, "weigh", spy_weigh)
    monkeypatch.setattr(consistency, "fill", spy_mend)
    monkeypatch.setattr(alignment, "align", spy_align)
    merged(moving(SPHERE), SPHERE, movers=looked_for, foreground=False)
    [(layers, pairs, flows)] = given
    assert len(flows) == len(weighed) == len(sampled) // 2 > 3
    for its, flow in zip(pairs, flows, strict=True):
        pair, images, whole, found_flow = weighed[its.a, its.b]
        assert flow is mended[id(found_flow)]
        assert whole is found.get(id(pair.chart))
        shown = [(layer, level) for layer, its_chart, level in sampled if its_chart is pair.chart]
        assert [level for _, level in shown] == list(images)
        assert [layer for layer, _ in shown] == [layers[pair.a], layers[pair.b]]


def test_what_fails_waits_for_no_kernels(monkeypatch):
    """Of those that are built meanwhile no other is begun: it may take seconds, as if Ctrl-C were lost."""

    def wait_for_loaders():
        for thread in threading.enumerate():
            if thread.name == "loader":
                thread.join(60)

    wait_for_loaders()  # of other tests
    built, failed, build = [], threading.Event(), Device.build

    def slow(device, module, options=""):
        if threading.current_thread().name == "loader":
            built.append(module)
            assert failed.wait(60)
        return build(device, module, options)

    def interrupted(top, bottom):
        raise KeyboardInterrupt

    monkeypatch.setattr(Device, "build", slow)
    layer = replace(masked(noise(151, 301), columns(PLANE, 0, 301)), read=interrupted)
    with pytest.raises(KeyboardInterrupt):
        merged([layer], PLANE)
    failed.set()
    wait_for_loaders()
    assert built == ["coefficient"]


@pytest.mark.parametrize("upright", [False, True])
def test_very_long_canvas_is_blended(upright):
    """Products of such a canvas's sides do not fit into 32 bits."""
    length, width = 60_001, 5
    bright, dark = (np.full((width, 40_001, 4), value, np.uint8) for value in (200, 100))
    bright[..., 3] = dark[..., 3] = 255
    places = [(0, 0), (20_000, 0)]
    canvas = Canvas.plane(length, width)
    if upright:
        bright, dark = (np.swapaxes(pixels, 0, 1) for pixels in (bright, dark))
        places = [(0, 0), (0, 20_000)]
        canvas = Canvas.plane(width, length)
    layers = [Layer.from_array("layer", p, *place) for p, place in zip((bright, dark), places, strict=True)]
    for strain in (0.07, 0):
        result = merged(layers, canvas, exposure=False, transition_strain=strain)
        profile = result[:, 2, 0] if upright else result[2, :, 0]
        assert np.all(np.diff(profile.astype(int)) <= 0)
        assert np.all(profile[:20_000] == 200) and np.all(profile[40_001:] == 100)
    assert 140 < profile[30_000] < 160  # as published: in the middle

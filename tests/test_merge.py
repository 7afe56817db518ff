"""The pipeline around the engine: simple cases, crops, bands, small devices, and no borrowed flow."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from pictures import expected_picture, masked, masks_of, merged, noise, one_device, pixel_places, texture

from hugin_abflow import blend, merge, opencl
from hugin_abflow.errors import (
    CanvasError,
    DeviceError,
    GuideError,
    LayersMismatchError,
    LayersMissingError,
    OutputError,
)
from hugin_abflow.guides import Guide
from hugin_abflow.images import ImageWriter, read_layer
from hugin_abflow.layer import Box, Canvas, Layer
from hugin_abflow.merge import merge_layers, merge_project, write_panorama
from hugin_abflow.project import read_plan
from hugin_abflow.settings import Settings

shared_device = pytest.mark.usefixtures(one_device.__name__)

ROOM = Path(__file__).resolve().parent.parent / "sample_projects" / "room"
WIDTH, HEIGHT = 301, 151
CANVASES = {
    "plane": Canvas.plane(WIDTH, HEIGHT),
    "cylinder": Canvas.plane(WIDTH, HEIGHT, wraps=True),
    "sphere": Canvas.sphere(302, HEIGHT),
}


def cropped(canvas: Canvas, *crop: int) -> Canvas:
    return Canvas(canvas.width, canvas.height, Box(*crop), canvas.wraps, canvas.spherical, canvas.hfov)


def with_parallax(canvas: Canvas, dtype: type = np.uint8) -> list[Layer]:
    """Three layers that leave the canvas's corners free; the last two cross the border if it wraps."""
    y, x = pixel_places(canvas.height, canvas.width)
    period = canvas.width if canvas.wraps else 0
    masks = [(x >= 20) & (x < 141) & (y > 11), (x >= 101) & (x < 281), (x >= 229) & (y < 139)]
    if canvas.wraps:
        masks[2] |= (x < 50) & (y < 139)
    motions = [(0, 0), (4, -2), (-3, 1)]
    return [
        masked(texture(y - dy, x - dx, dtype, period), mask, f"layer {k}")
        for k, (mask, (dx, dy)) in enumerate(zip(masks, motions, strict=True))
    ]


# Cases that need no blending


@shared_device
@pytest.mark.parametrize("canvas", CANVASES.values(), ids=CANVASES)
@pytest.mark.parametrize("mode", ["joint", "sequential"])
def test_one_layer_passes_through(canvas, mode):
    picture = noise(canvas.height, canvas.width, np.uint16)
    random = np.random.default_rng(1).random((canvas.height, canvas.width))
    layer = masked(picture, (random > 0.3) & (pixel_places(canvas.height, canvas.width)[1] > 30))
    result = merged([layer], canvas, merge=mode)
    np.testing.assert_array_equal(result, expected_picture(picture, masks_of([layer], canvas)[0]))


@shared_device
@pytest.mark.parametrize("canvas", CANVASES.values(), ids=CANVASES)
@pytest.mark.parametrize("mode", ["joint", "sequential"])
def test_layers_that_do_not_overlap_are_pasted(canvas, mode):
    """Even if they touch: there is nothing that could tell them to change."""
    y, x = pixel_places(canvas.height, canvas.width)
    masks = [(x < 97) & (y > 5), (x >= 97) & (x < 180), (x >= 211) & (y < 60), (x >= 211) & (y >= 83)]
    pictures = [noise(canvas.height, canvas.width, seed=k) for k in range(4)]
    layers = [masked(picture, mask) for picture, mask in zip(pictures, masks, strict=True)]
    result = merged(layers, canvas, merge=mode)
    expected = sum(expected_picture(p, m) for p, m in zip(pictures, masks, strict=True))
    np.testing.assert_array_equal(result, expected)


@shared_device
@pytest.mark.parametrize("exposure", [True, False])
def test_layer_inside_another_takes_no_part(exposure, caplog):
    canvas = CANVASES["plane"]
    layers = with_parallax(canvas)
    without = merged(layers, canvas, exposure=exposure)
    inner = replace(Layer.from_array("inner", noise(41, 57), 31, 47), photo="patch")
    with caplog.at_level(logging.WARNING, "hugin_abflow"):
        result = merged([inner, *layers], canvas, exposure=exposure)
    np.testing.assert_array_equal(result, without)
    assert [r.message for r in caplog.records if "wholly inside" in r.message] == [
        "patch is not used: it lies wholly inside layer 0, so nothing is its own; where it shall show, "
        "mask the other photos in Hugin"
    ]


@shared_device
def test_layer_that_shows_nothing_is_named(caplog):
    layers = with_parallax(CANVASES["plane"])
    empty = Layer.from_array("nothing", np.zeros((41, 57, 4), np.uint8), 31, 47)
    with caplog.at_level(logging.INFO, "hugin_abflow"):
        result = merged([empty, *layers], CANVASES["plane"])
    np.testing.assert_array_equal(result, merged(layers, CANVASES["plane"]))
    assert "nothing is not used: it shows nothing, or next to nothing" in caplog.messages


@shared_device
def test_layer_inside_another_but_for_a_column_still_shows_there(caplog):
    """At working resolution it is wholly inside; what it alone covers may not become a hole."""
    canvas = CANVASES["plane"]
    y, x = pixel_places(HEIGHT, WIDTH)
    # column 19 lies under a working pixel of which neither layer covers all
    masks = [(x >= 20) & (y >= 30), (x >= 19) & (x < 131) & (y >= 50) & (y < 101), y < 40]
    pictures = [noise(HEIGHT, WIDTH, seed=k) for k in range(3)]
    layers = [masked(p, mask, f"layer {k}") for k, (p, mask) in enumerate(zip(pictures, masks, strict=True))]
    with caplog.at_level(logging.INFO, "hugin_abflow"):
        result = merged(layers, canvas, working_pixels=9_000, exposure=False)
    assert "layer 1 is not used: it lies wholly inside layer 0" in caplog.text
    expected = expected_picture(pictures[0], masks[0])
    expected[masks[1] & ~masks[0]] = pictures[1][masks[1] & ~masks[0]]
    np.testing.assert_array_equal(result[40:], expected[40:])


# Crop and bands


@shared_device
@pytest.mark.parametrize("canvas", CANVASES.values(), ids=CANVASES)
@pytest.mark.parametrize(
    "crop", [(13, 7, 288, 140), (0, 60, 77, 61), (250, 0, 301, 151), (150, 145, 301, 151)]
)
def test_exactly_the_crop_comes_out(canvas, crop):
    layers = with_parallax(canvas)
    left, top, right, bottom = crop
    whole = merged(layers, canvas)
    result = merged(layers, cropped(canvas, *crop))
    assert result.shape == (bottom - top, right - left, 4)
    np.testing.assert_array_equal(result, whole[top:bottom, left:right])


@shared_device
@pytest.mark.parametrize("mode", ["joint", "sequential"])
def test_crop_beyond_the_layers_is_transparent(mode):
    canvas = Canvas.plane(401, 203)
    picture = noise(41, 57)
    layers = [
        Layer.from_array("a", picture[:, :40], 110, 90),
        Layer.from_array("b", picture[:, 20:], 130, 90),
    ]
    expected = np.zeros((203, 401, 4), np.uint8)
    expected[90:131, 110:167] = picture
    for left, top, right, bottom in [
        (0, 0, 401, 203),
        (100, 80, 401, 120),
        (0, 0, 60, 203),
        (0, 140, 401, 203),
    ]:
        result = merged(layers, cropped(canvas, left, top, right, bottom), merge=mode)
        np.testing.assert_array_equal(result, expected[top:bottom, left:right])


@shared_device
@pytest.mark.parametrize("mode", ["joint", "sequential"])
def test_wholly_transparent_panorama_is_warned_of(mode, caplog):
    """By its crop or by its masks; once, and not if a single pixel shows, in the last band."""
    canvas = Canvas.plane(101, 57)
    layers = [Layer.from_array(name, noise(20, 30, seed=k), 11 * k, 0) for k, name in enumerate("ab")]
    masked_out = [Layer.from_array("a", np.zeros((57, 101, 4), np.uint8))]
    for shown, crop in (
        (layers, (60, 0, 101, 57)),
        (layers, (0, 20, 101, 57)),
        (masked_out, (0, 0, 101, 57)),
    ):
        caplog.clear()
        result = merged(shown, cropped(canvas, *crop), merge=mode, band_rows=16)
        assert not result.any()
        assert [r.levelname for r in caplog.records] == ["WARNING"]
        assert "wholly transparent" in caplog.text and "crop" in caplog.text
    caplog.clear()
    speck = [Layer.from_array("a", noise(1, 1), 100, 56)]
    assert merged(speck, canvas, merge=mode, band_rows=16)[..., 3].sum() == 255
    assert not caplog.records


@shared_device
@pytest.mark.parametrize("canvas", CANVASES.values(), ids=CANVASES)
@pytest.mark.parametrize("working_pixels", [2_100_000, 7_000])
def test_height_of_bands_changes_nothing(canvas, working_pixels):
    layers = with_parallax(canvas)
    whole = merged(layers, canvas, working_pixels=working_pixels, band_rows=canvas.height)
    for rows in (1, 13, 64, 1000) if working_pixels > 7_000 else (17,):
        result = merged(layers, canvas, working_pixels=working_pixels, band_rows=rows)
        np.testing.assert_array_equal(result, whole)


@shared_device
@pytest.mark.parametrize("seed", [1, 3, 8])
def test_bands_do_not_tell_where_a_layer_inside_another_shows(seed):
    """It does where samples of the others fall into their holes, or it does not: for all bands alike."""
    random, canvas = np.random.default_rng(seed), Canvas.plane(48, 66)
    y, x = pixel_places(66, 48)
    first, second = random.random((2, 66, 48)) > 0.3
    inner = first & (x >= 10) & (y >= 20) & (y < 50)
    shifts = zip((0, 3, -2), (first, second, inner), strict=True)
    layers = [masked(texture(y, x - shift), mask) for shift, mask in shifts]
    settings = {"working_pixels": 48 * 66}
    whole = merged(layers, canvas, band_rows=66, **settings)
    for rows in (4, 13):
        np.testing.assert_array_equal(merged(layers, canvas, band_rows=rows, **settings), whole)


@shared_device
def test_bands_read_only_rows_near_them():
    """Full resolution is a stream: no layer is read whole for a band, but for a band of its height."""
    canvas = CANVASES["plane"]
    longest = []

    def watched(layer: Layer) -> Layer:
        def read(top: int, bottom: int) -> np.ndarray:
            longest.append(bottom - top)
            return layer.read(top, bottom)

        return Layer(layer.name, layer.box, layer.dtype, layer.channels, read)

    layers = [watched(layer) for layer in with_parallax(canvas)]
    bands = merge.joint.merge(merge.Device(None), layers, canvas, Settings(band_rows=16), merge.silent)
    next(bands)
    longest.clear()  # reading for the working canvas
    assert sum(len(rows) for rows in bands) == HEIGHT - 16
    assert 16 <= max(longest) <= 16 + 2 * 10  # motion of 4 px, three more for taps


# What merge_layers refuses


@shared_device
def test_layers_and_guides_may_come_one_after_the_other():
    layers = with_parallax(CANVASES["plane"])
    guides = [Guide(0, 1, (120.0, 60.0), (123.0, 60.0))]
    expected = merge_layers(layers, CANVASES["plane"], guides=guides)
    result = merge_layers(iter(layers), CANVASES["plane"], guides=iter(guides))
    np.testing.assert_array_equal(result, expected)


def test_no_layers():
    with pytest.raises(LayersMissingError, match="no layers to merge"):
        merge_layers([], CANVASES["plane"])


@pytest.mark.parametrize(
    "crop", [(0, 0, 0, 0), (5, 9, 30, 9), (9, 5, 9, 30), (-1, 0, 20, 20), (0, 0, 302, 20), (0, 9, 20, 152)]
)
def test_crops_that_are_no_part_of_the_canvas(crop):
    with pytest.raises(CanvasError, match=r"crop of columns .* canvas of 301x151; choose"):
        merge_layers([Layer.from_array("a", noise(20, 20))], cropped(CANVASES["plane"], *crop))


@pytest.mark.parametrize("a, b", [(0, 2), (2, 0), (-1, 0), (1, 1), (0.5, 1)])
def test_guides_of_layers_that_are_none(a, b):
    layers = [Layer.from_array(name, noise(20, 20)) for name in "ab"]
    with pytest.raises(GuideError, match=rf"^one is about the layers {a} and {b}; .* of 0 to 1, "):
        merge_layers(layers, CANVASES["plane"], guides=[Guide(a, b, (1, 1), (2, 2), "one")])


@pytest.mark.parametrize("place", [(float("nan"), 1.0), (1.0, float("inf"))])
def test_guides_of_places_that_are_none(place):
    layers = [Layer.from_array(name, noise(20, 20)) for name in "ab"]
    for ends in ((place, (1, 1)), ((1, 1), place)):
        with pytest.raises(GuideError, match=r"guide is at .*; give canvas pixels"):
            merge_layers(layers, CANVASES["plane"], guides=[Guide(1, 0, *ends)])


@pytest.mark.parametrize(
    "other, message",
    [
        (
            Layer.from_array("b", noise(20, 20), 290, 0),
            "b covers columns 290 to 310 .* outside the canvas of 301x151",
        ),
        (Layer.from_array("b", noise(20, 20, np.uint16)), "b has uint16 samples, a has uint8"),
        (Layer.from_array("b", noise(20, 20, channels=1)), "b is grey, a is RGB"),
    ],
)
def test_layers_that_do_not_belong_together(other, message):
    with pytest.raises(LayersMismatchError, match=message):
        merge_layers([Layer.from_array("a", noise(20, 20)), other], CANVASES["plane"])


def test_threads_bound_reading_and_writing_as_well(tmp_path, monkeypatch):
    """OpenImageIO decodes, our own threads encode."""
    seen = {}
    monkeypatch.setattr(merge, "use_threads", lambda count: seen.setdefault("decoding", count))
    writer = merge.ImageWriter
    monkeypatch.setattr(
        merge,
        "ImageWriter",
        lambda *a, threads, **more: seen.setdefault("encoding", threads) and writer(*a, **more),
    )
    canvas = CANVASES["plane"]
    settings = Settings(threads=1, flow=False)
    merge.write_panorama(
        tmp_path / "a.tif", with_parallax(canvas), canvas, settings, projection="flat", metadata=None
    )
    assert seen == {"decoding": 1, "encoding": 1}
    assert (tmp_path / "a.tif").exists()


# Devices with little memory


@pytest.fixture
def small_memory(monkeypatch):
    """`small_memory(bytes)`: a device on which all buffers that are alive together may take so much."""

    def limit(size: int) -> list[int]:
        peak, alive = [0], [0]

        class Limited(opencl.Buffer):
            def __init__(self, device, shape, dtype, host=None):
                self.counted = 0
                wanted = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
                if alive[0] + wanted > size:
                    raise opencl.DeviceMemoryError(f"no {wanted} bytes left; close other programs")
                super().__init__(device, shape, dtype, host)
                self.counted = wanted
                alive[0] += wanted
                peak[0] = max(peak[0], alive[0])

            def __del__(self):
                alive[0] -= self.counted

        monkeypatch.setattr(opencl, "Buffer", Limited)
        return peak

    return limit


@shared_device
def test_bands_shrink_where_memory_ends(small_memory, caplog):
    """All that is needed at working resolution fits, a band of the whole height does not."""
    canvas = Canvas.plane(701, 601)
    y, x = pixel_places(canvas.height, canvas.width)
    layers = [
        masked(texture(y, x), x < 400, "a"),
        masked(texture(y, x - 5), x >= 300, "b"),
    ]
    settings = {"working_pixels": 10_000}
    peak = small_memory(1 << 40)
    expected = merged(layers, canvas, **settings)
    needed = peak[0]
    peak = small_memory(1 << 40)
    merged(layers, canvas, band_rows=4, **settings)
    enough = (needed + peak[0]) // 2
    assert enough < 0.9 * needed
    peak = small_memory(enough)
    result = merged(layers, canvas, **settings)
    np.testing.assert_array_equal(result, expected)
    assert peak[0] <= enough
    assert not caplog.records  # the same result is nothing to warn of


@shared_device
def test_working_resolution_falls_where_memory_ends(small_memory, caplog):
    canvas = CANVASES["plane"]
    layers = with_parallax(canvas)
    peak = small_memory(1 << 40)
    # with more threads the peak varies from run to run
    expected = merged(layers, canvas, band_rows=16, threads=1)
    peak = small_memory(peak[0] * 2 // 3)
    result = merged(layers, canvas, band_rows=16, threads=1)
    (record,) = caplog.records
    assert record.levelno == logging.WARNING and "lower working resolution" in record.message
    np.testing.assert_array_equal(result[..., 3], expected[..., 3])
    assert np.abs(result.astype(int) - expected).mean() < 2  # much the same picture


@shared_device
def test_memory_below_any_sense_is_an_error(small_memory):
    small_memory(20_000)
    with pytest.raises(DeviceError, match="close other programs"):
        merged(with_parallax(CANVASES["plane"]), CANVASES["plane"])


@shared_device
def test_memory_too_small_for_the_smallest_band_is_an_error(small_memory, monkeypatch):
    def too_small(*arguments):
        raise opencl.DeviceMemoryError("no memory for a band")

    monkeypatch.setattr(blend, "_bands", too_small)
    with pytest.raises(DeviceError, match="no memory for a band"):
        merged(with_parallax(CANVASES["plane"]), CANVASES["plane"])


# What fails


def test_nothing_is_open_any_more_when_the_file_cannot_be_written(monkeypatch, tmp_path):
    """While the error is handled, and so holds all frames: the folder of the layers goes next."""
    closed = []

    def bands(*arguments):
        try:
            while True:
                yield np.zeros((1, WIDTH, 4), np.uint8)
        finally:
            closed.append(True)

    def full(writer, rows):
        raise OutputError("no space")

    monkeypatch.setattr(ImageWriter, "write_rows", full)
    layers = [Layer.from_array("a", noise(HEIGHT, WIDTH), 0, 0)]
    with pytest.raises(OutputError, match="no space") as error:
        write_panorama(tmp_path / "a.tif", layers, CANVASES["plane"], Settings(), projection="", method=bands)
    assert error.tb and closed
    assert not list(tmp_path.iterdir())


# The engine is ours


def test_sample_merges_without_opencv(monkeypatch, tmp_path):
    """No function of OpenCV is called that could do our work; where masks end at the rim is none."""
    monkeypatch.setattr("hugin_abflow.rim.cv2", Mock(**vars(cv2)))
    words = ("flow", "remap", "distance", "warp", "blur", "pyr", "filter", "resize", "blend", "inpaint")
    patched = []
    for name in dir(cv2):
        function = getattr(cv2, name)
        if callable(function) and any(word in name.lower() for word in words):

            def refuse(*arguments, name=name, **options):
                raise AssertionError(f"cv2.{name} was called")

            monkeypatch.setattr(cv2, name, refuse)
            patched.append(name)
    assert {"remap", "distanceTransform", "calcOpticalFlowFarneback", "warpAffine"} <= set(patched)
    assert {"DISOpticalFlow_create", "GaussianBlur", "resize", "pyrDown", "filter2D"} <= set(patched)
    output = tmp_path / "room.tif"
    merge_project(ROOM / "room.pto", Settings(working_pixels=60_000), prefix="room", output=output)
    crop = read_plan(ROOM / "room.pto").canvas.crop
    pixels = read_layer(output).read(0, crop.height)
    assert pixels.shape == (crop.height, crop.width, 4)
    assert (pixels[..., 3] == 255).all() and pixels[..., :3].std() > 20

"""Box, canvas and layer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hugin_abflow import merge_layers
from hugin_abflow.errors import CanvasError, ImageReadError, LayersMismatchError
from hugin_abflow.layer import Box, Canvas, Layer, check_canvas, check_layers, full_scale


def test_box_is_a_place_and_a_part_of_arrays():
    box = Box.at(4, 5, 10, 3)
    assert box == Box(4, 5, 14, 8) and box.place == (4, 5, 10, 3)
    assert np.zeros((20, 30))[box.slices].shape == (3, 10)
    assert (box.slices[0].start, box.slices[1].start) == (5, 4)


def test_box_measures_and_intersects():
    box = Box(3, 5, 14, 12)
    assert (box.width, box.height) == (11, 7)
    assert box.intersect(Box(10, 0, 99, 8)) == Box(10, 5, 14, 8)
    assert Box(10, 0, 99, 8).intersect(box) == Box(10, 5, 14, 8)


@pytest.mark.parametrize("other", [Box(14, 5, 20, 12), Box(3, 12, 14, 20), Box(-9, -9, 3, 5)])
def test_boxes_that_only_touch_have_nothing_in_common(other):
    common = Box(3, 5, 14, 12).intersect(other)
    assert common.width * common.height == 0
    assert common.width >= 0 and common.height >= 0


def test_canvas_kinds():
    assert not Canvas.plane(31, 17).wraps
    assert not Canvas.plane(31, 17).spherical
    assert Canvas.sphere(62, 31).wraps
    assert not Canvas.sphere(62, 31, hfov=359.0).wraps
    assert Canvas.sphere(62, 31).crop == Box(0, 0, 62, 31)


def test_layer_from_array_serves_the_rows_asked_for():
    pixels = np.arange(7 * 5 * 4, dtype=np.uint16).reshape(7, 5, 4)
    layer = Layer.from_array("memory", pixels[:, ::-1], left=3, top=2)  # not contiguous
    assert layer.box == Box(3, 2, 8, 9)
    assert (layer.channels, layer.dtype) == (3, np.uint16)
    assert np.array_equal(layer.read(2, 6), pixels[2:6, ::-1])
    assert layer.read(2, 6).flags.c_contiguous
    assert layer.file is None and layer.canvas_size is None


@pytest.mark.parametrize(
    "dtype, full", [(np.uint8, 255), (np.uint16, 65535), (np.float16, 1), (np.float32, 1)]
)
def test_full_scale(dtype, full):
    assert full_scale(dtype) == full


@pytest.mark.parametrize("shape", [(7, 5), (7, 5, 3), (7, 5, 1), (7, 5, 5), (0, 5, 4), (7, 0, 4)])
def test_array_of_another_shape_is_refused(shape):
    with pytest.raises(ImageReadError, match=r"memory has the shape .*RGB and alpha"):
        Layer.from_array("memory", np.zeros(shape, np.uint8))


@pytest.mark.parametrize("dtype", [np.float64, np.int16, np.uint32, bool])
def test_array_of_another_type_is_refused(dtype):
    with pytest.raises(ImageReadError, match=r"memory has samples of type .*uint16"):
        Layer.from_array("memory", np.zeros((7, 5, 4), dtype))


def test_array_in_foreign_byte_order_is_converted():
    pixels = np.arange(7 * 5 * 4, dtype=np.uint16).reshape(7, 5, 4)
    layer = Layer.from_array("memory", pixels.astype(pixels.dtype.newbyteorder()))
    assert layer.read(0, 7).dtype.isnative
    assert np.array_equal(layer.read(0, 7), pixels)


def test_different_profiles_are_reported(caplog):
    """All at once, and what becomes of them."""

    def layer(name, icc=b"profile"):
        return Layer.from_array(name, np.zeros((3, 5, 4), np.uint8), icc=icc)

    coloured = [layer("b"), layer("c")]
    check_layers(Canvas.plane(31, 17), coloured)
    assert not caplog.records
    check_layers(Canvas.plane(31, 17), [layer("a", None), *coloured])
    (said,) = caplog.messages
    assert "other than that of a: b, c; " in said
    caplog.clear()
    check_layers(Canvas.plane(31, 17), [*coloured, layer("a", None)])
    (said,) = caplog.messages
    assert "other than that of b: a; " in said and "not converted" in said
    check_layers(Canvas.plane(31, 17), [])


def test_a_place_is_of_whole_pixels():
    pixels = np.full((3, 5, 4), 255, np.uint8)
    layer = Layer.from_array("a", pixels, np.uint8(250), np.int16(7))
    assert layer.box == Box(250, 7, 255, 10)  # no more of 8 bits
    with pytest.raises(TypeError):
        Layer.from_array("a", pixels, 120.0)
    with pytest.raises(LayersMismatchError, match="not at whole pixels"):
        check_layers(Canvas.plane(300, 20), [replace(layer, box=Box(0.5, 0, 5.5, 3))])


@pytest.mark.parametrize("wrong", [np.s_[:, :, :3], np.s_[:, :4], np.s_[:1]])
def test_rows_of_another_shape_or_type_are_refused(wrong):
    """Kernels would read beyond them."""
    pixels = np.full((3, 5, 4), 255, np.uint8)
    layer = Layer.from_array("a", pixels)
    assert layer.rows(1, 3).shape == (2, 5, 4)
    wide = np.full((3, 9, 4), 255, np.uint8)
    assert replace(layer, read=lambda top, bottom: wide[top:bottom, 2:7]).rows(0, 3).flags.c_contiguous
    other = replace(layer, read=lambda top, bottom: pixels[top:bottom][wrong])
    with pytest.raises(ImageReadError, match=r"a: rows 0 to 3 are uint8 of the shape .*, \(3, 5, 4\)"):
        other.rows(0, 3)
    with pytest.raises(ImageReadError, match="are float64 of"):
        replace(layer, read=lambda top, bottom: pixels[top:bottom].astype(float)).rows(0, 3)
    with pytest.raises(ImageReadError, match="has to give uint8"):
        merge_layers([other, layer], Canvas.plane(5, 3))


@pytest.mark.parametrize("hfov", [0.0, -90.0, 361.0, float("nan")])
def test_a_sphere_has_a_field_of_view(hfov):
    with pytest.raises(CanvasError, match="field of view"):
        check_canvas(Canvas.sphere(60, 30, hfov))


def test_a_canvas_is_of_whole_pixels():
    with pytest.raises(CanvasError, match="whole numbers"):
        check_canvas(Canvas.plane(60.0, 30))

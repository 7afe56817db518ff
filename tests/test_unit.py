"""Floats coded as photos are: the kernel against its twin, and panoramas of any scale."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from grids import on_device, random_layer
from pictures import merged, noise, one_device
from reference.unit import unit_code

from hugin_abflow import unit
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.opencl import Device
from hugin_abflow.working import WorkingLayer

__all__ = ["one_device"]

CANVAS = Canvas.plane(301, 151)
FLOATS = Layer.from_array("a", np.zeros((1, 1, 4), np.float32))


def working(device: Device, pixels: np.ndarray) -> WorkingLayer:
    """A working layer of floats."""
    one = on_device(device, pixels.astype(np.float32), 3, 5)
    return WorkingLayer(FLOATS, one.box, one.pixels, one.checksum)


def layers(scale: float) -> list[Layer]:
    """Two photos of linear light that share 61 columns, one of them moved there and darker."""
    light = (noise(151, 301, seed=4).astype(np.float64) / 255) ** 2.2 * scale
    light[..., 3] = 1
    moved = np.roll(light, 3, 1) * (0.7, 0.7, 0.7, 1)
    return [
        Layer.from_array("a", np.ascontiguousarray(light[:, :181].astype(np.float32))),
        Layer.from_array("b", np.ascontiguousarray(moved[:, 120:].astype(np.float32)), 120),
    ]


def test_coded_as_by_the_twin(device: Device) -> None:
    """All layers alike, so that the light of their brightest channels has a median of .18; no light is less
    than none."""
    pixels = [0.02 * (random_layer(seed, 77, 53, 0.7) - 0.05) for seed in (1, 2)]
    for one in pixels:
        one[..., 3] = one[..., 3] > 0
    coded = [working(device, one) for one in pixels]
    light_unit = unit.code_floats(device, coded)
    assert 0 < light_unit < 1
    for one, before in zip(coded, pixels, strict=True):
        np.testing.assert_allclose(one.pixels.get(), unit_code(before, light_unit**-0.5), rtol=1e-5)
    picked = [one.pixels.get()[::8, ::8] for one in coded]
    seen = np.concatenate([one[..., :3].max(-1)[one[..., 3] > 0] for one in picked])
    assert np.median(seen[seen > 0]) ** 2 == pytest.approx(0.18, rel=1e-5)


def test_integers_stay(device: Device) -> None:
    pixels = random_layer(1, 77, 53, 1.0)
    integers = on_device(device, pixels)
    assert unit.code_floats(device, [integers]) == 1
    np.testing.assert_array_equal(integers.pixels.get(), pixels)
    assert unit.code_floats(device, []) == 1


@pytest.mark.parametrize("values", [[0.0], [np.nan, np.inf], [-1.0]])
def test_what_shows_nothing_has_no_unit(values: list[float]) -> None:
    picked = np.zeros((1, len(values), 4), np.float32)
    picked[0, :, :3], picked[..., 3] = np.array(values)[:, None], 1
    assert unit._light_unit([picked]) == 1


def test_light_beyond_what_floats_hold_is_none(device: Device) -> None:
    pixels = np.ones((53, 77, 4), np.float32)
    pixels[..., :3] = 1e-30
    pixels[8, 8, :3] = 3e38
    coded = working(device, pixels)
    unit.code_floats(device, [coded])
    assert np.isfinite(coded.pixels.get()).all()


def test_little_of_the_layers_is_on_the_host_at_a_time(device: Device) -> None:
    """None of their arrays stays, of which some pixels are looked at."""
    coded = [working(device, np.full((530, 770, 4), 0.3, np.float32)) for _ in range(9)]
    tracemalloc.start()
    unit.code_floats(device, coded)
    assert tracemalloc.get_traced_memory()[1] < 2.5 * 530 * 770 * 16
    tracemalloc.stop()


@pytest.mark.usefixtures(one_device.__name__)
@pytest.mark.parametrize("scale", [1 / 4096, 1 / 4, 1024.0])
def test_panoramas_do_not_depend_on_the_scale(scale: float) -> None:
    """Of light as dark as in a room, or in any other unit: a power of 4, whose root rounds nothing."""
    panorama, expected = (merged(layers(one), CANVAS)[..., :3] / one for one in (scale, 1.0))
    np.testing.assert_allclose(panorama, expected, rtol=1e-5, atol=1e-6)

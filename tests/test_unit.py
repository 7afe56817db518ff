"""The unit of floats: the kernel against its twin, and panoramas of any scale."""

from __future__ import annotations

import numpy as np
import pytest
from grids import on_device, random_layer
from pictures import merged, noise, one_device
from reference.unit import unit_scale

from hugin_abflow import unit
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.opencl import Device

__all__ = ["one_device"]

CANVAS = Canvas.plane(301, 151)


def layers(scale: float, dtype: type = np.float32) -> list[Layer]:
    """Two photos of linear light that share 61 columns, one of them moved there and darker."""
    light = (noise(151, 301, seed=4).astype(np.float64) / 255) ** 2.2 * scale
    light[..., 3] = 1
    moved = np.roll(light, 3, 1) * (0.7, 0.7, 0.7, 1)
    return [
        Layer.from_array("a", np.ascontiguousarray(light[:, :181].astype(dtype))),
        Layer.from_array("b", np.ascontiguousarray(moved[:, 120:].astype(dtype)), 120),
    ]


def test_scaled_as_by_the_twin(device: Device) -> None:
    """All layers by one factor, which leaves the median of their brightest channels at .18."""
    pixels = [0.02 * random_layer(seed, 77, 53, 0.7) for seed in (1, 2)]
    for one in pixels:
        one[..., 3] = one[..., 3] > 0
    working = [on_device(device, one.astype(np.float32), 3, 5) for one in pixels]
    floats = [Layer.from_array("a", np.zeros((1, 1, 4), np.float32))] * 2
    scaled = [
        type(one)(layer, one.box, one.pixels, one.checksum)
        for one, layer in zip(working, floats, strict=True)
    ]
    full = unit.scale_floats(device, scaled)
    assert 0 < full < 1
    for one, before in zip(scaled, pixels, strict=True):
        np.testing.assert_allclose(one.pixels.get(), unit_scale(before, 1 / full), rtol=1e-6)
    picked = [one.pixels.get()[::8, ::8] for one in scaled]
    seen = np.concatenate([one[..., :3].max(-1)[one[..., 3] > 0] for one in picked])
    assert np.median(seen[seen > 0]) == pytest.approx(0.18, rel=1e-5)


def test_integers_and_what_is_as_bright_as_photos_stay(device: Device) -> None:
    pixels = random_layer(1, 77, 53, 1.0)
    pixels[..., :3] = np.clip(pixels[..., :3], 0.2, 0.45)
    working = on_device(device, pixels)
    assert unit.scale_floats(device, [working]) == 1  # integers
    floats = Layer.from_array("a", np.zeros((1, 1, 4), np.float32))
    assert unit.scale_floats(device, [type(working)(floats, working.box, working.pixels, 0)]) == 1
    np.testing.assert_array_equal(working.pixels.get(), pixels)
    assert unit.scale_floats(device, []) == 1


@pytest.mark.parametrize("values", [[0.0], [np.nan, np.inf], [-1.0]])
def test_what_shows_nothing_has_no_unit(values: list[float]) -> None:
    picked = np.zeros((1, len(values), 4), np.float32)
    picked[0, :, :3], picked[..., 3] = np.array(values)[:, None], 1
    assert unit._factor([picked]) == 1


@pytest.mark.usefixtures(one_device.__name__)
@pytest.mark.parametrize(("scale", "like"), [(1 / 4096, 1 / 8), (1 / 64, 1 / 8), (512.0, 4.0)])
def test_panoramas_do_not_depend_on_the_scale(scale: float, like: float) -> None:
    """Of light as dark as in a room, or in any other unit."""
    panorama, expected = (merged(layers(one), CANVAS)[..., :3] / one for one in (scale, like))
    np.testing.assert_array_equal(panorama, expected)

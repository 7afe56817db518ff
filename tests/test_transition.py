"""Transitions as steep as the strain allows: kernels against twins, the strain against what it should be."""

from __future__ import annotations

import numpy as np
import pytest
from grids import GRIDS, on_device, patches, random_layer
from reference.transition import transition_ratio, transition_sharpen, transition_strain
from scipy import ndimage
from tolerances import TRIGONOMETRY, assert_close

from hugin_abflow import transition
from hugin_abflow.chart import pair_chart
from hugin_abflow.coefficient import Coefficients
from hugin_abflow.geometry import PairFlow
from hugin_abflow.opencl import Device
from hugin_abflow.settings import Settings

BOX = (9, 1, 60, 37)
# On the transition grid of GRIDS["plane"]: layers are as bright as each other.
ALIKE = np.zeros(transition.transition_grid(GRIDS["plane"]).shape, np.float32)


def smooth(seed: int, width: int, height: int) -> np.ndarray:
    """Coefficients with places where they are 0 and 1."""
    values = ndimage.gaussian_filter(np.random.default_rng(seed).random((height, width)), 4)
    values = (values - values.min()) / np.ptp(values)
    return np.clip(1.4 * values - 0.2, 0, 1).astype(np.float32)


@pytest.mark.parametrize("name", list(GRIDS))
def test_strain_equals_its_twin(device: Device, name: str) -> None:
    grid = GRIDS[name]
    box = (BOX[0], BOX[1], BOX[2], min(BOX[3], grid.height - 2))
    cells = grid.resized(5, 3)
    random = np.random.default_rng(3)
    displacement = ndimage.gaussian_filter(random.normal(size=(box[3], box[2], 4)), (3, 3, 0))
    displacement = (20 * displacement * (grid.lens[1] or 1)).astype(np.float32)
    blend, layer = smooth(4, box[2], box[3]), random_layer(5, box[2], box[3])
    strain = device.upload(np.ones((3, 5, 2), np.float32))
    device.run(
        "transition", "transition_strain", (5, 3),
        device.upload(displacement[::3, ::3]), device.upload(blend),
        device.upload(layer), box, grid.border, grid.lens, 3, cells.border, strain,
    )  # fmt: skip
    twin = transition_strain(
        displacement[::3, ::3], blend, layer, box, grid.border, grid.lens, 3, cells.border
    )
    assert (twin[..., 0] > 0).mean() > 0.6
    assert_close(strain.get(), 1 + twin, 10 * TRIGONOMETRY)


def test_twin_of_strain_is_flow_over_width() -> None:
    """A linear transition over 50 px with flow of 3 px: 6 % everywhere."""
    grid = GRIDS["plane"]
    blend = np.tile(np.clip((np.arange(77) - 10) / 50, 0, 1), (53, 1))
    displacement = np.zeros((53, 77, 4))
    displacement[..., 1] = 3 * (1 - blend)
    layer = np.ones((53, 77, 4))
    sums = transition_strain(
        displacement[::2, ::2], blend, layer, (0, 0, 77, 53), grid.border, grid.lens, 2, (1, 1)
    )
    # the ends of the transition, where the slope begins, weigh next to nothing
    assert (sums[0, 0, 0] / sums[0, 0, 1]) ** 0.25 == pytest.approx(0.06, rel=0.01)


@pytest.mark.parametrize("name", list(GRIDS))
def test_sharpening_equals_its_twins(device: Device, name: str) -> None:
    grid = GRIDS[name]
    box = (BOX[0], BOX[1], BOX[2], min(BOX[3], grid.height - 2))
    cells = grid.resized(5, 3)
    blend = smooth(6, box[2], box[3])
    power = (1 + 5 * np.random.default_rng(7).random((3, 5))).astype(np.float32)
    total = patches(8, grid.width, grid.height, 0.5) * 0.3
    sharpened, sums = device.upload(blend), device.upload(total)
    device.run(
        "transition", "transition_sharpen", box[2:], sharpened, box, grid.border, device.upload(power),
        cells.border, sums,
    )  # fmt: skip
    twin = transition_sharpen(blend, box, grid.border, power, cells.border)
    assert_close(sharpened.get(), twin, TRIGONOMETRY)
    inside = np.s_[box[1] : box[1] + box[3], box[0] : box[0] + box[2]]
    expected = total.astype(np.float64)
    expected[inside] += twin
    assert_close(sums.get(), expected, TRIGONOMETRY)
    device.run("transition", "transition_ratio", box[2:], sharpened, box, grid.border, sums)
    assert_close(sharpened.get(), transition_ratio(twin, box, expected), 10 * TRIGONOMETRY)


@pytest.mark.parametrize(("flow", "power"), [(0.0, 12.0), (0.5, 6.0), (3.0, 1.0), (10.0, 1.0)])
def test_exponent_brings_the_strain_to_what_is_wanted(flow: float, power: float) -> None:
    strain = flow / 50
    sums = np.tile(np.array([0.2 * strain**4, 0.2]), (9, 20, 1))
    alike, unlike = np.zeros((9, 20), np.float32), np.ones((9, 20), np.float32)
    assert transition.exponent(sums, 0.06, True, alike) == pytest.approx(power, rel=1e-3)
    assert transition.exponent(sums, 0.06, True, unlike) == pytest.approx(1, rel=1e-6)


def two_layers(device: Device, flow: float) -> tuple[list, list[Coefficients], list[PairFlow]]:
    """Two layers that share all of a plane but ten columns each, and change over between them."""
    grid = GRIDS["plane"]
    layers, coefficients = [], []
    for k in (0, 1):
        pixels = random_layer(k, 77, 53, 1.0)
        pixels[:, : 10 if k else 0, 3] = 0
        pixels[:, 67 if not k else 77 :, 3] = 0
        layers.append(on_device(device, pixels))
        w = np.tile(np.clip((np.arange(77) - 9.5) / 57, 0, 1), (53, 1)).astype(np.float32)
        w = w if k else 1 - w
        coefficients.append(Coefficients(device.upload(w), device.empty((53, 77), np.uint8).fill(255)))
    chart = pair_chart(np.ones((53, 77), bool), grid, grid)
    field = np.zeros((chart.height, chart.width, 2), np.float32)
    field[..., 0] = flow
    return layers, coefficients, [PairFlow(0, 1, chart, device.upload(field), device.upload(-field))]


@pytest.mark.parametrize("flow", [0.0, 0.6, 1.2, 10.0])
def test_narrowed_coefficients(device: Device, flow: float) -> None:
    """They sum to 1, keep their order and their middle, and are as steep as wanted, not steeper."""
    grid = GRIDS["plane"]
    layers, coefficients, flows = two_layers(device, flow)
    before = coefficients[1].blend.get()
    transition.narrow(device, layers, coefficients, flows, grid, Settings(), ALIKE)
    after = coefficients[1].blend.get()
    assert np.allclose(coefficients[0].blend.get() + after, 1, atol=1e-6)
    assert (np.diff(after, axis=1) >= -1e-6).all()
    assert (np.sign(np.round(after - 0.5, 5)) == np.sign(np.round(before - 0.5, 5))).all()
    steepest = np.diff(after, axis=1).max()
    strongest, wanted = 12 / 57, Settings().transition_strain / max(flow, 1e-9)
    assert steepest == pytest.approx(min(max(1 / 57, wanted), strongest), rel=0.15)
    assert steepest > 0.99 / 57


def test_off_and_without_flow_coefficients_stay(device: Device) -> None:
    grid = GRIDS["plane"]
    layers, coefficients, flows = two_layers(device, 1.0)
    before = [one.blend.get() for one in coefficients]
    transition.narrow(device, layers, coefficients, flows, grid, Settings(transition_strain=0), ALIKE)
    transition.narrow(device, layers, coefficients, [], grid, Settings(), ALIKE)
    for one, blend in zip(coefficients, before, strict=True):
        assert np.array_equal(one.blend.get(), blend)

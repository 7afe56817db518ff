"""Quicker transitions where aligned layers differ in fine detail."""

from __future__ import annotations

import numpy as np
import pytest
from grids import GRIDS, on_device, patches, plane
from pictures import masked, merged, one_device
from reference.ghosts import ghosts_sharpen
from scipy import ndimage
from test_seam_panoramas import CANVASES, halves, off, wall
from tolerances import SUM, assert_close

from hugin_abflow import ghosts
from hugin_abflow.opencl import Device


@pytest.mark.parametrize("name", list(GRIDS))
def test_sharpening_equals_its_twin(device: Device, name: str) -> None:
    """On grids of cells that divide nothing, over poles and borders."""
    grid = GRIDS[name]
    cells = grid.resized(10, 7).border
    box = (5, 0, grid.width - 5, grid.height - 2)
    power = (1 + 4 * patches(2, 10, 7, 0.5, 2)).astype(np.float32)
    field = np.random.default_rng(4).normal(size=(box[3], box[2], 4)).astype(np.float32)
    field[..., 3] = np.where(field[..., 3] > -1, np.exp(20 * np.minimum(field[..., 3], 0)), 0)
    out = device.upload(field)
    device.run(
        "ghosts", "ghosts_sharpen", box[2:], out, box, grid.border, device.upload(power), cells
    )  # fmt: skip
    expected = ghosts_sharpen(field, box, grid.border, power, cells)
    assert_close(out.get(), expected, 100 * SUM)
    assert np.array_equal(out.get()[..., :3], field[..., :3])
    assert ((out.get()[..., 3] == 0) == (field[..., 3] == 0)).all()
    assert (expected[..., 3] < 0.9 * field[..., 3]).any()


@pytest.mark.parametrize("wraps", [False, True])
def test_where_layers_agree_nothing_changes(wraps: bool) -> None:
    """Nor beside what one layer has whole; else up to two cells around."""
    fine = np.full((9, 12), 0.01)
    assert (ghosts.powers(fine, None, wraps) == 1).all()
    fine[4, 0] = 0.2
    found = ghosts.powers(fine, None, wraps)
    assert found[4, 0] == pytest.approx(3)
    assert found.max() <= 3
    assert (found[2:7, :3] > 1).all()
    assert (found[:, 3:10] == 1).all()
    assert (found[2:7, -2:] > 1).all() == wraps
    whole = np.zeros(fine.shape, bool)
    whole[4, 0] = True
    assert (ghosts.powers(fine, whole, wraps)[3:6, :2] == 1).all()


def test_weights_that_are_equal_stay_so(device: Device) -> None:
    """The middle of a transition is where it was; beside it less is seen of the other layer."""
    grid = plane(96, 16)
    cells = grid.resized(12, 2)
    across = np.tile(np.linspace(-4, 4, 96), (16, 1))
    layers, fields = [], []
    for side in (across, -across):
        pixels, field = (np.ones((16, 96, 4), np.float32) for _ in range(2))
        field[..., 3] = np.exp(np.minimum(side, 0))
        layers.append(on_device(device, pixels))
        fields.append(device.upload(field))
    ghosts.sharpen(device, layers, fields, np.full((2, 12), 0.1), None, grid, cells)
    first, second = (field.get()[8, :, 3].astype(np.float64) for field in fields)
    share = first / (first + second)
    assert np.allclose(share, 1 / (1 + np.exp(-3 * across[8])), atol=1e-4)


@pytest.mark.usefixtures(one_device.__name__)
def test_a_panorama_hardly_mixes_what_differs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Speckle of which each layer shows another one, as bright, in the middle of what both show."""
    canvas, middle, _ = CANVASES["plane"]
    random = np.random.default_rng(5)
    part = np.s_[60:140, middle - 40 : middle + 40]
    layers, shown = [], []
    for mask in halves(canvas, middle):
        picture = wall(canvas)
        speckle = ndimage.gaussian_filter(random.normal(size=picture.shape[:2]), 1)[part]
        speckle *= 40 / speckle.std()
        picture[part][..., :3] = (picture[part][..., :3] + speckle[..., None]).clip(0, 255)
        layers.append(masked(picture, mask))
        shown.append(picture)

    def mixed() -> float:
        result = merged(layers, canvas, exposure=False)
        return float((np.minimum(*(off(result, one)[part] for one in shown)) > 8).mean())

    quick = mixed()
    monkeypatch.setattr(ghosts, "sharpen", lambda *_: None)
    slow = mixed()
    assert quick < 0.7 * slow

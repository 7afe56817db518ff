"""What repeats is matched as a whole: bars whose lower part is matched with others than the upper one."""

from __future__ import annotations

import numpy as np
import pytest
from pictures import merged, one_device
from scipy import ndimage

from hugin_abflow import flow, fusion, repeats
from hugin_abflow.decision import Candidate
from hugin_abflow.fusion import Problem
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.opencl import Device
from hugin_abflow.pyramid import Level

Array = np.ndarray

pytestmark = pytest.mark.usefixtures(one_device.__name__)

HEIGHT, WIDTH = 160, 200
PERIOD, SHIFT = 16, 14
PARAMETERS = flow.FlowParameters()


def noise(seed: int, width: int = WIDTH) -> Array:
    """Texture, of log brightness."""
    made = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=(HEIGHT, width)), 1.2)
    return (0.15 * made / made.std()).astype(np.float32)


def railing(first: int) -> Array:
    """Bars from column `first` of the scene on, log brightness, before a lawn that does not move."""
    columns = np.arange(WIDTH) + first
    bar = np.abs(columns % PERIOD - PERIOD / 2) < 2
    return np.where(bar, np.float32(-1.2), noise(1))


def levels(device: Device, *images: Array, wraps: bool = False) -> list[Level]:
    mask = np.ones((HEIGHT, WIDTH), np.float32)
    return [Level(device.upload(one.astype(np.float32)), device.upload(mask), wraps) for one in images]


def matched(shift: float | Array) -> Array:
    """Flow both ways that leads so far to the left, and back, (2, HEIGHT, WIDTH, 2)."""
    flows = np.zeros((2, HEIGHT, WIDTH, 2), np.float32)
    flows[0, ..., 0], flows[1, ..., 0] = -np.broadcast_to(shift, (2, HEIGHT, WIDTH))[0], shift
    return flows


def mended(device: Device, images: list[Level], flows: Array) -> Array | None:
    """None: nothing was mended."""
    given = device.upload(flows[0]), device.upload(flows[1])
    got = repeats.mend(device, images, given, PARAMETERS)
    return None if got is given else np.stack([one.get() for one in got])


TORN = np.where(np.arange(HEIGHT)[:, None] < HEIGHT // 2, SHIFT - PERIOD, SHIFT)


def test_bars_are_matched_as_a_whole(device: Device) -> None:
    """They are 2 px to the right in the upper half, 14 to the left in the lower one: both lead back."""
    images = levels(device, railing(0), railing(SHIFT))
    got = mended(device, images, matched(TORN))
    assert got is not None
    inside = got[0, 8:-8, 40:-40, 0]
    bars = railing(0)[8:-8, 40:-40] < -1
    middle = np.median(inside[bars])
    assert min(abs(middle + SHIFT), abs(middle - PERIOD + SHIFT)) < 0.5
    assert np.mean(np.abs(inside[bars] - middle) < 2) > 0.98
    assert np.mean(np.abs(got[1, 8:-8, 40:-40, 0] + middle) < 3) > 0.9


def test_what_is_not_torn_or_wraps_stays(device: Device) -> None:
    bars = railing(0), railing(SHIFT)
    assert mended(device, levels(device, *bars), matched(SHIFT)) is None
    assert mended(device, levels(device, *bars, wraps=True), matched(TORN)) is None


def test_structure_is_measured_only_where_flow_has_parts(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured, measure = [], fusion.structure
    monkeypatch.setattr(fusion, "structure", lambda features: measured.append(1) or measure(features))
    images = levels(device, railing(0), railing(SHIFT))
    mended(device, images, matched(SHIFT))
    assert not measured
    mended(device, images, matched(TORN))
    assert len(measured) == 1


def test_what_moves_otherwise_and_does_not_repeat_stays(device: Device) -> None:
    """The lower half is of something near: flow jumps at its outline, and what is beside that is torn by no
    flow of the images."""
    far, near = noise(2), noise(3, WIDTH + SHIFT)
    images = [far.copy(), far.copy()]
    images[0][HEIGHT // 2 :] = near[HEIGHT // 2 :, :WIDTH]
    images[1][HEIGHT // 2 :] = near[HEIGHT // 2 :, SHIFT:]
    shift = np.where(np.arange(HEIGHT)[:, None] < HEIGHT // 2, 0, SHIFT)
    assert mended(device, levels(device, *images), matched(shift)) is None


def test_no_cells_have_less_energy() -> None:
    """All sets of cells are tried, of two images of two rows of two cells."""
    exact = changed = 0
    for seed in range(60):
        random = np.random.default_rng(seed)
        features = random.normal(0, 0.02, (2, 8, 8, 4)).astype(np.float32)
        features[..., 3] = 1
        candidates = []
        for shift in (0, 4):
            flows = random.normal(0, 1.5, (2, 2, 2, 2)).astype(np.float32)
            flows[0, ..., 0], flows[1, ..., 0] = flows[0, ..., 0] + shift, flows[1, ..., 0] - shift
            candidates.append(Candidate(flows, 0.2 * random.random((2, 2, 2)).astype(np.float32)))
        known = np.ones((2, 2, 2), bool)
        problem = Problem.of(fusion.structure(features), *candidates, known)
        if problem.terms()[3].min() < 0:
            continue  # a cut is no more than nearly the best
        sets = (np.arange(256)[:, None] >> np.arange(8)) & 1 == 1
        best = min(problem.energy(one) for one in sets)
        taken = problem.least(known.ravel())
        assert problem.energy(taken) == pytest.approx(best, abs=0.05)
        exact += 1
        changed += 0 < taken.sum() < 8
    assert exact >= 5
    assert changed


def bars_at(pixels: Array, row: int) -> Array:
    """Columns of the middles of bars in a row."""
    numbers, count = ndimage.label(pixels[row, :, 0] < 50)
    return np.array(ndimage.center_of_mass(np.ones(numbers.shape), numbers, range(1, count + 1))).ravel()


def test_bars_of_a_panorama_are_straight() -> None:
    """Bars shift by 15 px and are 18 px apart; the lawn behind them shifts by as much at their lower end."""
    canvas = Canvas.plane(900, 500)
    rows = np.arange(500)[:, None]
    nearness = np.clip((rows - 210) / 290 * 22, 1, None)
    grain = ndimage.gaussian_filter(np.random.default_rng(5).normal(size=(500, 1400)), (1.5, 1))
    grain = np.clip(110 * (1 + 0.3 * grain / grain.std()), 80, 250)

    def photo(name: str, first: int, last: int, seen: int) -> Layer:
        columns = np.broadcast_to(np.arange(first, last), (500, last - first)).astype(float)
        places = [np.broadcast_to(rows, columns.shape), columns + 200 + seen * nearness]
        behind = np.where(rows < 210, 200, ndimage.map_coordinates(grain, places, order=1))
        bar = (np.abs((columns + 15 * seen) % 18 - 9) < 1.75) & (rows > 190) & (rows < 380)
        rails = (np.abs(rows - 190) < 3) | (np.abs(rows - 380) < 2)
        pixels = np.repeat(np.where(bar | rails, 30, behind)[..., None], 4, 2)
        pixels[..., 3] = 255
        return Layer.from_array(name, np.rint(pixels).astype(np.uint8), first)

    pixels = merged([photo("a", 0, 575, 0), photo("b", 325, 900, 1)], canvas)
    counts = []
    for row in range(205, 365, 5):
        here, below = bars_at(pixels, row), bars_at(pixels, row + 5)
        counts.append(len(here))
        assert np.abs(here[:, None] - below).min(1).max() < 2.5
    assert np.ptp(counts) == 0

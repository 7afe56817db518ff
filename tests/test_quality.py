"""--flow-quality: how much work the flow is, and on how many pixels."""

from __future__ import annotations

import math
from contextlib import contextmanager
from typing import get_args

import numpy as np
import pytest
from scipy import ndimage

from hugin_abflow import flow, joint, quality
from hugin_abflow.grid import full_grid, working_grid
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.opencl import Device, DeviceMemoryError
from hugin_abflow.progress import silent
from hugin_abflow.settings import FlowQuality, Settings

QUALITIES = get_args(FlowQuality)
LARGE = Canvas.sphere(9000, 4500)


def layers(canvas: Canvas) -> list[Layer]:
    """Two halves that overlap and differ, without pixels: only their places count."""
    pixels = np.zeros((1, 1, 4), np.uint8)
    return [Layer.from_array("a", pixels), Layer.from_array("b", pixels, canvas.width - 1, canvas.height - 1)]


def test_normal_is_what_the_solver_does_by_itself() -> None:
    assert Settings().flow_quality == "normal"
    assert Settings().large_motion == "auto"
    assert quality.flow_parameters("normal", "auto") == flow.FlowParameters()


def test_quality_chooses_the_working_canvas() -> None:
    full = full_grid(LARGE, layers(LARGE))
    sizes = []
    for name in QUALITIES:
        settings = Settings(flow_quality=name)
        grid = working_grid(full, settings)
        sizes.append(grid.width * grid.height)
        assert 0.98 * settings.working_limit < sizes[-1] < 1.02 * settings.working_limit
    fast, normal, best = sizes
    assert fast < normal / 3 and 2 * normal < best <= 3.02 * normal


def test_flow_is_solved_on_every_second_pixel_where_many_are_left() -> None:
    """Never on few pixels; then it is refined on all, if there are few of them, or for "best"."""
    assert quality.coarseness("normal", 2_100_000) == quality.coarseness("fast", 500_000) == 2
    assert quality.coarseness("normal", 1_500_000) == quality.coarseness("fast", 300_000) == 1
    assert quality.coarseness("best", 6_300_000) == 2
    assert quality.coarseness("best", 1_500_000) == 1
    assert quality.refined("normal", 2_100_000, 1_000_000) and not quality.refined("fast", 500_000, 1)
    assert not quality.refined("normal", 2_100_000, 1_100_000)
    assert quality.refined("best", 6_300_000, 60_000_000) and not quality.refined("best", 6_300_000, 0)


@pytest.mark.parametrize("name", QUALITIES)
def test_working_pixels_outrank_the_quality(name: FlowQuality) -> None:
    assert Settings(flow_quality=name, working_pixels=5000).working_limit == 5000


def pair(canvas: Canvas) -> list[Layer]:
    """Two textured layers of the whole canvas but for a rim each, one moved by 2 px."""
    noise = np.random.default_rng(1).normal(size=(canvas.height, canvas.width + 2))
    grey = ndimage.gaussian_filter(noise, 2)
    grey = np.rint(120 + 100 * grey / np.abs(grey).max()).astype(np.uint8)
    result = []
    for name, left, shift in (("a", 0, 0), ("b", 9, 2)):
        cut = grey[:, left + shift : left + shift + canvas.width - 9]
        pixels = np.repeat(cut[..., None], 4, 2)
        pixels[..., 3] = 255
        result.append(Layer.from_array(name, pixels, left))
    return result


def test_fast_is_less_than_half_the_work(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pixels that the flow's kernels run over: on one working canvas, times the sizes of each quality's."""
    done = dict.fromkeys(QUALITIES, 0)
    run, repeat = device.run, device.repeat

    def counting_run(module, name, size, *arguments, **options):
        done[now] += math.prod(size) * (module == "flow")
        run(module, name, size, *arguments, **options)

    def counting_repeat(module, name, size, calls, times, *rest):
        done[now] += math.prod(size) * len(calls) * times
        repeat(module, name, size, calls, times, *rest)

    monkeypatch.setattr(device, "run", counting_run)
    monkeypatch.setattr(device, "repeat", counting_repeat)
    canvas = Canvas.plane(157, 131)
    for now in QUALITIES:
        joint.prepare(device, pair(canvas), canvas, Settings(flow_quality=now), silent)
    assert 0 < done["fast"] < done["normal"] <= done["best"]
    work = {}
    for name in QUALITIES:
        pixels = Settings(flow_quality=name).working_limit
        work[name] = done[name] * pixels / quality.coarseness(name, pixels) ** 2
    assert work["fast"] < 0.5 * work["normal"]
    assert work["best"] <= 12 * work["normal"]


def test_time_of_the_flow_is_told_as_the_flows(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """When its phase ends nothing of it is still to be done; kernels are queued, not awaited."""
    happened = []

    @contextmanager
    def progress(phase, total):
        yield lambda units: None
        happened.append(f"end of {phase}")

    finish, repeat = device.finish, device.repeat
    monkeypatch.setattr(device, "finish", lambda: (happened.append("finish"), finish())[1])
    monkeypatch.setattr(device, "repeat", lambda *a: (happened.append("flow"), repeat(*a))[1])
    canvas = Canvas.plane(157, 131)
    joint.prepare(device, pair(canvas), canvas, Settings(), progress)
    end = happened.index("end of flow")
    assert "flow" in happened[:end] and happened[end - 1] == "finish"


@pytest.mark.parametrize("threads", [1, 2])
def test_working_resolution_falls_from_what_the_quality_chose(
    device: Device, monkeypatch: pytest.MonkeyPatch, threads: int
) -> None:
    """Where the device's memory is too small for it, also with one pair of layers at a time."""
    asked = []

    class EnoughSeenError(Exception):
        pass

    def prepare(device, layers, canvas, settings, *more):
        asked.append(settings.working_limit)
        raise DeviceMemoryError("too small") if len(asked) < 2 + threads else EnoughSeenError

    monkeypatch.setattr(joint, "prepare", prepare)
    with pytest.raises(EnoughSeenError):
        settings = Settings(flow_quality="best", threads=threads)
        next(joint.merge(device, layers(LARGE), LARGE, settings, silent))
    limit = settings.working_limit
    assert asked == [*[limit] * threads, limit // 2, limit // 4]

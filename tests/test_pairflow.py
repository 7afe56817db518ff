"""Flow of all pairs: charts of half the working resolution, and flow refined on those of all of it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from pictures import merged, one_device
from scipy import ndimage

from hugin_abflow import (
    budget,
    chart,
    consistency,
    flow,
    guidance,
    joint,
    opencl,
    pairflow,
    quality,
    relay,
    single,
)
from hugin_abflow.cells import SingleSource
from hugin_abflow.grid import Grid, full_grid
from hugin_abflow.guides import Guide
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.merge import merge_layers
from hugin_abflow.opencl import Device, DeviceMemoryError
from hugin_abflow.progress import silent
from hugin_abflow.settings import FlowQuality, Settings

CANVAS = Canvas.plane(301, 151)

pytestmark = pytest.mark.usefixtures(one_device.__name__)


def layers(shared: int) -> list[Layer]:
    """Two that share so many columns, in which what the second one shows is moved by 3 px."""
    noise = np.random.default_rng(3).normal(size=(CANVAS.height, CANVAS.width + 3))
    grey = ndimage.gaussian_filter(noise, 1.5)
    grey = np.rint(128 + 90 * grey / np.abs(grey).max()).astype(np.uint8)
    middle, result = CANVAS.width // 2, []
    for name, first, end, by in (("a", 0, middle + shared // 2, 3), ("b", middle - shared // 2, 301, 0)):
        pixels = np.repeat(grey[:, first + by : end + by, None], 4, 2)
        pixels[..., 3] = 255
        result.append(Layer.from_array(name, pixels, first))
    return result


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Canvases as small as ours are large enough for coarse charts."""
    monkeypatch.setattr(quality, "_LEAST_PIXELS", dict.fromkeys(quality._LEAST_PIXELS, 10_000))


@pytest.fixture
def weighed(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """What `consistency.weigh` is given, and what it gives."""
    given, weigh = list[tuple[Any, ...]](), consistency.weigh

    def spy(device: Any, pair: Any, images: Any, parameters: Any, whole: Any) -> Any:
        given.append((pair, images, whole, weigh(device, pair, images, parameters, whole)))
        return given[-1][3]

    monkeypatch.setattr(consistency, "weigh", spy)
    return given


@pytest.mark.usefixtures(small.__name__)
@pytest.mark.parametrize(
    ("name", "shared", "fine"),
    [("normal", 31, True), ("normal", 201, False), ("best", 201, True), ("fast", 61, False)],
)
def test_flow_is_refined_where_overlaps_are_small(
    weighed: list[tuple[Any, ...]], name: FlowQuality, shared: int, fine: bool
) -> None:
    """Else it stays on charts of half the resolution. It is told in px of its chart."""
    merged(layers(shared), CANVAS, flow_quality=name, working_pixels=CANVAS.width * CANVAS.height)
    ((pair, images, _, _),) = weighed
    assert pair.chart.coarse == (1 if fine else 2)
    assert pair.forward.shape[:2] == images[0].image.shape == (pair.chart.height, pair.chart.width)
    both = ndimage.binary_erosion(images[0].mask.get() * images[1].mask.get() > 0, iterations=5)
    length = np.median(np.linalg.norm(pair.forward.get(), axis=-1)[both]) * pair.chart.coarse
    assert both.sum() > 100 and length == pytest.approx(3, abs=0.1 if fine else 0.5)


@pytest.mark.parametrize("coarse", [True, False])
def test_motion_of_a_tenth_of_the_canvas_is_searched(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, coarse: bool
) -> None:
    """In px of the chart."""
    if coarse:
        request.getfixturevalue(small.__name__)
    asked, solve = [], flow.solve
    monkeypatch.setattr(
        flow, "solve", lambda *given, **more: asked.append(more["reach"]) or solve(*given, **more)
    )
    merged(layers(61), CANVAS, working_pixels=CANVAS.width * CANVAS.height)
    assert asked == [pytest.approx(CANVAS.width / (20 if coarse else 10), rel=0.01)]


def _three() -> list[Layer]:
    """Of which each two overlap, and differ."""
    rng = np.random.default_rng(5)
    pixels = [rng.integers(0, 256, (151, width, 4), np.uint8) for width in (200, 170, 151)]
    for picture in pixels:
        picture[..., 3] = 255
    return [
        Layer.from_array(name, picture, left)
        for name, picture, left in zip("abc", pixels, (0, 60, 150), strict=True)
    ]


@pytest.fixture
def lanes(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many pairs are worked on at a time, each time."""
    seen, side_by_side = list[int](), pairflow.side_by_side

    def spy(device: Device, work: Any, lanes: int) -> Any:
        seen.append(lanes)
        return side_by_side(device, work, lanes)

    monkeypatch.setattr(pairflow, "side_by_side", spy)
    return seen


@pytest.mark.parametrize(
    ("limit", "threads", "most"), [("roomy", 2, 2), ("roomy", 1, 1), ("tight", 2, 1), ("too low", 2, 1)]
)
def test_two_pairs_are_worked_on_at_a_time_where_memory_suffices(
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    lanes: list[int],
    limit: str,
    threads: int,
    most: int,
) -> None:
    """They are the largest two that are reckoned with; nobody is refused for want of memory for two."""
    monkeypatch.setattr(budget.memory, "resident", lambda: 0)
    monkeypatch.setattr(Device, "own_memory", 0)  # a graphics card's counts besides
    monkeypatch.setattr(budget, "_SOLVER_BYTES", 20_000)
    sizes, draw = list[int](), pairflow.charts

    def spy_charts(*given: Any) -> list[chart.Chart]:
        charts = draw(*given)
        sizes[:] = [one.width * one.height for one in charts]
        return charts

    monkeypatch.setattr(pairflow, "charts", spy_charts)
    expected = merged(_three(), CANVAS, threads=1)
    assert max(sizes) == sizes[0] and len(sizes) == 3
    one, two = 20_000 * sizes[0], 20_000 * (sizes[0] + max(sizes[1:]))
    bytes_ = {"roomy": 2 * two, "tight": (one + two) // 2, "too low": one // 2}[limit]
    lanes.clear()
    if limit == "too low":  # not given by the user, so it goes on
        monkeypatch.setattr(budget.memory, "limit", lambda given: bytes_)
    with caplog.at_level("INFO", "hugin_abflow.budget"):
        given = 0 if limit == "too low" else bytes_
        found = merged(_three(), CANVAS, threads=threads, max_memory=given)
    assert np.array_equal(found, expected)
    assert lanes == [most, most]
    (said,) = (record.args[0] for record in caplog.records if "at working resolution" in record.msg)
    reckoned = float(str(said).split()[0]) * (1 << 20)
    assert reckoned == pytest.approx(two if most == 2 else one, rel=0.2)


@pytest.mark.parametrize("lacks", ["memory for two", "a second queue"])
def test_one_pair_at_a_time_where_the_device_lacks(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, lanes: list[int], lacks: str
) -> None:
    """What fits for one has to be the same as ever, and nothing to warn of."""
    device = Device()

    def merge() -> Any:
        settings = Settings(threads=2)
        return list(joint.merge(device, _three(), CANVAS, settings, silent))

    expected, solve = merge(), flow.solve
    lanes.clear()

    def limited(device: Device, *given: Any, **more: Any) -> Any:
        if lacks == "memory for two" and device.current is not device._first:
            raise DeviceMemoryError("for one there is enough")
        return solve(device, *given, **more)

    def no_queue(*_: Any) -> Any:
        raise DeviceMemoryError("too many")

    monkeypatch.setattr(flow, "solve", limited)
    if lacks == "a second queue":
        device._free.clear()
        monkeypatch.setattr(opencl, "Lane", no_queue)
    assert np.array_equal(np.concatenate(merge()), np.concatenate(expected))
    assert lanes == [2, 1, 1] and not caplog.records


def test_nothing_goes_on_when_the_run_is_interrupted(device: Device) -> None:
    """Though what interrupted it is still looked at."""

    @contextmanager
    def progress(name: str, total: int) -> Iterator[Any]:
        def interrupt(count: int) -> None:
            if name == "flow":
                raise KeyboardInterrupt

        yield interrupt

    with pytest.raises(KeyboardInterrupt) as told:
        list(joint.merge(device, _three(), CANVAS, Settings(threads=2), progress))
    assert told.value and not [one for one in threading.enumerate() if one.name.startswith("lane")]


@pytest.mark.usefixtures(small.__name__)
def test_what_is_taken_whole_is_told_on_the_chart_that_its_flow_has(
    weighed: list[tuple[Any, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is looked for on the coarse one."""
    seen, places = [], []

    def find(its_chart: chart.Chart, *_: Any) -> SingleSource:
        first = np.zeros((its_chart.height // 4, its_chart.width // 4), bool)
        first[5:8, 3:6] = True
        seen.append((its_chart, SingleSource(first, ~first)))
        return seen[-1][1]

    def on_canvas(found: list[SingleSource], charts: list[chart.Chart], cells: Grid) -> None:
        places.append([one.on_canvas(its_chart, cells) for one, its_chart in zip(found, charts, strict=True)])

    monkeypatch.setattr(single, "find", find)
    monkeypatch.setattr(single, "on_canvas", on_canvas)
    merged(layers(31), CANVAS, working_pixels=CANVAS.width * CANVAS.height)
    ((coarse, found),), ((pair, _, whole, _),) = seen, weighed
    assert (coarse.coarse, pair.chart.coarse) == (2, 1)
    assert np.array_equal(whole.first, np.kron(found.first, np.ones((2, 2), bool)))
    grid = full_grid(CANVAS, layers(31))
    cells = grid.resized(75, 37)
    assert np.array_equal(whole.on_canvas(pair.chart, cells), found.on_canvas(coarse, cells))
    assert len(places) == 1


@pytest.mark.usefixtures(small.__name__)
def test_what_is_small_is_told_by_the_pixels_of_all_charts() -> None:
    """Not of the overlaps: around what is thin and lies askew a chart is large."""
    grid = full_grid(CANVAS, layers(31))
    columns, rows = np.arange(grid.width), np.arange(grid.height)[:, None]
    upright, askew = (np.abs(columns - 2 * slope * rows - 5) < 5 for slope in (0, 1))
    upright = np.broadcast_to(upright, grid.shape)
    for overlaps, fine in (([upright], True), ([askew], False), ([upright] * 4, False), ([], False)):
        drawn = pairflow.charts(overlaps, grid, grid, Settings())
        ends = [one.coarse for one in pairflow.finest(drawn, grid, Settings())]
        assert [one.coarse for one in drawn] == [2] * len(overlaps)
        assert ends == [1 if fine else 2] * len(overlaps)


@pytest.mark.parametrize("wanted", [True, False])
def test_flow_is_compared_with_that_of_other_pairs(monkeypatch: pytest.MonkeyPatch, wanted: bool) -> None:
    """Before it is filled, and where three layers overlap alone."""
    asked, filled = list[list[tuple[int, int]]](), list[int]()
    monkeypatch.setattr(
        relay, "mend", lambda device, found, *_: asked.append([(one.a, one.b) for one in found]) or []
    )
    fill = consistency.fill
    monkeypatch.setattr(consistency, "fill", lambda *given: filled.append(len(asked)) or fill(*given))
    two = layers(31)
    merged(two, CANVAS, relay=wanted)
    assert asked == [] and filled == [0]
    pixels = np.ascontiguousarray(two[0].read(0, CANVAS.height)[:, 60:])
    merged([*two, Layer.from_array("c", pixels, 61)], CANVAS, relay=wanted)
    assert asked == ([[(0, 1), (0, 2), (1, 2)]] if wanted else [])
    assert filled[1:] == [int(wanted)] * 3


@pytest.mark.usefixtures(small.__name__)
def test_control_points_hold_flow_on_the_chart_that_it_has(
    weighed: list[tuple[Any, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both ways, where flow agrees with them when they have led it; before other pairs are asked."""
    told, led = list[dict[tuple[int, int], np.ndarray]](), list[object]()
    lead, held = guidance.lead, guidance.held
    monkeypatch.setattr(guidance, "lead", lambda *given: led.append(lead(*given)) or led[-1])
    monkeypatch.setattr(guidance, "held", lambda *given: led.append(given[1]) or held(*given))
    monkeypatch.setattr(relay, "triangles", lambda pairs: True)
    monkeypatch.setattr(relay, "mend", lambda device, found, compared, held: told.append(held) or [])
    guides = [Guide(1, 0, (150.5, 70.5), (147.5, 70.5)), Guide(0, 1, (149.5, 30.5), (172.5, 30.5))]
    settings = Settings(working_pixels=CANVAS.width * CANVAS.height)
    merge_layers(layers(31), CANVAS, settings, guides=guides)
    ((pair, _, _, _),), (its,) = weighed, told
    assert led[0] is led[1]
    assert pair.chart.coarse == 1 and set(its) == {(0, 1), (1, 0)}
    grid = full_grid(CANVAS, layers(31))
    ends = pair.chart.positions(grid.points(np.array([(147.5, 70.5), (150.5, 70.5)])))
    for way, (start, end) in (((0, 1), ends), ((1, 0), ends[::-1])):
        assert its[way] == pytest.approx(np.hstack([start, end - start])[None], abs=0.02)

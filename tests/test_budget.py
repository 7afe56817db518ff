"""What the working resolution takes, and what is done where that is too much."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pictures import merged, noise, one_device

from hugin_abflow import budget, quality, seam
from hugin_abflow.budget import Work
from hugin_abflow.errors import SettingsError
from hugin_abflow.grid import Border
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.settings import Settings

CANVAS = Canvas.plane(301, 151)
CELLS = SimpleNamespace(width=100, height=80)
MIB = 1 << 20

pytestmark = pytest.mark.usefixtures(one_device.__name__)


def layers() -> list[Layer]:
    """Two that share 61 columns, in which they differ."""
    return [
        Layer.from_array(name, noise(151, 181, seed=seed), left)
        for name, seed, left in (("a", 1, 0), ("b", 2, 120))
    ]


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Canvases as small as ours are large enough for coarse charts."""
    monkeypatch.setattr(quality, "_LEAST_PIXELS", dict.fromkeys(quality._LEAST_PIXELS, 10_000))


def work(sizes: Sequence[int], cut: int = 0, **settings: Any) -> Work:
    """On charts of so many pixels, which are not refined. cut: how many layers are."""
    charts: Any = [
        SimpleNamespace(width=pixels, height=1, coarse=1, border=Border(pixels, 1, 0)) for pixels in sizes
    ]
    grid: Any = SimpleNamespace(width=1000, height=1000, coarser=lambda by: CELLS)
    return Work(charts, grid, Settings(flow_quality="fast", large_motion="off", **settings), cut, 0.5)


def reckoned(monkeypatch: pytest.MonkeyPatch, its: Work, most: int) -> int:
    """How many pairs at a time there is memory for, beside what is taken already, in a process of nothing."""
    monkeypatch.setattr(budget.memory, "resident", lambda: 0)
    device: Any = SimpleNamespace(own_memory=0)
    layer: Any = SimpleNamespace(box=(0, 0, 100, 100), pixels=np.zeros((100, 100, 4), np.float32))
    return budget.abreast(device, [layer], its, lambda: work([1]), most)


def test_the_larger_of_both_counts() -> None:
    """Flow while it is found, with the largest charts' solvers, or all that is made from it."""
    its = work([100, 300, 200])
    one = budget._FOUND_BYTES * 600 + budget._SOLVER_BYTES * 300
    assert its.bytes(0) == one
    assert its.bytes(0, abreast=2) == one + budget._SOLVER_BYTES * 200
    assert its.bytes(1_000_000) == budget._FLOW_BYTES * 600 + budget._STEP_BYTES * 1_000_000
    assert work([]).bytes(7) == budget._STEP_BYTES * 7


def test_cuts_count_where_layers_are_many() -> None:
    """With the fields that are there already; not where nothing is cut."""
    room = seam.room(work([]).grid, False, 300, 0.5)
    assert room == 300 * 8000 * (seam._CELL_BYTES + seam._SHARED_BYTES / 2)
    assert work([], 300, flow=False).bytes(10_000) == budget._FIELD_BYTES * 10_000 + room
    assert work([], 300, flow=False).bytes(10_000_000) == budget._STEP_BYTES * 10_000_000
    assert work([], 300, flow=False, seam=False).bytes(10_000) == budget._STEP_BYTES * 10_000
    few = work([100]).bytes(0)
    aligned = seam.room(work([]).grid, True, 300, 0.5)
    assert work([100], 300).bytes(0) == max(few, aligned)


def test_a_search_that_takes_more_than_the_solver_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    its, most = work([100, 300, 200]), {100: 90_000, 300: 0, 200: 80_000}
    monkeypatch.setattr(budget.pairflow, "search_room", lambda drawn, *_: most[drawn.width])
    assert its.bytes(0) == budget._FOUND_BYTES * 600 + 90_000
    assert its.bytes(0, abreast=3) == budget._FOUND_BYTES * 600 + 90_000 + 80_000 + budget._SOLVER_BYTES * 300


def test_as_many_pairs_at_a_time_as_the_limit_allows(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = [100_000] * 3
    for pairs in (1, 2, 3):
        needed = budget._LIBRARY_BYTES + work(sizes).bytes(10_000, pairs)
        assert reckoned(monkeypatch, work(sizes, max_memory=needed), 3) == pairs
        assert reckoned(monkeypatch, work(sizes, max_memory=needed), 2) == min(pairs, 2)


def test_a_limit_that_is_too_low_is_refused_if_the_user_gave_it(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with pytest.raises(SettingsError, match=r"too little for these layers, whose flow takes about"):
        reckoned(monkeypatch, work([100_000], max_memory=MIB), 2)
    with pytest.raises(SettingsError, match=r"too little for these layers, which take about"):
        reckoned(monkeypatch, work([], max_memory=MIB, flow=False), 2)
    monkeypatch.setattr(budget.memory, "limit", lambda given: MIB)
    assert reckoned(monkeypatch, work([100_000]), 2) == 1
    assert caplog.messages[-1].endswith("; going on with that")


@pytest.mark.usefixtures(small.__name__)
def test_memory_is_reckoned_for_charts_as_fine_as_they_get(monkeypatch: pytest.MonkeyPatch) -> None:
    """For the solver by the largest of them."""
    reckoned = []
    small_memory: Any = {"large_motion": "off", "working_pixels": 45_451, "max_memory": 1 << 20}
    monkeypatch.setattr(budget.memory, "resident", lambda: 0)
    for name, bytes_ in (("fast", 0), ("fast", 10_000), ("best", 0), ("best", 10_000)):
        monkeypatch.setattr(budget, "_SOLVER_BYTES", bytes_)
        with pytest.raises(SettingsError, match=r"take?s? about \S+ MiB") as told:
            merged(layers(), CANVAS, flow_quality=name, **small_memory)
        reckoned.append(float(str(told.value).split("about ")[1].split()[0]))
        assert "--flow-quality" not in str(told.value)  # a MiB is too little for that, too
    few, fast, same, best = reckoned
    assert 0 <= same - few < 2 and best - same == pytest.approx(4 * (fast - few), abs=8)
    assert fast - few > 20
    monkeypatch.setattr(budget, "_FOUND_BYTES", 10_000)
    with pytest.raises(SettingsError, match=r"take?s? about \S+ MiB") as told:
        merged(layers(), CANVAS, flow_quality="fast", **small_memory)
    assert float(str(told.value).split("about ")[1].split()[0]) > fast


@pytest.mark.usefixtures(small.__name__)
@pytest.mark.parametrize("name", ["normal", "best"])
def test_less_quality_is_advised_where_that_would_do(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Where `fast` itself is not refused."""
    monkeypatch.setattr(budget.memory, "resident", lambda: 0)
    monkeypatch.setattr(budget, "_SOLVER_BYTES", 20_000)
    least = {}
    for one in ("fast", name):
        with pytest.raises(SettingsError, match="about") as told:
            merged(layers(), CANVAS, flow_quality=one, working_pixels=45_451, max_memory=1 << 20)
        least[one] = float(str(told.value).split("about ")[1].split()[0])
    assert least[name] > 1.2 * least["fast"]
    for share, advised in ((0.9, False), (1.1, True)):
        limit = int(share * least["fast"] * (1 << 20))
        with pytest.raises(SettingsError, match=r"give \d+\w") as told:
            merged(layers(), CANVAS, flow_quality=name, working_pixels=45_451, max_memory=limit)
        assert str(told.value).endswith(", or choose --flow-quality fast") == advised
    assert merged(layers(), CANVAS, flow_quality="fast", working_pixels=45_451, max_memory=limit).any()

"""Small overlaps whose flow need not be found, as others show them in much larger ones."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import combinations, permutations

import numpy as np
import pytest
from grids import plane, sphere, whole_chart
from hypothesis import given
from hypothesis import strategies as st
from pictures import one_device
from scipy import ndimage

from hugin_abflow import consistency, flow, guidance, quality, relay
from hugin_abflow.figures import parallax
from hugin_abflow.geometry import Pair, PairFlow
from hugin_abflow.grid import Grid
from hugin_abflow.guides import Guide
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.merge import merge_layers
from hugin_abflow.opencl import Device
from hugin_abflow.pyramid import Level
from hugin_abflow.settings import Settings

Spans = Sequence[tuple[int, int]]


def chosen(spans: Spans, grid: Grid, pairs: Sequence[tuple[int, int]] | None = None) -> set[tuple[int, int]]:
    """Which pairs are relayed, the smaller layer first, of layers that cover columns from first to end."""
    columns = np.indices(grid.shape)[1]
    shown = [(columns >= first) & (columns < end) for first, end in spans]
    pairs = [p for p in pairs or combinations(range(len(spans)), 2) if (shown[p[0]] & shown[p[1]]).any()]
    overlaps = [shown[a] & shown[b] for a, b in pairs]
    found = relay.inferable([Pair(*pair) for pair in pairs], overlaps, grid)
    return {(min(pair), max(pair)) for pair, its in zip(pairs, found, strict=True) if its}


@pytest.mark.parametrize(
    ("spans", "expected"),
    [
        ([(0, 60), (20, 90), (50, 130)], {(0, 2)}),  # 10 columns of 40 and 40
        ([(0, 60), (20, 90), (47, 130)], {(0, 2)}),  # 13
        ([(0, 60), (20, 90), (46, 130)], set()),  # 14: the larger ones are not three times as large
        ([(0, 60), (20, 60), (50, 130)], set()),  # the second shows no more of the third than the first
        ([(0, 60), (90, 120), (50, 130)], set()),  # nobody sees it
        ([(0, 60), (50, 130)], set()),
        ([(0, 63), (0, 64), (20, 151), (60, 151)], {(0, 3), (1, 3)}),
        ([(0, 60), (0, 14), (10, 151), (48, 151)], {(0, 3), (1, 2)}),
    ],
)
def test_small_overlaps_in_the_middle_of_others_are_relayed(
    spans: Spans, expected: set[tuple[int, int]]
) -> None:
    assert chosen(spans, plane(151, 17)) == expected


def test_others_have_to_show_all_of_it() -> None:
    """Several may do so together; a twentieth may be missing."""
    grid = plane(200, 100)
    rows, columns = np.indices(grid.shape)
    first, last = columns < 110, columns >= 90
    for below, expected in ((50, False), (94, False), (96, True), (100, True)):
        middle = rows < below
        shown = [first, last, middle]
        pairs = [(0, 1), (0, 2), (1, 2)]
        found = relay.inferable([Pair(*p) for p in pairs], [shown[a] & shown[b] for a, b in pairs], grid)
        assert found == [expected, False, False], below
    shown += [rows >= 40, rows < 60]
    pairs = [(0, 1), (0, 3), (1, 3), (0, 4), (1, 4)]
    found = relay.inferable([Pair(*p) for p in pairs], [shown[a] & shown[b] for a, b in pairs], grid)
    assert found == [True, False, False, False, False]


def test_what_is_relayed_stands_for_nothing_else() -> None:
    """Where two layers agree, as the third and the fourth here, they are no pair."""
    masks = np.zeros((5, 1, 120), bool)
    for index, spans in enumerate((
        [(0, 12)],  # of 0 and 1, relayed by 3
        [(0, 3)],  # of 0 and 2, for which only 1 could stand
        [(0, 3), (100, 109)],  # of 1 and 2
        [(0, 40)],  # of 0 and 3
        [(0, 12), (60, 88)],  # of 1 and 3
    )):  # fmt: skip
        for first, end in spans:
            masks[index, 0, first:end] = True
    pairs = [Pair(*pair) for pair in ((0, 1), (0, 2), (1, 2), (0, 3), (1, 3))]
    assert relay.inferable(pairs, masks, plane(120, 1)) == [True, False, False, False, False]
    del pairs[3:]
    assert relay.inferable(pairs, masks[:3], plane(120, 1)) == [False, True, False]


def test_at_a_pole_a_row_is_small() -> None:
    """As seen there, an overlap is larger beside one that reaches less far down than its pixels tell."""
    grid = sphere(78, 39)
    rows, columns = np.indices(grid.shape)
    cap, wider = rows < 5, rows < 9
    overlaps = [cap, wider, wider]
    pairs = [Pair(0, 1), Pair(0, 2), Pair(1, 2)]
    assert 3 * np.count_nonzero(cap) > np.count_nonzero(wider)
    assert relay.inferable(pairs, overlaps, grid) == [True, False, False]
    half = wider & (columns < 39)  # the third shows half of the cap with each of both, or all with one
    assert relay.inferable(pairs, [cap, half, half], grid) == [False, False, False]
    assert relay.inferable(pairs, [cap, half, wider], grid) == [False, False, False]


@given(st.lists(st.tuples(st.integers(0, 100), st.integers(5, 90)), min_size=3, max_size=7), st.randoms())
def test_what_is_relayed_lies_in_much_larger_overlaps_that_are_found(
    spans: list[tuple[int, int]], random: object
) -> None:
    """However pairs are ordered, and whichever layer of one is named first."""
    spans = [(first, first + width) for first, width in spans]
    grid = plane(200, 3)
    found = chosen(spans, grid)
    pairs = [pair if random.random() < 0.5 else pair[::-1] for pair in combinations(range(len(spans)), 2)]
    random.shuffle(pairs)
    assert chosen(spans, grid, pairs) == found

    def shared(*layers: int) -> set[int]:
        return set.intersection(*(set(range(*spans[k])) for k in layers))

    for a, c in found:
        legs = [
            b
            for b in set(range(len(spans))) - {a, c}
            if min(len(shared(a, b)), len(shared(b, c))) >= 3 * len(shared(a, c))
            and not {tuple(sorted((a, b))), tuple(sorted((b, c)))} & found
        ]
        seen = set().union(*(shared(a, b, c) for b in legs))
        assert len(seen) >= 0.95 * len(shared(a, c))


@pytest.mark.parametrize(
    ("pairs", "expected"),
    [
        ([], False),
        ([(0, 1)], False),
        ([(0, 1), (1, 2)], False),
        ([(0, 1), (1, 2), (2, 3), (0, 3)], False),
        ([(0, 1), (0, 2), (1, 2)], True),
        ([(0, 2), (1, 2), (2, 3), (1, 3)], True),
    ],
)
def test_three_layers_each_two_of_which_overlap(pairs: Iterable[tuple[int, int]], expected: bool) -> None:
    assert relay.triangles([Pair(*pair) for pair in pairs]) == expected


# Merges of three layers that are moved against each other.

CANVAS = Canvas.plane(301, 151)
SHIFTS = (3, 0, -2)
EDGES = ((0, 162), (25, 285), (138, 301))  # 24 columns of 137 and 147


def layers(changed: slice | None = None) -> list[Layer]:
    """The middle one may show something else in some columns."""
    noise = np.random.default_rng(3).normal(size=(2, CANVAS.height, CANVAS.width + 10))
    grey = ndimage.gaussian_filter(noise, (0, 1.5, 1.5))
    grey = np.rint(128 + 90 * grey / np.abs(grey).max()).astype(np.uint8)
    result = []
    for name, (first, end), by in zip("abc", EDGES, SHIFTS, strict=True):
        shown = grey[0, :, 5 + by : 306 + by].copy()
        if name == "b" and changed:
            shown[:, changed] = grey[1, :, changed]
        pixels = np.repeat(shown[:, first:end, None], 4, 2)
        pixels[..., 3] = 255
        result.append(Layer.from_array(name, pixels, first))
    return result


@pytest.fixture
def found(monkeypatch: pytest.MonkeyPatch) -> list[PairFlow]:
    """The flows of all pairs, mended."""
    seen, mend = list[PairFlow](), consistency.fill
    monkeypatch.setattr(consistency, "fill", lambda *given: seen.append(mend(*given)) or seen[-1])
    return seen


@pytest.fixture
def solved(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The widths of the grids on which flow is found."""
    seen, solve = list[int](), flow.solve
    monkeypatch.setattr(
        flow,
        "solve",
        lambda device, a, *given, **more: seen.append(a.grid[0]) or solve(device, a, *given, **more),
    )
    return seen


def median_way(found: Sequence[PairFlow]) -> float:
    """How far the flow of the first and the last layer leads to the right, in the middle of their overlap."""
    (one,) = (one for one in found if (one.a, one.b) == (0, 2))
    left = round(-float(one.chart.transform[11]))
    return float(np.median(one.forward.get()[20:-20, 142 - left : 158 - left, 0]))


pytestmark = pytest.mark.usefixtures(one_device.__name__)
THREADS = {"threads": 1, "large_motion": "off"}


def test_flow_by_way_of_the_middle_one_is_right(
    found: list[PairFlow], solved: list[int], caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, "hugin_abflow"):
        merge_layers(layers(), CANVAS, Settings(**THREADS))
    assert len(solved) == 2 and min(solved) > 130
    assert median_way(found) == pytest.approx(5, abs=0.2)
    assert "flow of a and c: by way of other layers, which show what they share" in caplog.messages
    shifts = {tuple(r.overlap["layers"]): r.overlap for r in caplog.records if hasattr(r, "overlap")}
    for pair, way in ((("a", "b"), 3), (("b", "c"), 2), (("a", "c"), 5)):
        assert shifts[pair]["parallax_median"] == pytest.approx(way, abs=0.2)
        assert shifts[pair]["consistent"] > 0.9


def test_it_is_as_if_it_had_been_found(monkeypatch: pytest.MonkeyPatch, found: list[PairFlow]) -> None:
    panorama = merge_layers(layers(), CANVAS, Settings(**THREADS))
    by_others = median_way(found)
    found.clear()
    monkeypatch.setattr(relay, "_MUCH", np.inf)
    own = merge_layers(layers(), CANVAS, Settings(**THREADS))
    assert median_way(found) == pytest.approx(by_others, abs=0.2)
    difference = np.abs(panorama.astype(int) - own)
    assert difference.mean() < 0.2 and np.percentile(difference, 99) <= 4


@pytest.mark.parametrize("changed", [None, slice(120, 180)])
def test_progress_counts_each_pair_once(changed: slice | None) -> None:
    """However its flow comes."""
    steps = list[int]()

    @contextmanager
    def progress(phase: str, total: int) -> Iterator[Callable[[int], None]]:
        yield lambda units: steps.append(units) if phase == "flow" else None
        assert phase != "flow" or sum(steps) == total == 3

    merge_layers(layers(changed), CANVAS, Settings(**THREADS), progress=progress)
    assert steps


def test_neither_order_nor_threads_change_it() -> None:
    first = merge_layers(layers(), CANVAS, Settings(threads=2))
    for order in permutations(range(3)):
        its = layers()
        again = merge_layers([its[k] for k in order], CANVAS, Settings(threads=1))
        assert np.array_equal(again, first)


def test_without_flow_or_relay_all_is_as_ever(solved: list[int]) -> None:
    merge_layers(layers(), CANVAS, Settings(relay=False, **THREADS))
    assert len(solved) == 3
    solved.clear()
    merge_layers(layers(), CANVAS, Settings(flow=False, **THREADS))
    merge_layers(layers(), CANVAS, Settings(merge="sequential", **THREADS))
    assert len(solved) == 2  # of two layers at a time


def test_where_others_do_not_know_it_it_is_found_after_all(
    found: list[PairFlow], solved: list[int], caplog: pytest.LogCaptureFixture
) -> None:
    """The middle one shows something else there, as somebody in the way."""
    with caplog.at_level(logging.INFO, "hugin_abflow.pairflow"):
        merge_layers(layers(changed=slice(120, 180)), CANVAS, Settings(**THREADS))
    assert len(solved) == 3 and solved[2] < 70
    assert median_way(found) == pytest.approx(5, abs=0.3)
    assert not any("a and c" in said for said in caplog.messages)


@pytest.mark.parametrize(("first", "count"), [(161, 2), (152, 3)])
def test_what_others_know_most_of_is_not_found(solved: list[int], first: int, count: int) -> None:
    """Of the columns from 138 to 162."""
    merge_layers(layers(changed=slice(first, 180)), CANVAS, Settings(**THREADS))
    assert len(solved) == count


@pytest.mark.parametrize(("down", "count"), [(0.0, 2), (2.5, 2), (9.0, 3)])
def test_guides_that_say_something_else_are_heard(
    found: list[PairFlow], solved: list[int], caplog: pytest.LogCaptureFixture, down: float, count: int
) -> None:
    """A wrong one is named, as ever."""
    guides = [
        Guide(0, 2, (145.5, y), (150.5, y + by), name)
        for y, by, name in ((30.5, 0, "g"), (70.5, 0, "h"), (100.5, 0, "i"), (120.5, down, "j"))
    ]
    with caplog.at_level(logging.INFO, "hugin_abflow"):
        merge_layers(layers(), CANVAS, Settings(**THREADS), guides=guides)
    assert len(solved) >= count and (down or len(solved) == count)  # more where it is led
    assert median_way(found) == pytest.approx(5, abs=0.3)
    assert any("j is ignored" in said for said in caplog.messages) == (down > 3)


@pytest.mark.parametrize(("down", "count"), [(4.0, 2), (9.0, 3)])
def test_guides_are_heard_in_px_of_the_chart_on_which_they_lead(
    solved: list[int], monkeypatch: pytest.MonkeyPatch, down: float, count: int
) -> None:
    """Flow is refined on one of twice the resolution."""
    monkeypatch.setattr(quality, "_LEAST_PIXELS", dict.fromkeys(quality._LEAST_PIXELS, 10_000))
    guides = [Guide(0, 2, (145.5, 70.5), (150.5, 70.5 + down))]
    settings = Settings(flow_quality="best", working_pixels=301 * 151, **THREADS)
    merge_layers(layers(), CANVAS, settings, guides=guides)
    assert max(solved) < 100 and (len(solved) >= count if down > 6 else len(solved) == count)


def test_what_is_found_after_all_is_compared_with_others(
    found: list[PairFlow], monkeypatch: pytest.MonkeyPatch
) -> None:
    """And goes by way of them, where it is wrong."""
    solve = flow.solve

    def wrong(device: Device, a: Level, *given: object, **more: object) -> flow.Solution:
        solution = solve(device, a, *given, **more)
        if a.grid[0] < 70:  # the flow of the small overlap
            for way, by in ((solution.forward, 9), (solution.backward, -9)):
                way.set(way.get() + np.float32([0, by]))
        return solution

    monkeypatch.setattr(flow, "solve", wrong)
    monkeypatch.setattr(relay, "_HELD", 5.0)
    guides = [Guide(0, 2, (145.5, 70.5), (150.5, 79.5))]
    monkeypatch.setattr(guidance, "lead", lambda device, images, flows, *more: flows)
    merge_layers(layers(), CANVAS, Settings(**THREADS), guides=guides)
    (one,) = (one for one in found if (one.a, one.b) == (0, 2))
    assert abs(np.median(one.forward.get()[100:130, 20:35, 1])) < 1


def test_figures_and_flow_of_what_is_unknown(device: Device) -> None:
    """Nothing is trusted in it."""
    grid = plane(77, 53)
    chart = whole_chart(grid)
    image = np.random.default_rng(1).normal(size=grid.shape).astype(np.float32)
    level = Level(device.upload(image), device.empty(grid.shape).fill(1), False)
    one = consistency.unknown(device, Pair(0, 1), chart, (level, level))
    assert consistency.known(one) == 0 and not one.single
    assert np.array_equal(one.forward.get()[..., 3], image)
    assert not one.forward.get()[..., :3].any() and not one.backward.get()[..., :3].any()
    assert parallax(one, grid).consistent == 0
    values = one.forward.get()
    values[:10, :, 0], values[:10, :, 1], values[:10, :, 2] = 3, 4, 1
    values[:, 70:, 3] = 0  # nothing is shown there
    one.forward.set(values)
    told = parallax(one, grid)
    assert (told.median, told.largest) == (5, 5) and told.consistent == pytest.approx(10 / 53)
    values[20:, :, 3] = consistency.EXCLUDED  # taken from one photo, whole
    one.forward.set(values)
    assert parallax(one, grid).consistent == pytest.approx(10 / 20)
    values[20:, :70, 3], values[20:, 70:, 3] = image[20:, :70], 0
    one.forward.set(values)
    assert consistency.known(one) == 0  # both ways
    one.backward.set(values)
    assert consistency.known(one) == pytest.approx(10 / 49)  # from the last rows it leads beyond them
    values[:5, :, 2] = 0
    one.forward.set(values)
    assert consistency.known(one) == pytest.approx(5 / 49)
    values[..., 0] = 60
    values[5:10, 20:, 2] = 0
    for way in (one.forward, one.backward):
        way.set(values)
    assert consistency.known(one) == pytest.approx(5 / 49)  # from few columns it does not
    values[..., 0] = 70
    one.forward.set(values)
    assert consistency.known(one) == 0

"""Near things that would be bent, on charts whose every flow is known: found where one photo shows all of
them, and nothing else is."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st
from pictures import masked, merged, one_device, pixel_places
from reference import common
from rooms import ROOM, Thing, hit, pattern, unit
from scenes import NOBODY
from scipy import ndimage

from hugin_abflow import foreground, movers
from hugin_abflow.cells import CELL, SingleSource, View
from hugin_abflow.layer import Canvas

Array = np.ndarray

WIDTH, HEIGHT = 323, 141
# The borders: where the second photo begins, and where the first one ends.
BORDERS = 100, 220
# What is behind shifts by so many px, and a thing by as many more.
BEHIND, OWN = np.array([2.0, 1.0]), np.array([18.0, -3.0])
few = settings(max_examples=20)


@dataclass(frozen=True)
class Pair:
    """What `find` takes, and the pixels of both photos that show the thing."""

    chart: SimpleNamespace
    flows: tuple[Array, Array]
    views: tuple[View, View]
    thing: tuple[Array, Array]

    def found(self, points: tuple[Array, Array] = NOBODY) -> SingleSource | None:
        return foreground.find(self.chart, self.flows, self.views, points)


def pair(
    left: float,
    right: float,
    *,
    height: float = 22,
    behind: Array = BEHIND,
    own: Array = OWN,
    borders: tuple[int, int] = BORDERS,
    top: int = 0,
    turned: int | None = None,
    gaps: int = 0,
    hole: int = 0,
) -> Pair:
    """A board in front of a wall. left, right: its ends in the first photo, px. top: rows that neither photo
    shows. turned: columns that a chart that wraps, and has 324, is turned by. gaps: px between its rails, as
    wide as these. hole: px, of a hoop, which is open below."""
    width = WIDTH if turned is None else WIDTH + 1
    rows, columns = np.mgrid[:HEIGHT, :width] + 0.5

    def board(x: Array, y: Array) -> Array:
        solid = (x >= left) & (x < right) & (np.abs(y - HEIGHT / 2) < height / 2)
        if hole:
            aside = np.abs(x - (left + right) / 2)
            solid &= ~((aside < hole / 2) & (np.abs(y - HEIGHT / 2) < hole / 2))
            solid &= ~((aside < 6) & (y > HEIGHT / 2))
        return solid & ((x % (2 * gaps) < gaps) if gaps else True)

    shift = behind + own
    things = board(columns, rows), board(columns - shift[0], rows - shift[1])
    flows = [
        np.where(thing[..., None], sign * shift, sign * behind).astype(np.float32)
        for thing, sign in zip(things, (1, -1), strict=True)
    ]
    masks = [(columns < borders[1]) & (rows > top), (columns >= borders[0]) & (rows > top)]
    turn = 0 if turned is None else turned
    flows, masks, things = ([np.roll(one, turn, 1) for one in many] for many in (flows, masks, things))
    views = tuple(View(np.zeros(mask.shape, np.float32), mask.astype(np.float32)) for mask in masks)
    border = width, HEIGHT, int(turned is not None), 0
    chart = SimpleNamespace(
        width=width,
        height=HEIGHT,
        wraps=turned is not None,
        border=border,
        projection=None,
        period=0 if turned is None else width,
    )
    return Pair(chart, tuple(flows), views, tuple(things))


def assert_found(found: SingleSource | None, of: Pair) -> None:
    """The cells in whose middle a photo shows the thing, if the other one does, too, and those around."""
    assert found is not None
    modes = "constant", "wrap" if of.chart.wraps else "constant"
    middle = np.s_[CELL // 2 :: CELL, CELL // 2 :: CELL]
    rows, columns = np.indices(of.thing[0].shape)
    for index, cells in enumerate((found.first, found.second)):
        right, down = np.moveaxis(of.flows[index].astype(int), -1, 0)
        there = of.views[1 - index].mask[rows + down * of.thing[index], (columns + right) % of.chart.width]
        place = (of.thing[index] & (of.views[index].mask > 0) & (there > 0))[middle]
        assert place.sum() > 30
        inner, outer = (ndimage.maximum_filter(place, 2 * by + 1, mode=modes) for by in (3, 5))
        assert cells[inner].all()
        assert not cells[~outer].any()


@pytest.mark.parametrize("ends", [(60, 160), (110, 170), (115, 260), (60, 130)])
def test_board_that_ends_within_the_overlap_is_found(ends: tuple[float, float]) -> None:
    """Running out of the second photo, of none, and of the first."""
    one = pair(*ends)
    assert_found(one.found(), one)


@few
@given(turned=st.integers(0, 80))
def test_chart_that_wraps_may_be_turned(turned: int) -> None:
    plain, one = pair(110, 170, turned=0), pair(110, 170, turned=CELL * turned)
    assert_found(one.found(), one)
    for a, b in zip(plain.found().__dict__.values(), one.found().__dict__.values(), strict=True):
        assert np.array_equal(np.roll(a, turned, 1), b)


@few
@given(
    left=st.integers(40, 140),
    length=st.integers(20, 80),
    height=st.integers(10, 60),
    right=st.floats(-25, 25),
    down=st.floats(-25, 25),
)
def test_it_is_the_same_whichever_photo_is_the_first(
    left: int, length: int, height: int, right: float, down: float
) -> None:
    """And it is the board, if anything is."""
    one = pair(left, left + length, height=height, own=np.round([right, down]))
    swapped = Pair(one.chart, one.flows[::-1], one.views[::-1], one.thing[::-1])
    found, other = one.found(), swapped.found()
    assert (found is None) == (other is None)
    event(f"found: {found is not None}")
    if found:
        assert np.array_equal(found.first, other.second) and np.array_equal(found.second, other.first)
        for cells, thing in zip((found.first, found.second), one.thing, strict=True):
            place = thing[CELL // 2 :: CELL, CELL // 2 :: CELL]
            assert not cells[~ndimage.maximum_filter(place, 13)].any()


def test_rails_are_one_thing() -> None:
    """With what shows between them."""
    one = pair(60, 160, gaps=8, height=60)
    assert_found(one.found(), one)
    middle = one.found().first[HEIGHT // 2 // CELL]
    assert middle[108 // CELL : 156 // CELL].all()


SHORT = {"left": 60, "right": 120, "height": 14, "borders": (100, 150)}


@pytest.mark.parametrize(
    "what",
    [
        {"left": 60, "right": 260},  # crosses the overlap: would break at a border
        {"left": 60, "right": 160, "own": OWN / 2.5},  # bends little
        {"left": 60, "right": 160, "borders": (10, 310)},  # the same, has much room to change over
        {"left": 60, "right": 160, "borders": (10, 310), "top": 50},  # where photos end is no border of them
        {**SHORT, "own": np.array([5.0, 0.0])},  # shifts little
        {"left": 95, "right": 205},  # crosses one border in one photo, and the other's in the other
        {"left": 140, "right": 160, "height": 12},  # no more than a few cells
        {"left": 60, "right": 160, "own": -BEHIND * 0.9},  # is farther than what is around
        {"left": 60, "right": 160, "behind": BEHIND + OWN, "own": -OWN},  # by much
        {"left": 60, "right": 160, "behind": OWN, "own": 0.5 * OWN},  # shifts by much, but not by much more
        {"left": 60, "right": 260, "own": np.array([-2.0, 24.0])},  # crosses it, and shifts along the borders
        {"left": 70, "right": 260},  # hardly ends within
        {"left": 110, "right": 170, "borders": (0, WIDTH)},  # lies in photos that show the same
    ],
)
def test_what_is_left_alone(what: dict) -> None:
    assert pair(**what).found() is None


@pytest.mark.parametrize("turned", [0, 34, 42])
def test_hoop_is_whole(turned: int) -> None:
    """With what shows in it, wherever a chart that wraps begins."""
    one = pair(115, 171, height=56, hole=40, turned=CELL * turned)
    assert one.found().first[HEIGHT // 2 // CELL, (143 // CELL + turned) % 81]


@pytest.mark.parametrize(
    "what",
    [
        {"left": 106, "right": 260},  # just reaches a border
        {**SHORT, "own": np.array([7.0, 0.0])},  # shifts just enough
    ],
)
def test_what_is_just_enough(what: dict) -> None:
    assert pair(**what).found() is not None


@pytest.mark.parametrize("turned", [0, 40, 41])
def test_surface_goes_on_around_a_chart(turned: int) -> None:
    """A wall of which but a part has flow that is alike, wherever that lies."""
    one = pair(120, 165, turned=0)
    noise = np.random.default_rng(1).normal(0, 1.0, one.flows[0].shape)
    columns = np.arange(WIDTH + 1)
    noise[:, (columns >= 138) & (columns < 186)] = 0
    flows = [flow + noise * ~thing[..., None] for flow, thing in zip(one.flows, one.thing, strict=True)]
    turn = partial(np.roll, shift=CELL * turned, axis=1)
    views = tuple(View(turn(view.image), turn(view.mask)) for view in one.views)
    flows = tuple(turn(flow.astype(np.float32)) for flow in flows)
    assert foreground.find(one.chart, flows, views, NOBODY) is not None


def test_soft_outline_is_one() -> None:
    one = pair(60, 160, height=60)
    flows = tuple(ndimage.uniform_filter(flow, (40, 40, 0)) for flow in one.flows)
    assert foreground.find(one.chart, flows, one.views, NOBODY) is not None


def test_many_things_are_told_apart() -> None:
    """Two boards, of which one ends within the overlap, and the other crosses it."""
    one, other = pair(60, 160), pair(60, 260)
    down = 40
    flows = tuple(
        np.where(np.roll(b, down, 0)[..., None], np.roll(flow, down, 0), a)
        for a, flow, b in zip(one.flows, other.flows, other.thing, strict=True)
    )
    both = Pair(one.chart, flows, one.views, one.thing)
    assert_found(both.found(), both)


def test_floor_that_comes_nearer_is_no_thing() -> None:
    """Flow grows as much, but slowly."""
    one = pair(60, 160)
    share = np.clip((np.arange(HEIGHT) - 20) / 100, 0, 1)[:, None, None]
    flows = tuple(
        (sign * (BEHIND + share * OWN)).astype(np.float32) + 0 * flow
        for sign, flow in zip((1, -1), one.flows, strict=True)
    )
    assert foreground.find(one.chart, flows, one.views, NOBODY) is None


def test_flow_that_does_not_lead_back_tells_nothing() -> None:
    one = pair(60, 160)
    flows = one.flows[0], np.where(one.thing[1][..., None], one.flows[1] + 3, one.flows[1])
    assert foreground.find(one.chart, flows, one.views, NOBODY) is None


def test_few_cells_that_lead_back_tell_nothing() -> None:
    one = pair(60, 160)
    columns = np.arange(WIDTH)[None]
    rest = one.thing[1] & ~((columns >= 128) & (columns < 140))
    flows = one.flows[0], np.where(rest[..., None], one.flows[1] + 3, one.flows[1])
    assert foreground.find(one.chart, flows, one.views, NOBODY) is None


def test_what_somebody_vouches_for_is_left_alone() -> None:
    """Once in each photo would do, but control points lie in both."""
    one = pair(60, 160)
    starts = np.array([[130.0, 70.0]])
    assert one.found((starts, starts + BEHIND + OWN)) is None
    assert one.found((starts, starts + BEHIND + OWN + 6)) is not None
    assert one.found((np.array([[130.0, 30.0]]), np.array([[130.0, 30.0]]) + BEHIND)) is not None


def test_what_somebody_vouches_for_across_the_border_of_a_chart() -> None:
    one, starts = pair(110, 170, turned=180), np.array([[310.0, 70.0]])
    assert one.found() is not None
    assert one.found((starts, (starts + BEHIND + OWN) % [324, 1000])) is None


@pytest.mark.parametrize("wraps", [False, True])
@pytest.mark.parametrize("size", [(1, 1), (90, 1), (90, 2), (1, 90), (2, 90), (90, 3), (3, 90)])
def test_charts_without_cells(size: tuple[int, int], wraps: bool) -> None:
    border = *size, int(wraps), 0
    chart = SimpleNamespace(
        width=size[0], height=size[1], wraps=wraps, period=size[0] * wraps, border=border, projection=None
    )
    flow, shown = np.zeros((*size[::-1], 2), np.float32), np.ones(size[::-1], np.float32)
    assert foreground.find(chart, (flow, flow), (View(shown, shown),) * 2, NOBODY) is None


def test_nothing_without_an_overlap_or_anything_behind() -> None:
    assert pair(60, 160, borders=(200, 200)).found() is None
    one = pair(60, 160)
    rng = np.random.default_rng(1)
    noise = tuple(rng.normal(0, 9, flow.shape).astype(np.float32) for flow in one.flows)
    assert foreground.find(one.chart, noise, one.views, NOBODY) is None


# Whole panoramas

CANVAS = Canvas.sphere(960, 480)
SCALE = 960 / (2 * np.pi)  # px per radian
MOVE = np.array([-0.12, 0, 0])
BALL = Thing((0.02, 1, 0.05), 0 * MOVE, 0.16, 0.75)


def ball(**options: float) -> tuple[int, int]:
    """Width and height of a ball, which both photos show round, in their panorama."""
    rows, columns = pixel_places(480, 960)
    rays = common.canvas_point(columns + 0.5, rows + 0.5, (-np.pi, 1 / SCALE, np.pi / 2, 1 / SCALE))
    layers = []
    for second, covered in ((False, (180, 535)), (True, (425, 780))):
        points = hit(ROOM, MOVE * second, rays)
        colours = np.exp(pattern(unit(points), 1, SCALE))[..., None] * [60.0, 80.0, 90.0]
        points, place = BALL.seen(MOVE * second, rays, second)
        own = np.exp(pattern(unit(points), 2, SCALE))[..., None] * [110.0, 50.0, 30.0]
        photo = np.full((480, 960, 4), 255, np.uint8)
        photo[..., :3] = np.clip(np.rint(np.where(place[..., None], own, colours)), 0, 255)
        layers.append(
            masked(photo, (np.abs(rows - 240) < 120) & (columns >= covered[0]) & (columns < covered[1]))
        )
    result = merged(layers, CANVAS, **options)
    red = ndimage.binary_opening((result[..., 0] > 1.5 * result[..., 2]) & (result[..., 3] > 0))
    return np.ptp(np.nonzero(red)[1]) + 1, np.ptp(np.nonzero(red)[0]) + 1


@pytest.mark.usefixtures(one_device.__name__)
def test_a_ball_close_by_stays_round(monkeypatch: pytest.MonkeyPatch) -> None:
    """And is shown once; it is squeezed if neither near things are looked for, nor transitions go round."""
    monkeypatch.setattr(movers, "find", lambda *_: None)
    for one in ({"transition_strain": 0}, {"foreground": False}):
        width, height = ball(**one)
        assert abs(width - height) <= 3
    width, height = ball(transition_strain=0, foreground=False)
    assert abs(width - height) > 5

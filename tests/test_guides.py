"""Which guides are doubted, and guides on the way through the whole pipeline."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from grids import GRIDS, on_device, plane
from pictures import masked, one_device, pixel_places
from test_flow_truth import scene

from hugin_abflow import flow, geometry, guidance, joint, reading
from hugin_abflow.chart import pair_chart
from hugin_abflow.grid import full_grid, working_grid
from hugin_abflow.guidance import GuidanceParameters, on_chart
from hugin_abflow.guides import Guide, by_pair, doubts
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.merge import merge_layers
from hugin_abflow.opencl import Device
from hugin_abflow.progress import silent
from hugin_abflow.settings import Settings

pytestmark = pytest.mark.usefixtures(one_device.__name__)


@pytest.fixture(autouse=True)
def no_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Flow by warping alone: the search finds by itself what these scenes need guides for."""
    monkeypatch.setattr(flow.search, "reaches", lambda *_, **__: {})


# Doubts

AROUND = [(0, 0), (40, 5), (10, 50), (45, 60), (20, 20)]


def test_like_neighbours_are_trusted():
    moves = np.array([(10, 0), (11, 0.5), (9, -0.5), (10.5, 1), (10, 0)])
    assert doubts(np.array(AROUND, float), moves, 100) == [""] * 5


def test_outlier_is_found_whatever_its_place_in_the_list():
    moves = [(10, 0), (11, 0), (9, 0), (10.5, 1), (40, -30)]
    for order in list(permutations(range(5)))[::17]:
        reasons = doubts(np.array(AROUND, float)[list(order)], np.array(moves, float)[list(order)], 100)
        assert [bool(reason) for reason in reasons] == [index == 4 for index in order]
        assert "neighbours move otherwise" in max(reasons)


def test_neighbours_are_found_around_the_canvas():
    places = np.array(AROUND, float)
    places[:, 0] = (places[:, 0] - 25) % 1000
    moves = np.array([(10, 0), (11, 0), (9, 0), (10.5, 1), (40, -30)])
    assert [bool(reason) for reason in doubts(places, moves, 100, 1000)] == [False] * 4 + [True]
    assert not any(doubts(places, moves, 100))


def test_two_on_a_near_thing_vouch_for_each_other():
    places = np.array([*AROUND, (24, 26)], float)
    moves = np.array([(10, 0), (11, 0), (9, 0), (10.5, 1), (40, -30), (43, -28)])
    assert doubts(places, moves, 100) == [""] * 6


def test_lone_guide_is_trusted():
    """Alone of all, or out of the others' reach, or with too few of them for a majority."""
    moves = np.array([(10, 0), (11, 0), (9, 0), (10.5, 1), (40, -30)])
    assert doubts(np.array([(3.0, 4)]), np.array([(500.0, 3)]), 100) == [""]
    assert doubts(np.array([*AROUND[:4], (900, 20)], float), moves, 100) == [""] * 5
    assert doubts(np.array(AROUND[2:], float), moves[2:], 100) == [""] * 3


def test_neighbours_that_differ_widely_prove_nothing():
    moves = np.array([(0, 0), (25, 0), (-20, 10), (5, 30), (40, -30)], float)
    assert doubts(np.array(AROUND, float), moves, 100) == [""] * 5


def test_repeated_guides_count_once():
    """A wrong point does not confirm itself by standing there twice."""
    places = np.array([*AROUND, (20.2, 20)], float)
    moves = np.array([(10, 0), (11, 0), (9, 0), (10.5, 1), (40, -30), (40, -30.3)])
    reasons = doubts(places, moves, 100)
    assert reasons[:4] == [""] * 4
    assert "neighbours move otherwise" in reasons[4] and reasons[5] == "it repeats another"


def test_one_wrong_point_among_thousands():
    random = np.random.default_rng(5)
    places, moves = random.random((3000, 2)) * 2000, random.normal((20, 0), 1, (3000, 2))
    moves[1234] = (-30, 50)
    reasons = doubts(places, moves, 160)
    assert [i for i, reason in enumerate(reasons) if reason and "repeats" not in reason] == [1234]


def test_contradicting_guides_are_both_ignored():
    reasons = doubts(np.array([(5.0, 5), (5, 5.4), (300, 5)]), np.array([(10.0, 0), (0, 20), (1, 1)]), 100)
    assert ["sends the same place elsewhere" in reason for reason in reasons] == [True, True, False]


# From the canvas to charts, and back


@pytest.mark.parametrize("name", list(GRIDS))
def test_places_on_a_grid_come_back(name: str) -> None:
    grid = GRIDS[name]
    half = grid.resized(max(2, grid.width // 2), max(1, grid.height // 3))
    places = np.random.default_rng(3).random((50, 2)) * (grid.region.width, grid.region.height)
    places += grid.region.left, grid.region.top
    for one in (grid, half):
        assert np.allclose(one.places(one.points(places)), places, atol=1e-9)
    points, coarse = grid.points(places), half.points(places)
    scale = (half.width / grid.width, half.height / grid.height, 1) if not grid.lonlat[1] else 1
    assert np.allclose(coarse, points * scale)


@pytest.mark.parametrize("name", list(GRIDS))
def test_guides_on_a_chart_are_where_kernels_put_them(name: str) -> None:
    """Against the twin; and the same guide named the other way round comes out turned."""
    from reference import common

    grid = GRIDS[name]
    overlap = np.zeros(grid.shape, bool)
    overlap[2:17, 5:20] = True
    chart = pair_chart(overlap, grid, grid)
    ends = [(9.5 + grid.region.left, 4.25 + grid.region.top), (12.0 + grid.region.left, 9 + grid.region.top)]
    guides = [Guide(0, 1, *ends, "there"), Guide(1, 0, ends[1], ends[0], "back"), Guide(0, 2, *ends, "other")]
    assert sorted(by_pair(guides, [0, 1, 2])) == [(0, 1), (0, 2)]
    (pair,) = by_pair(guides, [0, 1]).values()
    placed = on_chart(pair, chart, grid)
    assert placed.names == ("there", "back")
    for found, end in ((placed.at_a, ends[0]), (placed.at_b, ends[1])):
        x, y = np.array(end) - (grid.region.left, grid.region.top)
        u, v = common.chart_position(common.canvas_point(x, y, grid.lonlat), chart.transform)
        assert np.allclose(found, [(u, v)] * 2, atol=1e-3)
    (pair,) = by_pair(guides, [1, 0]).values()
    back = on_chart(pair, chart, grid)
    assert np.array_equal(back.at_a, placed.at_b) and np.array_equal(back.at_b, placed.at_a)


def test_a_layer_that_is_given_twice_has_two_numbers(device: Device) -> None:
    """Guides may be about the first or the second of them."""
    one, other = (
        Layer.from_array(
            "layer", (200 * np.random.default_rng(k).random((40, 50, 4))).astype(np.uint8), 9 * k, 3
        )
        for k in (0, 1)
    )
    layers = [one, other, one]
    grid = working_grid(full_grid(Canvas.plane(60, 50), layers), Settings())
    reduced = reading.read(device, layers, grid, silent, Settings())
    used, _ = joint._parted(device, reduced, layers, grid)
    assert len(used.layers) == 3 and sorted(used.numbers) == [0, 1, 2]
    assert all(layers[k] is its.layer for k, its in zip(used.numbers, used.layers, strict=True))


@pytest.mark.parametrize("first", [0, 300, 770])
@pytest.mark.parametrize("move", [-40, 40])
def test_guides_that_lead_beyond_a_chart_of_a_cylinder_go_the_shorter_way(first: int, move: int) -> None:
    """Also where the overlap lies across the canvas's border, and beside its chart, which does not wrap."""
    grid = plane(800, 200, wraps=True)
    overlap = np.zeros(grid.shape, bool)
    overlap[:, np.arange(first, first + 100) % 800] = True
    chart = pair_chart(overlap, grid, grid)
    assert not chart.wraps and chart.period == 800
    starts = [(first + column, row) for column, row in ((5, 40), (95, 100), (-10, 110), (108, 120))]
    guides = [Guide(0, 1, (x % 800, y), ((x + move) % 800, y)) for x, y in starts]
    its = on_chart(guides, chart, grid)
    there = np.zeros((chart.height, chart.width, 2), np.float32)
    there[..., 0] = move
    assert not guidance.contradict(chart, (there, -there), its, 1)
    assert guidance.contradict(chart, (-there, there), its, 1)
    # one that is farther away the other way round is a neighbour: three of them outvote the last one
    last = Guide(0, 1, (first % 800, 90), ((first + 30 - move) % 800, 130))
    odd = on_chart([*guides[:3], last], chart, grid)
    for one in (its, odd):
        directed = guidance._directed(chart.border, (there, -there), one)
        leading = guidance._leading(one, directed, 200.0, GuidanceParameters(agreement=-1.0))
        assert leading.tolist() == [True, True, True, one is its]


@pytest.mark.parametrize("name", ["plane", "sphere", "window"])
def test_panorama_shows_a_layers_places_where_it_says(device: Device, name: str) -> None:
    """x_k(p) = q: sampling the field at the answer leads back to the place."""
    grid = GRIDS[name]
    height, width = 29, 41
    layer = on_device(device, np.ones((height, width, 4)), 20, 5)
    y, x = pixel_places(height, width)
    shown = (
        np.stack([x + 20.5 + grid.region.left, y + 5.5 + grid.region.top], -1).reshape(-1, 2).astype(float)
    )
    sampled = shown + np.stack([2.5 + 0.5 * np.sin(x / 9), 1.5 * np.cos(y / 8)], -1).reshape(-1, 2)
    field = np.zeros((height, width, 4), np.float32)
    field[..., :3] = (grid.points(sampled) - grid.points(shown)).reshape(height, width, 3)
    inner = ((x > 4) & (x < 33) & (y > 4) & (y < 24)).ravel()
    found = geometry.shown_at(layer.box, device.upload(field), grid, sampled[inner])
    assert np.abs(found - shown[inner]).max() < 0.25  # the field is read without interpolation


# The whole pipeline: a thing before a wall, nearer than flow alone finds

CANVAS = Canvas.plane(401, 161)
FIRST, LAST = 60, 341  # columns of the overlap
THING, HALF, MOVE = (170, 80), (40, 50), 56  # centre in the left layer, px from it to its edges, motion


def look(shift: float) -> np.ndarray:
    """What a camera sees: the thing is weakly textured, striped, and moved by `shift`."""
    y, x = pixel_places(CANVAS.height, CANVAS.width)
    u, v = x + 0.5 - THING[0] - shift, y + 0.5 - THING[1]
    wall = 0.15 + 0.25 * scene(11, 500.0)(x + 0.5, y + 0.5)
    stripes = 0.62 + 0.05 * np.sin(u * 2 * np.pi / 14) + 0.02 * np.sin(v / 5)
    grey = np.where((np.abs(u) < HALF[0]) & (np.abs(v) < HALF[1]), stripes, wall)
    return np.rint(255 * np.stack([grey, grey, grey, np.ones_like(grey)], -1)).astype(np.uint8)


def near_scene() -> list[Layer]:
    x = pixel_places(CANVAS.height, CANVAS.width)[1]
    return [masked(look(0), x < LAST, "left"), masked(look(MOVE), x >= FIRST, "right")]


GUIDES = [
    Guide(0, 1, (x, y), (x + MOVE, y), f"guide {x}")
    for x, y in ((THING[0] - 16, 60.0), (THING[0] + 13, 102.0))
]


def off_by(pixels: np.ndarray) -> float:
    """How far the thing's left and right edge are from where they belong, px, rows in its middle: p = x +
    w_R(p) MOVE, and w_R grows linearly over the overlap."""
    grow = MOVE / (LAST - FIRST + 1)
    places = [(edge - (FIRST - 1) * grow) / (1 - grow) for edge in (THING[0] - HALF[0], THING[0] + HALF[0])]
    bright = pixels[60:101, :, 1] > 0.52 * 255
    edges = bright.argmax(1).mean(), bright.shape[1] - bright[:, ::-1].argmax(1).mean()
    holes = 1 - bright[:, round(places[0]) + 4 : round(places[1]) - 4].mean()
    return max(abs(edges[0] - places[0]), abs(edges[1] - places[1]), 100 * holes)


@pytest.mark.parametrize("mode", ["joint", "sequential"])
def test_near_thing_is_whole_and_in_its_place_only_with_guides(device, mode):
    settings = Settings(merge=mode, exposure=False, transition_strain=0)
    assert off_by(merge_layers(near_scene(), CANVAS, settings)) > 10
    assert off_by(merge_layers(near_scene(), CANVAS, settings, guides=GUIDES)) < 6  # edges, where flow jumps


@pytest.mark.parametrize("mode", ["joint", "sequential"])
def test_transition_goes_round_a_near_thing_that_guides_tell(device, mode):
    """It is seen as one of the photos shows it; without guides a part of it is there twice, side by side,
    unless it is cut out.
    """
    settings, shows = Settings(merge=mode, exposure=False, seam=False), [look(0), look(MOVE)]
    x = np.arange(CANVAS.width)
    near = (x > THING[0] - HALF[0] - 12) & (x < THING[0] + HALF[0] + MOVE + 12)

    def unlike(guides):
        result = merge_layers(near_scene(), CANVAS, settings, guides=guides).astype(int)
        return min(np.abs(result - photo)[20:140, near].mean() for photo in shows)

    assert unlike(GUIDES) < 0.5
    assert unlike(()) > 5  # a transition passes beside its stripes, but not beside all of them


def test_guides_may_be_left_aside(device):
    alone = merge_layers(near_scene(), CANVAS)
    off = merge_layers(near_scene(), CANVAS, Settings(guides=False), guides=GUIDES)
    np.testing.assert_array_equal(off, alone)
    assert (merge_layers(near_scene(), CANVAS, guides=GUIDES) != alone).any()


def test_order_of_the_layers_does_not_matter_to_guides(device):
    led = merge_layers(near_scene(), CANVAS, guides=GUIDES)
    turned = [Guide(1 - g.a, 1 - g.b, g.at_a, g.at_b, g.name) for g in GUIDES]
    np.testing.assert_array_equal(merge_layers(near_scene()[::-1], CANVAS, guides=turned), led)


def test_guides_move_with_the_mosaic(device, monkeypatch):
    """A third layer, merged last, has guides to the first one as it was before it was merged."""
    from hugin_abflow import guidance

    seen = []
    original = guidance.on_chart

    def watch(guides, *others):
        seen.append([(g.at_a, g.at_b) for g in guides])
        return original(guides, *others)

    monkeypatch.setattr(guidance, "on_chart", watch)
    y, x = pixel_places(CANVAS.height, CANVAS.width)
    left, right = masked(look(0), (x < LAST) & (y < 140)), masked(look(MOVE), (x >= FIRST) & (y < 140))
    third = masked(look(20), (x > 120) & (x < 330) & (y > 9), "third")
    to_third = Guide(2, 0, (190.0, 80.0), (170.0, 80.0), "to the third")
    settings = Settings(merge="sequential", transition_strain=0)
    merge_layers([left, right, third], CANVAS, settings, guides=[*GUIDES, to_third])
    first, last = seen
    assert {frozenset(ends) for ends in first} == {frozenset((g.at_a, g.at_b)) for g in GUIDES}
    ((in_mosaic, in_third),) = last
    assert in_third == (190.0, 80.0)
    # left's place lies in the middle of the overlap: the thing has moved by the right layer's share of MOVE
    assert 170 + 0.2 * MOVE < in_mosaic[0] < 170 + 0.8 * MOVE and abs(in_mosaic[1] - 80) < 2

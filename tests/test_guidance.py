"""Flow led by guides: kernels against twins, and scenes where flow alone goes astray."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from grids import patches
from reference import common
from reference import guidance as twin
from reference.flow import flow_solution, solving
from test_flow import SOLVED, board_of, make_feature, on_board, smooth_noise
from test_flow_truth import level, log, scene
from tolerances import DECISIONS, SUM, TRIGONOMETRY, assert_close

from hugin_abflow import flow, guidance
from hugin_abflow.flow import Board
from hugin_abflow.grid import Border
from hugin_abflow.guidance import ChartGuides, GuidanceParameters
from hugin_abflow.opencl import Device

GRIDS = {"plane": Border(77, 53, 0), "cylinder": Border(78, 53, 1), "odd cylinder": Border(77, 53, 1)}


@pytest.fixture(autouse=True)
def no_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Flow by warping alone: the search finds by itself what these scenes need guides for."""
    monkeypatch.setattr(flow.search, "reaches", lambda *_, **__: {})


# Kernels


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize("scale", [1, 4])
def test_start_equals_its_twin(device: Device, name: str, scale: int) -> None:
    grid = GRIDS[name]
    size = (-(-grid[0] // scale), -(-grid[1] // scale))
    moved = 9 * smooth_noise(61, grid, 2, 4)
    guides = np.array([[3.2, 7.1, 9, -4], [74.6, 30.3, -5, 2], [40, 50, 12, 12]], np.float32)
    sigmas = np.array([5, 8, 3], np.float32)
    start, near = device.empty((size[1], size[0], 2)), device.empty((size[1], size[0]))
    device.run(
        "guidance", "guidance_start", size, device.upload(moved), grid, device.upload(guides),
        device.upload(sigmas), 3, float(scale), start, near, size,
    )  # fmt: skip
    expected = twin.guidance_start(moved, grid, guides, sigmas, scale, size)
    assert_close(start.get(), expected[0], TRIGONOMETRY, scale=10)
    assert_close(near.get(), expected[1], TRIGONOMETRY)


@pytest.mark.parametrize("width", [64, 65, 66, 67])
def test_flow_starts_as_it_was_found_up_to_the_rim(device: Device, width: int) -> None:
    """A coarse level's last pixels may lie beyond the chart."""
    grid, size = Border(width, 33, 0), (-(-width // 8), 5)
    found = device.upload(np.full((33, width, 2), 24, np.float32))
    guide, sigma = device.upload(np.zeros((1, 4), np.float32)), device.upload(np.ones(1, np.float32))
    start, near = device.empty((size[1], size[0], 2)), device.empty((size[1], size[0]))
    device.run("guidance", "guidance_start", size, found, grid, guide, sigma, 1, 8.0, start, near, size)
    np.testing.assert_allclose(start.get(), 3, rtol=1e-6)


def test_twin_of_start_by_hand() -> None:
    """At a guide all of its residual, far away none, around the border of a cylinder too."""
    grid = Border(80, 60, 1)
    found = np.full((60, 80, 2), 0.5)
    start, near = twin.guidance_start(
        found, grid, np.array([[0.5, 30.5, 8.0, -6.0]]), np.array([5.0]), 1, (80, 60)
    )
    assert near[30, 0] == 1 and near[30, 79] == near[30, 1] == pytest.approx(np.exp(-0.02))
    assert np.allclose(start[30, [0, 1, 79]], (8.5, -5.5))
    assert np.array_equal(start[30, 25], (0.5, 0.5)) and np.array_equal(start[55, 0], (0.5, 0.5))
    assert near[30, 7] == pytest.approx(np.exp(-0.98))
    assert np.allclose(start[30, 7], 0.5 + (2 * np.exp(-0.98) - 0.001) * np.array([8, -6]))


def test_pull_equals_its_twin(device: Device) -> None:
    """A spring on the second of two systems: they are solved with it, the first one without."""
    grid = GRIDS["plane"]
    start, near = 5 * smooth_noise(62, grid, 2, 3), np.abs(smooth_noise(63, grid, 1, 3))[..., 0]
    left, right = np.abs(smooth_noise(64, grid, 4, 1)), smooth_noise(65, grid, 4, 1)
    right[..., 2] = np.abs(right[..., 2])
    left[:, -1, 3] = right[-1, :, 2] = 0  # there is no neighbour
    moved = smooth_noise(66, grid, 2, 2)
    alone = board_of(device, grid, {tuple(SOLVED): solving(left, right, grid, moved)})
    board = Board.of(device, 2, grid)
    board.planes.set(np.repeat(alone.planes.get(), 2, 0))
    device.run(
        "guidance", "guidance_pull", grid[:2], device.upload(start), device.upload(near), grid, board.pitch,
        8.0, 1, board.planes,
    )  # fmt: skip
    first, second = board.planes.get()
    assert np.array_equal(first, alone.planes.get()[0])
    expected = solving(*twin.guidance_pull(start, near, 8.0, left, right), grid, moved)
    assert_close(flow_solution(second[:, :, SOLVED], grid), expected, TRIGONOMETRY, scale=10)


@pytest.mark.parametrize("name", list(GRIDS))
def test_bring_equals_its_twin(device: Device, name: str) -> None:
    grid = GRIDS[name]
    feature, moved = make_feature(18, grid), 9 * smooth_noise(19, grid, 2, 4)
    brought = device.empty(feature.shape)
    device.run(
        "guidance", "guidance_bring", grid[:2], device.upload(feature), device.upload(moved), grid, brought
    )
    assert_close(brought.get(), twin.guidance_bring(feature, moved, grid), 1e-5, DECISIONS)


@pytest.mark.parametrize("name", list(GRIDS))
def test_vote_equals_its_twin(device: Device, name: str) -> None:
    grid = GRIDS[name]
    small = np.array([0.2, 0.2, 0.2, 1], np.float32)  # else every cost is the largest
    seen = [small * make_feature(66 + i, grid) for i in range(3)]
    near = np.abs(smooth_noise(70, grid, 1, 4))[..., 0]
    board = Board.of(device, 1, grid)
    device.run(
        "guidance", "guidance_vote", grid[:2], *map(device.upload, seen), device.upload(near), grid,
        board.pitch, 20.0, 15.0, 0.05, board.planes,
    )  # fmt: skip
    expected = twin.guidance_vote(*seen, near, grid, 20.0, 15.0, 0.05)
    assert (expected[1][..., 0] > 0.1).mean() > 0.1 and (expected[1][..., 0] < -0.1).mean() > 0.1
    wanted = solving(*expected, grid, np.zeros((grid[1], grid[0], 2)))
    assert_close(on_board(board, SOLVED), wanted, TRIGONOMETRY, scale=10)


def test_costs_on_the_host_are_those_of_the_vote() -> None:
    features, brought = (0.2 * make_feature(72 + i, GRIDS["plane"])[0] for i in range(2))
    expected = twin.cost(features, brought)
    assert 0.1 < (expected < twin.MOST_COST).mean() < 0.9
    assert_close(guidance._cost(features, brought), expected, SUM)


def test_twin_of_vote_is_a_weighted_mean() -> None:
    """Right over left is each pixel's own opinion: -1 far off, 1 at a guide, evidence in between."""
    grid = Border(5, 1, 0)
    feature = np.zeros((1, 5, 4))
    feature[..., 3] = 1
    old, new = feature.copy(), feature.copy()
    old[0, 2, 0], new[0, 3, 1] = 0.2, 0.1  # the new one fits better, worse
    near = np.array([[0.0, 1.0, 0.6, 0.6, 0.6]])
    left, right = twin.guidance_vote(feature, old, new, near, grid, 20.0, 10.0, 0.05)
    seed = 10 * 0.6**16
    assert np.allclose(left[0, :, 0], [1, 10, 4 + seed, 4 + seed, seed])
    assert np.allclose(right[0, :, 0], [-1, 10, 4 + seed, seed - 4, seed])
    assert np.allclose(left[0, :, 3], [1, 1, 1, 1, 0]) and not right[..., 2].any()
    new[0, 2, 3] = 0  # what one of them does not see is no evidence
    assert twin.guidance_vote(feature, old, new, near, grid, 20.0, 10.0, 0.05)[1][0, 2, 0] == seed


def test_choice_equals_its_twin(device: Device) -> None:
    grid = GRIDS["plane"]
    vote, new, old = (smooth_noise(71 + i, grid, 2, 2) for i in range(3))
    result = device.upload(old)
    device.run("guidance", "guidance_choose", grid[:2], device.upload(vote), device.upload(new), grid, result)
    assert np.array_equal(result.get(), twin.guidance_choose(vote, new, old))


def test_settling_equals_its_twin(device: Device) -> None:
    """And is exact where no guide is."""
    grid = GRIDS["plane"]
    refined, old = (smooth_noise(74 + i, grid, 2, 2) for i in range(2))
    near = np.maximum(smooth_noise(76, grid, 1, 4)[..., 0], 0) ** 2
    result = device.upload(old)
    device.run(
        "guidance", "guidance_blend", grid[:2], device.upload(refined), device.upload(near), grid, result
    )
    assert_close(result.get(), twin.guidance_blend(refined, near, old), SUM)
    assert 0.3 < (near < 5e-4).mean() < 0.8
    assert np.array_equal(result.get()[near < 5e-4], old[near < 5e-4])


# Scenes: a near thing before a textured wall, moved by much more than its detail

WIDTH, HEIGHT = 301, 201
CENTRE = (130, 100)
MOVE = 60


def thing(kind: str, shift: float) -> tuple[np.ndarray, np.ndarray]:
    """Brightness, and where the thing is: 68 x 120 px, moved by `shift`, before a wall that stays."""
    x, y = common.pixels(WIDTH, HEIGHT)
    u, v = x + 0.5 - CENTRE[0] - shift, y + 0.5 - CENTRE[1]
    inside = (np.abs(u) < 34) & (np.abs(v) < 60)
    wall = 0.15 + 0.25 * scene(11, 500.0)(x + 0.5, y + 0.5)
    surface = {
        "white": 0.75 + 0.01 * np.sin(u / 6) * np.cos(v / 7),
        "stripes": 0.55 + 0.12 * np.sin(u * 2 * np.pi / 17) + 0.01 * np.sin(v / 5),
        "texture": 0.3 + 0.6 * scene(3, 300.0)(u + 500, v + 200),
    }[kind]
    noise = np.random.default_rng(int(shift) + 5).normal(0, 0.002, inside.shape)
    return np.where(inside, surface, wall) + noise, inside


Pair = tuple[tuple, tuple, tuple[np.ndarray, np.ndarray]]


@pytest.fixture
def pair(device: Device) -> Callable[[str], Pair]:
    """Images, flow found alone, and where the thing is in each."""

    def make(kind: str) -> Pair:
        (a, in_a), (b, in_b) = thing(kind, 0), thing(kind, MOVE)
        images = level(device, log(a)), level(device, log(b))
        return images, flow.pair_flow(device, *images), (in_a, in_b)

    return make


def guides_at(*places: tuple[float, float], move: tuple[float, float] = (MOVE, 0)) -> ChartGuides:
    at_a = np.array(places, float)
    return ChartGuides(at_a, at_a + move, tuple(f"guide {i}" for i in range(len(places))))


ON_THE_THING = guides_at((118, 82), (138, 121))


def errors(flows: tuple, insides: tuple[np.ndarray, np.ndarray]) -> tuple[float, float]:
    """Median error on the thing, both ways; share of wrong pixels (3 px) where the wall is seen by both."""
    on, off = [], []
    for field, inside, other, move in zip(flows, insides, insides[::-1], (MOVE, -MOVE), strict=True):
        error = np.linalg.norm(field.get() - inside[..., None] * np.array([move, 0]), axis=-1)
        on.append(np.median(error[inside]))
        off.append((error[~inside & ~other] > 3).mean())
    return max(on), max(off)


@pytest.mark.parametrize("kind", ["white", "stripes", "texture"])
def test_guides_lead_where_flow_alone_goes_astray(device: Device, pair, kind: str) -> None:
    images, alone, insides = pair(kind)
    assert errors(alone, insides)[0] > 30
    led = guidance.lead(device, images, alone, ON_THE_THING, 2048.0)
    on, off = errors(led, insides)
    assert on < 1
    assert off < 0.04  # the wall stays, but for what the thing hides in one of the images


def test_far_places_are_untouched(device: Device, pair) -> None:
    images, alone, _ = pair("texture")
    before = [one.get() for one in alone]
    led = guidance.lead(device, images, alone, ON_THE_THING, 2048.0, GuidanceParameters(most_sigma=33.0))
    for one, other, far in zip(led, before, (np.s_[272:], np.s_[:44]), strict=True):
        changed = (one.get() != other).any(-1)
        assert changed.mean() > 0.2
        assert not changed[:, far].any()


def test_guides_that_are_too_far_apart_lead_one_by_one(device: Device, pair) -> None:
    """Two that send alike are on one thing, unless that were larger than any may be."""
    images, alone, _ = pair("texture")

    def led(spacing: float) -> np.ndarray:
        found = device.copy(alone[0]), device.copy(alone[1])
        parameters = GuidanceParameters(most_sigma=100.0, spacing=spacing)
        return guidance.lead(device, images, found, ON_THE_THING, 2048.0, parameters)[0].get()

    apart = float(np.linalg.norm(np.subtract(*ON_THE_THING.at_a)))
    one_by_one = led(0.0)
    assert np.array_equal(led(100.1 / apart), one_by_one)
    assert not np.array_equal(led(99.9 / apart), one_by_one)


def test_guides_that_agree_change_nothing(device: Device, pair) -> None:
    images, alone, _ = pair("texture")
    before = [one.get() for one in alone]
    led = guidance.lead(device, images, alone, guides_at((30, 30), (35, 160), move=(1, -1.5)), 2048.0)
    for one, other in zip(led, before, strict=True):
        assert np.array_equal(one.get(), other)


def test_flow_is_held_by_guides_that_agree_with_it_and_that_both_images_show(device: Device, pair) -> None:
    images, alone, _ = pair("texture")
    guides = guides_at((30, 30), (35, 160), (40, 100), (35, 60), (-50, 50), (250, 20), move=(1, -1.5))
    guides.at_b[1] += 4
    backward = alone[1].get()
    backward[50:70, 20:50] += 4  # the fourth agrees with flow one way only
    mask = images[1].mask.get()
    mask[:40, 240:] = 0
    masked = images[0], replace(images[1], mask=device.upload(mask))
    there, back = guidance.held(masked, (alone[0], device.upload(backward)), guides)
    for way, at, sign in ((there, guides.at_a, 1), (back, guides.at_b, -1)):
        assert np.array_equal(way[:, :2], at[[0, 2]]) and np.allclose(way[:, 2:], [[sign, -1.5 * sign]])


def test_guides_that_the_images_refute_are_ignored(device: Device, pair, caplog) -> None:
    """Two points that agree with each other, on a wall that both images show clearly at its place."""
    images, alone, _ = pair("texture")
    before = [one.get() for one in alone]
    with caplog.at_level(logging.INFO, "hugin_abflow"):
        led = guidance.lead(device, images, alone, guides_at((35, 60), (40, 140), move=(9, 14)), 2048.0)
    for one, other in zip(led, before, strict=True):
        assert np.array_equal(one.get(), other)
    assert [m.partition(" is ignored: ")[0] for m in caplog.messages] == ["guide 0", "guide 1"]


def test_guides_on_what_one_photo_does_not_show_are_ignored(device: Device, caplog) -> None:
    """Somebody who walked was masked in one photo, the control points on him are still there."""
    image, _ = thing("texture", 0)
    x, y = common.pixels(WIDTH, HEIGHT)
    shown = (np.abs(x - 110) > 40) | (np.abs(y - 100) > 40)
    images = level(device, log(image)), level(device, log(image), shown.astype(np.float32))
    alone = flow.pair_flow(device, *images)
    before = [one.get() for one in alone]
    with caplog.at_level(logging.INFO, "hugin_abflow"):
        led = guidance.lead(device, images, alone, guides_at((110, 95), (105, 108), move=(14, 9)), 2048.0)
    for one, other in zip(led, before, strict=True):
        assert np.array_equal(one.get(), other)
    assert caplog.messages == [
        f"guide {i} is ignored: one of the photos does not show the place" for i in (0, 1)
    ]


def test_outlier_is_named_and_ignored(device: Device, pair, caplog) -> None:
    images, alone, insides = pair("white")
    good, bad = ON_THE_THING, guides_at((128, 100), move=(-30, 20))
    more = guides_at((112, 110))
    guides = ChartGuides(
        np.concatenate([good.at_a, more.at_a, bad.at_a]),
        np.concatenate([good.at_b, more.at_b, bad.at_b]),
        ("one", "two", "three", "the wrong one"),
    )
    with caplog.at_level(logging.INFO, "hugin_abflow"):
        led = guidance.lead(device, images, alone, guides, 2048.0)
    assert any(
        m.startswith("the wrong one is ignored: its neighbours move otherwise") for m in caplog.messages
    )
    assert "3 of 4 control points of a pair lead its flow" in caplog.messages
    assert errors(led, insides)[0] < 1


def test_one_guide_alone_is_trusted(device: Device, pair) -> None:
    images, alone, _ = pair("white")
    led = guidance.lead(device, images, alone, guides_at((128, 100)), 2048.0)
    error = np.linalg.norm(led[0].get() - (MOVE, 0), axis=-1)
    assert error[95:106, 123:134].max() < 2


def test_guides_around_the_border_of_a_cylinder(device: Device) -> None:
    """The same scene, turned so that the border lies between its guides: the same flow, turned."""
    a, b = (np.pad(thing("white", s)[0], ((0, 0), (0, 83)), mode="reflect") for s in (0, MOVE))
    results = []
    for turn in (0, 256):
        images = tuple(level(device, log(np.roll(i, turn, 1)), None, True) for i in (a, b))
        at_a, at_b = (
            np.add(ends, (turn, 0)) % (384, 1000) for ends in (ON_THE_THING.at_a, ON_THE_THING.at_b)
        )
        alone = flow.pair_flow(device, *images)
        guides = ChartGuides(at_a, at_b, ("one", "two"), 384.0)
        led = guidance.lead(device, images, alone, guides, 2048.0, GuidanceParameters(spacing=2.0))
        results.append(np.roll(led[0].get(), -turn, 1))
    x, y = common.pixels(384, HEIGHT)
    inside = (np.abs(x + 0.5 - CENTRE[0]) < 34) & (np.abs(y + 0.5 - CENTRE[1]) < 60)
    for result in results:
        assert np.median(np.linalg.norm(result - (MOVE, 0), axis=-1)[inside]) < 1
    assert np.abs(results[0] - results[1]).max() < 0.1


@pytest.mark.parametrize("size", [(61, 47), (30, 26)])
def test_images_of_few_levels(device: Device, size: tuple[int, int]) -> None:
    """A chart so small that it has no coarse level starts on the one it has; ends may be outside of it."""
    width, height = size
    view = scene(7, 211.0)
    x, y = common.pixels(width, height)
    a, b = (log(view(x + 0.5 - s, y + 0.5)) * patches(s, width, height, 0.9) for s in (0, 12))
    images = level(device, a), level(device, b)
    alone = flow.pair_flow(device, *images)
    guides = ChartGuides(
        np.array([[20.0, 20], [-3, 5], [28, 900]]), np.array([[32.0, 20], [9, 5], [40, 900]]), ("a", "b", "c")
    )
    for field in guidance.lead(device, images, alone, guides, 2048.0, GuidanceParameters(agreement=0.0)):
        assert np.isfinite(field.get()).all()

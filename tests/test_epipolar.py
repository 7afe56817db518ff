"""Motion of what stands still, against points in space and cameras whose place is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hugin_abflow import epipolar

Points = np.ndarray


def unit(points: Points) -> Points:
    return points / np.linalg.norm(points, axis=-1, keepdims=True)


def seen(seed: int, count: int, move: Points, around: Points, nearest: float = 2.0) -> tuple[Points, Points]:
    """Directions before and after a camera's move of points within some 60 degrees of `around`."""
    rng = np.random.default_rng(seed)
    places = unit(around + 0.7 * rng.normal(size=(count, 3))) * rng.uniform(nearest, 9, (count, 1))
    return unit(places), unit(places - move)


@settings(max_examples=40)
@given(seed=st.integers(0, 10_000))
def test_the_move_is_found_among_things_that_move_otherwise(seed: int) -> None:
    """A fifth of the points moves at random, by as much as the others."""
    rng = np.random.default_rng(seed)
    move, around = (unit(rng.normal(size=3)) for _ in range(2))
    u, v = seen(seed, 1000, 0.1 * move, around)
    v[::5] = unit(u[::5] + 0.05 * rng.normal(size=(200, 3)))
    assert epipolar.move(u, v) @ move > np.cos(np.radians(3))


def test_still_points_move_along_whatever_their_distance() -> None:
    move = unit(np.array([0.3, -0.5, 0.2]))
    u, v = seen(1, 300, 0.2 * move, np.array([0, 1.0, 0]), nearest=0.5)
    assert epipolar.along(u, v, move).min() > 0.9
    assert epipolar.along(v, u, move).max() < -0.9
    assert not epipolar.along(u, u, move).any()


@pytest.mark.parametrize(
    ("direction", "expected"),
    [((1, 0, 0), True), ((-1, 0, 0), False), ((0, 0, 1), False), ((0, 0, -1), False)],
)
def test_what_walks_is_no_parallax(direction: tuple[float, float, float], expected: bool) -> None:
    """The camera moves left; what is found in front of it moves right, left, up, down, farther than all."""
    known = seen(2, 2000, np.array([-0.1, 0, 0]), np.array([0, 1.0, 0]))
    u, _ = seen(3, 300, np.zeros(3), np.array([0, 5.0, 0]))
    assert epipolar.parallax(known, (u, unit(u + 0.2 * np.array(direction))), either_way=True) is expected


@pytest.mark.parametrize(
    ("direction", "expected"),
    [((1, 0, 0), True), ((-1, 0, 0), True), ((0, 0, 1), False), ((0, 0, -1), False)],
)
def test_layers_aligned_on_what_is_near_move_both_ways(
    direction: tuple[float, float, float], expected: bool
) -> None:
    """The second photo is turned so far that half of what is known goes back; what is found may as well, but
    not up or down.
    """
    u, v = seen(2, 2000, np.array([-0.1, 0, 0]), np.array([0, 1.0, 0]))
    u, v = u[u[:, 1] > 0.9], v[u[:, 1] > 0.9]
    turn = -float(np.median(v[:, 0] - u[:, 0]))
    v = v @ np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1.0]])
    assert 0.4 < float((v[:, 0] > u[:, 0]).mean()) < 0.6
    near, _ = seen(3, 300, np.zeros(3), np.array([0, 5.0, 0]))
    assert epipolar.known_move(u, v) is None
    found = near, unit(near + 0.2 * np.array(direction))
    assert epipolar.parallax((u, v), found, either_way=True) is expected
    assert not epipolar.parallax((u, v), found, either_way=False)


def test_still_points_are_not_led_away() -> None:
    """Whatever their distance; for them all of their motion is along, and nothing of it for another move."""
    move = unit(np.array([0.3, -0.5, 0.2]))
    u, v = seen(1, 300, 0.1 * move, np.array([0, 1.0, 0]))
    motion = np.linalg.norm(v - u, axis=1)
    assert motion.max() > 0.04
    assert epipolar.across(u, v, move).max() < 1e-9
    assert epipolar.across(u, u, move).max() < 1e-12
    assert np.allclose(epipolar.across(v, u, move), motion, rtol=0.01)


@settings(max_examples=40)
@given(seed=st.integers(0, 10_000), size=st.floats(1e-4, 0.05), turn=st.floats(-np.pi, np.pi))
def test_what_leads_away_is_told_in_radians(seed: int, size: float, turn: float) -> None:
    """A step at an angle to the motion of still things: its sine, or all of it beyond a right angle."""
    rng = np.random.default_rng(seed)
    move = unit(rng.normal(size=3))
    u = unit(rng.normal(size=(100, 3)))
    u = u[np.abs(u @ move) < 0.95]
    still = unit(unit(u - 1e-3 * move) - u)
    beside = np.cross(u, still)
    v = unit(u + size * (np.cos(turn) * still + np.sin(turn) * beside))
    expected = size * (abs(np.sin(turn)) if abs(turn) < np.pi / 2 else 1)
    assert np.allclose(epipolar.across(u, v, move), expected, atol=2 * size**2 + 1e-3 * size)


def test_a_move_is_known_where_most_things_stand_still() -> None:
    """Not where nothing moves, where a third walks, or where few points are; of more than enough some do."""
    move = unit(np.array([0.3, -0.5, 0.2]))
    u, v = seen(1, 45_000, 0.1 * move, np.array([0, 1.0, 0]))
    rng = np.random.default_rng(2)
    v_lost = unit(u + 0.03 * rng.normal(size=u.shape))
    for share, expected in ((0.1, True), (0.33, False)):
        walks = rng.random(len(u)) < share
        found = epipolar.known_move(u, np.where(walks[:, None], v_lost, v))
        assert (found is not None) == expected
        assert found is None or found @ move > np.cos(np.radians(3))
    assert epipolar.known_move(u, u) is None
    assert epipolar.known_move(u[:199], v[:199]) is None
    for count in (200, 19_999, 20_001, 40_000):
        found = epipolar.known_move(u[:count], v[:count])
        assert found is not None and found @ move > np.cos(np.radians(3))


@pytest.mark.parametrize("turn", [0.0005, 0.002])
def test_a_turn_tells_no_move_whatever_is_near(turn: float) -> None:
    """Photos of what is far that are aligned a little wrongly, and a railing before it in a tenth of them."""
    rng = np.random.default_rng(7)
    far, _ = seen(8, 3000, np.zeros(3), np.array([0, 3.0, 0]))
    v = unit(far + np.cross(turn * unit(np.array([1.0, 0, 0.1])), far))
    v = unit(v + 0.05 * turn * rng.normal(size=v.shape))
    v[:300] = unit(far[:300] - 5 * turn * unit(np.array([0.3, 0, 0.9])))
    assert epipolar.known_move(far, v) is None
    # as much motion of what stands at several distances is a move
    move = unit(np.array([1.0, 0, 0.2]))
    u, v = seen(8, 3000, 5 * turn * move, np.array([0, 1.0, 0]))
    found = epipolar.known_move(u, unit(v + 0.02 * turn * rng.normal(size=v.shape)))
    assert found is not None and found @ move > np.cos(np.radians(5))


def test_an_unknown_move_proves_nothing() -> None:
    """All moves at random, or hardly anything is known."""
    rng = np.random.default_rng(4)
    u, v = seen(5, 2000, np.array([-0.1, 0, 0]), np.array([0, 1.0, 0]))
    found = (u[:300], v[:300])
    assert epipolar.parallax((u, v), found, either_way=True)
    assert not epipolar.parallax((u, unit(u + 0.05 * rng.normal(size=u.shape))), found, either_way=True)
    assert not epipolar.parallax((u[:150], v[:150]), found, either_way=True)
    assert not epipolar.parallax((u, v), (u[:0], v[:0]), either_way=True)


def test_what_stands_still_does_not_leave_its_way_however_near_it_is() -> None:
    """By up to an eighth of a turn: on the sphere its way is an arc, and a chord would leave it."""
    move = unit(np.array([0.3, -0.5, 0.2]))
    u, v = seen(6, 500, 0.7 * move, np.array([0, 1.0, 0]), nearest=0.75)
    assert np.arccos((u * v).sum(1)).max() > 0.8
    assert epipolar.across(u, v, move).max() < 1e-9

"""Motion of what stands still, for a camera that moved: epipolar geometry on the sphere, on the host.

A camera that moves towards the unit vector b without turning (the canvas has undone its turns) sees a still
point leave u for v on the great circle through u and b, away from b: b . (u x v) = 0, and v - u points along
(b . u) u - b (Longuet-Higgins, Prazdny, "The interpretation of a moving retinal image", 1980). Where both
photos show what did not move, b is found from the flow; somebody who walks moves as he likes.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Points = npt.NDArray[np.float64]

# Below which misfit nothing loses weight, from round to round: an angle times the root of the motion. Most
# count as fitting at first, so that a few which move otherwise cannot mislead the first guess.
_FITS = tuple(np.geomspace(0.2, 0.005, 20).tolist())
# Radians: what moves less does not move.
_NO_MOTION = 1e-6
# Fewer points than this say nothing about the move.
_LEAST = 200
# Radians by which well aligned photos are turned against each other at most, a sixth of a degree, and the
# share of motion that such a turn leaves at most: it left .28 in drawn overlaps, and other motion in those of
# real photos .36. A wall that the camera passes by 3 mm for each metre, or less, looks the same.
_TURNED, _LEFT = 0.003, 0.32
# More points than this, or about twice as many, say no more of a move, and of a turn, which is simpler.
_MOST, _MOST_TURNED = 20_000, 2_000
# The cosine of the angle by which motion may differ from that of still things.
_ALONG = 0.7
# The share that has to be still for the move to be known, and for motion to be taken for parallax.
_MOSTLY = 0.8


def move(u: Points, v: Points) -> Points:
    """The direction (3) in which the camera moved between seeing points at u and at v: (n, 3) unit vectors,
    n > 0. The sum of |b . (u x v)|, less for long motion, is least, and most points move away from it.
    """
    normals = np.cross(u, v)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), _NO_MOTION) ** 0.5
    weights = np.ones(len(u))
    for fits in _FITS:
        direction = np.linalg.eigh((normals * weights[:, None]).T @ normals).eigenvectors[:, 0]
        weights = 1 / np.maximum(np.abs(normals @ direction), fits)
    return direction if ((v - u) @ direction).sum() < 0 else -direction


def along(u: Points, v: Points, direction: Points) -> npt.NDArray[np.float64]:
    """Cosine (n) between the motion from u to v and that of still things, if the camera moved so; 0: none."""
    expected = _expected(u, direction)
    lengths = np.linalg.norm(v - u, axis=1) * np.linalg.norm(expected, axis=1)
    cosines: npt.NDArray[np.float64] = ((v - u) * expected).sum(1) / np.maximum(lengths, _NO_MOTION**2)
    return cosines


def _expected(u: Points, direction: Points) -> Points:
    """Where (n, 3) what stands still goes from u, if the camera moved so; not of length 1."""
    return (u @ direction)[:, None] * u - direction


def across(u: Points, v: Points, direction: Points) -> npt.NDArray[np.float64]:
    """How far (n), as the sine of an angle, motion from u to v leads away from that of still things, if the
    camera moved so; all of it where it points the other way.
    """
    motion = v - (u * v).sum(1, keepdims=True) * u  # along the sphere: however long, it has one direction
    expected = _expected(u, direction)
    expected /= np.maximum(np.linalg.norm(expected, axis=1, keepdims=True), _NO_MOTION)
    share = np.maximum((motion * expected).sum(1, keepdims=True), 0)
    return np.asarray(np.linalg.norm(motion - share * expected, axis=1))


def known_move(u: Points, v: Points) -> Points | None:
    """The camera's `move` that motion from u to v (n, 3) tells, if most of it is that of still things: what
    is far, and moves as photos do that are turned a little, tells none.
    """
    u, v = _some(u, v, _MOST)
    if len(u) < _LEAST or _is_turn(*_some(u, v, _MOST_TURNED)):
        return None
    direction = move(u, v)
    return direction if _mostly(along(u, v, direction)) else None


def _is_turn(u: Points, v: Points) -> bool:
    """Whether most of the motion is that of photos turned a little against each other: v - u = w x u."""
    motion = v - u
    axes = np.stack([np.cross(axis, u) for axis in np.eye(3)], axis=-1)  # (n, 3, 3): w x u is axes w
    turn, left = np.zeros(3), motion
    weights: Points = np.ones(len(u))
    for fits in _FITS:
        weighed = (weights[:, None, None] * axes).reshape(-1, 3)
        turn[:] = np.linalg.lstsq(weighed.T @ axes.reshape(-1, 3), weighed.T @ motion.ravel(), rcond=None)[0]
        left = motion - axes @ turn
        # rounds as for a move, but of so small turns: else near things would pull at them
        weights = 1 / np.maximum(np.linalg.norm(left, axis=1), fits * _TURNED)
    after, before = (float(np.median(np.linalg.norm(one, axis=1))) for one in (left, motion))
    return bool(np.linalg.norm(turn) < _TURNED) and after < _LEFT * before


def parallax(known: tuple[Points, Points], found: tuple[Points, Points], either_way: bool) -> bool:
    """Whether the motion in `found` is that of still things, for the camera's move that `known` tells; not so
    if it tells none. Each is where points are seen from the first and from the second place.

    either_way: layers that were aligned on what is near are turned against each other, so that what is
    farther goes the other way: if what is known does so, what is found may as well.
    """
    known = _some(*known, _MOST)
    if len(known[0]) < _LEAST or not len(found[0]):
        return False
    direction = move(*known)
    its, others = (along(*one, direction) for one in (found, known))
    if _mostly(others):
        return _mostly(its)
    return either_way and _mostly(abs(others)) and _mostly(abs(its))


def _some(u: Points, v: Points, most: int) -> tuple[Points, Points]:
    """Every so many points, such that `most` to twice as many are left, if there are so many."""
    step = max(1, len(u) // most)
    return u[::step], v[::step]


def _mostly(cosines: npt.NDArray[np.float64]) -> bool:
    """Whether most of what moves stands still, by what is `along`."""
    return float((cosines > _ALONG).mean()) >= _MOSTLY

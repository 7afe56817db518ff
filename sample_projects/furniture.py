"""What stands in the sample room: chairs, the table and its things, plants, lamps, books."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from sample_projects.tracer import Material as M
from sample_projects.tracer import Scene, rotation_x, rotation_z

Vector = npt.NDArray[np.float64]
HEIGHT = 2.65  # of the room
Colour = tuple[float, float, float]

OAK: Colour = (0.42, 0.24, 0.11)
WALNUT: Colour = (0.19, 0.095, 0.045)
PINE: Colour = (0.62, 0.42, 0.21)
WHITE: Colour = (0.78, 0.77, 0.74)
CREAM: Colour = (0.74, 0.66, 0.50)
BRASS: Colour = (0.55, 0.38, 0.12)
BLACK: Colour = (0.03, 0.03, 0.035)
GREEN: Colour = (0.10, 0.26, 0.06)

BOOKS: Sequence[Colour] = (
    (0.36, 0.06, 0.04), (0.05, 0.11, 0.24), (0.06, 0.17, 0.10), (0.50, 0.34, 0.10), (0.62, 0.55, 0.42),
    (0.16, 0.08, 0.05), (0.09, 0.26, 0.30), (0.52, 0.20, 0.06), (0.05, 0.05, 0.06), (0.30, 0.10, 0.16),
)  # fmt: skip


def ornament(scene: Scene, rng: np.random.Generator, x: float, y: float, z: float) -> None:
    colour, second = rng.uniform(0.08, 0.6, 3), rng.uniform(0.1, 0.7, 3)
    kind = rng.integers(3)
    if kind == 0:
        scene.rod((x, y, z), (x, y, z + 0.16), 0.035, M.CERAMIC, colour, second, end_radius=0.065)
    elif kind == 1:
        scene.ball((x, y, z + 0.075), 0.075, M.CERAMIC, colour, second)
    else:
        scene.box((x, y - 0.07, z), (x + 0.012, y + 0.07, z + 0.19), M.WOOD, WALNUT, turn=12)
        scene.box(
            (x - 0.002, y - 0.055, z + 0.015), (x + 0.01, y + 0.055, z + 0.175), M.PAINTING, WHITE, turn=12
        )


def books_pile(scene: Scene, rng: np.random.Generator, x: float, y: float, z: float) -> None:
    for k in range(4):
        colour = BOOKS[int(rng.integers(len(BOOKS)))]
        scene.box(
            (x - 0.09, y - 0.12, z),
            (x + 0.09, y + 0.12, z + 0.028),
            M.BOOK,
            colour,
            CREAM,
            turn=30 * np.sin(9 * k),
        )
        z += 0.028


def _leaves(
    scene: Scene, rng: np.random.Generator, root: Vector, count: int, reach: float, tall: float
) -> None:
    """Stalks that bow outwards, each with one leaf."""
    for k in range(count):
        a = 137.5 * k + rng.uniform(-20, 20)
        out = reach * rng.uniform(0.35, 1.0)
        up = tall * rng.uniform(0.35, 1.0) * (1.15 - 0.5 * out / reach)
        tip = root + np.array([out * np.cos(np.radians(a)), out * np.sin(np.radians(a)), up])
        bend = root + (tip - root) * np.array((0.45, 0.45, 0.75))
        radius = 0.0035 + 0.006 * reach
        scene.rod(root, bend, radius, M.PAINT, (0.14, 0.22, 0.05), texel=0.1)
        scene.rod(bend, tip, radius * 0.8, M.PAINT, (0.14, 0.22, 0.05), texel=0.1)
        size = reach * rng.uniform(0.24, 0.38)
        axes = rotation_z(a - 90) @ rotation_x(rng.uniform(-35, 20)) @ rotation_z(90)
        tone = np.array(GREEN) * rng.uniform(0.6, 1.5)
        centre = tip + axes[:, 0] * size * 0.6
        scene.ball(centre, (size, size * 0.42, 0.006), M.LEAF, tone, axes=axes, texel=0.05)


def plant(scene: Scene, rng: np.random.Generator, x: float, y: float) -> None:
    """A tall plant in a pot on the floor."""
    scene.rod(
        (x, y, 0), (x, y, 0.34), 0.14, M.CERAMIC, (0.50, 0.20, 0.10), (0.72, 0.50, 0.32), end_radius=0.19
    )
    scene.rod((x, y, 0.3), (x, y, 0.345), 0.17, M.PAINT, (0.06, 0.04, 0.03))
    scene.rod((x, y, 0.3), (x, y, 0.75), 0.018, M.WOOD, (0.25, 0.16, 0.08))
    _leaves(scene, rng, np.array([x, y, 0.45]), 16, 0.42, 0.6)
    _leaves(scene, rng, np.array([x, y, 0.75]), 16, 0.36, 0.75)


def pot_plant(scene: Scene, rng: np.random.Generator, x: float, y: float, z: float, size: float) -> None:
    colour = rng.uniform(0.15, 0.6, 3)
    scene.rod((x, y, z), (x, y, z + 1.7 * size), 0.75 * size, M.CERAMIC, colour, CREAM, end_radius=size)
    _leaves(scene, rng, np.array([x, y, z + 1.6 * size]), 9, 2.2 * size, 3.4 * size)


def floor_lamp(scene: Scene, x: float, y: float) -> None:
    scene.rod((x, y, 0), (x, y, 0.03), 0.15, M.PAINT, BLACK)
    scene.rod((x, y, 0), (x, y, 1.5), 0.012, M.PAINT, BLACK)
    scene.rod((x, y, 1.42), (x, y, 1.68), 0.2, M.GLOW, (1.5, 1.1, 0.66), end_radius=0.13)


def chair(scene: Scene, rng: np.random.Generator, x: float, y: float, turn: float) -> None:
    """A spindle-back chair; `turn` 0 has its back to the south."""
    wood = (OAK, WALNUT, PINE)[int(rng.integers(3))]
    frame = rotation_z(turn)

    def at(a: float, b: float, z: float) -> Vector:
        return np.asarray(frame @ np.array([a, b, 0]) + np.array([x, y, z]))

    for a in (-0.18, 0.18):
        scene.rod(at(1.12 * a, 0.21, 0), at(a, 0.18, 0.44), 0.011, M.WOOD, wood, end_radius=0.017)
        scene.rod(at(1.12 * a, -0.23, 0), at(a, -0.18, 0.44), 0.011, M.WOOD, wood, end_radius=0.017)
        scene.rod(at(a, -0.19, 0.44), at(a, -0.24, 0.92), 0.014, M.WOOD, wood)
        scene.rod(at(1.06 * a, 0.195, 0.2), at(1.06 * a, -0.205, 0.2), 0.009, M.WOOD, wood)
    scene.rod(at(-0.2, -0.0, 0.2), at(0.2, -0.0, 0.2), 0.008, M.WOOD, wood)
    seat = at(0, 0, 0.455)
    half = np.array([0.21, 0.205, 0.014])
    scene.box(seat - half, seat + half, M.WOOD, wood, turn=turn)
    scene.box(
        seat + np.array((-0.19, -0.18, 0.014)),
        seat + np.array((0.19, 0.18, 0.038)),
        M.CHECK,
        (0.62, 0.57, 0.46),
        (0.16, 0.24, 0.32),
        turn=turn,
    )
    for k in range(5):
        a = -0.12 + 0.06 * k
        scene.rod(at(a, -0.19, 0.46), at(a, -0.235, 0.86), 0.0065, M.WOOD, wood)
    back = at(0, -0.24, 0.89)
    half = np.array([0.205, 0.012, 0.045])
    scene.box(back - half, back + half, M.WOOD, wood, turn=turn, tilt=6)


def table(scene: Scene, rng: np.random.Generator, x: float, y: float) -> None:
    """Table, runner, and the near things on it: vase, fruit, cups, teapot, candle, an open book."""
    top = 0.76
    scene.box((x - 0.72, y - 0.45, top - 0.03), (x + 0.72, y + 0.45, top), M.WOOD, OAK, texel=0.008)
    scene.box((x - 0.62, y - 0.36, top - 0.1), (x + 0.62, y + 0.36, top - 0.03), M.WOOD, OAK)
    for a in (-0.64, 0.64):
        for b in (-0.37, 0.37):
            scene.rod((x + a, y + b, 0), (x + a, y + b, top - 0.03), 0.02, M.WOOD, OAK, end_radius=0.033)
    scene.box(
        (x - 0.16, y - 0.452, top),
        (x + 0.16, y + 0.452, top + 0.003),
        M.CHECK,
        (0.72, 0.68, 0.60),
        (0.15, 0.24, 0.42),
        texel=0.008,
    )
    _vase(scene, rng, x - 0.26, y - 0.22, top)
    _fruit(scene, rng, x + 0.03, y + 0.08, top)
    for a, b in ((0.36, -0.25), (-0.5, 0.16)):
        _cup(scene, rng, x + a, y + b, top)
    _teapot(scene, rng, x + 0.5, y + 0.08, top)
    for side in (-1, 1):
        scene.box(
            (x - 0.52 + side * 0.073 - 0.07, y - 0.27, top),
            (x - 0.52 + side * 0.073 + 0.07, y - 0.06, top + 0.012),
            M.PAGES,
            CREAM,
            turn=8,
            texel=0.02,
        )
    scene.rod((x + 0.2, y - 0.3, top), (x + 0.2, y - 0.3, top + 0.02), 0.045, M.PAINT, BRASS, end_radius=0.03)
    scene.rod((x + 0.2, y - 0.3, top + 0.02), (x + 0.2, y - 0.3, top + 0.2), 0.011, M.PAINT, CREAM)
    scene.ball((x + 0.2, y - 0.3, top + 0.215), (0.005, 0.005, 0.014), M.GLOW, (3.0, 1.9, 0.7))


def _vase(scene: Scene, rng: np.random.Generator, x: float, y: float, z: float) -> None:
    blue: Colour = (0.07, 0.14, 0.36)
    scene.rod((x, y, z), (x, y, z + 0.1), 0.038, M.CERAMIC, WHITE, blue, end_radius=0.065, texel=0.008)
    scene.rod((x, y, z + 0.1), (x, y, z + 0.17), 0.065, M.CERAMIC, WHITE, blue, end_radius=0.032, texel=0.008)
    scene.rod((x, y, z + 0.17), (x, y, z + 0.2), 0.032, M.PAINT, WHITE, end_radius=0.04, texel=0.008)
    for k in range(11):
        a, out = 2.4 * k, 0.03 + 0.085 * rng.random()
        tip = np.array([x + out * np.cos(a), y + out * np.sin(a), z + 0.30 + 0.17 * rng.random()])
        scene.rod((x, y, z + 0.15), tip, 0.0028, M.PAINT, GREEN, texel=0.05)
        bloom = [(0.75, 0.20, 0.10), (0.85, 0.62, 0.12), (0.70, 0.66, 0.62), (0.52, 0.14, 0.36)][k % 4]
        for petal in range(6):
            turn = rotation_z(60 * petal) @ rotation_x(25)
            scene.ball(tip + turn[:, 1] * 0.022, (0.011, 0.021, 0.004), M.PAINT, bloom, axes=turn, texel=0.02)
        scene.ball(tip + np.array((0, 0, 0.004)), 0.009, M.PAINT, (0.35, 0.22, 0.04))
        if k % 2:
            axes = rotation_z(50 * k) @ rotation_x(30)
            scene.ball(
                tip - np.array((0, 0, 0.1)) + axes[:, 0] * 0.04,
                (0.045, 0.013, 0.002),
                M.LEAF,
                GREEN,
                axes=axes,
            )


def _fruit(scene: Scene, rng: np.random.Generator, x: float, y: float, z: float) -> None:
    scene.rod(
        (x, y, z + 0.004),
        (x, y, z + 0.075),
        0.06,
        M.CERAMIC,
        (0.12, 0.30, 0.30),
        WHITE,
        end_radius=0.15,
        texel=0.01,
    )
    kinds = ((0.80, 0.30, 0.03), (0.55, 0.06, 0.04), (0.45, 0.50, 0.08), (0.78, 0.58, 0.06))
    for k, (a, b, c) in enumerate(
        (
            (0, 0, 0.1),
            (0.075, 0.02, 0.095),
            (-0.07, 0.03, 0.095),
            (0.01, -0.08, 0.095),
            (0.0, 0.08, 0.095),
            (0.03, 0.01, 0.15),
        )
    ):
        colour = kinds[int(rng.integers(4))] if k else kinds[0]
        scene.ball((x + a, y + b, z + c), 0.037 + 0.004 * (k % 2), M.PAINT, colour, texel=0.008)


def _cup(scene: Scene, rng: np.random.Generator, x: float, y: float, z: float) -> None:
    colour = rng.uniform(0.2, 0.75, 3)
    scene.rod((x, y, z), (x, y, z + 0.01), 0.045, M.PAINT, WHITE, end_radius=0.078, texel=0.01)
    scene.rod(
        (x, y, z + 0.01), (x, y, z + 0.075), 0.026, M.CERAMIC, WHITE, colour, end_radius=0.042, texel=0.008
    )
    scene.rod((x, y, z + 0.0751), (x, y, z + 0.0755), 0.037, M.PAINT, (0.10, 0.05, 0.02))
    last: Vector | None = None
    for k in range(7):
        a = np.radians(-90 + 30 * k)
        point = np.array([x + 0.034 + 0.026 * np.cos(a), y, z + 0.045 + 0.022 * np.sin(a)])
        if last is not None:
            scene.rod(last, point, 0.0045, M.PAINT, WHITE, texel=0.02)
        last = point


def _teapot(scene: Scene, rng: np.random.Generator, x: float, y: float, z: float) -> None:
    colour, second = (0.10, 0.22, 0.16), (0.65, 0.55, 0.32)
    scene.ball((x, y, z + 0.075), (0.095, 0.095, 0.075), M.CERAMIC, colour, second, texel=0.008)
    scene.rod((x - 0.07, y, z + 0.06), (x - 0.16, y, z + 0.13), 0.022, M.PAINT, colour, end_radius=0.011)
    scene.rod((x, y, z + 0.145), (x, y, z + 0.158), 0.045, M.PAINT, colour, end_radius=0.03)
    scene.ball((x, y, z + 0.17), 0.014, M.PAINT, second)
    last: Vector | None = None
    for k in range(9):
        a = np.radians(-110 + 27.5 * k)
        point = np.array([x + 0.085 + 0.045 * np.cos(a), y, z + 0.08 + 0.05 * np.sin(a)])
        if last is not None:
            scene.rod(last, point, 0.007, M.PAINT, colour, texel=0.03)
        last = point


def pendant(scene: Scene, x: float, y: float) -> None:
    """The lamp over the table, on its cable."""
    scene.rod((x, y, HEIGHT - 0.02), (x, y, HEIGHT), 0.05, M.PAINT, WHITE)
    scene.rod((x, y, 2.05), (x, y, HEIGHT), 0.0035, M.PAINT, BLACK)
    scene.rod((x, y, 1.9), (x, y, 2.06), 0.2, M.PAINT, (0.42, 0.12, 0.06), end_radius=0.05, texel=0.015)
    scene.ball((x, y, 1.87), 0.055, M.GLOW, (3.2, 2.6, 1.8))

"""The sample room: a sunny dining corner with shelves, sofa, stair and railing, a door, many thin things.

The camera stands near the origin at about 1.2 m, the table's vase 0.65 m away. `room(0)` is the room of the
sample projects; other seeds move the furniture and choose other colours, pictures and books.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sample_projects.furniture import (
    BLACK,
    BOOKS,
    BRASS,
    HEIGHT,
    OAK,
    PINE,
    WALNUT,
    WHITE,
    Colour,
    books_pile,
    chair,
    floor_lamp,
    ornament,
    pendant,
    plant,
    pot_plant,
    table,
)
from sample_projects.tracer import Material as M
from sample_projects.tracer import Scene, rotation_x, rotation_z

EAST, WEST, NORTH, SOUTH = 2.9, -2.7, 2.8, -2.6
EYE = (0.0, 0.0, 1.2)

WALLS: Sequence[tuple[Colour, Colour, Colour]] = (  # plain wall, wallpaper, its pattern
    ((0.48, 0.60, 0.58), (0.72, 0.66, 0.52), (0.30, 0.42, 0.33)),
    ((0.70, 0.58, 0.42), (0.52, 0.60, 0.66), (0.82, 0.80, 0.72)),
    ((0.62, 0.64, 0.52), (0.75, 0.60, 0.54), (0.45, 0.24, 0.22)),
)
FABRICS: Sequence[Colour] = ((0.10, 0.24, 0.34), (0.45, 0.15, 0.08), (0.20, 0.28, 0.14), (0.50, 0.36, 0.12))


def room(seed: int = 0) -> Scene:
    """The room with everything in it."""
    rng = np.random.default_rng(1000 + seed)
    jitter = 0.0 if seed == 0 else 0.12
    scene = Scene()
    walls = WALLS[seed % len(WALLS)]
    _shell(scene, walls)
    _window(scene, rng)
    _stair(scene)
    _door(scene)
    _shelves(scene, rng)
    _sofa(scene, rng, FABRICS[seed % len(FABRICS)])
    _pictures(scene, rng)
    plant(scene, rng, 2.35 + jitter * rng.uniform(-1, 1), 2.2)
    floor_lamp(scene, -2.3, 2.25)
    shift = jitter * rng.uniform(-1, 1, 2)
    _rug(scene, rng, 0.2 + shift[0], 0.7 + shift[1])
    table(scene, rng, 0.25 + shift[0], 1.15 + 0.5 * shift[1])
    for x, y, turn in ((-0.72, 1.2, 82), (1.25, 1.12, -75), (0.55, 1.95, 172), (0.62, 0.42, -12)):
        place = np.array([x, y]) + shift + jitter * rng.uniform(-0.5, 0.5, 2)
        place *= max(1.0, 0.72 / float(np.hypot(*place)))  # not nearer to the camera than that
        chair(scene, rng, place[0], place[1], turn + 25 * jitter * rng.uniform(-4, 4))
    pendant(scene, 0.3 + shift[0], 1.1 + shift[1])
    scene.sun((0.30, 1.0, 0.56), (7.5, 6.4, 4.9), 0.018)
    scene.window((0.2, NORTH + 0.02, 1.5), 1.08, 0.64, (5.5, 6.2, 7.0))
    scene.lamp((0.3 + shift[0], 1.1 + shift[1], 1.87), 0.11, (0.50, 0.37, 0.23))
    scene.lamp((-2.3, 2.25, 1.52), 0.22, (0.30, 0.21, 0.12))
    return scene


def _shell(scene: Scene, walls: tuple[Colour, Colour, Colour]) -> None:
    """Floor with the stair's opening, four walls, ceiling with beams, skirting."""
    plain, paper, pattern = walls
    scene.box((-1.0, SOUTH, -0.2), (EAST, NORTH, 0), M.PARQUET, (0.46, 0.27, 0.13), texel=0.016)
    scene.box((WEST, -1.15, -0.2), (-1.0, NORTH, 0), M.PARQUET, (0.46, 0.27, 0.13), texel=0.016)
    left, right, sill, lintel = -0.9, 1.3, 0.85, 2.15
    scene.box((WEST - 0.2, NORTH, -0.2), (left, NORTH + 0.25, HEIGHT), M.PLASTER, plain)
    scene.box((right, NORTH, -0.2), (EAST + 0.2, NORTH + 0.25, HEIGHT), M.PLASTER, plain)
    scene.box((left, NORTH, -0.2), (right, NORTH + 0.25, sill), M.PLASTER, plain)
    scene.box((left, NORTH, lintel), (right, NORTH + 0.25, HEIGHT), M.PLASTER, plain)
    scene.box((EAST, SOUTH, -0.2), (EAST + 0.2, NORTH, HEIGHT), M.PLASTER, plain)
    scene.box((WEST - 0.2, SOUTH, -2.2), (WEST, NORTH, HEIGHT), M.WALLPAPER, paper, pattern)
    scene.box((WEST, SOUTH - 0.2, -2.2), (EAST, SOUTH, HEIGHT), M.WALLPAPER, paper, pattern)
    scene.box((WEST - 0.2, SOUTH - 0.2, HEIGHT), (EAST + 0.2, NORTH + 0.2, HEIGHT + 0.1), M.PLASTER, WHITE)
    for y in (-1.9, -0.65, 0.6, 1.85):
        scene.box((WEST, y - 0.07, HEIGHT - 0.15), (EAST, y + 0.07, HEIGHT), M.WOOD, OAK)
    for low, high in (
        ((WEST, NORTH - 0.02, 0), (EAST, NORTH, 0.1)),
        ((EAST - 0.02, SOUTH, 0), (EAST, NORTH, 0.1)),
        ((WEST, -1.1, 0), (WEST + 0.02, NORTH, 0.1)),
        ((-1.0, SOUTH, 0), (EAST, SOUTH + 0.02, 0.1)),
    ):
        scene.box(low, high, M.PAINT, WHITE)


def _window(scene: Scene, rng: np.random.Generator) -> None:
    """Frame, sill with pots, curtains on a rod, radiator."""
    left, right, low, high, y = -0.9, 1.3, 0.85, 2.15, NORTH + 0.1
    for x in (left + 0.03, 0.2, right - 0.03):
        scene.box((x - 0.03, y, low), (x + 0.03, y + 0.06, high), M.PAINT, WHITE, texel=0.012)
    for z in (low + 0.03, 1.72, high - 0.03):
        scene.box((left, y + 0.002, z - 0.028), (right, y + 0.058, z + 0.028), M.PAINT, WHITE, texel=0.012)
    scene.box((left - 0.08, NORTH - 0.16, low - 0.035), (right + 0.08, NORTH + 0.1, low), M.WOOD, PINE)
    for x in (-0.65, 0.75, 1.0):
        pot_plant(scene, rng, x, NORTH - 0.05, low, 0.055)
    scene.rod((left - 0.5, NORTH - 0.1, 2.32), (right + 0.5, NORTH - 0.1, 2.32), 0.013, M.PAINT, BRASS)
    for side, start in ((-1, left + 0.02), (1, right - 0.02)):
        for k in range(8):
            x, depth = start + side * (0.03 + 0.058 * k), 0.028 * (1.5 if k % 2 else 0.9)
            top, foot = (x, NORTH - 0.1, 2.31), (x + side * 0.006 * k, NORTH - 0.09, 0.25)
            scene.rod(
                foot, top, 0.038, M.STRIPES, (0.70, 0.42, 0.22), (0.80, 0.70, 0.50), squash=depth / 0.038
            )
    for k in range(19):
        x = -0.5 + 0.075 * k
        scene.box((x, NORTH - 0.11, 0.16), (x + 0.05, NORTH - 0.03, 0.68), M.PAINT, WHITE, texel=0.05)
    scene.rod((-0.62, NORTH - 0.07, 0.2), (1.0, NORTH - 0.07, 0.2), 0.012, M.PAINT, WHITE)


def _stair(scene: Scene) -> None:
    """Steps that go down in the south-west corner, and the railing around them."""
    for k in range(8):
        x = -1.0 - 0.21 * k
        scene.box((x - 0.23, SOUTH, -0.19 * (k + 1) - 0.04), (x, -1.15, -0.19 * (k + 1)), M.WOOD, OAK)
        scene.box((x - 0.02, SOUTH, -0.19 * (k + 1)), (x, -1.15, -0.19 * k - 0.02), M.PAINT, WHITE)
    for x, y in ((-1.0, -1.15), (WEST + 0.05, -1.15), (-1.85, -1.15)):
        scene.box((x - 0.04, y - 0.04, 0), (x + 0.04, y + 0.04, 1.0), M.WOOD, WALNUT)
        scene.ball((x, y, 1.04), 0.045, M.WOOD, WALNUT)
    scene.box((WEST, -1.18, 0.88), (-1.0, -1.12, 0.93), M.WOOD, WALNUT)
    scene.box((WEST, -1.165, 0.1), (-1.0, -1.135, 0.13), M.WOOD, WALNUT)
    for k in range(15):
        x = -1.11 - 0.105 * k
        if abs(x + 1.85) > 0.05:
            scene.rod((x, -1.15, 0.12), (x, -1.15, 0.89), 0.011, M.PAINT, BLACK)
            scene.ball((x, -1.15, 0.5), (0.018, 0.018, 0.03), M.PAINT, BRASS)


def _door(scene: Scene) -> None:
    """A panelled door in the south wall, with frame and handle; a coat rack beside it."""
    left, right, top = 0.75, 1.65, 2.05
    y = SOUTH + 0.03
    scene.box((left, SOUTH - 0.01, 0), (right, y, top), M.PAINT, (0.24, 0.34, 0.33))
    for low, high in (
        ((left - 0.1, SOUTH, 0), (left, y + 0.02, top + 0.1)),
        ((right, SOUTH, 0), (right + 0.1, y + 0.02, top + 0.1)),
        ((left, SOUTH, top), (right, y + 0.02, top + 0.1)),
    ):
        scene.box(low, high, M.PAINT, WHITE)
    for x0, x1 in ((left + 0.1, left + 0.41), (left + 0.49, left + 0.8)):
        for z0, z1 in ((0.15, 0.7), (0.85, 1.5), (1.62, 1.93)):
            scene.box((x0, y, z0), (x1, y + 0.008, z1), M.PAINT, (0.28, 0.39, 0.37))
            scene.box(
                (x0 + 0.04, y, z0 + 0.04), (x1 - 0.04, y + 0.016, z1 - 0.04), M.PAINT, (0.23, 0.33, 0.32)
            )
    scene.rod((left + 0.07, y, 1.02), (left + 0.07, y + 0.06, 1.02), 0.009, M.PAINT, BRASS)
    scene.rod((left + 0.06, y + 0.055, 1.02), (left + 0.19, y + 0.055, 1.02), 0.009, M.PAINT, BRASS)
    scene.rod((1.2, SOUTH + 0.001, 2.37), (1.2, SOUTH + 0.04, 2.37), 0.16, M.CLOCK, BLACK)
    scene.box((1.95, SOUTH, 1.66), (2.75, SOUTH + 0.03, 1.76), M.WOOD, PINE)
    for k in range(5):
        x = 2.05 + 0.15 * k
        scene.rod((x, SOUTH + 0.03, 1.7), (x, SOUTH + 0.11, 1.73), 0.009, M.PAINT, BRASS)
    scene.ball((2.2, SOUTH + 0.13, 1.28), (0.16, 0.08, 0.42), M.WEAVE, (0.30, 0.06, 0.05))
    scene.ball(
        (2.52, SOUTH + 0.12, 1.36), (0.11, 0.07, 0.34), M.CHECK, (0.12, 0.16, 0.26), (0.45, 0.42, 0.36)
    )
    for x in (2.15, 2.42):
        scene.ball((x, SOUTH + 0.16, 0.06), (0.05, 0.13, 0.06), M.PAINT, (0.14, 0.06, 0.03))


def _shelves(scene: Scene, rng: np.random.Generator) -> None:
    """Bookshelf along the east wall: books in all colours, a few ornaments."""
    y0, y1, depth, top = -1.3, 1.35, 0.29, 2.06
    x = EAST - depth
    scene.box((EAST - 0.012, y0, 0.03), (EAST - 0.001, y1, top), M.WOOD, PINE)
    for y in (y0, (2 * y0 + y1) / 3, (y0 + 2 * y1) / 3, y1):
        scene.box((x, y - 0.014, 0), (EAST, y + 0.014, top), M.WOOD, PINE)
    levels = [0.06, 0.46, 0.82, 1.16, 1.5, 1.8]
    for z in [*levels, top]:
        scene.box((x, y0, z - 0.022), (EAST - 0.002, y1, z), M.WOOD, PINE)
    for z, above in zip(levels, [*levels[1:], top], strict=True):
        for bay in range(3):
            y = y0 + (y1 - y0) * bay / 3 + 0.02
            end = y0 + (y1 - y0) * (bay + 1) / 3 - 0.02
            stop = end - rng.choice([0.0, 0.0, 0.25, 0.4])
            while y < stop - 0.05:
                thick, tall = rng.uniform(0.018, 0.05), rng.uniform(0.55, 0.9) * (above - z - 0.03)
                hue = np.array(BOOKS[int(rng.integers(len(BOOKS)))]) * rng.uniform(0.5, 1.3)
                ink = (0.7, 0.6, 0.35) if hue.sum() < 0.9 else (0.06, 0.05, 0.05)
                lean = rng.uniform(0, 0.05)
                scene.box(
                    (x + 0.02 + lean, y, z), (x + 0.21, y + thick, z + tall), M.BOOK, hue, ink, texel=0.06
                )
                y += thick + rng.choice([0.001, 0.001, 0.004])
            if end - y > 0.16:
                ornament(scene, rng, x + 0.12, (y + end) / 2, z)


def _sofa(scene: Scene, rng: np.random.Generator, fabric: Colour) -> None:
    """Sofa at the west wall with cushions and a side table."""
    x, y0, y1 = WEST + 0.04, -0.55, 1.45
    dark = tuple(0.75 * c for c in fabric)
    scene.box((x, y0, 0.1), (x + 0.85, y1, 0.3), M.WEAVE, dark)
    for a, b in ((y0 + 0.16, 0.44), (0.46, y1 - 0.16)):
        scene.box((x + 0.18, a, 0.3), (x + 0.88, b, 0.44), M.WEAVE, fabric)
        scene.box((x + 0.14, a, 0.44), (x + 0.3, b, 0.82), M.WEAVE, fabric, tilt=0)
    scene.box((x, y0, 0.3), (x + 0.16, y1, 0.8), M.WEAVE, dark)
    for y in (y0, y1 - 0.15):
        scene.box((x, y, 0.3), (x + 0.85, y + 0.15, 0.56), M.WEAVE, dark)
        scene.rod((x, y + 0.075, 0.57), (x + 0.86, y + 0.075, 0.57), 0.085, M.WEAVE, dark)
        for leg in (x + 0.08, x + 0.78):
            scene.rod((leg, y + 0.07, 0), (leg, y + 0.07, 0.1), 0.02, M.WOOD, WALNUT)
    kinds = [
        (M.CHECK, (0.62, 0.55, 0.42), (0.45, 0.10, 0.06)),
        (M.STRIPES, (0.72, 0.50, 0.12), (0.75, 0.7, 0.6)),
    ]
    for k, y in enumerate((-0.18, 0.12, 0.95, 1.14)):
        material, colour, second = kinds[k % 2]
        axes = rotation_z(90 + rng.uniform(-14, 14)) @ rotation_x(rng.uniform(12, 24))
        scene.ball((x + 0.38, y, 0.63), (0.21, 0.075, 0.20), material, colour, second, axes=axes)
    scene.rod((x + 0.35, y1 + 0.4, 0.5), (x + 0.35, y1 + 0.4, 0.525), 0.24, M.WOOD, OAK)
    for k in range(3):
        a = 2.1 * k
        foot = (x + 0.35 + 0.2 * np.cos(a), y1 + 0.4 + 0.2 * np.sin(a), 0.0)
        scene.rod(foot, (x + 0.35, y1 + 0.4, 0.5), 0.012, M.WOOD, OAK)
    books_pile(scene, rng, x + 0.35, y1 + 0.35, 0.525)


def _pictures(scene: Scene, rng: np.random.Generator) -> None:
    """Framed pictures on the west, south and north walls."""
    for y, z, w, h in (
        (-0.72, 1.62, 0.30, 0.40),
        (0.05, 1.55, 0.62, 0.46),
        (0.80, 1.68, 0.34, 0.46),
        (1.32, 1.5, 0.3, 0.24),
    ):
        frame = WALNUT if rng.random() < 0.5 else BRASS
        scene.box(
            (WEST, y - w / 2 - 0.03, z - h / 2 - 0.03),
            (WEST + 0.02, y + w / 2 + 0.03, z + h / 2 + 0.03),
            M.WOOD,
            frame,
        )
        scene.box((WEST, y - w / 2, z - h / 2), (WEST + 0.023, y + w / 2, z + h / 2), M.PAINTING, WHITE)
    for x, z, w, h in (
        (-2.0, 1.45, 0.5, 0.66),
        (-1.28, 1.62, 0.4, 0.3),
        (-1.25, 1.18, 0.34, 0.34),
        (-0.2, 1.55, 0.9, 0.62),
    ):
        scene.box(
            (x - w / 2 - 0.03, SOUTH, z - h / 2 - 0.03),
            (x + w / 2 + 0.03, SOUTH + 0.02, z + h / 2 + 0.03),
            M.WOOD,
            WALNUT,
        )
        scene.box((x - w / 2, SOUTH, z - h / 2), (x + w / 2, SOUTH + 0.023, z + h / 2), M.PAINTING, WHITE)
    scene.box((-0.65, SOUTH, 0.42), (0.45, SOUTH + 0.38, 0.82), M.WOOD, OAK)
    for x in (-0.6, 0.4):
        scene.rod((x, SOUTH + 0.33, 0), (x, SOUTH + 0.33, 0.42), 0.016, M.WOOD, OAK)
        scene.rod((x, SOUTH + 0.05, 0), (x, SOUTH + 0.05, 0.42), 0.016, M.WOOD, OAK)
    for x in (-0.64, -0.09):
        scene.box((x, SOUTH + 0.38, 0.44), (x + 0.53, SOUTH + 0.39, 0.8), M.WOOD, OAK)
        scene.ball((x + 0.26, SOUTH + 0.4, 0.7), 0.016, M.PAINT, BRASS)
    ornament(scene, rng, -0.45, SOUTH + 0.2, 0.82)
    pot_plant(scene, rng, 0.25, SOUTH + 0.2, 0.82, 0.075)
    books_pile(scene, rng, -0.1, SOUTH + 0.18, 0.82)
    for k, x in enumerate((1.85, 2.35)):
        scene.box((x - 0.2, NORTH - 0.02, 1.5), (x + 0.2, NORTH, 2.02), M.WOOD, BRASS if k else WALNUT)
        scene.box((x - 0.17, NORTH - 0.023, 1.53), (x + 0.17, NORTH - 0.01, 1.99), M.PAINTING, WHITE)


def _rug(scene: Scene, rng: np.random.Generator, x: float, y: float) -> None:
    colour = rng.uniform((0.20, 0.035, 0.035), (0.27, 0.075, 0.06))
    scene.box(
        (x - 1.45, y - 1.15, 0),
        (x + 1.45, y + 1.15, 0.012),
        M.RUG,
        colour,
        (0.09, 0.15, 0.24),
        turn=4,
        texel=0.018,
    )

"""People who move: ``python benchmarks/crowds.py --scenes 40``

Drawn streets of which two photos overlap by a quarter to a half. People stand there, take a step, are
somewhere else in the other photo, or in one alone; what is behind them is the same in both. Blended by
hugin-abflow and enblend. Prints a Markdown table with how many people there are whom an overlap shows a part
of, and how many of these are cut (the picture shows a part of what a photo shows of them, or any of whom a
photo cuts itself), there twice, and gone; and the share of what both photos show alike, %, that the picture
shows otherwise: bent paving. With --keep, layers and panoramas are left in that folder.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import tifffile

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.rigs import write_layer
from benchmarks.stereo import blend, write_project

Floats = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.intp]

_WIDTH, _HEIGHT = 1200, 700
_TIMES = 2  # drawn larger by so much, for smooth outlines
_DARK = ((28, 25, 25), (30, 35, 40), (55, 30, 30), (20, 20, 20), (45, 45, 50), (40, 50, 60))
_BRIGHT = ((180, 190, 200), (170, 60, 60), (60, 120, 180), (90, 160, 150), (190, 170, 90), (150, 60, 120))
_SKIN = ((215, 170, 140), (190, 140, 110), (140, 95, 70))
_HAIR = ((25, 20, 20), (70, 45, 30), (130, 110, 90), (200, 160, 60))
# Of what a photo shows of somebody, so much is nothing, and so much all; levels that tell two photos apart,
# that leave them the same, or that show a picture to be something else; and pixels of somebody who counts.
_NOTHING, _ALL = 0.1, 0.9
_TELLS, _SAME, _OTHER = 14.0, 8.0, 14.0
_LEAST = 100


@dataclass(frozen=True)
class Person:
    """Somebody in two photos: feet at (x, y), px; None: not there. seed: of colours and build."""

    places: tuple[tuple[float, float] | None, tuple[float, float] | None]
    height: float
    seed: int


@dataclass(frozen=True)
class Scene:
    """Two photos, uint8 (height, width, 3) of the whole canvas, of which each shows the columns from `start`
    to `end`, and the numbers of the people that they show, 0: none.
    """

    photos: tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]
    people: tuple[Numbers, Numbers]
    columns: tuple[slice, slice]


def _noise(rng: np.random.Generator, height: int, width: int) -> Floats:
    """Clouds of a few sizes, at most 1."""
    result = np.zeros((height, width))
    for octave in range(2, 7):
        rows, columns = 2**octave, 2**octave * width // height
        some = rng.normal(size=(rows, columns)) * 0.55**octave
        result += cv2.resize(some, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(result / np.abs(result).max())


def _street(rng: np.random.Generator) -> tuple[Floats, int]:
    """A wall with things on it, and paving below: (height, width, 3), levels, and where the paving begins."""
    height, width = _HEIGHT * _TIMES, _WIDTH * _TIMES
    horizon = int(height * rng.uniform(0.3, 0.45))
    picture = np.tile(rng.uniform(90, 190, 3), (height, width, 1))
    for _ in range(rng.integers(5, 12)):
        x, y = rng.integers(0, width), rng.integers(0, horizon - 100)
        picture[y : min(y + rng.integers(60, 220), horizon), x : x + rng.integers(40, 200)] = rng.uniform(
            20, 120, 3
        )
    grey = rng.uniform(45, 130)
    picture[horizon:] = grey
    for k in range(1, 40):
        row = int(horizon + (height - horizon) * (k / 40) ** 1.7)
        cv2.line(picture, (0, row), (width, row), (0.6 * grey,) * 3, 2)
    for k in range(-60, 60):
        cv2.line(
            picture, (width // 2 + k * 30, horizon), (width // 2 + k * 220, height), (0.65 * grey,) * 3, 2
        )
    texture = (1 + 0.18 * _noise(rng, height, width)) * (1 + 0.05 * rng.normal(size=(height, width)))
    return np.clip(picture * texture[..., None], 0, 255), horizon


def _draw(picture: Floats, people: Numbers, person: Person, index: int, number: int) -> None:
    """Draw somebody as a photo shows him, over what is there."""
    place = person.places[index]
    if place is None:
        return
    rng, tall, (x, y) = np.random.default_rng(person.seed), person.height, place
    legs, top = (
        np.array((_DARK if rng.random() < share else _BRIGHT)[rng.integers(6)]) for share in (0.7, 0.55)
    )
    skin, hair = np.array(_SKIN[rng.integers(3)]), np.array(_HAIR[rng.integers(4)])
    wide, step = 0.11 * tall * rng.uniform(0.85, 1.2), (1.0, -0.6)[index] * tall * rng.uniform(-0.1, 0.1)
    hip, shoulder = y - 0.48 * tall, y - 0.83 * tall
    left, above = max(int(x - 0.45 * tall), 0), max(int(y - 1.05 * tall), 0)
    around = np.s_[above : int(y) + 2, left : max(int(x + 0.45 * tall), 0)]
    drawn = picture[around].copy()
    mask = np.zeros(drawn.shape[:2], np.uint8)
    if not mask.size:
        return

    def fill(points: list[tuple[float, float]], colour: npt.NDArray[np.float64]) -> None:
        corners = np.round(np.array(points) - (left, above)).astype(np.int32)
        cv2.fillPoly(drawn, [corners], colour.astype(float).tolist(), cv2.LINE_AA)
        cv2.fillPoly(mask, [corners], 255)

    def ellipse(dx: float, up: float, a: float, b: float, colour: npt.NDArray[np.float64]) -> None:
        turns = np.linspace(0, 2 * np.pi, 40)
        fill([(x + dx + a * np.cos(t), y - up + b * np.sin(t)) for t in turns], colour)

    for side in (-1, 1):
        at, foot = x + side * 0.02 * tall, x + side * step
        fill(
            [(at - wide / 2, hip), (at + wide / 2, hip), (foot + 0.4 * wide, y), (foot - 0.3 * wide, y)], legs
        )
    below = hip + 0.03 * tall
    fill(
        [
            (x - 1.05 * wide, below),
            (x + 1.05 * wide, below),
            (x + 1.25 * wide, shoulder),
            (x - 1.25 * wide, shoulder),
        ],
        top,
    )
    for side in (-1, 1):
        out = x + side * (1.5 * wide + 0.4 * abs(step))
        upper = [(x + side * 1.1 * wide, shoulder), (x + side * 1.55 * wide, shoulder + 0.03 * tall)]
        fill([*upper, (out, hip + 0.02 * tall), (x + side * 1.15 * wide, hip)], 0.9 * top)
    neck = shoulder - 0.04 * tall
    fill([(x - 0.3 * wide, neck), (x + 0.3 * wide, neck), (x + 0.35 * wide, below - 0.3 * tall)], skin)
    ellipse(0, 0.915 * tall, 0.052 * tall, 0.072 * tall, hair)
    ellipse(0.012 * tall, 0.9 * tall, 0.04 * tall, 0.055 * tall, skin)
    rows, columns = np.nonzero(mask)
    if rows.size:
        box = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
        size = drawn[box].shape[1::-1]
        cloth = 1 + 0.14 * cv2.resize(rng.normal(size=(24, 12)), size, interpolation=cv2.INTER_CUBIC)
        drawn[box] = np.where(
            mask[box][..., None] > 0, np.clip(drawn[box] * cloth[..., None], 0, 255), drawn[box]
        )
    picture[around] = drawn
    people[around][mask > 0] = number


def draw(seed: int) -> Scene:
    """A street and the people in it."""
    rng = np.random.default_rng(seed)
    street, horizon = _street(rng)
    overlap, width = rng.uniform(0.25, 0.5), _WIDTH * _TIMES
    people = []
    for _ in range(rng.integers(4, 16)):
        y = horizon + (_HEIGHT * _TIMES - horizon) * (0.05 + 1.05 * rng.random() ** 1.5)
        tall = (y - horizon) * rng.uniform(0.75, 0.95) + 60
        x, kind = rng.uniform(0.2, 0.8) * width, rng.random()
        step = rng.choice([-1, 1]) * rng.uniform(0.1, 1.5) * 0.6 * tall
        other = x if kind < 0.2 else x + step if kind < 0.6 else rng.uniform(0.2, 0.8) * width
        there = (True, True) if rng.random() < 0.7 else (True, False) if rng.random() < 0.5 else (False, True)
        places = ((x, y) if there[0] else None, (other, y) if there[1] else None)
        people.append((y, Person(places, tall, int(rng.integers(1 << 30)))))
    people.sort(key=lambda one: one[0])
    photos, shown = [], []
    for index in (0, 1):
        picture, numbers = street.copy(), np.zeros(street.shape[:2], np.intp)
        for number, (_, person) in enumerate(people, 1):
            _draw(picture, numbers, person, index, number)
        small = cv2.resize(picture, (_WIDTH, _HEIGHT), interpolation=cv2.INTER_AREA)
        small = (small + 1.5 * rng.normal(size=small.shape)) * (rng.uniform(0.92, 1.08) if index else 1)
        photos.append(np.clip(np.rint(small), 0, 255).astype(np.uint8))
        shown.append(numbers[_TIMES // 2 :: _TIMES, _TIMES // 2 :: _TIMES])
    ends = round(_WIDTH * (0.5 - overlap / 2)), round(_WIDTH * (0.5 + overlap / 2))
    return Scene((photos[0], photos[1]), (shown[0], shown[1]), (slice(0, ends[1]), slice(ends[0], _WIDTH)))


def make_set(folder: Path, scene: Scene) -> None:
    """Layers of a scene and their project."""
    for index, (photo, columns) in enumerate(zip(scene.photos, scene.columns, strict=True)):
        pixels: npt.NDArray[np.uint8] = np.dstack([photo, np.full(photo.shape[:2], 255, np.uint8)])[
            :, columns
        ]
        write_layer(folder / f"layer{index:04d}.tif", pixels, columns.start, 0, _WIDTH, _HEIGHT)
    write_project(folder, (_WIDTH, _HEIGHT), (_WIDTH, _HEIGHT))


def judge(scene: Scene, panorama: npt.NDArray[np.uint8]) -> tuple[int, int, int, int, float]:
    """People, those cut, there twice, and gone; and the share that is bent, %. panorama: r, g, b."""
    first, second = (_smooth(photo) for photo in scene.photos)
    covered = [np.zeros(first.shape[:2], bool) for _ in range(2)]
    for one, columns in zip(covered, scene.columns, strict=True):
        one[:, columns] = True
    both = covered[0] & covered[1]
    gain = float(np.median(second[both].sum(1) / np.maximum(first[both].sum(1), 1)))
    apart = np.abs(first - second / gain).max(2)
    # exposure may be left as it is, or halfway between the photos'
    off = [
        np.min([np.abs(_smooth(panorama) - one * part).max(2) for part in (1, gain**power)], 0)
        for one, power in ((first, 0.5), (second, -0.5))
    ]
    calm = cv2.erode((both & (apart < _SAME)).astype(np.uint8), np.ones((7, 7))) > 0
    bent = 100 * float((np.minimum(*off) > _OTHER)[calm].mean()) if calm.any() else 0.0
    tells = ~both | (apart > _TELLS)
    shares: dict[tuple[int, int], tuple[float, bool]] = {}
    for index, edge in ((0, scene.columns[0].stop - 1), (1, scene.columns[1].start)):
        shows = covered[index] & (~both | (off[index] < off[1 - index]))
        for number in np.unique(scene.people[index])[1:]:
            its = (scene.people[index] == number) & covered[index]
            told = its & tells
            if (its & both).any() and np.count_nonzero(told) >= _LEAST:
                framed = bool(np.count_nonzero(its[:, edge]) > 3)
                shares[int(number), index] = float(shows[told].mean()), framed
    numbers = {number for number, _ in shares}
    found = [[shares[n, index] for index in (0, 1) if (n, index) in shares] for n in numbers]
    cut = [
        any((share > _NOTHING) if framed else (_NOTHING < share < _ALL) for share, framed in one)
        for one in found
    ]
    twice = [len(one) == 2 and all(share > _ALL for share, _ in one) for one in found]
    gone = [all(share < _NOTHING for share, _ in one) for one in found]
    return len(numbers), sum(cut), sum(twice), sum(gone), bent


def _smooth(picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    return np.asarray(cv2.blur(picture.astype(np.float32), (3, 3)))


def run(seeds: range, options: list[str], keep: Path) -> None:
    """A table of both blenders, over all scenes."""
    totals = {name: np.zeros(5) for name in ("hugin-abflow", "enblend")}
    for seed in seeds:
        folder, scene = keep / f"crowd{seed}", draw(seed)
        folder.mkdir(parents=True, exist_ok=True)
        make_set(folder, scene)
        for name, total in totals.items():
            total += judge(scene, tifffile.imread(blend(folder, name, options))[..., :3])
        print(f"{folder.name} of {len(seeds)}", file=sys.stderr)
    print("| blender | people | cut | twice | gone | bent % |\n|---|---|---|---|---|---|")
    for name, total in totals.items():
        print(f"| {name} | {' | '.join(f'{n:.0f}' for n in total[:4])} | {total[4] / len(seeds):.3f} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=40, help="how many")
    parser.add_argument("--first", type=int, default=0, help="the first one's seed")
    parser.add_argument("--options", default="", help="of hugin-abflow, such as '--no-flow'")
    parser.add_argument("--keep", type=Path, help="where layers and panoramas are left")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        keep = (given.keep or Path(folder)).resolve()
        run(range(given.first, given.first + given.scenes), given.options.split(), keep)


if __name__ == "__main__":
    main()

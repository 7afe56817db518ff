"""Whole panoramas in which somebody took a step while the camera moved: he is shown once, unbent."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from pictures import masked, merged, one_device, pixel_places
from reference import common
from rooms import ROOM, Thing, hit, pattern, unit
from scipy import ndimage

from hugin_abflow import joint, movers, multiband, regions, seam
from hugin_abflow.content import Unlike
from hugin_abflow.guides import Guide
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.opencl import Device
from hugin_abflow.progress import silent
from hugin_abflow.settings import Settings

WIDTH, HEIGHT = 960, 480
CANVAS = Canvas.sphere(WIDTH, HEIGHT)
SCALE = WIDTH / (2 * np.pi)  # px per radian
MOVE = np.array([-0.12, 0, 0])
# Somebody who rises by half of his own width, some 23 px, and a column that is nearer than all else.
PERSON = Thing((0, 1, 0.05), np.array([0, 0, 0.3]), 0.15, 2.0)
COLUMN = Thing((-0.45, 1, -0.3), 0 * MOVE, 0.15, 1.2)


@dataclass(frozen=True)
class Shoot:
    """Two photos on the canvas, uint8 (height, width, 4); the pixels that show the person; their layers."""

    photos: tuple[np.ndarray, np.ndarray]
    person: tuple[np.ndarray, np.ndarray]
    layers: tuple[Layer, Layer]


def shoot(person: Thing | None, turned: int = 0) -> Shoot:
    """Photos that overlap around column 480 + turned, by some 110 degrees."""
    rows, columns = pixel_places(HEIGHT, WIDTH)
    rays = common.canvas_point(columns + 0.5, rows + 0.5, (-np.pi, 1 / SCALE, np.pi / 2, 1 / SCALE))
    photos, places, layers = [], [], []
    for second, covered in ((False, (180, 630)), (True, (330, 780))):
        points = hit(ROOM, MOVE * second, rays)
        colours = np.exp(pattern(unit(points), 1, SCALE))[..., None] * [60.0, 80.0, 90.0]
        place = np.zeros((HEIGHT, WIDTH), bool)
        for thing, paint in ((COLUMN, [50.0, 50.0, 60.0]), (person, [110.0, 50.0, 30.0])):
            if thing is not None:
                points, place = thing.seen(MOVE * second, rays, second)
                own = np.exp(pattern(unit(points), 2, SCALE))[..., None] * paint
                colours = np.where(place[..., None], own, colours)
        photo = np.full((HEIGHT, WIDTH, 4), 255, np.uint8)
        photo[..., :3] = np.clip(np.rint(colours), 0, 255)
        mask = (np.abs(rows - 240) < 120) & (columns >= covered[0]) & (columns < covered[1])
        photos.append(np.roll(photo, turned, 1))
        places.append(np.roll(place & mask, turned, 1))
        layers.append(masked(photos[-1], np.roll(mask, turned, 1)))
    return Shoot(tuple(photos), tuple(places), tuple(layers))


def aligned(result: np.ndarray, photo: np.ndarray, place: np.ndarray) -> tuple[float, int, int]:
    """How far the result differs from what a photo shows in a place, moved by as many rows and columns as are
    best, in levels."""
    rows, columns = np.nonzero(place)
    own, result = photo[rows, columns, :3].astype(int), result[..., :3].astype(int)
    return min(
        (float(np.abs(result[rows + down, (columns + right) % WIDTH] - own).mean()), down, right)
        for down in range(-3, 4)
        for right in range(-8, 9)
    )


def red(picture: np.ndarray) -> int:
    """Pixels of the person's colour."""
    return int(((picture[..., 0] > 1.5 * picture[..., 2]) & (picture[..., 3] > 0)).sum())


def best(result: np.ndarray, of: Shoot) -> tuple[tuple[float, int, int], int]:
    """How the result shows the person if it is as a photo does, and which."""
    both = enumerate(zip(of.photos, of.person, strict=True))
    return min((aligned(result, *its), number) for number, its in both)


# Photos are sampled between pixels, and their waves are 9 px long; levels.
WHOLE = 8


def beside_him(
    result: np.ndarray, one: Shoot, order: slice = slice(None), turned: int = 0, **chosen: float
) -> int:
    """Pixels within his own width of the person that are clearly other than they would be without him.
    Farther off, at outlines of what is near, the least change of flow shows: there are few, too."""
    (_, down, right), number = best(result, one)
    empty = merged(shoot(None, turned).layers[order], CANVAS, **chosen)
    assert (result[..., 3] == empty[..., 3]).all()
    his = np.tile(np.roll(one.person[number], (down, right), (0, 1)), 3)
    away = ndimage.distance_transform_edt(~his)[:, WIDTH : 2 * WIDTH]
    off = np.abs(result[..., :3].astype(int) - empty[..., :3]).max(-1) > 20
    assert off[away >= 45].sum() < 2 * FEW
    return int(off[(away > 3) & (away < 45)].sum())


# Pixels; next to nothing, beside some 1600 of himself.
FEW = 40


@pytest.mark.usefixtures(one_device.__name__)
@pytest.mark.parametrize(("turned", "order"), [(0, slice(None)), (480, slice(None, None, -1))])
def test_who_took_a_step_is_shown_once_and_unbent(turned: int, order: slice) -> None:
    """As one photo shows him, pixel by pixel, where what is behind him is; and beside him is what there would
    be without him. Across the canvas's border as well, and whichever layer is the first."""
    one = shoot(PERSON, turned)
    result = merged(one.layers[order], CANVAS)
    assert best(result, one)[0][0] < WHOLE
    sizes = [int(place.sum()) for place in one.person]
    assert 0.95 * min(sizes) < red(result) < 1.1 * max(sizes)
    assert beside_him(result, one, order, turned) < FEW


@pytest.mark.usefixtures(one_device.__name__)
def test_what_is_beside_him_would_be_bent(monkeypatch: pytest.MonkeyPatch) -> None:
    """The checks above can fail. Without regions that layers differ in, and transitions that are led around
    him, to look for him is what keeps him whole; without that he is bent, and so is what is beside him.
    """
    one = shoot(PERSON)
    monkeypatch.setattr(regions, "_LEAST", np.inf)
    published = {"transition_strain": 0.0}
    assert best(merged(one.layers, CANVAS, **published), one)[0][0] < WHOLE
    monkeypatch.setattr(movers, "find", lambda *_: None)
    bent = merged(one.layers, CANVAS, **published)
    assert best(bent, one)[0][0] > 2 * WHOLE and beside_him(bent, one, **published) > 5 * FEW


def test_his_place_is_known_wherever_it_matters(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where regions are looked for and cut, and where low frequencies are blended: the same cells, which he
    fills in one photo or the other."""
    one, seen = shoot(PERSON), {}

    def listen(module, name: str) -> None:
        original = getattr(module, name)

        def remember(*given, **named):
            last = given[3] if name == "cut" else named.get("single", given[-1])
            seen[name] = last.moved > 0 if isinstance(last, Unlike) else last
            return original(*given, **named)

        monkeypatch.setattr(module, name, remember)

    for module, name in ((seam, "regions"), (seam, "cut"), (multiband, "offsets")):
        listen(module, name)
    joint.prepare(device, one.layers, CANVAS, Settings(), silent)
    cells = seen["cut"]
    assert cells.dtype == bool and all(np.array_equal(cells, its) for its in seen.values())
    assert len(seen) == 3
    rows, columns = np.nonzero(one.person[0] | one.person[1])
    top = min(int(layer.box.top) for layer in one.layers)
    size = (one.layers[0].box.bottom - top) / cells.shape[0]
    at = ((rows - top + 0.5) / size).astype(int), ((columns + 0.5) * cells.shape[1] / WIDTH).astype(int)
    assert cells[at].all()
    assert cells.sum() * size**2 < 4 * len(rows)


def test_each_photo_is_looked_at_in_its_place(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside the overlap, where one of them ends."""
    one, seen = shoot(PERSON), []
    monkeypatch.setattr(movers, "find", lambda *given: seen.append(given))
    joint.prepare(device, one.layers, CANVAS, Settings(), silent)
    ((chart, _, views, _, _),) = seen
    for x, expected in ((325.5, [1, 0]), (634.5, [0, 1])):
        point = common.canvas_point(np.array(x), np.array(240.5), (-np.pi, 1 / SCALE, np.pi / 2, 1 / SCALE))
        u, v = (int(n) for n in common.chart_position(point, chart.transform))
        assert [view.mask[v, u] for view in views] == expected


@pytest.mark.usefixtures(one_device.__name__)
def test_without_seam_nobody_is_looked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """He could not be taken from one photo."""
    monkeypatch.setattr(movers, "find", None)
    one = shoot(PERSON)
    assert (merged(one.layers, CANVAS, seam=False)[..., 3].max(0) == 255).any()


def guides_of(one: Shoot, first: int) -> list[Guide]:
    """Points of the person, from the layer `first` to the other one."""
    rows, columns = np.nonzero(one.person[0])
    chosen = slice(len(rows) // 4, None, len(rows) // 4)
    x, y = columns[chosen] + 0.5, rows[chosen] + 0.5
    lonlat = (-np.pi, 1 / SCALE, np.pi / 2, 1 / SCALE)
    points = common.canvas_point(x, y, lonlat) * PERSON.distance + PERSON.step - MOVE
    ends = [np.stack([x, y], 1).tolist(), np.stack(common.canvas_position(points, lonlat), 1).tolist()]
    pairs = zip(ends[first], ends[1 - first], strict=True)
    return [Guide(first, 1 - first, tuple(at_a), tuple(at_b)) for at_a, at_b in pairs]


@pytest.mark.parametrize(
    ("turned", "first", "used"), [(False, 0, True), (True, 0, True), (False, 1, True), (True, 1, False)]
)
def test_what_guides_say_of_him_counts(
    device: Device, monkeypatch: pytest.MonkeyPatch, turned: bool, first: int, used: bool
) -> None:
    """That both photos show the same: his flow is left alone, however guides and layers are ordered; but not
    if guides are not to be used."""
    one, find, seen = shoot(PERSON), movers.find, []
    monkeypatch.setattr(movers, "find", lambda *given: seen.append(find(*given)) or seen[-1])
    its = [replace(g, a=g.a ^ turned, b=g.b ^ turned) for g in guides_of(one, first)]
    layers = one.layers[::-1] if turned else one.layers
    joint.prepare(device, layers, CANVAS, Settings(guides=used), silent, its)
    assert [found is None for found in seen] == [used]

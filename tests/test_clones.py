"""Somebody whom two layers show at two places: the kernel, where he is found, and that he is shown once."""

from __future__ import annotations

import logging
from types import SimpleNamespace

import numpy as np
import pytest
from grids import GRIDS, plane, random_layer, sphere
from pictures import masked, merged, one_device, pixel_places, texture
from reference.clones import clones_look
from scipy import ndimage
from tolerances import POSITION, assert_close

from hugin_abflow import clones
from hugin_abflow.clones import Clone
from hugin_abflow.geometry import Pair
from hugin_abflow.grid import Grid
from hugin_abflow.layer import Canvas
from hugin_abflow.opencl import Device
from hugin_abflow.regions import Choice, Residuals
from hugin_abflow.scene import Scene

HEIGHT, WIDTH = 24, 60
GRID = {"plane": plane(480, 192), "cylinder": plane(480, 192, wraps=True), "sphere": sphere(480, 240)}


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize("shoulder", [0.0, 0.5, 1.0])
def test_look_equals_its_twin(device: Device, name: str, shoulder: float) -> None:
    """On grids of cells that divide nothing, of a layer that does not fill its cells."""
    grid = GRIDS[name]
    cells, colours = grid.resized(10, 7).border, grid.resized(5, 3).border
    box, part = (9, 1, grid.width - 9, grid.height - 1), (2, 1, 7, 5)
    field = ndimage.gaussian_filter(np.random.default_rng(1).normal(size=(box[3], box[2], 4)), (4, 4, 0))
    field = (3 * field * (grid.lonlat[1] or 1)).astype(np.float32)
    if not grid.lonlat[1]:
        field[..., 2] = 0
    given = random_layer(20, box[2], box[3], 0.9), field, box
    gain = np.random.default_rng(9).normal(size=(3, 5, 4)).astype(np.float32)
    out = device.empty((5, 7, 4))
    layer, field, gains = (device.upload(one) for one in (given[0], given[1], gain))
    device.run(
        "clones", "clones_look", part[2:],
        layer, field, box, gains, grid.border, grid.lonlat, colours, cells, part, shoulder, out,
    )  # fmt: skip
    expected = clones_look(*given, gain, grid.border, grid.lonlat, colours, cells, shoulder)[1:6, 2:9]
    assert (expected[..., 3] > 0).mean() > 0.4 and (expected[..., 3] < 1).any()
    # a pixel more or less at a mask's rim is one of some ten of a cell
    assert_close(out.get(), expected, 10 * POSITION, decisions=0.05)


def walked(name: str, first: int, second: int, body: np.ndarray, turn: int = 0) -> list[np.ndarray]:
    """What two layers show of a wall before which somebody stands at column `first` in one, `second` in the
    other, and cells of regions; turned by some columns.
    """
    cells = grid_of(name)
    random = np.random.default_rng(3)
    wall = 0.5 + 0.03 * random.normal(size=(*cells.shape, 3))
    looks = []
    for column in (first, second):
        look = np.concatenate([wall + 0.01 * random.normal(size=wall.shape), np.ones((*cells.shape, 1))], 2)
        height, width = body.shape[:2]
        look[8 : 8 + height, column : column + width, :3] = body
        looks.append(np.roll(look.astype(np.float32), turn, 1))
    both = np.zeros(cells.shape, bool)
    both[4:22, 6:54] = True
    return [*looks, np.roll(both, turn, 1)]


def grid_of(name: str) -> Grid:
    """A grid of cells."""
    return GRID[name].resized(WIDTH, HEIGHT if name != "sphere" else 30)


def somebody(height: int = 11, width: int = 5) -> np.ndarray:
    """In a red coat of some texture, with a lighter face."""
    body = np.array([0.7, 0.2, 0.15]) + 0.05 * np.random.default_rng(5).normal(size=(height, width, 3))
    body[: height // 4] = [0.85, 0.65, 0.5]
    return body


@pytest.mark.parametrize(("name", "turn"), [
    ("plane", 0), ("cylinder", 0), ("cylinder", 30), ("cylinder", 41), ("sphere", 33),
])  # fmt: skip
@pytest.mark.parametrize(("first", "second"), [(20, 33), (33, 20), (25, 29)])
def test_somebody_is_found_at_both_places(name: str, turn: int, first: int, second: int) -> None:
    """Also where he overlaps himself, but for the cells in which both layers show him."""
    a, b, both = walked(name, first, second, somebody(), turn)
    found = list(clones.find(Pair(3, 7), a, b, both, grid_of(name)))
    assert len(found) == 1 and (found[0].a, found[0].b) == (3, 7)
    for place, column in ((found[0].first, first), (found[0].second, second)):
        expected = np.zeros(place.shape, bool)
        expected[8:19, column : column + 5] = True
        place = np.roll(place, -turn, 1)
        assert not (place & ~expected).any()
        assert (place & expected).sum() > 0.65 * expected.sum()


def test_two_people_are_found_each() -> None:
    a, b, both = walked("plane", 12, 22, somebody())
    other = [0.1, 0.2, 0.7] + 0.02 * np.random.default_rng(6).normal(size=(9, 4, 3))
    a[9:18, 45:49, :3], b[9:18, 36:40, :3] = other, other
    found = list(clones.find(Pair(0, 1), a, b, both, grid_of("plane")))
    assert len(found) == 2
    assert found[0].first[10:17, 13:16].all() and found[0].second[10:17, 23:26].all()
    assert found[1].first[10:17, 46:48].all() and found[1].second[10:17, 37:39].all()


@pytest.mark.parametrize(
    "what", ["another", "trousers", "one", "small", "outside", "equal", "wall", "windows"]
)
def test_what_is_not_there_twice_is_not_found(what: str) -> None:
    """Somebody else, also one who wears the same trousers, somebody who left, a thing of a few cells, what
    stands where one layer ends, layers that are equal, a wall behind two people who have little in common,
    and windows, before which somebody stands in each layer.
    """
    body = somebody(2, 3) if what == "small" else somebody()
    a, b, both = walked("plane", 20, 33, body)
    if what in ("another", "wall"):
        coat = 0.45 if what == "wall" else 0.0
        b[8:19, 33:38, :3] = [0.1 + coat, 0.2 + coat, 0.9]
    elif what == "trousers":
        b[8:15, 33:38, :3] = [0.1, 0.5, 0.2]
    elif what == "windows":
        a[8:19, 7:12], b[8:19, 46:51] = a[8:19, 20:25], b[8:19, 33:38]
        a[8:19, 46:51], b[8:19, 7:12] = b[8:19, 46:51], a[8:19, 7:12]
    elif what == "one":
        b[8:19, 33:38] = b[8:19, 43:48]
    elif what == "outside":
        both[:, 30:] = False
    elif what == "equal":
        b = a
    assert list(clones.find(Pair(0, 1), a, b, both, grid_of("plane"))) == []


def test_nobody_is_looked_for_near_a_pole() -> None:
    """Where a step on the canvas is a turn as well."""
    found = []
    for top in (0, 13):
        a, b, both = walked("sphere", 20, 33, somebody(5, 12))
        a, b, both = (np.roll(one, top - 8, 0) for one in (a, b, both))
        both[:] = True
        found.append(len(list(clones.find(Pair(0, 1), a, b, both, grid_of("sphere")))))
    assert found == [0, 1]


def test_nothing_is_found_in_no_region() -> None:
    a, b, both = walked("plane", 20, 33, somebody())
    assert list(clones.find(Pair(0, 1), a, b, np.zeros_like(both), grid_of("plane"))) == []


def chosen(
    monkeypatch: pytest.MonkeyPatch,
    ends: tuple[int, int] = (0, WIDTH),
    favour: float = 0.3,
    favour_second: float | None = None,
    beside: int = 0,
) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Whose each cell is where somebody stands in both layers at another place, with clones shown once and as
    the energy has it, and the layers that were looked at.

    ends        the columns from which, and before which, both layers lie.
    favour      how much the softmax favours the first layer at his first place, and, unless it is said, the
                second one at his second.
    beside      columns of something beside him that the second layer alone shows, in one region with him.
    """
    a, b, both = walked("plane", 20, 33, somebody())
    b[8:19, 41 : 41 + beside, :3] = 0.1
    covers = np.ones((2, HEIGHT, WIDTH), bool)
    covers[1, :, : ends[0]] = covers[0, :, ends[1] :] = False
    off = np.abs(a - b)[..., :3].max(-1).astype(np.float64)
    second = favour if favour_second is None else favour_second
    share = np.where(np.arange(WIDTH) < 29, 0.5 + favour, 0.5 - second) * np.ones((HEIGHT, 1))
    whole = np.zeros(both.shape, bool)
    whole[7:20, 19:26] = whole[7:20, 32:39] = True
    if beside:
        whole[7:20, 19 : 42 + beside] = True
    choice = Choice(
        whole, Residuals(off, off), np.stack([share, 1 - share]), covers, False, 10.0, 1.65 * whole
    )
    asked: list[int] = []
    monkeypatch.setattr(clones, "_look", lambda *given: asked.append(given[-1]) or (a, b)[given[-1]])
    layers = [SimpleNamespace(layer=SimpleNamespace(called=name)) for name in ("left.tif", "right.tif")]
    found, gone = clones.owners(
        Scene(None, layers, [Pair(0, 1)], [], None, None), None, grid_of("plane"), choice
    )
    assert all((found[at] != k).all() for k, at in gone.items())
    return found, choice.owners()[0], asked


@pytest.mark.parametrize("favour", [0.1, 0.3, 0.45])
def test_somebody_is_shown_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, favour: float
) -> None:
    """By the layer that costs less, however much the softmax favours both."""
    caplog.set_level(logging.INFO)
    once, twice, _ = chosen(monkeypatch, favour=favour)
    assert (twice[8:19, 20:25] == 0).all() and (twice[8:19, 33:38] == 1).all()
    shown = (once[8:19, 20:25] == 0).mean(), (once[8:19, 33:38] == 1).mean()
    assert sorted(shown) == [0, 1]
    assert [message for message in caplog.messages if "left.tif" in message and "right.tif" in message]


@pytest.mark.parametrize(("ends", "shown"), [((22, WIDTH), (1, 0)), ((21, 36), (1, 1)), ((0, 36), (0, 1))])
def test_nobody_is_cut_to_be_shown_once(
    monkeypatch: pytest.MonkeyPatch, ends: tuple[int, int], shown: tuple[int, int]
) -> None:
    """Where only one layer covers a part of him he is not taken away; if that is so at both places, both
    stay."""
    once, _, _ = chosen(monkeypatch, ends)
    assert ((once[8:19, 20:25] == 0).mean(), (once[8:19, 33:38] == 1).mean()) == shown


@pytest.mark.parametrize(("ends", "shown"), [((20, WIDTH), (1, 0)), ((0, 38), (0, 1)), ((20, 38), (1, 1))])
def test_who_touches_a_border_stays_there(
    monkeypatch: pytest.MonkeyPatch, ends: tuple[int, int], shown: tuple[int, int]
) -> None:
    """Where one layer goes on alone a finger of him may be, which no cell tells."""
    once, _, _ = chosen(monkeypatch, ends, favour=0.1)
    assert ((once[8:19, 20:25] == 0).mean(), (once[8:19, 33:38] == 1).mean()) == shown


@pytest.mark.parametrize(("beside", "theirs"), [(2, 1), (7, 0)])
def test_one_layer_is_not_taken_where_a_cut_shows_him_once(
    monkeypatch: pytest.MonkeyPatch, beside: int, theirs: int
) -> None:
    """But where much else differs, somebody else may be there twice."""
    once, before, _ = chosen(monkeypatch, favour=0.3, favour_second=0.1, beside=beside)
    assert (before[8:19, 19 : 42 + beside] == 0).all()
    assert (once[8:19, 20:25] == 0).all() and (once[8:19, 33:38] == 0).all()
    assert (once[8:19, 41 : 41 + beside] == theirs).all()


@pytest.mark.parametrize(("step", "cut"), [(6, True), (4, False), (2, False)])
def test_who_stands_upon_his_other_place_is_not_cut(step: int, cut: bool) -> None:
    """A cut between his places would go through him: he is shown by the one layer that has most of it."""
    first, second = np.zeros((2, HEIGHT, WIDTH), bool)
    first[8:19, 20:25], second[8:19, 20 + step : 25 + step] = True, True
    a, b = (np.where(at[..., None], 0.9, 0.2) * np.ones(4, np.float32) for at in (first, second))
    cover, half = np.ones((2, HEIGHT, WIDTH), bool), np.full((2, HEIGHT, WIDTH), 0.5)
    whole = first | second
    choice = Choice(whole, Residuals(half[0], half[0]), half, cover, False, 10.0, 1.65 * whole)
    found = clones._cut(choice, Clone(0, 1, first, second, 1.0), [a, b].__getitem__)
    assert (found is not None) == cut


def test_layers_are_not_looked_at_where_regions_are_small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clones, "_LEAST", 1e6)
    once, twice, asked = chosen(monkeypatch)
    assert np.array_equal(once, twice) and asked == []


@pytest.mark.usefixtures(one_device.__name__)
@pytest.mark.parametrize("wraps", [False, True])
@pytest.mark.parametrize(("exposure", "shade"), [(False, 10), (True, 16)])
def test_somebody_who_walks_on_is_in_a_panorama_once(wraps: bool, exposure: bool, shade: int) -> None:
    """He stands in the left half of the overlap in the left photo, and in the right half in the right one. He
    leaves nothing behind, though he is nearly black.
    """
    canvas = Canvas.plane(640, 240, wraps=wraps)
    turn = 320 if wraps else 0  # then the overlap lies across the border
    y, x = pixel_places(canvas.height, canvas.width)
    wall = texture(y, x, np.uint8, canvas.width if wraps else 0)
    wall[..., :3] = 96 + wall[..., :3] // 2
    layers = []
    for place, mask in ((250, (x >= 40) & (x < 450)), (390, (x >= 190) & (x < 600))):
        picture = wall.copy()
        picture[(np.abs(x - place) < 24) & (y > 60) & (y < 190), :3] = 24, 16, 12
        layers.append(masked(np.roll(picture, turn, 1), np.roll(mask, turn, 1)))
    seen = []
    for once in (True, False):
        result = np.roll(merged(layers, canvas, exposure=exposure, clones=once), -turn, 1)
        dark = result[80:170, :, :3].max(-1) < 64
        seen.append([dark[:, place - 16 : place + 16].mean() for place in (250, 390)])
        off = np.abs(result[..., :3].astype(int) - wall[..., :3]).max(-1)
        assert off[:, 290:350].max() <= shade and off[:, 40:200].max() <= shade
        if once:
            assert min(off[:, place - 40 : place + 40].max() for place in (250, 390)) <= shade
    assert sorted(seen[0]) == [0, 1]
    assert seen[1] == [1, 1]

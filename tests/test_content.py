"""Where layers show different things, differences are told from beside: kernels against twins, and which."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from grids import GRIDS, boxes, patches, plane, random_layer
from pictures import merged, one_device
from reference import content as twin
from reference.common import Array
from scipy import ndimage
from tolerances import SUM, assert_close

from hugin_abflow import content, seam
from hugin_abflow.content import Unlike
from hugin_abflow.grid import Grid
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.opencl import Device

__all__ = ["one_device"]

# The kernels


def shown(grid: Grid, box: tuple[int, int, int, int]) -> tuple[Array, Array, Array]:
    """How a layer differs, its share, and the mean of all: some of it dark, some of it black."""
    mean = random_layer(1, grid.width, grid.height, 2)
    mean[..., :3] *= 0.3 * patches(2, grid.width, grid.height, 0.7)[..., None]
    difference = random_layer(3, box[2], box[3], 0.7)
    difference[..., :3] -= 0.5
    share = np.random.default_rng(4).random((box[3], box[2])).astype(np.float32)
    return difference, share * patches(5, box[2], box[3], 0.7), mean


def unlike_of(grid: Grid) -> Unlike:
    """Random, and nothing in patches, on cells that divide nothing."""
    cells = grid.resized(10, 7)
    moved, other = (
        (patches(k, 10, 7, 0.3, 2) * np.random.default_rng(k).random(cells.shape)).astype(np.float32)
        for k in (6, 7)
    )
    return Unlike(cells, moved, other)


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize("part", [0, 1, 2])
@pytest.mark.parametrize("shoulder", [0.0, 0.75])
def test_kernels_equal_their_twins(device: Device, name: str, part: int, shoulder: float) -> None:
    grid, box = GRIDS[name], boxes(GRIDS[name])[part]
    difference, share, mean = shown(grid, box)
    unlike = unlike_of(grid)
    cells, told = unlike.grid, np.random.default_rng(8).normal(size=(7, 10, 4)).astype(np.float32)
    told[..., 3] = np.random.default_rng(9).random((7, 10)) * patches(10, 10, 7, 0.8)
    out, its_share, its_mean = device.upload(difference), device.upload(share), device.upload(mean)
    moved, other = device.upload(unlike.moved), device.upload(unlike.other)
    sums = device.empty((7, 10, 4))
    device.run(
        "content", "content_gather", cells.border[:2], out, its_share, box, grid.border, its_mean, moved,
        other, cells.border, shoulder, sums,
    )  # fmt: skip
    same = twin.content_same(
        difference, share, box, grid.border, mean, unlike.moved, unlike.other, cells.border, shoulder
    )
    expected = twin.content_gather(difference, share, same, box, grid.border, cells.border)
    assert (expected[..., 3] > 0).any()
    assert_close(sums.get(), expected, 10 * SUM)
    device.run(
        "content", "content_complete", box[2:], out, its_share, box, grid.border, its_mean, moved, other,
        device.upload(told), cells.border, shoulder,
    )  # fmt: skip
    expected = twin.content_complete(difference, share, same, box, grid.border, told, cells.border)
    assert_close(out.get(), expected, 10 * SUM)
    left = (out.get() == difference).all(-1)[difference[..., 3] > 0]
    assert 0.02 < left.mean() < 0.95  # where nothing is unlike, exactly


# What is told


def test_what_surely_differs_in_a_region_is_unlike() -> None:
    """And what moved, anywhere."""
    grid = plane(4, 2)
    residual = np.array([[0.05, 0.105, 0.3, 0.3], [0.0, 0.0, 0.0, 0.0]])
    whole = np.array([[True, True, True, False], [True] * 4])
    moved = np.zeros((2, 4), bool)
    moved[:, 3] = True
    found = Unlike.of(grid, residual, whole, moved)
    assert found.grid == grid
    assert found.other == pytest.approx(np.array([[0, 0.5, 1, 0], [0] * 4]))
    assert np.array_equal(found.moved, moved)
    assert found.anywhere.tolist() == [[False, True, True, True], [False] * 3 + [True]]
    assert not Unlike.of(grid, residual, whole, None).moved.any()


@pytest.mark.parametrize("moved", [False, True])
def test_nothing_is_done_where_nothing_is_unlike(moved: bool) -> None:
    """The box of a layer and all that is read of it: no kernel is started."""
    grid = plane(80, 40)
    one = np.zeros((10, 20), np.float32)
    one[9, 15] = 0.1
    unlike = Unlike(grid.coarser(4), *((one, 0 * one) if moved else (0 * one, one)))
    none = SimpleNamespace()  # has nothing that could be run, or read
    content.complete(none, none, none, (0, 0, 50, 40), grid, none, unlike, 1.0)
    with pytest.raises(AttributeError):
        content.complete(none, none, none, (0, 0, 60, 40), grid, none, unlike, 1.0)


WIDTH, HEIGHT = 160, 64


def completed(
    device: Device,
    difference: Array,
    share: Array,
    mean: float,
    *,
    moved: Array | None = None,
    other: Array | None = None,
    wraps: bool = False,
    shoulder: float = 1.0,
) -> Array:
    """Differences (height, width), of all channels, after some; moved, other: pixels, in whole cells of 4."""
    grid = plane(WIDTH, HEIGHT, wraps)
    cells = grid.coarser(4)
    none = np.zeros((HEIGHT, WIDTH), bool)
    parts = [(none if one is None else one)[2::4, 2::4].astype(np.float32) for one in (moved, other)]
    unlike = Unlike(cells, *parts)
    pixels = np.ones((HEIGHT, WIDTH, 4), np.float32)
    pixels[..., :3] = difference[..., None]
    out = device.upload(pixels)
    content.complete(
        device, out, device.upload(share.astype(np.float32)), (0, 0, WIDTH, HEIGHT), grid,
        device.upload(np.full((HEIGHT, WIDTH, 4), mean, np.float32)), unlike, shoulder,
    )  # fmt: skip
    assert (out.get()[..., 3] == 1).all()
    assert np.ptp(out.get()[..., :3], axis=-1).max() == 0
    return out.get()[..., 0]


def block(left: int, right: int, top: int = 16, bottom: int = 48) -> Array:
    result = np.zeros((HEIGHT, WIDTH), bool)
    result[top:bottom, left:right] = True
    return result


def core(mask: Array) -> Array:
    """What no cell around a mask's outline has a part in."""
    return ndimage.binary_erosion(mask, iterations=4, border_value=1)


@pytest.mark.parametrize("shares", [0.0, 0.4])
def test_a_thing_leaves_what_is_around_it(device: Device, shares: float) -> None:
    """Exposures differ more and more from left to right; a thing does by much more. The layer's own share is
    a part of the mean."""
    slope = np.broadcast_to(0.05 + 0.001 * np.arange(WIDTH), (HEIGHT, WIDTH)) * (1 - shares)
    thing = block(64, 96)
    seen = np.where(core(thing), -0.4, slope)
    share = np.full(seen.shape, shares)
    found = completed(device, seen, share, 0.7, other=thing)
    inner = core(core(thing))
    assert np.abs(found - slope)[inner].max() < 0.012 * (1 - shares)
    beside = ~ndimage.binary_dilation(thing, iterations=4)
    assert np.array_equal(found[beside], seen.astype(np.float32)[beside])


def test_places_that_are_a_layers_own_tell_nothing(device: Device) -> None:
    """It does not differ there from the mean, which it is."""
    own = block(0, 72, 0, HEIGHT)
    thing = block(76, 100, 0, HEIGHT)
    seen = np.where(own, 0, np.where(core(thing), 0.4, 0.1))
    found = completed(device, seen, own * 1.0, 0.5, other=thing)
    assert np.abs(found - 0.1)[core(core(thing))].max() < 1e-3


@pytest.mark.parametrize("dark", ["thing", "mean"])
def test_what_is_nearly_black_is_left_unless_it_moved(device: Device, dark: str) -> None:
    mean, off = (0.5, -0.48) if dark == "thing" else (0.02, 0.4)
    thing = block(64, 96)
    seen = np.where(core(thing), off, 0.05)
    kwargs = {"mean": mean, "share": np.zeros(seen.shape)}
    inner = core(core(thing))
    assert (completed(device, seen, other=thing, **kwargs)[inner] == np.float32(off)).all()
    for found in (
        completed(device, seen, moved=thing, **kwargs),
        completed(device, seen, other=thing, shoulder=0.0, **kwargs),  # floats: nobody knows what is dark
    ):
        assert np.abs(found[inner] - 0.05).max() < 1e-3


def test_across_the_border_as_elsewhere(device: Device) -> None:
    wave = 0.05 + 0.02 * np.sin(np.arange(WIDTH) * 2 * np.pi / WIDTH)
    thing = block(64, 96)
    seen = np.where(core(thing), -0.4, wave)
    share = np.zeros(seen.shape)
    first = completed(device, seen, share, 0.7, other=thing, wraps=True)
    seen, thing = (np.roll(one, WIDTH // 2, 1) for one in (seen, thing))
    second = completed(device, seen, share, 0.7, other=thing, wraps=True)
    assert_close(np.roll(second, WIDTH // 2, 1), first, 10 * SUM)


def test_where_nothing_tells_layers_are_left(device: Device) -> None:
    everything = np.ones((HEIGHT, WIDTH), bool)
    seen, share = np.full(everything.shape, 0.3, np.float32), np.zeros(everything.shape)
    assert np.array_equal(completed(device, seen, share, 0.5, other=everything), seen)


def test_little_tells_little(device: Device) -> None:
    """Of a narrow overlap all differs, but for a bit at its end, which says nothing of the other one."""
    own, thing = ~block(72, 84, 0, HEIGHT), block(72, 84, 8, HEIGHT)
    seen = np.where(own, 0, np.where(core(thing), 0.3, 0.05))
    found = completed(device, seen, own * 1.0, 0.5, other=thing)
    assert np.abs(found[-20:, 76:80] - 0.3).max() < 0.12
    own[:] = False  # of a wide one all that is beside tells as much as anything could
    seen = np.where(core(thing), 0.3, 0.05)
    found = completed(device, seen, own * 1.0, 0.5, other=thing)
    assert np.abs(found[-20:, 76:80] - 0.05).max() < 0.01


# The panorama


@pytest.mark.usefixtures(one_device.__name__)
def test_somebody_who_is_cut_out_leaves_less_of_a_shade(monkeypatch: pytest.MonkeyPatch) -> None:
    """Red, before a green wall; he walked, is cut between his places, and the photos have different light.
    There the wall is nearly as it would be without him."""
    monkeypatch.setattr(seam, "_WHOLE_FACTOR", 1.0)  # else he would be taken from one photo
    width, height = 401, 151
    noise = ndimage.gaussian_filter(np.random.default_rng(5).normal(size=(height, width, 1)), (2, 2, 0))
    wall = np.clip((0.3, 0.5, 0.4) + 0.05 * noise / noise.std(), 0, 1)

    def photo(light: float, left: int, right: int, he: int | None) -> Layer:
        scene = wall.copy()
        if he is not None:
            scene[30:, he : he + 30] = (0.6, 0.1, 0.1)
        pixels = np.full((height, right - left, 4), 255, np.uint8)
        pixels[..., :3] = np.rint(np.minimum(255, 255 * light * scene[:, left:right]))
        return Layer.from_array(f"{light}", pixels, left)

    def panorama(*he: int | None) -> Array:
        layers = [photo(1.0, 0, 270, he[0]), photo(1.25, 95, width, he[1])]
        return merged(layers, Canvas.plane(width, height), clones=False)[..., :3].astype(float)

    clean = panorama(None, None)

    def shade() -> float:
        return float(np.abs(panorama(120, 190) - clean)[60:140, 155:185].mean())

    found = shade()
    monkeypatch.setattr(content, "complete", lambda *given: None)
    assert found < 0.5 * shade()
    assert found < 3

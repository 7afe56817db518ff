"""One layer, whole, where flow explains nothing: labels of least energy, regions, and whole panoramas."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from grids import GRIDS, patches, plane, sphere
from hypothesis import given, settings
from hypothesis import strategies as st
from pictures import masked, merged, one_device, pixel_places, texture
from reference.seam import seam_yield
from scipy import ndimage
from tolerances import SUM, assert_close

from hugin_abflow import joint, seam
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.opencl import Device
from hugin_abflow.progress import silent
from hugin_abflow.settings import Settings

WRAPS = [False, True]

# The kernel


def test_twin_of_yield_reads_scipys_zoom() -> None:
    """A layer's weight times (1 - y) ** 4, with y between the cells' centres; never quite nothing."""
    yields = patches(0, 13, 9, 0.5, 3).astype(np.float64)
    field = np.random.default_rng(1).random((40, 60, 4))
    for wraps in WRAPS:
        result = seam_yield(field, (11, 7, 60, 40), (77, 53, int(wraps), 0), yields, (13, 9, int(wraps), 0))
        around = np.pad(
            np.pad(yields, ((1, 1), (0, 0)), "edge"), ((0, 0), (1, 1)), "wrap" if wraps else "edge"
        )
        y, x = np.mgrid[7:47, 11:71] + 0.5
        read = ndimage.map_coordinates(around, [y * 9 / 53 + 0.5, x * 13 / 77 + 0.5], order=1)
        assert (read == 0).any()
        assert np.allclose(
            result[..., 3], field[..., 3] * np.maximum((1 - read) ** 4, 1e-12), rtol=1e-9, atol=0
        )
        assert np.array_equal(result[..., :3], field[..., :3])
        assert result[..., 3].min() > 0


@pytest.mark.parametrize("name", list(GRIDS))
def test_yield_equals_its_twin(device: Device, name: str) -> None:
    """On grids of cells that divide nothing, over poles and borders."""
    grid = GRIDS[name]
    cells = grid.resized(10, 7).border
    box = (5, 0, grid.width - 5, grid.height - 2)
    yields = (patches(2, 10, 7, 0.5, 2) * np.random.default_rng(3).random((7, 10)).clip(0.3)).astype(
        np.float32
    )
    field = np.random.default_rng(4).normal(size=(box[3], box[2], 4)).astype(np.float32)
    out = device.upload(field)
    device.run("seam", "seam_yield", box[2:], out, box, grid.border, device.upload(yields), cells)
    expected = seam_yield(field, box, grid.border, yields, cells)
    assert_close(out.get(), expected, 10 * SUM)
    assert np.array_equal(out.get()[..., :3], field[..., :3])
    assert (expected[..., 3] == field[..., 3]).any()
    assert (expected[..., 3] != field[..., 3]).any()


# Labels of least energy


def energies(labels, rows, columns, residual, shares, cover, wraps) -> np.ndarray:
    """The sum in seam.py for each of the labellings (n, cells), cell by cell."""
    height, width = residual.shape
    number = {(y, x): k for k, (y, x) in enumerate(zip(rows.tolist(), columns.tolist(), strict=True))}
    total = np.zeros(len(labels))
    for (y, x), k in number.items():
        chosen = labels[:, k]
        r = residual[y, x]
        total += np.where(cover[chosen, y, x], r * (1 - shares[chosen, y, x]), seam._FORBIDDEN)
        for down, right in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            v, u = y + down, x + right
            if not 0 <= v < height or not (wraps or 0 <= u < width):
                continue
            u %= width
            total += seam._CUT * r * (cover[:, v, u].any() & ~cover[chosen, v, u])
            if (v, u) in number and down + right > 0:
                pair = seam._CUT * (r + residual[v, u]) / 2
                total += pair * (chosen != labels[:, number[v, u]])
    return total


@st.composite
def problems(draw, layers: int, most: int):
    """A connected region of at most `most` cells on a small grid; each is covered by one layer at least."""
    height, width = draw(st.integers(1, 5)), draw(st.integers(1, 5))
    wraps = draw(st.booleans())
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    region = np.zeros((height, width), bool)
    region[random.integers(height), random.integers(width)] = True
    for _ in range(draw(st.integers(1, most)) - 1):
        beside = np.pad(region, ((0, 0), (1, 1)), "wrap" if wraps else "constant")
        beside = ndimage.binary_dilation(beside)[:, 1:-1] & ~region
        if beside.any():
            region.flat[random.choice(np.flatnonzero(beside))] = True
    # from all alike to a few cells that count for all
    residual = random.random((height, width)) ** draw(st.sampled_from([0.1, 1, 4])) * draw(
        st.sampled_from([0.5, 3])
    )
    shares = random.random((layers, height, width)) ** draw(st.sampled_from([0.2, 1, 20]))
    shares /= np.maximum(shares.sum(0), 1e-9)
    cover = random.random((layers, height, width)) < draw(st.sampled_from([0.4, 0.8, 1]))
    cover[random.integers(layers), region & ~cover.any(0)] = True
    rows, columns = np.nonzero(region)
    return rows, columns, residual, shares, cover, wraps


many = settings(max_examples=150, deadline=None, derandomize=True)


def least_and_found(problem, layers: int) -> tuple[float, float, float]:
    """Least energy of all labellings, that of `label`, and what integer capacities may cost."""
    rows, columns, residual, _, cover, _ = problem
    found = seam.label(*problem)
    assert found.shape == rows.shape
    assert cover[found, rows, columns].all()  # no layer is taken where it is not
    everything = np.array(list(product(range(layers), repeat=rows.size)))
    assert residual.max() <= 3  # so that _FORBIDDEN forbids
    least = energies(everything, *problem).min()
    return least, energies(found[None], *problem)[0], 5 * rows.size / seam._UNIT


@many
@given(problem=problems(2, 11))
def test_of_two_layers_the_least_energy_is_found(problem) -> None:
    least, found, rounding = least_and_found(problem, 2)
    assert least <= found + 1e-9
    assert found <= least + rounding


@many
@given(problem=problems(3, 7))
def test_of_three_layers_nearly_the_least_energy_is_found(problem) -> None:
    least, found, rounding = least_and_found(problem, 3)
    assert least <= found + 1e-9
    assert found <= 1.05 * least + rounding


def test_a_lone_layer_is_taken_even_where_it_is_not() -> None:
    """Nothing else could be."""
    rows, columns = np.array([0, 0, 1]), np.array([0, 1, 1])
    cover = np.zeros((3, 2, 2), bool)
    shares, residual = np.full((3, 2, 2), 1 / 3), np.ones((2, 2))
    assert seam.label(rows, columns, residual, shares, cover, False).shape == (3,)
    cover[2, 0, 0] = True
    assert seam.label(rows, columns, residual, shares, cover, False).tolist() == [2, 2, 2]


def valley(shift: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Layers differ by 1 but along two winding paths, two cells wide: residual, shares, whose cells."""
    columns, rows = np.meshgrid(np.arange(40), np.arange(15))
    left, right = 9 + np.abs(rows - 7) // 2, 30 - rows // 4
    residual = np.ones((15, 40))
    for path in (left, right):
        residual[(columns == path) | (columns == path - 1)] = 0.01
    share = np.clip(1.5 - np.abs(columns - 19.5) / 10, 0, 1)  # layer 1 is the middle's
    labels = (columns >= left) & (columns < right)
    return (
        np.roll(residual, shift, 1),
        np.roll(np.stack([1 - share, share]), shift, 2),
        np.roll(labels, shift, 1),
    )


@pytest.mark.parametrize(("shift", "wraps"), [(0, False), (0, True), (12, True), (25, True)])
def test_a_cut_runs_through_the_least_residual(shift: int, wraps: bool) -> None:
    """Not where the coefficients are equal, which is up to three cells beside; across the border, too."""
    residual, shares, expected = valley(shift)
    rows, columns = (v.ravel() for v in np.mgrid[0:15, 0:40])
    found = seam.label(rows, columns, residual, shares, np.ones((2, 15, 40), bool), wraps).reshape(15, 40)
    assert 0.3 < expected.mean() < 0.6
    assert np.array_equal(found, expected)
    assert not np.array_equal(found, shares.argmax(0))


def test_a_border_counts_as_a_cut() -> None:
    """A favoured layer that ends where its region does gives way to one that goes on beyond; where both end
    there is no cut to be seen."""
    rows, columns = (v.ravel() for v in np.mgrid[0:6, 0:7])
    residual, cover = np.ones((6, 12)), np.ones((2, 6, 12), bool)
    shares = np.stack([np.full((6, 12), 0.2), np.full((6, 12), 0.8)])
    for ends, taken in (((), 1), ((1,), 0), ((0, 1), 1)):
        cover[list(ends), :, 7:] = False
        assert (seam.label(rows, columns, residual, shares, cover, False) == taken).all()


# Regions


@pytest.mark.parametrize("wraps", WRAPS)
def test_connected_parts_are_those_of_a_flood(wraps: bool) -> None:
    count = 0
    for seed in range(20):
        mask = patches(seed, 17, 12, 0.35, 1) > 0
        parts = seam._connected(mask, wraps)
        left, expected = {(int(y), int(x)) for y, x in np.argwhere(mask)}, set()
        while left:
            part, edge = set(), [left.pop()]
            while edge:
                y, x = edge.pop()
                part.add((y, x))
                near = {(y + j, (x + i) % 17 if wraps else x + i) for j in (-1, 0, 1) for i in (-1, 0, 1)}
                edge += near & left
                left -= near
            expected.add(frozenset(part))
        assert {frozenset(map(tuple, np.argwhere(part).tolist())) for part in parts} == expected
        count += len(expected)
    assert count > 60


def test_a_region_is_strong_and_takes_its_outskirts() -> None:
    cells = plane(480, 320).resized(60, 40)
    residual = np.zeros((40, 60))
    residual[5:12, 5:20] = 0.5 * (seam._WEAK + seam._STRONG)
    assert seam._regions(residual, cells) == []  # weak alone
    residual[6:8, 7:9] = 2.0
    residual[20, 30:35] = 2.0
    assert seam._regions(residual, cells) == []  # 4 cells here, 5 there: edges
    residual[8, 7:10] = 2.0
    (region,) = seam._regions(residual, cells)
    expected = np.zeros((40, 60), bool)
    expected[4:13, 4:21] = True
    assert np.array_equal(region, expected)


def test_a_region_across_the_border_is_one() -> None:
    residual = np.zeros((40, 60))
    residual[5:9, 58:] = residual[5:8, :1] = 2.0  # neither side is enough alone
    residual[7:9, 58:] = 0.5
    cells = plane(480, 320, wraps=True).resized(60, 40)
    (region,) = seam._regions(residual, cells)
    assert region[:, [57, 58, 59, 0, 1]].any(0).all()
    assert region.sum() == 6 * 4 + 5
    assert seam._regions(residual, plane(480, 320).resized(60, 40)) == []


def test_cells_near_a_pole_count_by_their_area() -> None:
    cells = sphere(480, 240).resized(60, 30)
    found = []
    for row in (0, 14):
        residual = np.zeros((30, 60))
        residual[row : row + 2, 10:20] = 2.0
        found.append(len(seam._regions(residual, cells)))
    assert found == [0, 1]


@pytest.mark.parametrize("wraps", WRAPS)
def test_outlines_are_blurred_over_a_cell(wraps: bool) -> None:
    mask = patches(5, 17, 12, 0.5, 4)
    mask[:, :3] = mask[:, -1:]  # something to see across the border
    mask[3] = 1 - mask[3]
    expected = ndimage.uniform_filter(
        mask.astype(np.float64), 3, mode=("nearest", "wrap" if wraps else "nearest")
    )
    assert np.allclose(seam._soften(mask, wraps), expected, atol=1e-6)


def test_cells_that_a_layer_covers_whole() -> None:
    covered = np.ones((2, 53, 77), bool)
    covered[0, 12, 20] = covered[1, 52, 76] = False
    whole = seam._cells_whole(covered, plane(110, 70).resized(9, 5))
    assert np.argwhere(~whole).tolist() == [[0, 1, 2], [1, 4, 8]]


# Whole panoramas: a dark disc in one of two layers that show the same wall


RADIUS, LAP = 28, 90  # px; overlaps are 2 LAP wide
DISC = (24, 16, 12)
CANVASES = {
    "plane": (Canvas.plane(480, 208), 240, 100),
    "across the border": (Canvas.plane(480, 208, wraps=True), 0, 100),
    "beside the border": (Canvas.plane(480, 208, wraps=True), 466, 80),
    "sphere": (Canvas.sphere(480, 240), 0, 100),
    "near a pole": (Canvas.sphere(480, 240), 2, 40),
}


def wall(canvas: Canvas, dx: float = 0.0) -> np.ndarray:
    """Mid tones everywhere, brighter than the disc."""
    y, x = pixel_places(canvas.height, canvas.width)
    picture = texture(y, x - dx, np.uint8, canvas.width if canvas.wraps else 0)
    picture[..., :3] = 64 + picture[..., :3] // 2
    return picture


def distance(canvas: Canvas, x: float, y: float) -> np.ndarray:
    """Of every pixel from a place, in px, on the sphere by angle."""
    rows, columns = (place + 0.5 for place in pixel_places(canvas.height, canvas.width))
    across = np.abs(columns - x)
    if canvas.wraps:
        across = np.minimum(across, canvas.width - across)
    if not canvas.spherical:
        return np.hypot(across, rows - y)
    step = np.pi / canvas.height
    lat, its, lon = np.pi / 2 - rows * step, np.pi / 2 - y * step, across * 2 * np.pi / canvas.width
    cosine = np.sin(lat) * np.sin(its) + np.cos(lat) * np.cos(its) * np.cos(lon)
    return np.arccos(np.clip(cosine, -1, 1)) / step


def halves(canvas: Canvas, x: int) -> tuple[np.ndarray, np.ndarray]:
    """Masks of two layers that overlap around column x, and opposite of it on a canvas that wraps."""
    columns = pixel_places(canvas.height, canvas.width)[1]
    if not canvas.wraps:
        return columns < x + LAP, columns >= x - LAP
    around, half = (columns - x) % canvas.width, canvas.width // 2
    return (around < half + LAP) | (around >= canvas.width - LAP), (around < LAP) | (around >= half - LAP)


def scene(
    name: str, who: int | None, light: float = 1.0, dx: float = 0.0
) -> tuple[list[Layer], Canvas, np.ndarray, np.ndarray]:
    """Two layers of the wall, of which `who` shows the disc and the second is darker and moved; the canvas;
    how far each pixel is from the disc's centre; the wall."""
    canvas, x, y = CANVASES[name]
    away, plain = distance(canvas, x, y), wall(canvas)
    layers = []
    for index, mask in enumerate(halves(canvas, x)):
        picture = wall(canvas, dx * index)
        if index == who:
            picture[away < RADIUS, :3] = DISC
        if index == 1:
            picture[..., :3] = np.rint(picture[..., :3] * light)
        layers.append(masked(picture, mask))
    return layers, canvas, away, plain


def off(result: np.ndarray, colours: np.ndarray | tuple[int, ...]) -> np.ndarray:
    """Largest difference of a channel, per pixel, in levels."""
    return np.abs(result[..., :3].astype(int) - np.asarray(colours)[..., :3]).max(-1)


def doubt(result: np.ndarray, plain: np.ndarray, away: np.ndarray) -> np.ndarray:
    """How far each pixel is from what either layer shows, in levels."""
    shown = plain.copy()
    shown[away < RADIUS, :3] = DISC
    return np.minimum(off(result, plain), off(result, shown))


@pytest.mark.usefixtures(one_device.__name__)
@pytest.mark.parametrize(
    ("name", "who"),
    [("plane", 0), ("plane", 1), ("across the border", 0), ("across the border", 1), ("beside the border", 0),
     ("sphere", 1), ("near a pole", 0)],
)  # fmt: skip
def test_what_only_one_layer_shows_is_whole_or_absent(name: str, who: int) -> None:
    layers, canvas, away, plain = scene(name, who)
    result = merged(layers, canvas, seam=True)
    assert doubt(result, plain, away).max() <= 8  # every pixel is one layer's; on the sphere flow resamples
    assert (off(result, DISC)[away < RADIUS - 1] <= 8).mean() in (0, 1)
    assert off(result, plain)[away >= RADIUS + 16].max() <= 8
    assert (result[..., 3] == 255).all()


@pytest.mark.usefixtures(one_device.__name__)
@pytest.mark.parametrize("name", ["plane", "across the border"])
def test_without_seam_it_is_half_transparent(name: str) -> None:
    layers, canvas, away, plain = scene(name, 0)
    result = merged(layers, canvas, seam=False)
    assert (doubt(result, plain, away)[away < RADIUS] > 20).mean() > 0.4


@pytest.mark.usefixtures(one_device.__name__)
@pytest.mark.parametrize("who", [0, 1])
@pytest.mark.parametrize("name", ["plane", "across the border"])
def test_what_only_one_layer_shows_does_not_change_the_exposure_around(name: str, who: int) -> None:
    """With layers of different light, beside the same without the disc."""
    layers, canvas, away, _ = scene(name, who, 0.8)
    clean = merged(scene(name, None, 0.8)[0], canvas)
    result = merged(layers, canvas)
    assert off(result, clean)[away > RADIUS + 32].max() <= 2
    # where the disc is absent the wall behind it has its light, but for what the correction fades by over so
    # small a canvas, else the disc is whole; layers differ by some 26 levels, the disc and the wall by 100
    inside = away < RADIUS - 8
    behind = ndimage.gaussian_filter(result[..., 1].astype(float) - clean[..., 1], 3, mode="wrap")[inside]
    absent = np.abs(behind).max() <= 8
    assert absent or off(result, DISC)[inside].max() <= 8


def prepared(device: Device, layers: list[Layer], canvas: Canvas, **chosen) -> joint.Prepared:
    return joint.prepare(device, layers, canvas, Settings(**chosen), silent)


def fields_of(found: joint.Prepared) -> list[np.ndarray]:
    return [layer.field.get() for layer in found.layers]


@pytest.mark.parametrize(
    ("dx", "light", "exposure"),
    [(1.5, 1.0, True), (4.0, 1.0, False), (0.0, 0.5, True), (0.0, 0.5, False), (3.0, 0.8, True)],
)
def test_layers_that_agree_are_blended_as_ever(
    device: Device, dx: float, light: float, exposure: bool
) -> None:
    """No region, and weights and places to the bit, whether the exposure is corrected or only known."""
    layers, canvas, *_ = scene("across the border", None, light, dx)
    with_, without = (prepared(device, layers, canvas, seam=s, exposure=exposure) for s in (True, False))
    for one, other in zip(fields_of(with_), fields_of(without), strict=True):
        np.testing.assert_array_equal(one, other)
    gains = [[layer.gain for layer in found.layers] for found in (with_, without)]
    if exposure:
        for one, other in zip(*gains, strict=True):
            assert (one is None) == (other is None)
            assert one is None or np.array_equal(one.get(), other.get())
    else:
        assert gains == [[None, None]] * 2


def test_identical_layers_have_no_regions(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are no pair, so that nothing is measured; weights and places are the same to the bit."""
    asked = []
    monkeypatch.setattr(seam, "regions", lambda *a, found=seam.regions: asked.append(found(*a)) or asked[-1])
    layers, canvas, *_ = scene("across the border", None)
    with_, without = (prepared(device, layers, canvas, seam=s) for s in (True, False))
    assert len(asked) == 1 and asked[0].shape == (26, 60) and not asked[0].any()
    for one, other in zip(fields_of(with_), fields_of(without), strict=True):
        np.testing.assert_array_equal(one, other)


def test_weights_outside_the_regions_stay(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """The cut takes weight away only where its cells, blurred by one, reach; a trace is left."""
    seen = {}

    def remember(device, layers, fields, *rest, original=seam.cut):
        seen["before"], seen["regions"] = [f.get() for f in fields], rest[3]
        original(device, layers, fields, *rest)
        seen["after"] = [f.get() for f in fields]

    monkeypatch.setattr(seam, "cut", remember)
    layers, canvas, *_ = scene("across the border", 0)
    found = prepared(device, layers, canvas)
    reach = ndimage.binary_dilation(np.tile(seen["regions"], 3), np.ones((3, 3)), 2)[:, 60:120]
    reach = np.kron(reach, np.ones((8, 8), bool))
    changed = 0
    for layer, before, after in zip(found.layers, seen["before"], seen["after"], strict=True):
        left, top, width, height = layer.working.box
        there = reach[top : top + height, left : left + width]
        assert np.array_equal(before[~there], after[~there])
        assert np.array_equal(before[..., :3], after[..., :3])
        assert ((after[..., 3] > 0) == (before[..., 3] > 0)).all()
        changed += (after[..., 3] < 1e-6 * before[..., 3]).sum()
    assert changed > np.pi * RADIUS**2

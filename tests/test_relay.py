"""Flow by way of other layers: kernels against twins, and scenes whose flow is known."""

from __future__ import annotations

from itertools import combinations, permutations

import numpy as np
import pytest
from grids import patches, plane, sphere
from reference import consistency as consistency_twin
from reference import relay as twin
from relay_scenes import Scene
from tolerances import SUM, TRIGONOMETRY, assert_close

from hugin_abflow import relay
from hugin_abflow.chart import pair_chart
from hugin_abflow.opencl import Device

CANVASES = {"plane": plane(151, 97), "cylinder": plane(151, 97, wraps=True), "sphere": sphere(302, 151)}


def random_found(seed: int, width: int, height: int, far: float = 2.0) -> np.ndarray:
    """Smooth flow, trust with patches of none, brightness with steps, with patches of nothing and of what
    tells nothing.
    """
    random = np.random.default_rng(seed)
    found = np.empty((height, width, 4))
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    found[..., 0], found[..., 1] = far * np.sin(x / 9 + seed), far * np.cos(y / 7 + x / 23)
    found[..., 2] = random.random((height, width)) * patches(seed, width, height, 0.8)
    found[..., 3] = random.normal(size=(height, width)) * 0.05 + patches(seed + 1, width, height, 0.5) * 0.7
    found[patches(seed + 2, width, height, 0.1, 9) > 0, 3] = consistency_twin.EXCLUDED
    found[patches(seed + 3, width, height, 0.1, 9) > 0, 3] = 0
    return found.astype(np.float32)


@pytest.mark.parametrize("wraps", [False, True])
@pytest.mark.parametrize("size", [(77, 53), (64, 31), (5, 3), (1, 7), (1, 1)])
def test_cells_equal_their_twin(device: Device, wraps: bool, size: tuple[int, int]) -> None:
    grid = (*size, int(wraps), 0)
    found, other = (random_found(seed, *size) for seed in (1, 20))
    cells = -(-size[0] // 8), -(-size[1] // 8)
    result = device.empty((*cells[::-1], 4))
    images = device.upload(found), device.upload(other)
    device.run("relay", "relay_cells", cells, *images, grid, 8, 0.03, cells, result)
    expected = twin.relay_cells(found, other, grid, 8, 0.03)
    if size == (77, 53):
        assert all(-1 in part and part.max() > 0 for part in (expected[..., 2], expected[..., 3]))
        assert np.ptp(expected[..., 3][expected[..., 3] >= 0]) > 0.1
    assert_close(result.get(), expected, TRIGONOMETRY, decisions=0.02)


def test_the_fit_is_that_of_a_flow_that_is_right_or_wrong(device: Device) -> None:
    """Of a texture that moved by 3 px; where there is none, any flow fits."""
    random = np.random.default_rng(3)
    texture = 0.2 * random.normal(size=(48, 99)) + 1
    flat = np.ones((48, 99))
    for shown, flow, low, high in (
        (texture, 3, 0.99, 1.0), (texture, 0, 0.0, 0.05), (flat, 3, 0.99, 1.0), (flat, 0, 0.99, 1.0),
    ):  # fmt: skip
        found, other = np.zeros((2, 48, 96, 4), np.float32)
        found[..., 0], found[..., 2] = flow, 1
        found[..., 3], other[..., 3] = shown[:, 3:], shown[:, :-3] + 0.4  # and is brighter
        cells = device.empty((6, 12, 4))
        device.run(
            "relay", "relay_cells", (12, 6), device.upload(found), device.upload(other), (96, 48, 0, 0), 8,
            0.03, (12, 6), cells,
        )  # fmt: skip
        assert low <= cells.get()[:, :-1, 3].min() and cells.get()[:, :-1, 3].max() <= high


@pytest.mark.parametrize("name", list(CANVASES))
@pytest.mark.parametrize("step", [1, 8])
@pytest.mark.parametrize("ring", [False, True])
def test_ways_equal_their_twin(device: Device, name: str, step: int, ring: bool) -> None:
    """On three charts of their own, each of which holds a part of the others; the third one may go around."""
    canvas = CANVASES[name]
    rows, columns = np.indices(canvas.shape)
    overlaps = [
        (columns < 0.7 * canvas.width) & (np.abs(rows - canvas.height / 2) < 0.3 * canvas.height),
        np.abs(rows - canvas.height / 2) < 0.4 * canvas.height,
        np.abs(rows - canvas.height / 2) < 0.35 * canvas.height
        if ring
        else np.abs(columns - canvas.width / 2) < 0.3 * canvas.width,
    ]
    charts = [pair_chart(overlap, canvas, canvas) for overlap in overlaps]
    grids = [(one.width, one.height, int(one.wraps), 0) for one in charts]
    parts = []
    for seed, (chart, grid) in enumerate(zip(charts[:2], grids[:2], strict=True)):
        found = random_found(10 * seed, chart.width, chart.height)
        cells = np.random.default_rng(seed).random((-(-grid[1] // 8), -(-grid[0] // 8), 4))
        back = random_found(10 * seed + 5, chart.width, chart.height)
        parts.append((found, back, cells.astype(np.float32), grid, chart.transform))
    size = -(-grids[2][0] // step), -(-grids[2][1] // step)
    total = device.upload(np.full((*size[::-1], 4), 0.25, np.float32))
    given = (device.upload(one) if np.ndim(one) > 1 else one for part in parts for one in part)
    device.run(
        "relay", "relay_add", size, *given, 8, grids[2], charts[2].transform, step, size, 0.7, total,
    )  # fmt: skip
    expected = twin.relay_add(*parts, 8, grids[2], charts[2].transform, step, 0.7)
    assert 0.15 < (expected[..., 2] > 0).mean() < 1
    assert charts[2].wraps or not (ring and canvas.wraps)
    assert np.abs(total.get() - 0.25).max() < 10  # none goes around the wrong way
    # a cell, or a chart's rim, may be missed by rounding
    assert_close(total.get() - 0.25, expected, 2e-3, decisions=0.01)
    assert_close(total.get()[..., 2] - 0.25, expected[..., 2], TRIGONOMETRY, decisions=0.01)


@pytest.mark.parametrize("wraps", [False, True])
@pytest.mark.parametrize("count", [0, 3])
def test_holding_equals_its_twin(device: Device, wraps: bool, count: int) -> None:
    points = np.array([[1.5, 40.2, 1, -1], [70, 8, -2, 0.5], [90, -3, 0, 0]], np.float32)[:count]
    found, grid = random_found(8, 77, 53), (77, 53, int(wraps), 0)
    total = device.upload(np.ones((53, 77, 4), np.float32))
    held = device.upload(points) if count else total, count, 9.0, 3.0
    device.run("relay", "relay_hold", grid[:2], *held, device.upload(found), grid, total)
    expected = twin.relay_hold(points, 9.0, 3.0, found, grid)
    assert count == 0 or expected.max() > 0.5
    assert_close(total.get()[..., 3], expected, TRIGONOMETRY)
    assert (total.get()[..., :3] == 1).all()


@pytest.mark.parametrize("counts", [0.0, 1.0])
def test_taking_equals_its_twin(device: Device, counts: float) -> None:
    random = np.random.default_rng(5)
    total = random.normal(size=(53, 77, 4)).astype(np.float32)
    total[..., 2] = random.random((53, 77)) * 0.5 * patches(4, 77, 53, 0.7)
    total[..., 3] = random.random((53, 77)) * patches(7, 77, 53, 0.4)
    found = random_found(6, 77, 53)
    result = device.upload(found)
    device.run(
        "relay", "relay_take", (77, 53), device.upload(total), (77, 53, 0, 0), 0.3, 3.0, counts, result
    )
    expected = twin.relay_take(total, 0.3, 3.0, counts, found)
    assert_close(result.get()[..., 2:], expected[..., 2:], SUM)
    sure = expected[..., 2] > 0.05
    assert_close(result.get()[sure][:, :2], expected[sure][:, :2], 1e-4)
    single = found[..., 3] >= consistency_twin.EXCLUDED
    assert single.any() and np.array_equal(result.get()[single], found[single])


# The module, on scenes in which each layer shows the same, moved by so many px.


SHIFTS = (0.0, 3.0, -2.0, 5.0)


@pytest.mark.parametrize("name", list(CANVASES))
@pytest.mark.parametrize("texture", [0.0, 0.2])
def test_what_agrees_stays_to_the_bit(device: Device, name: str, texture: float) -> None:
    scene = Scene(device, CANVASES[name], SHIFTS, texture=texture)
    assert scene.stays()


@pytest.mark.parametrize("name", list(CANVASES))
@pytest.mark.parametrize("pair", list(combinations(range(4), 2)))
def test_the_pair_that_two_triangles_contradict_is_the_wrong_one(
    device: Device, name: str, pair: tuple[int, int]
) -> None:
    """Without texture, whatever the images say; it leads back to the start all the same."""
    scene = Scene(device, CANVASES[name], SHIFTS, texture=0.0)
    scene.spoil(*pair, 20.0)
    others = {other: scene.off(*other) for other in scene.charts if other != pair}
    assert scene.off(*pair) == pytest.approx(20, abs=0.5)
    assert scene.mend() == [pair]
    assert scene.off(*pair) < 0.05
    assert {other: scene.off(*other) for other in others} == others


@pytest.mark.parametrize("pair", list(combinations(range(3), 2)))
def test_of_three_layers_the_images_tell_which_flow_is_wrong(device: Device, pair: tuple[int, int]) -> None:
    scene = Scene(device, CANVASES["plane"], SHIFTS[:3])
    scene.spoil(*pair, 20.0)
    assert scene.mend() == [pair]
    assert scene.off(*pair) < 0.05


def test_what_nothing_decides_stays(device: Device) -> None:
    """Three layers of one colour: each pair has as much to say as the others."""
    scene = Scene(device, CANVASES["plane"], SHIFTS[:3], texture=0.0)
    scene.spoil(0, 1, 20.0)
    assert scene.stays()


def test_small_overlaps_refute_no_large_ones(device: Device) -> None:
    """Whatever is wrong with it: they tell of a part of it alone."""
    canvas = CANVASES["plane"]
    columns = np.indices(canvas.shape)[1]
    shown = [columns >= 0, columns >= 0, columns < 24, columns < 24]
    small = dict.fromkeys(combinations(range(4), 2), columns < 24)
    scene = Scene(device, canvas, SHIFTS, small | {(0, 1): columns >= 0}, texture=0.0, shown=shown)
    scene.spoil(0, 1, 20.0)
    before = scene.buffers(0, 1)[0].get()
    scene.mend()
    assert np.array_equal(scene.buffers(0, 1)[0].get()[:, 45:], before[:, 45:])


def test_flow_that_is_carried_on_beside_an_overlap_tells_nothing(device: Device) -> None:
    """It is trusted there, as it leads back; but the third and the fourth layer do not show that place, in
    which the others show something nearer.
    """
    canvas = CANVASES["plane"]
    columns = np.indices(canvas.shape)[1]
    shown = [columns >= 0, columns < 60, columns < 60, columns >= 0]
    scene = Scene(device, canvas, SHIFTS, texture=0.0, shown=shown)
    scene.spoil(0, 3, 9, slice(70, None))
    assert scene.stays()


def test_both_ways_of_a_pair_change_or_neither(device: Device) -> None:
    """One alone would no longer lead back."""
    scene = Scene(device, CANVASES["plane"], SHIFTS, texture=0.0)
    forward, _ = scene.buffers(1, 2)
    values = forward.get()
    half = values.shape[1] // 2
    values[:, half:, 2] = 0
    forward.set(values)
    assert scene.stays()


def test_exact_flow_stays_where_others_nearly_agree(device: Device) -> None:
    """Of a pair which does not know half of its overlap, and of others that are a pixel off."""
    scene = Scene(device, CANVASES["plane"], SHIFTS, texture=0.0)
    for pair in ((0, 1), (0, 3)):
        scene.spoil(*pair, 0.5)
    half = scene.charts[1, 2].width // 2
    scene.forget(1, 2, slice(half, None))
    assert scene.mend() == [(1, 2)]
    off = np.abs(scene.buffers(1, 2)[0].get()[..., :2] - scene.flow(1, 2))
    assert off[:, : half - 8].max() < 0.1 and np.median(off[:, half:].max(-1)) < 0.6


def test_of_many_layers_those_with_the_largest_overlaps_are_asked(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, composed = [], relay._composed
    monkeypatch.setattr(
        relay, "_composed", lambda *given: asked.append((given[2], list(given[3]))) or composed(*given)
    )
    canvas = CANVASES["plane"]
    columns = np.indices(canvas.shape)[1]
    shifts = [float(k) for k in range(8)]
    overlaps = {pair: columns < 150 - 10 * max(pair) for pair in combinations(range(8), 2)}
    shown = [columns < 150 - 10 * k for k in range(8)]
    Scene(device, canvas, shifts, overlaps, shown=shown).mend()
    assert len(asked) == 56
    assert dict(asked)[0, 1] == [2, 3, 4, 5] and dict(asked)[7, 3] == [0, 1, 2, 4]


@pytest.mark.parametrize("name", list(CANVASES))
def test_where_a_flow_is_not_trusted_the_others_tell_it(device: Device, name: str) -> None:
    scene = Scene(device, CANVASES[name], SHIFTS, texture=0.0)
    scene.forget(1, 2, slice(scene.charts[1, 2].width // 2, None))
    assert scene.mend() == [(1, 2)]
    assert (scene.buffers(1, 2)[0].get()[..., 2] > 0.5).mean() > 0.8
    assert scene.off(1, 2) < 0.05


def told(scene: Scene, a: int, b: int) -> np.ndarray:
    """The trust in a pair's flow, of which nothing was known, after others were mended and told it."""
    scene.forget(a, b, slice(None))
    unknown = [one for one in scene.found if (one.a, one.b) == (a, b)]
    scene.found = [one for one in scene.found if (one.a, one.b) != (a, b)]
    scene.mend()
    before = scene.state()
    relay.infer(scene.device, relay.compare(scene.device, scene.found), unknown)
    assert all(map(np.array_equal, before, scene.state()))
    scene.found += unknown
    return np.minimum(*(buffer.get()[..., 2] for buffer in scene.buffers(a, b)))


@pytest.mark.parametrize("wrong", [0.0, 20.0])
def test_what_is_unknown_goes_by_way_of_others_that_are_mended(device: Device, wrong: float) -> None:
    scene = Scene(device, CANVASES["plane"], (*SHIFTS, 1.0), texture=0.0)
    scene.spoil(0, 1, wrong)
    assert (told(scene, 0, 2) > 0.5).mean() > 0.8 and scene.off(0, 2) < 0.05


def test_what_is_doubted_has_no_say_in_what_is_unknown(device: Device) -> None:
    """Nothing decides which flow of the first, second and fourth layer is wrong."""
    everywhere = np.ones(CANVASES["plane"].shape, bool)
    pairs = dict.fromkeys([(0, 1), (0, 2), (1, 2), (0, 3), (1, 3)], everywhere)
    scene = Scene(device, CANVASES["plane"], SHIFTS, pairs, texture=0.0)
    scene.spoil(0, 1, 20.0)
    assert not told(scene, 0, 2).any()


@pytest.mark.parametrize(("spoilt", "kept"), [(60, True), (110, False)])
def test_where_others_do_not_reach_doubted_flow_stays_and_refuted_flow_does_not(
    device: Device, spoilt: int, kept: bool
) -> None:
    """A third and a fourth layer are at the left alone; there flow is wrong."""
    canvas = CANVASES["plane"]
    columns = np.indices(canvas.shape)[1]
    overlaps = dict.fromkeys(combinations(range(4), 2), columns < 110) | {(0, 1): columns < 140}
    scene = Scene(device, canvas, SHIFTS, overlaps, texture=0.0)
    scene.spoil(0, 1, 20, slice(spoilt))
    before = scene.buffers(0, 1)[0].get()
    assert scene.mend() == [(0, 1)]
    after = scene.buffers(0, 1)[0].get()
    assert np.abs(after[:, 5 : spoilt - 5, :2] - scene.flow(0, 1)[:, 5 : spoilt - 5]).max() < 0.05
    right = np.s_[:, 135:140]
    assert np.array_equal(after[right][..., :2], before[right][..., :2])
    assert np.array_equal(after[right][..., 2], before[right][..., 2] * kept)


@pytest.mark.parametrize("refuted", [False, True])
def test_control_points_hold_flow_that_moves_as_they_do(
    device: Device, monkeypatch: pytest.MonkeyPatch, refuted: bool
) -> None:
    """They are the user's; the others are believed elsewhere, and where flow moves otherwise or is lost."""
    assert 20 < relay._HELD < 200
    monkeypatch.setattr(relay, "_HELD", 5.0)
    monkeypatch.setattr(relay, "_REFUTED", 1.0 if refuted else 0.0)
    scene = Scene(device, CANVASES["plane"], SHIFTS, texture=0.0)
    scene.spoil(1, 2, 20.0)
    scene.change(1, 2, lambda values, _: values[:36, :, 2].fill(0))
    scene.change(1, 2, lambda values, sign: values[44:, :, 0].__iadd__(9 * sign))
    held = {(1, 2): np.array([[60.0, 40.0, 15, 0]]), (2, 1): np.array([[75.0, 40.0, -15, 0]])}
    assert scene.mend(held) == [(1, 2)]
    for way, buffer in zip(((1, 2), (2, 1)), scene.buffers(1, 2), strict=True):
        after, column = buffer.get(), int(held[way][0, 0])
        off = np.linalg.norm(after[..., :2] - scene.flow(*way), axis=-1)[:, column - 45 : column + 1]
        assert off[39:41, 44:] == pytest.approx(20, abs=0.5)
        assert max(off[39:41, :20].max(), off[34:36, 44:].max(), off[44:46, 44:].max()) < 0.5
        assert after[34:46, column - 1 : column + 1, 2].min() > 0.6


def test_a_few_untrusted_pixels_are_left_to_what_is_around(device: Device) -> None:
    scene = Scene(device, CANVASES["plane"], SHIFTS)
    scene.change(1, 2, lambda values, _: values[:, :14, 2].fill(0))
    assert scene.stays()


def test_the_order_of_layers_does_not_matter(device: Device) -> None:
    """Nor which one of a pair is the first."""
    results = []
    for order in list(permutations(range(4)))[::5]:
        scene = Scene(device, CANVASES["plane"], [SHIFTS[k] for k in order])
        pair = sorted((order.index(1), order.index(2)))
        scene.spoil(*pair, 20.0 if order.index(1) < order.index(2) else -20.0)
        assert scene.mend() == [tuple(pair)]
        forward, backward = scene.buffers(*pair)
        results.append((forward if order.index(1) < order.index(2) else backward).get())
    for other in results[1:]:
        assert np.allclose(other, results[0], atol=1e-4)

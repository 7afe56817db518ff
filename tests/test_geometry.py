"""Where layers are sampled and how much they count: kernels against twins, twins against loops."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from grids import GRIDS, on_device, patches, plane, random_layer, sphere, whole, whole_chart
from pictures import masked, merged, one_device, pixel_places, texture
from reference import common
from reference import geometry as twin
from scipy import ndimage
from tolerances import POSITION, SUM, TRIGONOMETRY, assert_close

from hugin_abflow import geometry
from hugin_abflow.chart import Chart, pair_chart
from hugin_abflow.geometry import PairFlow
from hugin_abflow.grid import Grid
from hugin_abflow.layer import Box, Canvas
from hugin_abflow.opencl import Device
from hugin_abflow.settings import Settings

NAMES = list(GRIDS)


def smooth_flow(seed: int, found: Chart, strength: float = 3.0) -> np.ndarray:
    """A flow field (height, width, 2) that changes slowly, in chart px."""
    random = np.random.default_rng(seed)
    noise = random.normal(size=(found.height, found.width, 2))
    mode = ("nearest", "wrap" if found.wraps else "nearest")
    flow = np.stack([ndimage.gaussian_filter(noise[..., i], 4, mode=mode) for i in (0, 1)], -1)
    return (strength * flow / np.abs(flow).max()).astype(np.float32)


def flow_error(grid: Grid) -> float:
    """How far displacements may be off: positions' rounding in px, in the unit of a point."""
    return POSITION * (grid.lonlat[1] or 1.0)


@pytest.mark.parametrize("wraps", [False, True])
def test_twin_of_flow_reading_is_linear_interpolation(wraps: bool) -> None:
    random = np.random.default_rng(0)
    flow = random.normal(size=(31, 41, 2))
    u, v = random.random((2, 500)) * [[41], [31]]
    read = twin.flow_at(flow, u, v, (41, 31, int(wraps), 0))
    wide = np.pad(flow, ((1, 1), (1, 1), (0, 0)), mode="edge")
    if wraps:
        wide[:, 0], wide[:, -1] = wide[:, -2], wide[:, 1]
    for i in (0, 1):
        assert np.allclose(read[:, i], ndimage.map_coordinates(wide[..., i], [v + 0.5, u + 0.5], order=1))
    beyond = twin.flow_at(flow, np.array([20.0, -1.0]), np.array([-3.0, 9.0]), (41, 31, int(wraps), 0))
    assert not beyond[0].any()
    assert beyond[1].any() == wraps


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("first", [0, 1])
def test_add_equals_its_twin(device: Device, name: str, first: int) -> None:
    """On a chart of its own axis, for boxes that overlap in part. What a first one finds does not count."""
    grid = GRIDS[name]
    overlap = np.zeros(grid.shape, bool)
    overlap[: grid.height // 2, 20:40] = True
    found = pair_chart(overlap, grid, grid)
    flow = smooth_flow(1, found)
    layer, box = random_layer(2, 51, 19), (5, 0, 51, 19)
    blend, box_j = patches(3, 40, 17, 0.8) * np.float32(0.7), (30, 1, 40, 17)
    blend[::7] *= 1e-5  # as good as nothing
    random = np.random.default_rng(4)
    field = random.normal(size=(19, 51, 4)).astype(np.float32)
    out = device.upload(np.full_like(field, np.nan) if first else field)
    field *= not first
    chart_grid = (found.width, found.height, int(found.wraps), 0)
    device.run(
        "geometry", "geometry_add", (13, 19),
        device.upload(blend), box_j, device.upload(layer), box, grid.lonlat,
        device.upload(flow), chart_grid, found.transform, first, out,
    )  # fmt: skip
    expected = twin.geometry_add(
        blend, box_j, layer, box, grid.lonlat, flow, chart_grid, found.transform, field
    )
    kernel = out.get()
    assert np.array_equal(kernel[..., 3], field[..., 3])
    moved = np.abs(expected - field).max(-1) > 0
    assert 0.1 < moved.mean() < 0.6
    assert np.array_equal(kernel[~moved], field[~moved])
    # a flow read beyond the chart's rim falls from its last value to 0 at once
    assert_close(kernel, expected, 10 * flow_error(grid) + SUM, decisions=1e-3)


@pytest.mark.parametrize("name", list(GRIDS))
@pytest.mark.parametrize("fade", [0.0, 0.3, geometry.SHORTENED])
def test_within_equals_its_twin(device: Device, name: str, fade: float) -> None:
    """Of a layer that is displaced by up to some pixels, also beyond the canvas."""
    grid = GRIDS[name]
    box = (0, 0, grid.width, grid.height)
    field = ndimage.gaussian_filter(np.random.default_rng(3).normal(size=(*grid.shape, 4)), (4, 4, 0))
    field = (60 * field * (grid.lonlat[1] or 1)).astype(np.float32)
    if not grid.lonlat[1]:
        field[..., 2] = 0
    field[5:9] = 0
    out = device.upload(field)
    device.run("geometry", "geometry_within", box[2:], out, box, grid.border, grid.lonlat, fade)
    expected = twin.geometry_within(field, box, grid.border, grid.lonlat, fade)
    scale = grid.lonlat[1] or 1
    assert_close(out.get() / scale, expected / scale, 10 * POSITION, decisions=0.02)
    changed = (np.abs(expected - field)[..., :3] > 0.1 * scale).any(-1)
    assert changed.mean() < 0.5 and changed.any() == (not (grid.wraps and grid.poles == 3))
    kept = (np.abs(expected - field)[..., :3] < 1e-9).all(-1)
    assert np.array_equal(out.get()[kept, 3], field[kept, 3])


def test_what_leads_beyond_the_canvas_goes_half_of_the_way_to_its_border(device: Device) -> None:
    """And as far as it did along the border; farther in it is left as it is."""
    grid = plane(60, 40)
    field = np.zeros((40, 60, 4), np.float32)
    field[:] = -8.5, 3.25, 0, 1
    layers = [SimpleNamespace(box=(0, 0, 60, 40))]
    out = device.upload(field)
    geometry.keep_within(device, layers, [out], grid, fade=0.5)
    y, x = np.mgrid[:40, :60] + 0.5
    found = out.get()
    assert np.allclose(x + found[..., 0], np.maximum(x - 8.5, (x + 0.5) / 2), atol=1e-5)
    assert np.allclose(y + found[..., 1], np.minimum(y + 3.25, (y + 39.5) / 2), atol=1e-5)
    shortened = np.hypot(found[..., 0] + 8.5, found[..., 1] - 3.25)
    assert np.allclose(found[..., 3], np.exp(-0.5 * shortened), rtol=1e-4)


def test_a_canvas_that_wraps_ends_above_and_below(device: Device) -> None:
    """And nowhere where there are poles."""
    for grid, ends in ((plane(60, 40, wraps=True), True), (sphere(80, 40), False)):
        field = np.zeros((*grid.shape, 4), np.float32)
        field[:] = -8.5 * (grid.lonlat[1] or 1), 0, 0, 1
        field[:4] = 0, -6 if ends else 0, 0.2 * (not ends), 1
        out = device.upload(field)
        geometry.keep_within(device, [SimpleNamespace(box=(0, 0, *grid.shape[::-1]))], [out], grid)
        assert np.allclose(out.get()[4:], field[4:], atol=1e-5)
        changed = np.abs(out.get()[:4] - field[:4]).max(-1) > 0.1
        assert changed.all() if ends else not changed.any()


def test_what_is_shortened_by_a_pixel_is_not_seen_under_another_layer(device: Device) -> None:
    """A quarter of a level of 8 bits: both lie on each other no longer, and it would be there twice."""
    grid = plane(60, 40)
    field = np.zeros((40, 60, 4), np.float32)
    field[:] = -8.5, 0, 0, 1
    out = device.upload(field)
    geometry.keep_within(device, [SimpleNamespace(box=(0, 0, 60, 40))], [out], grid)
    shortened = out.get()[..., 0] + 8.5
    its = shortened > 0.99  # up to rounding
    assert 0.2 < its.mean() < 0.4
    assert (out.get()[its, 3] < 0.25 / 255).all()


@pytest.mark.usefixtures(one_device.__name__)
def test_no_other_layer_shows_at_once_along_the_border_of_the_canvas() -> None:
    """Where the brighter of two layers that lie some rows apart is displaced beyond the canvas."""
    canvas = Canvas.plane(400, 160)
    y, x = pixel_places(canvas.height, canvas.width)
    layers = []
    for down, brighter, mask in ((-5, 0, x < 280), (5, 40, x >= 120)):
        picture = texture(y + down, x, np.uint8)
        picture[..., :3] = 80 + brighter + picture[..., :3] // 3
        layers.append(masked(picture, mask))
    result = merged(layers, canvas, exposure=False, seam=False)[..., :3].mean(-1)
    steps = np.abs(np.diff(ndimage.gaussian_filter(result, (0, 12)), axis=0))[:, 130:270]
    assert steps[60:100].max() > 3 and max(steps[:45].max(), steps[-45:].max()) < 12


@pytest.mark.parametrize("name", ["plane", "sphere"])
def test_activation_and_softmax_equal_their_twins(device: Device, name: str) -> None:
    grid = GRIDS[name]
    random = np.random.default_rng(5)
    box = (7, 3, 51, 29)
    field = random.normal(size=(29, 51, 4)).astype(np.float32)
    blend = (random.random((29, 51)) * patches(6, 51, 29, 0.8)).astype(np.float32)
    blend[3, 5:9] = 1
    before = (random.random(grid.shape) * 12).astype(np.float32)
    highest, out = device.upload(before), device.upload(field)
    device.run(
        "geometry", "geometry_activation", box[2:], out, device.upload(blend), box, grid.border,
        10.0, 100.0, 77.0, 7.7, highest,
    )  # fmt: skip
    expected, top = twin.geometry_activation(field, blend, box, 10.0, 100.0, 77.0, 7.7, before)
    assert_close(out.get(), expected, TRIGONOMETRY)
    assert_close(highest.get(), top, TRIGONOMETRY)
    field[..., 3] = expected[..., 3]
    out.set(field)
    device.run(
        "geometry", "geometry_softmax", box[2:], out, device.upload(blend), box, grid.border,
        device.upload(top, np.float32),
    )  # fmt: skip
    weights = twin.geometry_softmax(field, blend, box, top)
    assert_close(out.get(), weights, TRIGONOMETRY)
    assert weights[..., 3].max() > 0.5
    assert np.array_equal(out.get()[..., 3] == 0, weights[..., 3] < 1e-45)


def test_layers_that_hardly_count_keep_their_ratio(device: Device) -> None:
    """They are all that is seen where the one that counts shows nothing. None is nothing, however faint."""
    below = np.linspace(0, 80, 21, dtype=np.float32)
    field = np.zeros((1, 22, 4), np.float32)
    field[0, :21, 3], field[0, 21, 3] = 900 - below, -5000
    blend, out = np.full((1, 22), 0.5, np.float32), device.upload(field)
    top = device.upload(np.full((1, 22), 900, np.float32))
    box = (0, 0, 22, 1)
    device.run("geometry", "geometry_softmax", box[2:], out, device.upload(blend), box, (22, 1, 0, 0), top)
    weights = out.get()[0, :, 3].astype(float)
    assert np.allclose(weights[1:21] / weights[:20], math.exp(-4), rtol=1e-3)
    assert 0 < weights[21] <= weights[20]


def test_twins_of_the_softmax_are_the_formulas() -> None:
    """One pixel by hand: exp(a_k) over the sum, with a_k of the design; and no overflow at 8 % flow."""
    sharpness, magnitude, width = 10.0, 100.0, 77.0
    blends, ways = [0.2, 0.5, 0.3], [(3.0, 4.0), (0.0, 1.0), (6.0, 0.0)]
    fields, top = [], np.zeros((1, 1))
    for blend, way in zip(blends, ways, strict=True):
        field = np.array([[[*way, 0.0, 0.0]]])
        field, top = twin.geometry_activation(
            field, np.array([[blend]]), (0, 0, 1, 1), sharpness, magnitude, width, 7.7, top
        )
        fields.append(field)
    weights = [
        twin.geometry_softmax(f, np.array([[b]]), (0, 0, 1, 1), top)[0, 0, 3]
        for f, b in zip(fields, blends, strict=True)
    ]
    activations = [
        math.fsum([sharpness * b * (1 + magnitude * min(math.hypot(*way) / (1 - b), 7.7) / width)])
        for b, way in zip(blends, ways, strict=True)
    ]
    expected = [math.exp(a) / math.fsum(map(math.exp, activations)) for a in activations]
    assert np.allclose(np.array(weights) / sum(weights), expected, rtol=1e-12)


@pytest.mark.parametrize("name", list(GRIDS))
def test_reach_equals_its_twin(device: Device, name: str) -> None:
    grid = GRIDS[name]
    box = 3, 2, grid.width - 5, grid.height - 3
    field = np.random.default_rng(7).normal(size=(box[3], box[2], 4)).astype(np.float32) * 0.1
    field[5, 6, :3] = 0, 0, -9  # down to beside the south pole
    rows = device.empty((box[3], 2))
    device.run("geometry", "geometry_reach", (box[3], 1), device.upload(field), box, grid.lonlat, rows)
    expected = twin.geometry_reach(field, box, grid.lonlat)
    by_hand = [max(math.hypot(*p[:3]) for p in row) for row in field.tolist()]
    assert np.allclose(expected[:, 0], by_hand)
    if grid.lonlat[1]:
        assert expected[5, 1] * grid.lonlat[3] > (math.pi / 2 if name == "sphere" else 1)
    else:
        assert np.allclose(expected[:, 1], [max(abs(p[1]) for p in row) for row in field.tolist()])
    result = rows.get()
    assert_close(result[:, 0], expected[:, 0], SUM)
    assert_close(result[:, 1], expected[:, 1], POSITION)


def test_reach_on_a_sphere_is_no_less_than_any_rows_way(device: Device) -> None:
    """A mean of chords ends inside the sphere: half a chord turns a direction by half its angle, which is
    more than a chord of that length does. Rows that a band needs must not be missed."""
    grid = sphere(402, 201)
    here, rows = centres(grid)
    south = np.array([0, 0, -1]) - here * -here[..., 2:]
    turned = here * math.cos(0.8) + south / np.linalg.norm(south, axis=-1, keepdims=True) * math.sin(0.8)
    reach, moved = reached(device, grid, 0.5 * (turned - here), here, rows)
    assert moved[60] == pytest.approx(0.4 / grid.lonlat[3], rel=1e-3)
    assert (moved <= reach + POSITION).all()


@pytest.mark.parametrize("seed", range(4))
def test_reach_holds_between_pixels_and_is_short_for_ways_to_the_side(device: Device, seed: int) -> None:
    """Displacements of each pixel of their own, 8 px to the side: half a pixel further their mean counts."""
    grid = sphere(402, 201)
    here, rows = centres(grid)
    random = np.random.default_rng(seed)
    east = np.stack([-here[..., 1], here[..., 0], np.zeros(rows.shape)], -1)
    east /= np.linalg.norm(east, axis=-1, keepdims=True)
    way = 8 * grid.lonlat[1] * random.uniform(-1, 1, (*rows.shape, 1)) * east
    reach, moved = reached(device, grid, way, here, rows)
    assert (moved <= reach + POSITION).all()
    assert reach[30:170].max() < 3.5 and reach[100] < 1.5
    columns, between = common.pixels(401, 200)
    place = common.canvas_point(columns + 1, between + 1, grid.lonlat)
    mean = (way[1:, 1:] + way[1:, :-1] + way[:-1, 1:] + way[:-1, :-1]) / 4
    _, y = common.canvas_position(place + mean, grid.lonlat)
    assert (np.abs(y - between - 1).max(1) <= np.maximum(reach[1:], reach[:-1]) + POSITION).all()


@pytest.mark.parametrize("middle", [0.0, 0.7, -1.2])
def test_reach_holds_where_neighbours_lead_to_both_sides(device: Device, middle: float) -> None:
    """The mean of two points of one latitude lies beyond it, by more than at the latitude of their row."""
    step = 2 * math.pi / 2048
    grid = Grid(Box(0, 0, 2048, 31), 2048, 31, True, 0, (-math.pi, step, middle + 15.5 * step, step))
    here, rows = centres(grid)
    columns, _ = common.pixels(2048, 31)
    aside, north = np.where(columns % 2, -0.35, 0.35) * math.cos(middle), 0.23 * math.cos(middle)
    there = common.canvas_point(
        columns + 0.5 + aside / step, rows + 0.5 - math.copysign(north, middle) / step, grid.lonlat
    )
    way = there - here
    reach, moved = reached(device, grid, way, here, rows)
    assert (moved <= reach + POSITION).all()
    between = common.canvas_point(columns[:, 1:] * 1.0, rows[:, 1:] + 0.5, grid.lonlat)
    _, y = common.canvas_position(between + (way[:, 1:] + way[:, :-1]) / 2, grid.lonlat)
    meant = np.abs(y - rows[:, 1:] - 0.5).max(1)
    assert (meant > moved + 0.5).all()
    assert (meant <= reach + POSITION).all()


def test_reach_of_rows_beyond_a_pole_is_that_of_their_directions(device: Device) -> None:
    """A canvas may be higher than half of its width; what is moved there is seen on the pole's other side."""
    step = 2 * math.pi / 200
    grid = Grid(Box(0, 0, 200, 120), 200, 120, True, 0, (-math.pi, step, 60 * step, step))
    here, rows = centres(grid)
    columns, _ = common.pixels(200, 120)
    way = common.canvas_point(columns + 0.8, rows + 0.5, grid.lonlat) - here
    reach, moved = reached(device, grid, way, here, rows)
    assert moved.max() > 15 and (moved <= reach + POSITION).all()


def centres(grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """The points of a grid's pixels, and their rows."""
    columns, rows = common.pixels(grid.width, grid.height)
    return common.canvas_point(columns + 0.5, rows + 0.5, grid.lonlat), rows


def reached(
    device: Device, grid: Grid, way: np.ndarray, here: np.ndarray, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Of each row what `reach` says, and how many rows its pixels are moved at most."""
    field = np.concatenate([way, np.ones((*rows.shape, 1))], -1).astype(np.float32)
    layer = on_device(device, np.ones(field.shape))
    found = geometry.reach(device, layer, device.upload(field), grid)
    _, y = common.canvas_position(here + field[..., :3], grid.lonlat)
    return np.array(found), np.abs(y - rows - 0.5).max(1)


def pair(device: Device, a: int, b: int, found: Chart, forward: np.ndarray, backward: np.ndarray) -> PairFlow:
    return PairFlow(a, b, found, device.upload(forward), device.upload(backward))


def test_two_layers_move_as_published(device: Device) -> None:
    """ColorL is read at p + F_RL(p) BlendR; F_RL starts on R. Weights are those of Code 1."""
    grid = plane()
    found = whole_chart(grid)
    share = np.tile(np.linspace(0.01, 0.99, 77, dtype=np.float32), (53, 1))
    left, right = whole(device, grid, share), whole(device, grid, 1 - share)
    lr, rl = smooth_flow(9, found), smooth_flow(10, found)
    both = [left[0], right[0]], [left[1], right[1]]
    fields = geometry.fields(device, *both, [pair(device, 0, 1, found, lr, rl)], grid, Settings())
    l_field, r_field = (f.get().astype(np.float64) for f in fields)
    blend_l, blend_r = share[..., None], 1 - share[..., None]
    assert np.allclose(l_field[..., :2], rl * blend_r, atol=1e-5)
    assert np.allclose(r_field[..., :2], lr * blend_l, atol=1e-5)
    exponents = []
    for blend, flow in ((blend_l, rl), (blend_r, lr)):
        long = np.linalg.norm(flow, axis=-1)
        exponents.append(10 * blend[..., 0] * (1 + 100 * np.minimum(long, 7.7) / 77))
    expected = 1 / (1 + np.exp(exponents[1] - exponents[0]))
    total = l_field[..., 3] + r_field[..., 3]
    assert np.allclose(l_field[..., 3] / total, expected, atol=1e-4)


@pytest.mark.parametrize("overlapping", [[(0, 1), (0, 2), (1, 2)], [(0, 2), (1, 2)], [(1, 2)]])
def test_more_layers_add_up(device: Device, overlapping: list[tuple[int, int]]) -> None:
    """x_k = p + sum over j of w_j F_jk: three layers with constant flows between them, or some of them."""
    grid = plane()
    found = whole_chart(grid)
    blends = (0.2, 0.3, 0.5)
    parts = [whole(device, grid, blend) for blend in blends]
    layers, coefficients = [p[0] for p in parts], [p[1] for p in parts]
    ways = {(0, 1): (1.0, -2.0), (0, 2): (-3.0, 0.5), (1, 2): (-4.0, 2.5)}
    ways = {both: ways[both] for both in overlapping}
    for used in [device.empty((*grid.shape, 4)).fill(np.nan) for _ in range(6)]:
        del used  # what was in the memory of fields must not count

    def constant(way: tuple[float, float], sign: int) -> np.ndarray:
        return np.broadcast_to(np.float32(way) * np.float32(sign), (found.height, found.width, 2))

    flows = [pair(device, a, b, found, constant(w, 1), constant(w, -1)) for (a, b), w in ways.items()]
    fields = [f.get() for f in geometry.fields(device, layers, coefficients, flows, grid, Settings())]
    assert not flows
    for k, field in enumerate(fields):
        expected = np.zeros(2)
        for (a, b), way in ways.items():
            if k == b:
                expected += blends[a] * np.array(way)
            elif k == a:
                expected -= blends[b] * np.array(way)
        assert np.allclose(field[..., :2], expected, atol=1e-5)


@pytest.mark.parametrize("name", ["plane", "cylinder", "sphere"])
def test_identical_layers_do_not_move(device: Device, name: str) -> None:
    grid = GRIDS[name]
    found = whole_chart(grid)
    parts = [whole(device, grid, 0.5) for _ in range(2)]
    zero = np.zeros((found.height, found.width, 2), np.float32)
    fields = geometry.fields(
        device, [p[0] for p in parts], [p[1] for p in parts], [pair(device, 0, 1, found, zero, zero)],
        grid, Settings(),
    )  # fmt: skip
    for field in fields:
        assert not field.get()[..., :3].any()
        assert (field.get()[..., 3] == 1).all()


def test_displacement_over_the_pole_is_continuous(device: Device) -> None:
    """A constant flow on a chart over the pole: the displacement, as a difference of points, hardly changes
    from pixel to neighbour, also across row 0, half a turn further; and it is the chart's own way."""
    grid = sphere(402, 201)
    columns, rows = common.pixels(402, 201)
    point = common.canvas_point(columns + 0.5, rows + 0.5, grid.lonlat)
    near = np.arccos(point[..., 2]) < 0.4
    found = pair_chart(near, grid, grid)
    way = np.array([4.0, -3.0], np.float32)
    flow = np.broadcast_to(way, (found.height, found.width, 2))
    parts = [whole(device, grid, 0.5) for _ in range(2)]
    fields = geometry.fields(
        device, [p[0] for p in parts], [p[1] for p in parts], [pair(device, 0, 1, found, flow, -flow)],
        grid, Settings(),
    )  # fmt: skip
    d = fields[1].get()[..., :3].astype(np.float64)
    step = grid.lonlat[1]
    # 5 px of angle, half of it for this layer; stretched where the chart's rows are
    assert np.allclose(np.linalg.norm(d[near], axis=-1), 2.5 * step, rtol=0.1)
    across = np.linalg.norm(d[0] - np.roll(d[0], 201, 0), axis=-1)
    along = np.linalg.norm(d[:8] - np.roll(d[:8], 1, 1), axis=-1)
    down = np.linalg.norm(d[:7] - d[1:8], axis=-1)
    assert max(across.max(), along.max(), down.max()) < 0.05 * step
    u, v = common.chart_position(point[near], found.transform)
    there = common.chart_point(u + way[0], v + way[1], found.transform)
    assert np.allclose(d[near], 0.5 * (there - point[near]), atol=2 * flow_error(grid))


def test_motion_across_the_border_is_short(device: Device) -> None:
    """On a cylinder the displacement beside the border is the flow, not a turn."""
    grid = plane(wraps=True)
    overlap = np.zeros(grid.shape, bool)
    overlap[10:40, :8] = overlap[10:40, -8:] = True
    found = pair_chart(overlap, grid, grid)
    assert not found.wraps
    flow = np.broadcast_to(np.float32([6, 1]), (found.height, found.width, 2))
    parts = [whole(device, grid, 0.5) for _ in range(2)]
    fields = geometry.fields(
        device, [p[0] for p in parts], [p[1] for p in parts], [pair(device, 0, 1, found, flow, -flow)],
        grid, Settings(),
    )  # fmt: skip
    assert np.allclose(fields[1].get()[overlap][:, :2], [3, 0.5], atol=1e-4)
    assert np.allclose(fields[0].get()[overlap][:, :2], [-3, -0.5], atol=1e-4)

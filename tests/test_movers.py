"""Things that moved by themselves, in scenes whose every point is known: found, and no others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from rooms import Thing
from scenes import LEFT, UP, Scene, scene
from scipy import ndimage

from hugin_abflow.cells import CELL, LEAST_CELLS, SingleSource

Array = np.ndarray


def near(mask: Array, by: int, wraps: bool) -> Array:
    """A mask and what is up to so many pixels beside it, or with a negative number what is as far inside."""
    tiled = np.pad(mask, ((0, 0), (60, 60)), mode="wrap" if wraps else "constant")
    away = ndimage.distance_transform_edt(~tiled) - ndimage.distance_transform_edt(tiled)
    return (away <= by)[:, 60:-60]


MIDDLE = np.s_[CELL // 2 :: CELL, CELL // 2 :: CELL]


def grown(cells: Array, wraps: bool) -> Array:
    """With three cells around."""
    tiled = np.pad(cells, ((0, 0), (9, 9)), mode="wrap" if wraps else "constant")
    return ndimage.binary_dilation(tiled, np.ones((7, 7)))[:, 9:-9]


def assert_found(found: SingleSource | None, of: Scene, *numbers: int) -> None:
    """Just these things are, in each photo where it shows them: in cells whose middle does, perhaps in those
    where one of the other photo leads, and in those around."""
    assert found is not None
    wraps = of.chart.wraps
    for cells, index in ((found.first, 0), (found.second, 1)):
        here, there = (
            np.logical_or.reduce([of.shown[number][k][MIDDLE] for number in numbers])
            for k in (index, 1 - index)
        )
        rows, columns = (CELL * n + CELL // 2 for n in np.nonzero(there))
        ends = np.stack([columns, rows], 1) + 0.5 + of.flows[1 - index][rows, columns]
        columns, rows = np.floor(ends).astype(int).T
        columns = columns % of.chart.width if wraps else columns
        reached = np.zeros_like(here)
        reached[
            tuple(np.minimum(n // CELL, m - 1) for n, m in zip((rows, columns), here.shape, strict=True))
        ] = 1
        assert here.any()
        assert cells[grown(here, wraps)].all()
        assert not cells[~grown(here | reached, wraps)].any()


AHEAD = (0.0, 1.0, 0.0)
BOTH = pytest.mark.parametrize("wraps", [False, True])
few = settings(max_examples=20)


@BOTH
@pytest.mark.parametrize("step", [UP, -UP, 0.6 * UP, 3 * LEFT, LEFT + UP])
def test_what_took_a_step_is_found_where_it_is(wraps: bool, step: Array) -> None:
    """Up, down, by half of its own width, away with the camera but farther, and both."""
    one = scene(Thing(AHEAD, step), wraps=wraps)
    assert_found(one.found(), one, 0)


@few
@given(angle=st.floats(0, 2 * np.pi), ahead=st.floats(-0.35, 0.35), away=st.floats(0, 2 * np.pi))
def test_it_is_found_whichever_way_camera_and_thing_went(angle: float, ahead: float, away: float) -> None:
    """Across the camera's move or against that of still things, by enough."""
    middle = np.array([np.sin(ahead), np.cos(ahead), 0.1])
    move = 0.12 * np.array([np.cos(angle), 0, np.sin(angle)])
    step = 0.12 * np.array([np.cos(away), 0, np.sin(away)])
    assume(np.cos(angle - away) > 0.95 or -0.3 < np.cos(angle - away) < 0.7)
    one = scene(Thing(tuple(middle), 2.5 * step if np.cos(angle - away) > 0.9 else step), move=move)
    assert_found(one.found(), one, 0)


@few
@given(
    distance=st.floats(0.8, 2), angle=st.floats(0, 2 * np.pi), ahead=st.floats(-0.4, 0.4),
    share=st.floats(-1, 0.9),
)  # fmt: skip
def test_what_moves_as_parallax_does_stands_still(
    distance: float, angle: float, ahead: float, share: float
) -> None:
    """However near it is; who walks along with the camera, or towards it, looks like a farther or nearer
    thing."""
    move = 0.12 * np.array([np.cos(angle), 0.1, np.sin(angle)])
    middle = (np.sin(ahead), np.cos(ahead), -0.05)
    assert scene(Thing(middle, 0 * move, 0.15, distance), move=move).found() is None
    assert scene(Thing(middle, share * move, 0.15, distance), move=move).found() is None


@BOTH
def test_a_near_edge_that_is_matched_farther_along_itself_stands_still(wraps: bool) -> None:
    """It shifts as near things do, and a little along itself: what moves by itself goes elsewhere."""
    one = scene(Thing(AHEAD, 0.4 * UP - LEFT), wraps=wraps)
    assert np.linalg.norm(one.flows[0][one.shown[0][0]], axis=-1).min() > 8
    assert one.found() is None


@BOTH
def test_a_scene_in_which_nothing_moved_has_none(wraps: bool) -> None:
    assert scene(wraps=wraps).found() is None


def test_things_at_the_border_of_a_chart_that_wraps_are_found() -> None:
    """Across it, if each side is large enough; close to it, for what is beside is told across it, too; and on
    one side in one photo, on the other in the other."""
    for longitude, size, step in (
        (np.pi, 0.2, UP),
        (np.pi - 0.14, 0.12, UP),
        (0.14 - np.pi, 0.12, 3 * UP - 3 * LEFT),
    ):
        one = scene(Thing((np.sin(longitude), np.cos(longitude), 0.05), step, size), wraps=True)
        (first, second) = one.shown[0]
        assert first[:, :4].any() or first[:, -4:].any()
        assert (first[:, :384].any() and second[:, 384:].any()) == (longitude != np.pi - 0.14)
        assert_found(one.found(), one, 0)


def test_two_things_are_found_and_one_that_stands_still_is_not() -> None:
    middles = ((0.3, 1.0, 0.15), (-0.25, 1.0, -0.2), (-0.2, 1.0, 0.2))
    one = scene(*(Thing(at, step) for at, step in zip(middles, (UP, -UP, 0 * UP), strict=True)))
    assert_found(one.found(), one, 0, 1)


def test_plain_things_are_left_alone() -> None:
    """A wall without texture is matched with itself anywhere; what has some is not."""
    for textured, expected in (((False, False), 0), ((False, True), 1)):
        one = scene(Thing(AHEAD, UP, 0.15), textured=textured)
        assert (one.found() is not None) == expected


@pytest.mark.parametrize("index", [0, 1])
def test_photos_are_compared_where_each_shows_the_things_place(index: int) -> None:
    """A thing that one photo alone shows with texture, in a plain room, and a move by more than its width:
    elsewhere nothing differs."""
    plain = scene(Thing(AHEAD, 2.6 * UP, 0.11), move=4 * LEFT, textured=(False, False))
    spotted = scene(Thing(AHEAD, 2.6 * UP, 0.11), move=4 * LEFT, textured=(False, True))
    views = list(plain.views)
    assert plain.found() is None
    views[index] = spotted.views[index]
    found = replace(plain, views=tuple(views)).found()
    assert found is not None
    assert (found.first, found.second)[index][plain.shown[0][index][MIDDLE]].all()
    flow, shown = plain.flows[index], plain.shown[0][index]
    assert np.linalg.norm(flow[~shown], axis=-1).min() > 9
    moved_by = np.round(flow[~near(shown, 3, False) & near(shown, 9, False)].mean(0)).astype(int)
    for way in (1, -1):
        # where the other photo would show the place if it did not move, or moved the other way
        image = np.roll(spotted.views[index].image, way * moved_by, (1, 0))
        views[index] = replace(plain.views[index], image=image)
        assert replace(plain, views=tuple(views)).found() is None


def test_flow_that_the_photos_do_not_ask_for_is_left_alone() -> None:
    """It leads back, over texture, but the photos agree if the place moves as what is around does."""
    assert replace(scene(), flows=scene(Thing(AHEAD, UP)).flows).found() is None


def test_a_plain_thing_is_found_where_both_photos_show_a_part_of_its_place() -> None:
    """One that left it wholly looks like a place that one photo shows darker: seams see to that."""
    for step, expected in ((1, True), (2, True), (3, False)):
        one = scene(Thing(AHEAD, step * UP, 0.1), textured=(False, False))
        views = tuple(
            replace(view, image=view.image - 1.5 * shown)
            for view, shown in zip(one.views, one.shown[0], strict=True)
        )
        assert (replace(one, views=views).found() is not None) == expected


@pytest.mark.parametrize("index", [0, 1])
def test_a_photo_that_is_darker_in_a_place_has_no_thing_there(index: int) -> None:
    """Towards a lens's border, say: all of it by about as much, and by more than what is around. What took a
    step there is found still."""
    he = scene(Thing(AHEAD, UP))
    place = near(he.shown[0][0] | he.shown[0][1], 8, False).astype(np.float32)
    darker = 0.8 * ndimage.gaussian_filter(place, 3)
    for one, expected in ((replace(scene(), flows=he.flows), False), (he, True)):
        views = list(one.views)
        views[index] = replace(views[index], image=views[index].image - darker)
        assert (replace(one, views=tuple(views)).found() is not None) == expected


def test_what_differs_as_little_as_noise_is_left_alone() -> None:
    """The same scene with a tenth of its contrast; few pixels that differ by far do not make up for it."""
    one = scene(Thing(AHEAD, UP, 0.15))
    faint = tuple(replace(view, image=0.1 * view.image) for view in one.views)
    assert replace(one, views=faint).found() is None
    spots = []
    for view, dots in zip(one.views, (0, 5), strict=True):
        image = 0.1 * view.image
        image[dots::12, dots::12] = 30.0
        spots.append(replace(view, image=image))
    assert replace(one, views=tuple(spots)).found() is None


def test_a_few_cells_are_no_thing() -> None:
    for size, expected in ((0.07, False), (0.1, True)):
        one = scene(Thing(AHEAD, UP, size))
        assert (one.found() is not None) == expected
        assert (one.shown[0][0].sum() / CELL**2 > LEAST_CELLS) == expected


def test_a_small_step_is_no_step() -> None:
    """Less than the flow's own error: half a degree, on this chart a pixel."""
    assert scene(Thing(AHEAD, 0.15 * UP, 0.15)).found() is None


def test_what_misses_parallax_by_less_belongs_to_the_thing_beside_it() -> None:
    """A leg that stands nearly still, below somebody; by itself it is nothing."""
    body, leg = Thing((0, 1, 0.1), UP, 0.14), Thing((0, 1, -0.12), 0.25 * UP, 0.14)
    assert scene(leg).found() is None
    one = scene(body, leg)
    assert_found(one.found(), one, 0, 1)


def test_a_near_thing_with_an_edge_where_flow_errs_is_no_mover() -> None:
    """By itself the edge would be one."""
    thing, edge = Thing(AHEAD, 0.25 * UP, 0.35), Thing((0, 1, -0.15), UP, 0.1)
    assert scene(edge).found() is not None
    assert scene(thing, edge).found() is None


@pytest.mark.parametrize(("strength", "steps"), [(0.5, (0.6, 1, 2)), (2.0, (1, 2)), (3.0, (2,))])
def test_where_all_flow_misses_parallax_a_thing_has_to_miss_it_by_more(
    strength: float, steps: tuple[float, ...]
) -> None:
    """Photos that are a little out of place: by some px, slowly up and down, there and back alike."""
    for step in (0.6, 1, 2):
        one = scene(Thing(AHEAD, step * UP))
        rows, columns = np.mgrid[: one.chart.height, : one.chart.width]
        wave = strength * np.sin(columns / 12) * np.cos(rows / 15)
        for flow, sign in zip(one.flows, (1, -1), strict=True):
            flow[..., 1] += sign * wave
        assert (one.found() is not None) == (step in steps)


def test_an_unknown_move_tells_nothing() -> None:
    """Flow that leads back, but each where it likes; and flow that does not lead back."""
    one = scene(Thing(AHEAD, UP))
    rng = np.random.default_rng(1)
    for waves in (True, False):
        flow = rng.normal(size=one.flows[0].shape).astype(np.float32) * 6
        if waves:
            flow = ndimage.gaussian_filter(flow, (9, 9, 0)) * 30
        assert replace(one, flows=(flow, -flow)).found() is None
    back = one.flows[1] + rng.normal(size=one.flows[1].shape) * 6
    assert replace(one, flows=(one.flows[0], back.astype(np.float32))).found() is None
    still = np.zeros_like(one.flows[0])
    assert replace(one, flows=(still, still)).found() is None


def test_where_directions_are_not_known_nothing_is() -> None:
    one = scene(Thing(AHEAD, UP))
    assert replace(one, chart=replace(one.chart, projection=None)).found() is None


def far_away(wraps: bool) -> tuple[Scene, Scene]:
    """Somebody who went so far that flow follows what is behind him, and the flow that would follow him."""
    he, nobody = scene(Thing(AHEAD, 2 * UP), wraps=wraps), scene(wraps=wraps)
    return replace(he, flows=nobody.flows), he


@BOTH
def test_flow_that_was_refused_shows_who_moved(wraps: bool) -> None:
    kept, he = far_away(wraps)
    assert kept.found() is None
    found = kept.found(refused=he.flows)
    assert found is not None
    for cells, shown in zip((found.first, found.second), he.shown[0], strict=True):
        middles = shown[MIDDLE]
        assert cells[middles].mean() > 0.8  # but where he leaves the chart
        assert not cells[~grown(grown(middles, wraps), wraps)].any()


@BOTH
def test_refused_flow_has_to_lead_back(wraps: bool) -> None:
    """What a search finds in one direction alone may be anything."""
    kept, he = far_away(wraps)
    assert kept.found(refused=(he.flows[0], kept.flows[1])) is None
    assert kept.found(refused=kept.flows) is None


@BOTH
def test_photos_that_change_places_change_the_places_of_what_is_found(wraps: bool) -> None:
    one = scene(Thing((-0.2, 1.0, 0.1), UP + 2 * LEFT), wraps=wraps)
    found = one.found()
    turned = replace(one, flows=one.flows[::-1], views=one.views[::-1]).found()
    assert found is not None and turned is not None
    assert np.array_equal(found.first, turned.second) and np.array_equal(found.second, turned.first)
    assert not np.array_equal(found.first, found.second)


@BOTH
def test_what_somebody_vouches_for_is_left_alone(wraps: bool) -> None:
    """Whichever photo is the first; the other thing is found still, and so it is if points say otherwise."""
    one = scene(Thing((0.3, 1, 0.05), UP), Thing((-0.3, 1, 0.05), -UP), wraps=wraps)
    assert_found(one.found(), one, 0, 1)
    for thing in (0, 1):
        starts, ends = one.vouch(thing)
        assert len(starts) > 1
        assert_found(one.found((starts, ends)), one, 1 - thing)
        turned = replace(one, flows=one.flows[::-1], views=one.views[::-1]).found((ends, starts))
        assert turned is not None
        assert_found(SingleSource(turned.second, turned.first), one, 1 - thing)
    for off in ((0, 8), (0, -8), (8, 0)):
        assert_found(one.found(one.vouch(0, off)), one, 0, 1)


def test_points_beside_the_chart_vouch_for_nothing() -> None:
    one = scene(Thing((0.2, 1.0, 0.1), UP))
    width, height = one.chart.width, one.chart.height
    beside = np.array([[-3.0, 5.0], [5.0, -3.0], [width + 9.0, 5.0], [5.0, height + 9.0]])
    assert_found(one.found((beside, beside)), one, 0)


def test_what_only_one_photo_shows_is_not_told() -> None:
    """Where the thing is, or where it went, the other photo ends; or shows enough of it still."""
    one = scene(Thing(AHEAD, UP, 0.15))
    for index in (0, 1):
        for reach, expected in ((8, False), (-12, True)):
            mask = one.views[index].mask.copy()
            rows = np.flatnonzero(one.shown[0][index].any(1))
            mask[: (rows[-1] if reach > 0 else rows[0]) + reach] = 0
            views = list(one.views)
            views[index] = replace(one.views[index], mask=mask)
            assert (replace(one, views=tuple(views)).found() is not None) == expected


@BOTH
def test_what_crosses_the_overlap_is_left_alone(wraps: bool) -> None:
    """Taken from either photo, it would break at that one's border. What one photo shows as far as the other
    one does is found: where one border crosses it, and where both photos end, so that nothing goes on.
    """
    one = scene(Thing(AHEAD, UP, 0.15), wraps=wraps)
    columns = np.flatnonzero(one.shown[0][0].any(0))
    beside = np.s_[columns[0] - 16 : columns[-1] + 17]
    rows = [np.flatnonzero(shown.any(1)) for shown in one.shown[0]]
    top, bottom = max(its[0] for its in rows) + 8, min(its[-1] for its in rows) - 8
    nothing = np.s_[:0]
    for first, second, expected in (
        (nothing, nothing, True),
        (np.s_[:top], nothing, True),
        (nothing, np.s_[bottom:], True),
        (np.s_[:top], np.s_[:top], True),
        (np.s_[:top], np.s_[bottom:], False),
    ):
        views = []
        for view, gone in zip(one.views, (first, second), strict=True):
            mask = view.mask.copy()
            mask[gone, beside] = 0
            views.append(replace(view, mask=mask))
        for flows, seen in ((one.flows, views), (one.flows[::-1], views[::-1])):
            assert (replace(one, flows=flows, views=tuple(seen)).found() is not None) == expected


@pytest.mark.parametrize("index", [0, 1])
def test_flow_beside_a_mask_tells_nothing_of_the_move(index: int) -> None:
    """A third of the chart, of which one photo shows nothing; flow has been carried there, anyhow, and leads
    back."""
    one = scene(Thing((0.2, 1.0, 0.1), UP))
    flows, views = [flow.copy() for flow in one.flows], list(one.views)
    anyhow = ndimage.gaussian_filter(np.random.default_rng(3).normal(size=flows[0].shape), (9, 9, 0)) * 60
    for flow, sign in zip(flows, (1, -1), strict=True):
        flow[:, :60] = sign * anyhow[:, :60]
    assert replace(one, flows=tuple(flows)).found() is None
    mask = one.views[index].mask.copy()
    mask[:, :64] = 0
    views[index] = replace(one.views[index], mask=mask)
    assert_found(replace(one, flows=tuple(flows), views=tuple(views)).found(), one, 0)


def test_what_is_beside_a_mask_does_not_count_as_a_difference() -> None:
    """A plain scene, in which a photo's colours beside its mask are others."""
    one = scene(Thing(AHEAD, UP, 0.15), textured=(False, False))
    views = []
    for view in one.views:
        mask = np.ones_like(view.mask)
        mask[::12] = 0
        views.append(replace(view, image=np.where(mask > 0, view.image, 9.0), mask=mask))
    assert replace(one, views=tuple(views)).found() is None


def test_what_one_flow_alone_shows_is_told_of_both_photos() -> None:
    """The other flow leads back from less than a thing's worth of cells."""
    one = scene(Thing(AHEAD, UP, 0.15))
    back = one.flows[1].copy()
    shown = one.shown[0][1]
    rows = np.flatnonzero(shown.any(1))
    gone = shown.copy()
    gone[len(rows) // 4 + rows[0] :] = False
    back[shown & ~gone] = back[~shown].mean(0)
    found = replace(one, flows=(one.flows[0], back)).found()
    assert found is not None
    assert found.first[one.shown[0][0][MIDDLE]].all()
    assert found.second[gone[MIDDLE]].all()


def test_flow_that_does_not_lead_back_tells_nothing_of_the_other_photo() -> None:
    """Of a thing, a part of whose flow is astray; where it leads, nothing is."""
    one = scene(Thing((-0.2, 1, 0), UP, 0.15))
    astray = one.flows[0].copy()
    rows = np.flatnonzero(one.shown[0][0].any(1))
    part = one.shown[0][0].copy()
    part[rows[0] + len(rows) // 3 :] = False
    astray[part] += (50, 0)
    assert_found(replace(one, flows=(astray, one.flows[1])).found(), one, 0)

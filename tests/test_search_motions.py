"""Large motions whose truth is known, found by the whole flow with its search."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from scipy import ndimage

from hugin_abflow import flow, quality, search
from hugin_abflow.flow import FlowParameters
from hugin_abflow.grid import Border
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.pyramid import Level
from hugin_abflow.settings import LargeMotion


def texture(seed: int, width: int, height: int) -> np.ndarray:
    """Brightness 0.1 to 1 with detail of all scales."""
    random = np.random.default_rng(seed)
    total = sum(
        ndimage.gaussian_filter(random.normal(size=(height, width)), sigma) * sigma for sigma in (1.5, 4, 10)
    )
    return 0.55 + 0.45 * np.tanh(total / (1.5 * total.std()))


def on_device(device: Device, brightness: np.ndarray, mask: np.ndarray) -> Level:
    image = np.log(brightness + 0.05) * mask
    return Level(device.upload(image.astype(np.float32)), device.upload(mask.astype(np.float32)), False)


@pytest.mark.parametrize("by", [(37, 0), (-37, 6), (4, 30)])
def test_motion_of_a_tenth_of_the_width_is_found(device: Device, by: tuple[int, int]) -> None:
    """In both directions, where the other image shows it."""
    wide, whole = texture(35, 500, 340), np.ones((217, 371))
    a = wide[60:277, 60:431]
    b = wide[60 - by[1] : 277 - by[1], 60 - by[0] : 431 - by[0]]
    ways = flow.pair_flow(device, on_device(device, a, whole), on_device(device, b, whole))
    y, x = np.mgrid[0:217, 0:371]
    for field, way in zip(ways, (by, (-by[0], -by[1])), strict=True):
        inside = (x + way[0] >= 2) & (x + way[0] < 369) & (y + way[1] >= 2) & (y + way[1] < 215)
        error = np.linalg.norm(field.get() - np.array(way), axis=-1)[inside]
        assert np.median(error) < 0.05
        assert (error < 1).mean() > 0.97


@pytest.mark.parametrize(("always", "found"), [(False, False), (True, True)])
def test_what_makes_images_no_more_alike_is_dropped(
    device: Device, monkeypatch: pytest.MonkeyPatch, always: bool, found: bool
) -> None:
    """A search that offers nonsense: only where it is always believed the flow is not what it is without. Nor
    is it motion that was refused, of which somebody who moved might be told."""
    a, whole = texture(36, 371, 217), np.ones((217, 371))
    images = [on_device(device, image, whole) for image in (a, np.roll(a, 2, 1))]
    solved = flow.solve(device, *images, reach=0.0)
    without = (solved.forward, solved.backward)

    def nonsense(_: Device, __: Buffer, stacked: Buffer, *___: object) -> Buffer:
        return device.upload(stacked.get() + np.float32(9))

    monkeypatch.setattr(flow, "_choose", nonsense)
    parameters = quality.flow_parameters("normal", "on" if always else "auto")
    solution = flow.solve(device, *images, parameters)
    flows = solution.forward, solution.backward
    assert all(np.array_equal(f.get(), w.get()) for f, w in zip(flows, without, strict=True)) != found
    assert not solution.refused


def board(
    middle: int, half: tuple[int, int], shift: int, background: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """A board before a wall, moved to the right by so many px, as the wall is; and where it is."""
    wall, front = texture(37, 371, 217), 1.05 - texture(38, 371, 217)
    y, x = np.mgrid[0:217, 0:371]
    there = (np.abs(x - shift - middle) < half[0]) & (np.abs(y - 100) < half[1])
    return np.where(there, np.roll(front, shift, 1), np.roll(wall, background, 1)), there


@pytest.mark.parametrize("large_motion", ["auto", "on"])
def test_a_small_thing_that_moves_far_is_found_if_wanted(device: Device, large_motion: LargeMotion) -> None:
    """A board of 40 x 60 px moves by 33 px in front of a wall that stands. It might be somebody who walked,
    for whom no flow is right."""
    (a, in_a), (b, _) = (board(160, (20, 30), shift) for shift in (0, 33))
    whole = np.ones(a.shape)
    parameters = quality.flow_parameters("normal", large_motion)
    forward, _ = flow.pair_flow(device, on_device(device, a, whole), on_device(device, b, whole), parameters)
    error = np.linalg.norm(forward.get() - np.where(in_a[..., None], (33, 0), (0, 0)), axis=-1)
    right = (error[ndimage.binary_erosion(in_a, iterations=6)] < 1).mean()
    assert right > 0.9 if large_motion == "on" else right < 0.1
    still = ~ndimage.binary_dilation(in_a, iterations=6) & ~ndimage.binary_dilation(
        np.roll(in_a, 33, 1), iterations=6
    )
    assert (error[still] < 0.5).mean() > 0.97


def test_of_what_is_found_a_part_that_fits_worse_is_dropped(device: Device) -> None:
    """A board that fills much moves by 12 px, the wall stands. What was found has that right, and a patch of
    the wall wrong."""
    (a, in_a), (b, in_b) = (board(120, (90, 80), shift) for shift in (0, 12))
    images = [on_device(device, image, np.ones(a.shape)) for image in (a, b)]
    features = flow.finest_features(device, images, FlowParameters())
    y, x = np.mgrid[0:217, 0:371]
    patch = (np.abs(x - 320) < 15) & (np.abs(y - 100) < 20)
    plain, found = np.zeros((2, 2, *a.shape, 2), np.float32)
    for way, (board_there, by) in enumerate(((in_a, 12), (in_b, -12))):
        found[way, board_there, 0] = by
        found[way, patch] = 7, -4
    flows = [device.upload(one) for one in (plain, found)]
    grid = images[0].grid
    left, refused = flow._decide(device, features, flows, grid, 1, None, FlowParameters())
    assert not refused
    found[:, patch] = 0
    assert np.array_equal(left[0].get(), found) and len(left) == 1
    (both, also), _ = flow._decide(device, features, flows, grid, 2, None, FlowParameters())
    assert both is flows[0] and also is flows[1]  # it is not decided there


def test_rails_before_a_near_surface_follow_the_frame_they_belong_to(device: Device) -> None:
    """8 px wide, on cloth that moves by 20 px, they and their frame by 30. They show on fine levels alone."""
    y, x = np.mgrid[0:300, 0:420]
    right = []
    for seed in (51, 71, 81):
        wall, cloth, wood = (texture(seed + index, 420, 300) for index in range(3))

        def view(far: int, near: int, nearest: int, wall=wall, cloth=cloth, wood=wood):
            column = x - nearest
            between = (column > 150) & (column < 270) & (y >= 90) & (y < 230)
            rails = between & (np.abs((column - 150) % 24 - 12) < 4)
            frame = (column > 140) & (column < 280) & ((np.abs(y - 70) < 20) | (np.abs(y - 240) < 10))
            seat = (x - near > 120) & (x - near < 300) & (y >= 90) & (y < 260)
            image = np.where(seat, 0.3 + 0.5 * np.roll(cloth, near, 1), np.roll(wall, far, 1))
            return np.where(rails | frame, 0.1 + 0.15 * np.roll(wood, nearest, 1), image), rails

        (a, rails), (b, _) = view(0, 0, 0), view(3, 20, 30)
        images = [on_device(device, image, np.ones(image.shape)) for image in (a, b)]
        forward, _ = flow.pair_flow(device, *images, quality.flow_parameters("normal", "on"))
        right.append((np.linalg.norm(forward.get()[rails] - (30, 0), axis=-1) < 2).mean())
    assert np.mean(right) > 0.68  # .53 where coarser levels alone take over flow from beside


@pytest.mark.parametrize(("by", "kept"), [(33, True), (-33, False)])
def test_a_small_thing_that_moves_as_near_things_do_is_found(device: Device, by: int, kept: bool) -> None:
    """The wall moves by 3 px to the right: the camera moved left, and what is near moves far to the right.
    What goes left walked."""

    def bearings(places: np.ndarray) -> np.ndarray:
        lon, lat = (places[:, 0] - 185) / 300, (108 - places[:, 1]) / 300
        return np.stack([np.cos(lat) * np.sin(lon), np.cos(lat) * np.cos(lon), np.sin(lat)], 1)

    (a, in_a), (b, _) = board(180, (20, 30), 0), board(180, (20, 30), by, 3)
    images = [on_device(device, image, np.ones(a.shape)) for image in (a, b)]
    solved, inner = flow.solve(device, *images, bearings=bearings), ndimage.binary_erosion(in_a, iterations=6)
    inside = solved.forward.get()[inner]
    assert ((np.linalg.norm(inside - (by, 0), axis=-1) < 1).mean() > 0.9) == kept
    assert (not solved.refused) == kept
    for refused in solved.refused[:1]:  # who walked is told from it
        forward, backward = refused.finest(371, 217)
        assert forward.shape == backward.shape == (217, 371, 2)
        assert (np.linalg.norm(forward[inner] - (by, 0), axis=-1) < 2).mean() > 0.75
        there = np.roll(inner, by, 1)
        assert (np.linalg.norm(backward[there] + (by, 0), axis=-1) < 2).mean() > 0.75


def test_a_narrow_overlap_shows_all_of_its_motion(device: Device) -> None:
    """17 px wide, moved by 4.5 px across: the whole of it, not a part."""
    wide = ndimage.zoom(texture(39, 40, 160), 2, order=3)  # smooth enough to move by halves: 80 x 320
    y, x = np.mgrid[0:300, 0:49].astype(np.float64)
    a, b = (ndimage.map_coordinates(wide, [y + 8, x + 12 + shift], order=3) for shift in (0.0, 4.5))
    left, right = (x < 33).astype(np.float64), (x >= 16).astype(np.float64)
    forward, backward = flow.pair_flow(device, on_device(device, a, left), on_device(device, b, right))
    seen = (x >= 21) & (x < 33)  # what a shows there, b shows too
    assert np.median(forward.get()[seen][:, 0]) == pytest.approx(-4.5, abs=0.15)
    assert np.median(backward.get()[(x >= 16) & (x < 28)][:, 0]) == pytest.approx(4.5, abs=0.15)


def test_small_overlaps_of_a_large_chart_take_no_more_memory_than_is_reckoned(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two corners allow for little motion, which a fine level would do for; that is of the whole chart."""
    monkeypatch.setattr(search, "_LEAST_ROOM", 1 << 20)
    costs, taken = search.costs, [0]

    def watched(*arguments: Any, room: Sequence[Buffer], **_: Any) -> Buffer:
        taken.append(sum(one.nbytes for one in room))
        return costs(*arguments, room)

    monkeypatch.setattr(search, "costs", lambda *given: watched(*given[:-1], room=given[-1]))
    brightness, parameters = texture(40, 371, 217), FlowParameters()
    y, x = np.mgrid[0:217, 0:371]
    spots = ((x < 14) & (y < 10)) | ((x >= 357) & (y >= 207))
    above = y < x * 217 / 371
    a, b = (on_device(device, brightness, (mask | spots).astype(float)) for mask in (above, ~above))
    flow.solve(device, a, b, parameters, reach=60)
    grid = Border(371, 217, 0)
    assert 0 < max(taken) <= flow.search_room(60, grid, parameters) < 200 * 371 * 217 + (1 << 20)
    taken.clear()
    flow.solve(device, a, a, parameters, reach=60)  # all of it
    assert 0 < max(taken) <= flow.search_room(60, grid, parameters)

"""Gains: the solver against dense least squares, and what it makes of differences."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from grids import plane, sphere

from hugin_abflow import gains
from hugin_abflow.gains import Difference, Measured
from hugin_abflow.grid import Grid

STRICT = pytest.mark.parametrize("strict", [False, True], ids=["normal", "strict"])


def solved(measured: Measured, strict: bool = False, unknown: np.ndarray | None = None) -> np.ndarray:
    """Gains (layers, height, width, 3); 0 beside the layers' cells."""
    result = np.zeros((*measured.inside.shape, 3))
    result[measured.inside] = gains.solve(measured, strict, unknown)
    return result


def slopes(mask: np.ndarray, area: np.ndarray, wraps: bool) -> list[tuple]:
    """Neighbouring cells of a mask, row and column of each, and how stiff the step between them is."""
    found, width = [], mask.shape[1]
    for y, x in np.argwhere(mask):
        right = (x + 1) % width
        if (right > x or wraps) and mask[y, right]:
            found.append(((y, x), (y, right), 1 / area[y]))
        if y + 1 < len(mask) and mask[y + 1, x]:
            found.append(((y, x), (y + 1, x), math.sqrt(area[y] * area[y + 1])))
    return found


def dense_gains(measured: Measured, strict: bool, unknown: np.ndarray) -> np.ndarray:
    """The minimum of the sum in gains.py by least squares, of blocks where differences weigh little."""
    cells, inside = measured.grid, measured.inside
    (_, height, width), index = inside.shape, np.arange(inside.size).reshape(inside.shape)
    latitude = cells.lonlat[2] - (np.arange(height) + 0.5) * cells.lonlat[3]
    area = np.maximum(np.cos(latitude), 0.02) if cells.lonlat[1] else np.ones(height)
    circle = 2 * math.pi / cells.lonlat[1] if cells.lonlat[1] else width
    solution = np.zeros((*inside.shape, 3))
    blocks = np.zeros((inside.size, inside.size))
    for k, y, x in np.argwhere(inside):
        blocks[index[k, y, x], index[k, y // 2, x // 2]] = 1
    rounds = gains._STRICT if strict else gains._ROUNDS
    for data, limit in rounds:
        slack, onto = (0.5, blocks) if data <= gains._ROUGH else (1.0, np.eye(inside.size))
        last = not strict or (data, limit) == rounds[-1]
        fade = max(1.0, (gains._FADE if last else gains._TREND_FADE) * circle)
        rows, targets = [], []

        def term(weight: float, entries: dict[int, float], target: np.ndarray, rows=rows, targets=targets):
            row = np.zeros(inside.size)
            for at, value in entries.items():
                row[at] = value * math.sqrt(weight)
            rows.append(row)
            targets.append(target * math.sqrt(weight))

        nothing = np.zeros(3)
        for k, mask in enumerate(inside):
            for y, x in np.argwhere(mask):
                term(area[y] / fade**2, {index[k, y, x]: 1}, nothing)
            for here, there, stiff in slopes(mask, area, cells.wraps):
                term(slack * stiff, {index[k, *here]: 1, index[k, *there]: -1}, nothing)
        for one in measured.differences:
            a, b, d = one.a, one.b, one.values
            for here, there, stiff in slopes(inside[a] & inside[b], area, cells.wraps):
                if unknown[here] or unknown[there]:
                    entries = {index[a, *here]: 1, index[b, *here]: -1, index[a, *there]: -1}
                    term(slack * stiff * gains._TOGETHER, entries | {index[b, *there]: 1}, nothing)
            for y, x in np.argwhere(d[..., 3] > 0):
                off = solution[a, y, x] - solution[b, y, x] + d[y, x, :3]
                distance = np.linalg.norm(off) if solution.any() else 0.0
                trust = (1 - (distance / limit) ** 2) ** 2 if distance < limit else 0.0
                weight = data * area[y] * d[y, x, 3] * trust
                term(weight, {index[a, y, x]: 1, index[b, y, x]: -1}, -d[y, x, :3])
            for y, x in np.argwhere(one.beyond[..., 3]):
                sign = np.sign(one.beyond[y, x, 3])
                raised = (b if sign > 0 else a), y, x
                least = sign * one.beyond[y, x, :3]
                short = least - solution[raised]
                if inside[raised] and short.mean() > 0 and np.linalg.norm(short) < limit:
                    trust = (1 - (np.linalg.norm(short) / limit) ** 2) ** 2
                    weight = gains._BOUND * area[y] * abs(one.beyond[y, x, 3]) * trust
                    term(weight, {index[raised]: 1}, least)
        solution = onto @ np.linalg.lstsq(np.array(rows) @ onto, np.array(targets), rcond=None)[0]
        solution = solution.reshape(*inside.shape, 3)
    return solution


def overlapping(seed: int, cells: Grid) -> Measured:
    """Measured differences of three layers, and which cells each covers."""
    random = np.random.default_rng(seed)
    inside = np.zeros((3, cells.height, cells.width), bool)
    inside[0, :, :6], inside[1, :, 4:], inside[2, 1:3, :3] = True, True, True
    inside[2, 1:3, -2:] = True
    differences = []
    for a, b in ((0, 1), (0, 2), (1, 2)):
        d = random.normal(size=(cells.height, cells.width, 4)) * 0.1 + [0.3, -0.2, 0.1, 0]
        d[..., 3] = random.random(d.shape[:2]) * (inside[a] & inside[b])
        d[0, 4, :3] += 2  # somebody who moved
        beyond = np.zeros_like(d)
        beyond[3:, ::2] = [0.9, 0.5, 0.7, 0.6]  # a is clipped
        beyond[4:, 1::2] = [-0.2, -0.6, -0.8, -0.9]
        mixing = np.ones(d.shape[:2])
        differences.append(Difference(a, b, d, beyond * (inside[a] & inside[b])[..., None], mixing, mixing))
    return Measured(cells, inside, 1.0, tuple(differences))


CELLS = {
    "plane": plane(110, 70).resized(9, 5),
    "cylinder": plane(110, 70, wraps=True).resized(9, 5),
    "sphere": sphere(110, 55).resized(9, 5),
}


@STRICT
@pytest.mark.parametrize("name", list(CELLS))
@pytest.mark.parametrize("hole", [False, True])
def test_solve_is_dense_least_squares(name: str, strict: bool, hole: bool) -> None:
    cells = CELLS[name]
    measured = overlapping(0, cells)
    unknown = np.zeros(measured.inside.shape[1:], bool)
    unknown[2, 0] = unknown[3:, 4:6] = hole  # between 0 and 2, and 0 and 1; these end there
    measured.inside[0, :, -1] = hole  # which 2 lies on as well, on both sides of the border
    found = solved(measured, strict, unknown if hole else None)
    expected = dense_gains(measured, strict, unknown)
    assert np.abs(expected).max() > 0.05
    assert np.allclose(found, expected, atol=1e-7)
    assert not found[~measured.inside].any()


@pytest.mark.parametrize(("shift", "off"), [(2, 1e-6), (4, 1e-6), (1, 5e-3)])
def test_turning_a_panorama_turns_its_gains(shift: int, off: float) -> None:
    """Where blocks of cells turn as well; else first rounds differ a little."""
    measured = overlapping(2, sphere(110, 55).resized(10, 5))
    found = solved(measured)
    turned = [
        replace(d, values=np.roll(d.values, shift, 1), beyond=np.roll(d.beyond, shift, 1))
        for d in measured.differences
    ]
    inside = np.roll(measured.inside, shift, 2)
    again = solved(replace(measured, inside=inside, differences=tuple(turned)))
    assert np.allclose(np.roll(found, shift, 2), again, atol=off)


def test_no_difference_is_exactly_no_gain() -> None:
    measured = overlapping(3, CELLS["plane"])
    for d in measured.differences:
        d.values[..., :3] = d.beyond[..., :3] = 0
    assert not solved(measured).any()


def test_what_is_clipped_is_a_bound_for_the_other() -> None:
    """A layer is raised towards one that is clipped, and not held where it is brighter than it has to be."""
    inside = np.zeros((2, 5, 9), bool)
    inside[0, :, :6], inside[1, :, 3:] = True, True
    overlap = inside.all(0)[..., None]
    beyond = overlap * [-0.6, -0.5, -0.7, -0.9]  # layer 1 is clipped
    nothing = np.zeros_like(beyond)

    def solve(values: np.ndarray, beyond: np.ndarray) -> np.ndarray:
        difference = Difference(0, 1, values, beyond, *np.ones((2, 5, 9)))
        return solved(Measured(CELLS["plane"], inside, 1.0, (difference,)))

    raised, other = solve(nothing, beyond)
    assert (raised[:, 3:6] > 0.02).all() and (raised <= 0.7).all()
    assert not other.any()
    brighter = overlap * [-1.3, -1.3, -1.3, 1.0]
    less = beyond * [0.1, 0.1, 0.1, 1.0]
    assert (solve(brighter, nothing)[0][:, 3:6] > 0.1).all()
    assert np.allclose(solve(brighter, less), solve(brighter, nothing), atol=0.02)

"""Trust in flow: its kernel against its twin, the twin against SciPy, flows that are known."""

from __future__ import annotations

import numpy as np
import pytest
from reference import common
from reference import consistency as twin
from scipy import ndimage
from test_consistency import SIZES, WRAPS, random_trusted, read_at
from tolerances import POSITION, assert_close

from hugin_abflow import consistency
from hugin_abflow.cells import CELL
from hugin_abflow.opencl import Device

# Cells of which none moved, as the kernel takes them.
NOTHING = np.zeros((1, 1), bool), (1, 1, CELL, 0)


def smooth_flow(seed: int, width: int, height: int, most: float, wraps: bool) -> np.ndarray:
    """Flow float32 (height, width, 2) of at most `most` px in each direction."""
    random = np.random.default_rng(seed).normal(size=(height, width, 2))
    flow = ndimage.gaussian_filter(
        random, (5, 5, 0), mode=("nearest", "wrap" if wraps else "nearest", "nearest")
    )
    return (flow * most / max(np.abs(flow).max(), 1e-9)).astype(np.float32)


def moved_cells(seed: int, width: int, height: int) -> np.ndarray:
    """A random mask of the cells of a chart; one of them at least is set."""
    rows, columns = (max(1, (n + CELL // 2 - 1) // CELL) for n in (height, width))
    cells = np.random.default_rng(seed).random((rows, columns)) < 0.3
    cells[-1, seed % columns] = True
    return cells


@pytest.mark.parametrize("wraps", WRAPS)
def test_twin_of_trust_is_the_formula(wraps: bool) -> None:
    flow, back = (smooth_flow(k, 77, 53, 6.0, wraps).astype(np.float64) for k in (0, 1))
    image = np.random.default_rng(2).normal(size=(53, 77))
    trusted = twin.consistency_trust(flow, back, (77, 53, int(wraps), 0), 1.5, 0.6, *NOTHING, image)
    columns, rows = common.pixels(77, 53)
    there = columns + 0.5 + flow[..., 0], rows + 0.5 + flow[..., 1]
    u, v = (read_at(back[..., k], *there, wraps) for k in (0, 1))
    squared = (flow[..., 0] + u) ** 2 + (flow[..., 1] + v) ** 2
    shown = np.clip((twin.area_there(flow, (77, 53, int(wraps), 0)) - 0.6) / 0.4, 0, 1)
    assert np.allclose(trusted[..., 2], shown / (1 + squared / 1.5**2) ** 4)
    assert np.array_equal(trusted[..., :2], flow)
    assert np.array_equal(trusted[..., 3], image)
    off = np.array([[[1.5, 0.0]]])  # 1.5 px from the start: a sixteenth
    little = twin.consistency_trust(off, 0 * off, (1, 1, 0, 0), 1.5, 0.6, *NOTHING, np.zeros((1, 1)))
    assert little[0, 0, 2] == pytest.approx(1 / 16)


@pytest.mark.parametrize("wraps", WRAPS)
def test_twin_of_area_is_the_area_of_moved_corners(wraps: bool) -> None:
    """Of the quadrangle in which the four pixels beside a pixel end up: half the product of its diagonals,
    crosswise; two pixels' area before.
    """
    flow = smooth_flow(7, 77, 53, 9.0, wraps)
    area = twin.area_there(flow, (77, 53, int(wraps), 0))
    columns, rows = common.pixels(77, 53)
    ends = np.dstack([columns, rows]) + flow
    for row, column in [(1, 1), (26, 40), (51, 75), (10, 60)]:
        left, right, above, below = (
            ends[row, column - 1], ends[row, column + 1], ends[row - 1, column], ends[row + 1, column],
        )  # fmt: skip
        product = np.cross([*(right - left), 0], [*(below - above), 0])[2] / 2
        assert area[row, column] == pytest.approx(product / 2, abs=1e-5)
    assert area.min() < 0.6
    assert area.max() > 1.4
    turned = np.roll(flow, 20, axis=1)
    equal = np.isclose(np.roll(area, 20, axis=1), twin.area_there(turned, (77, 53, int(wraps), 0)))
    assert equal.all() == wraps


@pytest.mark.parametrize("size", SIZES)
def test_twin_of_trust_has_none_in_what_moved(size: tuple[int, int]) -> None:
    """Pixel by pixel, on cells of the size that cells.py makes, as many as have a pixel in their middle."""
    moved, still = moved_cells(4, *size), np.zeros((size[1], size[0], 2))
    rows, columns = moved.shape
    grid, cells = (*size, 0, 0), (columns, rows, CELL, 0)
    trusted = twin.consistency_trust(still, still, grid, 1.5, 0.6, moved, cells, still[..., 0])
    for y, x in np.ndindex(trusted.shape[:2]):
        its = moved[min(y // CELL, rows - 1), min(x // CELL, columns - 1)]
        assert tuple(trusted[y, x, 2:]) == ((0, twin.EXCLUDED) if its else (1, 0))


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("wraps", WRAPS)
def test_trust_equals_its_twin(device: Device, size: tuple[int, int], wraps: bool) -> None:
    flow, back = (smooth_flow(k, *size, 6.0, wraps) for k in (2, 3))
    image = random_trusted(4, *size)[..., 3]
    for moved in (None, moved_cells(5, *size)):
        uploaded = device.upload(flow), device.upload(back), wraps, device.upload(image)
        kernel = consistency.trust(device, *uploaded, moved).get()
        given = NOTHING if moved is None else (moved, (*moved.shape[::-1], CELL, 0))
        grid = (*size, int(wraps), 0)
        least = consistency._TOLERANCE, consistency._SQUEEZED
        expected = twin.consistency_trust(flow, back, grid, *least, *given, image)
        assert np.array_equal(kernel[..., :2], flow)
        assert_close(kernel, expected, POSITION)
        under = np.zeros(size[::-1], bool) if moved is None else twin.on_pixels(moved, CELL, grid)
        assert not kernel[under, 2].any()

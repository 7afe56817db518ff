"""The flow benchmark's truths are true, and its errors are what they are called."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks import flow_pairs
from benchmarks.flow import Result, endpoint_errors, measure, table
from benchmarks.flow_pairs import Pair

H, W = 60, 90


@pytest.mark.parametrize("pair", flow_pairs.synthetic_pairs()[:2], ids=lambda pair: pair.name)
def test_synthetic_truth_shows_the_same_in_both_images(pair: Pair) -> None:
    """But for noise and the edges' jaggedness; without the motion nothing fits."""
    y, x = np.mgrid[0 : pair.a.shape[0], 0 : pair.a.shape[1]].astype(np.float32)
    for own, other, truth in ((pair.a, pair.b, pair.forward), (pair.b, pair.a, pair.backward)):
        known = np.isfinite(truth).all(-1)
        moved = np.nan_to_num(truth).astype(np.float32)
        there = cv2.remap(other, x + moved[..., 0], y + moved[..., 1], cv2.INTER_LINEAR)
        off = np.abs(there.astype(float) - own)[known].mean()
        still = np.abs(other.astype(float) - own)[known].mean()
        assert known.mean() > 0.8
        assert off < 2.0
        assert still > 5 * off


def test_motion_of_the_synthetic_pairs_is_as_named() -> None:
    vertical, tenth, exposure = flow_pairs.synthetic_pairs()
    assert np.nanmax(np.abs(vertical.forward[..., 1])) > 20
    assert np.nanmean(np.abs(vertical.forward[..., 0])) < 4
    assert np.nanmax(np.abs(tenth.forward[..., 0])) > 0.1 * 640
    assert exposure.b.mean() > 1.8 * exposure.a.mean()


def board() -> tuple[np.ndarray, np.ndarray]:
    """A board of 20 x 20 px that moves 7 px left before a wall that moves 2; its place in a."""
    y, x = np.mgrid[0:H, 0:W]
    there = (np.abs(x - 50) < 10) & (np.abs(y - 30) < 10)
    return np.where(there[..., None], (-7.0, 0.0), (-2.0, 0.0)), there


def test_reversed_truth_of_a_stereo_pair() -> None:
    """What moves most is in front; what nothing lands on is unknown."""
    forward, there = board()
    back = flow_pairs.reverse(forward, -np.linalg.norm(forward, axis=-1))
    shown = np.roll(there, -7, 1)
    assert np.array_equal(back[shown], np.tile([7.0, 0.0], (shown.sum(), 1)))
    laid_open = np.roll(there, -2, 1) & ~shown
    assert np.isnan(back[laid_open]).all()
    assert np.isnan(back[:, -2:]).all()
    rest = ~shown & ~laid_open
    rest[:, -2:] = False
    assert np.array_equal(back[rest], np.tile([2.0, 0.0], (rest.sum(), 1)))


def test_hidden_pixels_are_left_out() -> None:
    """The strip of wall that the board moves over, and what leaves the image."""
    forward, there = board()
    back = flow_pairs.reverse(forward, -np.linalg.norm(forward, axis=-1))
    seen = np.isfinite(flow_pairs.visible(forward, back)).all(-1)
    hidden = np.roll(there, -5, 1) & ~there
    assert hidden.sum() == 5 * 19
    assert not seen[hidden].any() and not seen[:, :2].any()
    rest = ~hidden
    rest[:, :2] = False
    assert seen[rest].all()


def test_what_looks_alike_is_in_front(tmp_path: Path) -> None:
    """A board that moves less than the wall behind it is told by its colours."""
    random = np.random.default_rng(1)
    wall, there = random.integers(0, 255, (H, W, 3), dtype=np.uint8), board()[1]
    a = np.where(there[..., None], 255 - wall // 4, wall).astype(np.uint8)
    b = np.where(there[..., None], a, np.roll(wall, -6, 1)).astype(np.uint8)
    forward = np.where(there[..., None], (0.0, 0.0), (-6.0, 0.0))
    pair = flow_pairs.make_pair("test", a, b, forward, None, stereo=False)
    inner = cv2.erode(there.astype(np.uint8), np.ones((9, 9))) > 0
    assert np.isfinite(pair.forward[inner]).all()
    assert (pair.backward[inner] == 0).all()
    assert np.isnan(pair.forward[np.roll(inner, 6, 1) & ~there]).all()


def test_flo_files_are_read(tmp_path: Path) -> None:
    values = np.random.default_rng(2).normal(size=(5, 7, 2)).astype("<f4")
    values[2, 3] = 2e9
    path = tmp_path / "a.flo"
    path.write_bytes(b"PIEH" + np.array([7, 5], "<i4").tobytes() + values.tobytes())
    truth = flow_pairs.read_flo(path)
    assert np.isnan(truth[2, 3]).all()
    truth[2, 3] = values[2, 3]
    assert np.array_equal(truth, values)
    path.write_bytes(b"nothing")
    with pytest.raises(SystemExit, match=r"no \.flo"):
        flow_pairs.read_flo(path)


def test_errors_of_both_directions_count_the_same() -> None:
    truth = np.zeros((H, W, 2))
    back = truth.copy()
    back[10:] = np.nan
    image = np.zeros((H, W, 3), np.uint8)
    pair = Pair("test", image, image, truth, back)
    result = measure(lambda a, b: (np.full((H, W, 2), (3.0, 4.0)), truth), pair)
    assert (result.error, result.outliers) == (2.5, 0.5)
    assert endpoint_errors(truth, back).size == 10 * W


def test_table_ends_in_the_means() -> None:
    rows = {
        "p": {"ours": Result(1, 0.1, 2), "DIS": Result(2, 0.2, 1)},
        "q": {"ours": Result(3, 0.3, 4), "DIS": Result(2, 0.4, 1)},
    }
    lines = table(rows).splitlines()
    assert lines[2] == "| p | 1.00 | 2.00 | 0.50 | 10 % | 20 % | 2.00 | 1.00 |"
    assert lines[-1] == "| mean | 2.00 | 2.00 | 1.00 | 20 % | 30 % | 3.00 | 1.00 |"

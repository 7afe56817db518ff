"""The scoring tells true from false, and the benchmarks' layers are what nona would write."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks import ablation, phases, rigs, scaling
from benchmarks.quality import paste
from benchmarks.rigs import read_canvas, write_layer
from benchmarks.scoring import Chart, Score, View, score
from benchmarks.speed import Run, measure, table
from hugin_abflow import Layer, Settings, read_layer, write_image
from sample_projects import lens

HEIGHT, WIDTH, PARALLAX = 150, 331, 18


def scenery(seed: int = 3) -> np.ndarray:
    """(HEIGHT, WIDTH + 2 PARALLAX): texture of several scales, grey 0..255."""
    rng = np.random.default_rng(seed)
    wide = np.zeros((HEIGHT, WIDTH + 2 * PARALLAX), np.float32)
    for blur in (1.5, 4.0, 9.0):
        layer = cv2.GaussianBlur(rng.standard_normal(wide.shape).astype(np.float32), (0, 0), blur)
        wide += layer / layer.std()
    return np.asarray((128 + 30 * wide).clip(0, 255), np.float32)


def seen_from(t: float, far: np.ndarray, near: np.ndarray) -> np.ndarray:
    """A view of a far wall with a near board in front of its lower half, from t = 0 (left) to 1 (right)."""
    x, y = np.meshgrid(np.arange(WIDTH, dtype=np.float32), np.arange(HEIGHT, dtype=np.float32))
    board = cv2.remap(near, x + PARALLAX * (1 + t), y, cv2.INTER_CUBIC)
    wall = cv2.remap(far, x + PARALLAX, y, cv2.INTER_CUBIC)
    return np.asarray(np.where(y < HEIGHT / 2, wall, board), np.float32)


@pytest.fixture(scope="module")
def views() -> list[np.ndarray]:
    far, near = scenery(3), scenery(4)
    return [seen_from(t, far, near) for t in (0.0, 0.25, 0.5, 0.75, 1.0)]


def judge(picture: np.ndarray, views: list[np.ndarray], opaque: np.ndarray | None = None) -> Score:
    everywhere = np.ones(picture.shape, bool)
    shown = [View(view, everywhere) for view in views]
    opaque = everywhere if opaque is None else opaque
    return score([Chart(picture, opaque, everywhere, shown, [shown[0], shown[-1]])], reach=20)


@pytest.mark.parametrize("which", [0, 2, 4])
def test_true_view_is_perfect(which: int, views: list[np.ndarray]) -> None:
    result = judge(views[which], views)
    assert result.textured > 100 and result.neighbours > 100
    assert result.false_share == 0 and result.broken_share == 0
    assert result.worst_break() == 0
    # between the layers' views the board is resampled, by parts of a pixel
    assert result.sharpness == pytest.approx(1, abs=1e-6 if which in (0, 4) else 0.02)


def test_exposure_does_not_matter(views: list[np.ndarray]) -> None:
    result = judge((0.8 * views[0] + 12).astype(np.float32), views)
    assert result.false_share == 0 and result.worst_break() == 0
    darker = judge(0.8 * views[0], views)
    assert darker.sharpness == pytest.approx(1, abs=1e-4)


def test_hard_paste_breaks_the_near_half_only(views: list[np.ndarray]) -> None:
    picture = views[0].copy()
    picture[:, WIDTH // 2 :] = views[4][:, WIDTH // 2 :]
    result = judge(picture, views)
    assert result.wrong > 0 or result.broken > 0
    assert 0.6 * PARALLAX < result.worst_break(places=1) <= PARALLAX + 1
    places = [(x, y) for jump, _, x, y in result.breaks if jump > 4]
    assert places
    assert all(abs(x - WIDTH / 2) < 40 and y > HEIGHT / 2 - 30 for x, y in places)


def test_smooth_change_of_viewpoint_is_no_break(views: list[np.ndarray]) -> None:
    far, near = scenery(3), scenery(4)
    x, y = np.meshgrid(np.arange(WIDTH, dtype=np.float32), np.arange(HEIGHT, dtype=np.float32))
    t = np.clip((x - 30) / 270, 0, 1)
    board = cv2.remap(near, x + PARALLAX * (1 + t), y, cv2.INTER_CUBIC)
    picture = np.where(y < HEIGHT / 2, seen_from(0, far, near), board).astype(np.float32)
    result = judge(picture, views)
    assert result.false_share == 0
    assert result.worst_break(places=1) <= 4


def test_ghost_is_false(views: list[np.ndarray]) -> None:
    result = judge(((views[0] + views[4]) / 2).astype(np.float32), views)
    lower = [y for _, _, y in result.wrong_places]
    assert result.false_share > 20
    assert min(lower) > HEIGHT / 2 - 20  # the far half agrees in all views


def test_shifted_patch_is_seen_as_a_jump(views: list[np.ndarray]) -> None:
    picture = views[2].copy()
    picture[20:130, 150:240] = views[2][20:130, 141:231]
    result = judge(picture, views)
    assert 7 < result.worst_break(places=1) < 11
    assert result.broken > 10


def test_blur_shows_in_sharpness(views: list[np.ndarray]) -> None:
    result = judge(cv2.GaussianBlur(views[2], (0, 0), 1.2), views)
    assert result.false_share < 5
    assert result.sharpness < 0.8


def test_average_of_layers_that_are_not_on_each_other_shows_in_sharpness(views: list[np.ndarray]) -> None:
    """By a pixel: still true, but soft."""
    moved = np.roll(views[0], 1, 1)
    result = judge((views[0] + moved) / 2, views)
    assert result.false_share < 5
    assert 0.5 < result.sharpness < 0.95


def test_sharpness_is_that_of_overlaps(views: list[np.ndarray]) -> None:
    """Where one layer is alone nothing was blended; without layers there is no figure."""
    everywhere = np.ones(views[0].shape, bool)
    left = everywhere.copy()
    left[:, WIDTH // 2 :] = False
    picture = views[0].copy()
    picture[:, WIDTH // 2 + 20 :] = cv2.GaussianBlur(picture, (0, 0), 1.2)[:, WIDTH // 2 + 20 :]
    shown = [View(view, everywhere) for view in views]
    layers = [shown[0], View(views[0], left)]
    result = score([Chart(picture, everywhere, everywhere, shown, layers)], reach=20)
    assert result.sharpness == pytest.approx(1, abs=1e-6)
    alone = score([Chart(picture, everywhere, everywhere, shown, layers[:1])], reach=20)
    assert np.isnan(alone.sharpness) and alone.textured == result.textured


def test_layers_are_on_their_charts(tmp_path: Path) -> None:
    """Grey where they are known, and known only where they are."""
    width = 240
    rng = np.random.default_rng(5)
    layer = np.full((60, 90, 4), 255, np.uint8)
    layer[..., :3] = rng.integers(60, 200, (60, 90, 1), dtype=np.uint8)
    write_layer(tmp_path / "layer0000.tif", layer, 70, 30, width)
    canvas = read_canvas(tmp_path / "layer0000.tif", width)
    shares = []
    for chart in rigs.chart_maps(width, 6):
        seen = rigs._seen_on(chart, canvas)
        opaque = chart.take(canvas[..., 3], cv2.INTER_NEAREST) > 127
        assert not (seen.known & ~opaque).any()
        assert (seen.grey[seen.known] > 20).all()
        shares.append(seen.known.sum() / max(1, opaque.sum()))
    assert shares[0] > 0.85


def test_holes_are_false_and_flat_patches_do_not_count(views: list[np.ndarray]) -> None:
    opaque = np.ones(views[0].shape, bool)
    opaque[60:100, 100:200] = False
    assert judge(views[2], views, opaque).wrong > 5
    flat = [np.full_like(view, 99) for view in views]
    assert judge(flat[0], flat).textured == 0


def test_a_lone_mistaken_match_is_no_worst_place() -> None:
    lone = Score(breaks=[(20.0, 0, 50.0, 50.0), (1.0, 0, 60.0, 50.0), (0.0, 1, 50.0, 50.0)])
    assert lone.worst_break(places=1) == 0
    line = Score(breaks=[(20.0, 0, 50.0, 50.0), (15.0, 0, 60.0, 50.0), (9.0, 0, 65.0, 50.0)])
    assert line.worst_break(places=1) == 15


def test_layer_comes_back_from_its_tags(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    layer = rng.integers(0, 255, (37, 53, 4), dtype=np.uint8)
    write_layer(tmp_path / "a.tif", layer, 131, 57, 512)
    canvas = read_canvas(tmp_path / "a.tif", 512)
    assert canvas.shape == (256, 512, 4)
    assert np.array_equal(canvas[57:94, 131:184], layer)
    assert canvas.sum(dtype=np.int64) == layer.sum(dtype=np.int64)


def test_paste_lays_later_layers_on_top(tmp_path: Path) -> None:
    paths = [tmp_path / "0.tif", tmp_path / "1.tif"]
    for value, path in zip((10, 200), paths, strict=True):
        layer = np.full((20, 30, 4), value, np.uint8)
        layer[..., 3] = 255
        layer[:, :5, 3] = 0
        write_layer(path, layer, 3 + value // 20, 4, 128)
    paste(paths, 128, tmp_path / "out.tif")
    canvas = read_canvas(tmp_path / "out.tif", 128)
    assert canvas[10, 10, 0] == 10 and canvas[10, 30, 0] == 200
    assert canvas[10, 17, 0] == 10  # transparent on top


@pytest.mark.parametrize("rig", list(rigs.RIGS))
def test_rigs_overlap_all_around(rig: str) -> None:
    cameras = rigs.RIGS[rig](1)
    maps = rigs.chart_maps(180, 4)
    for chart in maps[:1]:
        seen = np.sum([camera.covers(chart.rays[..., 0, :].astype(float)) for camera in cameras], axis=0)
        middle = seen[seen.shape[0] // 2]
        assert middle.min() >= 1 and middle.max() >= 2


def test_charts_show_the_canvas_where_their_rays_look() -> None:
    width = 240
    y, x = np.mgrid[0 : width // 2, 0:width] + 0.5
    directions = lens.equirect_directions(x, y, width)
    for number, chart in enumerate(rigs.chart_maps(width, 6)):
        rays = chart.rays[..., 0, :]
        for axis in range(3):
            taken = chart.take(directions[..., axis].astype(np.float32), cv2.INTER_LINEAR)
            tilt = np.abs(rays[..., 2])
            clear = tilt < np.cos(np.radians(3))  # at the pole itself the canvas ends
            assert np.abs(taken - rays[..., axis])[clear].max() < 2e-3, number


def test_measure_reports_the_child(tmp_path: Path) -> None:
    program = "x = bytearray(80 << 20); sum(range(200000))"
    run = measure([sys.executable, "-c", program])
    assert run.peak > 80 and run.cpu > 0 and 0 < run.wall < 60
    with pytest.raises(SystemExit, match="no such thing"):
        measure([sys.executable, "-c", "raise SystemExit('no such thing')"])


def test_table_has_medians_and_ratios() -> None:
    runs = {"a": [Run(1, 2, 100), Run(9, 9, 900), Run(2, 4, 200)], "b": [Run(1, 8, 50)]}
    lines = table(runs).splitlines()
    assert lines[2] == "| a | 2.0 | 4.0 | 200 | 1.00 | 1.00 | 1.00 |"
    assert lines[3] == "| b | 1.0 | 8.0 | 50 | 0.50 | 2.00 | 0.25 |"


@pytest.mark.parametrize("part", list(ablation.PARTS))
def test_each_part_differs_from_the_default_by_valid_settings(part: str) -> None:
    changed = Settings(**ablation.PARTS[part])
    assert (changed == Settings()) == (part == "default")


# Growth, and where the time goes


@pytest.mark.parametrize("factor", [0.5, 2, 4])
def test_layers_of_other_sizes_show_the_same(tmp_path: Path, factor: float) -> None:
    """In strips as at once; a halved layer begins at even rows and columns of the canvas."""
    height, width = 150, 121
    y, x = np.mgrid[:height, :width]
    picture = np.stack([x, y, 100 + np.sin(x / 9) * 50, np.full((height, width), 255)], -1).astype(np.uint8)
    picture[:, 100:, 3] = 0
    layer = Layer.from_array("layer", picture, 7, 13)
    write_image(tmp_path / "base.tif", picture, offset=(7, 13))
    scaling.resize_layer(tmp_path / "base.tif", tmp_path / "other.tif", factor)
    made = read_layer(tmp_path / "other.tif")
    unit = 2 if factor < 1 else 1
    left, top = layer.box.left + 7 % unit, layer.box.top + 13 % unit
    assert (made.box.left, made.box.top) == (left * factor, top * factor)
    pixels = made.read(0, made.box.height)
    even = picture[top - 13 :, left - 7 :]
    even = even[: len(even) // unit * unit, : even.shape[1] // unit * unit]
    assert np.array_equal(pixels, scaling.resized(even, factor))
    assert set(np.unique(pixels[..., 3])) == {0, 255}


def test_taller_layers_have_each_row_twice(tmp_path: Path) -> None:
    """More rows than are read at a time; the peak is compared with that of the first."""
    picture = np.random.default_rng(3).integers(0, 256, (150, 21, 4), np.uint8)
    write_image(tmp_path / "base.tif", picture, offset=(7, 13))
    scaling.repeat_rows(tmp_path / "base.tif", tmp_path / "tall.tif", 2)
    made = read_layer(tmp_path / "tall.tif")
    assert (made.box.left, made.box.top) == (7, 26)
    assert np.array_equal(made.read(0, 300), np.repeat(picture, 2, axis=0))
    table = scaling.tall_table({1: Run(10, 12, 500), 2: Run(20, 24, 525)})
    assert "| 9000x9000 | 20.0 | 24.0 | 525 | 1.05 |" in table


def test_the_plot_of_growth_is_an_svg_and_always_the_same(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="only the benchmark needs it")
    runs = {4500: Run(10, 12, 500), 9000: Run(20, 30, 600)}
    for name in ("a.svg", "b.svg"):
        scaling.plot(runs, tmp_path / name)
    text = (tmp_path / "a.svg").read_text("utf-8")
    assert text == (tmp_path / "b.svg").read_text("utf-8")
    assert "<svg" in text
    assert "| 9000x4500 | 40 | 20.0 | 30.0 | 0.741 | 600 |" in scaling.table(runs)


def test_phases_are_told_apart() -> None:
    """What begins in a phase counts for it, of its process alone."""
    rows = [
        ("flow", "phase", 0, 1000, 1), ("flow", "phase", 0, 500, 2), ("blend", "phase", 1000, 3000, 1),
        ("flow_relax", "kernel", 100, 200, 1), ("flow_relax", "kernel", 50, 100, 2),
        ("blend_band", "kernel", 1500, 700, 1), ("upload", "transfer", 1100, 50, 1),
        ("decode", "file", 1000, 900, 1), ("decode", "file", 1200, 900, 1), ("encode", "file", 5000, 9, 1),
    ]  # fmt: skip
    spans = [
        {"name": name, "cat": kind, "ts": start * 1e3, "dur": length * 1e3, "pid": process}
        for name, kind, start, length, process in rows
    ]
    text = phases.table(spans)
    assert "| flow | 1.500 | 0.300 | 0.000 | 0.000 |" in text
    assert "| blend | 3.000 | 0.700 | 0.050 | 1.800 |" in text
    assert "on the device: 1.050 s" in text
    assert "| flow_relax | 0.300 | 2 |" in text

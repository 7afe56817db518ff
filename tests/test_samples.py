"""The committed samples agree with themselves: project, layers, photos, lenses, and the room they show."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from sample_projects import lens
from sample_projects.generate import Sample, samples

FOLDER = Path(__file__).resolve().parent.parent / "sample_projects"
SAMPLES = samples()
NAMES = [sample.name for sample in SAMPLES]


def project_lines(sample: Sample, key: str) -> list[str]:
    text = (FOLDER / sample.name / f"{sample.name}.pto").read_text(encoding="utf-8")
    return [line for line in text.splitlines() if line.startswith(key + " ")]


def number(line: str, key: str) -> float:
    found = re.search(rf" {key}(-?[0-9.]+)", line)
    assert found, f"{key} in {line}"
    return float(found[1])


def read_layer(path: Path) -> tuple[np.ndarray, int, int, tuple[int, int]]:
    with tifffile.TiffFile(path) as file:
        tags = file.pages.first.tags
        left, top = (round(tags[n].value[0] / tags[n].value[1] * 150) for n in ("XPosition", "YPosition"))
        return file.asarray(), left, top, (tags[33300].value, tags[33301].value)


def test_everything_together_is_under_12_mb() -> None:
    assert sum(path.stat().st_size for path in FOLDER.rglob("*") if path.is_file()) < 12e6


@pytest.mark.parametrize("sample", SAMPLES, ids=NAMES)
def test_project_is_what_the_generator_writes(sample: Sample) -> None:
    (panorama,) = project_lines(sample, "p")
    assert panorama.startswith(f"p f2 w{sample.width} h{sample.width // 2} v360 ")
    images = project_lines(sample, "i")
    assert len(images) == len(sample.cameras)
    for line, camera in zip(images, sample.cameras, strict=True):
        for key, value in (
            ("w", camera.width), ("h", camera.height), ("f", camera.projection), ("v", camera.hfov),
            ("y", camera.yaw), ("p", camera.pitch), ("r", camera.roll), ("b", camera.b),
        ):  # fmt: skip
            assert number(line, key) == pytest.approx(value, abs=1e-4)
        name = re.search(r'n"([^"]+)"', line)
        assert name
        photo = cv2.imread(str(FOLDER / sample.name / name[1]))
        assert photo is not None and photo.shape == (camera.height, camera.width, 3)


@pytest.mark.parametrize("sample", SAMPLES, ids=NAMES)
def test_layers_lie_where_the_lenses_say(sample: Sample) -> None:
    bottom = sample.bottom or sample.width // 2
    paths = sorted((FOLDER / sample.name).glob("*.tif"))
    assert [path.name for path in paths] == [f"{sample.name}{k:04d}.tif" for k in range(len(sample.cameras))]
    union = np.zeros((bottom, sample.width), bool)
    for path, camera in zip(paths, sample.cameras, strict=True):
        pixels, left, top, canvas = read_layer(path)
        assert canvas == (sample.width, sample.width // 2)
        height, width = pixels.shape[:2]
        assert (left + width <= sample.width) and (top + height <= bottom)
        covered = pixels[..., 3] > 0
        y, x = np.mgrid[0:bottom, 0 : sample.width] + 0.5
        expected = camera.covers(lens.equirect_directions(x, y, sample.width))
        # alpha is the lens's frame but for its border; nona's guess at the box cuts off a few pixels
        outside = expected.copy()
        outside[top : top + height, left : left + width] = False
        assert outside.sum() < 2e-4 * expected.sum()
        part = expected[top : top + height, left : left + width]
        differs = cv2.erode((covered ^ part).astype(np.uint8), np.ones((3, 3)))
        assert not differs[1:-1, 1:-1].any()
        union[top : top + height, left : left + width] |= covered
    assert union.all()


@pytest.mark.parametrize("sample", SAMPLES, ids=NAMES)
def test_control_points_are_near_where_both_photos_show_the_same(sample: Sample) -> None:
    """Their directions differ by the parallax only: 8 cm between neighbours, 2 m away at least."""
    points = project_lines(sample, "c")
    assert len(points) >= 6
    for line in points:
        first, second = (sample.cameras[int(number(line, key))] for key in "nN")
        one = first.directions(np.array(number(line, "x") + 0.5), np.array(number(line, "y") + 0.5))
        two = second.directions(np.array(number(line, "X") + 0.5), np.array(number(line, "Y") + 0.5))
        apart = np.linalg.norm(np.subtract(first.centre, second.centre))
        assert np.arccos(np.clip(one @ two, -1, 1)) <= np.arcsin(apart / 2) + 1e-3


@pytest.mark.parametrize("projection", [lens.RECTILINEAR, lens.CIRCULAR_FISHEYE, lens.FULL_FRAME_FISHEYE])
def test_project_is_the_inverse_of_directions(projection: int) -> None:
    camera = lens.Camera((0, 0, 0), 37.0, -21.0, 8.0, 641, 479, 75.0, projection, -0.03)
    x, y = np.meshgrid(np.linspace(1, 640, 7), np.linspace(1, 478, 5))
    assert camera.project(camera.directions(x, y)) == pytest.approx(np.stack([x, y], -1), abs=1e-6)


def test_photo_has_its_corners_where_hugin_has_them() -> None:
    """Yaw turns right, pitch looks up, and roll turns the camera so that its right side goes down."""
    camera = lens.Camera((0, 0, 0), 90.0, 0.0, 0.0, 100, 100, 90.0)
    assert camera.directions(np.array(50.0), np.array(50.0)) == pytest.approx([1, 0, 0], abs=1e-9)
    up = lens.Camera((0, 0, 0), 0.0, 90.0, 0.0, 100, 100, 90.0)
    assert up.directions(np.array(50.0), np.array(50.0)) == pytest.approx([0, 0, 1], abs=1e-9)
    rolled = lens.Camera((0, 0, 0), 0.0, 0.0, 90.0, 100, 100, 90.0)
    assert rolled.directions(np.array(100.0), np.array(50.0))[2] < -0.7


@pytest.mark.skipif(shutil.which("nona") is None, reason="nona (hugin-tools) is not installed")
@pytest.mark.parametrize("sample", SAMPLES, ids=NAMES)
def test_nona_makes_the_same_layers(sample: Sample, tmp_path: Path) -> None:
    project = FOLDER / sample.name / f"{sample.name}.pto"
    command = ["nona", "-r", "ldr", "-m", "TIFF_m", "-i", "0", "-o", str(tmp_path / "again"), str(project)]
    subprocess.run(command, check=True, capture_output=True)
    (path,) = tmp_path.glob("again*.tif")
    new, *new_place = read_layer(path)
    old, *old_place = read_layer(FOLDER / sample.name / f"{sample.name}0000.tif")
    assert new_place == old_place and new.shape == old.shape
    # another version of nona, libjpeg or libm may round otherwise
    assert np.mean(np.abs(new.astype(int) - old).max(-1) > 3) < 0.002


@pytest.mark.skipif(shutil.which("nona") is None, reason="nona (hugin-tools) is not installed")
@pytest.mark.parametrize(
    ("projection", "hfov", "b"),
    [(lens.FULL_FRAME_FISHEYE, 112.0, -0.02), (lens.CIRCULAR_FISHEYE, 190.0, 0.0), (0, 70.0, 0.0)],
)
def test_nona_undoes_the_lens(projection: int, hfov: float, b: float, tmp_path: Path) -> None:
    """A photo through our lens, remapped by nona, is our own equirectangular view from the same point."""
    tracer_module = pytest.importorskip("sample_projects.tracer")
    from sample_projects.project import project_text

    ball = tracer_module.Scene()
    material = tracer_module.Material
    ball.ball((0, 0, 0), 5.0, material.PAINTING, (0.5, 0.5, 0.5))  # seen from inside
    ball.box((-1, 1.5, -0.6), (0.7, 1.9, 0.4), material.CHECK, (0.6, 0.5, 0.3), (0.1, 0.1, 0.4))
    ball.lamp((0.3, -0.4, 0.9), 0.1, (3, 3, 3))
    tracer = tracer_module.Tracer(ball, samples=4)
    camera = lens.Camera((0.1, -0.05, 0.02), 20.0, 9.0, 7.0, 420, 360, hfov, projection, b)
    colours, _ = tracer.look(camera.centre, camera.rays().reshape(-1, 3, 3))
    photo = (colours.reshape(360, 420, 3) * 255 + 0.5).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "photo.png"), cv2.cvtColor(photo, cv2.COLOR_RGB2BGR))
    (tmp_path / "one.pto").write_text(project_text([camera], ["photo.png"], 512), encoding="utf-8")
    command = ["nona", "-r", "ldr", "-m", "TIFF_m", "-o", str(tmp_path / "one"), str(tmp_path / "one.pto")]
    subprocess.run(command, check=True, capture_output=True)
    layer, left, top, _ = read_layer(tmp_path / "one0000.tif")
    height, width = layer.shape[:2]
    rays = lens.equirect_rays(512, top, top + height)[:, left : left + width]
    expected, _ = tracer.look(camera.centre, rays.reshape(-1, 3, 3))
    expected = expected.reshape(height, width, 3) * 255
    inner = cv2.erode((layer[..., 3] > 0).astype(np.uint8), np.ones((5, 5))) > 0
    error = np.abs(layer[..., :3] - expected)[inner].mean()
    moved = np.abs(layer[..., :3] - np.roll(expected, 1, axis=1))[inner].mean()
    assert expected[inner].std() > 15
    assert error < 3
    assert error < 0.6 * moved  # one pixel off would be seen

"""Projects of every projection: photos of one scene, remapped by nona, merged, are the scene again."""

from __future__ import annotations

import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import tifffile
from pictures import one_device
from scipy import ndimage

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from hugin_abflow import joint
from hugin_abflow.images import read_layer
from hugin_abflow.layer import full_scale
from hugin_abflow.merge import merge_project
from hugin_abflow.project import read_plan
from hugin_abflow.settings import Settings
from sample_projects import lens

pytestmark = pytest.mark.usefixtures(one_device.__name__, "nona")

# A photo to each side of a cube, 125 degrees wide, so that neighbours overlap by 35 degrees; two of them
# meet in the middle of the canvas.
SIDES = [(45.0, 0.0), (135.0, 0.0), (225.0, 0.0), (315.0, 0.0), (0.0, 90.0), (0.0, -90.0)]
SIZE, HFOV = 251, 125.0
EQUIRECTANGULAR = 4  # i-line f; the p-line counts otherwise

PROJECTIONS = {  # p-line
    "rectilinear": "f0 w301 h201 v100",
    "cylindrical": "f1 w401 h161 v360",
    "equirectangular": "f2 w402 h201 v360",
    "equirectangular, not all round": "f2 w300 h181 v270",
    "equirectangular, odd, cropped": "f2 w401 h201 v360 S31,377,5,190",
    "fisheye": "f3 w251 h251 v200",
    "stereographic": "f4 w251 h251 v220",
    "mercator": "f5 w351 h251 v360",
}
SHARP = ["rectilinear", "equirectangular", "fisheye"]


def scene(directions: np.ndarray) -> np.ndarray:
    """What is seen in unit directions (..., 3): colours 0..1, (..., 3), no two places alike."""
    random = np.random.default_rng(5)
    directions = directions.astype(np.float32)
    result = np.full(directions.shape, 0.5, np.float32)
    for wavelength in np.geomspace(7, 60, 12):  # degrees
        wave = random.normal(size=3).astype(np.float32)
        wave *= 360 / wavelength / np.linalg.norm(wave)
        phase = random.uniform(0, 2 * np.pi)
        for channel in range(3):
            result[..., channel] += 0.08 * np.sin(directions @ wave + phase + 0.6 * channel)
    return np.clip(result, 0, 1)


@cache
def photos(turned: float) -> list[np.ndarray]:
    """Photos to all sides, of a camera that looks by and by `turned` degrees left or right of its course."""
    y, x = np.mgrid[0:SIZE, 0:SIZE] + 0.5
    cameras = [
        lens.Camera((0, 0, 0), yaw + turned * (-1) ** k, pitch, 0.0, SIZE, SIZE, HFOV, lens.RECTILINEAR)
        for k, (yaw, pitch) in enumerate(SIDES)
    ]
    return [scene(camera.directions(x, y)) for camera in cameras]


def image_line(name: str, size: tuple[int, int], kind: int, hfov: float, yaw: float, pitch: float) -> str:
    return (
        f"i w{size[0]} h{size[1]} f{kind} v{hfov:g} Ra0 Rb0 Rc0 Rd0 Re0 Eev0 Er1 Eb1 r0 p{pitch:g} y{yaw:g} "
        f'TrX0 TrY0 TrZ0 j0 a0 b0 c0 d0 e0 g0 t0 Va1 Vb0 Vc0 Vd0 Vx0 Vy0 Vm5 n"{name}"'
    )


def project(folder: Path, panorama: str, dtype: type, turned: float) -> Path:
    """A project of six photos."""
    lines = ["# hugin project file", f'p {panorama} n"TIFF_m c:LZW r:CROP"', "m i0"]
    for k, (photo, (yaw, pitch)) in enumerate(zip(photos(turned), SIDES, strict=True)):
        name = f"photo{k}.tif"
        tifffile.imwrite(folder / name, np.rint(photo * full_scale(dtype)).astype(dtype), photometric="rgb")
        lines.append(image_line(name, (SIZE, SIZE), lens.RECTILINEAR, HFOV, yaw, pitch))
    path = folder / "cube.pto"
    path.write_text("\n".join(lines) + "\n")
    return path


def whole_scene(folder: Path, panorama: str) -> np.ndarray:
    """The scene on the canvas of the p-line (height, width, 3) in 0..1: one photo of everything, by nona."""
    y, x = np.mgrid[0:400, 0:800] + 0.5
    everything = np.rint(scene(lens.equirect_directions(x, y, 800)) * 65535).astype(np.uint16)
    tifffile.imwrite(folder / "everything.tif", everything, photometric="rgb")
    canvas = panorama.split(" S")[0]
    lines = [f'p {canvas} n"TIFF_m r:UNCROP"', "m i0"]
    lines.append(image_line("everything.tif", (800, 400), EQUIRECTANGULAR, 360, 0, 0))
    (folder / "truth.pto").write_text("\n".join(lines) + "\n")
    command = ["nona", "-r", "ldr", "-m", "TIFF_m", "-o", str(folder / "truth"), str(folder / "truth.pto")]
    subprocess.run(command, check=True, capture_output=True)
    layer = read_layer(folder / "truth0000.tif")
    pixels = layer.read(0, layer.box.height) / 65535
    plan = read_plan(folder / "truth.pto")
    result = np.zeros((plan.canvas.height, plan.canvas.width, 3))
    box = layer.box
    result[box.top : box.bottom, box.left : box.right] = pixels[..., :3]
    return result


def run(folder: Path, name: str, dtype: type = np.uint8, turned: float = 0.0, **settings):
    """Merge a project; gives, on the crop, colours 0..1, alpha, the number of layers, and the scene."""
    panorama = PROJECTIONS[name]
    path = project(folder, panorama, dtype, turned)
    output = merge_project(path, Settings(**settings), remap="always", keep_layers=True)
    result = read_layer(output)
    plan = read_plan(path)
    crop = plan.canvas.crop
    assert (result.box.left, result.box.top) == (crop.left, crop.top)
    assert (result.box.width, result.box.height) == (crop.width, crop.height)
    assert result.dtype == dtype and result.channels == 3
    count = np.zeros((plan.canvas.height, plan.canvas.width), int)
    kept = sorted(folder.glob("cube0*.tif"))
    assert len(kept) >= 3
    for file in kept:
        layer = read_layer(file)
        alpha, box = layer.read(0, layer.box.height)[..., -1] > 0, layer.box
        count[box.top : box.bottom, box.left : box.right] += alpha
    part = np.s_[crop.top : crop.bottom, crop.left : crop.right]
    pixels = result.read(0, crop.height)
    return (
        pixels[..., :3] / full_scale(dtype),
        pixels[..., 3],
        count[part],
        whole_scene(folder, panorama)[part],
    )


@pytest.mark.parametrize("name", PROJECTIONS)
def test_photos_of_a_scene_become_the_scene(tmp_path, name):
    dtype = np.uint16 if name == "stereographic" else np.uint8
    colours, alpha, count, truth = run(tmp_path, name, dtype)
    union = count > 0
    np.testing.assert_array_equal(alpha == full_scale(dtype), union)
    assert union.mean() > 0.95
    # nona interpolates the photos, which costs a percent where the scene is finest, and rounds; on the rim of
    # the canvas it has less to interpolate from
    error = np.abs(colours - truth)[ndimage.binary_erosion(union, iterations=3, border_value=1)]
    assert error.mean() < 0.004
    assert np.quantile(error, 0.999) < 0.03


def directions(name: str, turned: float) -> np.ndarray:
    """Where the pixels of a whole canvas look, turned to the right by some degrees: (height, width, 3)."""
    words = dict(re.findall(r"([fwhv])(\d+)", PROJECTIONS[name].split(" S")[0]))
    width, height, hfov = int(words["w"]), int(words["h"]), np.radians(float(words["v"]))
    y, x = np.mgrid[0:height, 0:width] + 0.5
    right, up = x - width / 2, height / 2 - y
    if words["f"] == "2":
        lon, lat = right * hfov / width, up * hfov / width
    elif words["f"] == "0":
        ahead = width / 2 / np.tan(hfov / 2)
        lon, lat = np.arctan2(right, ahead), np.arctan2(up, np.hypot(right, ahead))
    else:  # fisheye: the distance from the centre is the angle
        angle, around = np.hypot(right, up) * hfov / width, np.arctan2(up, right)
        lon = np.arctan2(np.sin(angle) * np.cos(around), np.cos(angle))
        lat = np.arcsin(np.sin(angle) * np.sin(around))
    lon = lon + np.radians(turned)
    return np.stack([np.cos(lat) * np.sin(lon), np.cos(lat) * np.cos(lon), np.sin(lat)], -1)


def mismatch(colours: np.ndarray, name: str, count: np.ndarray, most: float) -> float:
    """How far the overlaps' worst twentieth is from the scene, turned by what fits best at each place."""
    errors = [
        ndimage.gaussian_filter(np.abs(colours - scene(directions(name, turned))).mean(-1), 1)
        for turned in np.linspace(-most, most, 21)
    ]
    overlap = count >= 2
    assert overlap.sum() > 1000
    return float(np.quantile(np.min(errors, 0)[overlap], 0.95))


TURNED = 2.5  # degrees
# Flow is within a tenth of a pixel nearly everywhere; the scene changes by 0.1 of white per pixel at most.
FITS = 0.016


def test_directions_are_those_of_nona(tmp_path):
    for name in SHARP:
        truth = whole_scene(tmp_path, PROJECTIONS[name])
        assert np.abs(scene(directions(name, 0.0)) - truth)[10:-10, 10:-10].mean() < 0.003


@pytest.mark.parametrize("name", SHARP)
def test_photos_that_do_not_fit_become_one_scene(tmp_path, name):
    """Every other photo looks 2.5 degrees too far left, the others right, so that they are 5 degrees apart:
    the panorama turns smoothly from one to the other.
    """
    colours, alpha, count, _ = run(tmp_path, name, turned=TURNED)
    np.testing.assert_array_equal(alpha == 255, count > 0)
    assert mismatch(colours, name, count, TURNED) < FITS


def test_without_flow_they_would_fit_nowhere(tmp_path, monkeypatch):
    """The test above can fail: what the layers show at each place, mixed."""
    monkeypatch.setattr(joint.pairflow, "solve", lambda *arguments: ([], [], []))
    name = SHARP[1]
    colours, _, count, _ = run(tmp_path, name, turned=TURNED)
    assert mismatch(colours, name, count, TURNED) > 1.5 * FITS

"""Makes the sample projects again: ``python sample_projects/generate.py`` (a few minutes; needs nona).

Renders the photos, writes the projects and lets nona remap the layers. What it makes is committed, so
nobody needs to run it.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from sample_projects.lens import CIRCULAR_FISHEYE, FULL_FRAME_FISHEYE, Camera
from sample_projects.project import control_points, project_text
from sample_projects.scene import EYE, room
from sample_projects.tracer import Tracer

HERE = Path(__file__).resolve().parent
EXPOSURE = 1.25
OFF_AXIS = 0.07  # metres from the rotation axis to each camera's centre


@dataclass(frozen=True)
class Sample:
    """One sample project.

    gains   the photos' exposures, in display values.
    bottom  crop of the canvas, in rows; None where the photos see the ground.
    """

    name: str
    width: int
    cameras: list[Camera]
    gains: list[float]
    bottom: int | None = None


def ring_cameras(photo: tuple[int, int] = (900, 1200), turn: float = 0.0) -> list[Camera]:
    """The paper's rig: five fisheyes around and one up, 7 cm off the axis; mounted by hand, not exact."""
    lean = [(0.0, 0.0, 0.0), (0.8, -0.6, 0.4), (-0.5, 0.7, -0.8), (0.3, 0.4, 0.6), (-0.9, -0.5, -0.3)]
    cameras = []
    for k, (yaw, pitch, roll) in enumerate(lean):
        ahead = np.radians(72 * k + turn)
        centre = (EYE[0] + OFF_AXIS * np.sin(ahead), EYE[1] + OFF_AXIS * np.cos(ahead), EYE[2])
        heading = (72 * k + turn + yaw + 180) % 360 - 180
        cameras.append(Camera(centre, heading, pitch, roll, *photo, 112.0, FULL_FRAME_FISHEYE, -0.02))
    up = (EYE[0], EYE[1], EYE[2] + OFF_AXIS)
    cameras.append(Camera(up, turn, 89.3, 0.0, *photo, 112.0, FULL_FRAME_FISHEYE, -0.02))
    return cameras


def dual_cameras(size: int = 1200, turn: float = 0.0) -> list[Camera]:
    """Two fisheyes of 200 degrees back to back, 3 cm apart from the middle."""
    cameras = []
    for k, roll in enumerate((0.4, -0.3)):
        ahead = np.radians(180 * k + turn)
        centre = (EYE[0] + 0.03 * np.sin(ahead), EYE[1] + 0.03 * np.cos(ahead), EYE[2])
        heading = (180 * k + turn + 180) % 360 - 180
        hfov = 206.0  # over the photo's width; the image circle is 200 degrees
        circle = size / 2 * 200 / hfov
        cameras.append(
            Camera(centre, heading, 0.5 * k, roll, size, size, hfov, CIRCULAR_FISHEYE, 0.0, circle)
        )
    return cameras


def samples() -> list[Sample]:
    """The projects of this folder."""
    return [
        Sample("room", 2048, ring_cameras(), [1.0, 0.97, 1.02, 1.03, 0.98, 1.01], 928),
        Sample("dual_fisheye", 1600, dual_cameras(turn=75.0), [1.0, 0.975]),
    ]


def photograph(
    camera: Camera, tracer: Tracer, gain: float, grid: int = 3, exposure: float = EXPOSURE
) -> npt.NDArray[np.uint8]:
    """(height, width, 3) RGB as that lens would record it, a little darker towards the corners."""
    rays = camera.rays().reshape(-1, 3, 3)
    colours, _ = tracer.look(camera.centre, rays, grid=grid, exposure=exposure)
    picture = colours.reshape(camera.height, camera.width, 3)
    y, x = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    far = np.hypot(x - camera.width / 2, y - camera.height / 2)
    corner = camera.circle or np.hypot(camera.width, camera.height) / 2
    picture = picture * (gain * (1 - 0.05 * (far / corner) ** 2))[..., None].astype(np.float32)
    if camera.circle:
        picture *= np.clip(camera.circle + 6 - far, 0, 1)[..., None].astype(np.float32)
    return np.asarray(np.clip(picture, 0, 1) * 255 + 0.5, np.uint8)


def generate(sample: Sample, tracer: Tracer, folder: Path) -> None:
    """Photos, project and layers of one sample, in `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"photo{index}.jpg" for index in range(len(sample.cameras))]
    for camera, gain, name in zip(sample.cameras, sample.gains, names, strict=True):
        picture = photograph(camera, tracer, gain)
        options = [cv2.IMWRITE_JPEG_QUALITY, 92, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
        cv2.imwrite(str(folder / name), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), options)
    project = folder / f"{sample.name}.pto"
    points = control_points(sample.cameras, tracer)
    text = project_text(sample.cameras, names, sample.width, points, sample.bottom)
    project.write_text(text, encoding="utf-8")
    remap(project, folder / sample.name)


def remap(project: Path, prefix: Path) -> None:
    """Let nona make the layers as Hugin does, but deflated: a third smaller than LZW."""
    with tempfile.TemporaryDirectory() as scratch:
        target = Path(scratch) / prefix.name
        command = ["nona", "-z", "DEFLATE", "-r", "ldr", "-m", "TIFF_m", "-o", str(target), str(project)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        for layer in sorted(Path(scratch).glob(f"{prefix.name}*.tif")):
            shutil.move(layer, prefix.parent / layer.name)


def main() -> None:
    """Make all samples, in this folder or another one."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, default=HERE, help="folder to make them in")
    output = parser.parse_args().output
    with tempfile.TemporaryDirectory() as scratch:
        tracer = Tracer(room(0), Path(scratch), samples=64)
        for sample in samples():
            generate(sample, tracer, output / sample.name)
            size = sum(path.stat().st_size for path in (output / sample.name).iterdir())
            print(f"{sample.name}: {size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()

"""What several test modules need: photos and projects made on the fly, programs that may be missing."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import settings

from hugin_abflow.batch import pool, run, task
from hugin_abflow.layer import Layer, full_scale
from hugin_abflow.opencl import Device
from hugin_abflow.project import Plan
from hugin_abflow.supply import planned_layers

DTYPES = [np.uint8, np.uint16, np.float16, np.float32]
ICC = bytes(range(256)) * 3  # carried, never interpreted

# The same examples each time; how long one takes is the machine's affair.
settings.register_profile("deterministic", derandomize=True, deadline=None)
settings.load_profile("deterministic")

# Programs that tests start write as a user's do, not as where containers and CI set it.
os.environ.pop("PYTHONUNBUFFERED", None)

# A shell's background jobs ignore it, and would hand that on to the programs that tests interrupt.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def require_program(name: str) -> str:
    """The program's path. Without it the test is skipped, but fails in CI, where it must be there."""
    path = shutil.which(name)
    if path is None:
        reason = f"{name} is not installed; `make test` says how to get it"
        if os.environ.get("CI", "").lower() == "true":
            pytest.fail(reason)
        pytest.skip(reason)  # Hugin is large, and most tests need none of it
    return path


@pytest.fixture
def nona() -> str:
    """Hugin's nona, really installed."""
    return require_program("nona")


@pytest.fixture
def pano_trafo() -> str:
    """Hugin's pano_trafo, really installed."""
    return require_program("pano_trafo")


@pytest.fixture
def exiftool() -> str:
    """exiftool, really installed."""
    return require_program("exiftool")


@pytest.fixture
def enblend() -> str:
    """enblend, really installed."""
    return require_program("enblend")


def photo_pixels(
    seed: int, dtype: type = np.uint8, channels: int = 3, width: int = 203, height: int = 151
) -> np.ndarray:
    """A smooth photo without two equal rows or columns: (height, width, channels)."""
    y, x = np.mgrid[0:height, 0:width] / 25.0
    waves = [np.sin(x * (1 + 0.3 * c) + y * (0.7 + 0.2 * seed) + c + seed) for c in range(channels)]
    scaled = np.stack(waves, -1) * 0.45 + 0.5
    if np.dtype(dtype).kind == "f":
        return scaled.astype(dtype)
    return np.rint(scaled * np.iinfo(dtype).max).astype(dtype)


@pytest.fixture(scope="session")
def device() -> Device:
    """The default device; kernels are built once per session."""
    return Device()


Merge = Callable[..., Path]


@pytest.fixture
def replace(monkeypatch: pytest.MonkeyPatch) -> Callable[[Merge], None]:
    """Put a function in the place of `stitch_project`, for one output; all is made in this process then."""

    def put(merge: Merge) -> None:
        monkeypatch.setattr(
            task, "stitch_project", lambda path, finished, **keywords: finished(merge(path, **keywords))
        )
        monkeypatch.setattr(run, "Pool", lambda jobs, *rest: pool.Alone(*rest))
        monkeypatch.setattr(run, "Cluster", lambda scheduler, *rest: pool.Alone(*rest))

    return put


@pytest.fixture
def shoot(replace: Callable[[Merge], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The current folder has a folder of a project, as documented commands want it; nothing is stitched."""
    replace(lambda path, **keywords: path)
    (tmp_path / "shoot").mkdir()
    (tmp_path / "shoot" / "a.pto").touch()
    monkeypatch.chdir(tmp_path)


ProjectMaker = Callable[..., Path]


@pytest.fixture
def make_project(tmp_path: Path) -> ProjectMaker:
    """`make_project(...)` writes photos and a .pto, both in one folder, and returns the .pto's path.

    By default three rectilinear photos of 203x151, 80 degrees wide, 60 degrees apart, the last of which
    crosses the border of a 360-degree equirectangular canvas of 802x401.
    """

    def make(
        folder: str = "project",
        stem: str = "pano",
        yaws: Sequence[float] = (0, 60, 170),
        dtype: type = np.uint8,
        channels: int = 3,
        icc: bytes | None = None,
        panorama: str = 'f2 w802 h401 v360 n"TIFF_m c:LZW r:CROP"',
        disabled: Sequence[int] = (),
        extra: str = "",
        photo: str = "photo {}.tif",
        ending: str = ".pto",
    ) -> Path:
        place = tmp_path / folder
        place.mkdir(parents=True, exist_ok=True)
        lines = ["# hugin project file", f"p {panorama}", "m i0"]
        for index, yaw in enumerate(yaws):
            pixels = photo_pixels(index, dtype, channels)
            kind = "rgb" if channels == 3 else "minisblack"
            stored = pixels if channels == 3 else pixels[..., 0]
            # SampleFormat is set, else nona guesses
            tifffile.imwrite(place / photo.format(index), stored, photometric=kind, iccprofile=icc)
            lines.append(f"#-hugin  cropFactor=1{' disabled' if index in disabled else ''}")
            lines.append(
                f"i w203 h151 f0 v80 Ra0 Rb0 Rc0 Rd0 Re0 Eev0 Er1 Eb1 r0 p{5 * index} y{yaw} "
                f'TrX0 TrY0 TrZ0 j0 a0 b0 c0 d0 e0 g0 t0 Va1 Vb0 Vc0 Vd0 Vx0 Vy0 Vm5 n"{photo.format(index)}"'
            )
        project = place / f"{stem}{ending}"
        project.write_text("\n".join(lines) + "\n" + extra, encoding="utf-8")
        return project

    return make


def noise(dtype, channels: int = 3, width: int = 131, height: int = 77, seed: int = 0) -> np.ndarray:
    """Random pixels with binary alpha, colours under alpha 0 too: (height, width, channels + 1)."""
    values = np.random.default_rng(seed).random((height, width, channels + 1))
    pixels = values.astype(dtype)
    if np.dtype(dtype).kind == "u":
        pixels = np.rint(values * full_scale(dtype)).astype(dtype)
    pixels[..., -1] = np.where(values[..., -1] > 0.4, full_scale(dtype), 0)
    return pixels


def on_small_disk(folder: Path, size: str, script: str) -> subprocess.CompletedProcess[str]:
    """Run a shell's script in `folder`, on which a disk of `size` is mounted for as long as it runs."""
    if sys.platform != "linux":
        pytest.skip("needs Linux's file systems")  # others have neither unshare(1) nor tmpfs
    inside = f'mount -t tmpfs -o size={size} none "$0" && cd "$0" && {script}'
    done = subprocess.run(
        ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", inside, str(folder)],
        capture_output=True,
        text=True,
        timeout=120,
    )
    # some containers forbid it; a disk cannot be filled otherwise
    if "unshare" in done.stderr or "mount:" in done.stderr:
        pytest.skip(f"no disk of its own can be mounted here: {done.stderr.strip()}")
    return done


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def whole(layer) -> np.ndarray:
    return layer.read(0, layer.box.height)


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """TMPDIR of its own, found empty afterwards."""
    folder = tmp_path / "temporary files"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    yield folder
    assert not list(folder.iterdir())


def remap(plan: Plan, prefix: str, *options: str) -> None:
    """Layers from nona, run by hand in the project's folder."""
    arguments = ["-z", "LZW", "-r", "ldr", "-m", "TIFF_m", *options, "-o", prefix, str(plan.file)]
    subprocess.run(["nona", *arguments], cwd=plan.folder, check=True, capture_output=True)


def age(path: Path, seconds: float) -> None:
    """Make a file look older."""
    changed = path.stat().st_mtime - seconds
    os.utime(path, (changed, changed))


def pixels_of(layers: list[Layer]) -> list[np.ndarray]:
    return [layer.read(0, layer.box.height) for layer in layers]


def same(ones: list[np.ndarray], others: list[np.ndarray]) -> bool:
    """Equal but for nona's dither, which differs by 1 from run to run."""
    pairs = list(zip(ones, others, strict=True))
    return all(one.shape == other.shape for one, other in pairs) and all(
        np.abs(one.astype(float) - other.astype(float)).max() <= (1 if one.dtype.kind == "u" else 0)
        for one, other in pairs
    )


def names_of(layers: list[Layer]) -> list[str]:
    return [layer.name for layer in layers]


def refuse(*arguments):
    raise AssertionError("nona is not needed here")


def to_make(plan: Plan) -> tuple[str | None, list[int]]:
    """The name of the layers that are taken as they are, and the images that layers are made of."""
    found, missing = planned_layers(plan, "auto")
    return found and Path(found.prefix).name, [image.index for image in missing]

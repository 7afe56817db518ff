"""How fast? ``python benchmarks/speed.py [--width 9000] [--runs 3]``

Six layers of the paper's rig on a large canvas, 8 bit, LZW, cropped, as nona writes them, are blended by
enblend and by hugin-abflow in turns. The floor is what decoding the layers twice and encoding hugin-abflow's
result take, with nothing in between (`floor.py`). Wall time, CPU time (user + system) and peak memory are
medians over the runs; the table is Markdown. The layers are rendered once and kept in --cache.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.rigs import RIGS, render_layer, write_layer, write_project
from hugin_abflow.images import read_layer
from sample_projects.lens import Camera
from sample_projects.scene import room
from sample_projects.tracer import Tracer

ROOT = Path(__file__).resolve().parent.parent
FLOOR = "floor"


@dataclass(frozen=True)
class Run:
    """One run of a blender: seconds, seconds, MiB."""

    wall: float
    cpu: float
    peak: float


def make_layers(folder: Path, width: int) -> None:
    """Render the paper's rig."""
    render_layers(folder, RIGS["ring"](1), width, samples=12)


def render_layers(
    folder: Path, cameras: Sequence[Camera], width: int, samples: int, reach: float = 180.0
) -> None:
    """Render the layers and the project, unless they are there. One sample a pixel: speed needs no beauty.

    samples: of the light (tracer.py). reach: as `render_layer` takes it.
    """
    if (folder / "project.pto").exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    tracer = Tracer(room(1), folder.parent, samples=samples)
    for index, camera in enumerate(cameras):
        start = time.perf_counter()
        layer, left, top = render_layer(camera, tracer, width, 1 + 0.01 * (index % 3 - 1), 1, reach)
        write_layer(folder / f"layer{index:04d}.tif", layer, left, top, width)
        print(f"layer {index}: rendered in {time.perf_counter() - start:.0f} s", file=sys.stderr)
    write_project(folder, cameras, width)


def measure(command: list[str]) -> Run:
    """Run a command to its end and ask the system what it took, its children included."""
    paths = filter(None, [str(ROOT), os.environ.get("PYTHONPATH")])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    # compiled once, as pip does with what it installs, whatever this shell does
    environment |= {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": str(ROOT / "build" / "bytecode")}
    with tempfile.TemporaryFile() as log:
        start = time.perf_counter()
        streams = [(os.POSIX_SPAWN_DUP2, log.fileno(), 1), (os.POSIX_SPAWN_DUP2, log.fileno(), 2)]
        child = os.posix_spawnp(command[0], command, environment, file_actions=streams)
        _, status, usage = os.wait4(child, 0)
        wall = time.perf_counter() - start
        if os.waitstatus_to_exitcode(status) != 0:
            log.seek(0)
            raise SystemExit(f"{' '.join(command)} failed:\n{log.read().decode(errors='replace')}")
    # ru_maxrss counts KiB on Linux, bytes on macOS
    unit = 1 << 20 if sys.platform == "darwin" else 1 << 10
    return Run(wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / unit)


def commands(folder: Path, width: int) -> dict[str, list[str]]:
    """The blenders compared; the first is what the others are measured by."""
    layers = [str(path) for path in sorted(folder.glob("layer[0-9]*.tif"))]
    size = f"-f{width}x{width // 2}"
    out = {name: str(folder / f"result-{name}.tif") for name in ("enblend", "abflow")}
    project, prefix = str(folder / "project.pto"), str(folder / "layer")
    return {
        "enblend -w": ["enblend", "-w", size, "--compression=LZW", "-o", out["enblend"], "--", *layers],
        "hugin-abflow": [
            *(sys.executable, "-m", "hugin_abflow", project, "--prefix", prefix, "-o", out["abflow"]),
        ],
        FLOOR: [
            *(sys.executable, str(ROOT / "benchmarks" / "floor.py"), str(folder / "result.npy")),
            *(str(folder / "result-floor.tif"), *layers),
        ],
    }


def median(runs: list[Run]) -> Run:
    """Of each figure by itself."""
    return Run(*(statistics.median(getattr(run, key) for run in runs) for key in ("wall", "cpu", "peak")))


def table(runs: dict[str, list[Run]]) -> str:
    """Medians, and their ratios to the first blender's."""
    lines = ["| blender | wall s | CPU s | peak MiB | wall ratio | CPU ratio | memory ratio |"]
    lines.append("|---|---|---|---|---|---|---|")
    medians = {name: astuple(median(done)) for name, done in runs.items()}
    reference = next(iter(medians.values()))
    for name, (wall, cpu, peak) in medians.items():
        ratios = [value / base for value, base in zip((wall, cpu, peak), reference, strict=True)]
        shown = " | ".join(f"{ratio:.2f}" for ratio in ratios)
        lines.append(f"| {name} | {wall:.1f} | {cpu:.1f} | {peak:.0f} | {shown} |")
    return "\n".join(lines)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--width", type=int, default=9000, help="of the canvas, px")
    parser.add_argument("--runs", type=int, default=3, help="of each blender")
    parser.add_argument("--only", choices=["enblend -w", "hugin-abflow"], help="leave the other one out")
    parser.add_argument(
        "--cache", type=Path, default=ROOT / "build" / "benchmarks", help="where layers are kept"
    )
    options = parser.parse_args()
    folder = options.cache / f"speed-{options.width}"
    # by itself: the memory of this process is counted as that of those that it starts
    renderer = multiprocessing.get_context("spawn").Process(target=make_layers, args=(folder, options.width))
    renderer.start()
    renderer.join()
    if renderer.exitcode:
        raise SystemExit(renderer.exitcode)
    chosen = {
        name: command
        for name, command in commands(folder, options.width).items()
        if options.only in (None, name)
    }
    for name in chosen:
        if shutil.which(chosen[name][0]) is None:
            raise SystemExit(f"{chosen[name][0]} is not installed; --only measures the other blender alone")
    runs: dict[str, list[Run]] = {name: [] for name in chosen}
    for turn in range(options.runs):
        for name, command in chosen.items():
            if name == FLOOR and turn == 0:
                layer = read_layer(folder / "result-abflow.tif")
                np.save(folder / "result.npy", layer.read(0, layer.box.height))
            runs[name].append(measure(command))
            print(f"run {turn + 1}, {name}: {runs[name][-1].wall:.1f} s", file=sys.stderr)
    size = f"{options.width}x{options.width // 2}"
    print(f"Canvas {size}, six layers, {options.runs} runs of each in turns, medians:\n")
    print(table(runs))


if __name__ == "__main__":
    main()

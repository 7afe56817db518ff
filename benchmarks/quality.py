"""How good are the blends? ``python benchmarks/quality.py [--rigs ring dual] [--seeds 1 2] [--width 2048]``

Renders rigs in the sample room (kept in --cache), blends each set with hugin-abflow and its peers, scores
the results (see scoring.py) and prints a Markdown table. Blenders that are not installed are left out.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.rigs import RIGS, load_charts, make_set, read_canvas, write_layer
from benchmarks.scoring import Chart, Score, score

ROOT = Path(__file__).resolve().parent.parent

Command = Callable[[Path, list[Path], int, Path], list[str]]


def abflow(*options: str) -> Command:
    """hugin-abflow of this checkout with these options."""

    def command(folder: Path, layers: list[Path], width: int, out: Path) -> list[str]:
        prefix = str(folder / "layer")
        start = [sys.executable, "-m", "hugin_abflow", *options]
        return [*start, str(folder / "project.pto"), "--prefix", prefix, "-o", str(out)]

    return command


def enblend(folder: Path, layers: list[Path], width: int, out: Path) -> list[str]:
    """As Hugin calls it."""
    size = f"-f{width}x{width // 2}"
    return ["enblend", "-w", size, "--compression=LZW", "-o", str(out), "--", *map(str, layers)]


def verdandi(folder: Path, layers: list[Path], width: int, out: Path) -> list[str]:
    """Hugin's own blender."""
    return ["verdandi", "-w", "--compression=LZW", "-o", str(out), *map(str, layers)]


BLENDERS: dict[str, Command | None] = {
    "abflow": abflow(),
    "abflow fast": abflow("--flow-quality", "fast"),
    "abflow best": abflow("--flow-quality", "best"),
    "abflow no flow": abflow("--no-flow"),
    "abflow sequential": abflow("--merge", "sequential"),
    "enblend -w": enblend,
    "verdandi -w": verdandi,
    "paste": None,  # the layers laid over each other: what a blender must be better than
}


def paste(layers: list[Path], width: int, out: Path) -> None:
    """Each layer over those before it."""
    canvas = np.zeros((width // 2, width, 4), np.uint8)
    for path in layers:
        layer = read_canvas(path, width)
        covered = layer[..., 3] > 127
        canvas[covered] = layer[covered]
    write_layer(out, canvas, 0, 0, width)


def blend(name: str, folder: Path, width: int, out: Path) -> tuple[float, str]:
    """Run one blender: seconds taken, and an error (empty: none)."""
    layers = sorted(folder.glob("layer[0-9]*.tif"))
    command = BLENDERS[name]
    start = time.perf_counter()
    if command is None:
        paste(layers, width, out)
        return time.perf_counter() - start, ""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        command(folder, layers, width, out), capture_output=True, text=True, env=environment, check=False
    )
    seconds = time.perf_counter() - start
    failed = done.returncode != 0 or not out.exists()
    return seconds, (done.stderr.strip().splitlines() or [f"exit {done.returncode}"])[-1] if failed else ""


def count_holes(folder: Path, picture: npt.NDArray[np.uint8], width: int) -> int:
    """Pixels that some layer covers and the result leaves transparent."""
    union = np.zeros((width // 2, width), bool)
    for path in folder.glob("layer[0-9]*.tif"):
        union |= read_canvas(path, width)[..., 3] > 127
    return int((union & (picture[..., 3] < 128)).sum())


def show_places(charts: list[Chart], result: Score, out: Path) -> None:
    """Charts as pictures: false patches red, breaks yellow."""
    for number, chart in enumerate(charts):
        picture = cv2.cvtColor(np.clip(chart.grey, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR)
        picture[~chart.judged] //= 2
        for where, x, y in result.wrong_places:
            if where == number:
                cv2.rectangle(picture, (int(x) - 8, int(y) - 8), (int(x) + 8, int(y) + 8), (40, 40, 255), 2)
        for jump, where, x, y in result.breaks:
            if where == number and jump > 4:
                cv2.circle(picture, (int(x), int(y)), int(jump), (0, 230, 255), 2)
        cv2.imwrite(str(out.with_name(f"{out.stem}-{('band', 'north', 'south')[number]}.png")), picture)


def row(folder: Path, out: Path, width: int, seconds: float, show: bool = False) -> str:
    """The columns of the table from "false %" on, for a result of the set in `folder`."""
    picture = read_canvas(out, width)
    charts, reach = load_charts(folder, picture)
    result = score(charts, reach=reach, break_px=4.0 * width / 2048)
    if show:
        show_places(charts, result, out)
    return (
        f"| {result.false_share:.2f} | {result.worst_break():.1f} | {result.broken_share:.2f} "
        f"| {count_holes(folder, picture, width)} | {result.sharpness:.2f} | {seconds:.1f} |"
    )


def run_set(rig: str, seed: int, width: int, cache: Path, names: list[str], show: bool) -> None:
    """Make a set, blend it with every blender, print one table row each."""
    folder = cache / f"{rig}-{seed}-{width}"
    make_set(folder, rig, seed, width)
    for name in names:
        out = folder / f"result-{name.replace(' ', '_')}.tif"
        out.unlink(missing_ok=True)
        seconds, error = blend(name, folder, width, out)
        if error:
            print(f"| {rig} {seed} | {name} | failed: {error} | | | | | |", flush=True)
            continue
        print(f"| {rig} {seed} | {name} {row(folder, out, width, seconds, show)}", flush=True)


def add_set_options(parser: argparse.ArgumentParser) -> None:
    """Options that choose the sets."""
    parser.add_argument("--rigs", nargs="+", choices=list(RIGS), default=list(RIGS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[1])
    parser.add_argument("--width", type=int, default=2048, help="of the canvas, px")
    parser.add_argument(
        "--cache", type=Path, default=ROOT / "build" / "benchmarks", help="where sets are kept"
    )


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_set_options(parser)
    parser.add_argument("--blenders", nargs="+", choices=list(BLENDERS), default=list(BLENDERS))
    parser.add_argument("--show", action="store_true", help="pictures of the false patches and breaks")
    options = parser.parse_args()
    names = []
    for name in options.blenders:
        program = "" if BLENDERS[name] is None or name.startswith("abflow") else name.split()[0]
        if program and shutil.which(program) is None:
            print(f"{program} is not installed: left out", file=sys.stderr)
        else:
            names.append(name)
    print("| set | blender | false % | worst breaks px | broken % | holes px | sharp | s |")
    print("|---|---|---|---|---|---|---|---|")
    for rig in options.rigs:
        for seed in options.seeds:
            run_set(rig, seed, options.width, options.cache, names, options.show)


if __name__ == "__main__":
    main()

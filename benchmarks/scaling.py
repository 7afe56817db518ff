"""How do time and memory grow? ``python benchmarks/scaling.py [--widths 4500 9000 18000 36000]``

The layers of `speed.py` are enlarged or reduced, strip by strip, to canvases of other widths (twice as wide
as high) and blended. Wall time, CPU time (user + system) and peak memory are medians; the table is Markdown,
the plot `scaling.svg` shows time per megapixel and peak memory. Enlarged layers are smoother than photos of
that size, so they take less time to decode and encode. They are kept in --cache: 36,000 px take 2 GB.

With --many 300 photos of 480x500 px, which overlap in 1,900 pairs, are blended on 9,000 px instead.

With --tall two cylinders of 9,000 px are blended instead, with the same layers, whose rows the second has
twice: how much does peak memory grow with height alone?
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.rigs import RIGS, gigapixel_cameras, write_project
from benchmarks.speed import ROOT, Run, make_layers, measure, median, render_layers
from hugin_abflow.images import ImageWriter, read_layer

BASE = 9000  # the width that is rendered
STRIP = 64  # rows of the rendered layer at a time; even
MARGIN = 4  # rows that interpolation reaches beyond them


def resized(rows: np.ndarray, factor: float) -> np.ndarray:
    """Pixels (height, width, 4) at another size, with a binary alpha."""
    kind = cv2.INTER_CUBIC if factor > 1 else cv2.INTER_AREA
    size = round(rows.shape[1] * factor), round(rows.shape[0] * factor)
    out = cv2.resize(rows, size, interpolation=kind)
    out[..., 3] = np.where(cv2.resize(rows[..., 3], size, interpolation=cv2.INTER_NEAREST) > 127, 255, 0)
    return np.asarray(out)


def resize_layer(source: Path, target: Path, factor: float) -> None:
    """Write a layer at a whole multiple, or half, of its size; its place is moved alike."""
    layer = read_layer(source)
    box, unit = layer.box, 2 if factor < 1 else 1
    # what is halved begins and ends at even rows and columns of the canvas
    top, left = box.top + box.top % unit, box.left + box.left % unit
    bottom, right = box.bottom - box.bottom % unit, box.right - box.right % unit
    columns = slice(left - box.left, right - box.left)
    width, height = round((right - left) * factor), round((bottom - top) * factor)
    place = round(left * factor), round(top * factor)
    with ImageWriter(target, width, height, 3, np.uint8, offset=place) as writer:
        for first in range(top, bottom, STRIP):
            last = min(first + STRIP, bottom)
            above, below = max(first - MARGIN, top), min(last + MARGIN, bottom)
            rows = layer.read(above - box.top, below - box.top)[:, columns]
            start = round((first - above) * factor)
            count = round((last - first) * factor)
            writer.write_rows(resized(rows, factor)[start : start + count])


def make_set(cache: Path, width: int) -> Path:
    """The folder with layers and project for a canvas; made unless it is there."""
    base, folder = cache / f"speed-{BASE}", cache / f"scaling-{width}"
    make_layers(base, BASE)
    if width == BASE:
        return base
    if not (folder / "project.pto").exists():
        folder.mkdir(parents=True, exist_ok=True)
        for source in sorted(base.glob("layer[0-9]*.tif")):
            print(f"{width} px: {source.name}", file=sys.stderr)
            resize_layer(source, folder / source.name, width / BASE)
        write_project(folder, RIGS["ring"](1), width)
    return folder


def make_many_set(cache: Path, width: int) -> Path:
    """The folder with 300 small layers and their project."""
    folder = cache / "many"
    render_layers(folder, gigapixel_cameras(), width, samples=4, reach=14.0)
    return folder


def repeat_rows(source: Path, target: Path, times: int) -> None:
    """Write a layer with each row so many times; its place is moved alike."""
    layer = read_layer(source)
    box = layer.box
    with ImageWriter(
        target, box.width, box.height * times, 3, np.uint8, offset=(box.left, box.top * times)
    ) as writer:
        for first in range(0, box.height, STRIP):
            rows = layer.read(first, min(first + STRIP, box.height))
            writer.write_rows(np.repeat(rows, times, axis=0))


def make_tall_set(cache: Path, times: int) -> Path:
    """The folder with layers and project for a cylinder `times` as high as the base's canvas."""
    base, folder = cache / f"speed-{BASE}", cache / f"tall-{times}"
    make_layers(base, BASE)
    if not (folder / "project.pto").exists():
        folder.mkdir(parents=True, exist_ok=True)
        for source in sorted(base.glob("layer[0-9]*.tif")):
            print(f"{times} times as high: {source.name}", file=sys.stderr)
            repeat_rows(source, folder / source.name, times)
        text = (base / "project.pto").read_text(encoding="utf-8")
        sphere, cylinder = f"p f2 w{BASE} h{BASE // 2} ", f"p f1 w{BASE} h{BASE // 2 * times} "
        (folder / "project.pto").write_text(text.replace(sphere, cylinder), encoding="utf-8")
    return folder


def blend(folder: Path, options: list[str]) -> Run:
    """One run of hugin-abflow; its panorama is not kept."""
    out = folder / "result-scaling.tif"
    arguments = [str(folder / "project.pto"), "--prefix", str(folder / "layer"), "-o", str(out), *options]
    run = measure([sys.executable, "-m", "hugin_abflow", *arguments])
    out.unlink()
    return run


def tall_table(runs: dict[int, Run]) -> str:
    """One line for each height, as a multiple of the base's."""
    lines = ["| canvas | wall s | CPU s | peak MiB | peak ratio |", "|---|---|---|---|---|"]
    for times, run in sorted(runs.items()):
        lines.append(
            f"| {BASE}x{BASE // 2 * times} | {run.wall:.1f} | {run.cpu:.1f} | {run.peak:.0f} "
            f"| {run.peak / runs[1].peak:.2f} |"
        )
    return "\n".join(lines)


def table(runs: dict[int, Run]) -> str:
    """One line for each width."""
    lines = [
        "| canvas | megapixels | wall s | CPU s | CPU s / megapixel | peak MiB |",
        "|---|---|---|---|---|---|",
    ]
    for width, run in sorted(runs.items()):
        area = width * (width // 2) / 1e6
        lines.append(
            f"| {width}x{width // 2} | {area:.0f} | {run.wall:.1f} | {run.cpu:.1f} | {run.cpu / area:.3f} "
            f"| {run.peak:.0f} |"
        )
    return "\n".join(lines)


def plot(runs: dict[int, Run], path: Path) -> None:
    """Time per megapixel and peak memory over the width, as SVG."""
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams["svg.hashsalt"] = "hugin-abflow"  # else no two files are equal
    from matplotlib import pyplot

    widths = sorted(runs)
    figure, (time, memory) = pyplot.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    areas = [width * (width // 2) / 1e6 for width in widths]
    time.plot(widths, [runs[width].cpu / area for width, area in zip(widths, areas, strict=True)], "o-")
    time.set_ylabel("CPU seconds per megapixel")
    memory.plot(widths, [runs[width].peak for width in widths], "o-", label="peak")
    memory.plot(widths, [area * 4e6 / 2**20 for area in areas], ":", label="the panorama's pixels")
    memory.set_ylabel("MiB")
    memory.legend()
    for axes in (time, memory):
        axes.set_xlabel("canvas width, px")
        axes.set_xscale("log", base=2)
        axes.set_xticks(widths, [f"{width:,}" for width in widths])
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    figure.savefig(path, metadata={"Date": None})


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--widths", type=int, nargs="+", default=[4500, 9000, 18000, 36000])
    instead = parser.add_mutually_exclusive_group()
    instead.add_argument("--tall", action="store_true", help="a cylinder, and one twice as high, instead")
    instead.add_argument("--many", action="store_true", help="300 small layers instead")
    parser.add_argument("--runs", type=int, default=1, help="of each width")
    parser.add_argument("--max-memory", metavar="SIZE", help="of hugin-abflow")
    parser.add_argument("--plot", type=Path, default=ROOT / "benchmarks" / "scaling.svg")
    parser.add_argument("--cache", type=Path, default=ROOT / "build" / "benchmarks")
    parser.add_argument("--only-layers", action="store_true", help="make the layers and end")
    options = parser.parse_args()
    for width in options.widths:
        if width != BASE // 2 and width % BASE:
            raise SystemExit(f"{width} is neither half of {BASE} nor a multiple of it")
    make, sizes = (make_tall_set, [1, 2]) if options.tall else (make_set, options.widths)
    if options.many:
        make, sizes = make_many_set, [BASE]
    folders = {size: make(options.cache, size) for size in sizes}
    if options.only_layers:
        return
    limit = ["--max-memory", options.max_memory] if options.max_memory else []
    done: dict[int, list[Run]] = {size: [] for size in sizes}
    for _ in range(options.runs):
        for size, folder in folders.items():
            done[size].append(blend(folder, limit))
            print(f"{folder.name}: {done[size][-1]}", file=sys.stderr)
    runs = {size: median(its_runs) for size, its_runs in done.items()}
    if options.tall:
        print(tall_table(runs))
        return
    print(table(runs))
    if not options.many:
        plot(runs, options.plot)


if __name__ == "__main__":
    main()

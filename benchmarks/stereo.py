"""Real parallax: ``python benchmarks/stereo.py ../shared/flow --score "python score_photos.py"``

Of pairs of photos that cameras took side by side, which lie in a folder of their own and are no part of the
project (flow_pairs.py), layers are made that overlap by a quarter or half of a photo's width, either camera's
at the left; what most of the pair shows lies on itself. Blended by hugin-abflow and enblend, and scored by a
program that takes a panorama and its layers and prints ``bad=`` and ``step=``. Prints a Markdown table; with
--keep, layers and panoramas are left in that folder.
"""

from __future__ import annotations

import argparse
import itertools
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.flow_pairs import Pair, public_pairs
from benchmarks.quality import ROOT, abflow
from benchmarks.rigs import write_layer

OVERLAPS = (0.25, 0.5)
# Photos of fewer columns are shown twice as large, as working grids would be very small.
_SMALL = 1000


def make_set(folder: Path, pair: Pair, overlap: float, swapped: bool) -> None:
    """Layers of a pair and their project. overlap: its share of a photo's width."""
    times = 2 if pair.a.shape[1] < _SMALL else 1
    first, second = (cv2.resize(one, None, fx=times, fy=times, interpolation=cv2.INTER_CUBIC)
                     for one in ((pair.b, pair.a) if swapped else (pair.a, pair.b)))  # fmt: skip
    truth = pair.backward if swapped else pair.forward
    across, down = (round(-times * float(np.nanmedian(truth[..., k]))) for k in (0, 1))
    height, width = first.shape[:2]
    start, end = round(width * (0.5 - overlap / 2)), round(width * (0.5 + overlap / 2))
    second = second[:, max(start - across, 0) :]
    left, top = max(start, across), min(0, down)
    canvas = max(end, left + second.shape[1]), height + abs(down)
    for index, (photo, x, y) in enumerate(((first[:, :end], 0, -top), (second, left, down - top))):
        pixels: npt.NDArray[np.uint8] = np.dstack([photo[..., ::-1], np.full(photo.shape[:2], 255, np.uint8)])
        write_layer(folder / f"layer{index:04d}.tif", pixels, x, y, *canvas)
    write_project(folder, canvas, (width, height))


def write_project(folder: Path, canvas: tuple[int, int], photo: tuple[int, int]) -> None:
    """A project of two flat layers that are there, of whose photos nothing is known but (width, height)."""
    images = [f'i w{photo[0]} h{photo[1]} f0 v40 r0 p0 y{yaw} n"photo{yaw}.jpg"' for yaw in (-10, 10)]
    lines = [f'p f0 w{canvas[0]} h{canvas[1]} v60 E0 R0 n"TIFF_m c:LZW r:CROP"', "m i0", *images]
    (folder / "project.pto").write_text("\n".join(lines) + "\n", encoding="utf-8")


def blend(folder: Path, name: str, options: list[str]) -> Path:
    """The panorama that hugin-abflow with `options` makes, or enblend."""
    out, layers = folder / f"{name}.tif", sorted(folder.glob("layer*.tif"))
    command = ["enblend", "-o", str(out), *map(str, layers)]
    if name != "enblend":
        command = abflow("-q", "--remap", "never", *options)(folder, layers, 0, out)
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    return out


def scores(scorer: list[str], panorama: Path) -> tuple[float, float]:
    """bad, %, and step of a panorama beside its layers."""
    layers = sorted(panorama.parent.glob("layer*.tif"))
    printed = subprocess.run(
        [*scorer, str(panorama), *map(str, layers)], check=True, stdout=subprocess.PIPE, text=True
    ).stdout
    bad, step = (re.search(rf"\b{name}=(\S+)", printed) for name in ("bad", "step"))
    if not bad or not step:
        raise ValueError(f"{shlex.join(scorer)} printed no bad= and step=: {printed!r}")
    return float(bad[1]), float(step[1])


def row(title: str, found: Iterable[tuple[float, float]]) -> str:
    """A row of the table: bad and step of each blender."""
    return f"| {title} | {' | '.join(f'{bad:.2f} / {step:.3f}' for bad, step in found)} |"


def run(pairs: Path, scorer: list[str], options: list[str], keep: Path) -> None:
    """A table of all pairs, and their means."""
    names = ["hugin-abflow", "enblend"]
    print(f"| pair, overlap, left | {' | '.join(names)} |\n|---|{'---|' * len(names)}")
    every = []
    for pair, overlap, swapped in itertools.product(public_pairs(pairs), OVERLAPS, (False, True)):
        title = f"{pair.name}, {overlap:.0%}, {'b' if swapped else 'a'}"
        folder = keep / re.sub(r"\W+", "-", title)
        folder.mkdir(parents=True, exist_ok=True)
        make_set(folder, pair, overlap, swapped)
        every.append([scores(scorer, blend(folder, name, options)) for name in names])
        print(row(title, every[-1]), flush=True)
    print(row("mean", np.mean(every, 0)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pairs", type=Path, help="the folder of the pairs")
    parser.add_argument("--score", required=True, help="command that scores a panorama beside its layers")
    parser.add_argument("--options", default="", help="of hugin-abflow, such as '--no-flow'")
    parser.add_argument("--keep", type=Path, help="where layers and panoramas are left")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        keep = (given.keep or Path(folder)).resolve()
        run(given.pairs, shlex.split(given.score), shlex.split(given.options), keep)


if __name__ == "__main__":
    main()

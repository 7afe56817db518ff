"""How exact is the flow? ``python benchmarks/flow.py [../shared/flow] [--only NAME ...]``

Endpoint error in px over the pixels that the other image shows, mean over both directions, of hugin-abflow
and of OpenCV's DIS (medium) and Farneback: on pairs with ground truth, which lie in a folder of their own and
are no part of the project, and on synthetic pairs (flow_pairs.py). Seconds are for both directions. Prints a
Markdown table; without the folder, the synthetic pairs alone.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.flow_pairs import Floats, Pair, Pixels, public_pairs, synthetic_pairs
from hugin_abflow import flow
from hugin_abflow.opencl import Device
from hugin_abflow.pyramid import Level
from hugin_abflow.quality import flow_parameters

ROOT = Path(__file__).resolve().parent.parent

Solver = Callable[[Pixels, Pixels], tuple[Floats, Floats]]


@dataclass(frozen=True)
class Result:
    """Endpoint errors, mean and share over 1 px of both directions; seconds."""

    error: float
    outliers: float
    seconds: float


def endpoint_errors(found: Floats, truth: Floats) -> Floats:
    """Lengths of the differences where the truth (h, w, 2) is known, px."""
    known = np.isfinite(truth).all(-1)
    return np.asarray(np.linalg.norm(found[known] - truth[known], axis=-1))


def measure(solver: Solver, pair: Pair) -> Result:
    """Both directions; each counts the same, however much of its truth is known."""
    start = time.perf_counter()
    flows = solver(pair.a, pair.b)
    seconds = time.perf_counter() - start
    errors = [endpoint_errors(f, t) for f, t in zip(flows, (pair.forward, pair.backward), strict=True)]
    return Result(
        float(np.mean([e.mean() for e in errors])), float(np.mean([(e > 1).mean() for e in errors])), seconds
    )


def ours(device: Device) -> Solver:
    """The engine's flow on log brightness, as a chart has it."""

    def solve(a: Pixels, b: Pixels) -> tuple[Floats, Floats]:
        levels = []
        for image in (a, b):
            grey = image.astype(np.float32) @ np.float32([0.114, 0.587, 0.299]) / 255
            levels.append(
                Level(device.upload(np.log(grey + np.float32(0.05))), device.empty(grey.shape).fill(1), False)
            )
        forward, backward = flow.pair_flow(device, *levels, flow_parameters("normal", "on"))
        return forward.get(), backward.get()

    return solve


def dis(a: Pixels, b: Pixels) -> tuple[Floats, Floats]:
    """OpenCV's dense inverse search, preset medium."""
    first, second = (cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in (a, b))
    solver = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    return solver.calc(first, second, None), solver.calc(second, first, None)


def farneback(a: Pixels, b: Pixels) -> tuple[Floats, Floats]:
    """OpenCV's Farneback with five levels, a window of 15 px and polynomials of 5 px."""
    first, second = (cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in (a, b))
    how = (0.5, 5, 15, 3, 5, 1.2, 0)
    forward = cv2.calcOpticalFlowFarneback(first, second, None, *how)
    return forward, cv2.calcOpticalFlowFarneback(second, first, None, *how)


def table(results: dict[str, dict[str, Result]]) -> str:
    """A row for each pair: errors, their ratio to DIS, shares over 1 px, seconds; the means last."""
    names = list(next(iter(results.values())))
    heads = [f"{n} px" for n in names] + ["ours / DIS"] + [f"{n} > 1 px" for n in names]
    lines = [f"| pair | {' | '.join(heads)} | {' | '.join(f'{n} s' for n in names)} |"]
    lines.append("|" + "---|" * (len(heads) + len(names) + 1))
    for pair, row in results.items():
        lines.append(f"| {pair} | {' | '.join(_cells(row))} |")
    mean = {
        name: Result(
            *(float(np.mean([getattr(r[name], key) for r in results.values()])) for key in
              ("error", "outliers", "seconds"))
        )
        for name in names
    }  # fmt: skip
    lines.append(f"| mean | {' | '.join(_cells(mean))} |")
    return "\n".join(lines)


def _cells(row: dict[str, Result]) -> list[str]:
    errors = [f"{one.error:.2f}" for one in row.values()]
    shares = [f"{100 * one.outliers:.0f} %" for one in row.values()]
    times = [f"{one.seconds:.2f}" for one in row.values()]
    return [*errors, f"{row['ours'].error / row['DIS'].error:.2f}", *shares, *times]


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    shared = ROOT.parent / "shared" / "flow"
    parser.add_argument(
        "pairs", type=Path, nargs="?", default=shared, help="folder of pairs with ground truth"
    )
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these pairs alone")
    options = parser.parse_args()
    device = Device()
    solvers: dict[str, Solver] = {"ours": ours(device), "DIS": dis, "Farneback": farneback}
    if not options.pairs.is_dir():
        print(f"{options.pairs} is no folder: synthetic pairs alone", file=sys.stderr)
    warm: npt.NDArray[np.uint8] = np.random.default_rng(0).integers(0, 255, (300, 300, 3), dtype=np.uint8)
    solvers["ours"](warm, warm)  # kernels are built on their first run
    results: dict[str, dict[str, Result]] = {}
    for pair in [*public_pairs(options.pairs), *synthetic_pairs()]:
        if options.only and pair.name not in options.only:
            continue
        results[pair.name] = {name: measure(solver, pair) for name, solver in solvers.items()}
        errors = ", ".join(f"{name} {one.error:.2f}" for name, one in results[pair.name].items())
        print(f"{pair.name}: {errors}", file=sys.stderr)
    if not results:
        raise SystemExit("no pair of that name")
    print(table(results))


if __name__ == "__main__":
    main()

"""Is the flow the parallax? ``python benchmarks/parallax.py [--rigs quad ring] [--parts default "no relay"]``

In the sample room's sets the way from each place of a layer to where another layer shows it is known. Of all
pairs of layers, where both show it, prints a Markdown table: the mean length of the flow and of the true way
within 30 degrees of the poles and elsewhere, in px of the canvas's equator, and how much of the overlaps has
flow that is off by more than 3 px. Pairs count by the area of their overlaps; thin ones are told once more.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import numpy.typing as npt
from scipy import ndimage

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.ablation import PARTS
from benchmarks.quality import add_set_options
from benchmarks.rigs import RIGS, make_set
from hugin_abflow import Settings, merge_project, pairflow, projection
from hugin_abflow.geometry import PairFlow
from sample_projects import lens
from sample_projects.lens import Camera
from sample_projects.scene import room
from sample_projects.tracer import Tracer

Floats = npt.NDArray[np.float64]

POLE = 30.0  # degrees
OFF = 3.0  # px
EVERY = 5  # rows and columns of the canvas that are looked at
SEEN = 0.01  # of the distance: what is nearer by more hides a place
THIN = 0.25  # of the largest overlap of a set


@dataclass(frozen=True)
class Way:
    """From one layer to another at places that both show: areas in px, lengths in px, all (n,)."""

    area: Floats
    polar: npt.NDArray[np.bool_]
    flow: Floats
    truth: Floats
    off: Floats


class _Enough(Exception):
    """The flow is there; the rest of a merge is not needed."""


def flows(folder: Path, settings: Settings) -> list[tuple[str, str, PairFlow]]:
    """Of all pairs of a set, with the names of their layers."""
    found = list[tuple[str, str, PairFlow]]()
    solve = pairflow.solve

    def kept(device: Any, layers: Any, *rest: Any) -> Any:
        for one in solve(device, layers, *rest).flows:
            found.append((layers[one.a].layer.name, layers[one.b].layer.name, one))
        raise _Enough

    with (
        tempfile.TemporaryDirectory() as out,
        mock.patch.object(pairflow, "solve", kept),
        contextlib.suppress(_Enough),
    ):
        project, target = folder / "project.pto", Path(out, "panorama.tif")
        merge_project(project, settings, prefix=str(folder / "layer"), output=target)
    return found


def places(width: int) -> tuple[Floats, npt.NDArray[np.float32]]:
    """Latitudes (n,) and rays (n, 3, 3) of the canvas's pixels that are looked at."""
    rays = lens.equirect_rays(width)[EVERY // 2 :: EVERY, EVERY // 2 :: EVERY].reshape(-1, 3, 3)
    return np.arcsin(np.clip(rays[:, 0, 2].astype(np.float64), -1, 1)), rays


def read(flow: npt.NDArray[np.float32], positions: Floats, wraps: bool) -> Floats:
    """Flow at chart positions, (n, 2); what lies beside the chart counts as its rim."""
    padded = np.pad(flow.astype(np.float64), ((0, 0), (1, 1), (0, 0)), "wrap" if wraps else "edge")
    places = positions[:, 1] - 0.5, positions[:, 0] + 0.5
    return np.stack(
        [ndimage.map_coordinates(padded[..., k], places, order=1, mode="nearest") for k in (0, 1)], 1
    )


def points(positions: Floats, transform: npt.NDArray[np.float32]) -> Floats:
    """Unit vectors (n, 3) of a spherical chart's positions, as kernels/common.cl has it."""
    t = transform.astype(np.float64)
    lon, lat = (positions[:, 0] - t[11]) / t[9], (t[12] - positions[:, 1]) / t[10]
    return projection.directions(lon, lat) @ t[:9].reshape(3, 3)


def ways(
    found: list[tuple[str, str, PairFlow]], cameras: list[Camera], tracer: Tracer, width: int
) -> Iterator[Way]:
    """Both ways of each pair."""
    latitudes, rays = places(width)
    directions = rays[:, 0].astype(np.float64)
    distances = [tracer.look(camera.centre, rays, grid=1)[1].astype(np.float64) for camera in cameras]
    px = width / (2 * np.pi)
    for first, second, pair in found:
        a, b = (int(name[5:9]) for name in (first, second))
        for start, end, flow in ((a, b, pair.forward.get()), (b, a, pair.backward.get())):
            own, other = cameras[start], cameras[end]
            scene = directions * distances[start][:, None] + np.subtract(own.centre, other.centre)
            far = np.linalg.norm(scene, axis=1)
            there = scene / far[:, None]
            both = own.covers(directions) & other.covers(directions) & other.covers(there)
            shown = np.flatnonzero(both)
            if not len(shown):
                continue
            seen = tracer.look(other.centre, _rays(there[shown], width), grid=1)[1]
            shown = shown[seen > far[shown] * (1 - SEEN)]
            at = pair.chart.positions(directions[shown])
            led = points(at + read(flow, at, pair.chart.wraps), pair.chart.transform)
            yield Way(
                np.cos(latitudes[shown]) * EVERY**2,
                np.abs(latitudes[shown]) > np.radians(90 - POLE),
                px * _angle(directions[shown], led),
                px * _angle(directions[shown], there[shown]),
                px * _angle(led, there[shown]),
            )


def _rays(directions: Floats, width: int) -> npt.NDArray[np.float32]:
    """Rays that are no wider than a point."""
    rays = np.zeros((len(directions), 3, 3), np.float32)
    rays[:, 0] = directions
    return rays


def _angle(a: Floats, b: Floats) -> Floats:
    return np.asarray(2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=1) / 2, 0, 1)))


def row(found: list[Way]) -> str:
    """The table's cells after set and engine."""
    cells = list[str]()
    for polar in (True, False):
        area = sum(float(w.area[w.polar == polar].sum()) for w in found)
        lengths = [
            sum(float((w.area * values)[w.polar == polar].sum()) for w, values in pairs) / max(area, 1e-9)
            for pairs in ([(w, w.flow) for w in found], [(w, w.truth) for w in found])
        ]
        said = [f"{lengths[0]:.1f}", f"{lengths[1]:.1f}", f"{lengths[0] / max(lengths[1], 1e-9):.2f}"]
        cells += said if area else ["-"] * 3
    largest = max(float(w.area.sum()) for w in found)
    for some in (found, [w for w in found if w.area.sum() < THIN * largest]):
        area = sum(float(w.area.sum()) for w in some)
        off = sum(float(w.area[w.off > OFF].sum()) for w in some)
        cells.append(f"{100 * off / area:.1f}" if area else "-")
    return " | ".join(cells)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_set_options(parser)
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=["no relay", "default"])
    options = parser.parse_args()
    print(
        "| set | engine | flow at poles px | truth px | ratio | flow elsewhere px | truth px | ratio "
        "| off > 3 px % | in thin overlaps % |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for rig in options.rigs:
        for seed in options.seeds:
            folder = options.cache / f"{rig}-{seed}-{options.width}"
            make_set(folder, rig, seed, options.width)
            tracer = Tracer(room(seed), folder.parent, samples=1)
            for part in options.parts:
                found = flows(folder, Settings(**PARTS[part]))
                measured = list(ways(found, RIGS[rig](seed), tracer, options.width))
                print(f"| {rig} {seed} | {part} | {row(measured)} |", flush=True)


if __name__ == "__main__":
    main()

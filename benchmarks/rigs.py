"""Rigs in the sample room: layers as nona writes them, a project, and the true views to judge a blend by.

A set is a folder: ``layer0000.tif`` ..., ``project.pto``, ``views.npz``. It is made once and kept.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import tifffile

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.scoring import Chart, View
from sample_projects import lens
from sample_projects.generate import EXPOSURE, dual_cameras, ring_cameras
from sample_projects.lens import CIRCULAR_FISHEYE, RECTILINEAR, Camera
from sample_projects.project import project_text
from sample_projects.scene import EYE, room
from sample_projects.tracer import Tracer

Mask = npt.NDArray[np.bool_]
Pixels = npt.NDArray[np.uint8]

STATIONS = 5  # true views between two cameras, besides the cameras' own
MARGIN = 32  # px around an overlap that are judged too
BAND = 55.0  # degrees of latitude of the equatorial chart; the caps overlap it by 5 degrees
CAP = 40.0  # degrees from the pole


def quad_cameras(turn: float) -> list[Camera]:
    """Four fisheyes of 200 degrees around, 4 cm off the axis: all see both poles."""
    cameras = []
    for k in range(4):
        ahead = np.radians(90 * k + turn)
        centre = (EYE[0] + 0.04 * np.sin(ahead), EYE[1] + 0.04 * np.cos(ahead), EYE[2])
        heading = (90 * k + turn + 180) % 360 - 180
        cameras.append(
            Camera(centre, heading, 0.0, 0.0, 1200, 1200, 206, CIRCULAR_FISHEYE, 0.0, 600 * 200 / 206)
        )
    return cameras


def handheld_cameras(turn: float, seed: int) -> list[Camera]:
    """Two rows of eight rectilinear photos by somebody who turns with the camera 10 cm in front."""
    rng = np.random.default_rng(seed)
    cameras = []
    for pitch in (22.0, -20.0):
        for k in range(8):
            yaw, tilt, roll = rng.normal(0, 1.2, 3)
            ahead = np.radians(45 * k + turn)
            arm = np.array([0.10 * np.sin(ahead), 0.10 * np.cos(ahead), 0.0])
            centre = np.array(EYE) + arm + rng.normal(0, 0.008, 3)
            heading = (45 * k + turn + yaw + 180) % 360 - 180
            place = (float(centre[0]), float(centre[1]), float(centre[2]))
            cameras.append(Camera(place, heading, pitch + tilt, roll, 1200, 900, 66.0, RECTILINEAR))
    return cameras


def gigapixel_cameras() -> list[Camera]:
    """Ten rows of thirty narrow photos, by a camera on a head that turns 5 cm behind it."""
    rng = np.random.default_rng(1)
    cameras = []
    for pitch in np.arange(-67.5, 70, 15):
        for k in range(30):
            yaw, tilt, roll = rng.normal(0, 0.3, 3)
            ahead = np.radians(12 * k)
            arm = np.array([0.05 * np.sin(ahead), 0.05 * np.cos(ahead), 0.0])
            x, y, z = np.array(EYE) + arm + rng.normal(0, 0.004, 3)
            heading = (12 * k + yaw + 180) % 360 - 180
            place = float(x), float(y), float(z)
            cameras.append(Camera(place, heading, pitch + tilt, roll, 480, 500, 20.0, RECTILINEAR))
    return cameras


RIGS: dict[str, Callable[[int], list[Camera]]] = {
    "ring": lambda seed: ring_cameras(turn=_turn(seed)),
    "dual": lambda seed: dual_cameras(turn=_turn(seed)),
    "quad": lambda seed: quad_cameras(_turn(seed)),
    "handheld": lambda seed: handheld_cameras(_turn(seed), seed),
}


def _turn(seed: int) -> float:
    """Which way a rig looks: another one for each seed."""
    return round((seed * 137.508) % 360, 1)


@dataclass(frozen=True)
class ChartMap:
    """One chart of a canvas: the rays of its pixels, and where they lie on the canvas.

    Margins of `pad` px around the part that is judged hold what a search may reach.
    """

    rays: npt.NDArray[np.float32]  # (h, w, 3, 3)
    canvas: npt.NDArray[np.float32]  # (h, w, 2), canvas coordinates of pixel centres

    def take(self, image: npt.NDArray[Any], interpolation: int) -> npt.NDArray[Any]:
        """The canvas image, resampled to the chart; wraps at 360 degrees."""
        side = 8
        padded = np.concatenate([image[:, -side:], image, image[:, :side]], axis=1)
        x, y = self.canvas[..., 0] - 0.5 + side, self.canvas[..., 1] - 0.5
        return np.asarray(cv2.remap(padded, x, y, interpolation, borderMode=cv2.BORDER_REPLICATE))


def chart_maps(width: int, pad: int) -> list[ChartMap]:
    """The band around the equator, north cap, south cap."""
    rows = round(width / 360 * BAND)
    middle = width // 4
    top, bottom = middle - rows - pad, middle + rows + pad
    y, x = np.mgrid[top:bottom, -pad : width + pad] + 0.5
    rays = lens.equirect_rays(width, top, bottom)
    rays = np.concatenate([rays[:, -pad:], rays, rays[:, :pad]], axis=1)
    maps = [ChartMap(rays, np.stack([x % width, y], -1).astype(np.float32))]
    size = round(width / 360 * 2 * CAP)
    for south in (False, True):
        rays = lens.cap_rays(size, CAP, south)
        canvas = lens.canvas_points(rays[..., 0, :].astype(np.float64), width)
        maps.append(ChartMap(rays, canvas.astype(np.float32)))
    return maps


def grow(mask: Mask, pixels: int) -> Mask:
    """The mask and everything within that many pixels of it."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel) > 0)


def make_set(folder: Path, rig: str, seed: int, width: int) -> None:
    """Render layers, project and true views into `folder`, unless they are there."""
    if (folder / "views.npz").exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    cameras = RIGS[rig](seed)
    tracer = Tracer(room(seed), folder.parent, samples=12)
    rng = np.random.default_rng(seed)
    for index, camera in enumerate(cameras):
        layer, left, top = render_layer(camera, tracer, width, 1 + rng.uniform(-0.02, 0.02))
        write_layer(folder / f"layer{index:04d}.tif", layer, left, top, width)
    write_project(folder, cameras, width)
    _render_views(folder / "views.npz", cameras, tracer, width)


def render_layer(
    camera: Camera,
    tracer: Tracer,
    width: int,
    gain: float = 1.0,
    grid: int = 2,
    reach: float = 180.0,
) -> tuple[Pixels, int, int]:
    """What nona makes of that camera's photo: (rows, columns, 4) cropped RGBA, and its left and top.

    reach: degrees above and below its pitch within which all of it is known to lie.
    """
    strips, step = [], 256
    highest, lowest = ((90 - camera.pitch + side) / 180 * width / 2 for side in (-reach, reach))
    first, last = max(0, round(highest)), min(width // 2, round(lowest))
    for top in range(first, last, step):
        bottom = min(last, top + step)
        y, x = np.mgrid[top:bottom, 0:width] + 0.5
        covered = camera.covers(lens.equirect_directions(x, y, width))
        strip = np.zeros((bottom - top, width, 4), np.uint8)
        if covered.any():
            rays = lens.equirect_rays(width, top, bottom)[covered]
            colours, _ = tracer.look(camera.centre, rays, grid=grid, exposure=EXPOSURE)
            strip[covered, :3] = np.clip(colours * 255 * gain + 0.5, 0, 255)
            strip[covered, 3] = 255
        strips.append(strip)
    canvas = np.concatenate(strips)
    rows, columns = np.flatnonzero(canvas[..., 3].any(1)), np.flatnonzero(canvas[..., 3].any(0))
    left, top = int(columns[0]), int(rows[0])
    return canvas[top : rows[-1] + 1, left : columns[-1] + 1], left, first + top


def write_project(folder: Path, cameras: Sequence[Camera], width: int) -> None:
    """The project of the layers in a folder; its photos are not there."""
    names = [f"photo{index:04d}.jpg" for index in range(len(cameras))]
    (folder / "project.pto").write_text(project_text(cameras, names, width), encoding="utf-8")


def write_layer(
    path: Path, layer: Pixels, left: int, top: int, width: int, height: int | None = None
) -> None:
    """A TIFF with nona's tags: LZW, 150 dpi, position in inches, the canvas in PIXAR's tags.

    height: of the canvas; None: half its width.
    """
    tags = [
        (286, 5, 1, _rational(left / 150), True),
        (287, 5, 1, _rational(top / 150), True),
        (33300, 4, 1, width, True),
        (33301, 4, 1, height or width // 2, True),
    ]
    tifffile.imwrite(
        path,
        layer,
        photometric="rgb",
        extrasamples=["unassalpha"],
        compression="lzw",
        rowsperstrip=32,
        resolution=(150, 150),
        resolutionunit="inch",
        metadata=None,
        extratags=tags,
    )


def _rational(value: float) -> tuple[int, int]:
    """A fraction as libtiff makes it of a float: a power of two below, as fine as 32 bits allow."""
    denominator = 1
    while value * denominator < 1 << 30 and denominator < 1 << 30:
        denominator *= 2
    return round(value * denominator), denominator


def read_canvas(path: Path, width: int) -> Pixels:
    """(width / 2, width, 4) RGBA of a layer or a result at its place on the canvas."""
    with tifffile.TiffFile(path) as file:
        pixels = file.asarray()
        tags = file.pages.first.tags
        dpi = tags["XResolution"].value[0] / tags["XResolution"].value[1] if "XResolution" in tags else 150
        left, top = (
            round(tags[name].value[0] / tags[name].value[1] * dpi) if name in tags else 0
            for name in ("XPosition", "YPosition")
        )
    if pixels.shape[2] == 3:
        pixels = np.concatenate([pixels, np.full_like(pixels[..., :1], 255)], axis=2)
    canvas = np.zeros((width // 2, width, 4), np.uint8)
    canvas[top : top + pixels.shape[0], left : left + pixels.shape[1]] = pixels
    return canvas


def _reach(cameras: list[Camera], depth: float, width: int) -> int:
    """Search reach in px: half the parallax of the nearest things between neighbouring cameras, and some."""
    centres = np.array([camera.centre for camera in cameras])
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    apart[apart == 0] = np.inf
    neighbours = float(np.sort(apart, axis=1)[:, : min(2, len(cameras) - 1)].max())
    return int(np.clip(np.ceil(neighbours / depth / 2 * width / (2 * np.pi)) + 4, 8, 28 * width / 2048))


def _render_views(path: Path, cameras: list[Camera], tracer: Tracer, width: int) -> None:
    """True views of all overlaps, from the cameras and from stations between them, on each chart."""
    nearest = tracer.look(EYE, lens.equirect_rays(256).reshape(-1, 3, 3), grid=1)[1]
    reach = _reach(cameras, float(np.percentile(nearest, 1)), width)
    stored: dict[str, npt.NDArray[Any]] = {"reach": np.array(reach), "width": np.array(width)}
    for number, chart in enumerate(chart_maps(width, MARGIN + reach)):
        directions = chart.rays[..., 0, :].astype(np.float64)
        seen = [camera.covers(directions) for camera in cameras]
        overlap = np.sum(seen, axis=0) >= 2
        union = np.any(seen, axis=0)
        judged = grow(overlap, MARGIN) & union
        stored[f"judged{number}"] = judged
        wanted: dict[tuple[float, ...], Mask] = {}
        for first, second in combinations(range(len(cameras)), 2):
            common = seen[first] & seen[second]
            if common.sum() < 1500:  # a corner that other pairs cover as well
                continue
            region = grow(common, MARGIN + reach)
            for t in np.linspace(0, 1, STATIONS + 2):
                start, end = np.array(cameras[first].centre), np.array(cameras[second].centre)
                eye = tuple(np.round(start + t * (end - start), 6).tolist())
                wanted[eye] = wanted.get(eye, np.zeros_like(region)) | region
        for index, (eye, region) in enumerate(wanted.items()):
            colours, _ = tracer.look(eye, chart.rays[region], grid=2, exposure=EXPOSURE)
            grey = np.zeros(region.shape, np.uint8)
            grey[region] = np.clip(colours @ np.array([0.299, 0.587, 0.114]) * 255 + 0.5, 0, 255)
            rows, columns = np.flatnonzero(region.any(1)), np.flatnonzero(region.any(0))
            box = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
            stored[f"grey{number}_{index}"] = grey[box]
            stored[f"known{number}_{index}"] = np.packbits(region[box])
            stored[f"box{number}_{index}"] = np.array([box[0].start, box[1].start])
    partial = path.with_name("unfinished.npz")
    np.savez(partial, **stored)  # type: ignore[arg-type]
    partial.rename(path)


def load_charts(folder: Path, picture: Pixels) -> tuple[list[Chart], int]:
    """Charts of a result (height, width, 4; the whole canvas) with the true views, and the search reach."""
    with np.load(folder / "views.npz") as stored:
        width, reach = int(stored["width"]), int(stored["reach"])
        grey = _grey(picture)
        layers = [read_canvas(path, width) for path in sorted(folder.glob("layer[0-9]*.tif"))]
        charts = []
        for number, chart in enumerate(chart_maps(width, MARGIN + reach)):
            judged = stored[f"judged{number}"]
            views = []
            index = 0
            while f"grey{number}_{index}" in stored:
                part = stored[f"grey{number}_{index}"]
                y, x = stored[f"box{number}_{index}"]
                box = (slice(y, y + part.shape[0]), slice(x, x + part.shape[1]))
                whole, known = np.zeros(judged.shape, np.float32), np.zeros(judged.shape, bool)
                whole[box] = part
                bits = np.unpackbits(stored[f"known{number}_{index}"], count=part.size)
                known[box] = bits.reshape(part.shape).astype(bool)
                views.append(View(whole, known))
                index += 1
            opaque = chart.take(picture[..., 3], cv2.INTER_NEAREST) > 127
            own = [_seen_on(chart, layer) for layer in layers]
            charts.append(Chart(chart.take(grey, cv2.INTER_CUBIC), opaque, judged, views, own))
    return charts, reach


def _grey(picture: Pixels) -> npt.NDArray[np.float32]:
    return (picture[..., :3] @ np.array([0.299, 0.587, 0.114])).astype(np.float32)


def _seen_on(chart: ChartMap, layer: Pixels) -> View:
    """A layer on a chart, known where no tap of the interpolation is outside it."""
    known = chart.take((layer[..., 3] > 127).astype(np.float32), cv2.INTER_LINEAR)
    core = cv2.erode((known > 0.999).astype(np.uint8), np.ones((5, 5), np.uint8))
    return View(chart.take(_grey(layer), cv2.INTER_CUBIC), np.asarray(core > 0))

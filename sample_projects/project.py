"""Writes the sample's and the benchmarks' .pto files, and control points that are true."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sample_projects.lens import CIRCULAR_FISHEYE, Camera
from sample_projects.tracer import Tracer

ControlPoint = tuple[int, int, float, float, float, float]  # image n, image N, x, y, X, Y

# What Hugin writes below the images; the blender reads these lines too.
HUGIN_OPTIONS = """\
#hugin_optimizeReferenceImage 0
#hugin_blender enblend
#hugin_remapper nona
#hugin_enblendOptions
#hugin_enfuseOptions
#hugin_hdrmergeOptions -m avg -c
#hugin_verdandiOptions
#hugin_outputLDRBlended true
#hugin_outputLDRLayers false
#hugin_outputLDRExposureRemapped false
#hugin_outputLDRExposureLayers false
#hugin_outputLDRExposureBlended false
#hugin_outputLDRStacks false
#hugin_outputLDRExposureLayersFused false
#hugin_outputHDRBlended false
#hugin_outputHDRLayers false
#hugin_outputHDRStacks false
#hugin_outputLayersCompression LZW
#hugin_outputImageType tif
#hugin_outputImageTypeCompression LZW
#hugin_outputJPEGQuality 90
#hugin_outputImageTypeHDR exr
#hugin_outputImageTypeHDRCompression LZW
#hugin_outputStacksMinOverlap 0.700
#hugin_outputLayersExposureDiff 0.50
#hugin_optimizerMasterSwitch 0
#hugin_optimizerPhotoMasterSwitch 21
"""


def project_text(
    cameras: Sequence[Camera],
    names: Sequence[str],
    width: int,
    points: Sequence[ControlPoint] = (),
    bottom: int | None = None,
) -> str:
    """A project as Hugin saves it: canvas `width` x `width` / 2, equirectangular, 360 degrees.

    `bottom`: crop the canvas below that row (p-line S), where no photo looks.
    """
    crop = "" if bottom is None else f" S0,{width},0,{bottom}"
    lines = [
        "# hugin project file",
        "#hugin_ptoversion 2",
        f'p f2 w{width} h{width // 2} v360  k0 E0 R0{crop} n"TIFF_m c:LZW r:CROP"',
        "m i0",
        "",
        "# image lines",
    ]
    for camera, name in zip(cameras, names, strict=True):
        circle = ""
        if camera.projection == CIRCULAR_FISHEYE and camera.circle:
            left, top = camera.width / 2 - camera.circle, camera.height / 2 - camera.circle
            edges = (left, camera.width - left, top, camera.height - top)
            circle = " S" + ",".join(str(round(edge)) for edge in edges)
        lines.append("#-hugin  cropFactor=1")
        lines.append(
            f"i w{camera.width} h{camera.height} f{camera.projection} v{camera.hfov:g} "
            "Ra0 Rb0 Rc0 Rd0 Re0 Eev0 Er1 Eb1 "
            f"r{camera.roll:g} p{camera.pitch:g} y{camera.yaw:g} TrX0 TrY0 TrZ0 Tpy0 Tpp0 j0 "
            f"a0 b{camera.b:g} c0 d0 e0 g0 t0 Va1 Vb0 Vc0 Vd0 Vx0 Vy0 {circle} "
            f'Vm5 n"{name}"'
        )
    lines += ["", "", "# specify variables that should be optimized"]
    lines += [f"v {key}{image}" for image in range(1, len(cameras)) for key in "rpy"]
    lines += ["v", "", "", "# control points"]
    lines += [f"c n{n} N{m} x{x:.2f} y{y:.2f} X{u:.2f} Y{v:.2f} t0" for n, m, x, y, u, v in points]
    return "\n".join(lines) + "\n\n" + HUGIN_OPTIONS


def control_points(
    cameras: Sequence[Camera],
    tracer: Tracer,
    each: int = 6,
) -> list[ControlPoint]:
    """The same point of the room in two photos, for every pair that overlaps.

    Points lie at least 2 m away, where 7 cm between the cameras matter least, and are seen by both
    (nothing stands in between).
    """
    found: list[ControlPoint] = []
    for n, first in enumerate(cameras):
        grid = np.stack(np.meshgrid(np.linspace(0.06, 0.94, 15), np.linspace(0.06, 0.94, 19)), -1).reshape(
            -1, 2
        )
        at = np.round(grid * (first.width, first.height)) + 0.5
        directions = first.directions(at[:, 0], at[:, 1])
        rays = np.stack([directions, directions * 0, directions * 0], -2).astype(np.float32)
        far = tracer.look(first.centre, rays, grid=1)[1]
        points = np.asarray(first.centre) + directions * far[:, None]
        for m in range(n + 1, len(cameras)):
            second = cameras[m]
            towards = points - np.asarray(second.centre)
            distance = np.linalg.norm(towards, axis=1)
            unit = towards / distance[:, None]
            there = second.project(unit)
            back = np.stack([unit, unit * 0, unit * 0], -2).astype(np.float32)
            seen = np.abs(tracer.look(second.centre, back, grid=1)[1] - distance) < 0.005
            good = first.covers(directions) & second.covers(unit) & seen & (far > 2) & (far < 10)
            chosen = np.flatnonzero(good)
            if len(chosen) < each:
                continue
            for k in chosen[np.linspace(0, len(chosen) - 1, each).round().astype(int)]:
                # Hugin counts pixels from the centre of the first one
                x, y, u, v = (float(c) - 0.5 for c in (*at[k], *there[k]))
                found.append((n, m, x, y, u, v))
    return found

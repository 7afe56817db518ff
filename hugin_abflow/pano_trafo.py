"""A project's control points on the canvas, by Hugin's pano_trafo."""

from __future__ import annotations

import logging
import math
import os
import re
import subprocess
from collections.abc import Mapping, Sequence

from hugin_abflow import pto
from hugin_abflow.guides import Guide
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.project import Plan

_log = logging.getLogger(__name__)

_TIMEOUT = 60.0  # s; it maps 50,000 points in a quarter of a second
# What it prints of a point that no place of the canvas shows.
_NOWHERE = (-1.0, -1.0)


def images_of(plan: Plan, layers: Sequence[Layer]) -> list[int | None]:
    """The index of each layer's image in the project: the number at the end of its file's name.

    Where these are not the numbers of different active images (pages of one file, other names): the active
    images in order, if there are as many; else None.
    """
    active = [image.index for image in plan.images]
    ends = [re.search(r"(\d{4})$", layer.file.stem) if layer.file else None for layer in layers]
    named = [int(end[1]) for end in ends if end]
    if len(set(named)) == len(layers) and set(active).issuperset(named):
        return list(named)
    return list(active) if len(active) == len(layers) else [None] * len(layers)


def read_guides(plan: Plan, places: Mapping[int, int]) -> list[Guide]:
    """The control points between photos that are merged, as guides.

    places  index in the project of each image that is merged, to the index of its layer.

    Points of lines and points within one image are no guides. None, said at level info, where pano_trafo is
    not installed or fails: the flow does without. Raises `pto.PtoError` as `pto.load` does.
    """
    project = pto.load(plan.file)
    points = [
        (number, point)
        for number, point in enumerate(project.control_points)
        if point.type == 0
        and point.image1 != point.image2
        and point.image1 in places
        and point.image2 in places
    ]
    if not points:
        return []
    ends = [(point.image1, point.x1, point.y1) for _, point in points]
    ends += [(point.image2, point.x2, point.y2) for _, point in points]
    mapped = _map(plan, ends)
    if mapped is None:
        return []
    guides = []
    for (number, point), one, other in zip(points, mapped, mapped[len(points) :], strict=False):
        name = (
            f"control point {number} of images {point.image1} and {point.image2} "
            f"(line {project.control_points.positions[number] + 1} of {plan.file.name})"
        )
        at_a, at_b = _on_canvas(one, plan.canvas), _on_canvas(other, plan.canvas)
        if at_a is None or at_b is None:
            _log.info("%s is ignored: it is not on the canvas", name)
            continue
        guides.append(Guide(places[point.image1], places[point.image2], at_a, at_b, name))
    _log.info("%d control points between the layers", len(guides))
    return guides


def _map(plan: Plan, ends: Sequence[tuple[int, float, float]]) -> list[tuple[float, float]] | None:
    """Canvas pixels of places (image, x, y) in photos, by one run; None where there is no answer.

    On both sides the centre of the first pixel is at (0, 0), as in Hugin.
    """
    asked = "".join(f"{image} {x!r} {y!r}\n" for image, x, y in ends)
    command = ["pano_trafo", str(plan.file)]
    _log.info("%s", " ".join(command))
    try:
        process = subprocess.run(
            command,
            input=asked,
            capture_output=True,
            text=True,
            errors="replace",
            env={**os.environ, "LANGUAGE": "en"},
            timeout=_TIMEOUT,
            check=False,
        )
        lines = [tuple(map(float, line.split())) for line in process.stdout.splitlines() if line.strip()]
    except FileNotFoundError:
        _log.info("control points do not guide the flow: pano_trafo (of Hugin's tools) is not in PATH")
        return None
    except (OSError, subprocess.TimeoutExpired, ValueError) as error:
        _log.warning("control points do not guide the flow: pano_trafo failed (%s)", error)
        return None
    if process.returncode or len(lines) != len(ends) or any(len(line) != 2 for line in lines):
        said = (process.stderr or process.stdout).strip().splitlines()[-1:] or ["(nothing)"]
        _log.warning(
            "control points do not guide the flow: pano_trafo failed (exit code %d): %s",
            process.returncode,
            said[0],
        )
        return None
    return [(line[0], line[1]) for line in lines]


def _on_canvas(place: tuple[float, float], canvas: Canvas) -> tuple[float, float] | None:
    """A place in our pixels, whose centres are at + 0.5; None if it is not on the canvas."""
    x, y = place[0] + 0.5, place[1] + 0.5
    if place == _NOWHERE or not (math.isfinite(x) and math.isfinite(y)):
        return None
    if canvas.wraps:
        x %= canvas.width
    return (x, y) if 0 <= x <= canvas.width and 0 <= y <= canvas.height else None

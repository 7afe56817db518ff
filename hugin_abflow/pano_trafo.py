"""A project's control points on the canvas, by Hugin's pano_trafo."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Mapping, Sequence

from hugin_abflow import pto
from hugin_abflow.errors import ProgramFailedError, ProgramMissingError
from hugin_abflow.guides import Guide
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.programs import run
from hugin_abflow.project import Plan

_log = logging.getLogger(__name__)

# What it prints of a point that no place of the canvas shows.
_NOWHERE = (-1.0, -1.0)


def images_of(plan: Plan, layers: Sequence[Layer]) -> list[int | None]:
    """The index of each layer's image in the project: the number at the end of its file's name.

    Where these are not the numbers of different active images (pages of one file, stacks, other names): the
    active images in order, if there are as many; else None.
    """
    active = [image.index for image in plan.images]
    names = [layer.file.stem for layer in layers if layer.file]
    ends = [re.search(r"(?<!_stack_[lh]dr_)(\d{4})$", name) for name in names]
    named = [int(end[1]) for end in ends if end]
    if len(set(named)) == len(layers) and set(active).issuperset(named):
        return list(named)
    return list(active) if len(active) == len(layers) else [None] * len(layers)


def read_guides(plan: Plan, places: Mapping[int, int]) -> list[Guide]:
    """The control points between photos that are merged, as guides.

    places  index in the project of each image that is merged, to the index of its layer.

    Points of lines and points within one image, or one layer, are no guides. None, said at level info, where
    pano_trafo is not installed or fails: the flow does without. Raises `pto.PtoError` as `pto.load` does.
    """
    project = pto.load(plan.file)
    points = [
        (number, point)
        for number, point in enumerate(project.control_points)
        if point.type == 0
        and point.image1 != point.image2
        and point.image1 in places
        and point.image2 in places
        and places[point.image1] != places[point.image2]
    ]
    if not points:
        return []
    ends = [(point.image1, point.x1, point.y1) for _, point in points]
    ends += [(point.image2, point.x2, point.y2) for _, point in points]
    try:
        mapped = map_places(plan, ends)
    except ProgramMissingError:
        _log.info("control points do not guide the flow: pano_trafo (of Hugin's tools) is not in PATH")
        return []
    except ProgramFailedError as error:
        _log.warning("control points do not guide the flow: %s", error)
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


def map_places(
    plan: Plan, places: Sequence[tuple[int, float, float]], *options: str
) -> list[tuple[float, float] | None]:
    """Canvas pixels of places (image, x, y) in photos; with the option ``-r`` the other way round.

    None for a place that is not on the other side.

    On both sides the centre of the first pixel is at (0, 0), as in Hugin. All are mapped by one run, 50,000
    in a quarter of a second. Raises `ProgramMissingError`, `ProgramFailedError`.
    """
    asked = "".join(f"{image} {x!r} {y!r}\n" for image, x, y in places)
    answer = run(["pano_trafo", *options, str(plan.file)], plan.folder, asked)
    try:
        lines = [tuple(map(float, line.split())) for line in answer.splitlines() if line.strip()]
    except ValueError as error:
        raise ProgramFailedError(f"pano_trafo failed: {error}") from None
    if len(lines) != len(places) or any(len(line) != 2 for line in lines):
        raise ProgramFailedError(f"pano_trafo failed: {len(lines)} answers to {len(places)} questions")
    return [None if line == _NOWHERE else (line[0], line[1]) for line in lines]


def _on_canvas(place: tuple[float, float] | None, canvas: Canvas) -> tuple[float, float] | None:
    """A place in our pixels, whose centres are at + 0.5; None if it is not on the canvas."""
    if place is None or not (math.isfinite(place[0]) and math.isfinite(place[1])):
        return None
    x, y = place[0] + 0.5, place[1] + 0.5
    if canvas.wraps:
        x %= canvas.width
    return (x, y) if 0 <= x <= canvas.width and 0 <= y <= canvas.height else None

"""Photos that belong together: stacks of one view, and layers of one exposure; grouped as Hugin does."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence

from hugin_abflow import pto
from hugin_abflow.brackets import EXPOSURE_DIFFERENCE
from hugin_abflow.pano_trafo import map_places
from hugin_abflow.project import Plan

_STEPS = 10  # places along each side of a photo; as Hugin
_CIRCULAR = (2, 8, 20)  # projections of photos whose crop is a circle: circular fisheyes
_MIN_OVERLAP = 0.7  # Hugin's default


def stacks(plan: Plan, images: Sequence[int]) -> list[list[int]]:
    """The images in groups that show the same: each overlaps the first of its group by 70 % or more.

    The project may say another share (outputStacksMinOverlap). The overlap of two images is the share of
    places, spread over one, that the other shows too; the greater of both (Hugin's `getHDRStacks`). Raises
    `ProgramMissingError` and `ProgramFailedError` for pano_trafo.
    """
    if len(images) < 2:
        return [list(images)]
    project = pto.load(plan.file)
    least = _number(project.option("outputStacksMinOverlap", ""), _MIN_OVERLAP)
    photos = {index: _Frame(project.images[index]) for index in images}
    asked = [(index, x, y) for index in images for x, y in photos[index].places()]
    pairs = [
        (index, other, *place)
        for (index, _, _), place in zip(asked, map_places(plan, asked), strict=True)
        for other in images
        if place is not None and other != index
    ]
    answers = map_places(plan, [(other, x, y) for _, other, x, y in pairs], "-r")
    places = Counter(index for index, _, _ in asked)
    shared = Counter(
        (index, other)
        for (index, other, _, _), place in zip(pairs, answers, strict=True)
        if place is not None and photos[other].shows(*place)
    )

    def belongs(first: int, other: int) -> bool:
        shares = (shared[one, two] / max(1, places[one]) for one, two in ((first, other), (other, first)))
        return max(shares) > least

    return _grouped(images, belongs)


def exposure_layers(plan: Plan, images: Sequence[int]) -> list[list[int]]:
    """The images in groups whose exposure differs from the first one's by less than half a stop.

    The project may say another difference (outputLayersExposureDiff); Hugin's `getExposureLayers`.
    """
    project = pto.load(plan.file)
    most = _number(project.option("outputLayersExposureDiff", ""), EXPOSURE_DIFFERENCE)
    values = {index: project.images[index].variable("Eev") for index in images}
    return _grouped(images, lambda first, other: abs(values[first] - values[other]) < most)


def _grouped(images: Sequence[int], belongs: Callable[[int, int], bool]) -> list[list[int]]:
    """Groups: the first image that is left, and all others that belong to it."""
    groups = []
    left = sorted(images)
    while left:
        first, *others = left
        group = [first, *(other for other in others if belongs(first, other))]
        groups.append(group)
        left = [image for image in others if image not in group]
    return groups


class _Frame:
    """The part of a photo that is used: a rectangle, or a circle in one; both may reach beyond the photo."""

    def __init__(self, image: pto.Image) -> None:
        whole = (0, 0, image.width, image.height)
        self.left, self.top, self.right, self.bottom = image.crop or whole
        self.photo = image.width, image.height
        self.circle = image.crop is not None and image.projection in _CIRCULAR

    def places(self) -> list[tuple[float, float]]:
        """Places in px, spread evenly over what is in the photo, that are used."""
        left, top = max(self.left, 0), max(self.top, 0)
        width, height = min(self.right, self.photo[0]) - left, min(self.bottom, self.photo[1]) - top
        count = max(2, min(_STEPS, width, height))
        every = [
            (x / count * width + left, y / count * height + top) for x in range(count) for y in range(count)
        ]
        return [place for place in every if self.shows(*place)]

    def shows(self, x: float, y: float) -> bool:
        """Whether a place is used; Hugin takes whole pixels, and beyond the photo a rectangle's, too."""
        if not (math.isfinite(x) and math.isfinite(y)):
            return False
        x, y = math.trunc(x), math.trunc(y)
        if not (self.left <= x < self.right and self.top <= y < self.bottom):
            return False
        radius = min(self.right - self.left, self.bottom - self.top) / 2
        centre_x, centre_y = (self.left + self.right) / 2, (self.top + self.bottom) / 2
        within = 0 <= x < self.photo[0] and 0 <= y < self.photo[1]
        return not self.circle or (within and math.hypot(x - centre_x, y - centre_y) < radius)


def _number(text: str, default: float) -> float:
    """An option's number; the default where it is none."""
    try:
        return float(text)
    except ValueError:
        return default

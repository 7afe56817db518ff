"""How true is a panorama? Compares it, patch by patch, with what really can be seen from between the cameras.

A blender has to invent a view between two cameras that stand apart. Any view from the straight way between
them is right, so each patch of an overlap (and of a margin around it, where seams end) is looked up in
several true views along that way, by zero-mean normalised cross correlation within a search reach:

false   a textured patch that looks like none of them: a ghost, a smear, a broken thing.
break   two patches side by side that are both true, but not of the same picture: in every view where both
        are found, they lie at different displacements. A line that runs through both is broken by that many
        pixels. Displacements are sets (everything that correlates almost as well as the best), so a patch
        on a straight edge, which may slide along it, breaks nothing.
sharp   gradient energy of true patches that two layers or more cover, as a share of that of the layer they
        are most alike, at the same brightness: what is lost by sampling again and by averaging. On layers
        without noise: averaging noise away is no loss.

All of it happens on charts: pictures with the same scale everywhere (a band around the equator, and an
azimuthal view of each pole), given by the caller.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

Grey = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

TRUE_ENOUGH = (
    0.8  # correlation: a 1.5 px displacement between halves of a patch still passes, a ghost does not
)
NEARLY_BEST = 0.03  # displacements whose correlation is that near to the best are all possible
TEXTURE = 6.0  # standard deviation (grey levels of 255) below which a patch shows nothing to compare
BREAK = 4.0  # px at a canvas of 2048: a smooth change of viewpoint across an overlap reaches about 3


@dataclass(frozen=True)
class View:
    """What is seen from one point: (height, width) grey 0..255, and where it is known."""

    grey: Grey
    known: Mask


@dataclass(frozen=True)
class Chart:
    """A picture to judge: (height, width) grey 0..255, where it is opaque, where it counts, the truth, and
    the layers that it was made of (without them there is no `Score.sharpness`).
    """

    grey: Grey
    opaque: Mask
    judged: Mask
    views: Sequence[View]
    layers: Sequence[View] = ()


@dataclass
class Score:
    """Counts over all charts; properties turn them into the numbers of the table."""

    textured: int = 0
    wrong: int = 0
    neighbours: int = 0
    broken: int = 0
    energy: float = 0.0
    own_energy: float = 0.0
    breaks: list[tuple[float, int, float, float]] = field(default_factory=list)  # px, chart, x, y
    wrong_places: list[tuple[int, float, float]] = field(default_factory=list)  # chart, x, y

    @property
    def false_share(self) -> float:
        """Per cent of the textured patches that show no true view."""
        return 100.0 * self.wrong / max(1, self.textured)

    @property
    def broken_share(self) -> float:
        """Per cent of neighbouring pairs of true patches that break."""
        return 100.0 * self.broken / max(1, self.neighbours)

    @property
    def sharpness(self) -> float:
        """Gradient energy of the true patches of overlaps, 1.0 = that of the layers; NaN: there are none."""
        return self.energy / self.own_energy if self.own_energy else float("nan")

    def worst_break(self, places: int = 5, apart: float = 60.0) -> float:
        """Mean break in px at the worst places that are at least `apart` px from each other.

        A broken line shows in several pairs of the patches around it; a break that no pair within 25 px
        confirms is a mistaken match, so a place counts as much as its second worst pair.
        """
        left = np.array(self.breaks).reshape(-1, 4)
        left = left[np.argsort(-left[:, 0], kind="stable")]
        worst: list[float] = []
        while len(left) and len(worst) < places and left[0, 0] > 0:
            far = np.where(left[:, 1] == left[0, 1], np.hypot(*(left[:, 2:] - left[0, 2:]).T), np.inf)
            around = left[far <= 25, 0]
            if len(around) > 1 and around[1] >= 0.5 * around[0]:
                worst.append(float(around[1]))
                left = left[far >= apart]
            else:
                left = left[1:]
        return sum(worst) / places


@dataclass(frozen=True)
class _Match:
    """A patch found in one view: all displacements that are possible; its centre is no displacement."""

    possible: Mask


def score(charts: Sequence[Chart], patch: int = 20, reach: int = 24, break_px: float = BREAK) -> Score:
    """Judge the charts. `patch`: side in px (even); `reach`: largest displacement looked for, in px."""
    total = Score()
    for number, chart in enumerate(charts):
        _score_chart(total, number, chart, patch, reach, break_px)
    return total


def _score_chart(total: Score, number: int, chart: Chart, patch: int, reach: int, break_px: float) -> None:
    step = patch // 2
    height, width = chart.grey.shape
    slope, slopes = _slope_energy(chart.grey), [_slope_energy(layer.grey) for layer in chart.layers]
    found: dict[tuple[int, int], dict[int, _Match]] = {}
    for row, top in enumerate(range(reach, height - patch - reach, step)):
        for column, left in enumerate(range(reach, width - patch - reach, step)):
            here = (slice(top, top + patch), slice(left, left + patch))
            if not chart.judged[here].all():
                continue
            matches, textured = _look_up(chart, top, left, patch, reach)
            if not textured:
                continue
            total.textured += 1
            if not matches:
                total.wrong += 1
                total.wrong_places.append((number, left + patch / 2, top + patch / 2))
                continue
            found[row, column] = matches
            energies = _energies(chart, slope, slopes, top, left, patch, reach)
            total.energy += energies[0]
            total.own_energy += energies[1]
    for (row, column), matches in found.items():
        for other in ((row + 2, column), (row, column + 2)):  # patches overlap by half: these two touch
            if other not in found:
                continue
            jump = _jump(matches, found[other])
            if jump is None:
                continue
            total.neighbours += 1
            total.broken += jump > break_px
            x = reach + step * (column + other[1]) / 2 + patch / 2
            y = reach + step * (row + other[0]) / 2 + patch / 2
            total.breaks.append((jump, number, x, y))


def _look_up(chart: Chart, top: int, left: int, patch: int, reach: int) -> tuple[dict[int, _Match], bool]:
    """The views in which a patch is found, and whether there is texture to compare at all."""
    here = (slice(top, top + patch), slice(left, left + patch))
    around = (slice(top - reach, top + patch + reach), slice(left - reach, left + patch + reach))
    known = [index for index, view in enumerate(chart.views) if view.known[here].all()]
    if not any(chart.views[index].grey[here].std() >= TEXTURE for index in known):
        return {}, False
    mine = chart.grey[here]
    matches: dict[int, _Match] = {}
    if not chart.opaque[here].all() or mine.std() < 0.2 * TEXTURE:
        return matches, True
    for index in known:
        likeness = cv2.matchTemplate(chart.views[index].grey[around], mine, cv2.TM_CCOEFF_NORMED)
        best = float(likeness.max())
        if best < TRUE_ENOUGH:
            continue
        matches[index] = _Match(likeness >= max(best - NEARLY_BEST, TRUE_ENOUGH))
    return matches, True


def _energies(
    chart: Chart, slope: Grey, slopes: Sequence[Grey], top: int, left: int, patch: int, reach: int
) -> tuple[float, float]:
    """Gradient energy of a patch, and of the layer that it is most alike, made as bright; zeros where fewer
    than two layers are, or none is alike.
    """
    here = (slice(top, top + patch), slice(left, left + patch))
    around = (slice(top - reach, top + patch + reach), slice(left - reach, left + patch + reach))
    covering = [index for index, layer in enumerate(chart.layers) if layer.known[here].all()]
    if len(covering) < 2:
        return 0.0, 0.0
    found: list[tuple[float, float]] = []
    for index in covering:
        layer = chart.layers[index]
        likeness = cv2.matchTemplate(layer.grey[around], chart.grey[here], cv2.TM_CCOEFF_NORMED)
        dy, dx = np.unravel_index(int(likeness.argmax()), likeness.shape)
        y, x = top - reach + int(dy), left - reach + int(dx)
        there = (slice(y, y + patch), slice(x, x + patch))
        if not layer.known[there].all():
            continue
        brighter = float(chart.grey[here].mean()) / max(1.0, float(layer.grey[there].mean()))
        found.append((float(likeness.max()), float(slopes[index][there].sum()) * brighter**2))
    likeness_of_best, energy = max(found, default=(0.0, 0.0))
    return (float(slope[here].sum()), energy) if likeness_of_best >= TRUE_ENOUGH else (0.0, 0.0)


def _jump(one: dict[int, _Match], two: dict[int, _Match]) -> float | None:
    """Least difference of two patches' displacements in any view that shows both; None where none does."""
    jumps = []
    for index in one.keys() & two.keys():
        away = cv2.distanceTransform(
            (~one[index].possible).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE
        )
        jumps.append(float(away[two[index].possible].min()))
    return min(jumps, default=None)


def _slope_energy(grey: Grey) -> Grey:
    """Squared gradient per pixel."""
    down, right = np.gradient(grey)
    return np.asarray(down * down + right * right, np.float32)

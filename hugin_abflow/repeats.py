"""What repeats, such as the bars of a railing, is matched as a whole (on the host).

Bars look alike, so flow takes those that are before something far for others than those before the lawn at
its foot: both parts lead back, and bars are torn where they meet. If flow tears what goes on from a part to
the next one, that of either is carried on into the other and improved there; where the images are explained
as well by it, and less is torn, it is taken (fusion.py). Which of both depends on the rest: posts, what is
seen through bars, and how much would be torn beside.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import scipy

from hugin_abflow import flow, fusion
from hugin_abflow.cells import CELL, CONSISTENT, LEAST_CELLS, Mask, grown
from hugin_abflow.decision import Candidate
from hugin_abflow.flow import FlowParameters, Start
from hugin_abflow.fusion import Structure, Values
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.pyramid import Level

_Value = TypeVar("_Value", bound=np.generic)

# How often a part is carried on into another one, at most.
_TRIES = 6
# Level on which flow that is carried on is improved first: it leads there by a px or two, and bars are still
# seen.
_LEVEL = 1
# Cells: sigmas of means of flow that is carried on, of what is known and of what it becomes.
_MEAN, _SMOOTH = 2.0, 3.0
# Rounds in which a flow is inverted.
_ROUNDS = 8
# Cells beside those that take another flow in which flow is made smooth.
_BESIDE = 2


def mend(
    device: Device, images: Sequence[Level], flows: tuple[Buffer, Buffer], parameters: FlowParameters
) -> tuple[Buffer, Buffer]:
    """Flow from the first image to the second and back, with what repeats matched as a whole; `flows` where
    nothing is to be mended. Charts that wrap are left as they are.

    images: log brightness with masks. flows: float32 (height, width, 2) px.
    """
    height, width, _ = flows[0].shape
    if images[0].wraps or min(height, width) < 2 * CELL:
        return flows
    features = flow.finest_features(device, images, parameters)

    @cache
    def shown() -> Structure:
        return fusion.structure(features.get())

    def candidate(both: Values) -> Candidate:
        return Candidate(both, flow.misfit(device, features, device.upload(both), images[0].grid, parameters))

    def solved(level: int, there: Values, back: Values) -> Values:
        start = Start(level, (device.upload(there), device.upload(back)))
        solution = flow.solve(device, images[0], images[1], parameters, start)
        return np.stack([solution.forward.get(), solution.backward.get()])

    found = candidate(np.stack([one.get() for one in flows]))
    changed = np.zeros((2, height // CELL, width // CELL), bool)
    tried: set[tuple[int, int]] = set()
    for _ in range(_TRIES):
        carried = next((one for one in _carried(shown, found) if one.key not in tried), None)
        if carried is None:
            break
        tried.add(carried.key)
        there, back = carried.flows(found.flows)
        other = candidate(solved(_LEVEL, _coarser(there), _coarser(back)))
        taken = fusion.fused(shown(), found, other, carried.may)
        if taken.any():
            changed |= taken
            found = candidate(_where(taken, other.flows, found.flows))
    if not changed.any():
        return flows
    beside = np.stack([grown(one, _BESIDE, False) for one in changed])
    forward, backward = _where(beside, solved(0, *found.flows), found.flows)
    return device.upload(forward), device.upload(backward)


def _where(cells: Mask, those: Values, else_these: Values) -> Values:
    """Flows both ways, (2, height, width, 2), of one kind in cells, else of the other."""
    height, width = those.shape[1:3]
    pixels = np.stack([fusion.pixels_of(one, height, width) for one in cells])
    return np.where(pixels[..., None], those, else_these)


def _coarser(one: Values) -> Values:
    """A flow on the next coarser level, (ceil(height / 2), ceil(width / 2), 2), px of that."""
    for axis in (0, 1):
        if one.shape[axis] % 2:
            one = np.concatenate([one, one.take([-1], axis)], axis)
    height, width = one.shape[0] // 2, one.shape[1] // 2
    return np.ascontiguousarray(one.reshape(height, 2, width, 2, 2).mean((1, 3)) / 2)


@dataclass(frozen=True)
class _Carried:
    """The flow of a part of the first image, carried on.

    key     tells it from others of the same flow.
    flow    (rows, columns, 2) px, by cells.
    into    the cells of the part that it is carried into, (rows, columns).
    whole   those of both parts.
    """

    key: tuple[int, int]
    flow: Values
    into: Mask
    whole: Mask

    @property
    def may(self) -> Mask:
        """The cells of both images that may have it, (2, rows, columns)."""
        return np.stack([self.whole, self.whole[_leads_to(self._back())]])

    def flows(self, present: Values) -> Values:
        """Flows both ways, (2, height, width, 2): `present`, but for this where it is carried into."""
        height, width = present.shape[1:3]
        back = self._back()
        into = np.stack([self.into, self.into[_leads_to(back)]])
        both = np.stack([_pixels(one, height, width) for one in (self.flow, back)])
        return _where(into, both, present)

    def _back(self) -> Values:
        """The inverse of the flow, by cells of the second image."""
        back = -self.flow
        for _ in range(_ROUNDS):
            back = -self.flow[_leads_to(back)]
        return back


def _leads_to(flows: Values) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Rows and columns of the cells to which flow of cells leads, or of the nearest ones of the chart."""
    rows, columns = np.indices(flows.shape[:2])
    row, column = (
        np.clip(np.rint(flows[..., k] / CELL + at).astype(np.intp), 0, flows.shape[1 - k] - 1)
        for k, at in ((1, rows), (0, columns))
    )
    return row, column


def _pixels(cells: Values, height: int, width: int) -> Values:
    """Flow by cells at all pixels, (height, width, 2): linear between their centres."""
    weights = []
    for side, count in ((height, cells.shape[0]), (width, cells.shape[1])):
        place = np.clip((np.arange(side) - CELL // 2) / CELL, 0, count - 1)
        first = np.minimum(place.astype(int), count - 2)
        rows = np.zeros((side, count), np.float32)
        rows[np.arange(side), first], rows[np.arange(side), first + 1] = 1 - (place - first), place - first
        weights.append(rows)
    return np.stack([weights[0] @ cells[..., k] @ weights[1].T for k in (0, 1)], -1)


def _carried(shown: Callable[[], Structure], found: Candidate) -> Iterator[_Carried]:
    """The flow of parts of the first image, carried on into those torn from them, the most torn first."""
    flows, trusted, part = _parts(found)
    if np.unique(part[trusted]).size < 2:  # as in most pairs: nothing else needs to be known of them
        return
    nearest = scipy.ndimage.distance_transform_edt(~trusted, return_distances=False, return_indices=True)
    flows, part = flows[tuple(nearest)], part[tuple(nearest)]
    torn: dict[tuple[int, int], float] = {}
    for crossing, axis in ((shown().down[0], 0), (shown().right[0], 1)):
        one, other = _beside(part, axis)
        apart = one != other
        lost = (crossing * fusion.jump(*_beside(flows, axis)))[apart]
        for i, j, much in zip(one[apart].tolist(), other[apart].tolist(), lost.tolist(), strict=True):
            torn[min(i, j), max(i, j)] = torn.get((min(i, j), max(i, j)), 0.0) + much
    for (i, j), much in sorted(torn.items(), key=lambda one: (-one[1], one[0])):
        if much < fusion.WORTH:
            return
        for of, into in ((i, j), (j, i)):
            whole = (part == i) | (part == j)
            yield _Carried((of, into), _extended(flows, trusted & (part == of)), part == into, whole)


def _parts(found: Candidate) -> tuple[Values, Mask, npt.NDArray[np.intp]]:
    """Flow of the first image by cells, which of them lead back, in parts that are large enough, and the
    number of its first cell for each: parts within which flow does not jump.
    """
    forward = fusion.by_cells(found)
    height, width = forward.misfit.shape[1:]
    rows, columns = np.indices((height, width)) * CELL + CELL // 2
    flows = forward.flows[0]
    there = (
        np.clip(np.rint(rows + flows[..., 1]).astype(int), 0, found.flows.shape[1] - 1),
        np.clip(np.rint(columns + flows[..., 0]).astype(int), 0, found.flows.shape[2] - 1),
    )
    gap = np.linalg.norm(flows + found.flows[1][there], axis=-1)
    trusted = (gap < CONSISTENT) & (forward.misfit[0] >= 0)
    number = np.arange(height * width).reshape(height, width)
    links: list[npt.NDArray[np.intp]] = []
    for axis in (0, 1):
        near = np.logical_and(*_beside(trusted, axis)) & (fusion.jump(*_beside(flows, axis)) == 0)
        links.append(np.stack(_beside(number, axis))[:, near])
    pairs = np.concatenate(links, 1)
    graph = scipy.sparse.coo_array((np.ones(pairs.shape[1]), tuple(pairs)), shape=(number.size, number.size))
    _, part = scipy.sparse.csgraph.connected_components(graph, directed=False)
    _, first_cell, part = np.unique(part, return_index=True, return_inverse=True)
    part = part.reshape(height, width)
    trusted &= np.bincount(part[trusted], minlength=first_cell.size)[part] >= LEAST_CELLS
    return flows, trusted, first_cell[part]


def _beside(values: npt.NDArray[_Value], axis: int) -> tuple[npt.NDArray[_Value], npt.NDArray[_Value]]:
    """What cells have that have a next one along an axis, and what those have."""
    return (values[:-1], values[1:]) if axis == 0 else (values[:, :-1], values[:, 1:])


def _extended(flows: Values, own: Mask) -> Values:
    """Flow of cells carried on to all of them, smooth."""

    def mean(values: npt.NDArray[np.floating], sigma: float) -> npt.NDArray[np.floating]:
        return np.asarray(scipy.ndimage.gaussian_filter(values, (sigma, sigma, 0), mode="nearest"))

    weight = own[..., None].astype(np.float32)
    smooth = mean(flows * weight, _MEAN) / np.maximum(mean(weight, _MEAN), 1e-6)
    nearest = scipy.ndimage.distance_transform_edt(~own, return_distances=False, return_indices=True)
    return mean(smooth[tuple(nearest)], _SMOOTH).astype(np.float32)

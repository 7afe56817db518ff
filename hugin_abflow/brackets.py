"""Photos of one view in several exposures, of which an ordinary panorama shows one."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Hashable, Sequence

from hugin_abflow import pto
from hugin_abflow.layer import Layer
from hugin_abflow.pano_trafo import images_of
from hugin_abflow.project import Plan

_log = logging.getLogger(__name__)

# What photos of one view have in common, besides their size: their layers cover the same.
_VIEW = ("y", "p", "r", "TrX", "TrY", "TrZ", "Tpy", "Tpp", "v", "a", "b", "c", "d", "e", "g", "t")
# Stops from which on two exposures differ: Hugin's own for layers of one exposure.
_APART = 0.5


def of_one_exposure(plan: Plan, layers: Sequence[Layer]) -> list[Layer]:
    """The layers without those that show a view in another exposure than the one nearest to the panorama's.

    Brought to its exposure, the others have nothing to show beside that one but noise, or what they clip.
    All are kept of HDR, where the project does not tell whose layers they are, and where masks differ. Raises
    `pto.PtoError` as `pto.load` does.
    """
    project, images = pto.load(plan.file), images_of(plan, layers)
    views = defaultdict[Hashable, dict[int, float]](dict)
    for index in images:
        if index is None or plan.hdr:
            return list(layers)
        image = project.images[index]
        views[_view(image)][index] = image.variable("Eev") - project.panorama.exposure
    kept = set[int]()
    for off in views.values():
        # of two as near the one with less light, which clips less
        nearest = min(off.values(), key=lambda stops: (round(abs(stops), 3), -stops))
        kept |= {index for index, stops in off.items() if abs(stops - nearest) < _APART}
    for index, layer in zip(images, layers, strict=True):
        if index not in kept:
            _log.info("%s shows a view in another exposure; it is left out", layer.name)
    return [layer for index, layer in zip(images, layers, strict=True) if index in kept]


def _view(image: pto.Image) -> Hashable:
    """What images have in common whose layers cover the same."""
    masks = tuple(sorted((mask.type, tuple(mask.points)) for mask in image.masks))
    frame = image.width, image.height, image.projection, image.crop
    return *frame, masks, *(image.variable(name) for name in _VIEW)

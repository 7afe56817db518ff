"""Photos of one view in several exposures, of which an ordinary panorama shows one."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Hashable, Iterable, Mapping, Sequence

import numpy as np

from hugin_abflow import pto
from hugin_abflow.layer import Layer, full_scale
from hugin_abflow.pano_trafo import images_of
from hugin_abflow.project import Plan, PlannedImage

_log = logging.getLogger(__name__)

# What photos of one view have in common, besides their size.
_VIEW = ("y", "p", "r", "TrX", "TrY", "TrZ", "Tpy", "Tpp", "v", "a", "b", "c", "d", "e", "g", "t")
# Stops from which on two exposures differ: Hugin's default for layers of one exposure.
EXPOSURE_DIFFERENCE = 0.5
# Endings of photos that have no alpha.
_OPAQUE = (".jpg", ".jpeg")
# Rows of layers that are looked at together.
_ROWS = 64


def to_be_made(plan: Plan) -> tuple[PlannedImage, ...]:
    """The images without those whose layers `of_one_exposure` would leave out whatever they show.

    Masks, and photos that may be transparent, tell only in layers what they hide: then it is all images, and
    in scripts by other programs. Raises `pto.PtoError` as `pto.load` does.
    """
    project = pto.load(plan.file)
    images = [project.images[image.index] for image in plan.images]
    opaque = all(image.photo.suffix.lower() in _OPAQUE for image in plan.images)
    masked = project.masks or project.doubts  # what could not be read may be a mask to nona
    if plan.hdr or masked or not opaque or any(image.hugin is None for image in images):
        return plan.images
    shown = set().union(*map(_nearest, _views(images, project.panorama.exposure)))
    for image in plan.images:
        if image.index not in shown:
            _log.info("%s shows a view in another exposure; no layer of it is needed", image.name)
    return tuple(image for image in plan.images if image.index in shown)


def of_one_exposure(plan: Plan, layers: Sequence[Layer]) -> list[Layer]:
    """The layers without those that show a view in another exposure than the one nearest to the panorama's.

    Brought to its exposure, the others have nothing to show beside that one but noise, or what they clip.
    What shows a pixel that it does not is kept, and all of HDR, and all where the project does not tell whose
    layers they are. Raises `pto.PtoError` as `pto.load` does, `ImageReadError` as the layers' readers do.
    """
    images = images_of(plan, layers)
    numbers = [number for number in images if number is not None]
    if plan.hdr or len(numbers) < len(layers):
        return list(layers)
    layer_of = {number: k for k, number in enumerate(numbers)}
    kept = set[int]()
    project = pto.load(plan.file)
    for off in _views([project.images[number] for number in numbers], project.panorama.exposure):
        nearest = [layer_of[number] for number in _nearest(off)]
        others = {layer_of[number] for number in off}.difference(nearest)
        kept |= {*nearest, *(k for k in others if not _covered(layers[k], [layers[j] for j in nearest]))}
    for k, layer in enumerate(layers):
        if k not in kept:
            _log.info("%s shows a view in another exposure; it is left out", layer.called)
    return [layers[k] for k in sorted(kept)]


def _views(images: Iterable[pto.Image], exposure: float) -> list[dict[int, float]]:
    """Of each view its images, by number, and their stops from the panorama's exposure."""
    views = defaultdict[Hashable, dict[int, float]](dict)
    for image in images:
        views[_view(image)][image.index] = image.variable("Eev") - exposure
    return list(views.values())


def _nearest(off: Mapping[int, float]) -> list[int]:
    """A view's images of the exposure that is nearest to the panorama's. off: the images' stops from that."""
    nearest = min(off.values(), key=abs)
    if abs(nearest) >= EXPOSURE_DIFFERENCE:
        # of two about as near that with less light, which clips less: of all views the same one
        nearest = max(stops for stops in off.values() if abs(stops) <= abs(nearest) + EXPOSURE_DIFFERENCE)
    return [number for number, stops in off.items() if abs(stops - nearest) < EXPOSURE_DIFFERENCE]


def _covered(layer: Layer, others: Sequence[Layer]) -> bool:
    """Whether some of the others show every pixel that a layer shows."""
    others = [other for other in others if other.box == layer.box]
    step = max(layer.strip, _ROWS)
    for top in range(0, layer.box.height if others else 0, step):
        bottom = min(top + step, layer.box.height)
        shown, *theirs = (
            one.rows(top, bottom)[..., -1] >= full_scale(one.dtype) / 2 for one in (layer, *others)
        )
        if (shown & ~np.logical_or.reduce(theirs)).any():
            return False
    return bool(others)


def _view(image: pto.Image) -> Hashable:
    """What images have in common that look at the same."""
    frame = image.width, image.height, image.projection, image.crop
    return *frame, *(image.variable(name) for name in _VIEW)

"""The layers of a project: those that are there, those that nona makes, or both."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import get_args

from hugin_abflow.errors import ImageReadError, LayersMismatchError, SettingsError
from hugin_abflow.found import Found, Remap, find, layers_by_prefix, named_files, none_there
from hugin_abflow.images import read_layers
from hugin_abflow.layer import Layer, check_layers
from hugin_abflow.nona import can_make, made_in, make_all, make_missing
from hugin_abflow.progress import Progress, silent
from hugin_abflow.project import Plan, PlannedImage
from hugin_abflow.scratch import work_folder
from hugin_abflow.tifftags import is_edited

_log = logging.getLogger(__name__)


@contextmanager
def open_layers(
    plan: Plan,
    *,
    prefix: str | Path | None = None,
    layers: Sequence[str | Path] | None = None,
    remap: Remap = "auto",
    keep_layers: bool = False,
    images: Sequence[PlannedImage] | None = None,
    progress: Progress = silent,
) -> Iterator[list[Layer]]:
    """The project's layers in the order of its images, readable inside the ``with`` block.

    layers          files that are the layers, whatever their names; taken as they are.
    prefix          layers named PREFIX0000.tif ..., as given or relative to the project's folder; taken
                    as they are. Without both, the project's stem and Hugin's default prefix are tried.
    remap           "never": only what is there. "always": nona makes all layers. "auto": nona makes all
                    that are missing, and all if one cannot be read, has no alpha, is of another canvas, or is
                    more than 2 s older than the project or its photo, and they can be made again (else
                    old ones are used, with a warning).
    keep_layers     layers that nona made are moved beside the project, named as Hugin does.
    images          those of the project's of which layers are made; None, and where layers are kept: all.

    Layers are made in a folder under TMPDIR that is removed in the end. Raises `LayersMissingError`,
    `PhotoMissingError`, `NonaMissingError`, `NonaFailedError`, `LayersMismatchError`, `ImageReadError`,
    `ProjectError` (a photo has another size), `OutputError` (layers cannot be kept), `SettingsError`
    (`remap` unknown, or "always" together with named layers).
    """
    named = bool(prefix or layers)
    _check_request(remap, named)
    with work_folder() as folder:
        if layers:
            files = named_files(layers)
        elif prefix:
            files = layers_by_prefix(plan, prefix).in_order()
        else:
            needed = plan if images is None or keep_layers else replace(plan, images=tuple(images))
            files = _find_or_make(plan, needed, folder, remap, keep_layers, progress).in_order()
        found = [str(file) for file in files if file.parent != folder]
        opened = [layer for file in files for layer in read_layers(file)]
        names = {image.index: image.name for image in plan.images}
        photos = {str(file): names[index] for index, file in made_in(plan, folder).items()}
        # what was made will go: messages name the photo
        opened = [replace(one, photo=photos.get(str(one.file))) for one in opened]
        called = [one.photo or str(one.file) for one in opened]
        try:
            check_layers(plan.canvas, opened, called)
        except LayersMismatchError as error:
            if not found or not can_make(plan):
                raise
            without = ", without --prefix and --layers," if named else ""
            raise LayersMismatchError(f"{error} (--remap always{without} makes all of them)") from None
        try:
            yield opened
        except ImageReadError as error:  # files are opened before, but not decoded
            if named or not any(file in str(error) for file in found) or not can_make(plan):
                raise
            raise ImageReadError(f"{error} (--remap always makes all of them)") from None


def _check_request(remap: str, named: bool) -> None:
    if remap not in get_args(Remap):
        raise SettingsError(f"remap is {remap!r}; choose 'auto', 'always' or 'never'")
    if named and remap == "always":
        raise SettingsError(
            "layers are named and shall be made; leave out --prefix and --layers, or --remap always"
        )


def _find_or_make(
    plan: Plan, needed: Plan, folder: Path, remap: Remap, keep: bool, progress: Progress
) -> Found:
    """Layers that nobody named: what is there, what nona makes of the images of `needed`, or both."""
    found, missing = planned_layers(plan, remap)
    if found is None:
        return make_all(needed, folder, keep, progress)
    missing = [image for image in missing if image in needed.images]
    if not missing:
        return found
    made = make_missing(plan, missing, folder, found.prefix, keep, progress)
    return Found(found.prefix, found.files | made, found.pages)


def planned_layers(plan: Plan, remap: Remap) -> tuple[Found | None, Sequence[PlannedImage]]:
    """What `open_layers` takes where nobody names layers, and the images of which nona makes layers first;
    None and all images where it makes all anew. Says why.

    Raises `LayersMissingError` where nothing is there and nothing may be made.
    """
    found = None if remap == "always" else find(plan)
    if remap == "never":
        if found is None:
            raise none_there(plan)
        _report_used(plan, found)
        return found, []
    if found is None:
        return None, plan.images
    unusable, stale = found.unusable(plan), found.stale(plan)
    if (unusable or stale) and can_make(plan):
        if unusable:
            _log.warning("%s: all layers are made again", unusable)
        elif edited := [file for file in found.in_order() if is_edited(file)]:
            _log.warning(
                "%s was changed by another program, but %s is older than the project or its photo: layers "
                "are made again (--remap never takes them as they are)", edited[0], stale[0],
            )  # fmt: skip
        else:
            _log.info("%s is older than the project or its photo: layers are made again", stale[0])
        return None, plan.images
    if stale and not found.broken:
        reason = "nona is not installed" if shutil.which("nona") is None else "photos are missing"
        _log.warning("%s is older than the project or its photo; used as it is, since %s", stale[0], reason)
    return found, found.missing(plan)


def _report_used(plan: Plan, found: Found) -> None:
    """Warn of what --remap never leaves as it is."""
    for image in found.missing(plan):
        _log.warning("no layer of image %d (%s): it is left out", image.index, image.name)
    for file in found.stale(plan)[:1]:
        _log.warning("%s is older than the project or its photo; used as it is (--remap never)", file)

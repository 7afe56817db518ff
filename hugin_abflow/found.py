"""Layers that are there already: what they are called, whether they are all there, fresh and whole."""

from __future__ import annotations

import itertools
import logging
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

from hugin_abflow import tifftags
from hugin_abflow.errors import ImageReadError, LayersMissingError
from hugin_abflow.images import read_layers
from hugin_abflow.layer import Layer, misfit
from hugin_abflow.project import Plan, PlannedImage, file_key
from hugin_abflow.scratch import is_file

_log = logging.getLogger(__name__)

Remap = Literal["auto", "always", "never"]

_ENDINGS = (".tif", ".tiff", ".exr")  # of layers
_STALE_SECONDS = 2.0  # file times closer than this say nothing (FAT counts in steps of 2 s)


@dataclass(frozen=True)
class Found:
    """Layers on disk: one file per image index, or one file of many pages (then `files` is empty).

    The prefix is what comes before the numbers, folder included; it may end in a slash.
    """

    prefix: str
    files: dict[int, Path]
    pages: Path | None = None

    def missing(self, plan: Plan) -> list[PlannedImage]:
        """Active images without a layer; of a file of pages nobody can tell."""
        return [] if self.pages else [image for image in plan.images if image.index not in self.files]

    def stale(self, plan: Plan) -> list[Path]:
        """Layers older than the project or their photo."""
        project = _time(plan.file)
        photos = {image.index: _time(image.photo) for image in plan.images}
        newest = {file: max(project, photos[index]) for index, file in self.files.items()}
        if self.pages:
            newest[self.pages] = max(project, *photos.values())
        return [file for file, time in newest.items() if _time(file) < time - _STALE_SECONDS]

    @cached_property
    def _opened(self) -> dict[Path, list[Layer]]:
        """The layers by their files, up to the first that is no image, or not one that a layer can be: it has
        none. Pixels are not looked at.
        """
        opened: dict[Path, list[Layer]] = {}
        for file in self.in_order():
            try:
                opened[file] = read_layers(file)
            except ImageReadError:
                return opened | {file: []}
        return opened

    @property
    def broken(self) -> bool:
        """Whether one is no image, or not one that a layer can be."""
        return not all(self._opened.values())

    def unusable(self, plan: Plan) -> str | None:
        """The first that cannot be a layer of the project, and why, in words; None if all can be."""
        for file, layers in self._opened.items():
            if not layers:
                return f"{file} cannot be read"
            if why := next(filter(None, (misfit(layer, plan.canvas) for layer in layers)), None):
                return f"{file} {why}"
        return None

    def in_order(self) -> list[Path]:
        """The files by image index."""
        return [self.pages] if self.pages else [self.files[index] for index in sorted(self.files)]


def layer_name(prefix: str, index: int, ending: str) -> str:
    """What nona calls the layer of image `index`; numbers of unused images are left out."""
    return f"{prefix}{index:04d}{ending}"


def layer_path(prefix: str, index: int, ending: str) -> Path:
    """The file of that name."""
    return Path(layer_name(prefix, index, ending)).absolute()


def _find_under(plan: Plan, prefix: str) -> Found | None:
    """Layers that begin with `prefix`, if any."""
    endings = (".exr", ".tif", ".tiff") if plan.hdr else _ENDINGS
    photos = {file_key(photo) for photo in plan.photos}  # may be named alike: img0000.tif of img.pto
    for ending in endings:
        paths = {image.index: layer_path(prefix, image.index, ending) for image in plan.images}
        there = {index: path for index, path in paths.items() if is_file(path)}
        files = {
            index: path
            for index, path in there.items()
            if file_key(path) not in photos and not is_another_projects(plan, path)
        }
        if files:
            return Found(prefix, files)
    for ending in (".tif", ".tiff"):
        pages = Path(prefix + ending).absolute()
        if file_key(pages) not in photos and _is_multilayer(pages):
            return Found(prefix, {}, pages)
    return None


def is_another_projects(plan: Plan, file: Path) -> bool:
    """Whether a project of the file's name lies beside it, and is not the plan's: then the file is that one's
    panorama, or its layer, though it is called as one of this project: pano0000.tif. A link to a project is
    one of its own, with a panorama of its own.
    """
    own = plan.file.parent.resolve() / plan.file.name
    for project in (file.with_suffix(ending) for ending in (".pto", ".PTO")):
        named = project.parent.resolve() / project.name
        if not is_file(named) or named == own:
            continue
        # where case is ignored both names may be the plan's
        if own.is_symlink() or named.is_symlink() or not named.samefile(own):
            return True
    return False


def _is_multilayer(path: Path) -> bool:
    """Whether a file is nona's TIFF_multilayer: a finished panorama may have the same name."""
    try:
        return is_file(path) and any(place.paged for place in tifftags.read_places(path))
    except ImageReadError:
        return False


def candidates(plan: Plan) -> list[Found]:
    """Layers under the project's stem and under Hugin's default prefix, in this order."""
    taken = is_another_projects(plan, plan.folder / f"{plan.hugin_prefix}.tif")
    stems = [plan.stem] if taken else [plan.stem, plan.hugin_prefix]
    names = [plan.layer_prefix(name) for name in stems]
    names += stems if plan.hdr else []
    found = [layers for name in names if (layers := _find_under(plan, str(plan.folder / name)))]
    if plan.hdr:  # what is linear; layers of the other panorama may lie there too
        found = [layers for layers in found if all(path.suffix == ".exr" for path in layers.in_order())]
    return found


def find(plan: Plan) -> Found | None:
    """The best of the candidates: usable, complete and fresh ones first."""
    found = candidates(plan)
    if len(found) < 2:  # then it need not be looked into
        return found[0] if found else None
    return min(found, key=lambda f: (bool(f.unusable(plan)), bool(f.missing(plan)), bool(f.stale(plan))))


def layers_there(
    plan: Plan, prefix: str | Path | None, layers: Sequence[str | Path] | None, remap: Remap
) -> list[Path]:
    """The files that `open_layers` would find with these arguments; they may be stale, or not be there."""
    if layers:
        return [Path(path) for path in layers]
    if prefix:
        under = (_find_under(plan, place) for place in _places(plan, os.fspath(prefix)))
        found = next((layers for layers in under if layers), None)
    else:
        found = None if remap == "always" else find(plan)
    return found.in_order() if found else []


def layers_by_prefix(plan: Plan, prefix: str | Path) -> Found:
    """Layers that the user named by their prefix. Raises `LayersMissingError`."""
    prefix = os.fspath(prefix)
    for place in _places(plan, prefix):
        found = _find_under(plan, place)
        if found:
            for image in found.missing(plan):
                # nona makes none for a photo that misses the crop, but one that was lost leaves a hole
                _log.warning(
                    "no layer of image %d (%s) under %s: it is left out", image.index, image.name, prefix
                )
            return found
    _refuse_others(plan, prefix)
    first = layer_name(prefix, plan.images[0].index, ".tif")
    raise LayersMissingError(
        f"no layer {first} (nor .exr, nor of another active image) here or in {plan.folder}; "
        f"{_better_prefix(plan, prefix)}"
    )


def _refuse_others(plan: Plan, prefix: str) -> None:
    """Raise `LayersMissingError` where files of such names are there after all: then they are no layers."""
    names = itertools.product(_places(plan, prefix), (image.index for image in plan.images), _ENDINGS)
    if file := next(filter(is_file, itertools.starmap(layer_path, names)), None):
        another = is_another_projects(plan, file)
        why = f"is named after {file.stem}.pto, another project" if another else "is a photo of the project"
        raise LayersMissingError(
            f"{file} {why}, and no layer; check --prefix, or leave it out to have nona make the layers"
        )


def _places(plan: Plan, name: str) -> tuple[str, str]:
    """Where a name may lie. Joined as text: pathlib drops a slash at the end."""
    return name, os.path.join(plan.folder, name)  # noqa: PTH118


def _better_prefix(plan: Plan, prefix: str) -> str:
    """What to do about a prefix that no layer has: it may be the name of one."""
    for pattern in (r"\d{4}(\.\w+)?$", r"\.\w+$"):
        shorter = re.sub(pattern, "", prefix)
        if shorter not in ("", prefix) and any(_find_under(plan, p) for p in _places(plan, shorter)):
            return f"the prefix is what comes before the numbers: --prefix {shorter}"
    if any(is_file(Path(place)) for place in _places(plan, prefix)):
        return f"{prefix} is a file: name all layers with --layers"
    return "check --prefix, or leave it out to have nona make the layers"


def named_files(layers: Sequence[str | Path]) -> list[Path]:
    """Layers that the user named; raises `LayersMissingError` if one is not there."""
    for path in map(Path, layers):
        if not is_file(path):
            raise LayersMissingError(f"{path}: no such layer; check --layers")
    return [Path(path) for path in layers]


def none_there(plan: Plan) -> LayersMissingError:
    """What to raise where layers are neither there nor to be made."""
    return LayersMissingError(
        f"no layers {plan.stem}0000.tif ... or {plan.hugin_prefix}0000.tif ... beside {plan.file}; "
        "name them with --prefix or --layers, or let nona make them (--remap auto)"
    )


def _time(path: Path) -> float:
    """Time of the last change; 0 for what is not there, which makes nothing stale."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0

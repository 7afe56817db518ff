"""Hugin's remapper, nona: run to make layers of a project's images."""

from __future__ import annotations

import logging
import os
import re
import shutil
import subprocess
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from hugin_abflow import programs, pto
from hugin_abflow.errors import (
    ImageReadError,
    LayersMissingError,
    NonaFailedError,
    NonaMissingError,
    OutputError,
    PhotoMissingError,
    ProgramFailedError,
    ProgramMissingError,
)
from hugin_abflow.failures import check_made, failure, loss
from hugin_abflow.found import (
    Found,
    is_another_projects,
    layer_path,
)
from hugin_abflow.images import read_layers
from hugin_abflow.jpeg import is_cut
from hugin_abflow.programs import LAST_LINES, move_whole, started
from hugin_abflow.progress import Progress
from hugin_abflow.project import Plan, PlannedImage, file_key
from hugin_abflow.scratch import is_file, is_special
from hugin_abflow.targets import named_in_unicode
from hugin_abflow.tifftags import is_edited

_log = logging.getLogger(__name__)

# Bytes of a project's name with which those of its layers begin while they are made: file systems take 255,
# and numbers and endings follow.
_LONGEST_NAME = 200

_NAMED = 5  # photos that a warning names

# What to do where nona cannot make layers, beside mending that.
_OTHERWISE = "or name layers that exist with --prefix or --layers"

# What nona -v says of each photo: before it loads it; after that, and after it has remapped it.
_LOADING, _STEPS = "loading ", ("remapping ", "saving ")
# What libjpeg says of a photo that may lack pixels. nona remaps what there is, and that may be all: some
# cameras leave out nothing but the mark of the end. So we warn of these, and go on.
_CUT = "Premature end of JPEG file"
_DOUBTS = (_CUT, "Corrupt JPEG data")


def probe() -> str | None:
    """nona's version ("2022.0.0.a0962865f932"), None where it is not installed."""
    try:
        shown = subprocess.run(
            ["nona", "--help"], capture_output=True, text=True, errors="replace", timeout=30, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    version = re.search(r"nona version (\S+)", shown.stdout + shown.stderr)
    return version.group(1) if version else "unknown"


def can_make(plan: Plan) -> bool:
    """Whether nona is installed and all photos of a project are there."""
    return shutil.which("nona") is not None and all(is_file(image.photo) for image in plan.images)


def make_all(plan: Plan, folder: Path, keep: bool, progress: Progress) -> Found:
    """Have nona make every layer of a plan in `folder`. keep: move them beside the project then.

    Raises what `refuse_to_make` and a run of nona raise, `LayersMissingError` where it makes none.
    """
    prefix = str(plan.folder / plan.layer_prefix(plan.stem))
    refuse_to_make(plan, plan.images, prefix if keep else None, anew=True)
    with progress("remap", len(_STEPS) * len(plan.images)) as advance:
        ended = _run(plan, _project_for_nona(plan, folder), plan.images, folder, [], advance)
    made = made_in(plan, folder)
    if ended.code:
        raise failure(plan, plan.images, folder, ended.code, ended.lines)
    if not made:
        raise LayersMissingError(
            f"{plan.file}: nona made no layer: it sees no active image that shows anything in the crop; "
            "look at crop and masks in Hugin (of a crop far smaller than the photos it sees none), and "
            "whether the photos are RGB or grey"
        )
    check_made(plan, made)
    _tell_of_none(plan.images, made, ended.loaded)
    return Found(prefix, _keep(prefix, made) if keep else made)


def make_missing(
    plan: Plan, missing: Sequence[PlannedImage], folder: Path, prefix: str, keep: bool, progress: Progress
) -> dict[int, Path]:
    """Have nona make the layers of some images, as `make_all` does; images that miss the crop have none.

    prefix      of those that are there: the names of layers that are kept begin with it, too.
    """
    refuse_to_make(plan, missing, prefix if keep else None, anew=False)
    project, loaded = _project_for_nona(plan, folder), list[Path]()
    with progress("remap", len(_STEPS) * len(missing)) as advance:
        for image in missing:
            ended = _run(plan, project, [image], folder, ["-i", str(image.index)], advance)
            loaded += ended.loaded
            # nona does not count an image outside the crop as one of the project's
            if ended.code and f"image with number {image.index}" not in " ".join(ended.lines):
                _require_photo(plan, image)
                raise failure(plan, [image], folder, ended.code, ended.lines)
    made = made_in(plan, folder)
    check_made(plan, made)
    _tell_of_none(missing, made, loaded)
    return _keep(prefix, made) if keep else made


def _tell_of_none(images: Sequence[PlannedImage], made: Collection[int], loaded: Iterable[Path]) -> None:
    """Tell of images of which a run of nona that succeeded made no layer: such as it loaded, which does not
    happen outside the crop, will be missed.
    """
    loads = Counter(loaded)
    loads.subtract(image.photo for image in images if image.index in made)
    none = [image for image in images if image.index not in made]
    for image in none:
        if loads[image.photo] <= 0:
            _log.info("image %d (%s) misses the crop: it has no layer", image.index, image.name)
    if lost := [image for image in none if loads[image.photo] > 0]:
        names = ", ".join(image.name for image in lost[:_NAMED])
        more = f" and {len(lost) - _NAMED} more" if len(lost) > _NAMED else ""
        _log.warning("nona made no layer of %s%s: left out; look at their masks in Hugin", names, more)


def _require_photo(plan: Plan, image: PlannedImage) -> None:
    if not image.name:
        raise PhotoMissingError(
            f"image {image.index} of {plan.file} names no photo (its i-line has no n), and its layer must be "
            "made from it; the project may be damaged: save it anew in Hugin"
        )
    if not is_file(image.photo):
        raise PhotoMissingError(
            f"{image.photo} (image {image.index}) is not there, or its folder is closed to you, and its "
            f"layer must be made from it; put it back, {_OTHERWISE}"
        )


class _Ended(NamedTuple):
    """How nona ended: its exit code, its last lines, and the photos that it had loaded, each as often as it
    had.
    """

    code: int
    lines: list[str]
    loaded: list[Path]


def _run(
    plan: Plan,
    project: Path,
    images: Sequence[PlannedImage],
    folder: Path,
    options: list[str],
    advance: Callable[[int], None],
) -> _Ended:
    """Run nona as Hugin does. It does not outlive an exception.

    Raises `ImageReadError` for a photo of which pixels are missing, `NonaMissingError`, `NonaFailedError`.
    """
    command = remapping(plan, options, _prefix(plan, folder), str(project))
    lines: deque[str] = deque(maxlen=LAST_LINES)
    loaded, doubts = list[Path](), set[str]()
    try:
        with started(command, stdin=subprocess.DEVNULL, stderr=subprocess.STDOUT) as process:
            assert process.stdout is not None
            for line in process.stdout:
                if line.strip():
                    lines.append(line.strip())
                    _log.debug("nona: %s", line.strip())
                if line.startswith(_STEPS):
                    advance(1)
                elif line.startswith(_LOADING):
                    loaded.append(plan.folder / line.removeprefix(_LOADING).strip())
                elif lost := loss(loaded[-1] if loaded else plan.file, line):
                    raise lost
                elif any(mark in line for mark in _DOUBTS):
                    doubts.add(line.strip())
    except ProgramMissingError as error:  # it is there, but not its interpreter
        raise NonaMissingError(f"{error}; {_OTHERWISE}") from None
    except ProgramFailedError as error:
        raise NonaFailedError(str(error)) from None
    for doubt in sorted(doubts):
        # libjpeg names no file, and its lines need not be in order with nona's
        cut = [str(image.photo) for image in images if doubt.startswith(_CUT) and is_cut(image.photo)]
        _log.warning(
            "%s may be damaged (%s); look at the panorama", ", ".join(cut) or "one of the photos", doubt
        )
    return _Ended(process.returncode, list(lines), loaded)


def remapping(plan: Plan, options: Sequence[str], prefix: str, project: str) -> list[str]:
    """The command that makes the layers `prefix`0000.tif ..., or .exr; the same as Hugin's."""
    output = ["-r", "hdr", "-m", "EXR_m"] if plan.hdr else ["-r", "ldr", "-m", "TIFF_m"]
    output += ["--ignore-exposure"] if plan.ignore_exposure else []
    return ["nona", "-v", "-z", "LZW", *output, *options, "-o", prefix, project]


def _project_for_nona(plan: Plan, folder: Path) -> Path:
    """The project itself; a copy with absolute names where photos are not where it says, or the plan leaves
    some of them out.

    The former happens to projects that were moved or come from Windows; nona does not look elsewhere.
    """
    project, photos = pto.load(plan.file), {image.index: image.photo for image in plan.images}
    others = [image for image in project.images if image.index not in photos and not image.disabled]
    if not others and all(plan.folder / image.name == image.photo for image in plan.images):
        return plan.file
    for image in others:
        image.disabled = True
    for index, photo in photos.items():
        project.images[index].filename = str(photo)
    copy = folder / "project.pto"
    copy.write_bytes(pto.dumps(project))
    return copy


def _prefix(plan: Plan, folder: Path) -> str:
    """Where nona makes layers; named in UTF-8, without which OpenImageIO reads nothing."""
    name = plan.stem.encode(errors="replace")[:_LONGEST_NAME].decode(errors="ignore")
    return str(folder / plan.layer_prefix(name))


def made_in(plan: Plan, folder: Path) -> dict[int, Path]:
    """The layers that nona left in the folder."""
    prefix = _prefix(plan, folder)
    paths = {image.index: layer_path(prefix, image.index, plan.layer_ending) for image in plan.images}
    return {index: path for index, path in paths.items() if path.is_file()}


def refuse_to_make(plan: Plan, images: Sequence[PlannedImage], kept_as: str | None, anew: bool) -> None:
    """Raise what is known to keep nona from making layers of `images` before it begins.

    kept_as     the prefix of layers that are kept. anew: no other layers are there.

    Raises `NonaMissingError`, `PhotoMissingError`, of layers that are kept `OutputError`.
    """
    if not images:
        return
    if kept_as is not None:
        _refuse_to_keep(plan, images, kept_as)
    for image in images if anew else ():  # beside other layers it may miss the crop, and need no photo
        _require_photo(plan, image)
    if shutil.which("nona", os.F_OK) is None:  # why one that is there cannot be run is told when it is
        raise NonaMissingError(f"{programs.missing('nona')}; {_OTHERWISE}")


def _refuse_to_keep(plan: Plan, images: Sequence[PlannedImage], prefix: str) -> None:
    """Raise `OutputError` if layers of `images` could not be read by these names, or would take the place of
    something else: before nona makes them, which may take minutes.
    """
    if not named_in_unicode(Path(prefix)):
        raise OutputError(
            f"{prefix}0000 is not valid UTF-8, so that layers cannot be kept by such names; rename "
            "folder and project, or leave out --keep-layers"
        )
    photos = {file_key(photo) for photo in plan.photos}
    finals = [layer_path(prefix, image.index, plan.layer_ending) for image in images]
    for final in finals:
        if file_key(final) in photos:
            raise OutputError(f"{final} is a photo, and no layer takes its place; rename the project")
        if is_another_projects(plan, final):
            raise OutputError(
                f"{final} is the name of another project's panorama, {final.stem}.pto's, and no layer takes "
                "it; rename one of both, or leave out --keep-layers"
            )
        if is_file(final) and _is_picture(final):
            raise OutputError(
                f"{final} has no alpha channel: it is no layer, and none takes its place; move it, or rename "
                "the project"
            )
    for final in finals:
        if is_special(final):  # who opens a pipe waits until somebody writes
            raise OutputError(f"{final} is a pipe or a device, and no layer takes its place; move it")
        if is_edited(final):
            raise OutputError(
                f"{final} was changed by another program than nona, and no layer takes its place; move it, "
                "leave out --keep-layers, or take the layers as they are (--remap never)"
            )


def _keep(prefix: str, made: dict[int, Path]) -> dict[int, Path]:
    """Move layers beside the project, each whole or not at all."""
    kept, advice = {}, "leave out --keep-layers or free the folder"
    for index, path in made.items():
        final = layer_path(prefix, index, path.suffix)
        weights = path.with_name(f"{path.stem}_gray.pgm")  # hugin_hdrmerge asks for them beside the layers
        for file in (path, weights) if weights.is_file() else (path,):
            move_whole(file, final.with_name(file.name.replace(path.stem, final.stem)), advice)
        kept[index] = final
    return kept


def _is_picture(path: Path) -> bool:
    """Whether a file is an image, and no layer: a photo that was developed, perhaps, and no project names."""
    try:
        return not all(layer.has_alpha for layer in read_layers(path))
    except ImageReadError:
        return False

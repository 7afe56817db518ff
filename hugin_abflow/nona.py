"""Layers of a project: those that are there, and what Hugin's nona makes."""

from __future__ import annotations

import logging
import os
import re
import shutil
import subprocess
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, get_args

from hugin_abflow import programs, pto
from hugin_abflow.errors import (
    ImageReadError,
    LayersMismatchError,
    LayersMissingError,
    NonaFailedError,
    NonaMissingError,
    OutputError,
    PhotoMissingError,
    ProgramFailedError,
    ProgramMissingError,
    SettingsError,
)
from hugin_abflow.failures import check_made, failure
from hugin_abflow.found import (
    Found,
    Remap,
    find,
    is_another_projects,
    layer_path,
    layers_by_prefix,
    named_files,
    none_there,
)
from hugin_abflow.images import read_layers
from hugin_abflow.jpeg import is_cut
from hugin_abflow.layer import Layer, check_layers
from hugin_abflow.programs import LAST_LINES, move_whole, started
from hugin_abflow.progress import Progress, silent
from hugin_abflow.project import Plan, PlannedImage, file_key
from hugin_abflow.scratch import is_file, is_special, work_folder
from hugin_abflow.targets import named_in_unicode
from hugin_abflow.tifftags import is_edited

log = logging.getLogger("hugin_abflow.nona")

# Bytes of a project's name with which those of its layers begin while they are made: file systems take 255,
# and numbers and endings follow.
_LONGEST_NAME = 200

_NAMED = 5  # photos that a warning names

# What to do where nona cannot make layers, beside mending that.
_OTHERWISE = "or name layers that exist with --prefix or --layers"

_STEPS = ("remapping ", "saving ")  # what nona -v says at the end of a photo's loading and remapping
_LOADING = "loading "  # and at its beginning
# What libtiff and libjpeg say of a photo that nona remaps as if it were whole: pixels are missing; or may
# be missing: some cameras leave out no more than the mark of the end.
_LOSS, _CUT = ": Read error on ", "Premature end of JPEG file"
_DOUBTS = (_CUT, "Corrupt JPEG data")


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
        photos = {str(file): names[index] for index, file in _made(plan, folder).items()}
        # what was made will go: messages name the photo
        opened = [replace(one, photo=photos.get(str(one.file))) for one in opened]
        called = [one.photo or str(one.file) for one in opened]
        try:
            check_layers(plan.canvas, opened, called)
        except LayersMismatchError as error:
            if not found or not _can_make(plan):
                raise
            without = ", without --prefix and --layers," if named else ""
            raise LayersMismatchError(f"{error} (--remap always{without} makes all of them)") from None
        try:
            yield opened
        except ImageReadError as error:  # files are opened before, but not decoded
            if named or not any(file in str(error) for file in found) or not _can_make(plan):
                raise
            raise ImageReadError(f"{error} (--remap always makes all of them)") from None


def _check_request(remap: str, named: bool) -> None:
    if remap not in get_args(Remap):
        raise SettingsError(f"remap is {remap!r}; choose 'auto', 'always' or 'never'")
    if named and remap == "always":
        raise SettingsError(
            "layers are named and shall be made; leave out --prefix and --layers, or --remap always"
        )


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
    if (unusable or stale) and _can_make(plan):
        if unusable:
            log.warning("%s: all layers are made again", unusable)
        elif edited := [file for file in found.in_order() if is_edited(file)]:
            log.warning(
                "%s was changed by another program, but %s is older than the project or its photo: layers "
                "are made again (--remap never takes them as they are)", edited[0], stale[0],
            )  # fmt: skip
        else:
            log.info("%s is older than the project or its photo: layers are made again", stale[0])
        return None, plan.images
    if stale and not found.broken:
        reason = "nona is not installed" if shutil.which("nona") is None else "photos are missing"
        log.warning("%s is older than the project or its photo; used as it is, since %s", stale[0], reason)
    return found, found.missing(plan)


def _report_used(plan: Plan, found: Found) -> None:
    """Warn of what --remap never leaves as it is."""
    for image in found.missing(plan):
        log.warning("no layer of image %d (%s): it is left out", image.index, image.name)
    for file in found.stale(plan)[:1]:
        log.warning("%s is older than the project or its photo; used as it is (--remap never)", file)


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


def _can_make(plan: Plan) -> bool:
    return shutil.which("nona") is not None and all(is_file(image.photo) for image in plan.images)


def _make_all(plan: Plan, folder: Path, keep: bool, progress: Progress) -> Found:
    """Have nona make every layer."""
    prefix = str(plan.folder / plan.layer_prefix(plan.stem))
    refuse_to_make(plan, plan.images, prefix if keep else None, anew=True)
    with progress("remap", len(_STEPS) * len(plan.images)) as advance:
        ended = _run(plan, _project_for_nona(plan, folder), plan.images, folder, [], advance)
    made = _made(plan, folder)
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


def _find_or_make(
    plan: Plan, needed: Plan, folder: Path, remap: Remap, keep: bool, progress: Progress
) -> Found:
    """Layers that nobody named: what is there, what nona makes of the images of `needed`, or both."""
    found, missing = planned_layers(plan, remap)
    if found is None:
        return _make_all(needed, folder, keep, progress)
    missing = [image for image in missing if image in needed.images]
    if not missing:
        return found
    made = _make_missing(plan, missing, folder, found.prefix, keep, progress)
    return Found(found.prefix, found.files | made, found.pages)


def _make_missing(
    plan: Plan, missing: Sequence[PlannedImage], folder: Path, prefix: str, keep: bool, progress: Progress
) -> dict[int, Path]:
    """Have nona make the layers that are not there; images that miss the crop have none."""
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
    made = _made(plan, folder)
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
            log.info("image %d (%s) misses the crop: it has no layer", image.index, image.name)
    if lost := [image for image in none if loads[image.photo] > 0]:
        names = ", ".join(image.name for image in lost[:_NAMED])
        more = f" and {len(lost) - _NAMED} more" if len(lost) > _NAMED else ""
        log.warning("nona made no layer of %s%s: left out; look at their masks in Hugin", names, more)


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
                    log.debug("nona: %s", line.strip())
                if line.startswith(_STEPS):
                    advance(1)
                elif line.startswith(_LOADING):
                    loaded.append(plan.folder / line.removeprefix(_LOADING).strip())
                elif _LOSS in line:
                    photo = loaded[-1] if loaded else plan.file
                    raise ImageReadError(
                        f"{photo} is damaged ({line.strip()}); copy it from the camera again"
                    )
                elif any(mark in line for mark in _DOUBTS):
                    doubts.add(line.strip())
    except ProgramMissingError as error:  # it is there, but not its interpreter
        raise NonaMissingError(f"{error}; {_OTHERWISE}") from None
    except ProgramFailedError as error:
        raise NonaFailedError(str(error)) from None
    for doubt in sorted(doubts):
        # libjpeg names no file, and what it says overtakes what nona does
        cut = [str(image.photo) for image in images if doubt.startswith(_CUT) and is_cut(image.photo)]
        log.warning(
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


def _made(plan: Plan, folder: Path) -> dict[int, Path]:
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

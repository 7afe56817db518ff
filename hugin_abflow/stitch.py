"""All outputs that a project asks for, made or shown."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

from hugin_abflow.brackets import to_be_made
from hugin_abflow.errors import LayersMismatchError, ProgramMissingError
from hugin_abflow.exif import embed
from hugin_abflow.found import Remap, layer_name, layers_there
from hugin_abflow.images import COMPRESSIONS, DEFAULTS, ENDINGS, JPEG_QUALITY, read_layer
from hugin_abflow.layer import Layer, check_layers
from hugin_abflow.merge import (
    OpenDevice,
    check_early,
    default_target,
    guides_of,
    merge_project,
    storable,
    target_of,
    write_panorama,
)
from hugin_abflow.metadata import describe
from hugin_abflow.nona import open_layers, planned_layers, refuse_to_make, remapping
from hugin_abflow.oneline import commented
from hugin_abflow.outputs import (
    BLEND,
    PANORAMAS,
    WORDS,
    Branch,
    Kind,
    Step,
    branches,
    checked_outputs,
    impossible,
    no_option,
    possible_outputs,
    refuse_result,
)
from hugin_abflow.pano_trafo import images_of
from hugin_abflow.programs import move_whole, run
from hugin_abflow.progress import Progress, silent
from hugin_abflow.project import Output, Plan, read_plan, warn_of_doubts
from hugin_abflow.scratch import is_file, work_folder
from hugin_abflow.settings import Settings

# In commands of a script: what stands before files in its temporary folder. No argument can hold it.
_TEMPORARY = "\0"


def stitch_project(
    path: Path | str,
    settings: Settings | None = None,
    *,
    output: Path | str | None = None,
    prefix: str | Path | None = None,
    layers: Sequence[str | Path] | None = None,
    remap: Remap = "auto",
    keep_layers: bool = False,
    compression: str | None = None,
    jpeg_quality: int | None = None,
    metadata: bool = True,
    progress: Progress = silent,
    open_device: OpenDevice | None = None,
    finished: Callable[[Path], None] = lambda file: None,
    leave: Collection[Path] = (),
) -> list[Path]:
    """Make all outputs that are checked in Hugin for a project; returns their files, beside it.

    With `output`, `prefix` or `layers`: the one panorama of `merge.merge_project`, whose arguments these are.

    finished        is told each file when it is complete, so that it is known where a later one fails.
    leave           outputs that are checked, but not to be made: what is there stays as it is.

    Outputs whose programs are not installed are left out, with a warning. Each file appears when it is
    complete; one that fails ends the run, and what was made before stays. Raises the `AbflowError` family,
    `ProgramMissingError` if nothing can be made.
    """
    one = partial(
        merge_project, path, settings, output=output, prefix=prefix, layers=layers, compression=compression,
        jpeg_quality=jpeg_quality, metadata=metadata, progress=progress, open_device=open_device,
    )  # fmt: skip
    made: list[Path] = []

    def finish(*files: Path) -> None:
        for file in files:
            made.append(file)
            finished(file)

    if output or prefix or layers:
        finish(one(remap=remap, keep_layers=keep_layers))
        return made
    plan = read_plan(path)
    wanted = _branches(plan, leave)
    if not any(Kind.PANORAMA in branch.kinds for branch in wanted):  # else `merge_project` says it
        warn_of_doubts(plan)
    for branch in wanted:
        if Kind.LAYERS in branch.kinds:
            with open_layers(branch.plan, remap=remap, keep_layers=True, progress=progress) as opened:
                finish(*_files(opened))
        if Kind.PANORAMA in branch.kinds:
            # layers that were kept just now are not made again
            again: Remap = "auto" if made and remap == "always" else remap
            finish(one(remap=again, keep_layers=keep_layers))
        if branch.plan.hdr or branch.plan.ignore_exposure:
            stored = _stored(branch.plan, compression, jpeg_quality)
            maker = _Maker(
                replace(branch, plan=stored), settings or Settings(), metadata, progress, open_device, finish,
                leave,
            )  # fmt: skip
            maker.make(remap, keep_layers)
    return made


def show_project(
    path: Path | str,
    settings: Settings | None = None,
    *,
    output: Path | str | None = None,
    prefix: str | Path | None = None,
    layers: Sequence[str | Path] | None = None,
    remap: Remap = "auto",
    keep_layers: bool = False,
    compression: str | None = None,
    jpeg_quality: int | None = None,
    metadata: bool = True,
    options: Sequence[str] = (),
    leave: Collection[Path] = (),
) -> list[str]:
    """What `stitch_project` would do, as lines of a shell script: a comment on the plan, then the commands.

    options     of our own command line that say how to blend; the other arguments are `stitch_project`'s.
                Of settings and metadata the commands know by these options alone.

    As the run does, the script makes what is no output in a temporary folder, so that nothing is replaced but
    outputs. It ends at the first error. Photos that miss the crop, which nona tells later, are taken for part
    of the panorama; where nona makes some layers of several, to be kept or stacked, such a one is an error.
    Raises as `stitch_project` does for what project, output, photos and named layers can get wrong; whether
    `settings.max_memory` suffices shows in the run alone, once layers are decoded.
    """
    plan = read_plan(path)
    warn_of_doubts(plan)
    name = no_option(plan.file.name)
    script = partial(_script, plan, leave)
    chosen = compression if output else storable(plan, compression)
    check = partial(check_early, plan, settings or Settings(), output, chosen)
    stored = _storing(chosen, jpeg_quality)
    if output or prefix or layers:
        check()
        if prefix or layers:  # they are there, and fit, or the run ends with what is raised here
            with open_layers(plan, prefix=prefix, layers=layers, remap=remap) as opened:
                target_of(plan, opened, output)
        (final,) = asked_panoramas(plan, output=output, prefix=prefix, layers=layers, remap=remap)
        target = str(final) if output else no_option(final.name)
        merging = [BLEND, *options, *stored, "-o", target, name]
        if prefix:
            return script([final], [[*merging, "--prefix", _from_anywhere(plan, prefix)]])
        if layers:
            return script([final], [[*merging, "--layers", *(str(Path(one).absolute()) for one in layers)]])
        return script([final], _merging(merging, *_remapping(plan, remap, keep_layers)[:2]))
    commands: list[Sequence[str]] = []
    results: list[Path] = []
    for branch in _branches(plan, leave):
        commands += [["#", WORDS[kind]] for kind in Kind if kind in branch.kinds]
        keep = keep_layers or branch.keeps_layers
        remapped, found, files = _remapping(branch.plan, _remap(branch.plan, remap), keep)
        if Kind.PANORAMA in branch.kinds:
            check()
            results.append(default_target(plan))
            target = no_option(results[-1].name)
            remapped = _merging([BLEND, *options, *stored, "-o", target, name], remapped, found)
        commands += remapped
        asked = _stored(branch.plan, compression, jpeg_quality)
        differs = _differing(asked.output, plan.output)
        names = {branch.layer(index): file for index, file in files.items()}
        for step in _steps(replace(branch, plan=asked), [image.index for image in plan.images], leave):
            if step.wanted:
                results.append(plan.folder / step.result)
                refuse_result(results[-1], plan)
            names[step.result] = step.result if step.wanted else _TEMPORARY + step.result
            inputs = tuple(names.get(file, file) for file in step.inputs)
            placed = replace(step, result=names[step.result], inputs=inputs)
            commands.append(placed.command(name, [*options, *(differs if step.final else [])]))
    return script(results, commands)


def asked_panoramas(
    plan: Plan,
    *,
    output: Path | str | None = None,
    prefix: str | Path | None = None,
    layers: Sequence[str | Path] | None = None,
    remap: Remap = "auto",
    **others: object,
) -> list[Path]:
    """The panoramas that `stitch_project` is to make with these arguments, not the layers and stacks, whether
    or not that can be done here.
    """
    if output:
        return [Path(output).absolute()]
    if prefix or layers:
        return [default_target(plan, layers_there(plan, prefix, layers, remap))]
    found = branches(plan, checked_outputs(plan))
    return [_panorama(branch, kind) for branch in found for kind in PANORAMAS if kind in branch.kinds]


def names_one(options: Mapping[str, Any]) -> bool:
    """Whether `stitch_project` makes one panorama, whatever is checked; options: its keywords."""
    return any(options.get(name) for name in ("output", "prefix", "layers"))


def is_more_asked(plan: Plan, options: Mapping[str, Any], leave: Collection[Path]) -> bool:
    """Whether `stitch_project` would make anything but what is to be left; options: its keywords."""
    if names_one(options):
        return not set(asked_panoramas(plan, **options)) <= set(leave)
    kinds = checked_outputs(plan)
    lacking = impossible(kinds)
    return bool(_without(branches(plan, [kind for kind in kinds if kind not in lacking]), leave))


def _panorama(branch: Branch, kind: Kind) -> Path:
    """The file of a panorama that nobody names."""
    if kind is Kind.PANORAMA:
        return default_target(branch.plan)
    return branch.plan.folder / branch.panorama(kind)


def _without(found: Sequence[Branch], leave: Collection[Path]) -> list[Branch]:
    """What has still to be made of branches if files are left."""
    left = [{one for one in PANORAMAS if one in b.kinds and _panorama(b, one) in leave} for b in found]
    rest = [replace(branch, kinds=branch.kinds - its) for branch, its in zip(found, left, strict=True)]
    return [branch for branch in rest if branch.kinds]


def _steps(branch: Branch, images: Sequence[int], leave: Collection[Path]) -> list[Step]:
    """The steps of a branch. A stack that is left is made all the same where a panorama is made of it, but in
    a temporary folder: the one that is there may be of other photos.
    """
    steps = branch.steps(images)
    folder = branch.plan.folder
    placed = [replace(step, wanted=step.wanted and folder / step.result not in leave) for step in steps]
    needed = {name for step in placed for name in step.inputs}
    return [step for step in placed if step.wanted or step.result in needed]


def _script(
    plan: Plan, leave: Collection[Path], results: Sequence[Path], commands: Sequence[Sequence[str]]
) -> list[str]:
    """Commands as lines of a shell script, which ends at the first error; one "#" is a comment. So is what
    becomes of files that are there: of `results`, which are made, and of those that are left.
    """
    crop, canvas = plan.canvas.crop, plan.canvas
    said = [
        f"{plan.file.name}: {len(plan.images)} photos, {plan.projection}, "
        f"{crop.width} x {crop.height} of {canvas.width} x {canvas.height}",
        *(f"{file.name} is there, and replaced" for file in results if is_file(file)),
        *(f"{file.name} is left as it is (--force: made anew)" for file in leave),
    ]
    head = [*map(commented, said), "set -e", shlex.join(["cd", str(plan.folder)])]
    lines = [commented(words[1]) if words[0] == "#" else " ".join(map(_quoted, words)) for words in commands]
    if any(word.startswith(_TEMPORARY) for words in commands for word in words):
        remove = 'rm -rf "$layers"'
        # another project's script may follow, with a folder of its own
        return [*head, "layers=$(mktemp -d)", f"trap '{remove}' EXIT INT TERM", *lines, remove]
    return [*head, *lines]


def _quoted(word: str) -> str:
    """A word as a shell reads it."""
    if word.startswith(_TEMPORARY):
        return '"$layers"/' + shlex.quote(word.removeprefix(_TEMPORARY))
    return shlex.quote(word)


def _merging(command: list[str], remapped: list[list[str]], found: str) -> list[list[str]]:
    """Commands for a panorama, which `command` makes of layers that `_remapping` tells of."""
    if found:
        return [*remapped, [*command, "--prefix", found]]
    return [[*command, "--remap", "auto"]]  # which has nona make what is missing


def _storing(compression: str | None, jpeg_quality: int | None) -> list[str]:
    """Options of our command line for how a panorama is stored."""
    by_name = {"--compression": compression, "--jpeg-quality": jpeg_quality}
    return [word for name, value in by_name.items() if value for word in (name, str(value))]


def _differing(asked: Output, own: Output) -> list[str]:
    """Options for a panorama that is stored as `asked`, where a command takes `own` for what the project asks
    for: a project that makes several panoramas may store them in several ways.
    """
    kind, alike = ENDINGS[asked.ending], ENDINGS[asked.ending] == ENDINGS[own.ending]
    usual = (own.compression if alike else None) or DEFAULTS[kind]
    wanted = asked.compression or DEFAULTS[kind]
    quality = own.jpeg_quality if alike else JPEG_QUALITY
    of_jpeg = "jpeg" in (kind, wanted.lower())
    return _storing(
        wanted if wanted.lower() != usual.lower() else None,
        asked.jpeg_quality if of_jpeg and asked.jpeg_quality != quality else None,
    )


def _from_anywhere(plan: Plan, prefix: str | Path) -> str:
    """A prefix of layers that lie in the current folder, in full: the commands run in the project's."""
    here = os.path.join(Path.cwd(), prefix)  # noqa: PTH118 - pathlib drops a slash at the end
    return here if layers_there(plan, here, None, "auto") else no_option(str(prefix))


def _branches(plan: Plan, leave: Collection[Path]) -> list[Branch]:
    """What can be made of what is checked, and is not to be left; says what cannot."""
    possible = possible_outputs(plan)
    if not possible:
        reason = next(iter(impossible(checked_outputs(plan)).values()))
        raise ProgramMissingError(f"{plan.file}: nothing can be made: {reason}")
    return _without(branches(plan, possible), leave)


def _remap(plan: Plan, remap: Remap) -> Remap:
    """HDR layers are made again: without nona's files of weights beside them they cannot be merged."""
    return "always" if plan.hdr and remap == "auto" else remap


def _remapping(plan: Plan, remap: Remap, keep: bool) -> tuple[list[list[str]], str, dict[int, str]]:
    """nona's commands, if layers have to be made; what comes before the numbers of all layers, "" where these
    lie in two folders; and the layers' files by image. Raises as `nona.refuse_to_make` does.
    """
    found, missing = planned_layers(plan, remap)
    prefix = found.prefix if found else str(plan.folder / plan.layer_prefix(plan.stem))
    needed = plan.images if keep or plan.ignore_exposure else to_be_made(plan)
    refuse_to_make(plan, [one for one in missing if one in needed], prefix if keep else None, not found)
    here = Path(prefix).name
    there = no_option(here) if keep or not missing else _TEMPORARY + here
    which = [["-i", str(image.index)] for image in missing] if found else [[]]
    commands = [remapping(plan, options, there, no_option(plan.file.name)) for options in which]
    files = {index: file.name for index, file in found.files.items()} if found else {}
    files |= {image.index: layer_name(there, image.index, plan.layer_ending) for image in missing}
    return commands, "" if found and missing and not keep else there, files


def _stored(plan: Plan, compression: str | None, jpeg_quality: int | None) -> Plan:
    """The plan with what was asked for instead of the project's; a compression where the format has it."""
    possible = COMPRESSIONS.get({".tif": "TIFF", ".exr": "EXR"}.get(plan.output.ending, ""), ())
    chosen = compression if compression and compression.lower() in possible else plan.output.compression
    quality = jpeg_quality or plan.output.jpeg_quality
    return replace(plan, output=replace(plan.output, compression=chosen, jpeg_quality=quality))


def _files(layers: Sequence[Layer]) -> list[Path]:
    """The files of layers; of several pages once."""
    return list(dict.fromkeys(layer.file for layer in layers if layer.file is not None))


def _images(plan: Plan, layers: Sequence[Layer]) -> list[int]:
    """The image of each layer, which has a file of its own: programs that take them take whole files.

    Raises `LayersMismatchError` for pages of one file.
    """
    images = [image for image in images_of(plan, layers) if image is not None]
    if not len(images) == len(_files(layers)) == len(layers):
        raise LayersMismatchError(
            f"{layers[0].file} holds layers as its pages, but stacks and exposures are made of layers in "
            "files of their own; remove it, or make the layers again with --remap always"
        )
    return images


class _Maker:
    """Makes the outputs of one branch, step by step."""

    def __init__(
        self,
        branch: Branch,
        settings: Settings,
        metadata: bool,
        progress: Progress,
        open_device: OpenDevice | None,
        finish: Callable[..., None],
        leave: Collection[Path],
    ) -> None:
        self.branch, self.plan, self.settings = branch, branch.plan, settings
        self.metadata = describe(branch.plan) if metadata else None
        self.progress, self.open_device, self.finish, self.leave = progress, open_device, finish, leave

    def make(self, remap: Remap, keep_layers: bool) -> None:
        """Make the layers, if need be, then all that is made of them; `finish` is told the outputs."""
        keep = keep_layers or self.branch.keeps_layers
        remap = _remap(self.plan, remap)
        with (
            open_layers(self.plan, remap=remap, keep_layers=keep, progress=self.progress) as opened,
            work_folder() as scratch,
        ):
            images = _images(self.plan, opened)
            names = [self.branch.layer(image) for image in images]
            files = dict(zip(names, _files(opened), strict=True))
            if self.branch.keeps_layers:
                self.finish(*_files(opened))
            todo = _steps(self.branch, images, self.leave)
            for program, steps in groupby(todo, key=lambda step: step.program):
                if program == BLEND:
                    for step in steps:
                        files[step.result] = self._blend(step, files, scratch)
                    continue
                alike = list(steps)
                with self.progress(program, len(alike)) as advance:
                    for step in alike:
                        files[step.result] = self._run(step, files, scratch)
                        advance(1)

    def _target(self, step: Step, files: dict[str, Path], scratch: Path) -> Path:
        """Where the result goes, which must be none of the inputs."""
        target = (self.plan.folder if step.wanted else scratch) / step.result
        refuse_result(target, self.plan, [files[name] for name in step.inputs])
        return target

    def _run(self, step: Step, files: dict[str, Path], scratch: Path) -> Path:
        """Have another program make a file; with metadata, if it is an output."""
        target, result = self._target(step, files, scratch), scratch / step.result
        inputs = [str(files[name]) for name in step.inputs]
        run([step.program, *step.options, "-o", str(result), "--", *inputs], scratch)
        if step.wanted:
            if self.metadata:
                embed(result, ENDINGS[result.suffix], self.metadata)
            move_whole(result, target, "free the folder")
            self.finish(target)
        return target

    def _blend(self, step: Step, files: dict[str, Path], scratch: Path) -> Path:
        """Blend layers, stacks or exposures as `merge.merge_project` does."""
        target, plan = self._target(step, files, scratch), self.plan
        layers = [read_layer(files[name]) for name in step.inputs]
        check_layers(plan.canvas, layers, step.inputs)
        final = plan.output if step.final else None
        write_panorama(
            target, layers, plan.canvas, self.settings, projection=plan.projection,
            guides=partial(guides_of, plan, step.images, self.settings),
            compression=final.compression if final else None,
            jpeg_quality=final.jpeg_quality if final else None,
            metadata=self.metadata if step.wanted else None,
            progress=self.progress, open_device=self.open_device,
        )  # fmt: skip
        if step.wanted:
            self.finish(target)
        return target

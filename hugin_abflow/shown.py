"""What would be made of a project, shown as a script of commands."""

from __future__ import annotations

import os
import shlex
from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from hugin_abflow.asked import asked_panoramas, remap_for, stored_as, wanted_branches, wanted_steps
from hugin_abflow.brackets import to_be_made
from hugin_abflow.encoding import DEFAULTS, ENDINGS, JPEG_QUALITY
from hugin_abflow.found import Remap, layer_name, layers_there
from hugin_abflow.merge import check_early, default_target, storable, target_of
from hugin_abflow.nona import refuse_to_make, remapping
from hugin_abflow.oneline import commented
from hugin_abflow.outputs import BLEND, WORDS, Kind, no_option, refuse_result
from hugin_abflow.project import Output, Plan, read_plan, warn_of_doubts
from hugin_abflow.scratch import is_file
from hugin_abflow.settings import Settings
from hugin_abflow.supply import open_layers, planned_layers

# In commands of a script: what stands before files in its temporary folder. No argument can hold it.
_TEMPORARY = "\0"


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
    """What `stitch.stitch_project` would do, as lines of a shell script: a comment on the plan, then the
    commands.

    options     of our own command line that say how to blend; the other arguments are `stitch_project`'s. Of
                settings and metadata the commands know by these options alone.

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
    for branch in wanted_branches(plan, leave):
        commands += [["#", WORDS[kind]] for kind in Kind if kind in branch.kinds]
        keep = keep_layers or branch.keeps_layers
        remapped, found, files = _remapping(branch.plan, remap_for(branch.plan, remap), keep)
        if Kind.PANORAMA in branch.kinds:
            check()
            results.append(default_target(plan))
            target = no_option(results[-1].name)
            remapped = _merging([BLEND, *options, *stored, "-o", target, name], remapped, found)
        commands += remapped
        asked = stored_as(branch.plan, compression, jpeg_quality)
        differs = _differing(asked.output, plan.output)
        names = {branch.layer(index): file for index, file in files.items()}
        for step in wanted_steps(replace(branch, plan=asked), [image.index for image in plan.images], leave):
            if step.wanted:
                results.append(plan.folder / step.result)
                refuse_result(results[-1], plan)
            names[step.result] = step.result if step.wanted else _TEMPORARY + step.result
            inputs = tuple(names.get(file, file) for file in step.inputs)
            placed = replace(step, result=names[step.result], inputs=inputs)
            commands.append(placed.command(name, [*options, *(differs if step.final else [])]))
    return script(results, commands)


def _script(
    plan: Plan, leave: Collection[Path], results: Sequence[Path], commands: Sequence[Sequence[str]]
) -> list[str]:
    """Commands as lines of a shell script, which ends at the first error; one "#" is a comment. So is what
    becomes of files that are there: of `results`, which are made, and of those that are left.
    """
    crop, canvas = plan.canvas.crop, plan.canvas
    moved = [image for image in plan.images if image.photo != plan.folder / image.name]
    said = [
        f"{plan.file.name}: {len(plan.images)} photos, {plan.projection}, "
        f"{crop.width} x {crop.height} of {canvas.width} x {canvas.height}",
        *(
            f"{image.name} is {image.photo}, which nona does not find alone: save the project anew in Hugin"
            for image in moved
        ),
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

"""What is to be made of a project: the outputs that it asks for, less those whose files are to stay."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hugin_abflow.encoding import COMPRESSIONS
from hugin_abflow.errors import ProgramMissingError
from hugin_abflow.found import Remap, layers_there
from hugin_abflow.merge import default_target
from hugin_abflow.outputs import (
    PANORAMAS,
    Branch,
    Kind,
    Step,
    branches,
    checked_outputs,
    impossible,
    possible_outputs,
)
from hugin_abflow.project import Plan


def asked_panoramas(
    plan: Plan,
    *,
    output: Path | str | None = None,
    prefix: str | Path | None = None,
    layers: Sequence[str | Path] | None = None,
    remap: Remap = "auto",
    **others: object,
) -> list[Path]:
    """The panoramas that `stitch.stitch_project` is to make with these arguments, not the layers and stacks,
    whether or not that can be done here.
    """
    if output:
        return [Path(output).absolute()]
    if prefix or layers:
        return [default_target(plan, layers_there(plan, prefix, layers, remap))]
    found = branches(plan, checked_outputs(plan))
    return [_panorama(branch, kind) for branch in found for kind in PANORAMAS if kind in branch.kinds]


def names_one(options: Mapping[str, Any]) -> bool:
    """Whether `stitch.stitch_project` makes one panorama, whatever is checked; options: its keywords."""
    return any(options.get(name) for name in ("output", "prefix", "layers"))


def is_more_asked(plan: Plan, options: Mapping[str, Any], leave: Collection[Path]) -> bool:
    """Whether `stitch.stitch_project` would make anything but what is to be left; options: its keywords."""
    if names_one(options):
        return not set(asked_panoramas(plan, **options)) <= set(leave)
    kinds = checked_outputs(plan)
    lacking = impossible(kinds)
    return bool(_without(branches(plan, [kind for kind in kinds if kind not in lacking]), leave))


def wanted_branches(plan: Plan, leave: Collection[Path]) -> list[Branch]:
    """What can be made of what is checked, and is not to be left; says what cannot."""
    possible = possible_outputs(plan)
    if not possible:
        reason = next(iter(impossible(checked_outputs(plan)).values()))
        raise ProgramMissingError(f"{plan.file}: nothing can be made: {reason}")
    return _without(branches(plan, possible), leave)


def wanted_steps(branch: Branch, images: Sequence[int], leave: Collection[Path]) -> list[Step]:
    """The steps of a branch. A stack that is left is made all the same where a panorama is made of it, but in
    a temporary folder: the one that is there may be of other photos.
    """
    steps = branch.steps(images)
    folder = branch.plan.folder
    placed = [replace(step, wanted=step.wanted and folder / step.result not in leave) for step in steps]
    needed = {name for step in placed for name in step.inputs}
    return [step for step in placed if step.wanted or step.result in needed]


def remap_for(plan: Plan, remap: Remap) -> Remap:
    """HDR layers are made again: without nona's files of weights beside them they cannot be merged."""
    return "always" if plan.hdr and remap == "auto" else remap


def stored_as(plan: Plan, compression: str | None, jpeg_quality: int | None) -> Plan:
    """The plan with what was asked for instead of the project's; a compression where the format has it."""
    possible = COMPRESSIONS.get({".tif": "TIFF", ".exr": "EXR"}.get(plan.output.ending, ""), ())
    chosen = compression if compression and compression.lower() in possible else plan.output.compression
    quality = jpeg_quality or plan.output.jpeg_quality
    return replace(plan, output=replace(plan.output, compression=chosen, jpeg_quality=quality))


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

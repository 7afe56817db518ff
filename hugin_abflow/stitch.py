"""All outputs that a project asks for, made."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import partial
from itertools import groupby
from pathlib import Path

from hugin_abflow.asked import remap_for, stored_as, wanted_branches, wanted_steps
from hugin_abflow.encoding import ENDINGS
from hugin_abflow.errors import LayersMismatchError
from hugin_abflow.exif import embed
from hugin_abflow.found import Remap
from hugin_abflow.images import read_layer
from hugin_abflow.layer import Layer, check_layers
from hugin_abflow.merge import OpenDevice, guides_of, merge_project, write_panorama
from hugin_abflow.metadata import describe
from hugin_abflow.outputs import BLEND, Branch, Kind, Step, refuse_result
from hugin_abflow.pano_trafo import images_of
from hugin_abflow.programs import move_whole, run
from hugin_abflow.progress import Progress, silent
from hugin_abflow.project import Plan, read_plan, warn_of_doubts
from hugin_abflow.scratch import work_folder
from hugin_abflow.settings import Settings
from hugin_abflow.supply import open_layers


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
    wanted = wanted_branches(plan, leave)
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
            stored = stored_as(branch.plan, compression, jpeg_quality)
            maker = _Maker(
                replace(branch, plan=stored), settings or Settings(), metadata, progress, open_device, finish,
                leave,
            )  # fmt: skip
            maker.make(remap, keep_layers)
    return made


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
        remap = remap_for(self.plan, remap)
        with (
            open_layers(self.plan, remap=remap, keep_layers=keep, progress=self.progress) as opened,
            work_folder() as scratch,
        ):
            images = _images(self.plan, opened)
            names = [self.branch.layer(image) for image in images]
            files = dict(zip(names, _files(opened), strict=True))
            if self.branch.keeps_layers:
                self.finish(*_files(opened))
            todo = wanted_steps(self.branch, images, self.leave)
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

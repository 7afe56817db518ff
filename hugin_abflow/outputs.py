"""A project's checked outputs, named as Hugin names them, and the steps that make them.

As Hugin's own stitcher has it (``hugin_executor -s -d`` prints its commands); blending is ours.
"""

from __future__ import annotations

import logging
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

from hugin_abflow import pto
from hugin_abflow.found import layer_name
from hugin_abflow.metadata import PROGRAM
from hugin_abflow.programs import missing
from hugin_abflow.project import TIFF_COMPRESSIONS, Plan, read_output
from hugin_abflow.stacks import exposure_layers, stacks
from hugin_abflow.targets import refuse_input, refuse_photo

_log = logging.getLogger(__name__)

ENFUSE, HDRMERGE, BLEND = "enfuse", "hugin_hdrmerge", PROGRAM


class Kind(StrEnum):
    """An output that can be checked; the value is what follows ``#hugin_output``."""

    PANORAMA = "LDRBlended"
    LAYERS = "LDRLayers"
    EXPOSURE_REMAPPED = "LDRExposureRemapped"
    EXPOSURE_LAYERS = "LDRExposureLayers"
    FUSED_LAYERS = "LDRExposureLayersFused"
    STACKS = "LDRStacks"
    FUSED_STACKS = "LDRExposureBlended"
    HDR = "HDRBlended"
    HDR_LAYERS = "HDRLayers"
    HDR_STACKS = "HDRStacks"


# As Hugin's stitcher tab calls them.
WORDS = {
    Kind.PANORAMA: "panorama, exposure corrected",
    Kind.LAYERS: "remapped images, exposure corrected",
    Kind.EXPOSURE_REMAPPED: "remapped images, no exposure correction",
    Kind.EXPOSURE_LAYERS: "blended layers of similar exposure",
    Kind.FUSED_LAYERS: "panorama, exposure fused from any arrangement",
    Kind.STACKS: "exposure fused stacks",
    Kind.FUSED_STACKS: "panorama, exposure fused from stacks",
    Kind.HDR: "panorama, high dynamic range",
    Kind.HDR_LAYERS: "remapped images, high dynamic range",
    Kind.HDR_STACKS: "high dynamic range stacks",
}
_NEEDS = {
    Kind.FUSED_LAYERS: (ENFUSE,),
    Kind.STACKS: (ENFUSE, "pano_trafo"),
    Kind.FUSED_STACKS: (ENFUSE, "pano_trafo"),
    Kind.HDR: (HDRMERGE, "pano_trafo"),
    Kind.HDR_STACKS: (HDRMERGE, "pano_trafo"),
}
# What follows the project's name in those of panoramas, before the ending.
_SUFFIXES = {Kind.FUSED_LAYERS: "_blended_fused", Kind.FUSED_STACKS: "_fused", Kind.HDR: "_hdr"}
# Outputs of one file each, whose names are known before there are layers.
PANORAMAS = (Kind.PANORAMA, *_SUFFIXES)
# What follows it in those of which there are several: a number, from 0, and the ending.
_NUMBERED = {
    Kind.EXPOSURE_LAYERS: "_exposure_{:04d}.tif",
    Kind.STACKS: "_stack_ldr_{:04d}.tif",
    Kind.HDR_STACKS: "_stack_hdr_{:04d}.exr",
}
# Which outputs are made of layers of one kind; and which of them are the layers themselves.
_CORRECTED = frozenset({Kind.PANORAMA, Kind.LAYERS})
_UNCORRECTED = frozenset(
    {Kind.EXPOSURE_REMAPPED, Kind.EXPOSURE_LAYERS, Kind.FUSED_LAYERS, Kind.STACKS, Kind.FUSED_STACKS}
)
_LINEAR = frozenset({Kind.HDR, Kind.HDR_LAYERS, Kind.HDR_STACKS})
_REMAPPED = frozenset({Kind.LAYERS, Kind.EXPOSURE_REMAPPED, Kind.HDR_LAYERS})


def no_option(name: str) -> str:
    """A name of a file, or what it begins with, as an argument that no program takes for an option."""
    return f"./{name}" if name.startswith("-") else name


@dataclass(frozen=True)
class Step:
    """One file and what it is made of.

    program     enfuse, hugin_hdrmerge, or hugin-abflow: what we do ourselves.
    options     of the program, before the names of files.
    result      name of the file.
    inputs      names of the files that it is made of.
    images      indices of the images that each of the inputs shows.
    wanted      the file is an output, and not only needed for another.
    final       it is a panorama, stored as the project says; else TIFF or EXR, as layers are.
    """

    program: str
    options: tuple[str, ...]
    result: str
    inputs: tuple[str, ...]
    images: tuple[tuple[int, ...], ...]
    wanted: bool
    final: bool = False

    def command(self, project: str, blending: Sequence[str]) -> list[str]:
        """What one would type; blending: options of our own."""
        result, inputs = no_option(self.result), map(no_option, self.inputs)
        if self.program == BLEND:
            return [BLEND, *blending, "-o", result, no_option(project), "--layers", *inputs]
        return [self.program, *self.options, "-o", result, "--", *inputs]


@dataclass(frozen=True)
class Branch:
    """Layers of one kind and the outputs that are made of them.

    plan        the project; its `hdr`, `ignore_exposure` and `output` are the layers' and outputs'.
    kinds       what is wanted.
    """

    plan: Plan
    kinds: frozenset[Kind]

    @property
    def keeps_layers(self) -> bool:
        """Whether the layers are an output themselves."""
        return bool(self.kinds & _REMAPPED)

    def layer(self, index: int) -> str:
        """The name of an image's layer."""
        prefix = self.plan.layer_prefix(self.plan.stem)
        return layer_name(prefix, index, self.plan.layer_ending)

    def steps(self, images: Sequence[int]) -> list[Step]:
        """How the outputs are made of the layers of `images`, in this order.

        Not those of exposure-corrected layers, which `merge.merge_project` blends. Raises
        `ProgramMissingError` and `ProgramFailedError`.
        """
        if self.plan.hdr:
            return self._stack_steps(HDRMERGE, images, Kind.HDR_STACKS, Kind.HDR)
        if self.plan.ignore_exposure:
            layers = self._exposure_layer_steps(images)
            return [*layers, *self._stack_steps(ENFUSE, images, Kind.STACKS, Kind.FUSED_STACKS)]
        return []

    def _exposure_layer_steps(self, images: Sequence[int]) -> list[Step]:
        """Photos of one exposure are blended, then these layers fused."""
        if not self.kinds & {Kind.EXPOSURE_LAYERS, Kind.FUSED_LAYERS}:
            return []
        groups = exposure_layers(self.plan, images)
        wanted = Kind.EXPOSURE_LAYERS in self.kinds
        steps = [
            self._step(BLEND, self._numbered(Kind.EXPOSURE_LAYERS, number), group, wanted)
            for number, group in enumerate(groups)
        ]
        if Kind.FUSED_LAYERS in self.kinds:
            steps.append(self._gather(ENFUSE, Kind.FUSED_LAYERS, steps))
        return steps

    def _stack_steps(self, program: str, images: Sequence[int], stacked: Kind, blended: Kind) -> list[Step]:
        """Photos of one view are fused or merged, then these stacks blended."""
        if not self.kinds & {stacked, blended}:
            return []
        steps = [
            self._step(program, self._numbered(stacked, number), group, stacked in self.kinds)
            for number, group in enumerate(stacks(self.plan, images))
        ]
        if blended in self.kinds:
            steps.append(self._gather(BLEND, blended, steps))
        return steps

    def _step(self, program: str, result: str, images: Sequence[int], wanted: bool) -> Step:
        """A step that takes layers."""
        inputs = tuple(map(self.layer, images))
        options = self._options(program, final=False)
        return Step(program, options, result, inputs, tuple((image,) for image in images), wanted)

    def _numbered(self, kind: Kind, number: int) -> str:
        """The name of one of several outputs of a kind."""
        return f"{self.plan.stem}{_NUMBERED[kind].format(number)}"

    def panorama(self, kind: Kind) -> str:
        """The name of a panorama that is made of several files."""
        return self.plan.default_output(suffix=_SUFFIXES[kind]).name

    def results(self, keep_layers: bool) -> list[str]:
        """Names of what may be made, but for that of exposure-corrected layers; keep_layers: these as well.

        How many there are of several is not known before layers are made: one of each photo, at most.
        """
        several = sorted(self.kinds & _NUMBERED.keys())
        names = [self.panorama(kind) for kind in sorted(self.kinds & _SUFFIXES.keys())]
        for number, image in enumerate(self.plan.images):
            names += [self.layer(image.index)] if keep_layers or self.keeps_layers else []
            names += [self._numbered(kind, number) for kind in several]
        return names

    def _gather(self, program: str, kind: Kind, steps: Sequence[Step]) -> Step:
        """A step that makes a panorama of the results of others."""
        images = tuple(tuple(image for group in step.images for image in group) for step in steps)
        inputs = tuple(step.result for step in steps)
        options = self._options(program, final=True)
        return Step(program, options, self.panorama(kind), inputs, images, True, final=True)

    def _options(self, program: str, final: bool) -> tuple[str, ...]:
        """Options as Hugin gives them: the project's own, size and place, wrapping, compression."""
        project, crop, output = pto.load(self.plan.file), self.plan.canvas.crop, self.plan.output
        if program == HDRMERGE:
            return tuple(_words(project.option("hdrmergeOptions", "")))
        if program != ENFUSE:
            return ()
        wraps = self.plan.canvas.hfov == 360 and crop.width == self.plan.canvas.width
        size = f"-f{crop.width}x{crop.height}+{crop.left}+{crop.top}"
        if final and output.ending == ".jpg":
            compression = [f"--compression={output.jpeg_quality}"]
        elif final and output.ending != ".tif":
            compression = []
        else:
            layers = project.option("outputLayersCompression", "LZW").strip()
            name = (output.compression if final else layers) or "LZW"
            if name.lower() not in TIFF_COMPRESSIONS:
                _log.warning("%s: enfuse knows no compression %s; its files get LZW", self.plan.file, name)
                name = "LZW"
            compression = [f"--compression={name}"]
        own = _words(project.option("enfuseOptions", ""))
        return (*own, *(["-w"] if wraps else []), size, *compression)


def checked_outputs(plan: Plan) -> list[Kind]:
    """What is checked in Hugin's stitcher tab; if nothing is, the panorama."""
    project = pto.load(plan.file)
    kinds = [kind for kind in Kind if project.option(f"output{kind}", "").strip().lower() == "true"]
    unsaid = not project.option(f"output{Kind.PANORAMA}", "").strip()
    if unsaid and not plan.hdr and Kind.PANORAMA not in kinds:
        kinds.insert(0, Kind.PANORAMA)  # Hugin's default
    return kinds or [Kind.HDR if plan.hdr else Kind.PANORAMA]


def impossible(kinds: Sequence[Kind]) -> dict[Kind, str]:
    """Which outputs cannot be made here, and what to do about it."""
    reasons = {kind: [missing(program) for program in _NEEDS.get(kind, ())] for kind in kinds}
    return {kind: next(filter(None, why)) for kind, why in reasons.items() if any(why)}


def possible_outputs(plan: Plan) -> list[Kind]:
    """What is checked and can be made here; warns of what cannot."""
    kinds = checked_outputs(plan)
    reasons = impossible(kinds)
    for kind, reason in reasons.items():
        _log.warning("%s: left out: %s (%s)", plan.file, WORDS[kind], reason)
    return [kind for kind in kinds if kind not in reasons]


def branches(plan: Plan, kinds: Sequence[Kind]) -> list[Branch]:
    """The outputs by the layers that they are made of."""
    project = pto.load(plan.file)
    found = []
    for group, hdr, ignore_exposure in (
        (_CORRECTED, False, False),
        (_UNCORRECTED, False, True),
        (_LINEAR, True, False),
    ):
        if wanted := group & set(kinds):
            own = replace(plan, hdr=hdr, ignore_exposure=ignore_exposure, output=read_output(project, hdr))
            found.append(Branch(own, wanted))
    return found


def results(plan: Plan, keep_layers: bool) -> list[Path]:
    """Files that may be made for a project, whether or not they can be made here: what is checked, and its
    layers, if these are kept.
    """
    found = []
    for branch in branches(plan, checked_outputs(plan)):
        if Kind.PANORAMA in branch.kinds:
            found.append(plan.default_output())
        found += [plan.folder / name for name in branch.results(keep_layers)]
    return found


def refuse_result(result: Path, plan: Plan, inputs: Sequence[Path] = ()) -> None:
    """Raise `OutputError` for a file that would be made, but is there: an input, the project's or one of
    `inputs`, or a photo.
    """
    refuse_input(result, [plan.file, *plan.photos, *inputs])
    refuse_photo(result, "rename it, or the project, after which outputs are named")


def _words(text: str) -> list[str]:
    """Options as the user wrote them into Hugin's preferences."""
    try:
        return shlex.split(text)
    except ValueError:  # a quote without its other half
        return text.split()

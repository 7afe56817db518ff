"""``abflow-enblend``: blends what enblend is asked to blend, by optical flow."""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from hugin_abflow import process
from hugin_abflow.dropin.request import HELP, Request, read_command_line
from hugin_abflow.dropin.weights import MaskedMerge, mask_files
from hugin_abflow.errors import CommandLineError, ExitCode, LayersMismatchError, LayersMissingError
from hugin_abflow.guides import Guide
from hugin_abflow.images import read_layers
from hugin_abflow.layer import Box, Canvas, Layer, bounding_box, check_layers
from hugin_abflow.merge import guides_between, write_panorama
from hugin_abflow.metadata import describe, version
from hugin_abflow.progress import Progress
from hugin_abflow.project import read_plan, warn_of_doubts
from hugin_abflow.scratch import misnamed_root
from hugin_abflow.settings import Settings
from hugin_abflow.signals import interruptible
from hugin_abflow.targets import refuse_input, refuse_photo
from hugin_abflow.terminal import (
    catching,
    complain,
    display_progress,
    messages,
    print_message,
    print_result,
    say,
)

NAME = "abflow-enblend"

_log = logging.getLogger(__name__)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``abflow-enblend`` with `arguments` (default: the process's own); gives 0, or 1 as enblend does."""
    process.set_up()
    with interruptible():
        try:
            succeeded = _run(sys.argv[1:] if arguments is None else arguments)
            return ExitCode.OK if succeeded else ExitCode.FAILED
        except KeyboardInterrupt:
            say(f"{NAME}: interrupted")
            return ExitCode.INTERRUPTED


def _run(arguments: Sequence[str]) -> bool:
    """Whether the command line's panorama, or its answer, is there."""
    show = partial(print_message, program=NAME)
    with messages(logging.WARNING, show=show), catching(NAME, verbose=False, program=NAME) as failures:
        try:
            request = read_command_line(arguments)
        except CommandLineError as error:
            complain(f"{error}\nTry '{NAME} --help'.", NAME)
            return False
    if failures:
        return False
    if request.answer:
        with catching(NAME, verbose=False, program=NAME) as failures:
            print_result(HELP if request.answer == "help" else f"{NAME} {version()}, in place of enblend 4.2")
        return not failures
    verbose = request.verbosity > 1
    with (
        # that a layer is left out is known to `joint`, which tells it to those who ask; enblend warns of it
        messages(logging.INFO if verbose else logging.WARNING, always="hugin_abflow.unused", show=show),
        catching(str(request.output), verbose, NAME) as failures,
        display_progress("", quiet=request.verbosity == 0, verbose=True) as progress,
    ):
        blend(request, progress)
    return not failures


def blend(request: Request, progress: Progress) -> None:
    """Make the panorama that is asked for.

    Raises the `AbflowError` family; `LayersMismatchError` for layers without alpha too, as enblend refuses
    them.
    """
    if request.ignored:
        _log.warning("options of enblend that change nothing here: %s", ", ".join(request.ignored))
    if misnamed := misnamed_root():
        _log.warning("%s", misnamed)
    layers = _read(request)
    plan = read_plan(request.project) if request.project else None
    masks = mask_files(request.load_masks, layers, request.output) if request.load_masks else []
    inputs = [*request.inputs, *request.lists, *masks, *([plan.file, *plan.photos] if plan else [])]
    refuse_input(request.output, inputs)
    refuse_photo(request.output)
    settings = Settings(threads=_threads(os.environ.get("OMP_NUM_THREADS", "")))
    guides: Callable[[], Sequence[Guide]] = tuple
    metadata = None
    if plan:
        warn_of_doubts(plan)
        canvas = replace(plan.canvas, crop=request.crop or bounding_box(layers))
        projection, guides = plan.projection, partial(guides_between, plan, layers, settings)
        metadata = describe(replace(plan, canvas=canvas))
    else:
        canvas = _canvas(layers, request.crop, request.wraps)
        projection = "taken as equirectangular" if canvas.spherical else "taken as flat"
    check_layers(canvas, layers)
    if len(layers) == 1:
        _log.warning("only one layer: there is nothing to blend, the output is the layer")
    write_panorama(
        request.output, layers, canvas, settings, projection=projection, guides=guides,
        method=MaskedMerge(request.save_masks, request.load_masks, request.output, inputs),
        depth=request.depth, jpeg_quality=request.jpeg_quality,
        # what the others call compression is not what enblend's option means
        compression=request.compression if request.output.suffix.lower() in (".tif", ".tiff") else None,
        metadata=metadata, progress=progress,
    )  # fmt: skip


def _read(request: Request) -> list[Layer]:
    """The layers that are named, described but not decoded."""
    for path in request.inputs:
        if not path.is_file():
            raise LayersMissingError(f"{path}: no such file; name the layers that nona made")
    return [layer for path in request.inputs for layer in read_layers(path)]


def _threads(said: str) -> int:
    """Cores to use, as OpenMP's variable says, which Hugin sets for enblend; 0: all."""
    first = said.partition(",")[0].strip()  # of a list, for nested loops
    return int(first) if re.fullmatch(r"0*[1-9]\d{0,2}", first) else 0


def _canvas(layers: Sequence[Layer], crop: Box | None, wraps: bool) -> Canvas:
    """The canvas that a command line without a project is about.

    Its size is what the layers' files say, else what holds layers and crop. One that wraps and is twice as
    wide as high is the whole sphere: no other projection is used for that.
    """
    bounds = bounding_box(layers)
    shown = crop or bounds
    sizes = {layer.canvas_size: layer for layer in layers if layer.canvas_size}
    if len(sizes) > 1:
        (one, first), (other, second) = list(sizes.items())[:2]
        raise LayersMismatchError(
            f"{first.name} was made for a canvas of {one[0]}x{one[1]}, {second.name} for one of "
            f"{other[0]}x{other[1]}; name the layers of one panorama"
        )
    width, height = next(iter(sizes), None) or (
        max(bounds.right, shown.right),
        max(bounds.bottom, shown.bottom),
    )
    if crop and (crop.right > width or crop.bottom > height):
        raise LayersMismatchError(
            f"-f {crop.width}x{crop.height}+{crop.left}+{crop.top} reaches beyond the canvas of "
            f"{width}x{height} that the layers were made for; make them again, or correct -f"
        )
    whole = (
        Canvas.sphere(width, height) if wraps and width == 2 * height else Canvas.plane(width, height, wraps)
    )
    return replace(whole, crop=shown)

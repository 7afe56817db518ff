"""From a Hugin project, or from layers, to a panorama."""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hugin_abflow import joint, sequential
from hugin_abflow.brackets import of_one_exposure, to_be_made
from hugin_abflow.devices import choose
from hugin_abflow.encoding import ENDINGS
from hugin_abflow.errors import LayersMissingError
from hugin_abflow.exif import Metadata
from hugin_abflow.found import Remap, candidates
from hugin_abflow.guides import Guide, check_guides
from hugin_abflow.holes import Coverage
from hugin_abflow.images import ImageWriter, check_target, use_threads
from hugin_abflow.kept import in_use, kept_device
from hugin_abflow.layer import Canvas, Layer, check_canvas, check_layers
from hugin_abflow.metadata import describe
from hugin_abflow.opencl import Device
from hugin_abflow.pano_trafo import images_of, read_guides
from hugin_abflow.progress import Progress, silent
from hugin_abflow.project import Plan, read_plan, warn_of_doubts
from hugin_abflow.settings import Settings
from hugin_abflow.spool import spooled
from hugin_abflow.supply import open_layers
from hugin_abflow.targets import refuse_input, refuse_photo

_log = logging.getLogger(__name__)

# Names of the types of files that do not hold all samples, and the widest that they hold.
_MOST: dict[str, tuple[str, np.dtype[Any]]] = {
    "jpeg": ("JPEG", np.dtype(np.uint8)),
    "png": ("PNG", np.dtype(np.uint16)),
    "openexr": ("EXR", np.dtype(np.float32)),
}

# What `joint.merge` looks like.
Method = Callable[
    [Device, Sequence[Layer], Canvas, Settings, Progress, Sequence[Guide]],
    Generator[npt.NDArray[Any], None, None],
]

OpenDevice = Callable[[str | None, int], Device]


def merge_project(
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
) -> Path:
    """Turn a Hugin project into a panorama; returns its file.

    output          format by its ending; default: named and typed as the project says, beside it.
    prefix, layers, remap, keep_layers    where the layers come from, see `supply.open_layers`. Of those that
                    nobody named one by one, a view in several exposures is shown in one, and
                    only such are made that may be (`brackets.py`).
    compression, jpeg_quality    of the file, see `images.ImageWriter`; default: the project's, if the output
                    has the project's format. Without `output` a JPEG or PNG has its own whatever is chosen.
    metadata        write EXIF and, for viewers of 360-degree panoramas, GPano; see `metadata.describe`.
    open_device     gives the device that `settings.device` and `.threads` mean; default: `kept_device`.

    The file appears when it is complete; inputs are never touched. Raises the `AbflowError` family:
    what the project, its layers, the device or the output can get wrong.
    """
    plan = read_plan(path)
    warn_of_doubts(plan)
    settings = settings or Settings()
    if output is None:
        compression = storable(plan, compression)
    check_early(plan, settings, output, compression)
    with open_layers(
        plan, prefix=prefix, layers=layers, remap=remap, keep_layers=keep_layers,
        images=None if prefix or layers or keep_layers else to_be_made(plan), progress=progress,
    ) as opened:  # fmt: skip
        target = target_of(plan, opened, output)
        shown = opened if layers else of_one_exposure(plan, opened)
        if ENDINGS.get(target.suffix.lower()) == ENDINGS[plan.output.ending]:
            compression = plan.output.compression if compression is None else compression
            jpeg_quality = plan.output.jpeg_quality if jpeg_quality is None else jpeg_quality
        write_panorama(
            target, shown, plan.canvas, settings, projection=plan.projection,
            guides=partial(guides_between, plan, shown, settings),
            compression=compression, jpeg_quality=jpeg_quality,
            metadata=describe(plan) if metadata else None, progress=progress, open_device=open_device,
        )  # fmt: skip
    return target


def write_panorama(
    target: Path,
    layers: Sequence[Layer],
    canvas: Canvas,
    settings: Settings,
    *,
    projection: str,
    guides: Callable[[], Sequence[Guide]] = tuple,
    method: Method | None = None,
    depth: npt.DTypeLike | None = None,
    compression: str | None = None,
    jpeg_quality: int | None = None,
    metadata: Metadata | None = None,
    progress: Progress = silent,
    open_device: OpenDevice | None = None,
) -> None:
    """Merge layers that fit the canvas into a file, which appears when it is complete.

    projection      of the canvas, in words.
    guides          gives the places that layers have in common; asked once the file can be written.
    method          merges the layers; default: what `settings.merge` says.
    depth, compression, jpeg_quality, metadata    of the file, see `images.ImageWriter`; half floats become
                    floats in TIFF unless `depth` is said, integers in EXR always.
    open_device     see `merge_project`.

    Raises `OutputError`, `ImageReadError` (a layer cannot be decoded), `SettingsError` (`max_memory` is too
    little for the flow), `DeviceError`.
    """
    crop, first = canvas.crop, layers[0]
    with ImageWriter(
        target, crop.width, crop.height, first.channels, first.dtype, depth=_depth(target, first, depth),
        offset=(crop.left, crop.top), canvas_size=(canvas.width, canvas.height), icc=first.icc,
        compression=compression, jpeg_quality=jpeg_quality, metadata=metadata,
        threads=settings.cores,
    ) as writer:  # fmt: skip
        _report(canvas, projection, layers, writer)
        # where writing fails, what was opened is closed now, not when the error is forgotten
        with closing(_bands(layers, canvas, settings, progress, guides(), method, open_device)) as bands:
            _write(writer, bands)


def _depth(target: Path, layer: Layer, wanted: npt.DTypeLike | None) -> np.dtype[Any]:
    """Samples of a file: what is wanted, or else the layers', if files of its kind hold them."""
    kind = ENDINGS.get(target.suffix.lower(), "")
    depth: np.dtype[Any] = np.dtype(layer.dtype if wanted is None else wanted)
    if kind == "tiff" and wanted is None and depth == np.float16:
        return np.dtype(np.float32)  # few programs read TIFF with half floats; enblend writes floats, too
    name, most = _MOST.get(kind, ("", depth))
    # unless somebody asks for samples, fewer bits are what the type of file is chosen for
    narrowed = wanted is not None and depth.itemsize > most.itemsize
    if narrowed or (kind == "openexr" and depth.kind != "f"):
        coded = (
            "" if depth.kind == "f" else ", as the photos code them: EXR is shown as if it were linear light"
        )
        _log.warning("%s: %s holds no %s samples; they are written as %s%s", target, name, depth, most, coded)
        return most
    return depth


def merge_layers(
    layers: Iterable[Layer],
    canvas: Canvas,
    settings: Settings | None = None,
    *,
    guides: Iterable[Guide] = (),
    progress: Progress = silent,
) -> npt.NDArray[Any]:
    """Merge layers in memory: the canvas's crop, (height, width, channels + 1) in the layers' dtype.

    guides          places that two of `layers` have in common; they lead the flow where it goes astray.

    Alpha is last and unassociated. Raises `CanvasError` for a canvas or crop without pixels or a crop beyond
    the canvas, `LayersMissingError` without layers, `LayersMismatchError` if they do not fit the canvas or
    each other, `GuideError` for guides of layers or places that are none, `ImageReadError` if a layer cannot
    be decoded, `SettingsError` if `settings.max_memory` is too little for the flow, `DeviceError`.
    """
    check_canvas(canvas)
    layers, guides = list(layers), list(guides)
    if not layers:
        raise LayersMissingError("there are no layers to merge; give at least one")
    check_layers(canvas, layers)
    check_guides(guides, len(layers))
    return np.concatenate(list(_bands(layers, canvas, settings or Settings(), progress, guides)))


def _bands(
    layers: Sequence[Layer],
    canvas: Canvas,
    settings: Settings,
    progress: Progress,
    guides: Sequence[Guide],
    method: Method | None = None,
    open_device: OpenDevice | None = None,
) -> Generator[npt.NDArray[Any], None, None]:
    """The panorama's rows from top to bottom."""
    use_threads(settings.cores)
    device = (open_device or kept_device)(settings.device, settings.threads)
    _log.info("device: %s", device.name)
    method = method or {"joint": joint.merge, "sequential": sequential.merge}[settings.merge]
    coverage = Coverage(canvas)
    with (
        in_use(device),
        spooled(layers) as layers,
        # ended first: its threads read the layers
        closing(method(device, layers, canvas, settings, progress, guides)) as bands,
    ):
        for rows in bands:
            coverage.add(rows)
            yield rows
    coverage.report()


def guides_between(plan: Plan, layers: Sequence[Layer], settings: Settings) -> list[Guide]:
    """The project's control points between the layers, one for each image."""
    images = images_of(plan, layers)
    return guides_of(plan, [[] if image is None else [image] for image in images], settings)


def guides_of(plan: Plan, images: Sequence[Sequence[int]], settings: Settings) -> list[Guide]:
    """The project's control points between layers that show several images each, named by their indices."""
    if not (settings.flow and settings.guides) or len(images) < 2:
        return []
    return read_guides(plan, {image: layer for layer, group in enumerate(images) for image in group})


def _write(writer: ImageWriter, bands: Iterator[npt.NDArray[Any]]) -> None:
    """Write bands, encoding each while the next one is calculated."""
    with ThreadPoolExecutor(max_workers=1) as encoder:
        encoded: Future[None] | None = None
        for rows in bands:
            if encoded:
                encoded.result()
            encoded = encoder.submit(writer.write_rows, rows)
        if encoded:
            encoded.result()


def _report(canvas: Canvas, projection: str, layers: Sequence[Layer], writer: ImageWriter) -> None:
    """Say what is merged, and into what."""
    crop = canvas.crop
    _log.info(
        "canvas: %d x %d, %s%s; crop: %d x %d at (%d, %d)",
        canvas.width, canvas.height, projection, f", {canvas.hfov:g} degrees" if canvas.hfov else "",
        crop.width, crop.height, crop.left, crop.top,
    )  # fmt: skip
    kind = {1: "grey", 3: "RGB"}[layers[0].channels]
    _log.info("layers: %d, %s, %s", len(layers), kind, layers[0].dtype)
    for layer in layers:
        file, box = layer.file, layer.box
        name = layer.photo or (file.with_name(layer.name) if file else layer.name)
        _log.info("  %s: %d x %d at (%d, %d)", name, box.width, box.height, box.left, box.top)
    _log.info("output: %s, %s, %s, %s", writer.path, writer.format, writer.compression, writer.stored)


def target_of(plan: Plan, layers: Sequence[Layer], output: Path | str | None) -> Path:
    """The panorama's file, which must be none of the inputs. Raises `OutputError`."""
    inputs = [layer.file for layer in layers if layer.file is not None]
    if output is None:
        return default_target(plan, inputs)
    refuse_input(Path(output), inputs)
    return Path(output)


def default_target(plan: Plan, layers: Iterable[Path] = ()) -> Path:
    """The file of the panorama that nobody names: none of `layers`, nor of those that are there, which may be
    made again.
    """
    there = [file for found in candidates(plan) for file in found.in_order()]
    return plan.default_output([*layers, *there])


def storable(plan: Plan, compression: str | None) -> str | None:
    """A compression that is chosen for a panorama that nobody names; None where files of the type that the
    project asks for have but their own: then it is meant for the panoramas of others.
    """
    if compression and ENDINGS[plan.output.ending] in ("jpeg", "png"):
        _log.info("%s asks for %s, which has no other compression", plan.file, plan.output.ending)
        return None
    return compression


def check_early(plan: Plan, settings: Settings, output: Path | str | None, compression: str | None) -> None:
    """Raise what would be raised in the end, too, but after minutes in which nona makes the layers.

    compression     that was chosen; `storable` where nobody names the output.
    """
    if output is None:
        target = plan.default_output()
    else:
        target = Path(output)
        refuse_input(target, [plan.file, *plan.photos])
        refuse_photo(target)
    check_target(target, compression)
    if settings.device is not None:
        choose(settings.device, settings.threads)

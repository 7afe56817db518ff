"""Each layer's colour weight as an image: written (``--save-masks``), or taken instead (``--load-masks``)."""

from __future__ import annotations

import re
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hugin_abflow import joint, multiband, unit, working
from hugin_abflow.blend import BlendLayer, Prepared
from hugin_abflow.colour import Correction
from hugin_abflow.errors import CommandLineError, LayersMismatchError, LayersMissingError, SameOutputError
from hugin_abflow.grid import Grid, Place
from hugin_abflow.guides import Guide
from hugin_abflow.images import ImageWriter, check_target, read_layer
from hugin_abflow.layer import Box, Canvas, Layer, full_scale
from hugin_abflow.opencl import Device
from hugin_abflow.progress import Progress, silent
from hugin_abflow.project import file_key
from hugin_abflow.settings import Settings
from hugin_abflow.targets import refuse_input, refuse_photo

_OPTION = "--save-masks"
_WHITE = np.uint16(65535)
# What is left of a weight that a mask takes away, far below a step of 16 bits: a pixel that no other layer
# can fill stays opaque, and one that another's sample just reaches, from outside, is this layer's, as it was.
_LEAST_WEIGHT = 1e-7


@dataclass(frozen=True)
class MaskedMerge:
    """`joint.merge`, with weights that are saved, or taken from images; see `merge.Method`.

    save, load      templates of the masks' names, see `name`; None: not.
    output          the panorama's file, which templates may refer to.
    inputs          files that are needed: no mask takes their place.

    A mask covers the output's pixels. White: the layer counts wherever another could stand in for it.
    """

    save: str | None
    load: str | None
    output: Path
    inputs: Sequence[Path] = ()

    def __call__(
        self,
        device: Device,
        layers: Sequence[Layer],
        canvas: Canvas,
        settings: Settings,
        progress: Progress,
        guides: Sequence[Guide],
    ) -> Generator[npt.NDArray[Any], None, None]:
        """Bands as `joint.merge` gives them; raises what it raises, and `LayersMissingError`,
        `LayersMismatchError` and `ImageReadError` for masks that are missing, of another size, or broken,
        `OutputError` for such as cannot be written.
        """
        numbers = {id(layer): index for index, layer in enumerate(layers)}
        given = self._read(layers, canvas.crop) if self.load else []
        targets = self._targets(layers) if self.save else []
        prepared = joint.prepare_in_memory(device, layers, canvas, settings, progress, guides)
        if given:
            weighted = [
                _weighted(device, one, given[numbers[id(one.layer)]], prepared) for one in prepared.layers
            ]
            prepared = _offset(device, replace(prepared, layers=tuple(weighted)))
        if targets:
            with progress("masks", len(layers)) as advance:
                for layer, target in zip(layers, targets, strict=True):
                    _write(device, target, prepared, layer, canvas, settings)
                    advance(1)
        yield from joint.bands(device, prepared, canvas, settings, progress)

    def _read(self, layers: Sequence[Layer], crop: Box) -> list[Layer]:
        """The masks, on the canvas, in the layers' order."""
        masks = []
        for layer, path in zip(layers, mask_files(self.load or "", layers, self.output), strict=True):
            if not path.is_file():
                raise LayersMissingError(f"{path}: no such mask for {layer.name}; --save-masks writes them")
            mask = read_layer(path)
            if (mask.box.width, mask.box.height) != (crop.width, crop.height):
                raise LayersMismatchError(
                    f"{path} has {mask.box.width}x{mask.box.height} pixels, the output has "
                    f"{crop.width}x{crop.height}; masks must be of the output's size"
                )
            masks.append(replace(mask, box=crop))
        return masks

    def _targets(self, layers: Sequence[Layer]) -> list[Path]:
        """The files of masks that are written: each its own, and none of those that are needed."""
        targets = mask_files(self.save or "", layers, self.output)
        if len(set(targets)) < len(targets):
            raise CommandLineError(f"--save-masks={self.save} names one mask twice; %n gives each a number")
        for target in targets:
            if file_key(target) == file_key(self.output):
                raise SameOutputError(
                    f"{target} is the name of the panorama; choose another for masks with {_OPTION}"
                )
            refuse_input(target, self.inputs, _OPTION)
            refuse_photo(target, f"choose another name with {_OPTION}, or remove it")
            check_target(target, None, np.uint16, _OPTION)  # now, not when all else is done
        return targets


def mask_files(template: str, layers: Sequence[Layer], output: Path) -> list[Path]:
    """The layers' masks, as `name` calls them."""
    return [Path(name(template, index, layer, output)) for index, layer in enumerate(layers)]


def name(template: str, index: int, layer: Layer, output: Path) -> str:
    """The name of a layer's mask, as enblend makes it.

    template    ``%i``: index, from 0; ``%n``: number, from 1; ``%p``: path, ``%d``: folder, ``%b``: name,
                ``%f``: name without ending, ``%e``: ending, of the layer or in capitals of the output;
                ``%%``: a percent sign. Numbers may have a width: ``%03n``.

    Raises `CommandLineError` for another letter, or a width that no file's name has.
    """
    path = layer.file or Path(layer.name)

    def part(found: re.Match[str]) -> str:
        width, letter = found[1], found[2]
        if letter == "%":
            return "%"
        if letter in "in":
            if len(width.lstrip("0")) > 2:  # names of files end at 255 bytes
                raise CommandLineError(f"%{width}{letter} in {template}: choose a width of at most 99 digits")
            return f"{index + (letter == 'n'):0{int(width or 0)}}"
        file = output if letter.isupper() else path
        parts = {
            "p": str(file), "d": str(file.parent), "b": file.name, "f": file.stem, "e": file.suffix,
        }  # fmt: skip
        if letter.lower() not in parts:
            raise CommandLineError(f"%{letter} in {template} means nothing; see --help for what does")
        return parts[letter.lower()]

    return re.sub(r"%(\d*)(.)", part, template)


def _write(
    device: Device, path: Path, prepared: Prepared, layer: Layer, canvas: Canvas, settings: Settings
) -> None:
    """One layer's weight: the panorama of layers that are black, but for that one, which is white."""
    painted = replace(prepared, layers=tuple(_painted(device, one, layer) for one in prepared.layers))
    crop = canvas.crop
    with ImageWriter(
        path, crop.width, crop.height, 1, np.uint16, offset=(crop.left, crop.top), named_with=_OPTION
    ) as writer:
        for rows in joint.bands(device, painted, canvas, settings, silent):
            writer.write_rows(rows)


def _painted(device: Device, one: BlendLayer, white: Layer) -> BlendLayer:
    """A layer of 16-bit grey with the same mask and weight, white or black, each pixel in its place."""
    layer = one.layer
    colour = _WHITE if layer is white else np.uint16(0)

    def read(top: int, bottom: int) -> npt.NDArray[Any]:
        alpha = layer.rows(top, bottom)[..., -1:] >= 0.5 * full_scale(layer.dtype)
        return np.concatenate([np.full(alpha.shape, colour), alpha * _WHITE], 2)

    grey = replace(layer, dtype=np.dtype(np.uint16), channels=1, read=read)
    field = one.field.get()
    field[..., :3] = 0
    return replace(one, layer=grey, field=device.upload(field), gain=None, offset=None)


def _weighted(device: Device, layer: BlendLayer, mask: Layer, prepared: Prepared) -> BlendLayer:
    """The layer with the mask as its weight, reduced to the working grid, unless it never weighs anything."""
    field = layer.field.get()
    if (field[..., 3] < 0).all():
        return layer
    spread = _spread(mask, prepared.grid, layer.box)
    reduced = working.reduce_layer(device, spread, prepared.grid, lambda units: None, checked=False)
    weights = reduced.pixels.get()[..., 0]
    field[..., 3] = np.maximum(weights, _LEAST_WEIGHT)
    return replace(layer, field=device.upload(field))


def _spread(mask: Layer, grid: Grid, place: Place) -> Layer:
    """The mask as an opaque grey layer, over all that lies under a place of the grid; read by rows, as it may
    be large. Outside the crop its border is repeated: a working pixel that is not wholly covered would weigh
    nothing.
    """
    region, crop = grid.region, mask.box
    left, top, width, height = place
    box = Box(
        region.left + left * region.width // grid.width,
        region.top + top * region.height // grid.height,
        region.left - (-(left + width) * region.width // grid.width),
        region.top - (-(top + height) * region.height // grid.height),
    )
    columns = np.clip(np.arange(box.left, box.right) - crop.left, 0, crop.width - 1)

    def read(first: int, end: int) -> npt.NDArray[Any]:
        rows = np.clip(np.arange(first, end) + (box.top - crop.top), 0, crop.height - 1)
        above = int(rows[0])
        grey = mask.rows(above, int(rows[-1]) + 1)[rows - above][:, columns, :1]
        return np.concatenate([grey, np.full_like(grey, full_scale(mask.dtype))], 2)

    return Layer(mask.name, box, mask.dtype, 1, read)


def _offset(device: Device, prepared: Prepared) -> Prepared:
    """With offsets for other weights than those they were made for."""
    blended = [one for one in prepared.layers if one.offset is not None]
    if not blended:
        return prepared
    reduced = [
        working.reduce_layer(device, one.layer, prepared.grid, lambda units: None, checked=False)
        for one in blended
    ]
    for one in reduced:
        unit.code(device, one, prepared.light_unit)  # as those are that gains were measured with
    gains = Correction(prepared.gain_grid, prepared.shoulder, tuple(one.gain for one in blended))
    fields = [one.field for one in blended]
    offsets = multiband.offsets(device, reduced, fields, gains, prepared.grid, prepared.unlike)
    found = iter(offsets.layers)
    layers = [one if one.offset is None else replace(one, offset=next(found)) for one in prepared.layers]
    return replace(prepared, layers=tuple(layers))

"""The nouns every step shares: box, canvas, layer.

Frame: canvas pixels, x to the right, y down, origin at the canvas's upper left corner; pixel (x, y)
covers [x, x+1) x [y, y+1), so its centre is at (x + 0.5, y + 0.5).
"""

from __future__ import annotations

import logging
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hugin_abflow.errors import CanvasError, ImageReadError, LayersMismatchError
from hugin_abflow.projection import EQUIRECTANGULAR

_log = logging.getLogger(__name__)

# Rows `top` to `bottom` (exclusive) of a layer: (bottom - top, width, channels + 1), alpha last.
RowReader = Callable[[int, int], npt.NDArray[Any]]


def full_scale(dtype: npt.DTypeLike) -> float:
    """Alpha of an opaque pixel: 255, 65535, or 1.0 for floats."""
    kind = np.dtype(dtype)
    return float(np.iinfo(kind).max) if kind.kind == "u" else 1.0


def native(pixels: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Pixels (height, width, samples), C-contiguous in the machine's byte order; those with NaN or infinity
    are 0, and so transparent.
    """
    stored = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder("="))
    if stored.dtype.kind == "f":
        finite = np.isfinite(stored).all(axis=2, keepdims=True)
        stored = stored if finite.all() else np.where(finite, stored, stored.dtype.type(0))
    return stored


@dataclass(frozen=True)
class Box:
    """A rectangle of canvas pixels; right and bottom are exclusive."""

    left: int
    top: int
    right: int
    bottom: int

    @classmethod
    def at(cls, left: int, top: int, width: int, height: int) -> Box:
        """By its corner and size."""
        return cls(left, top, left + width, top + height)

    @property
    def width(self) -> int:
        """Columns."""
        return self.right - self.left

    @property
    def height(self) -> int:
        """Rows."""
        return self.bottom - self.top

    @property
    def place(self) -> tuple[int, int, int, int]:
        """Its corner and size, as kernels take it."""
        return self.left, self.top, self.width, self.height

    @property
    def slices(self) -> tuple[slice, slice]:
        """Its rows and columns, of an array over what it is a part of."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    def intersect(self, other: Box) -> Box:
        """The common part; its width or height is 0 where there is none."""
        left, top = max(self.left, other.left), max(self.top, other.top)
        return Box(
            left, top, max(left, min(self.right, other.right)), max(top, min(self.bottom, other.bottom))
        )


@dataclass(frozen=True)
class Canvas:
    """The panorama's pixel grid (p-line).

    crop        the part that is output (p-line S).
    wraps       the left and right borders are one (hfov 360 on a projection that wraps).
    spherical   equirectangular: rows are latitudes, columns longitudes; flow and distances are
                calculated on the sphere. Other projections are planes.
    hfov        horizontal field of view in degrees (scale of the sphere: width / hfov px per degree).
    projection  Hugin's number of it (p-line f); -1: not known.
    """

    width: int
    height: int
    crop: Box
    wraps: bool = False
    spherical: bool = False
    hfov: float = 0.0
    projection: int = -1

    @classmethod
    def plane(cls, width: int, height: int, wraps: bool = False) -> Canvas:
        """A flat canvas without crop."""
        return cls(width, height, Box(0, 0, width, height), wraps)

    @classmethod
    def sphere(cls, width: int, height: int, hfov: float = 360.0) -> Canvas:
        """An equirectangular canvas without crop; it wraps if `hfov` is 360 degrees."""
        return cls(width, height, Box(0, 0, width, height), hfov == 360.0, True, hfov, EQUIRECTANGULAR)


@dataclass(frozen=True)
class Layer:
    """One remapped photo: pixels, validity mask and place on the canvas.

    box         where the layer lies on the canvas; its size is the stored image's.
    dtype       uint8, uint16, float16 or float32.
    channels    1 (grey) or 3 (RGB); rows have one more, alpha.
    read        ``read(top, bottom)`` gives rows of the layer (its own row 0 is box.top) as an array
                (bottom - top, box.width, channels + 1) of `dtype`, C-contiguous. Alpha is unassociated;
                a pixel is valid where alpha is at least half of full scale (1.0 for floats). The
                reader is safe to call again and in any order; ascending order is fast. It is called
                from other threads, if `strip` is more than 1 from several at a time. Nobody writes
                into the array, which must not change afterwards: it is read later, too.
    icc         the ICC profile, if any.
    canvas_size (width, height) of the canvas that the layer was made for, if its file tells it.
    file        the file that `read` decodes; None for pixels in memory.
    has_alpha   False for a file without alpha: every pixel is valid.
    strip       rows that `read` decodes together, from row 0 on: it is fastest asked for whole ones.
    compressed  True for a file that is: to read rows again is to decode them again.
    photo       the name of the photo, if the file was made of it for this run alone.
    """

    name: str
    box: Box
    dtype: np.dtype[Any]
    channels: int
    read: RowReader = field(repr=False)
    icc: bytes | None = field(default=None, repr=False)
    canvas_size: tuple[int, int] | None = None
    file: Path | None = None
    has_alpha: bool = True
    strip: int = 1
    compressed: bool = False
    photo: str | None = None

    @property
    def called(self) -> str:
        """What messages call it."""
        return self.photo or self.name

    def rows(self, top: int, bottom: int) -> npt.NDArray[Any]:
        """What `read` gives, which is not trusted: kernels would read beyond it. Raises `ImageReadError`."""
        rows = np.ascontiguousarray(self.read(top, bottom))
        wanted = (bottom - top, self.box.width, self.channels + 1)
        if rows.shape != wanted or rows.dtype != self.dtype:
            raise ImageReadError(
                f"{self.name}: rows {top} to {bottom} are {rows.dtype} of the shape {rows.shape}; its reader "
                f"has to give {self.dtype}, {wanted}"
            )
        return rows

    @property
    def row_bytes(self) -> int:
        """Of one row that `read` gives."""
        return self.box.width * (self.channels + 1) * self.dtype.itemsize

    @classmethod
    def from_array(
        cls, name: str, pixels: npt.NDArray[Any], left: int = 0, top: int = 0, icc: bytes | None = None
    ) -> Layer:
        """A layer from pixels in memory: (height, width, 2 or 4), alpha last.

        Pixels with NaN or infinity are invalid, as in files. Raises `ImageReadError` for another shape
        (colours without alpha, for example), an empty array or a type that layers do not have, and TypeError
        for a place that is no whole number.
        """
        left, top = operator.index(left), operator.index(top)
        if pixels.ndim != 3 or pixels.shape[2] not in (2, 4) or not pixels.size:
            raise ImageReadError(
                f"{name} has the shape {pixels.shape}; give (height, width, 4), RGB and alpha, "
                "or (height, width, 2), grey and alpha"
            )
        if pixels.dtype.name not in ("uint8", "uint16", "float16", "float32"):
            raise ImageReadError(
                f"{name} has samples of type {pixels.dtype}; possible are uint8, uint16, float16, float32"
            )
        height, width, samples = pixels.shape
        stored = native(pixels)
        box = Box.at(left, top, width, height)
        return cls(name, box, stored.dtype, samples - 1, lambda first, last: stored[first:last], icc)


def bounding_box(layers: Sequence[Layer]) -> Box:
    """The smallest box around all layers, at least one."""
    boxes = [layer.box for layer in layers]
    return Box(
        min(box.left for box in boxes),
        min(box.top for box in boxes),
        max(box.right for box in boxes),
        max(box.bottom for box in boxes),
    )


def other_canvas(layer: Layer, canvas: Canvas) -> str | None:
    """The canvas that a layer was made for, as "800x400", if its file tells it and it is another one."""
    size = layer.canvas_size
    return None if size is None or size == (canvas.width, canvas.height) else f"{size[0]}x{size[1]}"


def check_canvas(canvas: Canvas) -> None:
    """Raise `CanvasError` unless the canvas has pixels and its crop is a part of it that has some, too, all
    of whole numbers, and on a sphere a field of view.
    """
    crop = canvas.crop
    edges = (canvas.width, canvas.height, crop.left, crop.top, crop.right, crop.bottom)
    if not all(isinstance(edge, Integral) for edge in edges):
        raise CanvasError(f"canvas and crop have {edges}; give whole numbers of pixels")
    if canvas.spherical and not 0 < canvas.hfov <= 360:
        raise CanvasError(f"the canvas has a field of view of {canvas.hfov} degrees; give up to 360")
    if not (0 <= crop.left < crop.right <= canvas.width and 0 <= crop.top < crop.bottom <= canvas.height):
        raise CanvasError(
            f"the crop of columns {crop.left} to {crop.right} and rows {crop.top} to {crop.bottom} is no "
            f"part of the canvas of {canvas.width}x{canvas.height}; choose one inside that has pixels"
        )


def misfit(layer: Layer, canvas: Canvas) -> str | None:
    """Why it cannot be one of the canvas's layers, in words that follow its name; None if it can."""
    box, size = layer.box, f"{canvas.width}x{canvas.height}"
    if not all(isinstance(edge, Integral) for edge in (box.left, box.top, box.right, box.bottom)):
        return f"lies at {box}, not at whole pixels"
    if not layer.has_alpha:
        return "has no alpha channel, so nothing says where it ends"
    if made_for := other_canvas(layer, canvas):
        return f"was made for a canvas of {made_for}, the project's is {size}"
    if min(box.left, box.top) < 0 or box.right > canvas.width or box.bottom > canvas.height:
        columns, rows = f"{box.left} to {box.right}", f"{box.top} to {box.bottom}"
        return f"covers columns {columns} and rows {rows}, outside the canvas of {size}"
    return None


def check_layers(canvas: Canvas, layers: Sequence[Layer], names: Sequence[str] | None = None) -> None:
    """Raise `LayersMismatchError` unless the layers fit the canvas and each other.

    Alpha, canvas size (where a layer's file tells it), place inside the canvas, depth, number of channels.

    names   what messages call the layers; None: their files.

    Warns of layers whose ICC profile is not that of the first one.
    """
    if not layers:
        return
    again = "make the layers again with nona, or leave the file out"
    called = names or [str(layer.file or layer.name) for layer in layers]
    first, first_name, others = layers[0], Path(called[0]).name, []
    for layer, name in zip(layers, called, strict=True):
        if why := misfit(layer, canvas):
            raise LayersMismatchError(f"{name} {why}; {again}")
        if layer.dtype != first.dtype:
            raise LayersMismatchError(
                f"{name} has {layer.dtype} samples, {first_name} has {first.dtype}; {again}"
            )
        if layer.channels != first.channels:
            kinds = {1: "grey", 3: "RGB"}
            raise LayersMismatchError(
                f"{name} is {kinds[layer.channels]}, {first_name} is {kinds[first.channels]}; {again}"
            )
        others += [name] if layer.icc != first.icc else []
    if others:
        _log.warning(
            "ICC profiles other than that of %s: %s; colours are not converted, and the panorama has that of "
            "its first layer, if there is one",
            called[0], ", ".join(others),
        )  # fmt: skip

"""What nona's failures mean: which photo is to blame, and what to do."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hugin_abflow import pto
from hugin_abflow.errors import (
    AbflowError,
    ImageReadError,
    LayersMismatchError,
    NonaFailedError,
    ProjectError,
)
from hugin_abflow.exif import read_exif
from hugin_abflow.formats import foreign_format
from hugin_abflow.images import image_size, read_layers
from hugin_abflow.layer import other_canvas
from hugin_abflow.programs import ending, last_lines
from hugin_abflow.project import Plan, PlannedImage
from hugin_abflow.targets import named_in_unicode
from hugin_abflow.tifftags import MAIN

# What libpng, libjpeg and OpenEXR say of a photo that they cannot decode to its end.
_UNDECODED = re.compile(r"error in (?:png|jpeg)_\w+\(\)|Error reading pixel data")
# What it says of a TIFF that it does not begin to read, before it says which it loads.
_REFUSED = re.compile(r"^\s*TIFFDecoder: (.+)", re.MULTILINE)
_TILE_WIDTH = 322
# What it says of photos of two depths, or of grey ones beside coloured ones.
_DIFFERENT = re.compile("uses [A-Z0-9]+ valued pixel, while|has [0-9] channels?, while")

# What libtiff says, other than warnings, of pixels that it cannot give. nona remaps the photo as if it had
# them, and ends with success.
_LOSS = re.compile(
    r"scanline decoding is not implemented|compression support is not configured|"
    r": Read error on |: Sample out of range"
    r"|^(?:\w+Decode(?!r)\w*|JPEGLib|TIFFReadScanline|TIFFRead\w+Strip|TIFFFillStrip): (?!Warning)"
)
# Where one of these is in such a line the photo is not damaged: what is the matter instead. (A planar photo,
# Photoshop's "per channel", stores all of red, then all of green; nona asks for a channel that no row has.)
_UNKNOWN = "is compressed in a way that Hugin does not know; save it with another compression, such as LZW"
_MISREAD = {
    "scanline decoding is not implemented": _UNKNOWN,
    "compression support is not configured": _UNKNOWN,
    ": Sample out of range": "has its channels one after the other (planar), which Hugin misreads; save it "
    "with interleaved channels",
    "downsampled JPEG": "is compressed as JPEG in a way that Hugin misreads; save it with another "
    "compression, such as LZW",
}


def loss(photo: Path, line: str) -> ImageReadError | None:
    """What to raise where nona says this while it loads a photo; None where nothing is lost."""
    if not _LOSS.search(line):
        return None
    for mark, why in _MISREAD.items():
        if mark in line:
            return ImageReadError(f"{photo} {why}, under the same name")
    return _damaged(photo, line.strip())


def _damaged(photo: Path, said: str) -> ImageReadError:
    return ImageReadError(f"{photo} is damaged ({said}); copy it from the camera again")


def failure(
    plan: Plan, images: Sequence[PlannedImage], folder: Path, code: int, lines: list[str]
) -> AbflowError:
    """What to raise for a run of nona over `images` that failed; it does not always say which is to blame."""
    said = last_lines(lines)
    for image in images:
        if any(f"Unable to open file '{name}'" in said for name in (image.name, image.photo)):
            return ImageReadError(f"{image.photo} cannot be opened; check its permissions")
    images = [image for image in images if named_in_unicode(image.photo)]  # else they cannot be opened here
    if "did not find a matching file type" in said:
        for image in images:
            if foreign := foreign_format(image.photo):
                return ImageReadError(
                    f"{image.photo} is {foreign}, which Hugin does not read; convert it to JPEG or TIFF, and "
                    "align the project with that"
                )
            if image_size(image.photo) is None:
                return ImageReadError(
                    f"{image.photo} is no image that can be read; copy it from the camera again"
                )
    if refused := _REFUSED.search(said):
        if "tiled" in refused[1]:
            for image in images:
                if _TILE_WIDTH in read_exif(image.photo).get(MAIN, {}):
                    return ImageReadError(
                        f"{image.photo} is a TIFF in tiles, which Hugin does not read; save the project's "
                        "photos without tiles, under the same names"
                    )
        return ImageReadError(
            f"{plan.file} has a photo in TIFF of a kind that Hugin does not read ({refused[1].strip()}); "
            "save its photos as plain TIFF of 8 or 16 bit, under the same names"
        )
    loads = [line.removeprefix("loading ") for line in lines if line.startswith("loading ")]
    if loads and (line := next(filter(_UNDECODED.search, lines), None)):
        return _damaged(plan.folder / loads[-1], line)
    if "unexpectedly changed dimensions" in said:
        project = pto.load(plan.file)
        for image in images:
            size, aligned = image_size(image.photo), project.images[image.index]
            wanted = aligned.width, aligned.height
            if size and all(wanted) and size != wanted:  # nona looks for itself where it is 0
                return ProjectError(
                    f"{image.photo} has {size[0]}x{size[1]} pixels, in {plan.file} it has "
                    f"{wanted[0]}x{wanted[1]}; put that photo back, or align this one in Hugin"
                )
    if _DIFFERENT.search(said):
        return LayersMismatchError(
            f"{plan.file}: photos differ in depth or in colour channels; give all the same, such as "
            f"8 bit RGB, under the same names. nona's last lines:\n  {said}"
        )
    advice = f"it wrote into {folder.parent}, TMPDIR chooses another folder"
    if "bad_alloc" in said:
        advice = "it had not enough memory: close other programs, or make the panorama smaller in Hugin"
    return NonaFailedError(f"nona {ending(code)} on {plan.file}; {advice}. Its last lines:\n  {said}")


def check_made(plan: Plan, made: dict[int, Path]) -> None:
    """Look at layers that nona made with success, and may be of no use all the same.

    made    layers by images; all have samples of one kind, and were made for one canvas.

    Raises `LayersMismatchError` if that is another canvas than the project's; `ImageReadError` if samples are
    of a kind that no layer may have (nona keeps that of photos), or nona took floats for whole numbers.
    """
    if not made:
        return
    photos = {image.index: image.photo for image in plan.images}
    index, path = next(iter(made.items()))
    try:
        layer = read_layers(path)[0]
    except ImageReadError as error:
        if image_size(path) is None:
            raise
        # the layer will go, and has what its photo has
        raise ImageReadError(
            f"{str(error).replace(str(path), str(photos[index]))}; convert the photos of the project to one "
            "of these, such as 16 bit, under the same names"
        ) from None
    if layer.dtype == np.uint16:
        for photo in (photos[index] for index in made):
            if _has_half_floats(photo):
                raise ImageReadError(
                    f"{photo} has 16 bit floats, which Hugin takes for whole numbers: far too dark; convert "
                    "the photos of the project to 16 bit whole numbers or 32 bit floats, under the same names"
                )
    if made_for := other_canvas(layer, plan.canvas):
        raise LayersMismatchError(
            f"{plan.file}: the canvas is {plan.canvas.width}x{plan.canvas.height}, of which Hugin makes "
            f"{made_for}, since this projection shows no more; open the project in Hugin, which corrects "
            "that, and save it"
        )


def _has_half_floats(photo: Path) -> bool:
    """Whether the samples of a photo are 16 bit floats; false where it cannot be opened here."""
    try:
        return read_layers(photo)[0].dtype == np.float16
    except ImageReadError:
        return False

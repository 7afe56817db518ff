"""What nona's failures mean: which photo is to blame, and what to do."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from hugin_abflow import pto
from hugin_abflow.errors import (
    AbflowError,
    ImageReadError,
    LayersMismatchError,
    NonaFailedError,
    ProjectError,
)
from hugin_abflow.formats import foreign_format
from hugin_abflow.images import image_size, read_layers
from hugin_abflow.layer import other_canvas
from hugin_abflow.programs import ending, last_lines
from hugin_abflow.project import Plan, PlannedImage
from hugin_abflow.targets import named_in_unicode

# What it says of photos of two depths, or of grey ones beside coloured ones.
_DIFFERENT = re.compile("uses [A-Z0-9]+ valued pixel, while|has [0-9] channels?, while")


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
    """Raise `LayersMismatchError` if nona made layers for another canvas than the project's, and
    `ImageReadError` if of photos whose samples it keeps, though no layer can have such.

    made    its layers by images; all are of one kind, and made for one canvas.
    """
    for index, path in list(made.items())[:1]:
        try:
            layer = read_layers(path)[0]
        except ImageReadError as error:
            if image_size(path) is None:
                raise
            # the layer will go, and has what its photo has
            (photo,) = (image.photo for image in plan.images if image.index == index)
            raise ImageReadError(
                f"{str(error).replace(str(path), str(photo))}; convert the photos of the project to one of "
                "these, such as 16 bit, under the same names"
            ) from None
        if made_for := other_canvas(layer, plan.canvas):
            raise LayersMismatchError(
                f"{plan.file}: the canvas is {plan.canvas.width}x{plan.canvas.height}, of which Hugin makes "
                f"{made_for}, since this projection shows no more; open the project in Hugin, which corrects "
                "that, and save it"
            )

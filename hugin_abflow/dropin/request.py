"""What an enblend command line asks for."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from hugin_abflow.dropin.arguments import Option, expand, parse
from hugin_abflow.encoding import COMPRESSIONS
from hugin_abflow.errors import CommandLineError
from hugin_abflow.layer import Box

_PROJECT = "abflow-project="
_MASKS = "mask-%n.tif"
_DEPTHS: dict[str, npt.DTypeLike] = {
    "8": np.uint8,
    "16": np.uint16,
    "r32": np.float32,
    "float": np.float32,
    "r64": np.float64,
    "double": np.float64,
}


@dataclass(frozen=True)
class Request:
    """One run.

    inputs          the layers' files.
    lists           response files that name them.
    output          the panorama's; its ending is its type.
    crop            canvas pixels that are output; None: all that the layers cover.
    wraps           the canvas's left and right border are one.
    depth           samples of the output; None: the layers'.
    compression     of a TIFF; None: default.
    jpeg_quality    1..100; None: default.
    verbosity       0: warnings; 1: the phases too; 2 and more: everything.
    save_masks, load_masks    templates of the masks' names, see `weights.name`.
    project         the Hugin project that the layers were made of.
    answer          what is wanted instead of a panorama.
    ignored         options that are understood and change nothing.
    """

    inputs: tuple[Path, ...] = ()
    lists: tuple[Path, ...] = ()
    output: Path = Path("a.tif")
    crop: Box | None = None
    wraps: bool = False
    depth: npt.DTypeLike | None = None
    compression: str | None = None
    jpeg_quality: int | None = None
    verbosity: int = 1
    save_masks: str | None = None
    load_masks: str | None = None
    project: Path | None = None
    answer: Literal["help", "version"] | None = None
    ignored: tuple[str, ...] = ()


# What an option with its value makes of a request.
_Meaning = Callable[[Request, str], Request]


def _output(request: Request, value: str) -> Request:
    if not value:
        raise CommandLineError("--output needs the name of a file")
    return replace(request, output=Path(value))


def _crop(request: Request, value: str) -> Request:
    # enblend's help has +xXOFFSET+yYOFFSET; it takes that, but leaves the offsets out
    found = re.fullmatch(r"(\d{1,9})x(\d{1,9})(?:\+x?(\d{1,9})\+y?(\d{1,9}))?", value)
    width, height, left, top = (int(number or 0) for number in found.groups()) if found else (0, 0, 0, 0)
    if not width or not height:
        raise CommandLineError(f"-f {value}: give WIDTHxHEIGHT or WIDTHxHEIGHT+X+Y in pixels")
    return replace(request, crop=Box.at(left, top, width, height))


def _wrap(request: Request, value: str) -> Request:
    mode = value.lower() or "horizontal"
    if mode in ("vertical", "both", "horizontal+vertical", "vertical+horizontal"):
        raise CommandLineError(
            f"--wrap={mode} is not possible: only the left and right border can be one; "
            "leave it out, or use enblend for this panorama"
        )
    if mode not in ("none", "open", "horizontal"):
        raise CommandLineError(f"--wrap={value}: choose none or horizontal")
    return replace(request, wraps=mode == "horizontal")


def _depth(request: Request, value: str) -> Request:
    if value.lower() not in _DEPTHS:
        raise CommandLineError(f"--depth={value} is not possible; choose 8, 16, r32 or r64")
    return replace(request, depth=_DEPTHS[value.lower()])


def _compression(request: Request, value: str) -> Request:
    """A TIFF's by name; JPEG's quality as a number or behind ``jpeg``."""
    name, _, quality = value.lower().partition(":")
    if name.isdecimal() and not quality:
        name, quality = "jpeg", name
    if name in ("jpeg", "jpeg-arith") and re.fullmatch(r"\d{0,9}", quality):
        chosen = max(1, min(100, int(quality))) if quality else request.jpeg_quality
        return replace(request, compression="jpeg", jpeg_quality=chosen)
    if name not in COMPRESSIONS["TIFF"] or quality:
        offered = ", ".join(COMPRESSIONS["TIFF"])
        raise CommandLineError(f"--compression={value}: choose {offered}, or 0 to 100 for JPEG")
    return replace(request, compression=name)


def _levels(request: Request, value: str) -> Request:
    if not re.fullmatch(r"auto|[+-]?\d+", value.lower()):
        raise CommandLineError(f"--levels={value}: choose a whole number or auto")
    return request if value.lower() == "auto" else _ignore("--levels")(request, value)


def _verbose(request: Request, value: str) -> Request:
    if not re.fullmatch(r"(-?\d{1,9})?", value):
        raise CommandLineError(f"--verbose={value}: choose a whole number")
    return replace(request, verbosity=max(0, int(value)) if value else request.verbosity + 1)


def _parameter(request: Request, value: str) -> Request:
    """A project's name is all that follows, since it may hold the colon that parts parameters."""
    before, ours, project = value.partition(_PROJECT)
    if ours and not project:
        raise CommandLineError(f"--parameter={value}: name the project, --parameter={_PROJECT}FILE")
    request = replace(request, project=Path(project)) if ours else request
    return _ignore("--parameter")(request, before) if before or not ours else request


def _save_masks(request: Request, value: str) -> Request:
    return replace(request, save_masks=value or _MASKS)


def _load_masks(request: Request, value: str) -> Request:
    return replace(request, load_masks=value or _MASKS)


def _layers(request: Request, value: str) -> Request:
    return request if value.lower() == "all-layers" else _ignore("--layer-selector")(request, value)


def _same(request: Request, value: str) -> Request:
    """What it asks for is so anyway: layers that do not overlap change nothing of each other."""
    return request


def _ignore(name: str) -> _Meaning:
    return lambda request, value: replace(request, ignored=(*request.ignored, name))


def _version(request: Request, value: str) -> Request:
    return replace(request, answer="version")


def _help(request: Request, value: str) -> Request:
    return replace(request, answer="help")


_MEANINGS: dict[Option, _Meaning] = {
    Option(("-o", "--output"), "required"): _output,
    Option(("-f",), "required"): _crop,
    Option(("-w", "--wrap"), "optional"): _wrap,
    Option(("-d", "--depth"), "required"): _depth,
    Option(("--compression",), "required"): _compression,
    Option(("-l", "--levels"), "required"): _levels,
    Option(("-v", "--verbose"), "optional"): _verbose,
    Option(("-a", "--pre-assemble")): _same,
    Option(("--no-pre-assemble",)): _same,
    Option(("--layer-selector",), "required"): _layers,
    Option(("--parameter",), "required"): _parameter,
    Option(("--save-masks",), "optional"): _save_masks,
    Option(("--load-masks",), "optional"): _load_masks,
    Option(("-h", "--help")): _help,
    Option(("-V", "--version")): _version,
    Option(("--show-globbing-algorithms",)): _version,
    Option(("--show-image-formats",)): _version,
    Option(("--show-signature",)): _version,
    Option(("--show-software-components",)): _version,
}
# enblend's others; what they are about does not exist here.
_IGNORED = [
    *(Option((f"-{letter}",)) for letter in "xgsz"),
    *(Option((f"-{letter}",), "required") for letter in "bm"),
    Option(("-c", "--ciecam")),
    *(
        Option((name,))
        for name in (
            "--no-ciecam", "--fine-mask", "--optimize", "--no-optimize", "--gpu", "--no-gpu"
        )
    ),
    *(Option((name,), "optional") for name in ("--coarse-mask", "--visualize")),
    *(
        Option((name,), "required")
        for name in (
            "--blend-colorspace", "--fallback-profile", "--primary-seam-generator", "--image-difference",
            "--optimizer-weights", "--mask-vectorize", "--anneal", "--dijkstra", "--no-parameter",
            "--prefer-gpu",
        )
    ),
]  # fmt: skip
OPTIONS = _MEANINGS | {option: _ignore(option.names[-1]) for option in _IGNORED}

HELP = """\
Usage: abflow-enblend [options] [--output=IMAGE] INPUT...
Blend INPUT images into a single IMAGE, by optical flow; called as enblend 4.2 is.

INPUT... are the layers that nona makes, or @LIST: a file with a name on each line, or a pattern
behind a line "#glob: wildcard".

  -o, --output=FILE      write output to FILE; default: "a.tif"
  -f WIDTHxHEIGHT[+X+Y]  size and position of the output; default: all that the layers cover
  -w, --wrap[=MODE]      "horizontal" (also without MODE): left and right border are one; "none"
  -d, --depth=DEPTH      samples of the output: 8, 16, r32, r64; default: as the layers'
  --compression=NAME     TIFF: none, packbits, lzw, deflate, zstd, jpeg; JPEG: quality, 0 to 100
  -v, --verbose[=LEVEL]  0: warnings only; 1: phases (default); 2: say what is done
  --save-masks[=NAME]    write each layer's weight; NAME may hold %n (number), %i (index), %f (the layer's
                         name), %d (its folder), %b (its file), %p (its path), %e (its ending), and the same
                         in capitals for the output; default: "mask-%n.tif"
  --load-masks[=NAME]    use such masks as weights
  --parameter=abflow-project=FILE
                         the Hugin project of the layers: its projection and control points are used
  -h, --help             print this and exit
  -V, --version          print the version and exit

enblend's other options are accepted and change nothing.
"""


def read_command_line(arguments: Sequence[str]) -> Request:
    """The request in a command line without the program's name.

    Raises `CommandLineError` for what enblend would not understand or do, or no inputs; `LayersMissingError`
    for a response file that cannot be read.
    """
    given, files = parse(arguments, list(OPTIONS))
    request = Request()
    for option, value in given:
        request = OPTIONS[option](request, value or "")
    if request.answer:
        return request
    if request.save_masks and request.load_masks:
        # by their default names, what somebody painted would be lost
        raise CommandLineError("--save-masks and --load-masks exclude each other; give one of them")
    inputs, lists = expand(files)
    if not inputs:
        raise CommandLineError("no input files; name the layers that are to be blended")
    return replace(request, inputs=tuple(inputs), lists=tuple(lists))

"""What a Hugin project asks for: canvas, active images, output."""

from __future__ import annotations

import logging
import os
import unicodedata
from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath

from hugin_abflow import pto
from hugin_abflow.errors import ProjectError
from hugin_abflow.exif import is_photo
from hugin_abflow.layer import Box, Canvas
from hugin_abflow.projection import EQUIRECTANGULAR
from hugin_abflow.scratch import is_file, is_pipe

_log = logging.getLogger(__name__)

SINUSOIDAL = 7

# Output projections whose columns are meridians, so that at 360 degrees the right border continues in
# the left one, row by row: cylindrical, equirectangular, Mercator, Lambert's cylindrical equal-area,
# Miller, architectural (Miller above the horizon, Lambert below). Found by remapping a smooth sphere
# with nona at hfov 360 in all 22 projections: in these six the step from the last to the first column
# is that between neighbours, in every row. Sinusoidal, Albers and Hammer-Aitoff have curved borders,
# the others none that meet. Hugin passes -w to enblend for all of them.
WRAPPING = frozenset({1, 2, 5, 8, 11, 13})

# libpano's names of output projections, by the p-line's f.
_PROJECTIONS = (
    "rectilinear", "cylindrical", "equirectangular", "fisheye", "stereographic", "Mercator",
    "transverse Mercator", "sinusoidal", "Lambert cylindrical equal-area", "Lambert azimuthal equal-area",
    "Albers conic equal-area", "Miller cylindrical", "Panini", "architectural", "orthographic", "equisolid",
    "equirectangular Panini", "biplane", "triplane", "general Panini", "Thoby", "Hammer-Aitoff",
)  # fmt: skip

_ENDINGS = {"tif": ".tif", "tiff": ".tif", "jpg": ".jpg", "jpeg": ".jpg", "png": ".png", "exr": ".exr"}
TIFF_COMPRESSIONS = ("none", "lzw", "packbits", "deflate")  # of Hugin, enblend and enfuse
_DOUBTS_SHOWN = 5
_JPEG_QUALITY = 100  # what hugin_executor takes where a project says nothing


@dataclass(frozen=True)
class PlannedImage:
    """One active image.

    index       its number in the project, from 0; nona puts it into the layer's name.
    name        the photo's name as the project writes it.
    photo       where the photo is (see `locate_photo`); it need not exist.
    """

    index: int
    name: str
    photo: Path


@dataclass(frozen=True)
class Output:
    """How the project wants its panorama stored.

    ending          of the file: .tif, .jpg, .png or .exr.
    compression     of a TIFF: none, lzw, packbits or deflate; None: not said.
    jpeg_quality    1..100.
    """

    ending: str
    compression: str | None
    jpeg_quality: int


@dataclass(frozen=True)
class Plan:
    """What a project asks for; see `read_plan`.

    file            the project file, absolute.
    canvas          the panorama's pixel grid; its crop is what is output.
    projection      of the canvas, in words.
    images          active images in the project's order.
    photos          where all photos of the project are, those of images that are not active too: inputs.
    output          type of the panorama's file.
    hdr             layers are scene-linear EXR (nona ``-r hdr``) instead of TIFF in the photos' depth.
    ignore_exposure layers keep their photos' exposure (nona ``--ignore-exposure``), to be fused.
    hugin_prefix    what Hugin names layers and panorama by default: "first image - last image".
    doubts          lines of the project that are left out, in sentences.
    """

    file: Path
    canvas: Canvas
    projection: str
    images: tuple[PlannedImage, ...]
    photos: tuple[Path, ...]
    output: Output
    hdr: bool
    hugin_prefix: str
    doubts: tuple[str, ...] = ()
    ignore_exposure: bool = False

    @property
    def folder(self) -> Path:
        """The project's folder: relative names begin here."""
        return self.file.parent

    @property
    def stem(self) -> str:
        """The project's name without .pto; Hugin's temporary projects have no ending to lose."""
        return self.file.stem if self.file.suffix.lower() == ".pto" else self.file.name

    def layer_prefix(self, name: str) -> str:
        """What comes before the numbers of layers, as Hugin has it, from a panorama's name without ending."""
        if self.hdr:
            return f"{name}_hdr_"
        return f"{name}_exposure_layers_" if self.ignore_exposure else name

    @property
    def layer_ending(self) -> str:
        """Of nona's layers."""
        return ".exr" if self.hdr else ".tif"

    def default_output(self, taken: Iterable[Path] = (), suffix: str = "") -> Path:
        """Beside the project, named after it: ``pano.pto`` -> ``pano.tif``.

        If that is a photo, of the project or as its EXIF tells, or one of `taken` (the layers' files),
        ``pano_abflow.tif``, then ``pano_abflow2.tif`` and so on: neither inputs nor photos are ever replaced.
        suffix: what follows the project's name, as of fused panoramas.
        """
        inputs = {file_key(path) for path in [*self.photos, *taken]}
        name = f"{self.stem}{suffix}"
        path, attempt = self.folder / f"{name}{self.output.ending}", 0
        while file_key(path) in inputs or is_photo(path):
            attempt += 1
            another = "_abflow" if attempt == 1 else f"_abflow{attempt}"
            path = self.folder / f"{name}{another}{self.output.ending}"
        return path


def read_plan(path: Path | str) -> Plan:
    """Read a project and decide what it asks for.

    Raises `pto.PtoError` for a file that is no project, `ProjectError` for one that makes no panorama:
    no active image, an empty crop; and for a pipe.
    """
    file = Path(path).absolute()
    if is_pipe(file):
        raise ProjectError(
            f"{path} is a pipe, which can be read but once, and a project is read several times, by nona as "
            "well; save it as a file, beside its photos"
        )
    project = pto.load(file)
    names = [image.filename for image in project.images]
    photos = tuple(_photo_of(file, name) for name in names)
    images = tuple(
        PlannedImage(image.index, image.filename, photo)
        for image, photo in zip(project.images, photos, strict=True)
        if not image.disabled
    )
    if not images:
        raise ProjectError(f"{file} has no active image; enable at least one in Hugin's photos list")
    hdr = _is_hdr(project)
    return Plan(
        file=file,
        canvas=_canvas(file, project.panorama),
        projection=_projection(project.panorama.projection),
        images=images,
        photos=photos,
        output=read_output(project, hdr),
        hdr=hdr,
        hugin_prefix=f"{_stem(names[0])} - {_stem(names[-1])}",
        doubts=tuple(project.doubts),
    )


def warn_of_doubts(plan: Plan) -> None:
    """Say which lines of the project are left out, of many only how many: once in a run."""
    for doubt in plan.doubts[:_DOUBTS_SHOWN]:
        _log.warning("%s", doubt)
    others = len(plan.doubts) - _DOUBTS_SHOWN
    if others > 0:
        _log.warning("%s: %d more such lines are left out", plan.file, others)


def _photo_of(file: Path, name: str) -> Path:
    """Where a photo of a project is: as `locate_photo` has it, also beside the file that a link leads to.

    /dev/stdin is a link as well, but panoramas do not belong beside it.
    """
    photo = locate_photo(file.parent, name)
    if file.suffix.lower() == ".pto" and file.is_symlink() and not is_file(photo):
        other = locate_photo(Path(os.path.realpath(file)).parent, name)
        return other if is_file(other) else photo
    return photo


def locate_photo(folder: Path, name: str) -> Path:
    """Where a photo is: relative to the project's folder unless absolute, as in Hugin.

    What is not there is also looked for with Windows' separators and, as Hugin's GUI does for moved
    projects, under its bare name beside the project; then at these places under a name that Windows or macOS
    takes for the same (see `_alike`). If nothing exists: where Hugin expects it, beside the project if that
    is a place on Windows.
    """
    expected = folder / name
    windows = PureWindowsPath(name)
    bare = folder / windows.name if windows.name else expected
    moved = bare if windows.is_absolute() or windows.drive else folder.joinpath(*windows.parts)
    for candidate in (expected, moved, bare):
        if is_file(candidate):
            return candidate
    for candidate in dict.fromkeys((expected, moved, bare)):
        alike = _alike(candidate)
        if alike and is_file(alike):
            return alike
    return bare if windows.drive and not Path(name).is_absolute() else expected


def _alike(path: Path) -> Path | None:
    """What differs from a path by case, or by how accents are coded, alone; none if several do, or nothing.

    Projects come from where such names are one, and photos from cards, whose names some systems show in
    small letters.
    """
    found = Path(path.anchor)
    for part in path.parts[1:] if path.anchor else path.parts:
        if os.path.lexists(found / part):
            found /= part
            continue
        try:
            wanted = _folded(part)
            others = [name for name in os.listdir(found) if _folded(name) == wanted]  # noqa: PTH208
        except (OSError, ValueError):
            return None
        if len(others) != 1:
            return None
        found /= others[0]
    return found


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def _canvas(file: Path, panorama: pto.Panorama) -> Canvas:
    """The p-line's canvas with its crop."""
    width, height, projection = panorama.width, panorama.height, panorama.projection
    # Hugin (PanoramaOptions::setWidth) makes these two even, and so do nona's layers
    if projection in (EQUIRECTANGULAR, SINUSOIDAL):
        width += width % 2
    whole = Box(0, 0, width, height)
    crop = whole
    if panorama.crop is not None:
        crop = whole.intersect(Box(*panorama.crop))
        if not crop.width or not crop.height:
            left, top, right, bottom = panorama.crop
            raise ProjectError(
                f"{file}: the crop (left {left}, top {top}, right {right}, bottom {bottom}) holds nothing of "
                f"the {width}x{height} canvas; set it anew in Hugin's stitcher tab"
            )
    wrapping = projection in WRAPPING
    hfov = min(panorama.hfov, 360.0) if wrapping else panorama.hfov  # as Hugin does
    spherical = projection == EQUIRECTANGULAR
    return Canvas(width, height, crop, wrapping and hfov == 360.0, spherical, hfov, projection)


def _projection(number: int) -> str:
    return _PROJECTIONS[number] if 0 <= number < len(_PROJECTIONS) else f"projection {number}"


def _is_hdr(project: pto.Project) -> bool:
    """Whether the HDR panorama is what Hugin would stitch; the ordinary one counts if both are."""
    blended_hdr, blended_ldr = (
        project.option(f"output{kind}Blended", "").strip().lower() for kind in ("HDR", "LDR")
    )
    if not blended_hdr and not blended_ldr:
        return bool(project.panorama.hdr)  # a script older than these options: what the p-line says
    return blended_hdr == "true" and blended_ldr != "true"


def read_output(project: pto.Project, hdr: bool) -> Output:
    """How panoramas are stored, HDR ones or others.

    From the #hugin_output lines; from the p-line's n where there are none (PanoTools scripts).
    """
    words = (project.panorama.output_format or "").split()
    from_n = words[0].partition("_")[0].lower() if words else ""
    letters = {word[:1]: word[1:].removeprefix(":") for word in words[1:]}  # c:LZW r:CROP q95
    kind = project.option("outputImageTypeHDR" if hdr else "outputImageType", "").strip().lower()
    default = "exr" if hdr else "tif"
    compression = project.option(f"outputImageType{'HDR' if hdr else ''}Compression", "").strip()
    compression = (compression or letters.get("c", "")).lower()
    quality = project.option("outputJPEGQuality", "").strip() or letters.get("q", "")
    ending = _ENDINGS.get(kind) or (not hdr and _ENDINGS.get(from_n)) or _ENDINGS[default]
    return Output(
        ending=ending,
        # Hugin's GUI writes TIFF's compression beside any type, LZW for EXR too
        compression=compression if ending == ".tif" and compression in TIFF_COMPRESSIONS else None,
        jpeg_quality=int(min(100, max(1, float(quality)))) if quality.isdecimal() else _JPEG_QUALITY,
    )


def _stem(name: str) -> str:
    """A photo's name without folder and ending."""
    return PureWindowsPath(name).stem


def file_key(path: Path) -> Hashable:
    """Equal for names of one file: by way of links or ``..``, and where the file system ignores case.

    What is not there has nothing but its name, and that may be any file's in which letters differ by case.
    """
    try:
        found = path.stat()
    except OSError:
        return os.path.realpath(path).casefold()
    return found.st_dev, found.st_ino

"""What a panorama's file says of it: camera, date, place, title of its first photo, and what viewers need."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Callable
from importlib import metadata as packages
from pathlib import Path

from hugin_abflow import caption, pto
from hugin_abflow.exif import (
    SOFTWARE,
    Metadata,
    comment,
    comment_of,
    is_ours,
    read_exif,
    read_packets,
    software,
    text,
    text_of,
)
from hugin_abflow.layer import Canvas
from hugin_abflow.oneline import one_line
from hugin_abflow.project import Plan
from hugin_abflow.scratch import is_file
from hugin_abflow.tifftags import EXIF, GPS, LONG, MAIN, RATIONAL, SHORT, UNDEFINED, Value

PROGRAM = "hugin-abflow"

_log = logging.getLogger(__name__)

_USER_COMMENT = 37510
_LATITUDE = 2  # cameras without a receiver tell but the version of GPS's tags
# What EXIF must have: versions of Exif and Flashpix, width and height, 150 dpi as enblend writes it.
_VERSIONS = {36864: Value(UNDEFINED, b"0232"), 40960: Value(UNDEFINED, b"0100")}
_SIZE = (40962, 40963)
_DPI = Value(RATIONAL, (150).to_bytes(4, "little") + (1).to_bytes(4, "little"))
_RESOLUTION = {282: _DPI, 283: _DPI, 296: Value(SHORT, b"\2\0")}
# What is copied: the tags that Hugin copies, and lens, time zone and fractions of seconds. What tells how one
# photo was taken is left out, such as its focal length: programs calculate the field of view from it.
_COPIED = {
    MAIN: (
        270,  # ImageDescription
        271,  # Make
        272,  # Model
        306,  # DateTime, which exiftool calls ModifyDate
        315,  # Artist
        318,  # WhitePoint
        33432,  # Copyright
    ),
    EXIF: (
        *(36867, 36868),  # DateTimeOriginal, DateTimeDigitized
        *(36880, 36881, 36882),  # their time zones
        *(37520, 37521, 37522),  # their fractions of seconds
        40961,  # ColorSpace
        *(42032, 42033),  # CameraOwnerName, BodySerialNumber
        *(42034, 42035, 42036, 42037),  # LensSpecification, LensMake, LensModel, LensSerialNumber
    ),
}
# What stands for it in XMP, where a program has left no EXIF; IPTC has become XMP by then.
_IN_XMP: dict[int, dict[int, tuple[tuple[str, str], ...]]] = {
    MAIN: {
        270: ((caption.TIFF, "ImageDescription"), (caption.DC, "description")),
        271: ((caption.TIFF, "Make"),),
        272: ((caption.TIFF, "Model"),),
        315: ((caption.TIFF, "Artist"), (caption.DC, "creator")),
        33432: ((caption.TIFF, "Copyright"), (caption.DC, "rights")),
    },
    EXIF: {
        36867: ((caption.EXIF, "DateTimeOriginal"), (caption.PHOTOSHOP, "DateCreated")),
        36868: ((caption.EXIF, "DateTimeDigitized"), (caption.XMP, "CreateDate")),
    },
}
_DATES = (36867, 36868)
_DATE = re.compile(r"(\d{4})-(\d\d)-(\d\d)T(\d\d:\d\d)(:\d\d)?")

# Vertical field of view, in degrees, from the horizontal one and height / width; by the p-line's f.
_VERTICAL: dict[int, Callable[[float, float], float]] = {
    0: lambda hfov, ratio: 2 * math.atan(ratio * math.tan(hfov / 2)),
    1: lambda hfov, ratio: 2 * math.atan(ratio * hfov / 2),
    2: lambda hfov, ratio: hfov * ratio,
    3: lambda hfov, ratio: hfov * ratio,
    4: lambda hfov, ratio: 4 * math.atan(ratio * math.tan(hfov / 4)),
    5: lambda hfov, ratio: 2 * math.atan(math.sinh(ratio * hfov / 2)),
}

_XMP = """\
<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
{}
 </rdf:RDF>
</x:xmpmeta>
<?xpacket end="w"?>"""
_GPANO = """\
  <rdf:Description rdf:about="" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/">
{}
  </rdf:Description>"""


def version() -> str:
    """The version of the installed package."""
    try:
        return packages.version(PROGRAM)
    except packages.PackageNotFoundError:
        return "(run from its source, not installed)"


def describe(plan: Plan) -> Metadata:
    """The metadata of a project's panorama, as Hugin has exiftool write them, but for what is said above.

    EXIF of the first active photo, Software, and a UserComment that goes on from the photo's; what people say
    of it in XMP and IPTC, which Hugin loses (see `caption`); GPano (Google's Photo Sphere XMP) where the
    panorama is equirectangular. A photo that is not there or tells nothing leaves only what the project
    tells. Raises `pto.PtoError` as `pto.load` does.
    """
    photo = plan.images[0].photo
    is_there = is_file(photo)
    found = read_exif(photo) if is_there else {}
    said_in_xmp = caption.read_caption(photo, read_packets(photo)) if is_there else {}
    if is_there and not found:
        _log.info("%s: no EXIF to copy into the panorama", photo)
    chosen = {
        directory: {tag: found[directory][tag] for tag in tags if tag in found.get(directory, {})}
        for directory, tags in _COPIED.items()
    }
    for directory, tags in _IN_XMP.items():
        for tag, names in tags.items():
            told = _from_xmp(said_in_xmp, tag, names)
            if told and not text_of(chosen[directory].get(tag, text(""))):  # cameras leave blanks
                chosen[directory][tag] = text(told)
    chosen[MAIN][SOFTWARE] = text(f"{PROGRAM} {version()}")
    said = comment_of(found.get(EXIF, {}).get(_USER_COMMENT))
    said = said or caption.plain(said_in_xmp.get(f"{{{caption.EXIF}}}UserComment"))
    chosen[EXIF][_USER_COMMENT] = comment("\n".join([said] * bool(said) + summary(plan)))
    chosen[MAIN] |= _RESOLUTION
    chosen[EXIF] |= _VERSIONS | {
        tag: Value(LONG, size.to_bytes(4, "little"))
        for tag, size in zip(_SIZE, (plan.canvas.crop.width, plan.canvas.crop.height), strict=True)
    }
    chosen[GPS] = dict(found.get(GPS, {}))
    copied = caption.packed(caption.to_copy(said_in_xmp, place=_LATITUDE not in chosen[GPS]))
    parts = [part for part in (gpano(plan.canvas, len(plan.images)), copied) if part]
    return Metadata(chosen, _XMP.format("\n".join(parts)).encode() if parts else b"")


def _from_xmp(said: caption.Properties, tag: int, names: tuple[tuple[str, str], ...]) -> str:
    """What EXIF's tag would hold, by the first name of XMP's that tells it; empty if none does."""
    for namespace, name in names:
        content = caption.plain(said.get(f"{{{namespace}}}{name}"))
        if tag in _DATES:
            date = _DATE.match(content)
            content = f"{date[1]}:{date[2]}:{date[3]} {date[4]}{date[5] or ':00'}" if date else ""
        if content:
            return content
    return ""


def saved_by(path: Path) -> str:
    """The program that EXIF says has saved an image, if that is neither ours nor Hugin's; else nothing. Those
    that Hugin calls, such as enblend, name none.
    """
    found = read_exif(path) if is_file(path) else {}
    return "" if is_ours(found) else one_line(software(found))


def summary(plan: Plan) -> list[str]:
    """Lines that say what Hugin's do of the panorama."""
    panorama = pto.load(plan.file).panorama
    number, canvas = panorama.projection, plan.canvas
    view = f"{canvas.hfov:.0f}"
    if number in _VERTICAL:
        vertical = _VERTICAL[number](math.radians(canvas.hfov), canvas.height / canvas.width)
        view += f" x {math.degrees(vertical):.0f}"
    name = plan.projection[:1].upper() + plan.projection[1:]
    return [f"Projection: {name} ({number})", f"FOV: {view}", f"Ev: {panorama.exposure:.2f}"]


def gpano(canvas: Canvas, photos: int) -> str:
    """What in XMP makes viewers show the canvas's crop as (a part of) a sphere; empty if it is none.

    photos      that it was made of.

    The whole sphere is as large as its scale, width / hfov, makes it, and twice as wide as high; the canvas
    lies in its middle. The view begins straight ahead if that is shown, else in the middle of what is shown.
    """
    if not canvas.spherical or canvas.hfov <= 0:
        return ""
    scale, crop = canvas.width / canvas.hfov, canvas.crop  # px per degree
    width, height = round(360 * scale), round(180 * scale)
    left = crop.left + (width - canvas.width) // 2
    top = crop.top + (height - canvas.height) // 2
    if top < 0 or top + crop.height > height:
        _log.warning(
            "the panorama reaches beyond the poles: viewers cannot be told to show it as a sphere; "
            "crop it in Hugin"
        )
        return ""
    heading = _first_view(left, left + crop.width, width / 2) / scale
    pitch = -_first_view(top, top + crop.height, height / 2) / scale
    values = {
        "UsePanoramaViewer": "True",
        "ProjectionType": "equirectangular",
        "StitchingSoftware": PROGRAM,
        "SourcePhotosCount": photos,
        "FullPanoWidthPixels": width,
        "FullPanoHeightPixels": height,
        "CroppedAreaImageWidthPixels": crop.width,
        "CroppedAreaImageHeightPixels": crop.height,
        "CroppedAreaLeftPixels": left,
        "CroppedAreaTopPixels": top,
        "InitialViewHeadingDegrees": round(heading) % 360,
        "InitialViewPitchDegrees": round(pitch),
        "InitialViewRollDegrees": 0,
    }
    lines = (f"   <GPano:{name}>{value}</GPano:{name}>" for name, value in values.items())
    return _GPANO.format("\n".join(lines))


def _first_view(low: int, high: int, ahead: float) -> float:
    """From straight ahead to where the view begins, px, if low to high is shown."""
    return 0.0 if low <= ahead <= high else (low + high) / 2 - ahead

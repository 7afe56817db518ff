"""Metadata of panoramas: what viewers need, and what Hugin copies; beside Hugin's own, read by exiftool."""

from __future__ import annotations

import os
import re
import subprocess
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest
from conftest import ProjectMaker, require_program
from pictures import one_device
from test_exif import shown

from hugin_abflow import cli
from hugin_abflow.errors import OutputError
from hugin_abflow.exif import comment_of
from hugin_abflow.layer import Box, Canvas
from hugin_abflow.merge import merge_project
from hugin_abflow.metadata import describe, gpano, summary, version
from hugin_abflow.project import read_plan
from hugin_abflow.tifftags import EXIF, MAIN

__all__ = ["one_device"]

GPANO = "{http://ns.google.com/photos/1.0/panorama/}"
CANVAS = 'f2 w400 h200 v360{} n"TIFF_m c:LZW r:CROP"'
SHOT = (
    "-Make=Acme",
    "-Model=Box",
    "-LensModel=Fisheye é",
    "-FocalLength=8",
    "-ExposureTime=0.01",
    "-DateTimeOriginal=2020:01:02 03:04:05",
    "-CreateDate=2020:01:02 03:04:06",
    "-ModifyDate=2020:01:02 03:04:07",
    "-OffsetTimeOriginal=+02:00",
    "-GPSLatitude=48.5",
    "-GPSLatitudeRef=S",
    "-GPSLongitude=11.25",
    "-GPSLongitudeRef=W",
    "-GPSAltitude=500",
    "-Artist=Zoë",
    "-Copyright=hers",
    "-ImageDescription=harbour",
    "-UserComment=windy",
    "-OwnerName=Zoë",
    "-SerialNumber=123",
    "-Orientation#=6",
)


def shot(exiftool: str, project: Path, photo: str = "photo 0.tif") -> Path:
    """The project, one of its photos as a camera writes it."""
    command = [exiftool, "-q", "-overwrite_original", *SHOT, str(project.parent / photo)]
    subprocess.run(command, check=True)
    return project


def values(canvas: Canvas, photos: int = 3) -> dict[str, str]:
    """What the XMP packet says."""
    packet = f'<x xmlns:rdf="urn:rdf">{gpano(canvas, photos)}</x>'
    return {
        e.tag.removeprefix(GPANO): e.text for e in ElementTree.fromstring(packet).iter() if GPANO in e.tag
    }


# Numbers


def test_a_whole_sphere() -> None:
    assert values(Canvas.sphere(800, 400)) == {
        "UsePanoramaViewer": "True",
        "ProjectionType": "equirectangular",
        "StitchingSoftware": "hugin-abflow",
        "SourcePhotosCount": "3",
        "FullPanoWidthPixels": "800",
        "FullPanoHeightPixels": "400",
        "CroppedAreaImageWidthPixels": "800",
        "CroppedAreaImageHeightPixels": "400",
        "CroppedAreaLeftPixels": "0",
        "CroppedAreaTopPixels": "0",
        "InitialViewHeadingDegrees": "0",
        "InitialViewPitchDegrees": "0",
        "InitialViewRollDegrees": "0",
    }


@pytest.mark.parametrize(
    ("size", "hfov", "crop", "whole", "place", "view"),
    [
        ((800, 300), 360, (0, 0, 800, 300), (800, 400), (0, 50), (0, 0)),
        ((800, 400), 360, (0, 0, 800, 330), (800, 400), (0, 0), (0, 0)),
        ((800, 400), 360, (600, 100, 700, 300), (800, 400), (600, 100), (112, 0)),
        ((800, 400), 360, (100, 100, 300, 300), (800, 400), (100, 100), (270, 0)),
        ((800, 400), 360, (0, 0, 800, 100), (800, 400), (0, 0), (0, 68)),
        ((800, 400), 360, (0, 300, 800, 400), (800, 400), (0, 300), (0, -68)),
        ((400, 120), 180, (20, 10, 380, 100), (800, 400), (220, 150), (0, 0)),
        ((400, 200), 359, (0, 0, 400, 200), (401, 201), (0, 0), (0, 0)),
        ((1000, 333), 77.7, (1, 2, 1000, 333), (4633, 2317), (1817, 994), (0, 0)),
    ],
)
def test_parts_of_a_sphere(
    size: tuple, hfov: float, crop: tuple, whole: tuple, place: tuple, view: tuple
) -> None:
    """The picture lies within the whole sphere, and the view begins where something is shown."""
    found = values(replace(Canvas.sphere(*size, hfov=hfov), crop=Box(*crop)))
    number = {name: int(value) for name, value in found.items() if re.fullmatch(r"-?\d+", value)}
    assert (number["FullPanoWidthPixels"], number["FullPanoHeightPixels"]) == whole
    assert (number["CroppedAreaLeftPixels"], number["CroppedAreaTopPixels"]) == place
    area = number["CroppedAreaImageWidthPixels"], number["CroppedAreaImageHeightPixels"]
    assert area == (crop[2] - crop[0], crop[3] - crop[1])
    assert place[0] + area[0] <= whole[0] and place[1] + area[1] <= whole[1]
    assert (number["InitialViewHeadingDegrees"], number["InitialViewPitchDegrees"]) == view


def test_what_is_no_sphere_or_reaches_beyond_its_poles(caplog: pytest.LogCaptureFixture) -> None:
    assert gpano(Canvas.plane(800, 400, wraps=True), 1) == "" and not caplog.text
    assert gpano(Canvas.sphere(800, 500), 1) == "" and "beyond the poles" in caplog.text
    assert gpano(replace(Canvas.sphere(800, 500), crop=Box(0, 50, 800, 450)), 1) != ""


def test_summary_of_a_projection_whose_height_we_do_not_know(make_project: ProjectMaker) -> None:
    plan = read_plan(make_project(panorama='f12 w500 h301 v120 E1.25 n"TIFF_m"'))
    assert summary(plan) == ["Projection: Panini (12)", "FOV: 120", "Ev: 1.25"]


# Files


def test_a_photo_of_another_project_is_not_replaced(
    exiftool: str, nona: str, one_device: None, make_project: ProjectMaker
) -> None:
    """A panorama is, its own or one that it has made, though EXIF of its first photo was copied."""
    project = shot(exiftool, make_project(panorama=CANVAS.format("")))
    other = project.with_name("IMG_7.tif")
    other.write_bytes((project.parent / "photo 0.tif").read_bytes())
    before = other.read_bytes()
    with pytest.raises(
        OutputError, match=r"IMG_7\.tif is a photo: .* choose another name with -o, or remove"
    ):
        merge_project(project, output=other)
    assert other.read_bytes() == before
    other.unlink()
    for _ in range(2):
        assert merge_project(project, output=other) == other


@pytest.mark.parametrize("ending", [".tif", ".jpg", ".png"])
def test_panorama_tells_camera_place_and_sphere(
    exiftool: str, nona: str, one_device: None, make_project: ProjectMaker, ending: str
) -> None:
    project = shot(exiftool, make_project(panorama=CANVAS.format(" S40,360,20,150"), disabled=[1]))
    panorama = merge_project(project, output=project.with_name(f"näme's{ending}"))
    tags = shown(exiftool, panorama)
    expected = {
        "IFD0:Make": "Acme",
        "IFD0:Model": "Box",
        "IFD0:Software": f"hugin-abflow {version()}",
        "IFD0:Artist": "Zoë",
        "IFD0:Copyright": "hers",
        "IFD0:ImageDescription": "harbour",
        "IFD0:ModifyDate": "2020:01:02 03:04:07",
        "ExifIFD:DateTimeOriginal": "2020:01:02 03:04:05",
        "ExifIFD:CreateDate": "2020:01:02 03:04:06",
        "ExifIFD:OffsetTimeOriginal": "+02:00",
        "ExifIFD:LensModel": "Fisheye é",
        "ExifIFD:OwnerName": "Zoë",
        "ExifIFD:UserComment": "windy\nProjection: Equirectangular (2)\nFOV: 360 x 180\nEv: 0.00",
        "Composite:GPSLatitude": -48.5,
        "Composite:GPSLongitude": -11.25,
        "GPS:GPSAltitude": 500,
        "XMP-GPano:ProjectionType": "equirectangular",
        "XMP-GPano:UsePanoramaViewer": True,
        "XMP-GPano:FullPanoWidthPixels": 400,
        "XMP-GPano:FullPanoHeightPixels": 200,
        "XMP-GPano:CroppedAreaImageWidthPixels": 320,
        "XMP-GPano:CroppedAreaImageHeightPixels": 130,
        "XMP-GPano:CroppedAreaLeftPixels": 40,
        "XMP-GPano:CroppedAreaTopPixels": 20,
        "XMP-GPano:SourcePhotosCount": 2,
        "File:ImageWidth"
        if ending == ".jpg"
        else ("PNG" if ending == ".png" else "IFD0") + ":ImageWidth": 320,
    }
    assert {name: tags.get(name) for name in expected} == expected
    # of one photo, or wrong for the panorama
    assert not [name for name in tags if name.endswith((":FocalLength", ":ExposureTime"))]
    assert tags.get("IFD0:Orientation", 1) == 1


def test_exiftool_is_not_needed(
    exiftool: str, nona: str, one_device: None, make_project: ProjectMaker, tmp_path: Path, monkeypatch
) -> None:
    project = shot(exiftool, make_project(panorama=CANVAS.format("")))
    programs = tmp_path / "programs"
    programs.mkdir()
    (programs / "exiftool").write_text('#!/bin/sh\ntouch "$0 was run"; exit 1\n')
    (programs / "exiftool").chmod(0o755)
    monkeypatch.setenv("PATH", str(programs), prepend=os.pathsep)
    panorama = merge_project(project)
    assert list(programs.iterdir()) == [programs / "exiftool"]
    assert shown(exiftool, panorama)["IFD0:Model"] == "Box"


def test_metadata_may_be_left_out(
    exiftool: str, nona: str, one_device: None, make_project: ProjectMaker, capsys
) -> None:
    project = shot(exiftool, make_project(panorama=CANVAS.format("")))
    assert cli.main(["-q", "--no-metadata", "-o", str(project.with_suffix(".tif")), str(project)]) == 0
    told = {"IFD0:Make", "IFD0:Software", "ExifIFD:UserComment", "XMP-GPano:ProjectionType"}
    assert not told & set(shown(exiftool, project.with_suffix(".tif")))


def test_first_active_photo_counts(exiftool: str, make_project: ProjectMaker) -> None:
    project = shot(exiftool, make_project(disabled=[0]), "photo 1.tif")
    assert describe(read_plan(project)).exif[MAIN][272].data == b"Box\0"


def test_photos_that_tell_nothing(make_project: ProjectMaker, caplog: pytest.LogCaptureFixture) -> None:
    """Lost ones too: layers may be all that is there."""
    project = make_project(panorama='f0 w400 h300 v90 n"TIFF_m"')
    caplog.set_level("INFO")
    (project.parent / "photo 0.tif").write_bytes(b"no picture")
    describe(read_plan(project))
    assert "photo 0.tif: no EXIF to copy" in caplog.text
    (project.parent / "photo 0.tif").unlink()
    metadata = describe(read_plan(project))
    assert comment_of(metadata.exif[EXIF][37510]) == "Projection: Rectilinear (0)\nFOV: 90 x 74\nEv: 0.00"
    assert metadata.xmp == b"" and 271 not in metadata.exif[MAIN]


@pytest.mark.parametrize(
    ("panorama", "ending"),
    [
        (CANVAS.format(" S0,400,20,160"), "jpg"),
        ('f2 w400 h120 v180 S20,380,10,100 E0.5 n"TIFF_m"', "png"),
        *((f'f{projection} w300 h151 v120 n"TIFF_m"', "tif") for projection in (0, 1, 3, 4, 5)),
    ],
)
def test_hugins_own_metadata_say_the_same(
    exiftool: str,
    nona: str,
    enblend: str,
    one_device: None,
    make_project: ProjectMaker,
    panorama: str,
    ending: str,
) -> None:
    """All that Hugin's stitcher has exiftool write, but for our name."""
    executor = require_program("hugin_executor")
    project = shot(exiftool, make_project(panorama=panorama, extra=f"#hugin_outputImageType {ending}\n"))
    command = [executor, "-s", "-p", str(project.parent / "hugins"), str(project)]
    subprocess.run(command, capture_output=True, check=True, cwd=project.parent)
    theirs = shown(exiftool, project.parent / f"hugins.{ending}")
    ours = shown(exiftool, merge_project(project))
    copied = {
        "IFD0:Make", "IFD0:Model", "IFD0:Artist", "IFD0:Copyright", "IFD0:ImageDescription",
        "IFD0:ModifyDate", "ExifIFD:DateTimeOriginal", "ExifIFD:CreateDate", "ExifIFD:UserComment",
        "ExifIFD:OwnerName", "ExifIFD:SerialNumber",
    }  # fmt: skip
    assert copied <= set(theirs)
    shared = copied | {name for name in theirs if name.startswith(("GPS:", "XMP-GPano:"))}
    shared.discard("XMP-GPano:StitchingSoftware")
    assert {name: ours.get(name) for name in shared} == {name: theirs[name] for name in shared}

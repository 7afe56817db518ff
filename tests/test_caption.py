"""What people say of a photo: carried into panoramas from XMP and IPTC; written and read back by exiftool."""

from __future__ import annotations

import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
import tifffile
from conftest import ProjectMaker
from pictures import one_device
from test_exif import picture, shown

from hugin_abflow.caption import DC, EXIF, PHOTOSHOP, packed, plain, read_caption, to_copy
from hugin_abflow.exif import Metadata, Packets, comment_of, read_packets, text
from hugin_abflow.merge import merge_project
from hugin_abflow.metadata import describe
from hugin_abflow.project import read_plan
from hugin_abflow.tifftags import EXIF as EXIF_TAGS
from hugin_abflow.tifftags import MAIN

__all__ = ["one_device"]

PHOTO = Path("photo.jpg")
XMP = (
    "-XMP-dc:Title=Haf€n",
    "-XMP-dc:Description=the <old> harbour",
    "-XMP-dc:Description-de=der alte Hafen",
    "-XMP-dc:Creator=Zoë",
    "-XMP-dc:Creator=Al",
    "-XMP-dc:Rights=hers & his",
    "-XMP-dc:Subject=sea",
    "-XMP-dc:Subject=boats",
    "-XMP-xmpRights:WebStatement=https://example.org/licence",
    "-XMP-plus:LicensorURL=https://example.org/shop",
    "-XMP-iptcCore:CreatorWorkEmail=zoe@example.org",
    "-XMP-iptcExt:PersonInImage=Bo",
    "-XMP-photoshop:City=Rostock",
    "-XMP-lr:HierarchicalSubject=water|sea",
)
COPIED = {
    "XMP-dc:Title": "Haf€n",
    "XMP-dc:Description": "the <old> harbour",
    "XMP-dc:Description-de": "der alte Hafen",
    "XMP-dc:Creator": ["Zoë", "Al"],
    "XMP-dc:Rights": "hers & his",
    "XMP-dc:Subject": ["sea", "boats"],
    "XMP-xmpRights:WebStatement": "https://example.org/licence",
    "XMP-plus:LicensorURL": "https://example.org/shop",
    "XMP-iptcCore:CreatorWorkEmail": "zoe@example.org",
    "XMP-iptcExt:PersonInImage": "Bo",
    "XMP-photoshop:City": "Rostock",
    "XMP-lr:HierarchicalSubject": "water|sea",
}
OF_ONE_PHOTO = (
    "-XMP-xmp:Rating=4",
    "-XMP-crs:Exposure2012=1",
    "-XMP-dc:Format=image/jpeg",
    "-XMP-exif:FocalLength=50",
    "-XMP-iptcExt:DigitalSourceType=x",
    "-XMP-mwg-rs:RegionInfo={RegionList=[{Name=Bo}]}",
)
IPTC = (
    "-IPTC:ObjectName=Ship",
    "-IPTC:Keywords=mast",
    "-IPTC:Keywords=hüll",
    "-IPTC:By-line=Cy",
    "-IPTC:CopyrightNotice=his",
    "-IPTC:City=Kiel",
    "-IPTC:Province-State=Holstein",
)


def told(exiftool: str, path: Path, *tags: str) -> Path:
    """The file, in which exiftool has written that."""
    subprocess.run([exiftool, "-q", "-m", "-overwrite_original", *tags, str(path)], check=True)
    return path


def described(exiftool: str, project: Path, *tags: str) -> Metadata:
    """What is written of a project's panorama, in whose first photo exiftool has written that."""
    told(exiftool, project.parent / "photo 0.tif", *tags)
    return describe(read_plan(project))


def packet(inside: str, attributes: str = "") -> bytes:
    return (
        f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description rdf:about="" xmlns:dc="{DC}" {attributes}>{inside}</rdf:Description>'
        "</rdf:RDF></x:xmpmeta>"
    ).encode()


# Panoramas


@pytest.mark.parametrize("ending", [".tif", ".jpg", ".png"])
def test_panorama_carries_what_is_said_of_its_first_photo(
    exiftool: str, nona: str, one_device: None, make_project: ProjectMaker, ending: str
) -> None:
    project = make_project(panorama='f2 w400 h200 v360 n"TIFF_m c:LZW r:CROP"')
    told(exiftool, project.parent / "photo 0.tif", "-ImageDescription=", *XMP, *OF_ONE_PHOTO, *IPTC)
    tags = shown(exiftool, merge_project(project, output=project.with_name(f"out{ending}")))
    assert {name: tags.get(name) for name in COPIED} == COPIED
    assert tags["XMP-photoshop:State"] == "Holstein"  # of IPTC, as XMP says nothing of it
    assert tags["XMP-GPano:ProjectionType"] == "equirectangular"
    assert not [name for name in tags if name.endswith(("Rating", "Exposure2012", "Format", "SourceType"))]
    assert not [name for name in tags if name.startswith(("XMP-mwg", "XMP-exif", "IPTC:"))]
    # for programs that know EXIF alone
    assert (tags["IFD0:Artist"], tags["IFD0:Copyright"]) == ("Zoë; Al", "hers & his")
    assert tags["IFD0:ImageDescription"] == "the <old> harbour"


def test_xmp_stands_in_where_there_is_no_exif(exiftool: str, make_project: ProjectMaker) -> None:
    """As Hugin has exiftool copy it; and the place, which it does not."""
    project = make_project(panorama='f0 w400 h300 v90 n"TIFF_m"')
    metadata = described(
        exiftool, project,
        "-XMP-tiff:Artist=Zoë", "-XMP-tiff:Make=Acme", "-XMP-exif:UserComment=windy",
        "-XMP-exif:DateTimeOriginal=2020:01:02 03:04:05", "-XMP-xmp:CreateDate=2020:01:02 03:04",
        "-XMP-exif:GPSLatitude=48.5", "-XMP-dc:Creator=Al",
    )  # fmt: skip
    assert metadata.exif[MAIN][315] == text("Zoë") and metadata.exif[MAIN][271] == text("Acme")
    assert metadata.exif[EXIF_TAGS][36867] == text("2020:01:02 03:04:05")
    assert metadata.exif[EXIF_TAGS][36868] == text("2020:01:02 03:04:00")
    assert comment_of(metadata.exif[EXIF_TAGS][37510]).startswith("windy\nProjection")
    assert b"48,30.0N" in metadata.xmp
    metadata = described(exiftool, project, "-Artist=Bo", "-GPSLatitude=1", "-GPSLatitudeRef=N")
    assert metadata.exif[MAIN][315] == text("Bo") and b"48,30.0N" not in metadata.xmp


def test_xmp_stands_in_where_a_camera_left_exif_blank(exiftool: str, make_project: ProjectMaker) -> None:
    """Authors that nobody has entered, and GPS without a receiver: but for its version nothing."""
    project = make_project(panorama='f0 w400 h300 v90 n"TIFF_m"')
    metadata = described(
        exiftool, project,
        "-Artist=   ", "-Copyright= ", "-GPSVersionID=2.3.0.0",
        "-XMP-dc:Creator=Al", "-XMP-exif:GPSLatitude=48.5",
    )  # fmt: skip
    assert metadata.exif[MAIN][315] == text("Al") and b"48,30.0N" in metadata.xmp
    assert not metadata.exif[MAIN][33432].data.strip(b" \0")  # XMP tells nothing, either


# Photos


@pytest.mark.parametrize("ending", [".tif", ".jpg"])
def test_iptc_of_photos(exiftool: str, tmp_path: Path, ending: str) -> None:
    photo = tmp_path / f"photo{ending}"
    picture(photo)
    for coded in ("UTF8", "Latin"):
        told(exiftool, photo, "-charset", f"iptc={coded}", *IPTC)
        found = read_caption(photo, read_packets(photo))
        assert {name.partition("}")[2]: plain(element) for name, element in found.items()} == {
            "title": "Ship", "subject": "mast; hüll", "creator": "Cy", "rights": "his", "City": "Kiel",
            "State": "Holstein",
        }  # fmt: skip


def test_iptc_that_tiff_holds_by_way_of_photoshop(tmp_path: Path) -> None:
    photo = tmp_path / "photo.tif"
    block = b"8BIM\4\1\0\0\0\0\0\3abc\0" + b"8BIM\4\4\3odd\0\0\0\x09" + b"\x1c\x02\x5a\0\4Kiel\0"
    pixels = np.zeros((3, 4), np.uint8)
    tifffile.imwrite(photo, pixels, extratags=[(34377, 7, len(block), block, True)])
    (city,) = read_caption(photo, read_packets(photo)).values()
    assert plain(city) == "Kiel"


def test_short_form_and_packed_text_of_png(exiftool: str, tmp_path: Path) -> None:
    photo = tmp_path / "photo.png"
    picture(photo)
    told(exiftool, photo, "-z", "-XMP-dc:Title=Ship", "-api", "Compact=Shorthand", "-XMP-photoshop:City=Kiel")
    found = to_copy(read_caption(photo, read_packets(photo)), place=False)
    assert sorted(plain(element) for element in found.values()) == ["Kiel", "Ship"]


@pytest.mark.parametrize(
    "content",
    [
        b"no XML",
        b"<a>",
        b'<!DOCTYPE a [<!ENTITY b "c">]>' + packet("<dc:title>&b;</dc:title>"),
        packet("<dc:title>x</dc:title>").decode().encode("utf-16"),
        b'<?xml version="1.0" encoding="none"?>' + packet("<dc:title>x</dc:title>"),
        packet("<dc:title>" + "<dc:a>" * 100_000 + "x" + "</dc:a>" * 100_000 + "</dc:title>"),
    ],
)
def test_xmp_that_cannot_be_understood(content: bytes, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    assert read_caption(PHOTO, Packets(content)) == {}
    assert "photo.jpg: its XMP cannot be understood" in caplog.text


@pytest.mark.parametrize("ending", [".tif", ".jpg", ".png"])
def test_files_that_are_cut(exiftool: str, tmp_path: Path, ending: str) -> None:
    photo = tmp_path / f"photo{ending}"
    picture(photo)
    told(exiftool, photo, "-XMP-dc:Title=Ship", *IPTC[:1] if ending != ".png" else ())
    whole, cut = photo.read_bytes(), tmp_path / f"cut{ending}"
    for length in range(0, len(whole), 97):
        cut.write_bytes(whole[:length])
        read_caption(cut, read_packets(cut))


def test_blocks_of_photoshop_that_are_cut_do_not_hide_xmp(tmp_path: Path) -> None:
    photo = tmp_path / "photo.jpg"
    picture(photo)
    xmp = b"http://ns.adobe.com/xap/1.0/\0" + packet("<dc:title>Ship</dc:title>")
    segments = (0xE1, xmp), (0xED, b"Photoshop 3.0\0" + b"8BIM\4\4\x09somewhere")
    added = b"".join(struct.pack(">BBH", 0xFF, kind, len(one) + 2) + one for kind, one in segments)
    photo.write_bytes(b"\xff\xd8" + added + photo.read_bytes()[2:])
    (title,) = read_caption(photo, read_packets(photo)).values()
    assert plain(title) == "Ship"


def test_what_is_too_long_is_left_out(caplog: pytest.LogCaptureFixture) -> None:
    content = packet(f"<dc:title>Ship</dc:title><dc:description>{'x' * 50_000}</dc:description>")
    text_ = packed(to_copy(read_caption(PHOTO, Packets(content)), place=False))
    assert "Ship" in text_ and len(text_) < 500
    assert "too long" in caplog.text and "description" in caplog.text


def test_what_xmp_leaves_empty_iptc_tells() -> None:
    """In the short form, an array, and a structure; an address alone is something."""
    empty = '<dc:title><rdf:Alt><rdf:li xml:lang="x-default"/></rdf:Alt></dc:title>'
    empty += '<dc:source rdf:parseType="Resource"/><dc:relation rdf:resource="https://example.org"/>'
    short = f'xmlns:p="{PHOTOSHOP}" p:City=""'
    iptc = b"\x1c\x02\x05\0\4Ship" + b"\x1c\x02\x5a\0\4Kiel"
    found = read_caption(PHOTO, Packets(packet(empty, short), iptc))
    assert [plain(element) for element in found.values()] == ["Ship", "Kiel", ""]
    assert list(found)[2] == f"{{{DC}}}relation"


def test_nothing_said_and_nothing_to_copy() -> None:
    found = read_caption(PHOTO, Packets(packet("<dc:title/><dc:format>x</dc:format>", f'xmlns:e="{EXIF}"')))
    assert packed(to_copy(found, place=True)) == ""

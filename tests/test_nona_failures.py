"""Runs of nona that fail: what is told of them."""

from __future__ import annotations

import os
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from conftest import ICC, names_in, photo_pixels, remap

from hugin_abflow.errors import (
    ImageReadError,
    LayersMismatchError,
    NonaFailedError,
    NonaMissingError,
    OutputError,
    ProjectError,
)
from hugin_abflow.failures import loss
from hugin_abflow.images import write_image
from hugin_abflow.project import read_plan
from hugin_abflow.supply import open_layers


@pytest.fixture
def as_nobody(nona, tmp_path, monkeypatch):
    """Have nona read no more than it may: to root nothing is forbidden."""
    if os.name == "nt":
        pytest.skip("Windows has other permissions")  # modes and root are those of POSIX
    if os.geteuid() == 0:
        folder = tmp_path / "bin"
        folder.mkdir()
        drop = "--bounding-set=-dac_override,-dac_read_search"
        (folder / "nona").write_text(f'#!/bin/sh\nexec setpriv {drop} {nona} "$@"\n')
        (folder / "nona").chmod(0o755)
        monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")


def test_photo_is_none(make_project, nona):
    """Nona does not say which."""
    plan = read_plan(make_project())
    plan.images[2].photo.write_bytes(b"no photo")
    with pytest.raises(ImageReadError, match=f"{plan.images[2].photo.name} is no image"), open_layers(plan):
        pass


@pytest.mark.parametrize(
    ("begins", "kind"), [(b"RIFF\0\0\0\0WEBPVP8 ", "WebP"), (b"\0\0\0\x18ftypheic", "HEIF")]
)
def test_photo_of_a_format_that_hugin_does_not_read(make_project, nona, begins, kind):
    """It may be sound: nobody needs to copy it again."""
    plan = read_plan(make_project())
    photo = plan.images[1].photo
    photo.write_bytes(begins + bytes(300))
    with pytest.raises(ImageReadError, match=rf"{photo} is {kind}, .*convert it to JPEG"), open_layers(plan):
        pass


@pytest.mark.parametrize("dtype", [np.float64, np.uint32, np.int16])
@pytest.mark.parametrize("keep", [False, True])
def test_photos_of_samples_that_no_layer_has(make_project, nona, dtype, keep):
    """Nona keeps them; the layer that cannot be read is gone when somebody looks for it."""
    plan = read_plan(make_project(yaws=(0, 60)))
    for number, photo in enumerate(plan.photos):
        tifffile.imwrite(photo, (photo_pixels(number) * 99.0).astype(dtype), photometric="rgb")
    before = names_in(plan.folder)
    said = f"^{plan.photos[0]} is of sample type .* convert the photos"
    with pytest.raises(ImageReadError, match=said), open_layers(plan, keep_layers=keep):
        pass
    assert names_in(plan.folder) == before


def test_tiff_that_nona_does_not_begin_to_read(make_project, nona):
    """The photo is to blame, not the project, and is not damaged."""
    plan = read_plan(make_project(yaws=(0, 60)))
    tifffile.imwrite(plan.photos[1], photo_pixels(1), photometric="rgb", tile=(64, 64))
    with pytest.raises(ImageReadError, match=f"^{plan.photos[1]} is a TIFF in tiles"), open_layers(plan):
        pass
    for photo in plan.photos:
        tifffile.imwrite(photo, photo_pixels(1)[..., 0], photometric="minisblack")
        bits = struct.pack("<HHIH", 258, 3, 1, 8), struct.pack("<HHIH", 258, 3, 1, 4)
        photo.write_bytes(photo.read_bytes().replace(*bits))
    said = f"^{plan.file} has a photo in TIFF of a kind that Hugin does not read"
    with pytest.raises(ImageReadError, match=said), open_layers(plan):
        pass


def test_photos_that_nona_misreads(make_project, nona):
    """It ends with success, and layers of noise, or far too dark ones."""
    plan = read_plan(make_project(yaws=(0, 60)))
    for number, photo in enumerate(plan.photos):
        pixels = photo_pixels(number).transpose(2, 0, 1)
        tifffile.imwrite(photo, pixels, photometric="rgb", planarconfig="separate")
    said = rf"^{plan.photos[0]} has its channels one after the other \(planar\), .*; save it with interleaved"
    with pytest.raises(ImageReadError, match=said), open_layers(plan):
        pass
    for number, photo in enumerate(plan.photos):
        pixels = photo_pixels(number)
        encoded = {"compression": "jpeg", "compressionargs": {"level": 90}}
        tifffile.imwrite(photo, pixels, photometric="ycbcr", subsampling=(2, 2), **encoded)
    said = rf"^{plan.photos[0]} is compressed as JPEG in a way .*; save it with another compression"
    with pytest.raises(ImageReadError, match=said), open_layers(plan):
        pass
    for number, photo in enumerate(plan.photos):
        kind = (257 * photo_pixels(number).astype(np.uint16), (photo_pixels(number) / 255).astype(np.float16))
        tifffile.imwrite(photo, kind[number], photometric="rgb")  # beside one that is read as it is
    said = rf"^{plan.photos[1]} has 16 bit floats, .*; convert the photos of the project to 16 bit whole"
    with pytest.raises(ImageReadError, match=said), open_layers(plan):
        pass


def test_photos_whose_compression_nona_does_not_know(make_project, nona):
    """It ends with success as well: such as JPEG 2000 in TIFF, or JPEG XL."""
    plan = read_plan(make_project(yaws=(0, 60)))
    for number, photo in enumerate(plan.photos):
        tifffile.imwrite(photo, photo_pixels(number), photometric="rgb")
    none, jpeg_xl = (struct.pack("<HHIH", 259, 3, 1, scheme) for scheme in (1, 50002))
    plan.photos[1].write_bytes(plan.photos[1].read_bytes().replace(none, jpeg_xl))
    said = rf"^{plan.photos[1]} is compressed in a way that Hugin does not know; .* LZW, under the same name$"
    with pytest.raises(ImageReadError, match=said), open_layers(plan):
        pass


@pytest.mark.parametrize(
    ("line", "lost"),
    [
        ("JPEGLib: Warning, Premature end of JPEG file.", False),
        ("TIFFReadDirectory: Warning, Unknown field with tag 37724 (0x935c) encountered.", False),
        ("JPEGLib: Not a JPEG file: starts with 0x00 0x00.", True),
        ("a.tif: Read error on strip 7; got 0 bytes, expected 9.", True),
    ],
)
def test_warnings_of_libtiff_are_no_loss(line, lost):
    assert (loss(Path("a.tif"), line) is not None) == lost


def test_a_codec_that_nona_was_built_without_is_no_damage():
    """As Zstandard's on some systems: libtiff names the file first."""
    said = str(loss(Path("a.tif"), "a.tif: ZSTD compression support is not configured"))
    assert said.startswith("a.tif is compressed in a way that Hugin does not know")


@pytest.mark.parametrize("compression", ["lzw", "zlib", "lzma", "zstd"])
def test_photos_whose_compressed_pixels_are_damaged(make_project, nona, compression):
    """As by a copy that was broken off, where the rest is zeros: nona leaves black, or noise."""
    plan = read_plan(make_project(yaws=(0, 60)))
    for number, photo in enumerate(plan.photos):
        rgb = photo_pixels(number)
        tifffile.imwrite(photo, rgb, photometric="rgb", compression=compression, rowsperstrip=16)
    with open_layers(plan):
        pass
    data = plan.photos[1].read_bytes()
    half = len(data) // 2
    plan.photos[1].write_bytes(data[:half] + bytes(len(data) - half))
    with pytest.raises(ImageReadError, match=rf"^{plan.photos[1]} is damaged \(.*Decode"), open_layers(plan):
        pass


@pytest.mark.parametrize("ending", ["png", "jpg", "exr"])
def test_photos_that_nona_cannot_decode(make_project, nona, ending):
    """What it says at the end is about the photo, not about the folder that it writes into."""
    plan = read_plan(make_project(yaws=(0, 60), photo=f"photo{{}}.{ending}"))
    for number, photo in enumerate(plan.photos):
        opaque = np.dstack([photo_pixels(number), np.full((151, 203), 255, np.uint8)])
        write_image(photo, opaque if ending != "exr" else (opaque / 255).astype(np.float32))
    data = bytearray(plan.photos[1].read_bytes())
    half = len(data) // 2
    data[half : half + 400] = bytes(byte ^ 0x15 for byte in data[half : half + 400])
    plan.photos[1].write_bytes(data)
    with pytest.raises(ImageReadError, match=rf"^{plan.photos[1]} is damaged \("), open_layers(plan):
        pass


def test_a_project_with_a_name_as_long_as_file_systems_take(make_project, nona):
    project = make_project()
    plan = read_plan(project.rename(project.with_name("ö" * 125 + "a.pto")))
    with open_layers(plan) as layers:
        assert len(layers) == 3
    with (
        pytest.raises(OutputError, match=r"0000\.tif cannot be written: .*; leave out --keep-layers"),
        open_layers(plan, keep_layers=True),
    ):
        pass


def test_photo_that_must_not_be_read(make_project, nona, as_nobody):
    """Nona names it as the project does."""
    plan = read_plan(make_project())
    plan.images[1].photo.chmod(0)
    with (
        pytest.raises(ImageReadError, match=rf"{plan.images[1].photo} cannot be opened; check its perm"),
        open_layers(plan),
    ):
        pass


def test_photo_of_another_size(make_project, nona):
    """Exported again; the aligned one is gone."""
    plan = read_plan(make_project())
    photo = plan.images[1].photo
    tifffile.imwrite(photo, tifffile.imread(photo)[::2, ::2], photometric="rgb")
    said = rf"{photo.name} has 102x76 pixels, in .*pano\.pto it has 203x151"
    with pytest.raises(ProjectError, match=said), open_layers(plan):
        pass


@pytest.mark.parametrize("other", ["16 bits", "grey"])
def test_photos_that_differ(make_project, nona, other):
    """One was developed otherwise."""
    plan = read_plan(make_project())
    photo = plan.images[1].photo
    pixels = tifffile.imread(photo)
    if other == "grey":
        tifffile.imwrite(photo, pixels[..., 0], photometric="minisblack")
    else:
        tifffile.imwrite(photo, pixels.astype(np.uint16) * 257, photometric="rgb")
    said = rf"(?s)photos differ in depth or in colour channels.*{photo.name}"
    with pytest.raises(LayersMismatchError, match=said), open_layers(plan):
        pass


def test_photo_that_is_remapped_is_blamed(make_project, nona):
    """The first one's layer is there; so its photo need not be."""
    plan = read_plan(make_project())
    remap(plan, "pano")
    (plan.folder / "pano0001.tif").unlink()
    plan.images[0].photo.unlink()
    plan.images[1].photo.write_bytes(b"no photo")
    with pytest.raises(ImageReadError, match=f"{plan.images[1].photo.name} is no image"), open_layers(plan):
        pass


def test_photo_whose_size_the_project_leaves_to_nona(make_project, nona):
    """It may be any; the next one may not."""
    project = make_project()
    project.write_text(project.read_text().replace("w203 h151", "w0 h0", 1))
    plan = read_plan(project)
    photo = plan.images[1].photo
    tifffile.imwrite(photo, tifffile.imread(photo)[::2, ::2], photometric="rgb")
    with pytest.raises(ProjectError, match=f"{photo.name} has 102x76 pixels"), open_layers(plan):
        pass


def test_photo_whose_name_is_no_unicode(make_project, nona):
    """Nobody here can open it, nona can; what it says of another one is told."""
    plan = read_plan(make_project(photo="photo{}.tif"))
    name = "photo\udcff.tif"
    plan.images[0].photo.rename(plan.folder / name)
    text = plan.file.read_bytes().replace(b"photo0.tif", b"photo\xff.tif")
    plan.file.write_bytes(text)
    plan = read_plan(plan.file)
    assert plan.images[0].photo.is_file()
    plan.images[1].photo.write_bytes(b"no photo")
    with pytest.raises(ImageReadError, match=r"photo1\.tif is no image"), open_layers(plan):
        pass


@pytest.mark.parametrize("keep", [False, True])
def test_canvas_that_hugin_makes_lower(make_project, nona, keep):
    """A general Panini of such a view is not as high as the project says; no layer is left beside it."""
    panorama = 'f19 w600 h400 v319 k0 E0 R0 P"100 0 0" n"TIFF_m c:LZW r:CROP"'
    plan = read_plan(make_project(panorama=panorama))
    with (
        pytest.raises(LayersMismatchError, match="600x400, of which Hugin makes 600x307"),
        open_layers(plan, keep_layers=keep),
    ):
        pass
    assert not list(plan.folder.glob("pano*.tif"))


def test_nona_without_memory(make_project, tmp_path, monkeypatch):
    program_file = tmp_path / "nona"
    program_file.write_text('#!/bin/sh\necho "what():  std::bad_alloc"\nkill -6 $$\n')
    program_file.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    with (
        pytest.raises(NonaFailedError, match=r"(?s)SIGABRT.* close other programs.*std::bad_alloc") as error,
        open_layers(read_plan(make_project())),
    ):
        pass
    assert "TMPDIR" not in str(error.value)


@pytest.mark.parametrize(
    ("interpreter", "mode", "raised", "said"),
    [
        (
            "/nowhere/sh",
            0o755,
            NonaMissingError,
            "nona cannot be run; or name layers that exist with --prefix",
        ),
        ("/bin/sh", 0o644, NonaFailedError, "nona cannot be run: Permission denied"),
    ],
)
def test_nona_that_is_there_and_cannot_be_run(
    make_project, tmp_path, monkeypatch, interpreter, mode, raised, said
):
    """As where it was copied from another machine, or a file system that knows no permissions."""
    (tmp_path / "nona").write_text(f"#!{interpreter}\n")
    (tmp_path / "nona").chmod(mode)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(raised, match=said), open_layers(read_plan(make_project())):
        pass


def test_photos_are_named_of_which_layers_were_made(make_project, nona, caplog):
    plan = read_plan(make_project(icc=ICC))
    tifffile.imwrite(plan.images[1].photo, photo_pixels(1, np.uint8, 3), photometric="rgb")
    with open_layers(plan, keep_layers=True):
        assert f"of {plan.folder / 'pano0000.tif'}: {plan.folder / 'pano0001.tif'};" in caplog.text
    caplog.clear()
    with open_layers(plan, remap="always"):
        assert "of photo 0.tif: photo 1.tif;" in caplog.text


def test_photos_outside_the_crop_are_no_reason_to_warn(make_project, nona, caplog):
    """Somebody has cropped them off."""
    panorama = 'f2 w600 h300 v360 k0 E0 R0 S250,350,100,200 n"TIFF_m c:LZW r:CROP"'
    plan = read_plan(make_project(panorama=panorama, yaws=(0, 20, 180)))
    with caplog.at_level("INFO", "hugin_abflow"), open_layers(plan) as layers:
        assert len(layers) == 2
    assert "image 2 (photo 2.tif) misses the crop" in caplog.text
    assert not any(record.levelname == "WARNING" for record in caplog.records)


@pytest.mark.skipif(os.name == "nt", reason="the stand-in is a shell script")
def test_photos_of_which_nona_makes_no_layer_are_told(make_project, nona, tmp_path, monkeypatch, caplog):
    """Also of one that was to be made beside others; a small crop may leave out many, and few are named."""
    folder = tmp_path / "bin"
    folder.mkdir()
    (folder / "nona").write_text(
        f'#!/bin/sh\n{nona} "$@" || exit\nwhile [ "$1" != -o ]; do shift; done\nrm -f "$2"000[1-6].tif\n'
    )
    (folder / "nona").chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")
    plan = read_plan(make_project(yaws=range(0, 210, 30)))
    with open_layers(plan, keep_layers=True) as layers:
        assert len(layers) == 1
    names = ", ".join(image.name for image in plan.images[1:6])
    assert f"nona made no layer of {names} and 1 more: left out;" in caplog.text
    caplog.clear()
    with open_layers(replace(plan, images=plan.images[:2])) as layers:
        assert len(layers) == 1
    assert f"nona made no layer of {plan.images[1].name}: left out;" in caplog.text

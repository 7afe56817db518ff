"""Writing panoramas: what comes back, tags, whole files or none."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import tifffile
from conftest import DTYPES, ICC, names_in, noise, photo_pixels, whole

from hugin_abflow import imagewriter
from hugin_abflow.encoding import ENDINGS
from hugin_abflow.errors import OutputError
from hugin_abflow.images import ImageWriter, read_layer, write_image
from hugin_abflow.layer import Box, full_scale

# ------------------------------------------------------------------------------------ round trips


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("compression", ["none", "lzw", "packbits", "deflate"])
def test_tiff_comes_back_exactly(tmp_path, dtype, channels, compression):
    pixels = noise(dtype, channels)
    write_image(tmp_path / "a.tif", pixels, offset=(656, 49), icc=ICC, compression=compression)
    layer = read_layer(tmp_path / "a.tif")
    assert (layer.box, layer.channels) == (Box(656, 49, 656 + 131, 49 + 77), channels)
    assert (layer.dtype, layer.icc, layer.canvas_size) == (np.dtype(dtype), ICC, None)
    assert np.array_equal(whole(layer), pixels)  # colours under alpha 0 too
    # and another program agrees
    page = tifffile.TiffFile(tmp_path / "a.tif").pages[0]
    assert np.array_equal(page.asarray(), pixels)
    assert [int(extra) for extra in page.extrasamples] == [2]
    names = {"none": 1, "lzw": 5, "packbits": 32773, "deflate": 8}
    assert int(page.compression) == names[compression]


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_exr_comes_back_exactly_but_for_colours_under_alpha_0(tmp_path, dtype, channels):
    pixels = noise(dtype, channels)
    write_image(tmp_path / "a.exr", pixels, offset=(-3, 40), canvas_size=(901, 333))
    layer = read_layer(tmp_path / "a.exr")
    assert layer.box == Box(-3, 40, 128, 117)
    assert layer.canvas_size == (901, 333)
    pixels[pixels[..., -1] == 0] = 0  # EXR's alpha is associated
    assert np.array_equal(whole(layer), pixels)


def test_exr_partial_alpha_is_undone(tmp_path):
    pixels = noise(np.float32)
    pixels[..., -1] = 0.25
    write_image(tmp_path / "a.exr", pixels)
    stored = oiio.ImageBuf(str(tmp_path / "a.exr")).get_pixels(oiio.FLOAT)
    assert np.array_equal(stored[..., :3], pixels[..., :3] * np.float32(0.25))
    assert np.array_equal(whole(read_layer(tmp_path / "a.exr")), pixels)  # a power of two loses nothing


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_png_comes_back_exactly(tmp_path, dtype, channels):
    pixels = noise(dtype, channels)
    write_image(tmp_path / "a.png", pixels, offset=(5, 6))
    assert np.array_equal(whole(read_layer(tmp_path / "a.png")), pixels)


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_png_stores_floats_with_16_bit(tmp_path, dtype, caplog):
    pixels = noise(dtype)
    pixels[0, 0] = (2.0, -1.0, 0.5, 1.0)
    write_image(tmp_path / "a.png", pixels)
    expected = np.rint(np.clip(pixels.astype(np.float64), 0, 1) * 65535)
    layer = read_layer(tmp_path / "a.png")
    assert layer.dtype == np.uint16
    assert np.abs(whole(layer) - expected).max() <= 1  # float32 arithmetic at a rounding border
    assert "clipped" in caplog.text


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("dtype", DTYPES)
def test_jpeg_is_8_bit_over_black(tmp_path, dtype, channels):
    pixels = np.concatenate(
        [photo_pixels(1, dtype, channels), np.full((151, 203, 1), full_scale(dtype), dtype)], 2
    )
    pixels[:40, :, -1] = 0
    write_image(tmp_path / "a.jpg", pixels, jpeg_quality=97, icc=ICC)
    layer = read_layer(tmp_path / "a.jpg")
    assert (layer.dtype, layer.channels) == (np.uint8, channels)
    expected = pixels[..., :-1].astype(np.float64) * (255 / full_scale(dtype))
    expected[:40] = 0
    got = whole(layer)
    assert np.abs(got[:32, :, :-1].astype(int)).max() <= 2  # black, but for what JPEG makes of the edge below
    assert np.abs(got[48:, :, :-1] - expected[48:]).mean() < 1.0
    assert (got[..., -1] == 255).all()


def test_jpeg_quality_counts(tmp_path):
    for quality in (30, 95):
        write_image(tmp_path / f"{quality}.jpg", noise(np.uint8), jpeg_quality=quality)
    assert (tmp_path / "30.jpg").stat().st_size * 2 < (tmp_path / "95.jpg").stat().st_size


@pytest.mark.parametrize("ending", [".jpg", ".tif"])
def test_icc_profile_is_carried(tmp_path, ending):
    write_image(tmp_path / f"a{ending}", noise(np.uint8), icc=ICC)
    assert read_layer(tmp_path / f"a{ending}").icc == ICC


def test_icc_profile_is_carried_by_png(tmp_path):
    """OpenImageIO writes PNG's profiles but does not read them, so look into the file."""
    write_image(tmp_path / "a.png", noise(np.uint8), icc=rgb_profile())
    chunks = png_chunks(tmp_path / "a.png")
    assert zlib.decompress(chunks[b"iCCP"].split(b"\0", 1)[1][1:]) == rgb_profile()
    assert b"sRGB" not in chunks and b"gAMA" not in chunks


@pytest.mark.parametrize("broken", ["no profile at all" * 20, "short", "cut"])
def test_png_leaves_a_broken_profile_out(tmp_path, broken, caplog):
    """Bytes that are none, and one that ends too early."""
    pixels = noise(np.uint8)
    icc = rgb_profile()[:-4] if broken == "cut" else broken.encode()
    write_image(tmp_path / "a.png", pixels, icc=icc)
    assert "a.png: written without the layers' ICC profile (" in caplog.text
    assert b"iCCP" not in png_chunks(tmp_path / "a.png")
    assert np.array_equal(whole(read_layer(tmp_path / "a.png")), pixels)


def png_chunks(path: Path) -> dict[bytes, bytes]:
    data, at, found = path.read_bytes(), 8, {}
    while at < len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        found[data[at + 4 : at + 8]] = data[at + 8 : at + 8 + length]
        at += length + 12
    return found


def rgb_profile() -> bytes:
    """The least that PNG's library takes for a profile: the header of an RGB display and one tag."""
    tag = b"text\0\0\0\0none\0\0\0\0"
    header = bytearray(128)
    header[0:4] = (128 + 4 + 12 + len(tag)).to_bytes(4, "big")
    header[8:12] = bytes((2, 0x20, 0, 0))
    header[12:16], header[16:20], header[20:24], header[36:40] = b"mntr", b"RGB ", b"XYZ ", b"acsp"
    header[68:80] = bytes.fromhex("0000f6d6 00010000 0000d32d")  # D50
    table = (1).to_bytes(4, "big") + b"cprt" + (144).to_bytes(4, "big") + len(tag).to_bytes(4, "big")
    return bytes(header) + table + tag


# ------------------------------------------------------------------------------------ TIFF tags


def tags(exiftool: str, path: Path) -> dict:
    shown = subprocess.run([exiftool, "-j", "-n", str(path)], capture_output=True, text=True, check=True)
    return json.loads(shown.stdout)[0]


@pytest.mark.parametrize("offset", [(0, 0), (49, 0), (656, 101)])
def test_tiff_tags_are_those_of_enblend(tmp_path, exiftool, enblend, offset):
    x, y = offset
    pixels = noise(np.uint8)
    pixels[..., -1] = 255
    pixels[3, 4:9, -1] = 0
    write_image(tmp_path / "ours.tif", pixels, offset=offset)
    size = f"-f131x77+{x}+{y}"
    command = [enblend, size, "--compression=LZW", "-o", tmp_path / "theirs.tif", tmp_path / "ours.tif"]
    subprocess.run(command, check=True, capture_output=True)
    ours, theirs = tags(exiftool, tmp_path / "ours.tif"), tags(exiftool, tmp_path / "theirs.tif")
    about_file = {"SourceFile", "FileName", "FileSize", "StripOffsets", "StripByteCounts", "RowsPerStrip"}
    names = {name for name in theirs if not name.startswith("File")} - about_file
    # a predictor makes LZW files smaller; unsigned samples are the default
    optional = {"Predictor", "SubfileType", "SampleFormat"}
    positions = {"XPosition", "YPosition"}
    assert set(ours) - names - about_file - optional <= {n for n in ours if n.startswith("File")}
    for name in names - optional - positions:
        assert ours[name] == theirs[name], name
    assert ours["XPosition"] == pytest.approx(x / 150, abs=1e-6)
    for name in positions:
        assert theirs[name] == pytest.approx(ours[name], abs=1e-6)


def test_equal_panoramas_are_equal_files(tmp_path):
    hashes = set()
    for name in ("a.tif", "b.tif"):
        write_image(tmp_path / name, noise(np.uint8))
        hashes.add(hashlib.sha256((tmp_path / name).read_bytes()).hexdigest())
    assert len(hashes) == 1
    assert 306 not in tifffile.TiffFile(tmp_path / "a.tif").pages[0].tags  # DateTime: no trace of it


def test_bigtiff_when_classic_could_not_hold_it(tmp_path, monkeypatch):
    """LZW may make noise half as large again."""
    assert imagewriter._CLASSIC_LIMIT < 1 << 32
    monkeypatch.setattr(imagewriter, "_CLASSIC_LIMIT", 1.2 * noise(np.uint8).nbytes)
    for compression, version in (("none", 42), ("deflate", 42), ("lzw", 43)):
        write_image(tmp_path / "a.tif", noise(np.uint8), compression=compression)
        assert (tmp_path / "a.tif").read_bytes()[2] == version
        np.testing.assert_array_equal(tifffile.imread(tmp_path / "a.tif"), noise(np.uint8))


# ------------------------------------------------------------------------------------ whole or not at all


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("interruption", [KeyboardInterrupt, ValueError])
def test_interrupted_write_leaves_the_old_file(tmp_path, ending, interruption):
    path = tmp_path / f"päno rama{ending}"
    pixels = noise(np.float16 if ending == ".exr" else np.uint8)
    write_image(path, pixels)
    old = path.read_bytes()
    with pytest.raises(interruption), ImageWriter(path, 131, 77, 3, pixels.dtype) as writer:
        writer.write_rows(pixels[:40])
        raise interruption
    assert path.read_bytes() == old
    assert names_in(tmp_path) == [path.name]


@pytest.mark.parametrize("ending", ENDINGS)
def test_file_is_replaced_when_complete(tmp_path, ending):
    path = tmp_path / f"päno rama{ending}"
    path.write_bytes(b"old")
    pixels = noise(np.float16 if ending == ".exr" else np.uint8)
    with ImageWriter(path, 131, 77, 3, pixels.dtype) as writer:
        for top in range(0, 77, 9):
            writer.write_rows(pixels[top : top + 9])
            assert path.read_bytes() == b"old"
    assert read_layer(path).box == Box(0, 0, 131, 77)
    assert names_in(tmp_path) == [path.name]


def test_new_files_get_the_usual_permissions(tmp_path):
    (tmp_path / "plain").touch()
    write_image(tmp_path / "a.tif", noise(np.uint8))
    assert (tmp_path / "a.tif").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_link_is_written_through(tmp_path):
    (tmp_path / "far").mkdir()
    (tmp_path / "far" / "real.tif").write_bytes(b"old")
    (tmp_path / "link.tif").symlink_to(tmp_path / "far" / "real.tif")
    write_image(tmp_path / "link.tif", noise(np.uint8))
    assert (tmp_path / "link.tif").is_symlink()
    assert read_layer(tmp_path / "far" / "real.tif").box.width == 131


def test_missing_rows_are_an_error(tmp_path):
    writer = ImageWriter(tmp_path / "a.tif", 131, 77, 3, np.uint8)
    with pytest.raises(OutputError, match="only 40 of 77 rows"), writer:
        writer.write_rows(noise(np.uint8)[:40])
    assert not names_in(tmp_path)


def test_rows_of_another_kind_are_a_mistake_of_the_caller(tmp_path):
    wrong = [
        noise(np.uint16),
        noise(np.uint8, channels=1),
        noise(np.uint8, width=130),
        noise(np.uint8, height=78),
    ]
    for pixels in wrong:
        writer = ImageWriter(tmp_path / "a.tif", 131, 77, 3, np.uint8)
        with pytest.raises(ValueError), writer:
            writer.write_rows(pixels)
    assert not names_in(tmp_path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_pipe_behind_a_link_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "a.tif").symlink_to(tmp_path / "pipe")
    with pytest.raises(OutputError, match=r"a\.tif is no ordinary file"):
        write_image(tmp_path / "a.tif", noise(np.uint8))
    assert (tmp_path / "pipe").is_fifo()
    assert {path.name for path in tmp_path.iterdir()} == {"pipe", "a.tif"}


@pytest.mark.parametrize("shape", [(5, 7), (5, 7, 3), (5, 7, 1), (0, 7, 4)])
def test_pixels_without_alpha_are_refused(tmp_path, shape):
    with pytest.raises(OutputError, match=r"a\.tif: the pixels have the shape .*RGB and alpha"):
        write_image(tmp_path / "a.tif", np.zeros(shape, np.uint8))
    assert not list(tmp_path.iterdir())


def test_name_that_is_too_long_is_an_output_error(tmp_path):
    with pytest.raises(OutputError, match=r"\.tif cannot be written"):
        write_image(tmp_path / f"{'a' * 300}.tif", noise(np.uint8))
    assert not list(tmp_path.iterdir())


def test_output_errors_name_the_file_and_what_to_do(tmp_path):
    pixels = noise(np.uint8)
    with pytest.raises(OutputError, match=r"a\.bmp: the ending must be one of \.tif, .*\.exr"):
        write_image(tmp_path / "a.bmp", pixels)
    with pytest.raises(OutputError, match="EXR holds half or float, and these are uint8"):
        write_image(tmp_path / "a.exr", pixels)
    with pytest.raises(OutputError, match="int32"):
        write_image(tmp_path / "a.tif", pixels.astype(np.int32))
    with pytest.raises(OutputError, match=r"missing.*a\.tif cannot be written.*No such file"):
        write_image(tmp_path / "missing" / "a.tif", pixels)
    with pytest.raises(OutputError, match="is a folder"):
        write_image(make_folder(tmp_path / "b.tif"), pixels)
    with pytest.raises(OutputError, match=r"'lzma'; choose one of none, packbits, lzw, deflate, zstd, jpeg$"):
        write_image(tmp_path / "a.tif", pixels, compression="lzma")
    with pytest.raises(OutputError, match="'jpeg:85'; choose one of"):  # quality has an argument of its own
        write_image(tmp_path / "a.tif", pixels, compression="jpeg:85")
    with pytest.raises(OutputError, match="quality 101"):
        write_image(tmp_path / "a.jpg", pixels, jpeg_quality=101)
    for name in ("a.jpg", "a.tif"):
        with pytest.raises(OutputError, match="65500"):
            ImageWriter(tmp_path / name, 70_000, 9, 3, np.uint8, compression="jpeg")
    with pytest.raises(OutputError, match="negative position"):
        write_image(tmp_path / "a.tif", pixels, offset=(-1, 0))
    assert names_in(tmp_path) == ["b.tif"]


def make_folder(path: Path) -> Path:
    path.mkdir()
    return path


def test_unwritable_folder(tmp_path):
    folder = make_folder(tmp_path / "closed")
    folder.chmod(0o500)
    try:
        if os.access(folder, os.W_OK):
            pytest.skip("this user may write everywhere")  # as root may, in containers
        with pytest.raises(OutputError, match="Permission denied"):
            write_image(folder / "a.tif", noise(np.uint8))
    finally:
        folder.chmod(0o700)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems' names of files are Unicode")
def test_a_name_may_be_no_unicode_but_its_folder_must(tmp_path):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xe9"))
    folder.mkdir()
    with pytest.raises(OutputError, match="UTF-8; rename"):
        write_image(folder / "a.tif", noise(np.uint8))
    assert not names_in(folder)
    folder.rmdir()
    write_image(folder.with_suffix(".tif"), noise(np.uint8))
    assert folder.with_suffix(".tif").is_file()


@pytest.mark.skipif(os.name == "nt", reason="only administrators make links on Windows")
def test_link_to_itself_is_replaced(tmp_path):
    """Nothing else can come of it; Python before 3.13 takes it for an error of the program."""
    (tmp_path / "a.tif").symlink_to("a.tif")
    pixels = noise(np.uint8)
    write_image(tmp_path / "a.tif", pixels)
    assert np.array_equal(whole(read_layer(tmp_path / "a.tif")), pixels)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("depth", [np.uint8, np.uint16, np.float16, np.float32, np.float64])
def test_tiff_holds_the_depth_that_is_asked_for(tmp_path: Path, dtype: type, depth: type) -> None:
    """Any to any; black and white stay what they are."""
    path, full = tmp_path / "a.tif", full_scale(dtype)
    pixels = (np.linspace(0, 1, 64) * full).astype(dtype).reshape(4, 4, 4)
    with ImageWriter(path, 4, 4, 3, dtype, depth=depth) as writer:
        writer.write_rows(pixels)
    found = tifffile.imread(path)
    assert found.dtype == depth
    scale = full_scale(depth)
    expected = pixels.astype(float) / full * scale
    if found.dtype.kind == "u":
        expected = np.rint(expected)
    np.testing.assert_allclose(found, expected, rtol=1e-3 if depth == np.float16 else 1e-6, atol=1e-6)
    assert found.min() == 0 and found.max() == scale

"""Reading layers, writing panoramas."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import threading
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import tifffile
from conftest import photo_pixels

from hugin_abflow.errors import ImageReadError, OutputError
from hugin_abflow.images import ENDINGS, ImageWriter, read_layer, read_layers, write_image
from hugin_abflow.layer import Box, full_scale

DTYPES = [np.uint8, np.uint16, np.float16, np.float32]
ICC = bytes(range(256)) * 3  # carried, never interpreted


def noise(dtype, channels: int = 3, width: int = 131, height: int = 77, seed: int = 0) -> np.ndarray:
    """Random pixels with binary alpha, colours under alpha 0 too: (height, width, channels + 1)."""
    values = np.random.default_rng(seed).random((height, width, channels + 1))
    pixels = values.astype(dtype)
    if np.dtype(dtype).kind == "u":
        pixels = np.rint(values * full_scale(dtype)).astype(dtype)
    pixels[..., -1] = np.where(values[..., -1] > 0.4, full_scale(dtype), 0)
    return pixels


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def whole(layer) -> np.ndarray:
    return layer.read(0, layer.box.height)


# ------------------------------------------------------------------------------------ round trips


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("compression", ["none", "lzw", "packbits", "deflate"])
def test_tiff_comes_back_exactly(tmp_path, dtype, channels, compression):
    pixels = noise(dtype, channels)
    write_image(tmp_path / "a.tif", pixels, offset=(656, 49), icc=ICC, compression=compression)
    layer = read_layer(tmp_path / "a.tif")
    assert layer.box == Box(656, 49, 656 + 131, 49 + 77)
    assert (layer.dtype, layer.channels, layer.icc) == (np.dtype(dtype), channels, ICC)
    assert layer.canvas_size is None
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


def test_16_to_8_bit_rounds_to_nearest(tmp_path):
    pixels = np.full((1, 65536, 2), 65535, np.uint16)
    pixels[0, :, 0] = np.arange(65536)
    with ImageWriter(tmp_path / "a.jpg", 256, 256, 1, np.uint16) as writer:
        converted = writer._convert(pixels.reshape(256, 256, 2))
        writer.write_rows(pixels.reshape(256, 256, 2))
    assert np.array_equal(converted.ravel(), np.rint(np.arange(65536) / 257).astype(np.uint8))


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
    # a predictor makes LZW files smaller, the position of (0, 0) is the default
    optional = {"Predictor", "XPosition", "YPosition", "SubfileType"}
    assert set(ours) - names - about_file - optional <= {n for n in ours if n.startswith("File")}
    for name in names - optional:
        assert ours[name] == theirs[name], name
    assert ours.get("XPosition", 0) == pytest.approx(x / 150, abs=1e-6)
    assert theirs.get("YPosition", 0) == pytest.approx(ours.get("YPosition", 0), abs=1e-6)


@pytest.mark.parametrize("resolution, unit", [(150, 2), (72, 2), (300, 2), (59.055, 3)])
def test_positions_of_any_resolution_are_rounded_not_truncated(tmp_path, resolution, unit):
    for x in (1, 26, 49, 63, 64, 656, 4095, 17999):
        position = (int(x / resolution * 65536 + 0.5), 65536)
        extra = [(286, "2I", 1, position, True), (287, "2I", 1, position, True)]
        tifffile.imwrite(
            tmp_path / "a.tif",
            noise(np.uint8, width=5, height=3),
            photometric="rgb",
            extrasamples=["unassalpha"],
            resolution=(resolution, resolution),
            resolutionunit=unit,
            extratags=extra,
        )
        assert read_layer(tmp_path / "a.tif").box == Box(x, x, x + 5, x + 3)


def test_positions_as_libtiff_makes_them_from_floats(tmp_path):
    extra = [(286, "2I", 1, (9171545, 2097152), True), (287, "2I", 1, (0, 1), True)]
    extra += [(33300, "I", 1, 2000, True), (33301, "I", 1, 1000, True)]
    pixels = noise(np.uint8)
    tifffile.imwrite(
        tmp_path / "a.tif",
        pixels,
        photometric="rgb",
        extrasamples=["unassalpha"],
        resolution=(150, 150),
        extratags=extra,
    )
    layer = read_layer(tmp_path / "a.tif")
    assert layer.box == Box(656, 0, 656 + 131, 77)
    assert layer.canvas_size == (2000, 1000)


def test_equal_panoramas_are_equal_files(tmp_path):
    hashes = set()
    for name in ("a.tif", "b.tif"):
        write_image(tmp_path / name, noise(np.uint8))
        hashes.add(hashlib.sha256((tmp_path / name).read_bytes()).hexdigest())
    assert len(hashes) == 1
    assert 306 not in tifffile.TiffFile(tmp_path / "a.tif").pages[0].tags  # DateTime: no trace of it


def test_bigtiff_when_classic_could_not_hold_it(tmp_path):
    """Only the header is looked at; the file is given up after its first row."""
    kinds = {}
    for width, compression in ((36_000, "lzw"), (36_000, "none"), (42_000, "none"), (80_000, "lzw")):
        row = np.zeros((1, width, 4), np.uint8)
        writer = ImageWriter(tmp_path / "a.tif", width, width // 2, 3, np.uint8, compression=compression)
        with pytest.raises(KeyboardInterrupt), writer:
            writer.write_rows(row)
            raise_after_look(kinds, (width, compression), tmp_path)
    assert kinds == {
        (36_000, "lzw"): 42,
        (36_000, "none"): 42,  # 2.6 GB
        (42_000, "none"): 42,  # 3.5 GB
        (80_000, "lzw"): 43,  # 12.8 GB
    }


def raise_after_look(kinds: dict, key: tuple, folder: Path) -> None:
    (part,) = folder.iterdir()
    kinds[key] = part.read_bytes()[2]
    raise KeyboardInterrupt


@pytest.mark.parametrize("compression", ["jpeg", "jpeg:85", "zstd"])
def test_compressions_that_do_not_exist_are_named(tmp_path, compression, caplog):
    with ImageWriter(tmp_path / "a.tif", 131, 77, 3, np.uint8, compression=compression) as writer:
        writer.write_rows(noise(np.uint8))
        assert writer.compression == "deflate"
    assert compression in caplog.text and "deflate is used" in caplog.text
    assert int(tifffile.TiffFile(tmp_path / "a.tif").pages[0].compression) == 8


# ------------------------------------------------------------------------------------ kinds of input


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    "options",
    [
        {"bigtiff": True},
        {"byteorder": ">"},
        {"bigtiff": True, "byteorder": ">"},
        {"tile": (32, 16)},
        {"tile": (32, 16), "compression": "lzw"},
        {"compression": "lzw", "rowsperstrip": 7},
        {"compression": "lzw", "rowsperstrip": 77},
        {"compression": "deflate", "rowsperstrip": 50},
    ],
    ids=str,
)
def test_tiff_kinds_are_read_in_any_order(tmp_path, dtype, options):
    if options.get("compression") == "lzw" and not has_codecs():
        pytest.skip("imagecodecs is not installed")
    pixels = noise(dtype)
    tifffile.imwrite(tmp_path / "a.tif", pixels, photometric="rgb", extrasamples=["unassalpha"], **options)
    layer = read_layer(tmp_path / "a.tif")
    assert np.array_equal(whole(layer), pixels)
    for top, bottom in ((0, 1), (5, 30), (20, 77), (76, 77), (60, 61), (0, 77), (3, 3), (70, 75), (10, 76)):
        rows = layer.read(top, bottom)
        assert rows.shape == (bottom - top, 131, 4)
        assert rows.flags.c_contiguous
        assert np.array_equal(rows, pixels[top:bottom])


def has_codecs() -> bool:
    try:
        import imagecodecs  # noqa: F401
    except ImportError:
        return False
    return True


def test_planar_tiff(tmp_path):
    pixels = noise(np.uint8)
    planes = np.ascontiguousarray(np.moveaxis(pixels, 2, 0))
    tifffile.imwrite(
        tmp_path / "a.tif", planes, photometric="rgb", extrasamples=["unassalpha"], planarconfig="separate"
    )
    assert np.array_equal(whole(read_layer(tmp_path / "a.tif")), pixels)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("dtype", DTYPES)
def test_without_alpha_all_is_opaque(tmp_path, dtype, channels):
    colours = photo_pixels(2, dtype, channels)
    kind = "rgb" if channels == 3 else "minisblack"
    tifffile.imwrite(tmp_path / "a.tif", colours if channels == 3 else colours[..., 0], photometric=kind)
    rows = whole(read_layer(tmp_path / "a.tif"))
    assert np.array_equal(rows[..., :-1], colours)
    assert (rows[..., -1] == full_scale(dtype)).all()


def test_unspecified_extra_sample_is_alpha(tmp_path):
    pixels = noise(np.uint8)
    tifffile.imwrite(tmp_path / "a.tif", pixels, photometric="rgb", extrasamples=["unspecified"])
    assert np.array_equal(whole(read_layer(tmp_path / "a.tif")), pixels)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_associated_alpha_is_undone(tmp_path, dtype):
    full = int(full_scale(dtype))
    pixels = np.zeros((5, 7, 4), dtype)
    pixels[:2] = (full // 3, full // 4, 0, full)
    pixels[2:4] = (full // 3 // 2, full // 2, 0, full // 2)  # the second colour is full under half alpha
    tifffile.imwrite(tmp_path / "a.tif", pixels, photometric="rgb", extrasamples=["assocalpha"])
    rows = whole(read_layer(tmp_path / "a.tif"))
    assert np.array_equal(rows[:2], pixels[:2])
    assert np.abs(rows[2, 0].astype(int) - (full // 3, full, 0, full // 2)).max() <= 2
    assert not rows[4].any()


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
@pytest.mark.parametrize("ending", [".tif", ".exr"])
def test_nan_and_infinity_are_invalid_pixels(tmp_path, dtype, ending):
    pixels = noise(dtype)
    pixels[..., -1] = 1
    write_image(tmp_path / f"good{ending}", pixels)
    pixels[3, 5, 0], pixels[4, 6, 1], pixels[70, 0, 2] = np.nan, np.inf, -np.inf
    pixels[8, 8, :3] = 7.5  # bright, but valid
    write_image(tmp_path / f"bad{ending}", pixels)
    rows = whole(read_layer(tmp_path / f"bad{ending}"))
    expected = pixels.copy()
    expected[[3, 4, 70], [5, 6, 0]] = 0
    assert np.array_equal(rows, expected)


def test_exr_with_more_channels_gives_colours_and_alpha(tmp_path):
    spec = oiio.ImageSpec(9, 5, 5, "float")
    spec.channelnames = ("A", "B", "G", "R", "Z")
    spec.alpha_channel = 0
    values = np.random.default_rng(0).random((5, 9, 5)).astype(np.float32)
    values[..., 0] = 1
    output = oiio.ImageOutput.create(str(tmp_path / "a.exr"))
    assert output.open(str(tmp_path / "a.exr"), spec) and output.write_image(values) and output.close()
    assert np.array_equal(whole(read_layer(tmp_path / "a.exr")), values[..., [3, 2, 1, 0]])


def test_pages_are_layers_and_thumbnails_are_not(tmp_path):
    first, second = noise(np.uint8, seed=1), noise(np.uint8, width=31, height=19, seed=2)
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for pixels, kind in ((first, 2), (noise(np.uint8, width=9, height=5), 1), (second, 2)):
            x = [(286, "2I", 1, (len(pixels), 10), True), (287, "2I", 1, (0, 1), True)]
            file.write(
                pixels,
                photometric="rgb",
                extrasamples=["unassalpha"],
                subfiletype=kind,
                resolution=(10, 10),
                extratags=x,
            )
    layers = read_layers(tmp_path / "a.tif")
    assert [layer.box for layer in layers] == [Box(77, 0, 77 + 131, 77), Box(19, 0, 19 + 31, 19)]
    assert [layer.name for layer in layers] == ["a.tif[0]", "a.tif[2]"]
    assert np.array_equal(whole(layers[1]), second)
    assert np.array_equal(whole(layers[0]), first)
    with pytest.raises(ImageReadError, match="2 layers"):
        read_layer(tmp_path / "a.tif")


UNUSABLE = {
    "palette": lambda p: tifffile.imwrite(
        p, np.zeros((5, 7), np.uint8), photometric="palette", colormap=np.zeros((3, 256), np.uint16)
    ),
    "CMYK": lambda p: tifffile.imwrite(p, np.zeros((5, 7, 4), np.uint8), photometric="separated"),
    "1-bit": lambda p: tifffile.imwrite(p, np.zeros((5, 7), bool), photometric="minisblack"),
    "int16": lambda p: tifffile.imwrite(p, np.zeros((5, 7, 3), np.int16), photometric="rgb"),
    "double": lambda p: tifffile.imwrite(p, np.zeros((5, 7, 3), np.float64), photometric="rgb"),
    "not there": lambda p: None,
    "cannot be read": lambda p: p.write_bytes(b"no image at all"),
    "cannot be read (": lambda p: p.write_bytes(b"II*\0\xff\xff\xff\x7f"),
}


@pytest.mark.parametrize("what", UNUSABLE)
def test_unusable_files_are_named_with_the_reason(tmp_path, what):
    path = tmp_path / "layer ä.tif"
    UNUSABLE[what](path)
    with pytest.raises(ImageReadError) as error:
        read_layer(path)
    assert str(path) in str(error.value) and what in str(error.value)


def test_broken_pixels_are_an_error_each_time(tmp_path):
    path = tmp_path / "a.tif"
    write_image(path, noise(np.uint8, width=600, height=300))
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 9000] = bytes(9000)
    path.write_bytes(data)
    layer = read_layer(path)
    for _ in range(2):
        with pytest.raises(ImageReadError, match=r"a\.tif cannot be read"):
            whole(layer)


def test_rows_outside_are_a_mistake_of_the_caller(tmp_path):
    write_image(tmp_path / "a.tif", noise(np.uint8))
    layer = read_layer(tmp_path / "a.tif")
    for top, bottom in ((-1, 3), (5, 4), (70, 78)):
        with pytest.raises(IndexError):
            layer.read(top, bottom)


# ------------------------------------------------------------------------------------ how it is read


class Counting:
    """An ImageInput that counts the rows it decodes."""

    def __init__(self, source, rows: list[tuple[int, int]]):
        self._source, self._rows = source, rows

    def __getattr__(self, name):
        return getattr(self._source, name)

    def read_scanlines(self, top, bottom, *rest):
        self._rows.append((top, bottom))
        return self._source.read_scanlines(top, bottom, *rest)


@pytest.mark.parametrize("rows_per_strip", [7, 32, 40])
def test_overlapping_bands_decode_each_row_once(tmp_path, monkeypatch, rows_per_strip):
    from hugin_abflow import images

    pixels = noise(np.uint8, width=61, height=300)
    tifffile.imwrite(
        tmp_path / "a.tif",
        pixels,
        photometric="rgb",
        extrasamples=["unassalpha"],
        rowsperstrip=rows_per_strip,
    )
    decoded: list[tuple[int, int]] = []
    real_open = images._open
    monkeypatch.setattr(images, "_open", lambda path, page: Counting(real_open(path, page), decoded))
    layer = read_layer(tmp_path / "a.tif")
    for top in range(0, 300, 40):
        first, last = max(0, top - 11), min(300, top + 40 + 11)
        assert np.array_equal(layer.read(first, last), pixels[first:last])
    steps = [row for span in decoded for row in range(*span)]
    assert set(steps) == set(range(300))
    # none twice, but for the strips at the end: once they are read the layer forgets them
    assert len(steps) <= 300 + 2 * rows_per_strip
    assert all(top % rows_per_strip == 0 for top, _ in decoded)


def test_answers_stay_as_they_were_given(tmp_path):
    pixels = noise(np.uint8, height=301)
    write_image(tmp_path / "a.tif", pixels)
    layer = read_layer(tmp_path / "a.tif")
    answers = [(top, layer.read(top, top + 30)) for top in range(0, 270, 20)]
    for top, rows in answers:
        assert np.array_equal(rows, pixels[top : top + 30])
        with pytest.raises(ValueError):
            rows[0, 0, 0] = 1  # shared memory: a caller that writes into it must copy


def test_many_threads_read_one_layer(tmp_path):
    pixels = noise(np.uint16, height=301)
    write_image(tmp_path / "a.tif", pixels)
    layer = read_layer(tmp_path / "a.tif")
    start = threading.Barrier(4)

    def work(seed: int) -> bool:
        random = np.random.default_rng(seed)
        start.wait()
        return all(
            np.array_equal(layer.read(top, top + 25), pixels[top : top + 25])
            for top in random.integers(0, 276, 40)
        )

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(work, range(4)))


def test_a_layer_read_to_its_end_holds_no_file(tmp_path):
    paths = [tmp_path / f"{index}.tif" for index in range(30)]
    for path in paths:
        write_image(path, noise(np.uint8))
    before = open_files()
    layers = [read_layer(path) for path in paths]
    for layer in layers:
        whole(layer)
    assert open_files() <= before + 2


def open_files() -> int:
    folder = Path("/proc/self/fd")
    if not folder.is_dir():
        pytest.skip("this system does not list open files")
    return len(names_in(folder))


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


def test_output_errors_name_the_file_and_what_to_do(tmp_path):
    pixels = noise(np.uint8)
    with pytest.raises(OutputError, match=r"a\.bmp: the ending must be one of \.tif, .*\.exr"):
        write_image(tmp_path / "a.bmp", pixels)
    with pytest.raises(OutputError, match="EXR holds half or float, the layers have uint8"):
        write_image(tmp_path / "a.exr", pixels)
    with pytest.raises(OutputError, match="int32"):
        write_image(tmp_path / "a.tif", pixels.astype(np.int32))
    with pytest.raises(OutputError, match=r"missing.*a\.tif cannot be written.*No such file"):
        write_image(tmp_path / "missing" / "a.tif", pixels)
    with pytest.raises(OutputError, match="is a folder"):
        write_image(make_folder(tmp_path / "b.tif"), pixels)
    with pytest.raises(OutputError, match="'lzma'; choose one of none, lzw"):
        write_image(tmp_path / "a.tif", pixels, compression="lzma")
    with pytest.raises(OutputError, match="quality 101"):
        write_image(tmp_path / "a.jpg", pixels, jpeg_quality=101)
    with pytest.raises(OutputError, match="65500"):
        ImageWriter(tmp_path / "a.jpg", 70_000, 9, 3, np.uint8)
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
            pytest.skip("this user may write everywhere")
        with pytest.raises(OutputError, match="Permission denied"):
            write_image(folder / "a.tif", noise(np.uint8))
    finally:
        folder.chmod(0o700)


def test_full_disk(tmp_path):
    """A limit on file size stands for a full disk."""
    resource = pytest.importorskip("resource")
    import signal

    old_action = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        with pytest.raises(OutputError, match=r"a\.tif cannot be written"):
            write_image(tmp_path / "a.tif", noise(np.uint16, width=401, height=301))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, old_action)
    assert not names_in(tmp_path)

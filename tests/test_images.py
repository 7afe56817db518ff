"""Reading layers: places, kinds of files, rows in any order."""

from __future__ import annotations

import os
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import tifffile
from conftest import DTYPES, names_in, noise, photo_pixels, whole
from layer_files import write_layer

from hugin_abflow.errors import ImageReadError, OutputError
from hugin_abflow.images import read_layer, read_layers, write_image
from hugin_abflow.layer import Box, full_scale

# ------------------------------------------------------------------------------------ places


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
    pixels = noise(dtype)
    tifffile.imwrite(tmp_path / "a.tif", pixels, photometric="rgb", extrasamples=["unassalpha"], **options)
    layer = read_layer(tmp_path / "a.tif")
    assert np.array_equal(whole(layer), pixels)
    for top, bottom in ((0, 1), (5, 30), (20, 77), (76, 77), (60, 61), (0, 77), (3, 3), (70, 75), (10, 76)):
        rows = layer.read(top, bottom)
        assert rows.shape == (bottom - top, 131, 4)
        assert rows.flags.c_contiguous
        assert np.array_equal(rows, pixels[top:bottom])


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


def test_grey_whose_0_is_white(tmp_path):
    """Where OpenImageIO inverts what it should, and no more."""
    colours = photo_pixels(2, np.uint8, 1)
    tifffile.imwrite(tmp_path / "a.tif", colours[..., 0], photometric="miniswhite")
    rows = whole(read_layer(tmp_path / "a.tif"))
    assert np.array_equal(rows[..., :-1], 255 - colours) and (rows[..., -1] == 255).all()


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
    "Lab": lambda p: tifffile.imwrite(p, np.zeros((5, 7, 3), np.uint8), photometric="cielab"),
    "whose 0 is white": lambda p: tifffile.imwrite(
        p, np.zeros((5, 7, 2), np.uint8), photometric="miniswhite", extrasamples=["unassalpha"]
    ),
    "0 is white": lambda p: tifffile.imwrite(p, np.zeros((5, 7), np.uint16), photometric="miniswhite"),
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


@pytest.mark.skipif(sys.platform != "linux", reason="other systems' names of files are Unicode")
def test_a_name_that_is_no_unicode_is_refused(tmp_path):
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xe9.tif"))
    path.write_bytes(b"")
    with pytest.raises(ImageReadError, match="UTF-8; rename"):
        read_layer(path)


def test_missing_strips_are_told_once(tmp_path):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, noise(np.uint8, width=61, height=90), photometric="rgb", rowsperstrip=5)
    path.write_bytes(path.read_bytes()[:9000])
    with pytest.raises(ImageReadError) as error:
        whole(read_layer(path))
    assert "a.tif cannot be read (" in str(error.value) and "\n" not in str(error.value)


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


@pytest.mark.parametrize(
    ("name", "compression", "compressed"),
    [
        ("a.tif", "none", False), ("a.tif", "lzw", True), ("a.tif", "zstd", True),
        ("a.exr", "none", False), ("a.exr", "zip", True), ("a.png", None, True),
    ],
)  # fmt: skip
def test_layers_tell_whether_their_files_are_compressed(tmp_path, name, compression, compressed):
    dtype = np.float32 if name.endswith("exr") else np.uint8
    write_image(tmp_path / name, noise(dtype, width=31, height=17), compression=compression)
    assert read_layer(tmp_path / name).compressed == compressed


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


def test_two_threads_decode_one_layer_at_a_time(tmp_path, monkeypatch):
    """And one, in whatever order, keeps one file open."""
    from hugin_abflow import images

    pixels = noise(np.uint8, width=61, height=300)
    write_image(tmp_path / "a.tif", pixels)
    both, opened = threading.Barrier(2, timeout=60), []

    class Meeting(Counting):
        def read_scanlines(self, *span):
            if not both.broken:
                both.wait()
            return super().read_scanlines(*span)

    real_open = images._open
    monkeypatch.setattr(
        images, "_open", lambda path, page: opened.append(Meeting(real_open(path, page), [])) or opened[-1]
    )
    layer = read_layer(tmp_path / "a.tif")
    opened.clear()  # what told of the layer
    with ThreadPoolExecutor(2) as threads:
        first, second = threads.map(layer.read, (0, 160), (100, 260))
    assert np.array_equal(first, pixels[:100]) and np.array_equal(second, pixels[160:260])
    assert len(opened) == 2
    both.abort()
    for top in (250, 20, 130, 64, 200):
        assert np.array_equal(layer.read(top, top + 40), pixels[top : top + 40])
    assert len(opened) == 2


@pytest.mark.parametrize("last", [True, False])
def test_a_layer_that_threads_read_to_its_end_holds_no_file(tmp_path, last):
    """Whoever is the last one to read of it."""
    write_image(tmp_path / "a.tif", noise(np.uint8, width=61, height=300))
    before, layer = open_files(), read_layer(tmp_path / "a.tif")
    rows = layer.read.__self__
    with rows._decoder(0) as first, rows._decoder(200) as second:
        first.read(0, 100)
        second.read(200, 300)
        assert open_files() == before + 2
        rows._done = True  # one of them had the last rows
    del first, second
    assert open_files() == before
    layer.read(200, 299 + last)
    assert open_files() == before + (not last)


def test_a_decoder_that_failed_is_not_used_again(tmp_path):
    """Where it stands nobody knows."""
    write_image(tmp_path / "a.tif", noise(np.uint8))
    rows = read_layer(tmp_path / "a.tif").read.__self__
    with pytest.raises(ValueError), rows._decoder(0) as failed:
        raise ValueError
    with rows._decoder(0) as found:
        assert found is not failed
    with rows._decoder(0) as again:
        assert again is found


def test_where_decoding_stands_it_goes_on(tmp_path):
    """Two threads that take turns keep their places."""
    write_image(tmp_path / "a.tif", noise(np.uint8, width=61, height=300))
    rows = read_layer(tmp_path / "a.tif").read.__self__
    with rows._decoder(0) as first, rows._decoder(200) as second:
        first.read(0, 40)
        second.read(200, 240)
    for _ in range(3):
        with rows._decoder(240) as found:
            assert found is second
        with rows._decoder(40) as found:
            assert found is first


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
        pytest.skip("this system does not list open files")  # only Linux does
    return len(names_in(folder))


@pytest.mark.parametrize("alpha", [True, False])
def test_layer_tells_whether_its_file_has_alpha(tmp_path: Path, alpha: bool) -> None:
    write_layer(tmp_path / "a.tif", np.full((5, 7, 4), 255, np.uint8), alpha=alpha)
    assert read_layer(tmp_path / "a.tif").has_alpha == alpha


def test_a_write_protected_file_is_not_replaced(tmp_path):
    """A rename would, whoever may write into the folder."""
    file = tmp_path / "a.tif"
    write_image(file, np.zeros((3, 5, 4), np.uint8))
    before = file.read_bytes()
    file.chmod(0o444)
    with pytest.raises(OutputError, match=r"a\.tif is write-protected"):
        write_image(file, np.ones((3, 5, 4), np.uint8))
    assert file.read_bytes() == before
    file.chmod(0o644)
    write_image(file, np.ones((3, 5, 4), np.uint8))
    assert file.read_bytes() != before

"""TIFF encoded on several cores: each compression is what it says, and nothing depends on cores or bands."""

from __future__ import annotations

import queue
import threading

import numpy as np
import pytest
import tifffile
from conftest import noise, whole

from hugin_abflow import imagewriter, tiffwriter
from hugin_abflow.errors import OutputError
from hugin_abflow.images import ImageWriter, read_layer, write_image


@pytest.mark.parametrize(("dtype", "channels"), [(np.uint16, 3), (np.uint8, 1)])
def test_jpeg_in_tiff_is_for_8_bit_rgb(tmp_path, caplog, dtype, channels):
    write_image(tmp_path / "a.tif", noise(dtype, channels), compression="jpeg")
    assert "jpeg" in caplog.text and "deflate is used" in caplog.text
    assert int(tifffile.TiffFile(tmp_path / "a.tif").pages[0].compression) == 8
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "a.tif"), noise(dtype, channels))


def test_jpeg_in_tiff_is_as_good_as_asked_for(tmp_path):
    """Other programs read it, alpha as well."""
    y, x = np.mgrid[:77, :131]
    smooth = np.stack([x, y, x + y, np.full_like(x, 255)], -1).astype(np.uint8)
    sizes = []
    for quality in (None, 30, 98):
        write_image(tmp_path / "a.tif", smooth, compression="jpeg", jpeg_quality=quality)
        assert int(tifffile.TiffFile(tmp_path / "a.tif").pages[0].compression) == 7
        for read in (tifffile.imread(tmp_path / "a.tif"), whole(read_layer(tmp_path / "a.tif"))):
            assert np.abs(read.astype(int) - smooth).max() <= (24 if quality == 30 else 6)
        sizes.append((tmp_path / "a.tif").stat().st_size)
    assert sizes[1] < sizes[0] < sizes[2]


def test_zstd_is_zstd(tmp_path):
    for dtype in (np.uint8, np.float32):
        write_image(tmp_path / "a.tif", noise(dtype), compression="zstd")
        assert int(tifffile.TiffFile(tmp_path / "a.tif").pages[0].compression) == 50000
        np.testing.assert_array_equal(tifffile.imread(tmp_path / "a.tif"), noise(dtype))


@pytest.mark.parametrize("compression", ["none", "packbits", "lzw", "deflate", "zstd", "jpeg"])
def test_neither_threads_nor_bands_change_the_file(tmp_path, compression):
    files = set()
    for threads, rows in ((1, 77), (3, 5), (2, 33)):
        with ImageWriter(
            tmp_path / "a.tif", 131, 77, 3, np.uint8, compression=compression, threads=threads
        ) as writer:
            for top in range(0, 77, rows):
                writer.write_rows(noise(np.uint8)[top : top + rows])
        files.add((tmp_path / "a.tif").read_bytes())
    assert len(files) == 1


# bytes of a strip beside its pixels: JPEG's tables and marks
TABLES = 700


@pytest.mark.parametrize("quality", [90, 100])
@pytest.mark.parametrize("compression", ["none", "packbits", "lzw", "deflate", "zstd", "jpeg"])
@pytest.mark.parametrize("values", [2, 256])
def test_noise_takes_no_more_than_the_worst_case(compression, values, quality):
    """Else a panorama of nearly 4 GB is lost in its last moment; black and white noise is JPEG's worst."""
    random = np.random.default_rng(0).integers(0, values, (32, 1001, 4))
    rows = (random * (255 // (values - 1))).astype(np.uint8)
    made = len(tiffwriter.encode(rows, compression, quality))
    assert made <= tiffwriter.worst_case(compression, quality) * rows.nbytes + TABLES


def test_jpeg_gets_room_for_noise(tmp_path, monkeypatch):
    """At a quality of 100 it takes more than uncompressed; at the usual one the file stays a classic TIFF."""
    limit = 1.2 * noise(np.uint8).nbytes
    monkeypatch.setattr(imagewriter, "_CLASSIC_LIMIT", limit)
    for quality, version in ((None, 42), (100, 43)):
        write_image(tmp_path / "a.tif", noise(np.uint8), compression="jpeg", jpeg_quality=quality)
        assert ((tmp_path / "a.tif").stat().st_size > limit) == (version == 43)
        assert (tmp_path / "a.tif").read_bytes()[2] == version


def test_what_fails_in_the_background_is_told(tmp_path, monkeypatch):
    """By the next call, or when the file is closed; nothing is left."""

    def full(*arguments, **more):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tiffwriter, "encode", full)
    writer = ImageWriter(tmp_path / "a.tif", 131, 7700, 3, np.uint8)
    with pytest.raises(OutputError, match=r"a\.tif cannot be written: No space left on device"), writer:
        for _ in range(100):
            writer.write_rows(noise(np.uint8))
    assert not list(tmp_path.iterdir())


def test_thread_may_take_the_last_strip_while_it_is_given_up(tmp_path, monkeypatch):
    """The caller's error is told, not that the queue became empty after it was asked whether it is."""
    monkeypatch.setattr(queue.Queue, "empty", lambda strips: False)
    with (
        pytest.raises(ValueError, match="the caller's"),
        ImageWriter(tmp_path / "a.tif", 131, 77, 3, np.uint8),
    ):
        raise ValueError("the caller's")
    assert not list(tmp_path.iterdir())


def test_what_fails_while_it_is_given_up_leaves_nothing(tmp_path, monkeypatch):
    abandon = tiffwriter.TiffWriter.abandon

    def fail(writer):
        abandon(writer)
        raise RuntimeError("cannot end a thread")

    monkeypatch.setattr(tiffwriter.TiffWriter, "abandon", fail)
    writer = ImageWriter(tmp_path / "a.tif", 131, 77, 3, np.uint8)
    with pytest.raises(RuntimeError, match="cannot end") as error, writer:
        raise ValueError("the caller's")
    assert isinstance(error.value.__context__, ValueError)
    assert not list(tmp_path.iterdir())


def test_control_c_while_the_thread_starts_leaves_nothing(tmp_path, monkeypatch):
    """The thread may run for the first time when the file has been removed already."""
    late, start = [], threading.Thread.start

    def interrupted(thread):
        late.append(thread)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", interrupted)
        with pytest.raises(KeyboardInterrupt), ImageWriter(tmp_path / "a.tif", 131, 77, 3, np.uint8):
            pass
    for thread in late:
        start(thread)
        thread.join(10)
        assert not thread.is_alive()
    assert late and not list(tmp_path.iterdir())

"""TIFF in compressions that OpenImageIO lacks: each row as it was written, in any order."""

from __future__ import annotations

import numpy as np
import pytest
import tifffile
from conftest import DTYPES, noise, whole

from hugin_abflow.errors import ImageReadError
from hugin_abflow.images import read_layer, read_layers, write_image
from hugin_abflow.layer import Box

ALPHA = {"photometric": "rgb", "extrasamples": ["unassalpha"]}


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("dtype", DTYPES)
def test_zstd_that_we_wrote_is_a_layer(tmp_path, dtype, channels):
    pixels = noise(dtype, channels)
    write_image(tmp_path / "a.tif", pixels, compression="zstd", offset=(7, 3))
    layer = read_layer(tmp_path / "a.tif")
    assert layer.box == Box(7, 3, 7 + 131, 3 + 77) and layer.dtype == dtype
    np.testing.assert_array_equal(whole(layer), pixels)
    for top, bottom in ((0, 1), (40, 70), (31, 33), (76, 77), (5, 5), (64, 77)):
        np.testing.assert_array_equal(layer.read(top, bottom), pixels[top:bottom])


@pytest.mark.parametrize("byteorder", ["<", ">"])
@pytest.mark.parametrize("compression", ["zstd", "lzma"])
@pytest.mark.parametrize("rows", [1, 10, 77])
def test_those_of_other_programs(tmp_path, compression, byteorder, rows):
    """Pages too."""
    pages = [noise(np.uint16, seed=seed) for seed in (1, 2)]
    with tifffile.TiffWriter(tmp_path / "a.tif", byteorder=byteorder) as file:
        for page in pages:
            file.write(page, compression=compression, predictor=True, rowsperstrip=rows, **ALPHA)
    for layer, page in zip(read_layers(tmp_path / "a.tif"), pages, strict=True):
        np.testing.assert_array_equal(layer.read(13, 41), page[13:41])
        np.testing.assert_array_equal(whole(layer), page)


def test_alpha_that_colours_were_multiplied_by(tmp_path):
    pixels = np.full((5, 7, 4), 80, np.uint8)
    pixels[..., 3] = 200
    kind = {"photometric": "rgb", "extrasamples": ["assocalpha"]}
    tifffile.imwrite(tmp_path / "a.tif", pixels, compression="zstd", **kind)
    assert (whole(read_layer(tmp_path / "a.tif")) == (102, 102, 102, 200)).all()


def test_broken_strips_and_tiles_are_refused_in_words(tmp_path):
    write_image(tmp_path / "a.tif", noise(np.uint8), compression="zstd")
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        place = file.pages[0].dataoffsets[1]
    content = bytearray((tmp_path / "a.tif").read_bytes())
    content[place : place + 9] = bytes(9)
    (tmp_path / "a.tif").write_bytes(content)
    layer = read_layer(tmp_path / "a.tif")
    np.testing.assert_array_equal(layer.read(0, 32), noise(np.uint8)[:32])
    with pytest.raises(ImageReadError, match=r"a\.tif cannot be read \(.*\); make the layer again"):
        whole(layer)
    tifffile.imwrite(tmp_path / "b.tif", noise(np.uint8), compression="zstd", tile=(32, 32), **ALPHA)
    with pytest.raises(ImageReadError, match=r"b\.tif cannot be read \(.*ZSTD"):
        whole(read_layer(tmp_path / "b.tif"))

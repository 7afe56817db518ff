"""Formats in and out, end to end: layers as nona writes them, of every depth, to files of every type."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import tifffile
from conftest import ICC, photo_pixels, require_program
from pictures import one_device

from hugin_abflow.encoding import COMPRESSIONS
from hugin_abflow.images import read_layer, write_image
from hugin_abflow.layer import Layer, full_scale
from hugin_abflow.merge import merge_project
from hugin_abflow.settings import Settings

__all__ = ["one_device"]
pytestmark = pytest.mark.usefixtures("one_device")

WIDTH, HEIGHT, CROP = 161, 80, (11, 150, 7, 71)  # left, right, top, bottom
SETTINGS = Settings(flow=False, seam=False, exposure=False)  # the files are what counts here

# nona's options, the photos' depth, the layers' depth, channels, and what becomes of the layers afterwards.
LDR, HDR, PAGES, PNG = "-r ldr -m TIFF_m", "-r hdr -m EXR_m", "-r ldr -m TIFF_multilayer", "-r ldr -m PNG_m"
KINDS: dict[str, tuple[str, type, type, int]] = {
    "8 bit TIFF": (LDR, np.uint8, np.uint8, 3),
    "16 bit TIFF": (LDR, np.uint16, np.uint16, 3),
    "float TIFF": (LDR, np.float32, np.float32, 3),
    "grey 8 bit TIFF": (LDR, np.uint8, np.uint8, 1),
    "grey 16 bit TIFF": (LDR, np.uint16, np.uint16, 1),
    "grey float TIFF": (LDR, np.float32, np.float32, 1),
    "TIFF of pages": (PAGES, np.uint16, np.uint16, 3),
    "half EXR": (HDR, np.float32, np.float16, 3),
    "float EXR": (HDR, np.float32, np.float32, 3),
    "8 bit PNG": (PNG, np.uint8, np.uint8, 3),
    "16 bit PNG": (PNG, np.uint16, np.uint16, 3),
}
ENDINGS = (".tif", ".jpg", ".png", ".exr")


@pytest.fixture(scope="session")
def project_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[Path, list[Path]]]:
    """`project_of(kind)`: a project of two photos and its layers."""
    nona = require_program("nona")

    @cache
    def make(kind: str) -> tuple[Path, list[Path]]:
        options, photo_dtype, _, channels = KINDS[kind]
        folder = tmp_path_factory.mktemp(kind.replace(" ", "_"))
        left, right, top, bottom = CROP
        lines = [
            f'p f2 w{WIDTH} h{HEIGHT} v300 S{left},{right},{top},{bottom} n"TIFF_m c:LZW r:CROP"',
            "m i0",
        ]
        for index, yaw in enumerate((-35, 25)):
            photo = folder / f"photo{index}.tif"
            pixels = photo_pixels(index, photo_dtype, channels)
            stored, photometric = (pixels, "rgb") if channels == 3 else (pixels[..., 0], "minisblack")
            profile = ICC if "TIFF" in kind else None  # PNG and EXR look into it, or have none
            tifffile.imwrite(photo, stored, photometric=photometric, iccprofile=profile)
            lines.append(
                f"i w203 h151 f0 v110 Ra0 Rb0 Rc0 Rd0 Re0 Eev0 Er1 Eb1 r0 p5 y{yaw} TrX0 TrY0 TrZ0 j0 "
                f'a0 b0 c0 d0 e0 g0 t0 Va1 Vb0 Vc0 Vd0 Vx0 Vy0 Vm5 n"{photo.name}"'
            )
        project = folder / "a.pto"
        project.write_text("\n".join(lines) + "\n")
        command = [nona, *options.split(), "-o", "layer", "a.pto"]
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
        layers = sorted(path for path in folder.glob("layer*") if path.suffix != ".pgm")
        if kind == "float EXR":
            layers = [to_float(path) for path in layers]
        return project, layers

    return make


def to_float(path: Path) -> Path:
    """A half EXR as float EXR, which nona does not write."""
    layer, wide = read_layer(path), path.with_name(f"wide {path.name}")
    assert layer.dtype == np.float16
    pixels = layer.read(0, layer.box.height).astype(np.float32)
    write_image(wide, pixels, offset=(layer.box.left, layer.box.top), canvas_size=layer.canvas_size)
    return wide


def merged(project: Path, layers: list[Path], name: str, **options: object) -> Layer:
    target = project.with_name(name)
    merge_project(project, SETTINGS, layers=layers, output=target, **options)
    return read_layer(target)


def pixels_of(layer: Layer) -> np.ndarray:
    return layer.read(0, layer.box.height)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("kind", KINDS)
def test_every_layer_to_every_file(project_of: Callable, kind: str, ending: str) -> None:
    """Size, place, depth, channels and profile; the pixels are those of the TIFF in the layers' depth.

    Of half floats TIFF makes floats, which more programs read, and EXR of integers, which it does not hold.
    """
    _, _, dtype, channels = KINDS[kind]
    in_tiff = np.float32 if dtype == np.float16 else dtype
    project, layers = project_of(kind)
    exact = pixels_of(merged(project, layers, "exact.tif", compression="none"))
    assert exact.shape == (CROP[3] - CROP[2], CROP[1] - CROP[0], channels + 1) and exact.dtype == in_tiff
    assert 0.2 < (exact[..., -1] > 0).mean() < 1
    panorama = merged(project, layers, f"out{ending}", jpeg_quality=100 if ending == ".jpg" else None)
    found = pixels_of(panorama)
    assert found.shape == exact.shape
    covered = exact[..., -1] > 0
    if ending in (".tif", ".exr"):
        assert (panorama.box.left, panorama.box.top) == (CROP[0], CROP[2])
        of_integers = np.float32 if np.dtype(dtype).kind == "u" else dtype
        assert found.dtype == (in_tiff if ending == ".tif" else of_integers)
        if exact.dtype.kind == "u" and ending == ".exr":
            exact = exact.astype(np.float32) / np.float32(full_scale(exact.dtype))
        np.testing.assert_array_equal(found[covered], exact[covered])
        np.testing.assert_array_equal(found[..., -1], exact[..., -1])
        assert panorama.icc == (ICC if "TIFF" in kind and ending == ".tif" else None)
        return
    deep = ending == ".png" and dtype != np.uint8
    assert found.dtype == (np.uint16 if deep else np.uint8)
    expected = np.clip(exact.astype(float) / full_scale(exact.dtype), 0, 1) * full_scale(found.dtype)
    tolerance = 0.51 if ending == ".png" else 6  # rounding; JPEG's own loss
    assert np.abs(found[covered][:, :-1] - expected[covered][:, :-1]).max() <= tolerance
    if ending == ".png":
        np.testing.assert_array_equal(found[..., -1] > 0, covered)
    else:
        assert np.abs(found[~covered][:, :-1].astype(int)).mean() < 4  # black, but for what JPEG spreads


@pytest.mark.parametrize("compression", [name for name in COMPRESSIONS["TIFF"] if name != "jpeg"])
@pytest.mark.parametrize("kind", ["8 bit TIFF", "16 bit TIFF", "float TIFF", "grey 16 bit TIFF", "half EXR"])
def test_every_compression_of_every_depth(project_of: Callable, kind: str, compression: str) -> None:
    project, layers = project_of(kind)
    exact = pixels_of(merged(project, layers, "exact.tif", compression="none"))
    target = project.with_name(f"{compression}.tif")
    merge_project(project, SETTINGS, layers=layers, output=target, compression=compression)
    with tifffile.TiffFile(target) as written:
        np.testing.assert_array_equal(written.pages[0].asarray(), exact)
        assert compression in written.pages[0].compression.name.lower().replace("adobe_", "")


@pytest.mark.parametrize("kind", ["half EXR", "float EXR"])
@pytest.mark.parametrize("compression", COMPRESSIONS["EXR"])
def test_every_compression_of_exr(project_of: Callable, kind: str, compression: str) -> None:
    project, layers = project_of(kind)
    exact = pixels_of(merged(project, layers, "exact.tif", compression="none"))
    covered = exact[..., -1] > 0
    found = pixels_of(merged(project, layers, f"{compression}.exr", compression=compression))
    np.testing.assert_array_equal(found[covered], exact[covered])


@pytest.mark.parametrize("ending", [".jpg", ".png"])
def test_photos_of_other_types(nona: str, tmp_path: Path, ending: str) -> None:
    """As cameras and other programs write them; nona makes 8 bit layers of them."""
    photo = tmp_path / f"photo{ending}"
    opaque = np.full((151, 203, 4), 255, np.uint8)
    opaque[..., :3] = photo_pixels(0)
    write_image(photo, opaque)
    (tmp_path / "a.pto").write_text(
        'p f0 w203 h151 v80 n"TIFF_m c:LZW r:CROP"\nm i0\n'
        "i w203 h151 f0 v80 Ra0 Rb0 Rc0 Rd0 Re0 Eev0 Er1 Eb1 r0 p0 y0 TrX0 TrY0 TrZ0 j0 "
        f'a0 b0 c0 d0 e0 g0 t0 Va1 Vb0 Vc0 Vd0 Vx0 Vy0 Vm5 n"{photo.name}"\n'
    )
    panorama = pixels_of(read_layer(merge_project(tmp_path / "a.pto", SETTINGS)))
    assert panorama.shape == (151, 203, 4) and panorama.dtype == np.uint8
    difference = np.abs(panorama[2:-2, 2:-2, :3].astype(int) - photo_pixels(0)[2:-2, 2:-2])
    assert difference.max() <= (2 if ending == ".png" else 12)


@pytest.mark.parametrize(("white", "told"), [(1.15, False), (1.3, True)])
def test_what_is_brighter_than_white_is_told_where_it_is_lost(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, white: float, told: bool
) -> None:
    """Not what is a little brighter, beside edges that nona sampled by a cubic."""
    pixels = np.full((5, 7, 4), (white, -0.1, 0.5, 1.0), np.float32)
    for ending in (".png", ".jpg", ".tif"):
        caplog.clear()
        write_image(tmp_path / f"a{ending}", pixels)
        assert ("clipped" in caplog.text) == (told and ending != ".tif")


@pytest.mark.parametrize("kind", ["8 bit TIFF", "float TIFF"])
def test_bigtiff_where_classic_ends(
    project_of: Callable, kind: str, monkeypatch: pytest.MonkeyPatch, exiftool: str
) -> None:
    """With metadata and profile. 4 GB are not written here: the limit is moved."""
    project, layers = project_of(kind)
    exact = pixels_of(merged(project, layers, "exact.tif"))
    size = exact.nbytes
    for limit, mark in ((2 * size, 42), (size // 2, 43)):
        monkeypatch.setattr("hugin_abflow.imagewriter._CLASSIC_LIMIT", limit)
        panorama = merged(project, layers, "big.tif", compression="deflate")
        assert project.with_name("big.tif").read_bytes()[2] == mark
        np.testing.assert_array_equal(pixels_of(panorama), exact)
        assert panorama.icc == ICC
        with tifffile.TiffFile(project.with_name("big.tif")) as written:
            assert b"GPano:ProjectionType>equirectangular<" in bytes(written.pages[0].tags["XMP"].value)

"""The public names: a project or layers in, a panorama out, with progress and clear refusals."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from pictures import masked, masks_of, noise, pixel_places

import hugin_abflow
from hugin_abflow import Canvas, Layer, Settings, merge_layers, merge_project, read_layer, write_image
from hugin_abflow.errors import DeviceError, OutputError
from hugin_abflow.layer import full_scale

WIDTH, HEIGHT = 202, 101
CROP = (20, 10, 190, 95)  # left, top, right, bottom
PROJECT = f"""# hugin project file
p f2 w{WIDTH} h{HEIGHT} v360 S{CROP[0]},{CROP[2]},{CROP[1]},{CROP[3]} n"TIFF_m c:LZW r:CROP"
m i0
i w100 h100 f3 v200 r0 p0 y0 n"a.jpg"
i w100 h100 f3 v200 r0 p0 y180 n"b.jpg"
#hugin_outputImageType tif
#hugin_outputImageTypeCompression DEFLATE
"""


class Recorder:
    """A progress callable that keeps what it is told."""

    def __init__(self) -> None:
        self.phases: list[str] = []
        self.totals: dict[str, int] = {}
        self.done: dict[str, int] = {}
        self.open: list[str] = []

    @contextmanager
    def __call__(self, phase: str, total: int) -> Iterator:
        self.phases.append(phase)
        self.totals[phase], self.done[phase] = total, 0
        self.open.append(phase)

        def advance(units: int) -> None:
            assert phase in self.open and units >= 0
            self.done[phase] += units

        yield advance
        self.open.remove(phase)


def layers_of(picture: np.ndarray, second: np.ndarray | None = None) -> list[Layer]:
    """Two halves of a canvas that overlap on both sides, cropped; the second one may show something else."""
    _, x = pixel_places(HEIGHT, WIDTH)
    masks = [x < 120, (x >= 90) | (x < 15)]
    pictures = [picture, picture if second is None else second]
    return [masked(p, m, name) for p, m, name in zip(pictures, masks, ("left", "right"), strict=True)]


def store(folder: Path, layers: list[Layer], icc: bytes | None = None) -> None:
    """The project's layers, as a user of the API would write them."""
    for index, layer in enumerate(layers):
        pixels, box = layer.read(0, layer.box.height), layer.box
        write_image(folder / f"pano{index:04d}.tif", pixels, offset=(box.left, box.top), icc=icc)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """pano.pto with its layers pano0000.tif, pano0001.tif."""
    (tmp_path / "pano.pto").write_text(PROJECT)
    store(tmp_path, layers_of(noise(HEIGHT, WIDTH)))
    return tmp_path


def the_crop(picture: np.ndarray) -> np.ndarray:
    left, top, right, bottom = CROP
    return picture[top:bottom, left:right]


def test_all_public_names_are_there():
    assert sorted(hugin_abflow.__all__) == list(hugin_abflow.__all__)
    for name in hugin_abflow.__all__:
        assert getattr(hugin_abflow, name).__doc__


def test_public_names_are_listed_before_they_are_loaded():
    code = "import hugin_abflow, sys; print(*dir(hugin_abflow)); print('hugin_abflow.merge' in sys.modules)"
    command = [sys.executable, "-W", "error", "-c", code]
    names, loaded = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    assert set(hugin_abflow.__all__) <= set(names.split())
    assert loaded == "False"


def test_a_name_that_is_not_there_is_refused():
    """When the program runs, and by type checkers, which believe a `__getattr__` that they see."""
    with pytest.raises(AttributeError, match="module 'hugin_abflow' has no attribute 'merge_layrs'"):
        hugin_abflow.merge_layrs  # noqa: B018
    tree = ast.parse(Path(hugin_abflow.__file__).read_text("utf-8"))
    assert "__getattr__" not in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_project_becomes_a_panorama_beside_it(folder):
    store(folder, layers_of(noise(HEIGHT, WIDTH)), icc=b"a profile")
    output = merge_project(folder / "pano.pto", remap="never")
    assert output == folder / "pano.tif"
    layer = read_layer(output)
    assert (layer.box.left, layer.box.top) == CROP[:2]
    assert layer.icc == b"a profile"
    np.testing.assert_array_equal(layer.read(0, layer.box.height), the_crop(noise(HEIGHT, WIDTH)))


@pytest.mark.parametrize("given", [str, Path])
def test_paths_may_be_text(folder, given, monkeypatch):
    monkeypatch.chdir(folder)
    output = merge_project(given("pano.pto"), Settings(), output=given("other.png"), prefix=given("pano"))
    assert Path(output).resolve() == folder / "other.png"
    np.testing.assert_array_equal(
        read_layer(output).read(0, CROP[3] - CROP[1]), the_crop(noise(HEIGHT, WIDTH))
    )


def test_layers_may_be_named(folder):
    layers = [(folder / f"pano{k:04d}.tif").rename(folder / f"{k}.tif") for k in range(2)]
    output = merge_project(folder / "pano.pto", layers=layers, output=folder / "out.tif")
    np.testing.assert_array_equal(
        read_layer(output).read(0, CROP[3] - CROP[1]), the_crop(noise(HEIGHT, WIDTH))
    )


@pytest.mark.parametrize("mode", ["joint", "sequential"])
def test_progress_reports_every_phase_to_its_end(folder, mode):
    store(folder, layers_of(noise(HEIGHT, WIDTH), noise(HEIGHT, WIDTH, seed=1)))
    recorder = Recorder()
    settings = Settings(merge=mode, band_rows=16)
    merge_project(folder / "pano.pto", settings, prefix="pano", progress=recorder)
    expected = ["merge"] * (mode == "sequential") + ["read", "flow", "align", "blend"]
    assert recorder.phases == expected
    assert recorder.totals["read"] == 2 * HEIGHT
    assert recorder.totals["flow"] == 1
    assert recorder.totals["blend"] == CROP[3] - CROP[1]
    for phase in ("read", "flow", "align", "blend"):
        assert recorder.done[phase] == recorder.totals[phase]
    assert not recorder.open


def test_progress_may_end_the_merge(folder):
    """As Ctrl-C does: no output, nothing left."""

    class Enough(Exception):
        pass

    @contextmanager
    def impatient(phase: str, total: int) -> Iterator:
        def advance(units: int) -> None:
            if phase == "blend":
                raise Enough

        yield advance

    before = {path.name for path in folder.iterdir()}
    with pytest.raises(Enough):
        merge_project(folder / "pano.pto", Settings(band_rows=16), prefix="pano", progress=impatient)
    assert {path.name for path in folder.iterdir()} == before


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_merge_layers_gives_pixels_in_the_layers_depth(dtype):
    picture = noise(HEIGHT, WIDTH, dtype)
    recorder = Recorder()
    result = merge_layers(layers_of(picture), Canvas.sphere(WIDTH, HEIGHT), progress=recorder)
    assert isinstance(result, np.ndarray) and result.dtype == dtype and result.shape == picture.shape
    np.testing.assert_array_equal(result, picture)
    assert recorder.done == recorder.totals


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_nan_and_infinity_in_memory_are_invalid_pixels(dtype):
    """As in files: another layer shows there, or nothing; none of it spreads."""
    picture = noise(HEIGHT, WIDTH, dtype)
    left, right = (layer.read(0, layer.box.height).copy() for layer in layers_of(picture))
    left[30:33, 100:103, 0] = np.nan  # both layers are here
    left[50, 60, 1], left[51, 61, 3] = np.inf, np.nan  # only this one is
    layers = [Layer.from_array("left", left), Layer.from_array("right", right)]
    result = merge_layers(layers, Canvas.sphere(WIDTH, HEIGHT), Settings(exposure=False))
    picture[50, 60] = picture[51, 61] = 0
    np.testing.assert_array_equal(result, picture)
    assert np.isnan(left).sum() == 10  # what came in is not changed


def test_layers_are_read_only(folder):
    """Neither files nor arrays that come in are changed."""
    picture, second = noise(HEIGHT, WIDTH), noise(HEIGHT, WIDTH, seed=1)
    layers = layers_of(picture, second)
    before = [layer.read(0, layer.box.height).copy() for layer in layers]
    merge_layers(layers, Canvas.sphere(WIDTH, HEIGHT))
    for layer, pixels in zip(layers, before, strict=True):
        np.testing.assert_array_equal(layer.read(0, layer.box.height), pixels)
    files = {path: path.read_bytes() for path in folder.iterdir()}
    output = merge_project(folder / "pano.pto", prefix="pano")
    assert {path: path.read_bytes() for path in folder.iterdir() if path != output} == files


@pytest.mark.parametrize(
    ("ending", "dtype"),
    [("tif", np.uint8), ("tiff", np.uint16), ("png", np.uint16), ("exr", np.float16), ("exr", np.float32)],
)
def test_what_is_merged_can_be_written_and_read(tmp_path, ending, dtype):
    canvas = Canvas.plane(WIDTH, HEIGHT)
    layers = layers_of(noise(HEIGHT, WIDTH, dtype), noise(HEIGHT, WIDTH, dtype, seed=1))
    layers[0] = Layer.from_array("left", layers[0].read(0, 60))  # leaves a corner free
    result = merge_layers(layers, canvas, Settings(working_pixels=9_000))
    free = ~masks_of(layers, canvas).any(0)
    assert free.any()
    np.testing.assert_array_equal(result[..., 3] == 0, free)
    path = tmp_path / f"result.{ending}"
    write_image(path, result)
    stored = read_layer(path)
    assert stored.dtype == dtype and stored.channels == 3
    np.testing.assert_array_equal(stored.read(0, HEIGHT), result)


@pytest.mark.parametrize("ending", ["tif", "png", "jpg"])
def test_ending_of_the_output_chooses_the_format(folder, ending):
    output = folder / f"out.{ending}"
    assert merge_project(folder / "pano.pto", prefix="pano", output=output, jpeg_quality=100) == output
    magic = {"tif": b"II*\0", "png": b"\x89PNG", "jpg": b"\xff\xd8\xff"}[ending]
    assert output.read_bytes().startswith(magic)
    pixels = read_layer(output).read(0, CROP[3] - CROP[1])
    assert (pixels[..., 3] == full_scale(pixels.dtype)).all()
    difference = np.abs(pixels.astype(int) - the_crop(noise(HEIGHT, WIDTH)))
    assert difference.max() == 0 if ending != "jpg" else difference.mean() < 40  # JPEG halves colour's detail


def test_output_may_be_no_input(folder):
    before = (folder / "pano0000.tif").read_bytes()
    with pytest.raises(OutputError, match=r"pano0000\.tif is an input of .*choose another name"):
        merge_project(folder / "pano.pto", prefix="pano", output=folder / "pano0000.tif")
    assert (folder / "pano0000.tif").read_bytes() == before


def test_output_may_be_no_photo_of_a_disabled_image(folder):
    added = "\n#-hugin  cropFactor=1 disabled\n#-hugin  cropFactor=1\ni w100"
    (folder / "pano.pto").write_text(PROJECT.replace("\ni w100", added, 1))
    photo = folder / "a.jpg"
    photo.write_bytes(b"a photo")
    with pytest.raises(OutputError, match=r"a\.jpg is an input"):
        merge_project(folder / "pano.pto", prefix="pano", output=photo)
    assert photo.read_bytes() == b"a photo"


def test_device_that_is_none(folder):
    with pytest.raises(DeviceError, match="no OpenCL device fits --device nonesuch"):
        merge_project(folder / "pano.pto", Settings(device="nonesuch"), prefix="pano")
    assert not (folder / "pano.tif").exists()


@pytest.mark.parametrize("ending", [".tif", ".png"])
def test_pixels_in_foreign_byte_order_are_written(tmp_path: Path, ending: str) -> None:
    """As big-endian TIFF files are decoded by some."""
    pixels = np.full((3, 5, 4), 0x1234, np.uint16)
    write_image(tmp_path / f"a{ending}", pixels.astype(">u2"))
    write_image(tmp_path / f"b{ending}", pixels)
    assert (tmp_path / f"a{ending}").read_bytes() == (tmp_path / f"b{ending}").read_bytes()


@pytest.mark.parametrize("ending", [".tif", ".png", ".jpg", ".exr"])
def test_pixels_that_are_no_numbers_are_transparent(tmp_path: Path, ending: str) -> None:
    pixels = np.ones((8, 8, 4), np.float32)
    pixels[:, :4, 1] = np.nan
    write_image(tmp_path / f"a{ending}", pixels)
    rows = read_layer(tmp_path / f"a{ending}").read(0, 8).astype(float)
    assert rows[:, 5:, 1].min() > 0 and (rows[:, :3, :3].max() < 0.1 * rows.max())


@pytest.mark.parametrize("wrong", [{"offset": (1.5, 2)}, {"offset": (10**10, 0)}, {"jpeg_quality": "90"}])
def test_what_cannot_be_written_is_an_output_error(tmp_path: Path, wrong: dict) -> None:
    for ending in (".jpg", ".tif", ".png", ".exr") if "offset" in wrong else (".jpg",):
        with pytest.raises(OutputError):
            write_image(tmp_path / f"a{ending}", np.ones((3, 5, 4), np.float32), **wrong)
    with pytest.raises(OutputError, match="NUL"):
        write_image(tmp_path / "a\0.tif", np.ones((3, 5, 4), np.float32))

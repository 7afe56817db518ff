"""Finding layers, and having nona make them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from conftest import ICC, names_of, photo_pixels, pixels_of, remap, same

from hugin_abflow import nona as program
from hugin_abflow.errors import (
    ImageReadError,
    LayersMismatchError,
    NonaMissingError,
    OutputError,
    PhotoMissingError,
)
from hugin_abflow.images import read_layers, write_image
from hugin_abflow.layer import Box, Canvas, Layer, check_layers
from hugin_abflow.project import read_plan
from hugin_abflow.supply import open_layers

pytestmark = pytest.mark.usefixtures("temporary")


# ------------------------------------------------------------------------------------ made by nona


def uncropped(layer: Layer, canvas: Canvas) -> np.ndarray:
    """A layer laid out on its canvas."""
    whole = np.zeros((canvas.height, canvas.width, layer.channels + 1), layer.dtype)
    box = layer.box
    whole[box.top : box.bottom, box.left : box.right] = layer.read(0, box.height)
    return whole


KINDS = {
    "8 bit": {},
    "16 bit": {"dtype": np.uint16},
    "float": {"dtype": np.float32},
    "grey": {"channels": 1},
    "grey 16 bit": {"channels": 1, "dtype": np.uint16},
    "ICC": {"icc": ICC},
    "unicode and spaces": {"folder": "Räume mit Blick", "stem": "mein 'Päno'", "photo": "Föto {} ß.tif"},
    "odd canvas": {"panorama": 'f2 w801 h403 v360 n"TIFF_m c:LZW r:CROP"'},
    "crop": {"panorama": 'f2 w802 h401 v360 S31,700,101,333 n"TIFF_m c:LZW r:CROP"'},
    "no ending": {"stem": "huginpto_A1b2", "ending": ""},
    "rectilinear": {"panorama": 'f0 w501 h301 v110 n"TIFF_m r:CROP"', "yaws": (-20, 5, 30)},
    "cylindrical": {"panorama": 'f1 w801 h203 v360 n"TIFF_m r:CROP"'},
    "fisheye": {"panorama": 'f3 w401 h401 v200 n"TIFF_m r:CROP"', "yaws": (-40, 5, 60)},
    "stereographic": {"panorama": 'f4 w401 h397 v220 n"TIFF_m r:CROP"', "yaws": (-40, 5, 60)},
}


def test_layers_that_will_go_are_called_as_their_photos(make_project, nona):
    """Nobody finds a layer that was made for the run."""
    plan = read_plan(make_project())
    with open_layers(plan) as layers:
        assert [layer.called for layer in layers] == [image.name for image in plan.images]
    remap(plan, str(plan.folder / plan.stem))
    with open_layers(plan) as layers:
        assert [layer.called for layer in layers] == names_of(layers)


@pytest.mark.parametrize("kind", KINDS)
def test_layers_are_what_nona_makes(make_project, nona, kind):
    """Depth, channels, position, canvas, colours: as tifffile sees nona's own files, run by hand."""
    plan = read_plan(make_project(**KINDS[kind]))
    hand = plan.folder / "by hand"
    hand.mkdir()
    remap(plan, str(hand / "cropped "))
    with open_layers(plan) as layers:
        assert names_of(layers) == [f"{plan.stem}{index:04d}.tif" for index in range(3)]
        for index, layer in enumerate(layers):
            page = tifffile.TiffFile(hand / f"cropped {index:04d}.tif").pages[0]
            x, y = (round(page.tags[tag].value[0] / page.tags[tag].value[1] * 150) for tag in (286, 287))
            height, width = page.shape[:2]
            assert layer.box == Box(x, y, x + width, y + height)
            assert layer.canvas_size == (plan.canvas.width, plan.canvas.height)
            assert layer.dtype == KINDS[kind].get("dtype", np.uint8)
            assert layer.channels == KINDS[kind].get("channels", 3)
            assert layer.icc == KINDS[kind].get("icc")
            assert np.array_equal(layer.read(0, height), tifffile.imread(layer.file))
            assert same([layer.read(0, height)], [page.asarray()])


@pytest.mark.parametrize("options", [("TIFF_m", True), ("TIFF_multilayer", False)])
def test_uncropped_and_multilayer_are_the_same_pixels(make_project, nona, options):
    """Without r:CROP nona writes the whole canvas; positions of cropped layers must match it."""
    kind, uncrop = options
    plan = read_plan(make_project())
    bare = read_plan(make_project(stem="bare", panorama='f2 w802 h401 v360 n"TIFF_m c:LZW"'))
    remap(bare if uncrop else plan, "other", "-m", kind)
    with open_layers(plan) as cropped, open_layers(plan, prefix="other") as others:
        assert len(cropped) == len(others) == 3
        for one, other in zip(cropped, others, strict=True):
            assert other.box == (Box(0, 0, 802, 401) if uncrop else one.box)
            assert same([uncropped(one, plan.canvas)], [uncropped(other, plan.canvas)])


def test_a_layer_across_the_border_is_as_wide_as_the_canvas(make_project, nona):
    plan = read_plan(make_project(yaws=(0, 175)))
    with open_layers(plan) as layers:
        across = layers[1]
        assert (across.box.left, across.box.right) == (0, 802)
        alpha = across.read(across.box.height // 2, across.box.height // 2 + 1)[0, :, -1]
        assert alpha[0] == alpha[-1] == 255 and not alpha[200:600].any()


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_hdr_layers_are_half_exr(make_project, nona, dtype):
    hdr = "#hugin_outputLDRBlended false\n#hugin_outputHDRBlended true\n"
    plan = read_plan(make_project(dtype=dtype, extra=hdr))
    hand = plan.folder / "by hand"
    hand.mkdir()
    subprocess.run(
        ["nona", "-r", "hdr", "-m", "EXR_m", "-o", hand / "h", plan.file], check=True, capture_output=True
    )
    with (
        open_layers(plan) as layers,
        open_layers(read_plan(plan.file.with_name("pano.pto")), prefix="by hand/h") as o,
    ):
        assert names_of(layers) == [f"pano_hdr_{index:04d}.exr" for index in range(3)]
        for layer, other in zip(layers, o, strict=True):
            assert (layer.dtype, layer.channels, layer.canvas_size) == (np.float16, 3, (802, 401))
            assert layer.box == other.box
            rows = layer.read(0, layer.box.height)
            assert np.array_equal(rows, other.read(0, other.box.height))
            assert set(np.unique(rows[..., 3])) == {0, 1}
        # the same photos as TIFF lie at the same place
        with open_layers(read_plan(make_project(stem="ldr", dtype=dtype))) as ldr:
            assert [layer.box for layer in ldr] == [layer.box for layer in layers]


def test_bigtiff_layers(make_project, nona):
    plan = read_plan(make_project())
    remap(plan, "pano")
    with open_layers(plan, remap="never") as layers:
        expected = pixels_of(layers)
    for index in range(3):
        path = plan.folder / f"pano{index:04d}.tif"
        page = tifffile.TiffFile(path).pages[0]
        places = [
            (tag, page.tags[tag].dtype, 1, page.tags[tag].value, True) for tag in (286, 287, 33300, 33301)
        ]
        options = {"photometric": "rgb", "extrasamples": ["unassalpha"], "resolution": (150, 150)}
        tifffile.imwrite(path, page.asarray(), bigtiff=True, extratags=places, **options)
        assert path.read_bytes()[2] == 43
    with open_layers(plan, remap="never") as layers:
        assert all(layer.canvas_size == (802, 401) for layer in layers)
        assert same(pixels_of(layers), expected)


def test_positions_of_nona_at_every_offset(tmp_path, nona):
    """Crops put the layer's corner at chosen columns; nona writes them as RATIONALs of floats."""
    photo = np.full((60, 120, 3), 200, np.uint8)
    tifffile.imwrite(tmp_path / "p.tif", photo, photometric="rgb")
    for left in (1, 49, 63, 98, 126, 196, 251, 392):
        (tmp_path / "a.pto").write_text(
            f'p f2 w802 h401 v360 S{left},790,{left // 2},390 n"TIFF_m c:LZW r:CROP"\nm i0\n'
            "i w120 h60 f4 v360 Ra0 Rb0 Rc0 Rd0 Re0 Eev0 Er1 Eb1 r0 p0 y0 TrX0 TrY0 TrZ0 j0 "
            'a0 b0 c0 d0 e0 g0 t0 Va1 Vb0 Vc0 Vd0 Vx0 Vy0 Vm5 n"p.tif"\n'
        )
        plan = read_plan(tmp_path / "a.pto")
        with open_layers(plan, remap="always") as layers:
            assert layers[0].box == plan.canvas.crop


# ------------------------------------------------------------------------------------ moved projects


def test_projects_from_windows_and_moved_ones_are_remapped(make_project, nona):
    plan = read_plan(make_project())
    with open_layers(plan) as layers:
        expected = pixels_of(layers)
    (plan.folder / "sub").mkdir()
    (plan.folder / "photo 0.tif").rename(plan.folder / "sub" / "photo 0.tif")
    text = plan.file.read_text()
    text = text.replace('n"photo 0.tif"', 'n"sub\\photo 0.tif"').replace('n"photo 1', 'n"C:\\me\\photo 1')
    plan.file.write_bytes(text.replace('n"photo 2', 'n"/gone/photo 2').replace("\n", "\r\n").encode())
    written = plan.file.read_bytes()
    with open_layers(read_plan(plan.file)) as layers:
        assert same(pixels_of(layers), expected)
    assert plan.file.read_bytes() == written


# ------------------------------------------------------------------------------------ failures


@pytest.fixture
def no_nona(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A PATH without nona."""
    monkeypatch.setenv("PATH", str(tmp_path / "nothing here"))


def test_photo_missing(make_project, nona):
    plan = read_plan(make_project())
    plan.images[1].photo.unlink()
    with (
        pytest.raises(PhotoMissingError, match=r"photo 1\.tif \(image 1\) is not there.*--prefix"),
        open_layers(plan),
    ):
        pass


def test_image_that_names_no_photo(make_project, nona):
    """As where a project was cut off within a line."""
    project = make_project()
    project.write_text(project.read_text().replace(' n"photo 1.tif"', ""))
    plan = read_plan(project)
    with pytest.raises(PhotoMissingError, match=r"image 1 of .*pano\.pto names no photo"), open_layers(plan):
        pass
    remap(read_plan(make_project(stem="whole")), str(plan.folder / "pano"))
    with open_layers(plan, remap="never") as layers:
        assert len(layers) == 3


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has names that are not UTF-8")
def test_project_whose_name_is_not_utf8(make_project, nona):
    """Its layers are called by another name, without which they could not be read."""
    plan = read_plan(make_project(stem="p\udcf6n\udcff"))
    with open_layers(plan) as layers:
        assert names_of(layers) == [f"p?n?{index:04d}.tif" for index in range(3)]
        pixels_of(layers)
    before = sorted(plan.folder.iterdir())
    with (
        pytest.raises(OutputError, match=r"not valid UTF-8.*--keep-layers"),
        open_layers(plan, keep_layers=True),
    ):
        pass
    assert sorted(plan.folder.iterdir()) == before


def test_photo_that_was_cut_is_told(make_project, nona, caplog):
    """nona itself ends with success: what is missing is black, of JPEG grey."""
    project = make_project()
    photo = project.with_name("photo 1.tif")
    photo.write_bytes(photo.read_bytes()[:40_000])
    with (
        pytest.raises(ImageReadError, match=r"photo 1\.tif is damaged \(.*Read error"),
        open_layers(read_plan(project)),
    ):
        pass
    project = make_project("of jpeg", photo="photo{}.jpg")
    for number in range(3):
        cv2.imwrite(str(project.with_name(f"photo{number}.jpg")), photo_pixels(number))
    with open_layers(read_plan(project)):
        assert caplog.text == ""
    photo = project.with_name("photo1.jpg")
    photo.write_bytes(photo.read_bytes()[:-800])
    with open_layers(read_plan(project)):
        assert f"{photo} may be damaged (Premature end of JPEG file)" in caplog.text
        assert caplog.text.count("may be damaged") == 1  # no other photo, and not the project


def test_photo_of_a_missing_layer_missing(make_project, nona):
    plan = read_plan(make_project())
    remap(plan, "pano")
    (plan.folder / "pano0001.tif").unlink()
    plan.images[1].photo.unlink()
    with pytest.raises(PhotoMissingError, match=r"photo 1\.tif \(image 1\)"), open_layers(plan):
        pass


def test_nona_missing(make_project, no_nona):
    assert program.probe() is None
    with (
        pytest.raises(NonaMissingError, match="apt install hugin-tools"),
        open_layers(read_plan(make_project())),
    ):
        pass


def test_nona_is_probed(nona):
    assert program.probe()[0].isdigit()


SLOW_NONA = """#!/bin/sh
echo $$ > "{folder}/pid"
while [ "$1" != -o ]; do shift; done
: > "${{2}}0000.tif"
echo 'loading photo 0.tif'
echo 'remapping photo 0.tif'
exec sleep 60
"""


def test_interruption_ends_nona_and_leaves_nothing(make_project, tmp_path):
    """A real Ctrl-C, in a process of its own, while nona is at work."""
    if os.name == "nt":
        pytest.skip("signals of POSIX")  # Windows sends no Ctrl-C to one process alone
    folder = make_slow_nona(tmp_path)
    project = make_project()
    code = (
        "import sys\n"
        "from hugin_abflow.supply import open_layers\n"
        "from hugin_abflow.project import read_plan\n"
        "from hugin_abflow.signals import interruptible\n"
        "with interruptible(), open_layers(read_plan(sys.argv[1])):\n"
        "    pass\n"
    )
    environment = {
        **os.environ,
        "PATH": f"{folder}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(Path(__file__).parents[1]),
    }
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(project)], env=environment, stderr=subprocess.PIPE, text=True
    )
    try:
        pid = int(wait_for(folder / "pid"))
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30)
    finally:
        process.kill()
    assert "KeyboardInterrupt" in errors
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def make_slow_nona(tmp_path: Path) -> Path:
    folder = tmp_path / "bin"
    folder.mkdir()
    (folder / "nona").write_text(SLOW_NONA.format(folder=folder))
    (folder / "nona").chmod(0o755)
    return folder


def wait_for(path: Path) -> str:
    for _ in range(600):
        if path.is_file() and path.read_text().endswith("\n"):
            return path.read_text()
        time.sleep(0.05)
    raise AssertionError(f"{path} did not appear")


def test_an_exception_of_the_caller_ends_nona_too(make_project, tmp_path, monkeypatch):
    folder = make_slow_nona(tmp_path)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")

    @contextmanager
    def progress(phase, total):
        def advance(units):
            raise RuntimeError("the progress bar broke")

        yield advance

    with (
        pytest.raises(RuntimeError, match="progress bar"),
        open_layers(read_plan(make_project()), progress=progress),
    ):
        pass
    with pytest.raises(ProcessLookupError):
        os.kill(int((folder / "pid").read_text()), 0)


# ------------------------------------------------------------------------------------ what must agree


CANVAS = Canvas.sphere(802, 401)


def layer(name: str, dtype: type = np.uint8, channels: int = 3, left: int = 10, top: int = 10) -> Layer:
    return Layer.from_array(name, np.zeros((31, 41, channels + 1), dtype), left, top)


@pytest.mark.parametrize(
    "odd, said",
    [
        (layer("b", dtype=np.uint16), ["b has uint16", "a has uint8"]),
        (layer("b", channels=1), ["b is grey", "a is RGB"]),
        (layer("b", left=-1), ["b covers columns -1 to 40", "802x401"]),
        (layer("b", left=780), ["b covers columns 780 to 821", "802x401"]),
        (layer("b", top=390), ["rows 390 to 421", "802x401"]),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_layers_that_do_not_belong_together(odd, said):
    check_layers(CANVAS, [layer("a"), layer("c")])
    with pytest.raises(LayersMismatchError) as error:
        check_layers(CANVAS, [layer("a"), odd, layer("c")])
    assert all(part in str(error.value) for part in said)


def test_layers_of_another_canvas(make_project, nona):
    small = read_plan(make_project(stem="small", panorama='f2 w600 h300 v360 n"TIFF_m c:LZW r:CROP"'))
    remap(small, "pano")
    plan = read_plan(make_project())
    with (
        pytest.raises(
            LayersMismatchError, match=r"pano0000\.tif was made for a canvas of 600x300, .* 802x401"
        ),
        open_layers(plan, prefix="pano"),
    ):
        pass


def test_layers_of_other_depth_are_named(make_project, nona):
    plan = read_plan(make_project())
    remap(plan, "pano")
    path = plan.folder / "pano0001.tif"
    (wrong,) = read_layers(path)
    write_image(
        path, wrong.read(0, wrong.box.height).astype(np.uint16), offset=(wrong.box.left, wrong.box.top)
    )
    with (
        pytest.raises(
            LayersMismatchError, match=r"pano0001\.tif has uint16 samples, pano0000\.tif has uint8"
        ),
        open_layers(plan),
    ):
        pass


def test_a_layer_that_is_no_image(make_project, nona):
    plan = read_plan(make_project())
    remap(plan, "pano")
    (plan.folder / "pano0002.tif").write_bytes(b"II*\0")
    with pytest.raises(ImageReadError, match=r"pano0002\.tif"), open_layers(plan, remap="never"):
        pass

"""abflow-enblend at work, beside the real enblend where the two can be compared."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
from conftest import ICC, names_in, whole
from layer_files import FULL_WIDTH, X_POSITION, Y_POSITION, write_layer
from pictures import one_device, texture

from hugin_abflow import cli
from hugin_abflow.dropin import enblend as stand_in
from hugin_abflow.images import read_layer, write_image
from hugin_abflow.layer import full_scale

__all__ = ["one_device"]
pytestmark = pytest.mark.usefixtures("one_device")

CANVAS = (180, 90)

Run = Callable[..., int]


def picture(dtype: type = np.uint8) -> np.ndarray:
    """A canvas full of distinct pixels, its right border continued on the left."""
    y, x = np.mgrid[: CANVAS[1], : CANVAS[0]]
    return texture(y, x, dtype, period=CANVAS[0])


def part(name: str, left: int, width: int, top: int = 0, height: int = CANVAS[1], **how) -> Path:
    """A layer that shows columns of the picture, written into the current folder."""
    pixels = picture(how.pop("dtype", np.uint8))[top : top + height, left : left + width]
    if how.pop("grey", False):
        pixels = pixels[..., [1, 3]]
    return write_layer(Path(name), pixels, left, top, how.pop("canvas", CANVAS), **how)


@pytest.fixture
def layers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Two layers of one picture that overlap, in the current folder: columns 20 to 120 and 70 to 160."""
    monkeypatch.chdir(tmp_path)
    return [str(part("a b.tif", 20, 100, 5, 80)), str(part("é.tif", 70, 90, 0, 70))]


def run(*arguments: str) -> int:
    return int(stand_in.main(["-o", "out.tif", *arguments]))


def spread(line: str, layers: list[str]) -> list[str]:
    """The words of a line, with the layers' names for ``{layers}``."""
    return [word for words in line.split() for word in (layers if words == "{layers}" else [words])]


def place(file: str) -> tuple[int, int, int, int]:
    """(left, top, width, height); no position is 0."""
    with tifffile.TiffFile(file) as tiff:
        tags, shape = tiff.pages[0].tags, tiff.pages[0].shape
        left, top = (
            tags[tag].value[0] * 150 / tags[tag].value[1] if tag in tags else 0
            for tag in (X_POSITION, Y_POSITION)
        )
    return round(left), round(top), shape[1], shape[0]


# Beside the real one


SAME = {
    "plain": "{layers}",
    "options after files": "{layers} -d 8",
    "crop": "-f 140x85+20+0 {layers}",
    "whole canvas": "-f180x90 {layers}",
    "wrap": "-w -f180x90 {layers}",
    "no wrap": "--wrap=NONE {layers}",
    "16 bit": "-d16 {layers}",
    "floats": "--depth=R32 {layers}",
    "doubles": "-d r64 {layers}",
    "shortened": "--dep=8 --comp=lzw {layers}",
    "packbits": "--compression=PackBits {layers}",
    "one": "one.tif",
    "twice the same": "one.tif one.tif",
    "one inside the other": "one.tif inside.tif",
    "apart": "one.tif far.tif",
    "nothing in it": "one.tif empty.tif",
    "list": "@list.txt",
    "ignored": "--fine-mask -l 3 -a --no-optimize --primary-seam-generator=nft {layers}",
    "end of options": "-- {layers}",
    "a value that is not attached": "{layers} -w none",
    "an unknown option": "--bogus {layers}",
    "an unknown letter": "-q {layers}",
    "an ambiguous option": "--no {layers}",
    "no value": "{layers} --depth",
    "no files": "-w",
    "a missing file": "one.tif gone.tif",
    "no alpha": "one.tif opaque.tif",
    "only no alpha": "opaque.tif",
    "mixed depths": "one.tif deep.tif",
    "grey and colour": "one.tif grey.tif",
    "half a size": "-f180 {layers}",
    "an unknown mode": "-wsideways {layers}",
    "an unknown depth": "-d 64 {layers}",
    "an unknown compression": "--compression=zip {layers}",
    "an unknown ending": "-o out.xyz {layers}",
    "no folder": "-o gone/out.tif {layers}",
    "an empty line": "",
}


@pytest.mark.parametrize("line", SAME.values(), ids=list(SAME))
def test_ends_as_enblend_does(
    enblend: str, layers: list[str], line: str, capfd: pytest.CaptureFixture[str]
) -> None:
    """Exit code, and of the output size, place, depth, samples; nothing on stdout."""
    part("one.tif", 20, 100)
    part("inside.tif", 40, 30, 20, 30)
    part("far.tif", 140, 40)
    part("opaque.tif", 70, 100, alpha=False)
    part("deep.tif", 70, 100, dtype=np.uint16)
    part("grey.tif", 70, 100, grey=True)
    write_layer(Path("empty.tif"), np.zeros((90, 100, 4), np.uint8), 70, 0, CANVAS)
    Path("list.txt").write_text("# of\n" + "\n".join(layers) + "\n", "utf-8")
    arguments = spread(line, layers)
    before = names_in(Path())
    theirs = subprocess.run([enblend, "-o", "theirs.tif", *arguments], capture_output=True)
    ours = run(*arguments)
    output = capfd.readouterr()
    assert ours == theirs.returncode, (output.err, theirs.stderr)
    assert output.out == "" and "Traceback" not in output.err
    if ours:
        assert output.err.startswith("abflow-enblend: error: ")
        assert names_in(Path()) == before
        return
    assert set(names_in(Path())) - set(before) == {"out.tif", "theirs.tif"}
    assert place("out.tif") == place("theirs.tif")
    found, expected = tifffile.imread("out.tif"), tifffile.imread("theirs.tif")
    assert found.shape == expected.shape and found.dtype == expected.dtype
    np.testing.assert_array_equal(found[..., 3], expected[..., 3])


@pytest.mark.parametrize("line", ["{layers}", "-w -f180x90 {layers}", "-f 90x40+40+20 {layers}"])
def test_layers_of_one_picture_give_it_back(layers: list[str], line: str) -> None:
    assert (
        run(*(word for words in line.split() for word in (layers if words == "{layers}" else [words]))) == 0
    )
    left, top, width, height = place("out.tif")
    pixels, whole = tifffile.imread("out.tif"), picture()[top : top + height, left : left + width]
    covered = pixels[..., 3] == 255
    assert covered.mean() > 0.5
    np.testing.assert_array_equal(pixels[covered], whole[covered])


def test_size_is_exactly_what_is_asked_for(layers: list[str]) -> None:
    """enblend's is larger where layers reach beyond."""
    assert run("-f50x40+60+30", *layers) == 0
    assert place("out.tif") == (60, 30, 50, 40)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("depth", ["8", "16", "r32", "r64"])
def test_depth_rescales(layers: list[str], dtype: type, depth: str) -> None:
    part("a.tif", 0, 120, dtype=dtype)
    assert run("-d", depth, "a.tif") == 0
    found, stored = tifffile.imread("out.tif"), picture(dtype)[:, :120].astype(float) / full_scale(dtype)
    assert found.dtype == {"8": "uint8", "16": "uint16", "r32": "float32", "r64": "float64"}[depth]
    scale = full_scale(found.dtype)
    np.testing.assert_allclose(
        found, stored * scale, atol=0.5 if found.dtype.kind == "u" else 1e-6, rtol=1e-6
    )
    assert (found[..., 3] == scale).all()


@pytest.mark.parametrize(
    ("option", "name"), [("none", "NONE"), ("LZW", "LZW"), ("deflate", "DEFLATE"), ("90", "JPEG")]
)
def test_compression_of_tiff(layers: list[str], option: str, name: str) -> None:
    assert run(f"--compression={option}", *layers) == 0
    with tifffile.TiffFile("out.tif") as tiff:
        assert name in tiff.pages[0].compression.name


def test_quality_of_jpeg_and_compression_of_others(layers: list[str]) -> None:
    sizes = []
    for quality in ("20", "jpeg:95"):
        assert run("-o", "out.jpg", f"--compression={quality}", *layers) == 0
        sizes.append(Path("out.jpg").stat().st_size)
    assert sizes[0] < sizes[1] / 2
    assert run("-o", "out.png", "--compression=LZW", *layers) == 0
    assert run("-o", "out.exr", "-d", "r32", "--compression=LZW", *layers) == 0


@pytest.mark.parametrize("line", ["-o out.exr {layers}", "-o out.exr -d 16 {layers}", "-o out.tif half.exr"])
def test_samples_that_the_type_of_file_has_not(
    enblend: str, layers: list[str], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Floats; that integers become floats is warned of. (In EXR enblend itself writes halves, always.)"""
    write_image(Path("half.exr"), (picture() / 255).astype(np.float16))
    arguments = spread(line, layers)
    assert run(*arguments) == 0
    said = capsys.readouterr().err
    assert ("EXR holds no uint" in said) == ("as the photos code them" in said) == ("out.exr" in line)
    ours = read_layer(arguments[1])
    subprocess.run([enblend, *arguments], check=True, capture_output=True)
    theirs = read_layer(arguments[1])
    assert ours.dtype == np.float32
    assert ours.box == theirs.box
    alpha, expected = whole(ours)[..., 3], whole(theirs)
    np.testing.assert_array_equal(alpha, expected[..., 3])
    if len(arguments) == 3:  # one layer is copied
        np.testing.assert_array_equal(whole(ours), expected)
    assert whole(ours)[..., :3].max() == pytest.approx(expected[..., :3].max(), abs=0.02)


def test_icc_profile_is_kept(layers: list[str]) -> None:
    tifffile.imwrite("icc.tif", picture(), photometric="rgb", extrasamples=["unassalpha"], iccprofile=ICC)
    assert run("icc.tif") == 0
    assert read_layer("out.tif").icc == ICC


# The canvas


def test_canvas_is_said_with_v(layers: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """From PIXAR's tags; twice as wide as high and wrapped, it is a sphere."""
    assert run("-v", "-w", "-f180x90", *layers) == 0
    assert "canvas: 180 x 90, taken as equirectangular, 360 degrees" in capsys.readouterr().err
    assert run("-v", *layers) == 0
    assert "canvas: 180 x 90, taken as flat; crop: " in capsys.readouterr().err
    assert FULL_WIDTH in tifffile.TiffFile(layers[0]).pages[0].tags


def test_canvas_of_layers_that_do_not_tell(layers: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    part("a.tif", 20, 100, canvas=None)
    assert run("-v", "a.tif") == 0
    assert "canvas: 120 x 90, taken as flat" in capsys.readouterr().err
    assert run("-v", "-w", "-f200x100", "a.tif") == 0
    assert "canvas: 200 x 100, taken as equirectangular" in capsys.readouterr().err
    assert place("out.tif") == (0, 0, 200, 100)


def test_canvases_that_disagree(layers: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    part("other.tif", 70, 90, canvas=(360, 180))
    assert run(*layers, "other.tif") == 1
    message = capsys.readouterr().err
    assert "canvas of 180x90" in message and "other.tif" in message and "360x180" in message
    assert run("-f200x90", *layers) == 1
    assert "-f 200x90+0+0 reaches beyond the canvas of 180x90" in capsys.readouterr().err
    assert run("-f180x80+0+20", *layers) == 1
    assert "-f 180x80+0+20 reaches beyond the canvas of 180x90" in capsys.readouterr().err


def test_layer_beyond_the_canvas(layers: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """As a photo among the layers may be: nobody said -f."""
    write_image("photo.tif", np.full((100, 300, 4), 255, np.uint8))
    assert run(*layers, "photo.tif") == 1
    message = capsys.readouterr().err
    assert "photo.tif covers columns 0 to 300" in message and "-f" not in message
    write_image("photo.jpg", np.full((100, 300, 4), 255, np.uint8))
    assert run(*layers, "photo.jpg") == 1
    assert "photo.jpg has no alpha channel" in capsys.readouterr().err


LENS = "Eev0 Er1 Eb1 r0 p0 TrX0 TrY0 TrZ0 j0 a0 b0 c0 d0 e0 g0 t0"
PROJECT = f"""# hugin project file
p f2 w180 h90 v360 E0 R0 S20,160,0,85 n"TIFF_m c:LZW r:CROP"
m i0
i w120 h120 f3 v200 Ra0 Rb0 Rc0 Rd0 Re0 {LENS} y-60 n"a.jpg"
i w120 h120 f3 v200 Ra0 Rb0 Rc0 Rd0 Re0 {LENS} y40 n"b.jpg"
"""


def shifted(layers: list[str]) -> None:
    """Let the second layer show the picture 2 px off, 20 % darker: there is something to do."""
    pixels = np.roll(picture(), 2, 1)[:70, 70:160].copy()
    pixels[..., :3] = pixels[..., :3] * 0.8
    write_layer(Path(layers[1]), pixels, 70, 0, CANVAS)


def test_picture_is_that_of_hugin_abflow(layers: list[str]) -> None:
    """Bit for bit, with the project named and, as its canvas is a sphere, without."""
    shifted(layers)
    Path("p.pto").write_text(PROJECT)
    assert cli.main(["p.pto", "-o", "theirs.tif", "--layers", *layers]) == 0
    theirs = tifffile.imread("theirs.tif")
    assert run("-w", "-f140x85+20+0", *layers) == 0
    np.testing.assert_array_equal(tifffile.imread("out.tif"), theirs)
    assert run("-f140x85+20+0", "--parameter=abflow-project=p.pto", *layers) == 0
    np.testing.assert_array_equal(tifffile.imread("out.tif"), theirs)
    assert run("-f140x85+20+0", *layers) == 0  # flat, for all that it knows
    assert (tifffile.imread("out.tif") != theirs).any()


def test_project_of_another_canvas(layers: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    Path("p.pto").write_text(PROJECT.replace("w180 h90", "w360 h180"))
    assert run("--parameter=abflow-project=p.pto", *layers) == 1
    assert "180x90" in capsys.readouterr().err
    assert run("--parameter=abflow-project=gone.pto", *layers) == 1
    assert "gone.pto" in capsys.readouterr().err


def test_control_points_are_asked_for(layers: list[str], pano_trafo: str, capsys) -> None:
    names = [str(Path(name).rename(f"l{index:04}.tif")) for index, name in enumerate(layers)]
    Path("p.pto").write_text(PROJECT + "c n0 N1 x90 y60 X30 Y60 t0\n")
    assert run("-v", "--parameter=abflow-project=p.pto", *names) == 0
    assert "1 control points between the layers" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("said", "threads"),
    [(None, 0), ("1", 1), ("3", 3), (" 2,4", 2), ("0", 0), ("", 0), ("all", 0), ("-2", 0), ("9999999", 0)],
)
def test_as_many_cores_as_hugin_says(
    layers: list[str], said: str | None, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """hugin_executor's --threads and the preference of that name reach enblend as OMP_NUM_THREADS."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if said is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", said)
    found: list[int] = []
    monkeypatch.setattr(stand_in, "write_panorama", lambda *given, **named: found.append(given[3].threads))
    assert run(*layers) == 0
    assert found == [threads]


def test_photos_are_not_replaced(
    layers: list[str], exiftool: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither those of the project nor any other that tells how it was taken; what Hugin made is."""
    write_image("photo.tif", picture())
    Path("named.tif").write_bytes(Path("photo.tif").read_bytes())
    subprocess.run([exiftool, "-q", "-ExposureTime=0.01", "-Software=Box 1.0", "photo.tif"], check=True)
    Path("a.pto").write_text(
        'p f0 w180 h90 v60 n"TIFF_m"\nm i0\n'
        + "".join(
            f'i w90 h90 f0 v40 r0 p0 y{yaw} n"{name}"\n' for yaw, name in ((0, "named.tif"), (9, "x.tif"))
        )
    )
    before = {path.name: path.read_bytes() for path in Path().iterdir()}
    for arguments in (
        ["-o", "photo.tif"],
        ["-o", "named.tif", "--parameter=abflow-project=a.pto"],
        ["-o", "out.tif", "--save-masks=photo.tif"],
    ):
        assert run(*arguments, *layers[:1]) == 1
    assert capsys.readouterr().err.count("choose another name") >= 2
    assert {path.name: path.read_bytes() for path in Path().iterdir()} == before
    subprocess.run([exiftool, "-q", "-overwrite_original", "-Software=Hugin 2022.0", "photo.tif"], check=True)
    assert run("-o", "photo.tif", *layers) == 0


# What is said


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("one.tif", "only one layer"),
        ("one.tif inside.tif", "inside.tif is not used"),
        ("--fine-mask -x one.tif one.tif", "change nothing here: --fine-mask, -x"),
        ("-d 16 -o a.jpg one.tif one.tif", "a.jpg: JPEG holds no uint16 samples; they are written as uint8"),
        ("-d r32 -o a.png one.tif one.tif", "PNG holds no float32 samples; they are written as uint16"),
        ("-d r64 -o a.exr one.tif one.tif", "EXR holds no float64 samples; they are written as float32"),
    ],
)
def test_warnings(layers: list[str], line: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    part("one.tif", 20, 100)
    part("inside.tif", 40, 30, 20, 30)
    assert run("-v0", *line.split()) == 0
    (warning,) = capsys.readouterr().err.splitlines()
    assert said in warning and "hugin-abflow" not in warning


def test_a_folder_for_temporary_files_that_is_not_there_is_told(
    layers: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TMPDIR", "none")
    assert run(*layers) == 0
    assert "abflow-enblend: warning: TMPDIR is none, and no such folder is there" in capsys.readouterr().err


def test_verbosity(layers: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    printed = []
    for option in ("-v0", "-v1", "-v2"):
        assert run(option, *layers) == 0
        printed.append(capsys.readouterr().err)
    assert printed[0] == ""
    assert printed[1].startswith("read ...\n") and "canvas" not in printed[1]
    assert "canvas" in printed[2] and "blend: " in printed[2]


def test_wrong_line_names_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--bogus") == 1
    message = capsys.readouterr().err
    assert message == "abflow-enblend: error: unknown option --bogus\nTry 'abflow-enblend --help'.\n"


def test_version_names_enblend_in_its_first_line(capsys: pytest.CaptureFixture[str]) -> None:
    for option in ("--version", "-V"):
        assert stand_in.main([option]) == 0
        first = capsys.readouterr().out.splitlines()[0]
        assert first.startswith("abflow-enblend ") and first.endswith("in place of enblend 4.2")


def test_help_is_narrow_and_on_stdout(capsys: pytest.CaptureFixture[str]) -> None:
    assert stand_in.main(["-h"]) == 0
    output = capsys.readouterr()
    assert output.out.startswith("Usage: abflow-enblend ") and output.err == ""
    assert max(map(len, output.out.splitlines())) <= 110


def test_input_is_never_replaced(layers: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    before = Path(layers[0]).read_bytes()
    assert run("-o", layers[0], *layers) == 1
    assert "is an input" in capsys.readouterr().err
    assert Path(layers[0]).read_bytes() == before

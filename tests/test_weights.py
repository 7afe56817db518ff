"""Masks that abflow-enblend writes and takes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from layer_files import write_layer
from pictures import one_device, texture

from hugin_abflow import joint, working
from hugin_abflow.dropin import enblend, weights
from hugin_abflow.dropin.request import read_command_line
from hugin_abflow.dropin.weights import name
from hugin_abflow.errors import CommandLineError
from hugin_abflow.layer import Layer
from hugin_abflow.progress import silent

__all__ = ["one_device"]
pytestmark = pytest.mark.usefixtures("one_device")

WIDTH, HEIGHT = 200, 100


@pytest.fixture
def layers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Columns 0 to 120 and 80 to 200 of two quite different pictures."""
    monkeypatch.chdir(tmp_path)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    write_layer(Path("a.tif"), texture(y, x)[:, :120], 0, 0, (WIDTH, HEIGHT))
    write_layer(Path("b.tif"), texture(x, y)[:, 80:], 80, 0, (WIDTH, HEIGHT))
    return ["a.tif", "b.tif"]


def run(*arguments: str) -> int:
    return int(enblend.main(["-v0", "-o", "out.tif", *arguments]))


def weights_by_masks(line: str, layers: list[str]) -> list[np.ndarray]:
    """What weights become where masks are loaded; the command line saves them only where none are."""
    request = read_command_line(["-o", "out.tif", line, "--load-masks", *layers])
    enblend.blend(replace(request, save_masks="s%n.tif"), silent)
    return [tifffile.imread(f"s{number}.tif")[..., 0] for number in (1, 2)]


def test_masks_are_the_weights(layers: list[str]) -> None:
    """Of the output's size; white where a layer is alone, together white everywhere, black outside."""
    assert run("-f180x90+10+5", "--save-masks", *layers) == 0
    masks = [tifffile.imread(f"mask-{number}.tif") for number in (1, 2)]
    for mask in masks:
        assert mask.shape == (90, 180, 2) and mask.dtype == np.uint16
        assert (mask[..., 1] == 65535).all()
    assert (masks[0][:, :70, 0] == 65535).all() and (masks[0][:, 110:, 0] == 0).all()
    assert (masks[1][:, :70, 0] == 0).all() and (masks[1][:, 110:, 0] == 65535).all()
    total = masks[0][..., 0].astype(int) + masks[1][..., 0]
    assert np.abs(total - 65535).max() <= 1


@pytest.mark.parametrize("light", [False, True])
def test_masks_that_were_saved_give_the_same_picture(layers: list[str], light: bool) -> None:
    """Of floats, too, which are coded where all is seen from afar, and whose exposures differ."""
    for file, left, exposure in zip(layers * light, (0, 80), (1.0, 0.8), strict=False):
        pixels = tifffile.imread(file).astype(np.float32) / 255
        pixels[..., :3] *= exposure
        write_layer(Path(file), pixels, left, 0, (WIDTH, HEIGHT))
    assert run("--save-masks=m%n.tif", *layers) == 0
    first = tifffile.imread("out.tif").astype(float)
    assert run("--load-masks=m%n.tif", *layers) == 0
    assert np.abs(tifffile.imread("out.tif") - first).max() <= (1 / 255 if light else 1)


def test_a_layer_that_takes_no_part_gets_no_weight(
    layers: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It lies wholly inside the first; its mask would be read at one place only."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    write_layer(Path("c.tif"), texture(y, x)[20:60, 10:70], 10, 20, (WIDTH, HEIGHT))
    for number in (1, 2, 3):
        tifffile.imwrite(f"mask-{number}.tif", np.full((HEIGHT, WIDTH), 255, np.uint8))
    used, bands = [], joint.bands

    def watched(device, prepared, *others):
        used.extend(layer.field.get()[..., 3] for layer in prepared.layers)
        return bands(device, prepared, *others)

    monkeypatch.setattr(joint, "bands", watched)
    assert run("--load-masks", *layers, "c.tif") == 0
    assert [bool((weight < 0).any()) for weight in used] == [False, False, True]


def test_what_masks_take_out_leaves_no_shadow(layers: list[str]) -> None:
    """A dark thing that only the second layer shows: bands of frequencies change over where masks do, and it
    is no difference of exposure."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    wall = texture(y, x)
    wall[..., :3] = 100 + wall[..., :3] // 4
    picture = wall.copy()
    picture[25:75, 85:108, :3] = 45
    write_layer(Path("a.tif"), wall[:, :120], 0, 0, (WIDTH, HEIGHT))
    write_layer(Path("b.tif"), picture[:, 80:], 80, 0, (WIDTH, HEIGHT))
    for number, own in ((1, x < 118), (2, x >= 118)):
        tifffile.imwrite(f"mask-{number}.tif", own * np.uint8(255))
    assert run("--load-masks", *layers) == 0
    off = tifffile.imread("out.tif")[..., :3].astype(int) - wall[..., :3]
    assert np.abs(off[:, :112].mean(2)).max() < 5


@pytest.mark.parametrize("crop", ["200x100", "150x70+20+15"])
@pytest.mark.parametrize("samples", ["8 bit", "16 bit", "float", "colour"])
def test_masks_decide_which_layer_is_seen(layers: list[str], crop: str, samples: str) -> None:
    """Half of the overlap from either layer, cut where no weight of ours would; without geometry's help."""
    width, height = map(int, crop.partition("+")[0].split("x"))
    left, top = map(int, [*crop.split("+"), "0", "0"][1:3])
    upper = np.broadcast_to((np.arange(height) + top < 40)[:, None], (height, width))
    for number, white in ((1, upper), (2, ~upper)):
        grey = white * np.uint8(255)
        stored = {
            "8 bit": grey,
            "16 bit": grey * np.uint16(257),
            "float": grey.astype(np.float32) / 255,
            "colour": np.stack([grey] * 3, 2),
        }[samples]
        tifffile.imwrite(f"mask-{number}.tif", stored, photometric="rgb" if samples == "colour" else None)
    masks = weights_by_masks(f"-f{crop}", layers)
    inside = slice(85 - left, 115 - left)
    for rows, seen in ((slice(0, 39 - top), 0), (slice(41 - top, None), 1)):
        assert (masks[seen][rows, inside] == 65535).all()
        assert (masks[1 - seen][rows, inside] == 0).all()


def test_masks_of_a_smaller_working_canvas(layers: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Reduced and enlarged again, up to the crop's border, which no working pixel lies on."""
    settings = enblend.Settings
    monkeypatch.setattr(enblend, "Settings", lambda **chosen: settings(working_pixels=3000, **chosen))
    for number, white in ((1, 255), (2, 0)):
        tifffile.imwrite(f"mask-{number}.tif", np.full((81, 177), white, np.uint8))
    first, _ = weights_by_masks("-f177x81+9+11", layers)
    assert (first[:, : 115 - 9] == 65535).all()


def test_masks_are_read_by_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, layers: list[str]) -> None:
    """Of the layer's own place alone: memory does not grow with the canvas."""
    width, height, own = 400, 700, slice(500, 700)
    y, x = np.mgrid[:height, :width]
    write_layer(Path("a.tif"), texture(y, x)[:560], 0, 0, (width, height))
    write_layer(Path("b.tif"), texture(x, y)[own, 300:], 300, own.start, (width, height))
    for number in (1, 2):
        tifffile.imwrite(f"mask-{number}.tif", np.full((height, width), 255, np.uint8), rowsperstrip=1)
    asked: dict[str, list[tuple[int, int]]] = {}
    spread: list[tuple[int, int]] = []
    original, reduce_layer = weights.read_layer, working.reduce_layer

    def watched(path: Path) -> Layer:
        mask = original(path)

        def read(top: int, bottom: int) -> np.ndarray:
            asked.setdefault(mask.name, []).append((top, bottom))
            return mask.read(top, bottom)

        return replace(mask, read=read)

    def reduced(device, layer, *others, **options):
        spread.append((layer.box.width, layer.box.height))
        return reduce_layer(device, layer, *others, **options)

    monkeypatch.setattr(weights, "read_layer", watched)
    monkeypatch.setattr(working, "reduce_layer", reduced)
    assert run("--load-masks", "a.tif", "b.tif") == 0
    assert max(bottom - top for rows in asked.values() for top, bottom in rows) < 300
    assert min(asked["mask-2.tif"])[0] == own.start and max(asked["mask-2.tif"])[1] == own.stop
    assert (100, 200) in spread


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    before = {path: path.read_bytes() for path in Path().iterdir()}
    assert run(*arguments) == 1
    assert {path: path.read_bytes() for path in Path().iterdir()} == before
    return capsys.readouterr().err


def test_masks_that_cannot_be(layers: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert "mask-1.tif: no such mask for a.tif" in refused(capsys, "--load-masks", *layers)
    tifffile.imwrite("m.tif", np.zeros((9, 11), np.uint8))
    message = refused(capsys, "--load-masks=m.tif", *layers)
    assert "m.tif has 11x9 pixels, the output has 200x100" in message
    assert "names one mask twice" in refused(capsys, "--save-masks=s.tif", *layers)
    assert "is an input" in refused(capsys, "--save-masks=%p", *layers)
    message = refused(capsys, "--save-masks=%F.tif", layers[0])
    assert "out.tif is the name of the panorama; choose another for masks with --save-masks" in message
    assert "%q in %q.tif means nothing" in refused(capsys, "--save-masks=%q.tif", *layers)


def test_masks_and_lists_are_never_replaced(layers: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    for number in (1, 2):
        tifffile.imwrite(f"m{number}.tif", np.zeros((HEIGHT, WIDTH), np.uint8))
    Path("l.tif").write_text("@l1.tif\nb.tif\n")
    Path("l1.tif").write_text("a.tif\n")
    for arguments, replaced in (
        (("-o", "m1.tif", "--load-masks=m%n.tif", *layers), "m1.tif"),
        (("-o", "l.tif", "@l.tif"), "l.tif"),
        (("-o", "l1.tif", "@l.tif"), "l1.tif"),
        (("--save-masks=l%i.tif", "@l.tif"), "l1.tif"),
    ):
        assert f"{replaced} is an input of this panorama" in refused(capsys, *arguments)


def test_masks_replace_no_photos_of_the_project(
    layers: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """Whether or not their EXIF tells an exposure time, and whether they are active."""
    for number in (1, 2):
        tifffile.imwrite(f"photo{number}.tif", np.full((90, 90, 3), 99, np.uint8))
    photo = 'i w90 h90 f0 v40 r0 p0 y0 n"photo{}.tif"'
    lines = ['p f0 w200 h100 v60 n"TIFF_m"', "m i0", photo.format(1), "#-hugin disabled", photo.format(2)]
    Path("a.pto").write_text("\n".join([*lines, ""]))
    for first in ("photo%n", "./photo%n", "photo2"):
        said = refused(capsys, "--parameter=abflow-project=a.pto", f"--save-masks={first}.tif", layers[0])
        assert "is an input" in said


def test_masks_that_cannot_be_written_are_told_before_the_work(
    layers: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def prepare(*_: object) -> None:
        raise AssertionError("the work has begun")

    monkeypatch.setattr(joint, "prepare_in_memory", prepare)
    message = refused(capsys, "--save-masks=none/m%n.tif", *layers)
    assert "none/m1.tif cannot be written" in message
    assert "No such file or directory" in message
    assert "choose another folder with --save-masks" in message
    assert "m1.text: the ending must be one of" in refused(capsys, "--save-masks=m%n.text", *layers)
    message = refused(capsys, "--save-masks=m%n.exr", *layers)
    assert "m1.exr: EXR holds half or float, and these are uint16; choose .tif" in message
    assert "choose another name with --save-masks" in refused(capsys, "--save-masks=%p", *layers)


@pytest.mark.parametrize(
    ("template", "expected"),
    [
        ("mask-%n.tif", "mask-3.tif"),
        ("%03i%%%02n", "002%03"),
        ("%d/%f_m%e", "in/a.b_m.tif"),
        ("%b|%p", "a.b.tif|in/a.b.tif"),
        ("%D/%F%E %B %P", "out/p.png p.png out/p.png"),
        ("plain", "plain"),
    ],
)
def test_names_of_masks(template: str, expected: str) -> None:
    layer = Layer.from_array("x", np.zeros((1, 1, 4), np.uint8))
    layer = replace(layer, file=Path("in/a.b.tif"))
    assert name(template, 2, layer, Path("out/p.png")) == expected.replace("/", str(Path("/"))[0])


@pytest.mark.parametrize(
    ("template", "why"),
    [
        ("a%x", "%x in a%x means nothing"),
        ("a%99999999999n", "%99999999999n in .*: choose a width of at most 99"),
    ],
)
def test_name_that_cannot_be(template: str, why: str) -> None:
    with pytest.raises(CommandLineError, match=why):
        name(template, 0, Layer.from_array("x", np.zeros((1, 1, 4), np.uint8)), Path("o"))

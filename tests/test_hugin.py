"""Hugin's own stitcher, hugin_executor, blending through us: by its preferences, and by output sequences."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import tifffile
from conftest import ProjectMaker, names_in, photo_pixels, require_program
from layer_files import X_POSITION, Y_POSITION
from pictures import one_device

from hugin_abflow import cli
from hugin_abflow.dropin import setup

__all__ = ["one_device"]
pytestmark = [
    pytest.mark.skipif(os.name == "nt", reason="the programs' stand-ins are shell scripts"),
    pytest.mark.usefixtures("one_device"),
]

CANVAS = 'f2 w400 h200 v360 n"TIFF_m c:LZW r:CROP"'
NAME = 'a b\'c "d" é'  # what has to survive scripts, shells and wxWidgets

# What the command `pip install` makes does, and keeps the layers that the stitcher removes.
PROGRAM = """#!/bin/sh
for name; do
    case "$name" in *[0-9][0-9][0-9][0-9].???) test -f "$name" && cp -p "$name" "{kept}/";; esac
done
exec "{python}" -c 'import sys; from {module} import main; sys.exit(main())' "$@"
"""


@dataclass(frozen=True)
class Hugin:
    """hugin_executor with preferences and data of its own, and our programs installed.

    kept    the folder with copies of the layers that a blender was given.
    """

    executor: str
    kept: Path

    def stitch(self, project: Path, *options: str, name: str = NAME) -> str:
        """Stitch into the project's folder; the log of a run that must succeed."""
        command = [self.executor, "-s", *options, "-p", str(project.parent / name), str(project)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=project.parent)
        log = done.stdout + done.stderr
        assert done.returncode == 0, log
        assert "reverting" not in log and "Traceback" not in log
        return log

    def layers(self) -> list[str]:
        return [str(path) for path in sorted(self.kept.iterdir())]


@pytest.fixture
def hugin(tmp_path: Path, nona: str, exiftool: str, monkeypatch: pytest.MonkeyPatch) -> Hugin:
    """hugin-abflow-setup has been run, its programs lie in a folder with a space in its name."""
    executor = require_program("hugin_executor")
    programs, kept = tmp_path / "our programs", tmp_path / "kept"
    programs.mkdir()
    kept.mkdir()
    modules = {"hugin-abflow": "hugin_abflow.cli", "abflow-enblend": "hugin_abflow.dropin.enblend"}
    for name, module in modules.items():
        script = PROGRAM.format(kept=kept, python=sys.executable, module=module)
        (programs / name).write_text(script)
        (programs / name).chmod(0o755)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setattr(sys, "argv", [str(programs / "hugin-abflow-setup")])
    assert setup.main(["install"]) == 0
    return Hugin(executor, kept)


def read(path: Path) -> np.ndarray:
    image = oiio.ImageBuf(str(path))
    assert not image.has_error, image.geterror()
    return np.asarray(image.get_pixels(image.spec().format))


def position(path: Path) -> tuple[int, int]:
    with tifffile.TiffFile(path) as tiff:
        tags = tiff.pages[0].tags
        found = [tags[tag].value if tag in tags else (0, 1) for tag in (X_POSITION, Y_POSITION)]
    return round(found[0][0] * 150 / found[0][1]), round(found[1][0] * 150 / found[1][1])


def metadata(exiftool: str, path: Path) -> dict[str, object]:
    shown = subprocess.run([exiftool, "-json", "-n", str(path)], capture_output=True, check=True).stdout
    (tags,) = json.loads(shown)
    return dict(tags)


def ours(hugin: Hugin, project: Path, output: Path) -> np.ndarray:
    """What hugin-abflow makes of the project and the layers that the blender was given."""
    assert cli.main(["-q", str(project), "-o", str(output), "--layers", *hugin.layers()]) == 0
    return read(output)


# By the preferences


@pytest.mark.parametrize(
    ("how", "size", "offset"),
    [
        pytest.param(
            {"folder": "f é", "stem": NAME, "photo": "p'h {} ß.tif", "channels": 1},
            (400, 200),
            (0, 0),
            id="names, grey",
        ),
        pytest.param(
            {"panorama": CANVAS.replace("n", "S0,400,30,170 n", 1), "disabled": [1]},
            (400, 140),
            (0, 30),
            id="rows, disabled",
        ),
        pytest.param({"panorama": 'f1 w400 h150 v360 n"TIFF_m"'}, (400, 150), (0, 0), id="cylindrical"),
    ],
)
def test_stitcher_runs_through_us(
    hugin: Hugin,
    exiftool: str,
    make_project: ProjectMaker,
    tmp_path: Path,
    how: dict,
    size: tuple,
    offset: tuple,
) -> None:
    """Size, place, depth, ICC, Hugin's metadata, and each pixel what hugin-abflow makes of these layers."""
    project = make_project(**({"panorama": CANVAS} | how))
    before = set(names_in(project.parent))
    log = hugin.stitch(project)
    assert "read ..." in log and "enblend: info" not in log
    assert set(names_in(project.parent)) - before == {f"{NAME}.tif"}
    panorama = project.parent / f"{NAME}.tif"
    pixels = read(panorama)
    assert pixels.shape[1::-1] == size and pixels.dtype == how.get("dtype", np.uint8)
    assert position(panorama) == offset
    with tifffile.TiffFile(panorama) as tiff:
        assert tiff.pages[0].iccprofile == how.get("icc")
        assert tiff.pages[0].compression.name == "LZW"
    tags = metadata(exiftool, panorama)
    assert "Hugin" in str(tags["Software"])
    if how.get("panorama", CANVAS).startswith("f2"):
        assert (tags["FullPanoWidthPixels"], tags["FullPanoHeightPixels"]) == (400, 200)
        assert (tags["CroppedAreaImageWidthPixels"], tags["CroppedAreaImageHeightPixels"]) == size
        assert (tags["CroppedAreaLeftPixels"], tags["CroppedAreaTopPixels"]) == offset
    np.testing.assert_array_equal(pixels, ours(hugin, project, tmp_path / "ours.tif"))


def stacked(project: Path, options: str = "") -> Path:
    """The project with a darker photo in a stack with each of its own; another output than usual is asked."""
    lines: list[str] = []
    for line in project.read_text().splitlines():
        lines.append(line)
        if not line.startswith("i "):
            continue
        index = lines.count("#-hugin  cropFactor=1") - 1
        darker = f"darker {index}.tif"
        tifffile.imwrite(project.parent / darker, photo_pixels(index // 2) // 2, photometric="rgb")
        lines[-1] = line.replace(" j0 ", f" j{index} ")
        photo = line.split('n"')[0].replace(" Eev0 ", " Eev1 ").replace(" j0 ", f" j={index} ")
        lines += ["#-hugin  cropFactor=1", f'{photo}n"{darker}"']
    project.write_text("\n".join([*lines, "#hugin_outputLDRBlended false", options]) + "\n")
    return project


@pytest.mark.parametrize(
    ("option", "made", "blended"),
    [
        ("outputLDRExposureBlended", ["_fused.tif"], True),
        ("outputHDRBlended", ["_hdr.exr"], True),
        ("outputLDRExposureLayers", ["_exposure_0000.tif", "_exposure_0001.tif"], False),
    ],
)
def test_stacks_and_exposure_layers_run_through_us(
    hugin: Hugin, make_project: ProjectMaker, tmp_path: Path, option: str, made: list[str], blended: bool
) -> None:
    """As Hugin names them; `blended`: in one call, to compare with."""
    require_program("enfuse")
    project = stacked(make_project(panorama=CANVAS), f"#hugin_{option} true\n#hugin_outputImageTypeHDR exr")
    before = set(names_in(project.parent))
    assert "read ..." in hugin.stitch(project)
    panoramas = sorted(set(names_in(project.parent)) - before)
    assert panoramas == [NAME + ending for ending in made]
    for name in panoramas:
        pixels = read(project.parent / name)
        assert pixels.shape == (200, 400, 4) and (pixels[..., 3] > 0).mean() > 0.15
        if blended:
            plain = make_project(folder="plain", panorama=CANVAS)
            ending = Path(name).suffix
            assert len(hugin.layers()) == 3 and pixels.dtype == (np.float16 if ending == ".exr" else np.uint8)
            np.testing.assert_array_equal(pixels, ours(hugin, plain, tmp_path / f"ours{ending}"))


def test_project_in_the_options_is_used(hugin: Hugin, make_project: ProjectMaker, tmp_path: Path) -> None:
    """Part of a sphere, which a command line does not tell from a plane."""
    part = CANVAS.replace("n", "S50,350,20,160 n", 1)
    flat, told = (make_project(folder=folder, panorama=part) for folder in ("flat", "told"))
    told.write_text(told.read_text() + f"#hugin_enblendOptions --parameter=abflow-project={told}\n")
    hugin.stitch(flat)
    expected = ours(hugin, flat, tmp_path / "flat.tif")
    assert (read(flat.parent / f"{NAME}.tif") != expected).any()
    hugin.stitch(told)
    np.testing.assert_array_equal(read(told.parent / f"{NAME}.tif"), ours(hugin, told, tmp_path / "told.tif"))


def test_failure_of_the_blender_is_the_stitchers(hugin: Hugin, make_project: ProjectMaker) -> None:
    """What a user writes into Hugin's options may be wrong."""
    project = make_project(panorama=CANVAS, extra="#hugin_enblendOptions --bogus\n")
    with pytest.raises(AssertionError, match="unknown option --bogus"):
        hugin.stitch(project)
    assert not (project.parent / f"{NAME}.tif").exists()


def test_after_uninstall_enblend_is_back(hugin: Hugin, enblend: str, make_project: ProjectMaker) -> None:
    assert setup.main(["uninstall"]) == 0
    project = make_project(panorama=CANVAS)
    shown = hugin.stitch(project, "-d")
    assert "\nenblend " in shown and "abflow" not in shown.replace(str(project), "")


# By output sequences


def photographed(exiftool: str, project: Path) -> Path:
    """The project, its first photo taken by a camera named Box."""
    tag = [exiftool, "-q", "-overwrite_original", "-Model=Box", str(project.parent / "photo 0.tif")]
    subprocess.run(tag, check=True)
    return project


def test_sequence_keeps_layers(
    hugin: Hugin, exiftool: str, make_project: ProjectMaker, tmp_path: Path
) -> None:
    """Part of a sphere, which the project tells: pixels are those of hugin-abflow."""
    part = CANVAS.replace("n", "S50,350,20,160 n", 1)
    project = photographed(exiftool, make_project(stem=NAME, panorama=part))
    before = set(names_in(project.parent))
    hugin.stitch(project, "-u", "abflow_layers.executor")
    panorama = project.parent / f"{NAME}.tif"
    layers = sorted(set(names_in(project.parent)) - before - {panorama.name})
    assert layers == [f"{NAME}{number:04}.tif" for number in range(3)]
    pixels = read(panorama)
    assert pixels.shape == (140, 300, 4) and position(panorama) == (50, 20)
    assert metadata(exiftool, panorama)["Model"] == "Box"
    arguments = ["-q", str(project), "-o", str(tmp_path / "ours.tif"), "--layers"]
    assert cli.main([*arguments, *(str(project.parent / layer) for layer in layers)]) == 0
    np.testing.assert_array_equal(pixels, read(tmp_path / "ours.tif"))


def test_sequence_leaves_only_the_panorama(hugin: Hugin, exiftool: str, make_project: ProjectMaker) -> None:
    """Of a project that is named as Hugin's window hands it over."""
    project = photographed(exiftool, make_project(stem="huginpto_1a2b", ending="", panorama=CANVAS))
    before = set(names_in(project.parent))
    hugin.stitch(project, "-u", "abflow_panorama.executor")
    panorama = project.parent / f"{NAME}.tif"
    assert set(names_in(project.parent)) - before == {panorama.name}
    assert read(panorama).shape == (200, 400, 4)
    assert metadata(exiftool, panorama)["Model"] == "Box"

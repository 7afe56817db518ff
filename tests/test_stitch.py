"""Everything that a project asks for: the files of Hugin's own stitcher, blended by us."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import tifffile
from conftest import ProjectMaker, names_in, require_program
from layer_files import RATIONAL, X_POSITION, Y_POSITION, write_layer
from pictures import one_device
from test_exif import shown
from test_hugin import CANVAS, NAME, stacked
from test_metadata import shot

from hugin_abflow import cli, supply
from hugin_abflow.errors import (
    ExitCode,
    LayersMismatchError,
    LayersMissingError,
    OutputError,
    ProgramFailedError,
)
from hugin_abflow.images import read_layer
from hugin_abflow.merge import merge_project
from hugin_abflow.outputs import Kind
from hugin_abflow.settings import Settings
from hugin_abflow.shown import show_project
from hugin_abflow.stitch import stitch_project

__all__ = ["one_device"]
PART = 'f2 w400 h200 v250 S20,380,10,180 n"TIFF_m c:LZW r:CROP"'
pytestmark = pytest.mark.usefixtures("one_device")


@pytest.fixture(autouse=True)
def programs() -> None:
    for name in ("nona", "enfuse", "hugin_hdrmerge", "pano_trafo", "hugin_executor"):
        require_program(name)


def asked(*kinds: Kind, extra: str = "") -> str:
    """The lines of a project in which these outputs are checked."""
    lines = [f"#hugin_output{kind} {str(kind in kinds).lower()}" for kind in Kind]
    return "\n".join([*lines, extra, ""])


def pixels_of(path: Path) -> np.ndarray:
    image = oiio.ImageBuf(str(path))
    assert not image.has_error, image.geterror()
    return np.asarray(image.get_pixels(image.spec().format))


def hugins(project: Path, folder: Path) -> dict[str, Path]:
    """What Hugin's stitcher makes of the project, with enblend, in another folder; by name."""
    folder.mkdir()
    for file in project.parent.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    before = set(names_in(folder))
    prefix = project.stem if project.suffix == ".pto" else project.name
    command = ["hugin_executor", "-s", "-p", str(folder / prefix), str(folder / project.name)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return {name: folder / name for name in set(names_in(folder)) - before}


@pytest.mark.parametrize(
    ("how", "extra"),
    [
        pytest.param({"stem": NAME, "folder": "f é"}, "", id="360, names"),
        pytest.param(
            {"panorama": PART, "stem": "huginpto_1a", "ending": ""},
            "#hugin_outputImageType jpg\n#hugin_outputJPEGQuality 93\n#hugin_outputImageTypeHDR tif",
            id="part, cropped, JPEG, HDR as TIFF",
        ),
        pytest.param(
            {"panorama": 'f1 w400 h150 v360 n"TIFF_m"'},
            "#hugin_outputImageType png\n#hugin_enfuseOptions --hard-mask\n#hugin_hdrmergeOptions -m avg -c",
            id="cylindrical, PNG, options",
        ),
    ],
)
def test_all_outputs_are_hugins_files(
    make_project: ProjectMaker, exiftool: str, tmp_path: Path, how: dict, extra: str
) -> None:
    """Names, sizes, depth, place; layers and stacks nearly to the pixel."""
    project = stacked(make_project(**({"panorama": CANVAS} | how)), asked(*Kind, extra=extra))
    before = set(names_in(project.parent))
    theirs = hugins(project, tmp_path / "theirs")
    made = stitch_project(project)
    new = set(names_in(project.parent)) - before
    assert new == set(theirs)
    assert {path.name for path in made} == {name for name in new if not name.endswith(".pgm")}
    for path in made:
        ours, other = pixels_of(path), pixels_of(theirs[path.name])
        assert ours.shape == other.shape and ours.dtype == other.dtype, path.name
        if path.suffix == ".tif":
            assert read_layer(path).box == read_layer(theirs[path.name]).box, path.name
        if "_exposure_layers_" in path.name or "_stack_ldr_" in path.name:
            assert np.abs(ours.astype(int) - other.astype(int)).max() <= 2, path.name  # nona's dither


def test_blends_are_those_of_their_layers(make_project: ProjectMaker, exiftool: str) -> None:
    """Pixel by pixel what the command makes of the same files; with the first photo's metadata."""
    project = stacked(make_project(panorama=CANVAS, icc=None), asked(*Kind))
    shot(exiftool, project)
    stitch_project(project)
    folder, stem = project.parent, project.stem
    for name, layers in {
        f"{stem}.tif": [f"{stem}{index:04d}.tif" for index in (0, 2, 4)],  # of each view one exposure
        f"{stem}_exposure_0000.tif": [f"{stem}_exposure_layers_{index:04d}.tif" for index in (0, 2, 4)],
        f"{stem}_exposure_0001.tif": [f"{stem}_exposure_layers_{index:04d}.tif" for index in (1, 3, 5)],
        f"{stem}_fused.tif": [f"{stem}_stack_ldr_{index:04d}.tif" for index in range(3)],
        f"{stem}_hdr.exr": [f"{stem}_stack_hdr_{index:04d}.exr" for index in range(3)],
    }.items():
        again = folder / f"again{Path(name).suffix}"
        merge_project(project, layers=[folder / layer for layer in layers], output=again)
        np.testing.assert_array_equal(pixels_of(folder / name), pixels_of(again), err_msg=name)
    for name in ("", "_fused", "_blended_fused", "_exposure_0001", "_stack_ldr_0002"):
        tags = shown(exiftool, folder / f"{stem}{name}.tif")
        assert tags["IFD0:Model"] == "Box", name
        assert (tags["XMP-GPano:FullPanoWidthPixels"], tags["XMP-GPano:CroppedAreaTopPixels"]) == (400, 0)


@pytest.mark.parametrize(
    ("kinds", "made"),
    [
        ((), ["pano.tif"]),
        ((Kind.PANORAMA,), ["pano.tif"]),
        ((Kind.FUSED_STACKS,), ["pano_fused.tif"]),
        ((Kind.FUSED_LAYERS,), ["pano_blended_fused.tif"]),
        ((Kind.PANORAMA, Kind.HDR), ["pano.tif", "pano_hdr.exr"]),
        ((Kind.STACKS,), [f"pano_stack_ldr_{number:04d}.tif" for number in range(3)]),
    ],
)
def test_nothing_but_what_is_asked_for(
    make_project: ProjectMaker, temporary: Path, capsys, kinds: tuple, made: list[str]
) -> None:
    """Names on stdout; intermediate files are gone."""
    project = stacked(make_project(panorama=CANVAS), asked(*kinds))
    before = set(names_in(project.parent))
    assert cli.main([str(project)]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert [Path(line).name for line in printed] == made
    assert set(names_in(project.parent)) - before == set(made)


def test_output_named_is_the_only_one(make_project: ProjectMaker, capsys) -> None:
    project = stacked(make_project(panorama=CANVAS), asked(*Kind))
    before = set(names_in(project.parent))
    assert cli.main([str(project), "-o", str(project.with_name("only.png"))]) == 0
    assert set(names_in(project.parent)) - before == {"only.png"}


def test_options_reach_the_files(make_project: ProjectMaker) -> None:
    """Depth of the photos; compression where a format has it; layers kept."""
    kinds = asked(Kind.FUSED_STACKS, Kind.HDR)
    project = make_project(panorama=CANVAS, dtype=np.uint16)
    project.write_text(project.read_text() + kinds)
    made = stitch_project(project, compression="deflate", metadata=False, keep_layers=True)
    fused, hdr = made
    image = oiio.ImageBuf(str(fused))
    assert image.spec().format == oiio.UINT16 and image.spec().getattribute("compression") == "zip"
    assert not image.spec().getattribute("Software")
    assert oiio.ImageBuf(str(hdr)).spec().format == oiio.HALF
    assert {"pano_exposure_layers_0002.tif", "pano_hdr_0002.exr"} <= set(names_in(project.parent))


# What goes wrong


@pytest.fixture
def no_enfuse(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """PATH is a folder with all programs but enfuse; some OpenCL drivers need a linker from there."""
    folder = tmp_path / "programs"
    folder.mkdir()
    for place in os.get_exec_path():
        for program in Path(place).iterdir() if Path(place).is_dir() else ():
            if program.name != "enfuse" and not (folder / program.name).is_symlink():
                (folder / program.name).symlink_to(program)
    monkeypatch.setenv("PATH", str(folder))
    return folder


def test_what_cannot_be_made_is_said_and_left_out(
    make_project: ProjectMaker, no_enfuse: Path, capsys
) -> None:
    project = stacked(make_project(panorama=CANVAS), asked(Kind.PANORAMA, Kind.FUSED_STACKS))
    assert cli.main(["-q", str(project)]) == 0
    assert project.with_suffix(".tif").exists()
    said = capsys.readouterr().err
    assert "panorama, exposure fused from stacks" in said and "apt install enfuse" in said


def test_nothing_can_be_made(make_project: ProjectMaker, no_enfuse: Path, capsys) -> None:
    project = stacked(make_project(panorama=CANVAS), asked(Kind.FUSED_STACKS, Kind.STACKS))
    before = names_in(project.parent)
    for arguments in ([], ["--dry-run"]):
        assert cli.main([*arguments, str(project)]) == ExitCode.PROGRAM
        assert "nothing can be made: enfuse is not in PATH" in capsys.readouterr().err
    assert names_in(project.parent) == before


def test_program_that_fails_leaves_nothing(
    make_project: ProjectMaker, no_enfuse: Path, temporary: Path
) -> None:
    project = stacked(make_project(panorama=CANVAS), asked(Kind.FUSED_STACKS))
    before = names_in(project.parent)
    enfuse = no_enfuse / "enfuse"
    enfuse.write_text("#!/bin/sh\necho one; echo no such mask >&2; exit 1\n")
    enfuse.chmod(0o755)
    with pytest.raises(ProgramFailedError, match=r"enfuse failed \(exit code 1\).*\n  no such mask"):
        stitch_project(project)
    assert names_in(project.parent) == before


def test_what_was_made_before_a_failure_is_told(
    make_project: ProjectMaker, no_enfuse: Path, tmp_path: Path, capsys
) -> None:
    project = stacked(make_project(panorama=CANVAS), asked(Kind.PANORAMA, Kind.FUSED_STACKS))
    enfuse, report = no_enfuse / "enfuse", tmp_path / "report.json"
    enfuse.write_text("#!/bin/sh\nexit 1\n")
    enfuse.chmod(0o755)
    assert cli.main(["--report", str(report), str(project)]) == ExitCode.PROGRAM
    panorama = project.with_suffix(".tif")
    assert capsys.readouterr().out == f"{panorama}\n"
    (record,) = json.loads(report.read_text("utf-8"))["projects"]
    assert record["result"] == "failed"
    assert record["outputs"] == [{"file": str(panorama), "bytes": panorama.stat().st_size}]


def test_compression_that_enfuse_does_not_know(make_project: ProjectMaker, caplog) -> None:
    require_program("enfuse")
    project = stacked(make_project(panorama=CANVAS), asked(Kind.FUSED_LAYERS, Kind.FUSED_STACKS))
    by_enfuse, by_us = stitch_project(project, Settings(flow=False), compression="zstd")
    assert tifffile.TiffFile(by_enfuse).pages[0].compression.name == "LZW"
    assert tifffile.TiffFile(by_us).pages[0].compression.name == "ZSTD"
    assert caplog.text.count("enfuse knows no compression zstd; its files get LZW") == 1


@pytest.mark.parametrize("pages", [3, 2])
def test_layers_in_one_file_of_pages_are_refused(make_project: ProjectMaker, pages: int) -> None:
    """As many as there are images, and fewer."""
    project = make_project(panorama=CANVAS)
    project.write_text(project.read_text() + asked(Kind.EXPOSURE_LAYERS))
    with tifffile.TiffWriter(project.parent / "pano_exposure_layers_.tif") as writer:
        for _ in range(pages):
            tags = [(tag, RATIONAL, 1, (0, 150), True) for tag in (X_POSITION, Y_POSITION)]
            pixels = np.full((20, 30, 4), 255, np.uint8)
            writer.write(
                pixels, photometric="rgb", extrasamples=["unassalpha"], subfiletype=2, extratags=tags,
                resolution=(150, 150), resolutionunit="inch", metadata=None,
            )  # fmt: skip
    with pytest.raises(LayersMismatchError, match=r"pano_exposure_layers_\.tif holds .* --remap always"):
        stitch_project(project, remap="never")
    assert stitch_project(project, Settings(flow=False), remap="always")


@pytest.mark.parametrize("disabled", [(), (0,)])
def test_photo_is_never_replaced(make_project: ProjectMaker, disabled: tuple[int, ...]) -> None:
    project = make_project(panorama=CANVAS, photo="pano_stack_ldr_000{}.tif", disabled=disabled)
    project.write_text(project.read_text() + asked(Kind.STACKS))
    before = {path: path.read_bytes() for path in project.parent.iterdir()}
    with pytest.raises(OutputError, match=r"pano_stack_ldr_0000\.tif is an input"):
        stitch_project(project)
    assert {path: path.read_bytes() for path in project.parent.iterdir()} == before


# Shown, not made


def calls(lines: list[str]) -> list[str]:
    """The programs that a script calls, but for those of the shell itself."""
    words = (shlex.split(line)[0] for line in lines if not line.startswith("#"))
    return [word for word in words if word.partition("=")[0] not in ("set", "cd", "layers", "trap", "rm")]


def test_dry_run_does_nothing(make_project: ProjectMaker, temporary: Path, capsys) -> None:
    project = stacked(make_project(panorama=CANVAS, stem=NAME), asked(*Kind))
    before = {path: path.read_bytes() for path in project.parent.iterdir()}
    assert cli.main(["--dry-run", str(project)]) == 0
    assert {path: path.read_bytes() for path in project.parent.iterdir()} == before
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"# {NAME}.pto: 6 photos, equirectangular, 400 x 200 of 400 x 200"
    assert calls(lines) == [
        "nona", "hugin-abflow",
        "nona", "hugin-abflow", "hugin-abflow", "enfuse", "enfuse", "enfuse", "enfuse", "hugin-abflow",
        "nona", "hugin_hdrmerge", "hugin_hdrmerge", "hugin_hdrmerge", "hugin-abflow",
    ]  # fmt: skip


def run_shown(script: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run commands that were shown as a script in a folder, where this checkout is installed."""
    programs = folder / "bin"
    programs.mkdir()
    (programs / "hugin-abflow").write_text(f'#!/bin/sh\nexec "{sys.executable}" -m hugin_abflow "$@"\n')
    (programs / "hugin-abflow").chmod(0o755)
    monkeypatch.setenv("PATH", str(programs), prepend=os.pathsep)
    subprocess.run(["sh", "-c", script], cwd=folder, check=True, capture_output=True)


def test_commands_that_are_shown_make_the_files(
    make_project: ProjectMaker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Run as a script in another folder, with the options that were given.

    nona's dither is another one each time. These photos show different things, which may be cut in ways that
    are nearly as good as each other: dither would choose one.
    """
    project = stacked(make_project(panorama=CANVAS, stem=NAME), asked(Kind.FUSED_STACKS, Kind.HDR))
    settings = Settings(seam=False)
    script = "\n".join(show_project(project, settings, options=["--seam", "off"]))
    made = {path.name: pixels_of(path) for path in stitch_project(project, settings)}
    for name in made:
        (project.parent / name).unlink()
    run_shown(script, tmp_path, monkeypatch)
    for name, pixels in made.items():
        again = pixels_of(project.parent / name)
        assert again.shape == pixels.shape and again.dtype == pixels.dtype
        difference = np.abs(again.astype(float) - pixels.astype(float))
        assert (difference > 2).mean() < 1e-3 and difference.mean() < 0.1


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (
            {"output": "x y.jpg"},
            [
                *("layers=", "trap", "nona"),
                "hugin-abflow -o '{here}/x y.jpg' pano.pto --prefix \"$layers\"/pano",
                "rm",
            ],
        ),
        ({"prefix": "l"}, ["hugin-abflow -o pano.tif pano.pto --prefix l"]),
        ({"layers": ["a.tif"]}, ["hugin-abflow -o pano.tif pano.pto --layers {here}/a.tif"]),
    ],
)
def test_dry_run_of_one_panorama(
    make_project: ProjectMaker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: dict, expected: list
) -> None:
    monkeypatch.chdir(tmp_path)
    project = make_project(extra=asked(*Kind))
    for layer in (project.with_name("l0000.tif"), tmp_path / "a.tif"):
        write_layer(layer, np.full((9, 9, 4), 255, np.uint8))
    lines = show_project(project, **options)[3:]
    assert len(lines) == len(expected)
    for line, begin in zip(lines, expected, strict=True):
        assert line.startswith(begin.format(here=tmp_path))


def test_dry_run_takes_what_the_run_takes_and_nothing_else(make_project: ProjectMaker) -> None:
    project = make_project()
    shown = show_project(project)
    assert shown == show_project(project, Settings(), metadata=False)
    with pytest.raises(TypeError, match="prefixes"):
        show_project(project, prefixes="l")  # type: ignore[call-arg]


def test_dry_run_says_how_to_blend(make_project: ProjectMaker, capsys: pytest.CaptureFixture[str]) -> None:
    """By the command line or a file of settings; storing is said of outputs alone."""
    project = stacked(
        make_project(panorama=CANVAS), asked(Kind.PANORAMA, Kind.EXPOSURE_LAYERS, Kind.FUSED_STACKS)
    )
    project.with_name("abflow.toml").write_text("flow-magnitude = 50\n")
    chosen = ["--no-flow", "--max-memory", "1G", "--seam=auto", "--compression", "zstd"]
    assert cli.main(["--dry-run", "-v", *chosen, str(project)]) == 0
    lines = [shlex.split(line) for line in capsys.readouterr().out.splitlines()]
    ours = [line[1 : line.index("-o")] for line in lines if line[0] == "hugin-abflow"]
    how = ["--flow-magnitude", "50.0", "--no-flow", "--max-memory", "1073741824"]
    stored = ["--compression", "zstd"]
    assert ours == [[*how, *stored], how, how, [*how, *stored]]
    for words in ours:
        assert cli.main(["--dry-run", *words, str(project)]) == 0


def test_dry_run_finds_layers_as_the_run_does(
    make_project: ProjectMaker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = make_project(panorama=CANVAS)
    for run in (show_project, stitch_project):
        with pytest.raises(LayersMissingError, match=r"no layers pano0000\.tif .* let nona make them"):
            run(project, remap="never")
    (tmp_path / "layers").mkdir()
    write_layer(tmp_path / "layers" / "l0000.tif", np.full((9, 9, 4), 255, np.uint8))
    monkeypatch.chdir(tmp_path)
    line = shlex.split(show_project(project, prefix="layers/l")[-1])
    assert line[-2:] == ["--prefix", str(tmp_path / "layers" / "l")]


def test_dry_run_takes_layers_that_are_there(make_project: ProjectMaker) -> None:
    project = make_project(panorama=CANVAS)
    assert calls(show_project(project)) == ["nona", "hugin-abflow"]
    merge_project(project, keep_layers=True)
    assert calls(show_project(project)) == ["hugin-abflow"]
    assert calls(show_project(project, remap="always")) == ["nona", "hugin-abflow"]


def test_dry_run_has_nona_make_what_is_missing_and_no_more(make_project: ProjectMaker) -> None:
    project = make_project(panorama=CANVAS)
    merge_project(project, keep_layers=True)
    project.with_name("pano0001.tif").unlink()
    before = project.with_name("pano0000.tif").stat()
    alone = shlex.split(show_project(project)[-1])
    assert alone == ["hugin-abflow", "-o", "pano.tif", "pano.pto", "--remap", "auto"]
    remapping, ours = (shlex.split(line) for line in show_project(project, keep_layers=True)[5:])
    assert remapping[remapping.index("-i") :] == ["-i", "1", "-o", "pano", "pano.pto"]
    subprocess.run(remapping, cwd=project.parent, check=True, capture_output=True)
    assert project.with_name("pano0001.tif").is_file()
    assert project.with_name("pano0000.tif").stat() == before
    assert [shlex.split(line) for line in show_project(project)[5:]] == [ours]


def test_dry_run_names_the_panorama_as_the_run_does(make_project: ProjectMaker) -> None:
    """A file of many pages has the name that the panorama would have."""
    project = make_project(panorama=CANVAS)
    with tifffile.TiffWriter(project.with_name("pano.tif")) as file:
        for page in range(2):
            file.write(
                np.full((50, 50, 4), 255, np.uint8), photometric="rgb", extrasamples=["unassalpha"],
                subfiletype=2, resolution=(150, 150), resolutionunit="inch", metadata=None,
                extratags=[(X_POSITION, RATIONAL, 1, (40 * page, 150), True)],
            )  # fmt: skip
    for options in ({}, {"prefix": "pano"}):
        line = shlex.split(show_project(project, remap="never", **options)[-1])
        assert line[line.index("-o") + 1] == "pano_abflow.tif"
    assert [file.name for file in stitch_project(project, remap="never")] == ["pano_abflow.tif"]


def test_never_leaves_layers_as_they_are_for_the_panorama_as_well(
    make_project: ProjectMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = make_project(panorama=CANVAS, extra=asked(Kind.LAYERS, Kind.PANORAMA))
    merge_project(project, keep_layers=True)
    for file in project.parent.glob("pano000?.tif"):
        os.utime(file, (1e9, 1e9))
    monkeypatch.setattr(supply, "make_all", lambda *_: pytest.fail("layers are made"))
    assert [file.name for file in stitch_project(project, remap="never")][-1] == "pano.tif"

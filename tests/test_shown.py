"""Commands that are shown store what they make as the run does, by any name, and replace no more."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path

import numpy as np
import pytest
import tifffile
from conftest import ProjectMaker, remap
from layer_files import write_layer
from pictures import one_device
from test_hugin import CANVAS, stacked
from test_stitch import asked, programs, run_shown

from hugin_abflow.errors import AbflowError, ExitCode, NonaMissingError, OutputError
from hugin_abflow.outputs import Kind
from hugin_abflow.project import read_plan
from hugin_abflow.settings import Settings
from hugin_abflow.shown import show_project
from hugin_abflow.stitch import stitch_project

__all__ = ["one_device", "programs"]
pytestmark = pytest.mark.usefixtures("one_device")


def ours(lines: list[str], suffix: str) -> list[str]:
    """The words of the command that makes the panorama of this name."""
    (found,) = [
        words for words in map(shlex.split, lines) if any(word.endswith(suffix) for word in words[:9])
    ]
    return found


@pytest.mark.parametrize(
    ("ldr", "hdr", "chosen", "words"),
    [
        ("LZW", "DEFLATE", {}, ["--compression", "deflate"]),
        ("DEFLATE", "DEFLATE", {}, []),
        ("DEFLATE", "", {}, ["--compression", "lzw"]),  # what is usual, and not the other panorama's
        ("", "LZW", {}, []),
        ("LZW", "LZW", {"compression": "zstd", "jpeg_quality": 50}, ["--compression", "zstd"]),
        (
            "LZW",
            "LZW",
            {"compression": "jpeg", "jpeg_quality": 50},
            ["--compression", "jpeg", "--jpeg-quality", "50"],
        ),
    ],
)
def test_storing_is_said_where_it_is_not_that_of_the_ordinary_panorama(
    make_project: ProjectMaker, ldr: str, hdr: str, chosen: dict, words: list[str]
) -> None:
    extra = f"#hugin_outputImageTypeHDR tif\n#hugin_outputImageTypeHDRCompression {hdr}\n"
    extra += f"#hugin_outputImageType tif\n#hugin_outputImageTypeCompression {ldr}\n"
    kinds = Kind.PANORAMA, Kind.HDR
    project = stacked(make_project(panorama=CANVAS, stem="pano"), asked(*kinds, extra=extra))
    line = ours(show_project(project, **chosen), "pano_hdr.tif")
    assert line[1 : line.index("-o")] == words


def test_what_is_shown_works_for_names_with_a_dash_in_front(
    make_project: ProjectMaker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And makes HDR in deflate, as the run does."""
    extra = "#hugin_outputImageTypeHDR tif\n#hugin_outputImageTypeHDRCompression DEFLATE\n"
    kinds = Kind.PANORAMA, Kind.FUSED_STACKS, Kind.HDR
    project = stacked(make_project(panorama=CANVAS, stem="-x"), asked(*kinds, extra=extra))
    settings = Settings(flow=False)
    script = "\n".join(show_project(project, settings, options=["--no-flow"]))
    made = {path.name: compression_of(path) for path in stitch_project(project, settings)}
    assert made == {"-x.tif": "LZW", "-x_fused.tif": "LZW", "-x_hdr.tif": "ADOBE_DEFLATE"}
    for name in made:
        (project.parent / name).unlink()
    run_shown(script, tmp_path, monkeypatch)
    assert {name: compression_of(project.parent / name) for name in made} == made


@pytest.mark.parametrize("kind", ["jpg", "png"])
def test_a_compression_for_other_types_leaves_jpeg_and_png_as_they_are(
    make_project: ProjectMaker, kind: str
) -> None:
    """In a run over several projects they may be of several types; who names the file is told."""
    extra = asked(Kind.PANORAMA, extra=f"#hugin_outputImageType {kind}\n")
    project = make_project(panorama=CANVAS, yaws=(0, 60), extra=extra)
    settings, name = Settings(flow=False), f"pano.{kind}"
    line = ours(show_project(project, settings, compression="lzw"), name)
    assert "--compression" not in line
    (made,) = stitch_project(project, settings, compression="lzw")
    assert made.name == name
    own = {"jpg": "jpeg", "png": "deflate"}[kind]
    with pytest.raises(OutputError, match=rf"pano\.{kind}: compression 'lzw'; choose one of {own}"):
        stitch_project(project, settings, output=made, compression="lzw")
    assert stitch_project(project, settings, output=made, compression=own.upper()) == [made]


# What must not be replaced


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_layers_of_a_script_replace_nothing(
    make_project: ProjectMaker, tmp_path: Path, temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They would have the photos' names; a stack, which is made on the way, that of a picture."""
    project = make_project(panorama=CANVAS, yaws=(0, 60), photo="pano{:04d}.tif")
    project.write_text(project.read_text() + asked(Kind.PANORAMA, Kind.FUSED_STACKS))
    project.with_name("pano_stack_ldr_0000.tif").write_bytes(b"a picture of mine")
    before = contents(project.parent)
    run_shown("\n".join(show_project(project, options=["--no-flow"])), tmp_path, monkeypatch)
    made = {"pano.tif", "pano_fused.tif"}
    assert {name: data for name, data in contents(project.parent).items() if name not in made} == before


@pytest.mark.parametrize("kinds", [(Kind.PANORAMA,), (Kind.LAYERS,)])
def test_layers_that_cannot_be_kept_are_refused(make_project: ProjectMaker, kinds: tuple[Kind, ...]) -> None:
    """As the run refuses them: a script would have nona replace them."""
    project = make_project(panorama=CANVAS, photo="pano{:04d}.tif", extra=asked(*kinds))
    with pytest.raises(OutputError, match=r"pano0000\.tif is a photo"):
        show_project(project, keep_layers=Kind.PANORAMA in kinds)


def test_stacks_that_would_replace_photos_are_refused(make_project: ProjectMaker) -> None:
    """As by the run: enfuse would replace them."""
    project = make_project(panorama=CANVAS, photo="pano_stack_ldr_{:04d}.tif", extra=asked(Kind.STACKS))
    with pytest.raises(OutputError, match=r"pano_stack_ldr_0000\.tif is an input"):
        show_project(project)


def test_missing_layers_are_made_beside_those_that_are_there(
    make_project: ProjectMaker, tmp_path: Path, temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of exposures, which programs take that have no --remap."""
    project = make_project(panorama=CANVAS, yaws=(0, 60), extra=asked(Kind.FUSED_STACKS))
    stitch_project(project, keep_layers=True)
    for name in ("pano_fused.tif", "pano_exposure_layers_0001.tif"):
        project.with_name(name).unlink()
    before = contents(project.parent)
    run_shown("\n".join(show_project(project)), tmp_path, monkeypatch)
    after = contents(project.parent)
    assert after.pop("pano_fused.tif") and after == before


@pytest.mark.parametrize("fails", ["cd", "nona"])
def test_a_script_ends_at_the_first_error(
    make_project: ProjectMaker, tmp_path: Path, temporary: Path, monkeypatch: pytest.MonkeyPatch, fails: str
) -> None:
    """Even if layers are there from before, or the current folder has a project of the same name."""
    project = make_project(panorama=CANVAS, yaws=(0, 60))
    remap(read_plan(project), "pano")
    script = "\n".join(show_project(project, remap="always"))
    here = project.parent
    if fails == "cd":
        here = project.parent.rename(tmp_path / "elsewhere")
    else:
        project.with_name("photo 0.tif").unlink()
    with pytest.raises(subprocess.CalledProcessError):
        run_shown(script, here, monkeypatch)
    assert not (here / "pano.tif").exists()


def compression_of(path: Path) -> str:
    with tifffile.TiffFile(path) as file:
        return file.pages[0].compression.name


@pytest.mark.parametrize(
    ("options", "code", "said"),
    [
        ({"compression": "piz"}, ExitCode.OUTPUT, "compression 'piz'; choose one of none"),
        ({"compression": "lzw", "output": "a.jpg"}, ExitCode.OUTPUT, "compression 'lzw'; choose one of jpeg"),
        ({"output": "a.gif"}, ExitCode.OUTPUT, "the ending must be one of"),
        ({"output": "none/a.tif"}, ExitCode.OUTPUT, "choose another folder with -o"),
        ({"output": "photo 0.tif"}, ExitCode.OUTPUT, "is an input of this panorama"),
        ({"output": "a.tif", "layers": ["a.tif"]}, ExitCode.OUTPUT, "is an input of this panorama"),
        ({"layers": ["none.tif"]}, ExitCode.LAYERS_MISSING, "no such layer"),
        ({"layers": ["photo 0.tif"]}, ExitCode.LAYERS_MISMATCH, "has no alpha channel"),
        ({"layers": ["pano.pto"]}, ExitCode.IMAGE_READ, "cannot be read"),
        ({"layers": ["a.tif"], "remap": "always"}, ExitCode.USAGE, "leave out"),
        ({"prefix": "none"}, ExitCode.LAYERS_MISSING, "check --prefix"),
        ({"settings": Settings(device="none")}, ExitCode.DEVICE, "--device none"),
        ({"output": "missing.tif"}, ExitCode.LAYERS_MISSING, "photo 1.tif (image 1) is not there"),
        ({"remap": "always"}, ExitCode.LAYERS_MISSING, "photo 1.tif (image 1) is not there"),
    ],
)
def test_what_the_run_refuses_is_refused_alike(
    make_project: ProjectMaker, monkeypatch: pytest.MonkeyPatch, options: dict, code: ExitCode, said: str
) -> None:
    """Of the options; what is found out while layers are made or merged shows in the run alone."""
    project = make_project(panorama=CANVAS)
    write_layer(project.with_name("a.tif"), np.full((9, 9, 4), 255, np.uint8))
    if "photo 1" in said:
        project.with_name("photo 1.tif").unlink()
    monkeypatch.chdir(project.parent)
    before = sorted(project.parent.iterdir())
    messages = []
    for run in (stitch_project, show_project):
        with pytest.raises(AbflowError, match=re.escape(said)) as caught:
            run(project, **options)
        assert caught.value.exit_code == code
        messages.append(str(caught.value))
    assert messages[0] == messages[1]
    assert sorted(project.parent.iterdir()) == before


def test_nona_is_missed_where_layers_have_to_be_made(
    make_project: ProjectMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Or some of them; whether photos of these miss the crop, and need not be there, nona alone can tell."""
    project = make_project(panorama=CANVAS, yaws=(0, 60))
    remap(read_plan(project), "pano")
    project.with_name("pano0001.tif").unlink()
    project.with_name("photo 1.tif").rename(project.with_name("photo 2.tif"))
    assert show_project(project)
    monkeypatch.setenv("PATH", "")
    assert show_project(project, remap="never")
    for run in (stitch_project, show_project):
        with pytest.raises(NonaMissingError, match=r"nona is not in PATH; .* or name layers"):
            run(project)
    project.with_name("photo 2.tif").rename(project.with_name("photo 1.tif"))
    for run in (stitch_project, show_project):
        with pytest.raises(NonaMissingError, match=r"nona is not in PATH; .* or name layers"):
            run(project, remap="always")


def test_photos_that_nona_does_not_find_are_named(make_project: ProjectMaker, nona: str) -> None:
    """The run finds them: the project may come from Windows."""
    project = make_project(panorama=CANVAS, stem="pano")
    assert not [line for line in show_project(project) if "nona does not find" in line]
    found = (project.parent / "photo 1.tif").rename(project.parent / "PHOTO 1.tif")
    (line,) = [line for line in show_project(project) if "nona does not find" in line]
    assert line.startswith(f"# photo 1.tif is {found}, which ")
    assert stitch_project(project)

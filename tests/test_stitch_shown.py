"""Commands that are shown store what they make as the run does, whatever it is called."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
import tifffile
from conftest import ProjectMaker
from pictures import one_device
from test_hugin import CANVAS, stacked
from test_stitch import asked, programs, run_shown

from hugin_abflow.errors import OutputError
from hugin_abflow.outputs import Kind
from hugin_abflow.settings import Settings
from hugin_abflow.stitch import show_project, stitch_project

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


def compression_of(path: Path) -> str:
    with tifffile.TiffFile(path) as file:
        return file.pages[0].compression.name

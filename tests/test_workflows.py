"""Every way in which Hugin's users come to a panorama, with the real programs: the table of what is checked.

Each row is a project, a command and what the panorama's file must be: size, place on the canvas, depth, ICC
profile, camera, GPano, and each pixel what `merge_layers` makes of the same layers.
"""

from __future__ import annotations

import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ICC, ProjectMaker, require_program
from pictures import one_device
from test_hugin import CANVAS, NAME, Hugin, hugin, metadata, read, stacked
from test_metadata import shot

from hugin_abflow import cli
from hugin_abflow.dropin.enblend import main as abflow_enblend
from hugin_abflow.images import read_layer, write_image
from hugin_abflow.merge import merge_layers
from hugin_abflow.project import read_plan

__all__ = ["hugin", "one_device"]
pytestmark = pytest.mark.usefixtures("one_device")

CROPPED = CANVAS.replace("n", "S50,350,20,160 n", 1)  # 300 x 140 at (50, 20)
ROWS_CUT = CANVAS.replace("n", "S0,400,30,170 n", 1)
HALF = 'f2 w200 h100 v180 n"TIFF_m"'
FLAT = 'f0 w300 h200 v110 S20,280,10,190 n"TIFF_m"'
FUSED = "#hugin_outputLDRExposureBlended true\n#hugin_outputLDRStacks true"
HDR = "#hugin_outputHDRBlended true\n#hugin_outputHDRStacks true\n#hugin_outputImageTypeHDR exr"


@dataclass(frozen=True)
class Workflow:
    """One row of the table.

    command     "stitch": hugin_executor, as Hugin's window has it, with our program in its preferences;
                "sequence NAME": with one of our output sequences; "hugin-abflow ARGUMENTS"; "abflow-enblend".
    project     keywords of `make_project`.
    stacks      each photo has a darker one beside it; options that are checked in Hugin.
    ending      of the panorama, from the project's or prefix's name on.
    knows       the blender is told the project, not only the layers.
    size, place, dtype, icc, gpano (left, top), camera    what the file must say.
    """

    command: str
    project: Mapping[str, Any] = field(default_factory=dict)
    stacks: str = ""
    ending: str = ".tif"
    knows: bool = True
    size: tuple[int, int] = (400, 200)
    place: tuple[int, int] = (0, 0)
    dtype: type = np.uint8
    icc: bytes | None = None
    gpano: tuple[int, int] | None = (0, 0)
    camera: bool = True


NAMED = {"folder": "f é", "stem": NAME, "photo": "p'h {} ß.tif"}
DEEP = {"dtype": np.uint16, "icc": ICC}
PART = {"panorama": CROPPED}
WORKFLOWS = {
    "Stitch!, 360": Workflow("stitch", knows=False),
    "Stitch!, names": Workflow("stitch", NAMED, knows=False),
    "Stitch!, 16 bit, ICC": Workflow("stitch", DEEP, dtype=np.uint16, icc=ICC, knows=False),
    "Stitch!, rows cut": Workflow(
        "stitch", {"panorama": ROWS_CUT}, size=(400, 140), place=(0, 30), gpano=(0, 30), knows=False
    ),
    "Stitch!, project in the options": Workflow(
        "stitch told", PART, size=(300, 140), place=(50, 20), gpano=(50, 20)
    ),
    "Stitch!, flat": Workflow(
        "stitch", {"panorama": FLAT, "yaws": (-20, 5, 30)}, size=(260, 180), place=(20, 10), gpano=None,
        knows=False,
    ),
    "Stitch!, JPEG": Workflow(
        "stitch", {"extra": "#hugin_outputImageType jpg\n#hugin_outputJPEGQuality 92\n"}, ending=".jpg",
        knows=False,
    ),
    "Stitch!, stacks": Workflow("stitch", stacks=FUSED, ending="_fused.tif", knows=False),
    "Stitch!, HDR": Workflow(
        "stitch", stacks=HDR, ending="_hdr.exr", dtype=np.float16, gpano=None, camera=False, knows=False
    ),
    "sequence": Workflow("sequence abflow_panorama", DEEP | NAMED, dtype=np.uint16, icc=ICC),
    "sequence, layers kept, cropped": Workflow(
        "sequence abflow_layers", PART, size=(300, 140), place=(50, 20), gpano=(50, 20)
    ),
    "sequence, stacks": Workflow(
        "sequence abflow_stacks", stacks=FUSED, ending="_fused.tif", gpano=None, knows=False
    ),
    "hugin-abflow": Workflow("hugin-abflow"),
    "hugin-abflow, names, cropped": Workflow(
        "hugin-abflow", PART | NAMED, size=(300, 140), place=(50, 20), gpano=(50, 20)
    ),
    "hugin-abflow, 16 bit, ICC": Workflow("hugin-abflow", DEEP, dtype=np.uint16, icc=ICC),
    "hugin-abflow, JPEG": Workflow("hugin-abflow -o .jpg --jpeg-quality 92", PART, ending=".jpg",
        size=(300, 140), gpano=(50, 20)),
    "hugin-abflow, PNG of 16 bit": Workflow("hugin-abflow -o .png", {"dtype": np.uint16}, ending=".png",
        dtype=np.uint16),
    "hugin-abflow, grey": Workflow("hugin-abflow", {"channels": 1}),
    "hugin-abflow, part of a sphere": Workflow(
        "hugin-abflow", {"panorama": HALF, "yaws": (-40, 5, 60)}, size=(200, 100), gpano=(100, 50)
    ),
    "hugin-abflow, flat": Workflow(
        "hugin-abflow", {"panorama": FLAT, "yaws": (-20, 5, 30)}, size=(260, 180), place=(20, 10), gpano=None
    ),
    "hugin-abflow, stacks": Workflow("hugin-abflow", stacks=FUSED, ending="_fused.tif"),
    "hugin-abflow, HDR": Workflow(
        "hugin-abflow", stacks=HDR, ending="_hdr.exr", dtype=np.float16, gpano=None, camera=True
    ),
    "abflow-enblend in a script": Workflow(
        "abflow-enblend", PART, size=(300, 140), place=(50, 20), gpano=(50, 20)
    ),
}  # fmt: skip


def asked(row: Workflow, make_project: ProjectMaker, exiftool: str) -> Path:
    """The row's project, its first photo taken by a camera named Box."""
    project = make_project(**({"panorama": CANVAS} | dict(row.project)))
    project = stacked(project, row.stacks) if row.stacks else project
    if row.command == "stitch told":
        project.write_text(
            f"{project.read_text()}#hugin_enblendOptions --parameter=abflow-project={project}\n"
        )
    photo = row.project.get("photo", "photo {}.tif").format(0)
    title = [exiftool, "-q", "-overwrite_original", "-XMP-dc:Title=quay", str(project.parent / photo)]
    subprocess.run(title, check=True)
    return shot(exiftool, project, photo)


def run(row: Workflow, hugin: Hugin, project: Path) -> tuple[Path, list[Path]]:
    """Make the panorama; gives its file and the layers that were blended."""
    program, *words = row.command.split()
    panorama = project.with_name(f"{NAME}{row.ending}")
    if program in ("stitch", "sequence"):
        hugin.stitch(project, *(["-u", f"{words[0]}.executor"] if program == "sequence" else []))
        return panorama, sorted(hugin.kept.iterdir()) or sorted(project.parent.glob(f"{NAME}????.tif"))
    if program == "hugin-abflow":
        if words:
            words[1] = str(project.with_name(f"out{words[1]}"))
        assert cli.main(["-q", "--keep-layers", *words, str(project)]) == 0
        panorama = Path(words[1]) if words else project.with_name(f"{project.stem}{row.ending}")
        pattern = {FUSED: "_stack_ldr_????.tif", HDR: "_stack_hdr_????.exr"}.get(row.stacks, "????.tif")
        return panorama, sorted(project.parent.glob(f"{project.stem}{pattern}"))
    nona = [require_program("nona"), "-r", "ldr", "-m", "TIFF_m", "-o", "l", str(project)]
    subprocess.run(nona, cwd=project.parent, check=True, capture_output=True)
    layers = sorted(project.parent.glob("l????.tif"))
    told = f"--parameter=abflow-project={project}"
    crop = f"-f{row.size[0]}x{row.size[1]}+{row.place[0]}+{row.place[1]}"
    assert abflow_enblend([told, crop, "-o", str(panorama), "--", *map(str, layers)]) == 0
    return panorama, layers


def expected(row: Workflow, project: Path, layers: list[Path], panorama: Path) -> np.ndarray:
    """What `merge_layers` makes of the layers, through a file of the same type."""
    canvas = read_plan(project).canvas
    if not row.knows:
        canvas = replace(canvas, spherical=canvas.spherical and canvas.wraps, hfov=360 * canvas.spherical)
    pixels = merge_layers([read_layer(layer) for layer in layers], canvas)
    file = panorama.with_name(f"expected{panorama.suffix}")
    write_image(file, pixels, jpeg_quality=92)
    return read(file)


@pytest.mark.parametrize("name", WORKFLOWS)
def test_workflow(name: str, hugin: Hugin, exiftool: str, make_project: ProjectMaker) -> None:
    row = WORKFLOWS[name]
    require_program("enfuse")
    project = asked(row, make_project, exiftool)
    panorama, layers = run(row, hugin, project)

    pixels = read(panorama)
    assert pixels.shape[1::-1] == row.size and pixels.dtype == row.dtype
    layer = read_layer(panorama)
    if panorama.suffix in (".tif", ".exr"):
        assert (layer.box.left, layer.box.top) == row.place
    assert layer.icc == row.icc

    shown = subprocess.run(
        [exiftool, "-a", "-G1", "-s", str(panorama)], capture_output=True, text=True
    ).stdout
    for tag in ("UserComment", "ProjectionType", "GPSLatitudeRef"):
        assert shown.count(f" {tag} ") <= 1, tag
    tags = metadata(exiftool, panorama)
    assert tags.get("Model") == ("Box" if row.camera else None)
    # Hugin copies none, our sequences do
    titled = (row.knows or row.command.startswith("sequence")) and panorama.suffix != ".exr"
    assert tags.get("Title") == ("quay" if titled else None)
    if row.gpano is None:
        assert "ProjectionType" not in tags
    else:
        assert tags["ProjectionType"] == "equirectangular" and tags["UsePanoramaViewer"] is True
        assert (tags["FullPanoWidthPixels"], tags["FullPanoHeightPixels"]) == (400, 200)
        assert (tags["CroppedAreaLeftPixels"], tags["CroppedAreaTopPixels"]) == row.gpano
        assert (tags["CroppedAreaImageWidthPixels"], tags["CroppedAreaImageHeightPixels"]) == row.size

    if layers:
        assert len(layers) == 3
        np.testing.assert_array_equal(pixels, expected(row, project, layers, panorama))
    else:  # gone with Hugin's sequence
        assert row.command == "sequence abflow_panorama" and pixels[..., 3].any()

"""Photos beside a project that are none of its own are not replaced by outputs that nobody names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import ProjectMaker, names_in
from shoots import Deaf, write_project
from test_hugin import CANVAS
from test_stitch import asked

from hugin_abflow import cli
from hugin_abflow.asked import asked_panoramas
from hugin_abflow.batch.task import Task, perform
from hugin_abflow.encoding import ENDINGS
from hugin_abflow.errors import OutputError
from hugin_abflow.exif import Metadata, embed, text
from hugin_abflow.images import write_image
from hugin_abflow.outputs import Kind, results
from hugin_abflow.project import read_plan
from hugin_abflow.settings import Settings
from hugin_abflow.shown import show_project
from hugin_abflow.stitch import stitch_project
from hugin_abflow.tifftags import EXIF, MAIN, RATIONAL, Value

EXPOSURE_TIME = {33434: Value(RATIONAL, (1).to_bytes(4, "little") + (250).to_bytes(4, "little"))}
JPEG = "#hugin_outputImageType jpg\n"
CAMERA = "Ver.1.00"  # what one names as its software


def photograph(file: Path, software: str = "") -> bytes:
    """A file as a camera writes it, which may name its software."""
    write_image(file, np.full((20, 30, 4), 255, np.uint8))
    main = {271: text("NIKON"), **({305: text(software)} if software else {})}
    embed(file, ENDINGS[file.suffix], Metadata({MAIN: main, EXIF: EXPOSURE_TIME}))
    return file.read_bytes()


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """With its layers; a JPEG file is asked for."""
    file = write_project(tmp_path / "IMG_1.pto")
    file.write_text(file.read_text().replace("#hugin_outputImageType tif\n", JPEG))
    return file


@pytest.mark.parametrize("ending", [".tif", ".jpg", ".png"])
@pytest.mark.parametrize("suffix", ["", "_fused"])
def test_default_output_is_no_photo_of_others(make_project: ProjectMaker, ending: str, suffix: str) -> None:
    plan = read_plan(make_project(extra=f"#hugin_outputImageType {ending[1:]}\n"))
    first, second = (plan.folder / f"pano{suffix}{more}{ending}" for more in ("", "_abflow"))
    assert plan.default_output(suffix=suffix) == first
    photograph(first)
    assert plan.default_output(suffix=suffix) == second
    photograph(second, CAMERA)
    assert plan.default_output(suffix=suffix).name == f"pano{suffix}_abflow2{ending}"


@pytest.mark.parametrize("software", ["hugin-abflow 0.9", "Hugin 2023.0.0"])
def test_panoramas_that_tell_an_exposure_time_are_replaced(project: Path, software: str) -> None:
    """Some have all of their first photo's EXIF."""
    photograph(project.with_suffix(".jpg"), software)
    assert read_plan(project).default_output() == project.with_suffix(".jpg")


def test_a_single_run_leaves_the_photo_and_replaces_its_own(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photo = project.with_suffix(".jpg")
    before = photograph(photo, CAMERA)
    names = names_in(project.parent)
    for _ in range(2):
        assert cli.main([str(project)]) == 0
        assert capsys.readouterr().out == f"{project.with_name('IMG_1_abflow.jpg')}\n"
        assert names_in(project.parent) == sorted([*names, "IMG_1_abflow.jpg"])
    assert photo.read_bytes() == before


@pytest.mark.parametrize("software", ["", CAMERA])
@pytest.mark.parametrize("ending", [".jpg", ".tif"])
def test_a_run_over_its_folder_leaves_the_photo_and_knows_its_own(
    project: Path, ending: str, software: str
) -> None:
    project.write_text(project.read_text().replace(JPEG, f"#hugin_outputImageType {ending[1:]}\n"))
    photo = project.with_suffix(ending)
    before = photograph(photo, software)
    task = Task(project, {"settings": Settings()}, resume=True, remember=True)
    for result in ("made", "skipped"):
        record = perform(task, Deaf())
        assert (record.result, record.warnings) == (result, [])
        assert [file.name for file in record.files] == [f"IMG_1_abflow{ending}"]
    assert photo.read_bytes() == before


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        (Kind.FUSED_STACKS, "pano_fused"),
        (Kind.FUSED_LAYERS, "pano_blended_fused"),
        (Kind.HDR, "pano_hdr"),
    ],
)
def test_panoramas_of_several_exposures_have_other_names(
    make_project: ProjectMaker, kind: Kind, name: str
) -> None:
    """By whatever way names are found: what is made, shown, remembered, and compared with other projects'."""
    extra = asked(kind, extra="#hugin_outputImageTypeHDR tif\n")
    project = make_project(panorama=CANVAS, yaws=(0, 60), extra=extra)
    photo = project.with_name(f"{name}.tif")
    before = photograph(photo)
    expected = project.with_name(f"{name}_abflow.tif")
    plan = read_plan(project)
    assert asked_panoramas(plan) == [expected] and expected in results(plan, keep_layers=False)
    assert photo not in results(plan, keep_layers=False)
    assert stitch_project(project) == [expected] and photo.read_bytes() == before
    assert expected.name in show_project(project)[-2]


def test_stacks_that_would_replace_a_photo_are_refused(make_project: ProjectMaker) -> None:
    """Their names are numbers, so that none can have another."""
    project = make_project(panorama=CANVAS, yaws=(0, 60), extra=asked(Kind.STACKS))
    photo = project.with_name("pano_stack_ldr_0001.tif")
    before = photograph(photo)
    said = r"pano_stack_ldr_0001\.tif is a photo: .* rename it, or the project"
    for make in (stitch_project, show_project):
        with pytest.raises(OutputError, match=said):
            make(project)
    assert photo.read_bytes() == before

"""What somebody retouched is left by runs over many projects, what else is missing or stale is made."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from conftest import ProjectMaker, age, names_in, require_program
from shoots import Deaf, write_project

from hugin_abflow import cli, scratch
from hugin_abflow.asked import asked_panoramas
from hugin_abflow.batch import pool, run, task
from hugin_abflow.batch.record import Record
from hugin_abflow.batch.task import Task, perform
from hugin_abflow.encoding import ENDINGS
from hugin_abflow.exif import Metadata, embed, text
from hugin_abflow.images import write_image
from hugin_abflow.metadata import saved_by
from hugin_abflow.outputs import Kind
from hugin_abflow.project import read_plan
from hugin_abflow.settings import Settings
from hugin_abflow.shown import show_project
from hugin_abflow.stitch import stitch_project
from hugin_abflow.tifftags import MAIN

GIMP = "GIMP 2.10"
PICTURE = np.full((120, 120, 3), 7, np.uint8)
BOTH = "#hugin_outputLDRBlended true\n#hugin_outputLDRExposureLayersFused true\n"


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of panoramas as they are made, which happens quickly, in this process."""
    names: list[str] = []

    def stitch(
        path: Path, finished: Callable[[Path], None], leave: Collection[Path] = (), **options: Any
    ) -> None:
        for file in asked_panoramas(read_plan(path), **options):
            if file not in leave:
                save(file, "Hugin 2023.0.0")
                names.append(file.name)
                finished(file)

    monkeypatch.setattr(task, "stitch_project", stitch)
    monkeypatch.setattr("hugin_abflow.outputs.missing", lambda program: None)
    return names


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Of which a panorama and one that is fused are asked for."""
    file = write_project(tmp_path / "tiny.pto")
    file.write_text(file.read_text() + BOTH)
    return file


def save(file: Path, program: str | bool) -> bytes:
    tifffile.imwrite(file, PICTURE, software=program)
    return file.read_bytes()


def make(project: Path, resume: bool = True, **options: object) -> Record:
    return perform(Task(project, {"settings": Settings()} | options, resume, remember=True), Deaf())


@pytest.mark.parametrize("remembered", [False, True])
def test_only_what_was_retouched_is_left(project: Path, made: list[str], remembered: bool) -> None:
    """Whether it is known how it was made, or another program's name is all that tells."""
    fused = project.with_name("tiny_blended_fused.tif")
    if remembered:
        make(project)
    retouched = save(fused, GIMP)
    project.with_name("tiny.tif").unlink(missing_ok=True)
    made.clear()
    said = "was changed since it was made" if remembered else f"was saved by {GIMP}"
    record = make(project)
    assert record.result == "made" and made == ["tiny.tif"]
    assert [file.name for file in record.files] == ["tiny.tif"]
    assert record.warnings == [f"{fused} {said}; it is left as it is (--force makes it anew)"]
    again = make(project)
    assert again.result == "skipped" and again.warnings == record.warnings
    assert sorted(again.files) == sorted([project.with_name("tiny.tif"), fused])
    project.write_text(project.read_text() + "# a comment\n")
    for result in ("made", "skipped"):
        record = make(project)
        assert record.result == result and len(record.warnings) == 1
    assert made == ["tiny.tif"] * 2 and fused.read_bytes() == retouched
    fused.unlink()
    assert make(project).result == "made" and fused.is_file()
    assert make(project).result == "skipped" and make(project).warnings == []


def test_a_warning_tells_a_display_which_file_is_left(project: Path, made: list[str]) -> None:
    told: list[str] = []

    class Ear(Deaf):
        def message(self, level: int, text: str, left: str = "") -> None:
            told.append(left)

    file = project.with_name("tiny.tif")
    save(file, GIMP)
    perform(Task(project, {"settings": Settings()}, resume=True), Ear())
    assert str(file) in told


def test_what_it_was_before_is_stale_where_something_else_was_made_since(
    project: Path, made: list[str]
) -> None:
    """Somebody may take the retouched one for a copy of the one before."""
    make(project)
    fused = project.with_name("tiny_blended_fused.tif")
    before = fused.read_bytes()
    save(fused, GIMP)
    project.write_text(project.read_text() + "# a comment\n")
    make(project)
    fused.write_bytes(before)
    assert "tiny_blended_fused.tif was changed since it was made; it is left" in make(project).warnings[0]


@pytest.mark.parametrize("remembered", [False, True])
def test_what_is_asked_for_no_more_is_nobody_s_business(
    project: Path, made: list[str], remembered: bool
) -> None:
    """It was warned of for ever, with an advice that did nothing; and without it, all was made anew."""
    project.write_text(project.read_text().removesuffix(BOTH))
    panorama = project.with_name("tiny.tif")
    if remembered:
        make(project)
    retouched = save(panorama, GIMP)
    assert len(make(project).warnings) == 1
    project.write_text(project.read_text() + "#hugin_outputImageType jpg\n")
    made.clear()
    record = make(project)
    assert record.warnings == [] and [file.name for file in record.files] == made == ["tiny.jpg"]
    for there in (True, False):
        assert panorama.exists() == there and (not there or panorama.read_bytes() == retouched)
        record = make(project)
        assert record.result == "skipped" and record.warnings == [] and len(record.files) == 1
        panorama.unlink(missing_ok=True)


def test_stacks_that_were_retouched_are_left_as_long_as_they_are_checked(
    project: Path, made: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    stack, stitch = project.with_name("tiny_stack_ldr_0001.tif"), task.stitch_project

    def stitch_all(path: Path, finished: Callable[[Path], None], **options: Any) -> None:
        stitch(path, finished=finished, **options)
        save(stack, "Hugin 2023.0.0")
        finished(stack)

    monkeypatch.setattr(task, "stitch_project", stitch_all)
    checked = "#hugin_outputLDRStacks true\n"
    project.write_text(project.read_text() + checked)
    make(project)
    save(stack, GIMP)
    (warning,) = make(project).warnings
    assert f"{stack} was changed" in warning
    project.write_text(project.read_text().removesuffix(checked))
    assert make(project).warnings == []


@pytest.mark.parametrize("options", [{}, {"output": "out.tif"}, {"prefix": "tiny"}], ids=str)
def test_nothing_is_made_where_all_is_left(
    project: Path, made: list[str], monkeypatch: pytest.MonkeyPatch, options: dict[str, str]
) -> None:
    monkeypatch.chdir(project.parent)
    files = asked_panoramas(read_plan(project), **options)
    content = [save(file, GIMP) for file in files]
    record = make(project, **options)
    assert record.result == "skipped" and record.files == files and len(record.warnings) == len(files)
    assert made == [] and [file.read_bytes() for file in files] == content
    assert make(project, resume=False, **options).result == "made"
    assert made == [file.name for file in files] and make(project, **options).warnings == []


@pytest.mark.parametrize("program", ["hugin-abflow 0.1.0", "Hugin 2023.0.0.d88dc56ded0e", False])
def test_what_nobody_retouched_is_replaced(project: Path, made: list[str], program: str | bool) -> None:
    save(project.with_name("tiny.tif"), program)
    assert make(project).warnings == [] and "tiny.tif" in made


def test_what_lacks_its_program_is_not_more_to_be_made(
    project: Path, made: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run for nothing would end in an error."""
    monkeypatch.setattr("hugin_abflow.outputs.missing", {"enfuse": "install it"}.get)
    save(project.with_name("tiny.tif"), GIMP)
    record = make(project)
    assert record.result == "skipped" and record.files == [project.with_name("tiny.tif")] and made == []


def test_what_is_left_is_never_remembered_as_made(
    project: Path, made: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where a run finds that nothing is to be made: how many stacks there are is known no sooner."""
    stack, stitch = project.with_name("tiny_stack_ldr_0000.tif"), task.stitch_project

    def stitch_all(path: Path, finished: Callable[[Path], None], **options: Any) -> None:
        stitch(path, finished=finished, **options)
        if stack not in options["leave"]:
            save(stack, "Hugin 2023.0.0")
            finished(stack)

    monkeypatch.setattr(task, "stitch_project", stitch_all)
    text = project.read_text().removesuffix(BOTH)
    project.write_text(text + "#hugin_outputLDRBlended true\n#hugin_outputLDRStacks true\n")
    files = [project.with_name("tiny.tif"), stack]
    assert make(project).files == files
    for file in files:
        save(file, GIMP)
    for comment in ("", "# a comment\n", "# another\n"):
        project.write_text(project.read_text() + comment)
        for _ in range(2):
            record = make(project)
            assert record.result == "skipped" and record.files == files and len(record.warnings) == 2
    assert made == ["tiny.tif"]


def test_what_is_damaged_is_made(project: Path, made: list[str]) -> None:
    file = project.with_name("tiny.tif")
    content = save(file, GIMP)
    file.write_bytes(content[: len(content) - PICTURE.size // 2])
    assert saved_by(file) == GIMP
    assert make(project).warnings == [] and "tiny.tif" in made


def test_painted_layers_of_a_panorama_s_name_are_no_panorama(tmp_path: Path, made: list[str]) -> None:
    project = write_project(tmp_path / "tiny.pto")
    for number in range(2):
        project.with_name(f"tiny{number:04}.tif").unlink()
    page = np.zeros((125, 250, 4), np.uint8)
    with tifffile.TiffWriter(project.with_name("tiny.tif")) as pages:
        for _ in range(2):
            pages.write(page, photometric="rgb", extrasamples=["unassalpha"], software=GIMP, subfiletype=2)
    record = make(project)
    assert record.result == "made" and record.warnings == [] and made == ["tiny_abflow.tif"]


@pytest.mark.parametrize("ending", ["tif", "jpg", "png"])
def test_the_program_is_told_by_software(tmp_path: Path, ending: str) -> None:
    file = tmp_path / f"a.{ending}"
    write_image(file, np.ones((5, 7, 4), np.uint8))
    assert saved_by(file) == saved_by(tmp_path / "none") == saved_by(tmp_path) == ""
    embed(file, ENDINGS[file.suffix], Metadata({MAIN: {305: text(GIMP)}}, b""))
    assert saved_by(file) == GIMP
    embed(file, ENDINGS[file.suffix], Metadata({MAIN: {305: text("GIMP\nerror: \x1b[2J")}}, b""))
    assert saved_by(file) == "GIMP?error: ?[2J"


def test_temporary_files_of_killed_runs_are_looked_for_once(
    tmp_path: Path, made: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where all projects hold as well: the folder may hold much of others'."""
    temporary, swept = tmp_path / "temporary files", list[Path]()
    (temporary / f"hugin-abflow-{scratch._HOST}-0123456789ab").mkdir(parents=True)
    for name in ("a", "b"):
        write_project(tmp_path / "shoot" / f"{name}.pto")
    monkeypatch.setattr(run, "Pool", lambda jobs, *rest: pool.Alone(*rest))
    assert cli.main([str(tmp_path / "shoot")]) == 0
    made.clear()
    monkeypatch.setenv("TMPDIR", str(temporary))
    sweep = scratch.sweep
    monkeypatch.setattr(scratch, "sweep", lambda folder: [swept.append(folder), sweep(folder)])
    assert cli.main([str(tmp_path / "shoot")]) == 0
    assert made == names_in(temporary) == [] and swept.count(temporary) == 1


def test_dry_run_tells_what_becomes_of_what_is_there(
    project: Path, made: list[str], nona: str, capsys: pytest.CaptureFixture[str]
) -> None:
    save(project.with_name("tiny_blended_fused.tif"), GIMP)
    save(project.with_name("tiny.tif"), False)
    for photo in ("left.png", "right.png"):  # of which layers would be made to be fused
        project.with_name(photo).touch()
        age(project.with_name(photo), 60)
    for arguments, lines in (
        (
            [str(project.parent)],
            ["tiny.tif is there, and replaced", "tiny_blended_fused.tif is left as it is"],
        ),
        (
            [str(project)],
            ["tiny.tif is there, and replaced", "tiny_blended_fused.tif is there, and replaced"],
        ),
        (["-o", str(project.with_name("tiny.tif")), str(project)], ["tiny.tif is there, and replaced"]),
    ):
        assert cli.main(["--dry-run", *arguments]) == 0
        shown = capsys.readouterr()
        comments = [line for line in shown.out.splitlines() if "is there" in line or "is left" in line]
        assert [line.removesuffix(" (--force: made anew)") for line in comments] == [f"# {x}" for x in lines]
        assert ("enfuse" in shown.out) == (len(lines) == 2 and "left" not in lines[1])
        assert ("was saved by GIMP" in shown.err) == ("left" in lines[-1])
    assert made == []


@pytest.mark.skipif(os.name == "nt", reason="no such names there")
def test_a_line_break_in_a_name_runs_nothing(
    tmp_path: Path, made: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """What follows it was a command of the script that is shown."""
    project = write_project(tmp_path / "a\ntouch harm\n.pto")
    for left in (False, True):
        save(project.with_suffix(".tif"), GIMP if left else False)
        assert cli.main(["--dry-run", str(tmp_path)]) == 0
        shown = capsys.readouterr().out
        tokens = shlex.shlex(shown, posix=True, punctuation_chars=False)
        assert [line for line in shown.splitlines() if "left as it is" in line or "is there" in line]
        assert "touch" not in list(tokens) and "# a?touch harm?" in shown.replace(f"{tmp_path}/", "")


@pytest.mark.parametrize("scripted", [False, True])
def test_stacks_that_are_left_are_not_what_a_panorama_is_made_of(
    make_project: ProjectMaker, temporary: Path, scripted: bool
) -> None:
    """They are made in a temporary folder for it: those that are there may be of other photos."""
    for name in ("nona", "enfuse", "pano_trafo"):
        require_program(name)
    kinds = (Kind.PANORAMA, Kind.STACKS, Kind.FUSED_STACKS)
    lines = "".join(f"#hugin_output{kind} {str(kind in kinds).lower()}\n" for kind in Kind)
    project = make_project(panorama='f2 w200 h100 v360 n"TIFF_m"', yaws=(0, 60), extra=lines)
    photos = set(names_in(project.parent))
    leave = [project.with_name(name) for name in ("pano.tif", "pano_stack_ldr_0000.tif")]
    for file in leave:
        file.write_bytes(b"retouched")
    if scripted:
        script = "\n".join(show_project(project, leave=leave, options=["--no-flow"]))
        assert "pano_stack_ldr_0000.tif is left" in script and '"$layers"/pano_stack_ldr_0000.tif' in script
        assert "-o pano.tif" not in script
    else:
        files = stitch_project(project, Settings(flow=False), leave=leave)
        assert [file.name for file in files] == ["pano_stack_ldr_0001.tif", "pano_fused.tif"]
        assert tifffile.imread(project.with_name("pano_fused.tif")).any()
        new = {file.name for file in [*files, *leave]}
        assert set(names_in(project.parent)) == photos | new
    assert all(file.read_bytes() == b"retouched" for file in leave)
    rest = [*leave, *(project.with_name(name) for name in ("pano_fused.tif", "pano_stack_ldr_0001.tif"))]
    assert stitch_project(project, Settings(flow=False), leave=rest) == []

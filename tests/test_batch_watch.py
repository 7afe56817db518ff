"""Projects as they are saved: when they have settled, once for each time, until interrupted."""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from itertools import count
from pathlib import Path

import pytest
from conftest import names_in
from shoots import write_project

from hugin_abflow import cli
from hugin_abflow.batch import run
from hugin_abflow.batch.display import Display
from hugin_abflow.batch.record import Record
from hugin_abflow.batch.task import Task
from hugin_abflow.batch.watch import watch
from hugin_abflow.errors import ExitCode


def start(folder: Path, recursive: bool = False) -> Iterator[Path | None]:
    """Look at a folder, by a clock that goes on by a second from look to look."""
    return watch(folder, recursive, clock=partial(next, count(0.0)))


def after(saved: Iterator[Path | None], looks: int) -> list[str]:
    """The projects that come up in so many looks."""
    found = []
    while looks:
        project = next(saved)
        if project is None:
            looks -= 1
        else:
            found.append(getattr(project, "name", project))
    return found


def test_project_comes_up_once_it_has_settled(tmp_path: Path) -> None:
    write_project(tmp_path / "a.pto")
    saved = start(tmp_path)
    assert after(saved, 3) == []
    assert after(saved, 1) == ["a.pto"]
    assert after(saved, 9) == []
    (tmp_path / "a.pto").write_text((tmp_path / "a.pto").read_text() + "# saved again\n")
    write_project(tmp_path / "b.pto")
    assert after(saved, 3) == []
    assert after(saved, 1) == ["a.pto", "b.pto"]


def test_a_folder_that_is_gone_is_told_once_and_looked_for_again(tmp_path: Path) -> None:
    folder = tmp_path / "card"
    write_project(folder / "a.pto")
    saved = start(folder)
    assert after(saved, 4) == ["a.pto"]
    for _ in range(2):
        folder.rename(tmp_path / "gone")
        assert after(saved, 3) == [f"{folder} is no longer there, or closed to you; it is looked for again"]
        (tmp_path / "gone").rename(folder)
        assert after(saved, 5) == []


def test_warnings_are_shown_and_logged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    how = run.Run(log=tmp_path / "log")
    assert run.run(iter(["card is no longer there"]), how) == ExitCode.OK
    assert capsys.readouterr().err.endswith("hugin-abflow: warning: card is no longer there\n")
    assert (tmp_path / "log").read_text().endswith("WARNING card is no longer there\n")


def test_a_panorama_that_is_left_is_told_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Not each time its project is saved, until something else is to be told of it. All is logged."""
    task = Task(tmp_path / "a.pto")
    with (tmp_path / "log").open("w") as log, Display(quiet=False, verbose=False, log=log) as display:
        for result, text, shown in (
            ("skipped", "a.tif was changed", True),
            ("skipped", "a.tif was changed", False),
            ("skipped", "a.tif and a.pto were changed", True),
            ("made", "a.tif has a hole", True),
            ("made", "a.tif has a hole", True),
            ("skipped", "a.tif was changed", True),
            ("skipped", "a.tif was changed", False),
        ):
            display.began(task).message(logging.WARNING, text)
            display.ended(task, Record(task.project, result))
            assert (f"{text}\n" in capsys.readouterr().err) == shown
    assert (tmp_path / "log").read_text().count("a.tif was changed\n") == 4


def test_a_file_that_is_left_is_told_once_whatever_becomes_of_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """And whatever is the reason: what was changed was saved by GIMP once others are made."""
    task = Task(tmp_path / "a.pto")
    with Display(quiet=False, verbose=False, log=None) as display:
        for result, text, left, shown in (
            ("made", "a.tif was changed, and so was a.pto", "a.tif", True),
            ("made", "a.tif was saved by GIMP", "a.tif", False),
            ("failed", "a.tif was saved by GIMP", "a.tif", False),
            ("failed", "a.pto is cut off", "", True),
            ("skipped", "a.tif was saved by GIMP", "a.tif", False),
            ("made", "a_fused.tif was saved by GIMP", "a_fused.tif", True),
            ("made", "a.tif was saved by GIMP", "a.tif", True),
            ("made", "a.tif has a hole", "", True),
            ("made", "a.tif was saved by GIMP", "a.tif", True),
        ):
            display.began(task).message(logging.WARNING, text, left)
            display.ended(task, Record(task.project, result))
            assert (f"{text}\n" in capsys.readouterr().err) == shown, (result, text)


def test_project_that_is_still_being_saved_waits(tmp_path: Path) -> None:
    saved = start(tmp_path)
    for part in range(6):
        (tmp_path / "a.pto").write_text("#" * part)
        assert after(saved, 1) == []
    assert after(saved, 3) == ["a.pto"]


def test_photo_that_comes_later_brings_its_project_up_again(tmp_path: Path) -> None:
    write_project(tmp_path / "a.pto")
    saved = start(tmp_path)
    assert after(saved, 4) == ["a.pto"]
    (tmp_path / "left.png").write_bytes(b"half")
    assert after(saved, 2) == []
    (tmp_path / "left.png").write_bytes(b"all of it")
    assert after(saved, 3) == []
    assert after(saved, 1) == ["a.pto"]


def test_folders_of_folders_on_demand_and_lost_ones_are_no_error(tmp_path: Path) -> None:
    write_project(tmp_path / "day" / "a.pto")
    assert after(start(tmp_path), 5) == []
    saved = start(tmp_path, recursive=True)
    assert after(saved, 5) == ["a.pto"]
    (tmp_path / "day" / "a.pto").unlink()
    assert after(saved, 5) == []


def test_project_that_is_saved_again_waits_until_it_is_done() -> None:
    first, second, other = Task(Path("a.pto")), Task(Path("a.pto"), {"jpeg_quality": 1}), Task(Path("b.pto"))
    running: set[Path] = set()
    display = Display(quiet=True, verbose=False, log=None)
    tasks = run._announced(iter([first, second, other, None, None]), running, display)
    assert [next(tasks) for _ in range(3)] == [first, None, other]
    assert display.total == 2
    running.discard(Path("a.pto").absolute())
    assert list(tasks) == [second, None]


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["--watch", "gone"], "gone"),
        (["--watch", ".", "a.pto"], "leave out PROJECT"),
        (["--watch", ".", "-o", "a.tif"], "-o is for one project"),
    ],
)
def test_wrong_use(capsys: pytest.CaptureFixture[str], arguments: list[str], part: str) -> None:
    assert cli.main(arguments) == ExitCode.USAGE
    assert part in capsys.readouterr().err


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such signals")
def test_saved_projects_are_stitched_until_interrupted(tmp_path: Path) -> None:
    shoot, report = tmp_path / "shoot", tmp_path / "report.json"
    write_project(shoot / "a.pto")
    (shoot / "abflow.toml").write_text('seam = "of"')  # a mistake, which is put right later
    command = [sys.executable, "-m", "hugin_abflow", "--watch", shoot, "--jobs", "1", "--report", report]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert child.communicate(timeout=60)[1].startswith("hugin-abflow: error: ")
    (shoot / "abflow.toml").write_text('seam = "off"')
    child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert child.stdout is not None
    assert child.stdout.readline() == f"{shoot / 'a.tif'}\n"
    write_project(shoot / "b.pto")
    assert child.stdout.readline() == f"{shoot / 'b.tif'}\n"
    time.sleep(0.1)
    child.send_signal(signal.SIGINT)
    _, said = child.communicate(timeout=30)
    assert child.returncode == ExitCode.INTERRUPTED and "Traceback" not in said
    assert said.splitlines()[-1] == "hugin-abflow: interrupted" and "what went wrong" in said
    records = json.loads(report.read_text("utf-8"))["projects"]
    assert [(Path(r["project"]).name, r["result"], r["settings"]["seam"]) for r in records] == [
        ("a.pto", "made", False),
        ("b.pto", "made", False),
    ]
    assert [name for name in names_in(shoot) if name.startswith(".abflow-")] == []

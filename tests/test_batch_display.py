"""What is shown meanwhile: bars on a terminal, lines with the time elsewhere, and all of it in a log."""

from __future__ import annotations

import json
import logging
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from shoots import write_project
from terminals import on_terminal

from hugin_abflow import cli
from hugin_abflow.batch.display import Bars, Display, duration, phase_table
from hugin_abflow.batch.record import Record
from hugin_abflow.batch.task import Task
from hugin_abflow.errors import ExitCode, ImageReadError

STAMP = r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d "
LOG_STAMP = r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d[+-]\d\d:\d\d "


def working(path: Path, **keywords: Any) -> Path:
    """A `merge_project` with a message, a phase, and an error for b.pto."""
    logging.getLogger("hugin_abflow.merge").info("canvas [bold]")
    with keywords["progress"]("flow", 2) as advance:
        advance(1)
        advance(1)
    if path.stem == "b":
        raise ImageReadError(f"{path}: no picture")
    return path.with_suffix(".tif")


def timeless(text: str) -> str:
    """The same, as if nothing took any time."""
    return re.sub(r"\d+\.\d+ s", "0.0 s", text)


@pytest.mark.parametrize(("seconds", "text"), [(3.21, "3.2 s"), (64.6, "1:05"), (3725, "1:02:05")])
def test_times_are_for_people(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_lines_have_the_time_where_there_is_no_terminal(
    replace: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    replace(working)
    assert cli.main(["a.pto", "b.pto"]) == ExitCode.PARTIAL
    lines = capsys.readouterr().err.splitlines()[:3]
    assert [re.sub(STAMP, "", timeless(line), count=1) for line in lines] == [
        "[1/2] a.pto: made a.tif (0.0 s, 0 bytes)",
        "hugin-abflow: error: b.pto: no picture",
        "[2/2] b.pto: failed",
    ]
    assert all(re.match(STAMP, line) for line in lines)
    assert cli.main(["a.pto", "b.pto", "-v"]) == ExitCode.PARTIAL
    said = timeless(capsys.readouterr().err)
    for part in ("a.pto: canvas [bold]", "a.pto: flow ...", "b.pto: flow: 0.0 s", "a.pto: total "):
        assert re.search(f"^{STAMP}{re.escape(part)}", said, re.MULTILINE)


def test_log_has_everything_whatever_is_shown(
    replace: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    replace(working)
    log = tmp_path / "log.txt"
    log.write_text("earlier\n")
    assert cli.main(["a.pto", "b.pto", "-q", "--log", str(log)]) == ExitCode.PARTIAL
    assert capsys.readouterr().err.count("\n") == 1  # the error
    first, *lines = log.read_text("utf-8").splitlines()
    assert first == "earlier" and all(re.match(LOG_STAMP + "(INFO|ERROR) ", line) for line in lines)
    text = [re.sub(LOG_STAMP, "", timeless(line)).strip() for line in lines]
    assert text[:3] == [
        "INFO    a.pto: canvas [bold]",
        "INFO    a.pto: flow ...",
        "INFO    a.pto: flow: 0.0 s",
    ]
    assert "ERROR   b.pto: b.pto: no picture" in text and "INFO    [2/2] b.pto: failed" in text
    assert cli.main(["a.pto", "--log", str(log)]) == 0
    assert timeless(log.read_text("utf-8").splitlines()[-1]).endswith("a.pto: made a.tif (0.0 s, 0 bytes)")


def test_projects_of_one_name_are_told_by_their_folders(
    replace: Callable[..., None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """As in the table: from here, if that is shorter. All of the lines of two `pano.pto` were alike."""
    replace(working)
    monkeypatch.chdir(tmp_path)
    named = ["day1/pano.pto", str(tmp_path / "day2" / "pano.pto"), "/elsewhere/b.pto"]
    assert cli.main([*named, "-v", "--log", "log.txt"]) == ExitCode.PARTIAL
    said = timeless(capsys.readouterr().err)
    logged = timeless((tmp_path / "log.txt").read_text("utf-8"))
    for name in ("day1/pano.pto", "day2/pano.pto", "/elsewhere/b.pto"):
        for part in (f"{name}: flow ...", f"{name}: canvas [bold]", f"{name}: flow: 0.0 s"):
            assert re.search(f"^{STAMP}{re.escape(part)}$", said, re.MULTILINE)
            assert re.search(f"^{LOG_STAMP}INFO    {re.escape(part)}$", logged, re.MULTILINE)
    for text in (said, logged):
        assert "[2/3] day2/pano.pto: made pano.tif" in text
    assert "error: /elsewhere/b.pto: no picture" in said


def test_a_long_name_leaves_room_for_its_bar(tmp_path: Path) -> None:
    task = Task(tmp_path / ("a long way " * 9) / "pano.pto")
    with Bars(quiet=False, verbose=False, log=None) as bars:
        bars.began(task).phase_began("flow", 4)
        text = str(bars._bars.tasks[1].description)
    assert text.endswith("a long way /pano.pto: flow") and len(text) == len(": flow") + 40


def test_log_that_cannot_be_written_ends_the_run_before_it_starts(
    replace: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    replace(working)
    assert cli.main(["a.pto", "--log", str(tmp_path)]) == ExitCode.OUTPUT
    output = capsys.readouterr()
    assert "--log" in output.err and output.out == ""


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_log_on_a_full_disk_is_given_up(
    replace: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    replace(working)
    assert cli.main(["a.pto", "c.pto", "--log", "/dev/full"]) == 0
    assert capsys.readouterr().err.count("/dev/full cannot be written: No space left") == 1


@pytest.mark.skipif(os.name == "nt", reason="Windows has no pseudo-terminals")
@pytest.mark.parametrize(
    ("hang_up", "names", "code"),
    [(False, "a", 0), (False, "abc", 0), (True, "abc", ExitCode.INTERRUPTED)],
)
def test_terminal_that_is_closed_meanwhile(tmp_path: Path, hang_up: bool, names: str, code: int) -> None:
    """As when a connection is lost: with or without SIGHUP, of which a shell may keep its jobs."""
    projects = [write_project(tmp_path / f"{name}.pto") for name in names]
    report = tmp_path / "report.json"
    command = [sys.executable, "-m", "hugin_abflow", *projects, "--jobs", "1", "--report", report]
    ours, theirs = os.openpty()
    child = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=theirs, env={**os.environ, "TERM": "xterm"}
    )
    os.close(theirs)
    shown = b""
    while b"flow" not in shown:
        shown += os.read(ours, 4096)
    os.close(ours)
    if hang_up:
        child.send_signal(signal.SIGHUP)
    child.communicate(timeout=60)
    assert child.returncode == code
    written = json.loads(report.read_text("utf-8"))
    assert written["made"] == len(written["projects"]) and (written["made"] == len(names) or hang_up)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no signals for that")
def test_messages_that_nobody_reads_end_no_run(tmp_path: Path) -> None:
    """As behind `2>&1 | head -1`."""
    for name in "ab":
        write_project(tmp_path / f"{name}.pto")
    report = tmp_path / "report.json"
    command = [sys.executable, "-m", "hugin_abflow", tmp_path, "--report", report]
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    assert child.stderr is not None
    child.stderr.close()
    assert child.wait(60) == 0
    assert json.loads(report.read_text("utf-8"))["made"] == 2


@pytest.mark.skipif(os.name == "nt", reason="Windows has no pseudo-terminals")
def test_bars_on_a_terminal(tmp_path: Path) -> None:
    for name in "abc":
        write_project(tmp_path / f"{name}.pto")
    (tmp_path / "b0000.tif").write_bytes(b"no picture")
    command = [sys.executable, "-m", "hugin_abflow", tmp_path, "--jobs", "2"]
    code, out, shown = on_terminal(command, {"TERM": "xterm", "COLUMNS": "150"}, 60)
    text = re.sub(r"\x1b\[[\d;?]*\w", "", shown.decode())
    assert code == ExitCode.PARTIAL
    assert sorted(out.decode().split()) == [str(tmp_path / f"{name}.tif") for name in "ac"]
    assert "0 of 3 projects" in text and re.search(r"[12] of 3 projects, 1 failed", text)
    assert re.search(r"a\.pto: (read|flow|align|blend) ", text) and re.search(r"c\.pto: \w+ ", text)
    assert "b0000.tif cannot be read" in text and "what went wrong" in text
    assert not re.search(STAMP, text)


def test_rows_are_those_of_the_projects_that_run() -> None:
    tasks = [Task(Path(name)) for name in ("a.pto", "b.pto")]
    with Bars(quiet=False, verbose=False, log=None) as bars:
        bars.expect(2)
        voices = [bars.began(task) for task in tasks]
        voices[0].phase_began("flow", 4)
        voices[0].advanced("flow", 3)
        rows = {row.description: (row.completed, row.total) for row in bars._bars.tasks}
        assert rows == {"0 of 2 projects": (0, 2), "a.pto: flow": (3, 4), "b.pto": (0, None)}
        bars.began(tasks[0])  # another attempt
        bars.ended(tasks[0], Record(Path("a.pto"), message="x"))
        assert [row.description for row in bars._bars.tasks] == ["1 of 2 projects, 1 failed", "b.pto"]
        bars.ended(tasks[1], Record(Path("b.pto"), "made"))
    assert (bars.done, bars.failed, bars.total) == (2, 1, 2)


def test_quiet_terminal_has_no_bars(monkeypatch: pytest.MonkeyPatch) -> None:
    from hugin_abflow.batch import display

    monkeypatch.setattr(display, "on_terminal", lambda: True)
    assert type(display.choose_display(False, False, False, None)) is Bars
    assert type(display.choose_display(False, True, False, None)) is Display


def test_shares_of_phases_add_up() -> None:
    record = Record(Path("a.pto"), "made", seconds=10.0, phases={"read": 2.0, "flow": 5.5})
    rows = [" ".join(line.split()) for line in phase_table(record)[1:5]]
    assert rows == ["read 2.00 20%", "flow 5.50 55%", "other 2.50 25%", "total 10.00 100%"]


def test_phases_that_take_all_of_the_time_leave_nothing() -> None:
    """And no less: each of them is rounded."""
    record = Record(Path("a.pto"), "made", seconds=10.0, phases={"read": 4.0, "flow": 6.001})
    assert phase_table(record)[3].split() == ["other", "0.00", "0%"]

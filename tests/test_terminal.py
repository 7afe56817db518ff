"""Messages, progress, signals and pipes, through the command line. `merge_project` is replaced."""

from __future__ import annotations

import logging
import os
import re
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from terminals import on_terminal

from hugin_abflow import cli
from hugin_abflow.errors import ExitCode

Replace = Callable[[Callable[..., Path]], None]


# Messages and progress


def working(path: Path, **keywords: Any) -> Path:
    """A `merge_project` that logs and reports phases."""
    log = logging.getLogger("hugin_abflow.merge")
    log.info("device [red]PoCL[/red]")
    log.warning("layers are older than the project")
    for phase in ("Flow", "Blend"):
        with keywords["progress"](phase, 4) as advance:
            advance(1)
            advance(3)
    return path.with_suffix(".tif")


def test_warnings_are_shown_and_info_is_not(replace: Replace, capsys: pytest.CaptureFixture[str]) -> None:
    replace(working)
    for arguments in (["a.pto"], ["-q", "a.pto"]):
        assert cli.main(arguments) == 0
        assert capsys.readouterr().err == "hugin-abflow: warning: layers are older than the project\n"


def test_verbose_shows_info_and_phases(replace: Replace, capsys: pytest.CaptureFixture[str]) -> None:
    replace(working)
    assert cli.main(["-v", "a.pto"]) == 0
    output = capsys.readouterr()
    lines = [  # the process that runs all tests may hold more than a GiB
        re.sub(r"\d+\.\d+( GiB)?", lambda m: "0.0 MiB" if m[1] else "0.0", line)
        for line in output.err.splitlines()
    ]
    assert lines == [
        "device [red]PoCL[/red]",
        "hugin-abflow: warning: layers are older than the project",
        *("Flow ...", "Flow: 0.0 s", "Blend ...", "Blend: 0.0 s"),
        "phase     seconds  share",
        *lines[-5:-1],
        "peak memory: 0.0 MiB",
    ]
    assert output.out == "a.tif\n"


def test_verbose_ends_with_a_table_of_phases(replace: Replace, capsys: pytest.CaptureFixture[str]) -> None:
    """A phase that comes twice has one line; shares are of the whole."""

    def slow(path: Path, **keywords: Any) -> Path:
        for phase, seconds in (("read", 0.02), ("blend", 0.06), ("read", 0.02)):
            with keywords["progress"](phase, 1):
                time.sleep(seconds)
        return path

    replace(slow)
    assert cli.main(["-v", "a.pto"]) == 0
    table = capsys.readouterr().err.split("phase     seconds  share\n")[1].splitlines()[:-1]
    rows = [re.fullmatch(r"(\w+) +(\d+\.\d\d) +(\d+)%", line) for line in table]
    assert all(rows)
    names, seconds, shares = zip(*(row.groups() for row in rows if row), strict=True)
    assert names == ("read", "blend", "other", "total")
    assert float(seconds[0]) >= 0.04 and float(seconds[1]) >= 0.06
    assert sum(map(float, seconds[:3])) == pytest.approx(float(seconds[3]), abs=0.02)
    assert sum(map(int, shares[:3])) == pytest.approx(100, abs=2) and shares[3] == "100"


def test_messages_are_not_doubled_by_a_second_run(
    replace: Replace, capsys: pytest.CaptureFixture[str]
) -> None:
    replace(working)
    cli.main(["a.pto"])
    capsys.readouterr()
    cli.main(["a.pto"])
    assert capsys.readouterr().err.count("older") == 1
    assert logging.getLogger("hugin_abflow").handlers == []


def test_phases_of_several_projects_name_them(replace: Replace, capsys: pytest.CaptureFixture[str]) -> None:
    replace(working)
    assert cli.main(["-v", "a.pto", "b.pto"]) == 0
    assert "a.pto: Flow ..." in (text := capsys.readouterr().err) and "b.pto: Blend ..." in text


# A process of its own, with the function `merge` as its merge_project.
CHILD = """
import os, signal, sys, time
from pathlib import Path
from hugin_abflow import __main__
from hugin_abflow.batch import pool, run, task
{merge}
task.stitch_project = lambda path, finished, **keywords: finished(merge(path, **keywords))
run.Pool = lambda jobs, *rest: pool.Alone(*rest)
sys.exit(__main__.main())
"""


def child(merge: str, *arguments: str | bytes) -> list[str | bytes]:
    return [sys.executable, "-c", CHILD.format(merge=textwrap.dedent(merge)), *arguments]


PHASES = """
def merge(path, progress, **keywords):
    for phase in ("Flow", "Blend"):
        with progress(phase, 3) as advance:
            for step in range(3):
                time.sleep(0.06)
                advance(1)
    return path.with_suffix(".tif")
"""


@pytest.mark.skipif(os.name == "nt", reason="Windows has no pseudo-terminals")
@pytest.mark.parametrize(
    ("term", "quiet", "bars"), [("xterm", [], True), ("xterm", ["-q"], False), ("dumb", [], False)]
)
def test_bars_on_a_terminal_only_and_on_stderr(term: str, quiet: list[str], bars: bool) -> None:
    code, out, shown = on_terminal(child(PHASES, "a.pto", *quiet), {"TERM": term}, 30)
    assert code == 0
    assert out == (b"" if quiet else b"a.tif\n")
    assert (b"Flow" in shown and b"100%" in shown and b"Blend" in shown) if bars else shown == b""


# Interruptions and broken pipes


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such signals")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_signal_unwinds_and_ends_with_130(
    replace: Replace, capsys: pytest.CaptureFixture[str], request: pytest.FixtureRequest, name: str
) -> None:
    number = getattr(signal, name)
    # under nohup, or in a shell's background, the tests themselves run with signals ignored
    inherited = signal.signal(number, signal.default_int_handler if name == "SIGINT" else signal.SIG_DFL)
    request.addfinalizer(lambda: signal.signal(number, inherited))
    before = signal.getsignal(number)
    unwound, merged = [], []

    def merge(path: Path, **keywords: Any) -> Path:
        merged.append(path)
        try:
            os.kill(os.getpid(), number)
            time.sleep(30)  # cut short by the signal
        finally:
            os.kill(os.getpid(), number)  # an impatient user: the tidying up goes on
            unwound.append(True)
        return path

    replace(merge)
    assert cli.main(["a.pto", "b.pto"]) == ExitCode.INTERRUPTED
    output = capsys.readouterr()
    rest, last = filter(None, output.err.splitlines())
    assert rest.endswith("2 of 2 projects left; the same command goes on from here")
    assert last == "hugin-abflow: interrupted" and output.out == ""
    assert len(merged) == 1 and unwound == [True]
    assert signal.getsignal(number) is before


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGHUP")
def test_nohup_is_obeyed() -> None:
    merge = """
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    def merge(path, **keywords):
        os.kill(os.getpid(), signal.SIGHUP)
        return path.with_suffix(".tif")
    """
    done = subprocess.run(child(merge, "a.pto"), capture_output=True, timeout=30)
    assert (done.returncode, done.stdout, done.stderr) == (0, b"a.tif\n", b"")


SUCCESS = """
def merge(path, **keywords):
    return path.with_suffix(".tif")
"""


@pytest.mark.skipif(os.name == "nt", reason="pipes break differently on Windows")
@pytest.mark.parametrize("arguments", [["a.pto", "b.pto"], ["--help"], ["--list-devices"]])
def test_broken_pipe_is_no_traceback(arguments: list[str]) -> None:
    read, write = os.pipe()
    os.close(read)
    process = subprocess.Popen(child(SUCCESS, *arguments), stdout=write, stderr=subprocess.PIPE)
    os.close(write)
    _, messages = process.communicate(timeout=30)
    if arguments[0] == "a.pto":
        assert process.returncode == 0  # the panoramas are there
        assert b"Traceback" not in messages and b"Broken pipe" not in messages
    else:
        assert messages == b""


@pytest.mark.skipif(os.name == "nt", reason="names are Unicode on Windows")
def test_closed_stderr_does_not_lose_the_panorama() -> None:
    read, write = os.pipe()
    os.close(read)
    process = subprocess.Popen(child(PHASES, "-v", "a.pto"), stdout=subprocess.PIPE, stderr=write)
    os.close(write)
    out, _ = process.communicate(timeout=30)
    assert (process.returncode, out) == (0, b"a.tif\n")


FULL = Path("/dev/full")
UNPRINTED = b"error: stdout cannot be written: No space left on device; make room, or lead it elsewhere\n"


@pytest.mark.skipif(not FULL.exists(), reason="needs a device that is always full")
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_full_disk_under_stdout_is_told_when_all_is_done(unbuffered: str) -> None:
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    command = child(PHASES, "-v", "a.pto", "b.pto")
    with FULL.open("wb") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, env=environment, timeout=30)
    assert done.returncode == ExitCode.OUTPUT
    assert b"b.pto: Blend: " in done.stderr and done.stderr.endswith(b"\nhugin-abflow: " + UNPRINTED)


@pytest.mark.skipif(not FULL.exists(), reason="needs a device that is always full")
@pytest.mark.parametrize(
    ("function", "argument", "code", "message"),
    [
        ("main", "--list-devices", ExitCode.OUTPUT, b"hugin-abflow: " + UNPRINTED),
        ("main", "--help", ExitCode.OUTPUT, b"hugin-abflow: " + UNPRINTED),
        ("main", "--version", ExitCode.OUTPUT, b"hugin-abflow: " + UNPRINTED),
        ("enblend", "--help", ExitCode.FAILED, b"abflow-enblend: " + UNPRINTED),
    ],
)
def test_answer_that_cannot_be_printed(function: str, argument: str, code: int, message: bytes) -> None:
    call = f"from hugin_abflow import __main__; exit(__main__.{function}())"
    with FULL.open("wb") as full:
        command = [sys.executable, "-c", call, argument]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, timeout=30)
    assert (done.returncode, done.stderr) == (code, message)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has names that are not UTF-8")
def test_name_that_is_not_utf8_is_printed_in_its_bytes() -> None:
    done = subprocess.run(child(SUCCESS, b"caf\xe9.pto"), capture_output=True, timeout=30)
    assert (done.returncode, done.stdout, done.stderr) == (0, b"caf\xe9.tif\n", b"")


UNREADABLE = """
from hugin_abflow.errors import ImageReadError
def merge(path, **keywords):
    raise ImageReadError(f"{path}: not a TIFF")
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has names that are not UTF-8")
def test_error_about_a_name_that_is_not_utf8_can_be_printed() -> None:
    done = subprocess.run(child(UNREADABLE, b"caf\xe9.pto"), capture_output=True, timeout=30)
    assert done.returncode == ExitCode.IMAGE_READ
    assert done.stderr.startswith(b"hugin-abflow: error: caf") and done.stderr.endswith(b".pto: not a TIFF\n")

"""Other programs: what they answer, and what is told of those that do not."""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path

import pytest

from hugin_abflow.errors import ProgramFailedError, ProgramMissingError
from hugin_abflow.programs import run, started
from hugin_abflow.signals import interruptible

pytestmark = pytest.mark.skipif(os.name == "nt", reason="the programs are shell scripts")


@pytest.fixture
def enfuse(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A program that says what it is asked, twice."""
    program = tmp_path / "bin" / "enfuse"
    program.parent.mkdir()
    program.write_text("#!/bin/sh\nread -r asked\necho $asked $asked $LANGUAGE\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")
    return program


def test_answer_is_what_it_says(enfuse: Path, tmp_path: Path) -> None:
    assert run(["enfuse"], tmp_path, "a\n") == "a a en\n"


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("echo one; echo two >&2; exit 3", r"failed \(exit code 3\)\. Its last lines:\n  two$"),
        ("echo one; exit 1", r"failed \(exit code 1\)\. Its last lines:\n  one$"),
        ("kill -9 $$", r"was killed \(SIGKILL\)\. Its last lines:\n  \(nothing\)$"),
    ],
)
def test_failure_is_told(enfuse: Path, tmp_path: Path, script: str, said: str) -> None:
    enfuse.write_text(f"#!/bin/sh\n{script}\n")
    with pytest.raises(ProgramFailedError, match=f"enfuse {said}"):
        run(["enfuse"], tmp_path)


def test_what_cannot_be_run_is_told(enfuse: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(enfuse.parent))
    enfuse.chmod(0o644)
    with pytest.raises(ProgramFailedError, match=r"enfuse cannot be run: Permission denied; look at"):
        run(["enfuse"], tmp_path)
    enfuse.unlink()
    with pytest.raises(ProgramMissingError, match=r"enfuse is not in PATH; install .*apt install enfuse"):
        run(["enfuse"], tmp_path)


def test_it_does_not_outlive_an_exception(enfuse: Path) -> None:
    enfuse.write_text("#!/bin/sh\nexec sleep 60\n")
    with pytest.raises(KeyboardInterrupt), started(["enfuse"]) as program:
        raise KeyboardInterrupt
    assert program.returncode < 0


def test_it_does_not_outlive_a_signal_while_it_starts(enfuse: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """That comes when it runs already, and nobody has its name yet."""
    enfuse.write_text("#!/bin/sh\nexec sleep 60\n")
    begun: list[subprocess.Popen[str]] = []

    class Interrupted(subprocess.Popen[str]):
        def __init__(self, *arguments: object, **options: object) -> None:
            super().__init__(*arguments, **options)  # type: ignore[call-overload]
            begun.append(self)
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(subprocess, "Popen", Interrupted)
    with pytest.raises(KeyboardInterrupt), interruptible(), started(["enfuse"]):
        pass
    assert begun[0].returncode == -signal.SIGTERM

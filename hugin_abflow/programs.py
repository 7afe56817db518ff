"""Other programs: run to their end, or ended with us."""

from __future__ import annotations

import logging
import os
import shlex
import shutil
import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from hugin_abflow.errors import OutputError, ProgramFailedError, ProgramMissingError
from hugin_abflow.scratch import part_beside, put
from hugin_abflow.signals import deferred

_log = logging.getLogger(__name__)

LAST_LINES = 8  # of a program's output, in the message of a failure
_KILL_SECONDS = 5.0
# Where a program comes from on Debian and Ubuntu; elsewhere all of them come with Hugin.
_PACKAGES = {
    "enfuse": "enfuse", "hugin_hdrmerge": "hugin-tools", "nona": "hugin-tools", "pano_trafo": "hugin-tools",
}  # fmt: skip


def missing(program: str) -> str | None:
    """What to do about a program that is not installed; None if it is."""
    if shutil.which(program) is not None:
        return None
    return (
        f"{program} is not in PATH; install Hugin (Debian, Ubuntu: apt install {_PACKAGES[program]}; Fedora: "
        "dnf install hugin; macOS, Windows: put the folder of Hugin's programs into PATH)"
    )


@contextmanager
def started(
    command: Sequence[str],
    folder: Path | None = None,
    *,
    stdin: int = subprocess.PIPE,
    stderr: int = subprocess.PIPE,
) -> Iterator[subprocess.Popen[str]]:
    """A program that runs in a folder, and ends with the ``with`` block; it does not outlive an exception.

    stdin, stderr   as `subprocess` has them; stdout is a pipe.

    Raises `ProgramMissingError`, and `ProgramFailedError` if it cannot be run.
    """
    _log.info("%s", shlex.join(command))
    process: subprocess.Popen[str] | None = None
    try:
        with deferred():
            process = _open(command, folder, stdin, stderr)
        yield process
    except BaseException:
        if process:
            _stop(process)
        raise
    finally:
        if process:
            with process:  # closes the pipes and waits
                pass


def _open(command: Sequence[str], folder: Path | None, stdin: int, stderr: int) -> subprocess.Popen[str]:
    """Start a program, as `started` does."""
    try:
        return subprocess.Popen(
            command,
            cwd=folder,
            stdin=stdin,
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
            errors="replace",
            env={**os.environ, "LANGUAGE": "en"},  # what it says is read, and told
        )
    except FileNotFoundError:
        raise ProgramMissingError(missing(command[0]) or f"{command[0]} cannot be run") from None
    except OSError as error:
        raise ProgramFailedError(
            f"{command[0]} cannot be run: {error.strerror}; look at its file and at the folders in PATH"
        ) from None


def run(command: Sequence[str], folder: Path, asked: str = "") -> str:
    """Run a program in a folder; what it writes to stdout.

    asked   text for its stdin.

    It does not outlive an exception. Raises `ProgramMissingError`, `ProgramFailedError`.
    """
    with started(command, folder) as process:
        answer, messages = process.communicate(asked)
    if process.returncode:
        said = last_lines((messages or answer).splitlines())
        raise ProgramFailedError(f"{command[0]} {ending(process.returncode)}. Its last lines:\n  {said}")
    return answer


def ending(code: int) -> str:
    """How a program ended that did not succeed, in words."""
    return f"was killed ({signal.Signals(-code).name})" if code < 0 else f"failed (exit code {code})"


def last_lines(lines: Sequence[str]) -> str:
    """The end of what a program said, for the message of a failure."""
    said = [line.strip() for line in lines if line.strip()]
    return "\n  ".join(said[-LAST_LINES:]) or "(nothing)"


def _stop(process: subprocess.Popen[str]) -> None:
    """End a program, which may tidy up first."""
    process.terminate()
    try:
        process.wait(_KILL_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()


def move_whole(path: Path, final: Path, advice: str) -> None:
    """Move a program's result to its final name, where it appears whole or not at all. A file that it
    replaces leaves it its permissions.

    Raises `OutputError`, which ends with `advice`.
    """
    try:
        with suppress(OSError):  # another file system
            put(path, final)
            return
        with part_beside(final) as part:
            shutil.copyfile(path, part)
            put(part, final)
    except OSError as error:
        raise OutputError(f"{final} cannot be written: {error.strerror}; {advice}") from None

"""Other programs: run to their end, or ended with us."""

from __future__ import annotations

import logging
import os
import shlex
import shutil
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from hugin_abflow.errors import OutputError, ProgramFailedError, ProgramMissingError
from hugin_abflow.scratch import part_beside, put

_log = logging.getLogger(__name__)

_LAST_LINES = 8  # of a program's output, in the message of a failure
_KILL_SECONDS = 5.0
# Where a program comes from on Debian and Ubuntu; elsewhere all of them come with Hugin.
_PACKAGES = {"enfuse": "enfuse", "hugin_hdrmerge": "hugin-tools", "pano_trafo": "hugin-tools"}


def missing(program: str) -> str | None:
    """What to do about a program that is not installed; None if it is."""
    if shutil.which(program) is not None:
        return None
    return (
        f"{program} is not in PATH; install Hugin (Debian, Ubuntu: apt install {_PACKAGES[program]}; macOS, "
        "Windows: put the folder of Hugin's programs into PATH)"
    )


def run(command: Sequence[str], folder: Path, asked: str = "") -> str:
    """Run a program in a folder; what it writes to stdout.

    asked   text for its stdin.

    It does not outlive an exception. Raises `ProgramMissingError`, `ProgramFailedError`.
    """
    _log.info("%s", shlex.join(command))
    try:
        process = subprocess.Popen(
            command,
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            env={**os.environ, "LANGUAGE": "en"},
        )
    except FileNotFoundError:
        raise ProgramMissingError(missing(command[0]) or f"{command[0]} cannot be run") from None
    except OSError as error:
        raise ProgramFailedError(f"{command[0]} cannot be run: {error.strerror}") from None
    with process:  # closes the pipes and waits
        try:
            answer, messages = process.communicate(asked)
        except BaseException:
            stop(process)
            raise
    if process.returncode:
        lines = [line.strip() for line in (messages or answer).splitlines() if line.strip()]
        said = "\n  ".join(lines[-_LAST_LINES:]) or "(nothing)"
        raise ProgramFailedError(
            f"{command[0]} failed (exit code {process.returncode}). Its last lines:\n  {said}"
        )
    return answer


def stop(process: subprocess.Popen[str]) -> None:
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

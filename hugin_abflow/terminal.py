"""The terminal: messages, results, and progress bars.

Only results go to stdout; messages and progress go to stderr.
"""

from __future__ import annotations

import logging
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, cast

import click

from hugin_abflow.errors import AbflowError, ExitCode, OutputError
from hugin_abflow.metadata import PROGRAM
from hugin_abflow.progress import Advance, Progress, silent

if TYPE_CHECKING:
    from rich.console import Console


def say(text: str) -> None:
    """Print to stderr; if nobody reads that any more, the panorama is still worth finishing."""
    with suppress(OSError):
        click.echo(text, err=True)


def complain(text: str, program: str = PROGRAM) -> None:
    """Print an error of one of our programs to stderr."""
    say(f"{program}: error: {text}")


def print_path(path: Path) -> None:
    """Print a result to stdout."""
    print_result(os.fspath(path))


def print_result(text: str) -> None:
    """Print text to stdout; names of files in it in their own bytes whatever the locale.

    That nobody reads it any more (`| head -1`) is no error. Raises `OutputError` where it cannot be written.
    """
    try:
        with suppress(BrokenPipeError):
            click.echo(text if os.name == "nt" else os.fsencode(text))
    except OSError as error:
        raise OutputError(
            f"stdout cannot be written: {error.strerror}; make room, or lead it elsewhere"
        ) from error


@contextmanager
def catching(task: str, verbose: bool, program: str = PROGRAM) -> Iterator[list[ExitCode]]:
    """Report an error in a program's task instead of ending the run; gives the list that its code goes to."""
    failures: list[ExitCode] = []
    try:
        yield failures
    except Exception as error:
        if verbose and is_bug(error):
            say(traceback.format_exc().rstrip())
        message, code = explain(task, error)
        complain(message, program)
        failures.append(code)


def is_bug(error: Exception) -> bool:
    """Whether an error is nobody's fault but ours."""
    return not isinstance(error, AbflowError | MemoryError | OSError)


def system_error(error: OSError) -> str:
    """What the system says of an error; if the current folder is gone, so that names mean nothing, that."""
    try:
        os.getcwd()  # noqa: PTH109 - Path's is the same
    except FileNotFoundError:
        return "the current folder is no longer there; go to one that is"
    return str(error)


def explain(task: str, error: Exception) -> tuple[str, ExitCode]:
    """What went wrong in a task and what to do about it, and the exit code for it."""
    if isinstance(error, AbflowError):
        return str(error), error.exit_code
    if isinstance(error, MemoryError):
        remedy = "close other programs, or make the panorama smaller in Hugin"
        return f"{task}: not enough memory; {remedy}", ExitCode.FAILED
    if isinstance(error, OSError):
        return f"{task}: {system_error(error)}", ExitCode.FAILED
    return (
        f"{task}: {type(error).__name__}: {error}\n"
        f"This is a bug in {PROGRAM}; please report it with what the same command prints with -v."
    ), ExitCode.FAILED


def print_message(record: logging.LogRecord, program: str = PROGRAM) -> None:
    """Print a log message to stderr."""
    say(label(record.levelno, program) + record.getMessage())


def label(level: int, program: str = PROGRAM) -> str:
    """What stands before a message of `logging`'s level."""
    return f"{program}: {logging.getLevelName(level).lower()}: " if level >= logging.WARNING else ""


class _Handler(logging.Handler):
    def __init__(self, show: Callable[[logging.LogRecord], None]) -> None:
        super().__init__()
        self._show = show

    def emit(self, record: logging.LogRecord) -> None:
        self._show(record)


@contextmanager
def messages(
    level: int, always: str | None = None, show: Callable[[logging.LogRecord], None] = print_message
) -> Iterator[None]:
    """Show the package's log messages from `level` upwards; of the logger `always`, all."""
    levels = {logging.getLogger("hugin_abflow"): level}
    if always:
        levels[logging.getLogger(always)] = logging.INFO
    before = {logger: logger.level for logger in levels}
    handler = _Handler(show)
    logging.getLogger("hugin_abflow").addHandler(handler)
    for logger, its_level in levels.items():
        logger.setLevel(its_level)
    try:
        yield
    finally:
        logging.getLogger("hugin_abflow").removeHandler(handler)
        for logger, its_level in before.items():
            logger.setLevel(its_level)


def on_terminal() -> bool:
    """Whether stderr is a terminal on which bars can be drawn."""
    return sys.stderr is not None and sys.stderr.isatty() and os.environ.get("TERM") != "dumb"


class _Enduring:
    """A stream to which writing never fails: who read it may be gone."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        with suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with suppress(OSError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def console() -> Console:
    """Rich's console on stderr. By itself it ends the run where nobody reads that any more."""
    from rich.console import Console  # takes a while to load, and is needed seldom

    return Console(file=cast(TextIO, _Enduring(sys.stderr)))


def display_progress(heading: str, quiet: bool, verbose: bool) -> AbstractContextManager[Progress]:
    """How phases are shown: bars on a terminal, lines with -v elsewhere, else not at all."""
    if quiet:
        return _as_given(silent)
    if on_terminal():
        return _bars(heading)
    return _as_given(partial(_lines, heading) if verbose else silent)


@contextmanager
def _as_given(progress: Progress) -> Iterator[Progress]:
    yield progress


@contextmanager
def _lines(heading: str, phase: str, total: int) -> Iterator[Advance]:
    """A phase as two lines."""
    started = time.monotonic()
    say(f"{heading}{phase} ...")
    yield lambda units: None
    say(f"{heading}{phase}: {time.monotonic() - started:.2f} s")


@contextmanager
def _bars(heading: str) -> Iterator[Progress]:
    """A bar for each phase on the terminal; they go when the project is done."""
    from rich import progress as rich_progress  # takes a while to load, and is needed here only

    columns = (
        rich_progress.TextColumn("{task.description}", markup=False),
        rich_progress.BarColumn(),
        rich_progress.TaskProgressColumn(),
        rich_progress.TimeElapsedColumn(),
    )
    # stdout is for results: it must not be led through the display, which writes to stderr.
    with rich_progress.Progress(
        *columns, console=console(), transient=True, redirect_stdout=False
    ) as display:

        @contextmanager
        def phase_bar(phase: str, total: int) -> Iterator[Advance]:
            task = display.add_task(heading + phase, total=total)
            yield lambda units: display.advance(task, units)
            display.update(task, completed=total)
            display.stop_task(task)

        yield phase_bar

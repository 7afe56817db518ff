"""How a run is shown while it goes on: bars on a terminal, lines elsewhere, and everything in a log file."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, TextIO

from hugin_abflow.batch.record import Record
from hugin_abflow.batch.task import Task
from hugin_abflow.errors import OutputError
from hugin_abflow.memory import size
from hugin_abflow.progress import Advance
from hugin_abflow.scratch import open_to_add
from hugin_abflow.terminal import console, display_progress, label, on_terminal, say

_WIDEST = 40  # characters of a project's name before a bar


def duration(seconds: float) -> str:
    """A time for people: ``3.2 s``, ``4:05``, ``1:02:03``."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def name_of(project: Path) -> str:
    """What a project is called from here, with its folder: others may have its name."""
    shown = project
    with suppress(ValueError, OSError):  # it lies elsewhere, or the current folder is gone
        shown = project.relative_to(Path.cwd()) if project.is_absolute() else project
    return str(shown).encode("utf-8", "replace").decode("utf-8")


def outcome(record: Record) -> str:
    """What became of a project, in a line."""
    if record.result == "failed":
        return "failed"
    names = ", ".join(file.name for file in record.files)
    if record.result == "skipped":
        return f"{names} left as it is"
    return f"made {names} ({duration(record.seconds)}, {size(record.bytes)})"


def phase_table(record: Record) -> list[str]:
    """Seconds and shares of the phases, as lines."""
    whole = max(record.seconds, 1e-9)
    other = max(0.0, whole - sum(record.phases.values()))  # each of them is rounded
    rows = {**record.phases, "other": other, "total": whole}
    shares = [f"{phase:<9}{seconds:8.2f}{seconds / whole:6.0%}" for phase, seconds in rows.items()]
    peak = [] if record.memory is None else [f"peak memory: {size(record.memory)}"]
    return ["phase     seconds  share", *shares, *peak]


@contextmanager
def open_log(path: Path | None) -> Iterator[TextIO | None]:
    """The log file, to the end of which lines are added. Raises `OutputError` if it cannot be written."""
    if path is None:
        yield None
        return
    try:
        file = open_to_add(path, buffering=1)
    except OSError as error:
        raise OutputError(
            f"{path} cannot be written: {error.strerror}; name another file with --log"
        ) from None
    try:
        yield file
    finally:
        with suppress(OSError):  # a full disk, of which `write_log` told
            file.close()


class Display:
    """Lines with time stamps on stderr. A context manager; also where no terminal is.

    quiet       warnings and errors only. verbose: what is done as well.
    log         gets all of it, whatever `quiet` and `verbose` say.
    """

    def __init__(self, quiet: bool, verbose: bool, log: TextIO | None) -> None:
        self.quiet, self.verbose, self._log = quiet, verbose, log
        self.total = self.done = self.failed = 0
        # warnings of each project that are no news, and those so far of what is going on: their texts, but of
        # outputs that are left as they are the files, since the reason may be another each time
        self._known: dict[Path, set[str]] = {}
        self._said: dict[Path, dict[str, bool]] = {}  # and whether it is such a file

    def __enter__(self) -> Display:
        return self

    def __exit__(self, *reason: object) -> None:
        return

    def expect(self, count: int) -> None:
        """So many projects more are to come."""
        self.total += count

    def began(self, task: Task) -> Voice:
        """A task begins."""
        self._said[task.project] = {}
        return Voice(self, task)

    def ended(self, task: Task, record: Record) -> None:
        """A task is done."""
        self.done += 1
        if record.result == "failed":
            self.failed += 1
        # a watched folder's project is looked at each time it is saved: no warning is news where nothing is
        # made, and where other outputs are, none of one that is left
        said = self._said.pop(task.project, {})
        left = {what for what, is_left in said.items() if is_left}
        if record.result == "failed":  # perhaps before it was looked at what is left
            left |= self._known.get(task.project, set())
        self._known[task.project] = set(said) if record.result == "skipped" else left
        self._tell_end(task, record)
        line = f"[{self.done}/{self.total}] {name_of(task.project)}: {outcome(record)}"
        self.write_log(logging.INFO, line)
        if not self.quiet:
            self._show(line)

    def _tell_end(self, task: Task, record: Record) -> None:
        """What went wrong, or where the time went."""
        if record.result == "failed":
            self.tell(task, logging.ERROR, record.message)
        elif record.result == "made":
            for line in phase_table(record):
                self.tell(task, logging.INFO, line)

    def tell(self, task: Task, level: int, text: str, left: str = "") -> None:
        """A message about a task. Warnings about what was left as it is (the file `left`, or all that there
        is) and still is are not shown again.
        """
        self.write_log(level, f"{name_of(task.project)}: {text}")
        if level == logging.WARNING:
            self._said.setdefault(task.project, {})[left or text] = bool(left)
            if (left or text) in self._known.get(task.project, ()):
                return
        if level >= logging.WARNING or (self.verbose and not self.quiet):
            self._show(f"{label(level)}{self._heading(task, text)}{text}")

    def note(self, text: str) -> None:
        """A message about no task."""
        self.write_log(logging.INFO, text)
        if not self.quiet:
            self._show(text)

    def warn(self, text: str) -> None:
        """A warning about no task."""
        self.write_log(logging.WARNING, text)
        self._show(label(logging.WARNING) + text)

    def phase_began(self, task: Task, name: str, total: int) -> None:
        """A phase of a task begins."""
        self.tell(task, logging.INFO, f"{name} ...")

    def advanced(self, task: Task, name: str, units: int) -> None:
        """So many more units of a phase are done."""

    def phase_ended(self, task: Task, name: str, seconds: float) -> None:
        """A phase of a task is done."""
        self.tell(task, logging.INFO, f"{name}: {seconds:.2f} s")

    def write_log(self, level: int, text: str) -> None:
        """A line of the log file."""
        if self._log is not None:
            stamp = datetime.now().astimezone().isoformat(timespec="seconds")
            try:
                self._log.write(f"{stamp} {logging.getLevelName(level):7} {text}\n")
            except OSError as error:  # a full disk: the panoramas are worth more
                name, self._log = self._log.name, None
                self._show(
                    f"{label(logging.WARNING)}{name} cannot be written: {error.strerror}; going on without"
                )

    def _heading(self, task: Task, text: str) -> str:
        return "" if name_of(task.project) in text else f"{name_of(task.project)}: "

    def _show(self, text: str) -> None:
        say(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {text}")


class Bars(Display):
    """A line for each running project and one for all of them, with the remaining time, on a terminal."""

    def __enter__(self) -> Bars:
        from rich import progress  # takes a while to load, and is needed here only

        self._bars = progress.Progress(
            progress.TextColumn("{task.description}", markup=False),
            progress.BarColumn(),
            progress.TaskProgressColumn(),
            progress.TimeElapsedColumn(),
            progress.TimeRemainingColumn(),
            # stdout is for results: it must not be led through the display, which writes to stderr
            console=console(), transient=True, redirect_stdout=False,
            speed_estimate_period=24 * 3600,
        )  # fmt: skip
        self._bars.start()
        self._all = self._bars.add_task("", total=0)
        self._rows: dict[Path, Any] = {}
        return self

    def __exit__(self, *reason: object) -> None:
        self._bars.stop()

    def expect(self, count: int) -> None:
        """So many projects more are to come."""
        super().expect(count)
        self._update()

    def began(self, task: Task) -> Voice:
        """A task begins."""
        if task.project not in self._rows:
            self._rows[task.project] = self._bars.add_task(self._row(task), total=None)
        return super().began(task)

    def ended(self, task: Task, record: Record) -> None:
        """A task is done."""
        self._bars.remove_task(self._rows.pop(task.project))
        super().ended(task, record)
        self._update()

    def phase_began(self, task: Task, name: str, total: int) -> None:
        """A phase of a task begins."""
        self.write_log(logging.INFO, f"{name_of(task.project)}: {name} ...")
        self._bars.reset(self._rows[task.project], total=total, description=f"{self._row(task)}: {name}")

    def advanced(self, task: Task, name: str, units: int) -> None:
        """So many more units of a phase are done."""
        self._bars.advance(self._rows[task.project], units)

    def phase_ended(self, task: Task, name: str, seconds: float) -> None:
        """A phase of a task is done."""
        self.write_log(logging.INFO, f"{name_of(task.project)}: {name}: {seconds:.2f} s")

    def _row(self, task: Task) -> str:
        """What stands before a bar, for which a long name would leave no room: the end of it."""
        name = name_of(task.project)
        return name if len(name) <= _WIDEST else f"\N{HORIZONTAL ELLIPSIS}{name[1 - _WIDEST :]}"

    def _update(self) -> None:
        failed = f", {self.failed} failed" if self.failed else ""
        self._bars.update(
            self._all, total=self.total, completed=self.done,
            description=f"{self.done} of {self.total} projects{failed}",
        )  # fmt: skip

    def _show(self, text: str) -> None:
        say(text)


class Lone(Display):
    """One project, as if there were no others: a bar for each phase, and messages that do not name it."""

    def __enter__(self) -> Lone:
        self._stack = ExitStack()
        self._progress = self._stack.enter_context(display_progress("", self.quiet, self.verbose))
        self._phases: dict[str, tuple[ExitStack, Advance]] = {}
        return self

    def __exit__(self, *reason: object) -> None:
        self._stack.close()

    def ended(self, task: Task, record: Record) -> None:
        """The task is done."""
        self._tell_end(task, record)
        self.write_log(logging.INFO, f"{name_of(task.project)}: {outcome(record)}")

    def phase_began(self, task: Task, name: str, total: int) -> None:
        """A phase begins."""
        self.write_log(logging.INFO, f"{name_of(task.project)}: {name} ...")
        phase = ExitStack()
        self._phases[name] = phase, phase.enter_context(self._progress(name, total))

    def advanced(self, task: Task, name: str, units: int) -> None:
        """So many more units of a phase are done."""
        self._phases[name][1](units)

    def phase_ended(self, task: Task, name: str, seconds: float) -> None:
        """A phase is done."""
        self.write_log(logging.INFO, f"{name_of(task.project)}: {name}: {seconds:.2f} s")
        self._phases.pop(name)[0].close()

    def _heading(self, task: Task, text: str) -> str:
        return ""

    def _show(self, text: str) -> None:
        say(text)


@dataclass(frozen=True)
class Voice:
    """Tells a display how one task goes on: a `task.Listener`."""

    display: Display
    task: Task

    def phase_began(self, name: str, total: int) -> None:
        """A phase of `total` units begins."""
        self.display.phase_began(self.task, name, total)

    def advanced(self, name: str, units: int) -> None:
        """So many more units of a phase are done."""
        self.display.advanced(self.task, name, units)

    def phase_ended(self, name: str, seconds: float) -> None:
        """A phase is done."""
        self.display.phase_ended(self.task, name, seconds)

    def message(self, level: int, text: str, left: str = "") -> None:
        """A message; left: the output that it says is left as it is."""
        self.display.tell(self.task, level, text, left)


def choose_display(lone: bool, quiet: bool, verbose: bool, log: TextIO | None) -> Display:
    """The display for one project, or for many; bars where stderr is a terminal."""
    if lone:
        return Lone(quiet, verbose, log)
    kind = Bars if on_terminal() and not quiet else Display
    return kind(quiet, verbose, log)

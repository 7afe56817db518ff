"""One project, stitched in this process: from a task to a record."""

from __future__ import annotations

import logging
import platform
import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any, Protocol

from hugin_abflow import memory, nona, scratch, trace
from hugin_abflow.batch.record import Record
from hugin_abflow.batch.state import State
from hugin_abflow.errors import AbflowError
from hugin_abflow.kept import kept_device
from hugin_abflow.metadata import version
from hugin_abflow.opencl import Device
from hugin_abflow.progress import Advance
from hugin_abflow.settings import Settings
from hugin_abflow.stitch import stitch_project
from hugin_abflow.terminal import explain, is_bug, messages

_log = logging.getLogger(__name__)

# Phases that keep the device busy, up to the last; before them layers are remapped and decoded. "merge" is
# that of --merge sequential: all of its merges but the last, whose own phases it does not tell.
_COMPUTING = ("merge", "flow", "align", "blend")


@dataclass(frozen=True)
class Task:
    """One project and how it is stitched; travels between processes.

    project     the file, as the user named it.
    options     keywords of `stitch_project`.
    resume      leave what was made before as it is if it still holds. remember: so that this can be told.
    """

    project: Path
    options: Mapping[str, Any] = field(default_factory=dict)
    resume: bool = False
    remember: bool = False


class Turn(Protocol):
    """The right to compute on a device that several processes share; calls that change nothing are fine."""

    def take(self) -> None:
        """Wait for it."""

    def give_back(self) -> None:
        """Let the next one have it."""


class Listener(Protocol):
    """Who is told how a task goes on. Called by several threads, one at a time."""

    def phase_began(self, name: str, total: int) -> None:
        """A phase of `total` units begins."""

    def advanced(self, name: str, units: int) -> None:
        """So many more units of a phase are done."""

    def phase_ended(self, name: str, seconds: float) -> None:
        """A phase is done."""

    def message(self, level: int, text: str, left: str = "") -> None:
        """A message of `logging`'s level; left: the output that it says is left as it is."""


def perform(task: Task, listener: Listener, level: int = logging.WARNING, turn: Turn | None = None) -> Record:
    """Stitch the project of a task. Errors end in the record; only interruptions are raised.

    level       of the messages that `listener` gets; an error is no message but in the record.
    turn        is waited for before the project computes on a graphics card.
    """
    record = Record(task.project.absolute(), started=datetime.now(UTC).isoformat(timespec="seconds"))
    record.settings = settings_of(task)
    began = time.monotonic()
    memory.reset_peak()

    def show(said: logging.LogRecord) -> None:
        if said.levelno >= logging.WARNING:
            record.warnings.append(said.getMessage())
        if hasattr(said, "overlap"):
            record.overlaps.append(said.overlap)
        listener.message(said.levelno, said.getMessage(), getattr(said, "left", ""))

    with messages(level, show=show):
        try:
            state = _state(task, record)
            if state and task.resume and state.restore(record):
                # what makes something does so by itself
                for folder in {state.file.parent, *(file.parent for file in record.files)}:
                    scratch.sweep(folder)
            else:
                _stitch(task, record, listener, turn, state)
                if state and task.remember:
                    state.save(record)
        except Exception as error:
            record.result = "failed"
            if is_bug(error):
                _log.info("%s", traceback.format_exc().rstrip())
            record.message, record.exit_code = explain(str(task.project), error)
        finally:
            if turn:
                turn.give_back()
    record.seconds = round(time.monotonic() - began, 3)
    record.memory = memory.peak()
    return record


def left_alone(task: Task) -> tuple[bool, list[Path]]:
    """Whether `perform` makes nothing, and the outputs that it leaves as they are."""
    record = Record(task.project.absolute())
    state = _state(task, record) if task.resume else None
    if state is None:
        return False, []
    return (True, record.files) if state.restore(record) else (False, state.left)


def _state(task: Task, record: Record) -> State | None:
    """What is remembered of the project; tells `record` of the inputs. None where one of them cannot be read,
    of which `stitch_project` tells.
    """
    with suppress(AbflowError, OSError):
        state = State(task.project, task.options, settings_of(task))
        record.inputs = _sizes(state.inputs())
        if task.resume or task.remember:
            state.begin()
        return state
    return None


def _stitch(task: Task, record: Record, listener: Listener, turn: Turn | None, state: State | None) -> None:
    """Fill in the record while the panorama is made."""
    record.versions = _versions()
    leave = state.left if state else []
    shared = False  # a processor serves several at a time; a graphics card's memory may not hold two

    def open_device(wanted: str | None, threads: int) -> Device:
        nonlocal shared
        device = kept_device(wanted, threads)
        record.device, shared = device.name, device.kind != "CPU"
        return device

    @contextmanager
    def progress(phase: str, total: int) -> Iterator[Advance]:
        if turn and shared and phase in _COMPUTING:
            turn.take()
        began = time.monotonic()
        listener.phase_began(phase, total)
        yield lambda units: listener.advanced(phase, units)
        seconds = time.monotonic() - began
        record.phases[phase] = round(record.phases.get(phase, 0.0) + seconds, 3)
        listener.phase_ended(phase, seconds)
        if turn and phase == _COMPUTING[-1]:
            turn.give_back()  # what is left is to encode

    made: list[Path] = []

    def finished(file: Path) -> None:
        made.append(file)
        if state:
            state.note(file)

    try:
        stitch_project(
            task.project, **task.options,
            progress=trace.phases(progress), open_device=open_device, finished=finished, leave=leave,
        )  # fmt: skip
        record.result = "made" if made or not leave else "skipped"
    finally:
        # what comes before one that fails is there, too
        record.outputs = _sizes(leave if record.result == "skipped" else made)


def settings_of(task: Task) -> dict[str, Any]:
    """All options of a task as plain values for JSON, those of the engine among them."""
    values: dict[str, Any] = {}
    for name, value in task.options.items():
        values |= asdict(value) if isinstance(value, Settings) else {name: value}
    return {name: _plain(value) for name, value in sorted(values.items())}


def _plain(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def _sizes(files: list[Path]) -> list[dict[str, Any]]:
    """Files, and how large they are."""
    return [{"file": str(file), "bytes": file.stat().st_size if file.is_file() else 0} for file in files]


@cache
def _versions() -> dict[str, str]:
    return {
        "hugin-abflow": version(),
        "nona": nona.probe() or "not installed",
        "python": platform.python_version(),
        "system": platform.platform(),
    }

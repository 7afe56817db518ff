"""Where the time goes: phases, kernels, input and output, as Chrome trace-event JSON.

Trace viewers (chrome://tracing, Perfetto, speedscope) open the file. Nothing is recorded, and next to no
time is lost, outside `recording`. A process has one recorder, which all its threads write into.
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

from hugin_abflow.errors import OutputError
from hugin_abflow.progress import Advance, Progress
from hugin_abflow.scratch import is_special, open_to_add

# What is told of: steps of a run; work on the device; files; copies between host and device.
PHASE, KERNEL, FILE, TRANSFER = "phase", "kernel", "file", "transfer"

Event = dict[str, Any]

_recorder: _Recorder | None = None


class _Recorder:
    """Events of one run; times are in seconds of `time.perf_counter`."""

    def __init__(self) -> None:
        self._events: list[Event] = []
        self._lanes: dict[str, int] = {}
        self._lock = threading.Lock()

    def add(self, name: str, kind: str, start: float, end: float, lane: str, **details: object) -> None:
        with self._lock:
            number = self._lanes.setdefault(lane, len(self._lanes) + 1)
            self._events.append(
                {
                    "name": name, "cat": kind, "ph": "X", "ts": start * 1e6, "dur": (end - start) * 1e6,
                    "pid": os.getpid(), "tid": number, "args": details,
                }
            )  # fmt: skip

    def take(self) -> list[Event]:
        """What came since the last call, after the names of the lanes."""
        with self._lock:  # of both: other threads add lanes meanwhile, and no event may lack its lane's name
            lanes = list(self._lanes.items())
            events, self._events = self._events, []
        names = [
            {"name": "thread_name", "ph": "M", "pid": os.getpid(), "tid": number, "args": {"name": lane}}
            for lane, number in lanes
        ]
        return names + events

    def extend(self, events: Sequence[Event]) -> None:
        with self._lock:
            self._events += events

    def write(self, file: TextIO, path: Path) -> None:
        """Write all into `file` and close it; of half a trace nothing is left."""
        try:
            with file:
                json.dump({"traceEvents": self.take(), "displayTimeUnit": "ms"}, file)
        except BaseException:
            if not is_special(path):
                with suppress(OSError):
                    path.resolve().unlink()  # through a link, as it was written
            raise


@contextmanager
def collecting() -> Iterator[Callable[[], list[Event]]]:
    """Record what happens inside, for another process; gives what gives all since the last call."""
    global _recorder
    recorder = _recorder = _Recorder()
    try:
        yield recorder.take
    finally:
        _recorder = None


def extend(events: Sequence[Event]) -> None:
    """Record what another process of this machine collected: all have one clock."""
    recorder = _recorder  # read once: another thread may end the recording
    if recorder is not None:
        recorder.extend(events)


@contextmanager
def recording(path: Path | None) -> Iterator[None]:
    """Record what happens inside, also what fails, into the file `path`; None: do nothing.

    Raises `OutputError` if the file cannot be written; never instead of what ended the block.
    """
    global _recorder
    if path is None:
        yield
        return
    try:
        # now: a run may be long
        file = open_to_add(path) if is_special(path) else path.open("w", encoding="utf-8")
    except OSError as error:
        raise _unwritable(path, error) from None
    recorder = _recorder = _Recorder()
    complete = False
    try:
        yield
        complete = True
    finally:
        _recorder = None
        try:
            recorder.write(file, path)
        except OSError as error:
            if complete:
                raise _unwritable(path, error) from None


def _unwritable(path: Path, error: OSError) -> OutputError:
    return OutputError(f"{path} cannot be written: {error.strerror}; name another file with --profile")


def is_recording() -> bool:
    """Whether what is added now is kept."""
    return _recorder is not None


def add(name: str, kind: str, start: float, end: float, lane: str, **details: object) -> None:
    """Record what lasted from `start` to `end`, in seconds of `time.perf_counter`."""
    recorder = _recorder  # read once: another thread may end the recording
    if recorder is not None:
        recorder.add(name, kind, start, end, lane, **details)


@contextmanager
def span(name: str, kind: str, **details: object) -> Iterator[None]:
    """Record how long the block takes, in the lane of its thread."""
    start = time.perf_counter()
    try:
        yield
    finally:
        add(name, kind, start, time.perf_counter(), threading.current_thread().name, **details)


def phases(progress: Progress) -> Progress:
    """The same progress, whose phases are recorded."""

    @contextmanager
    def phase(name: str, total: int) -> Iterator[Advance]:
        with span(name, PHASE, total=total), progress(name, total) as advance:
            yield advance

    return phase

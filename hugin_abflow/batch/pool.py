"""Processes of this machine that stitch projects side by side.

While one project computes, the next one's layers are remapped and decoded, and the last one's panorama is
encoded. Processes, not threads: a crash costs one attempt at one project.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from multiprocessing import resource_tracker
from multiprocessing.connection import wait
from multiprocessing.context import SpawnProcess
from types import TracebackType
from typing import Any, Protocol

from hugin_abflow import trace
from hugin_abflow.batch.record import Record
from hugin_abflow.batch.task import Listener, Task, perform, settings_of
from hugin_abflow.batch.worker import GO, GRACE, work
from hugin_abflow.errors import ExitCode
from hugin_abflow.signals import deferred

# A project is tried again once if its process dies or its device fails: both may be another project's fault.
ATTEMPTS = 2
# Time to end after an interruption, seconds; whoever takes longer is ended.
_GRACE = GRACE + 5.0
# Seconds until it is asked again for a task where there was none.
PAUSE = 1.0


class Watcher(Protocol):
    """Who is told what becomes of tasks."""

    def began(self, task: Task) -> Listener:
        """A task begins; gives who is told how it goes on."""

    def ended(self, task: Task, record: Record) -> None:
        """A task is done."""


class _Worker:
    """A process with what it does at the moment."""

    def __init__(self, level: int, sharers: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self.process: SpawnProcess = context.Process(
            target=work, args=(other, level, trace.is_recording(), sharers), daemon=True
        )
        with _deaf():
            self.process.start()
        other.close()
        self.task: Task | None = None
        self._listener: Listener | None = None
        self._attempt, self._started = 0, datetime.now(UTC)
        self.turn_wanted: float | None = None  # since when it waits for the device
        self.has_turn = False

    def begin(self, task: Task, attempt: int, listener: Listener) -> None:
        """Have it stitch a project, for the first or second time."""
        self.task, self._attempt, self._listener = task, attempt, listener
        self._started = datetime.now(UTC)
        with suppress(OSError):  # dead already: the pipe says so when it is read
            self.pipe.send(task)

    def grant_turn(self) -> None:
        """Let it compute on the device."""
        self.turn_wanted, self.has_turn = None, True
        with suppress(OSError):
            self.pipe.send(GO)

    def end(self) -> None:
        """Let it go once it has nothing to do."""
        with suppress(OSError):
            self.pipe.send(None)

    def hear(self) -> Record | None:
        """Take in what it sends; gives the record when its project is done, or it is dead."""
        assert self.task is not None
        try:
            name, *values = self.pipe.recv()
        except (EOFError, OSError):
            record = Record(self.task.project.absolute(), exit_code=ExitCode.FAILED)
            record.settings = settings_of(self.task)
            record.started = self._started.isoformat(timespec="seconds")
            record.seconds = round((datetime.now(UTC) - self._started).total_seconds(), 3)
            record.message = (
                f"{self.task.project}: the process that stitched it {self._why_dead()}; "
                "run it alone with -v, and with fewer --jobs"
            )
        else:
            if name in ("turn_wanted", "turn_done"):
                self.turn_wanted = time.monotonic() if name == "turn_wanted" else None
                self.has_turn = False
                return None
            if name != "ended":
                getattr(self._listener, name)(*values)
                return None
            record, events = values
            trace.extend(events)
        record.attempts = self._attempt
        return record

    def release(self) -> Task:
        """What it has done; it is free for another."""
        self.turn_wanted, self.has_turn = None, False
        task, self.task = self.task, None
        assert task is not None
        return task

    def _why_dead(self) -> str:
        """How the process ended, once its pipe is closed."""
        self.process.join(_GRACE)
        code = self.process.exitcode
        if code is not None and code < 0:
            name = signal.Signals(-code).name
            memory = "; the system does that when memory runs out" if name == "SIGKILL" else ""
            return f"was ended by {name}{memory}"
        return f"ended with code {code}"


class Pool:
    """Up to `jobs` processes; `run` may be called again and again inside the ``with`` block.

    level       of the messages that listeners get.
    """

    def __init__(self, jobs: int, level: int, watcher: Watcher) -> None:
        self._jobs, self._level, self._watcher = jobs, level, watcher
        self._workers: list[_Worker] = []

    def __enter__(self) -> Pool:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        for worker in self._workers:
            if kind is None:
                worker.end()
            else:
                worker.pipe.close()  # on which it ends by itself, and tidies up
        for worker in self._workers:
            worker.process.join(_GRACE)
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()

    def run(self, tasks: Iterable[Task | None]) -> Iterator[Record]:
        """The records of the tasks, in the order in which they are done.

        A task is asked for when a process is free; None means that there is none at the moment.
        """
        source = iter(tasks)
        again: deque[tuple[Task, int]] = deque()
        coming, asking = True, 0.0  # from when on a task is asked for
        while coming or again or self._busy():
            while len(self._busy()) < self._jobs and (again or (coming and time.monotonic() >= asking)):
                try:
                    task, attempt = again.popleft() if again else (next(source), 1)
                except StopIteration:
                    coming = False
                    break
                if task is None:
                    asking = time.monotonic() + PAUSE
                else:
                    self._free().begin(task, attempt, self._watcher.began(task))
            for pipe in self._ready(asking if coming else None):
                worker = next(one for one in self._workers if one.pipe is pipe)
                record = worker.hear()
                if record is None:
                    self._grant_turn()
                    continue
                task = worker.release()
                self._grant_turn()
                if worker.process.exitcode is not None:
                    self._workers.remove(worker)
                if self._retry(worker, record):
                    again.append((task, record.attempts + 1))
                    continue
                self._watcher.ended(task, record)
                yield record

    def _ready(self, asking: float | None) -> list[Any]:
        """The pipes of processes that have sent something; waits for that, but not beyond the time `asking`
        if a process is free then.
        """
        busy = self._busy()
        free = len(busy) < self._jobs
        timeout = max(0.0, asking - time.monotonic()) if free and asking is not None else None
        if not busy:  # nothing to wait for, which Windows would not do
            time.sleep(timeout or 0.0)
            return []
        return wait([worker.pipe for worker in busy], timeout)

    def _grant_turn(self) -> None:
        """Let the one that has waited longest compute, if nobody does."""
        waiting = [worker for worker in self._workers if worker.turn_wanted is not None]
        if waiting and not any(worker.has_turn for worker in self._workers):
            min(waiting, key=lambda worker: worker.turn_wanted or 0.0).grant_turn()

    def _retry(self, worker: _Worker, record: Record) -> bool:
        """Whether another attempt may end better."""
        broken = worker.process.exitcode is not None or record.exit_code == ExitCode.DEVICE
        return broken and record.attempts < ATTEMPTS

    def _busy(self) -> list[_Worker]:
        return [worker for worker in self._workers if worker.task is not None]

    def _free(self) -> _Worker:
        """A process with nothing to do, a new one if there is none."""
        for worker in self._workers:
            if worker.task is None:
                return worker
        with deferred():  # `__exit__` ends those in the list: one that is started, and not in it, would go on
            self._workers.append(_Worker(self._level, self._jobs))
        return self._workers[-1]


class Alone:
    """The same in this process, one after the other: for one project, which needs no other."""

    def __init__(self, level: int, watcher: Watcher) -> None:
        self._level, self._watcher = level, watcher

    def __enter__(self) -> Alone:
        return self

    def __exit__(self, *reason: object) -> None:
        return

    def run(self, tasks: Iterable[Task | None]) -> Iterator[Record]:
        """The records of the tasks, one after the other."""
        for task in filter(None, tasks):
            record = perform(task, self._watcher.began(task), self._level)
            self._watcher.ended(task, record)
            yield record


@contextmanager
def _deaf() -> Iterator[None]:
    """Keep Ctrl-C from processes that are started in the ``with`` block; the pool tells them of it.

    SIGINT is blocked, which they inherit, and not ignored: so one that comes to us meanwhile is not lost, but
    comes after the block.
    """
    if os.name == "nt":
        yield  # blocked signals are not inherited there
        return
    resource_tracker.ensure_running()  # starts with the first process, and then unblocks SIGINT
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)

"""The same on the machines of a Dask cluster, over storage that all of them share.

Each project is a task of the cluster's scheduler, which gives it to another worker when one dies. A worker
uses its own device, and tells of progress through the scheduler's events. The only module that knows Dask.
"""

from __future__ import annotations

import glob
import logging
import os
import queue
import secrets
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from hugin_abflow import scratch
from hugin_abflow.batch.pool import PAUSE, Watcher
from hugin_abflow.batch.record import Record
from hugin_abflow.batch.task import Listener, Task, perform, settings_of
from hugin_abflow.errors import ClusterError, ExitCode
from hugin_abflow.metadata import PROGRAM, version
from hugin_abflow.terminal import label, say

_TIMEOUT = "10s"  # for the scheduler's first answer
_SILENCE = 10.0  # seconds after which it is asked whether there are workers
_EVERY = 0.5  # seconds between two messages about how far a phase is
_WITHOUT_PORTS = ("inproc", "ucx")  # kinds of addresses that Dask does not take apart
# Loggers that print tracebacks of a lost connection, of which futures tell.
_CHATTERS = ("distributed", "distributed.client", "tornado.application", "asyncio")
# Messages, the device and the measure of memory are a process's own: one project at a time in each.
_one_at_a_time = threading.Lock()


@dataclass
class _Voice:
    """Tells of a task on a worker, through the events of a topic."""

    worker: Any
    topic: str
    key: str
    _units: dict[str, int] = field(default_factory=dict)
    _told: float = 0.0

    def tell(self, name: str, *values: object) -> None:
        self.worker.log_event(self.topic, [self.key, name, *values])

    def phase_began(self, name: str, total: int) -> None:
        self.tell("phase_began", name, total)

    def advanced(self, name: str, units: int) -> None:
        self._units[name] = self._units.get(name, 0) + units
        if time.monotonic() - self._told > _EVERY:
            self._told = time.monotonic()
            self.tell("advanced", name, self._units.pop(name))

    def phase_ended(self, name: str, seconds: float) -> None:
        self.tell("phase_ended", name, seconds)

    def message(self, level: int, text: str, left: str = "") -> None:
        self.tell("message", level, text, left)


def _perform(task: Task, key: str, topic: str, level: int, its_version: str) -> Record:
    """On a worker: stitch the project of a task."""
    from distributed import get_worker  # an extra need not be there

    with _one_at_a_time:
        voice = _Voice(get_worker(), topic, key)
        voice.tell("began")
        if version() != its_version:
            record = Record(task.project, exit_code=ExitCode.CLUSTER)
            record.message = (
                f"{task.project}: a worker has {PROGRAM} {version()}, and not {its_version}; install "
                "the same on all machines"
            )
            return record
        scratch.sweep(scratch.root())  # this machine's, which is not where the run began
        return perform(task, voice, level)


class Cluster:
    """The workers of a scheduler, such as ``tcp://host:8786``; a context manager.

    level       of the messages that listeners get.

    Raises `ClusterError` if Dask is not installed, `scheduler` is no address, or no scheduler answers.
    """

    def __init__(self, scheduler: str, level: int, watcher: Watcher) -> None:
        try:
            from distributed import Client
            from distributed.comm.addressing import get_address_host_port, parse_address
        except ImportError:
            raise ClusterError(
                f"--scheduler needs Dask; install it with: pip install '{PROGRAM}[cluster]'"
            ) from None
        for name in _CHATTERS:
            logging.getLogger(name).setLevel(logging.CRITICAL)
        try:
            # a client that cannot even begin waits for 20 s when it is collected, and prints a traceback
            if parse_address(scheduler)[0] not in _WITHOUT_PORTS:
                get_address_host_port(scheduler)
        except ValueError as error:
            raise ClusterError(
                f"{scheduler} is no scheduler's address ({error}); give one such as tcp://host:8786"
            ) from None
        try:
            self._client = Client(scheduler, timeout=_TIMEOUT, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise ClusterError(
                f"no scheduler answers at {scheduler} ({error}); docs/cluster.md says how to start one"
            ) from None
        self._level, self._watcher = level, watcher
        self._topic = f"{PROGRAM}-{secrets.token_hex(6)}"
        self._heard: queue.SimpleQueue[Any] = queue.SimpleQueue()  # events and futures that are done
        self._tasks: dict[str, Task] = {}
        self._listeners: dict[str, Listener] = {}
        self._attempts: dict[str, int] = {}
        self._deserted = False

    def __enter__(self) -> Cluster:
        self._client.subscribe_topic(self._topic, lambda event: self._heard.put(event[1]))
        self._look_for_workers()
        return self

    def __exit__(self, *reason: object) -> None:
        self._client.close()  # the scheduler forgets what nobody waits for

    def run(self, tasks: Iterable[Task | None]) -> Iterator[Record]:
        """The records of the tasks, in the order in which they are done; None: no task at the moment."""
        for task in tasks:
            if task is not None:
                self._submit(task)
            yield from self._hear_for(PAUSE if task is None else 0.0)
        while self._tasks:
            try:
                heard = self._heard.get(timeout=_SILENCE)
            except queue.Empty:
                self._look_for_workers()
            else:
                yield from self._take_in(heard)

    def _look_for_workers(self) -> None:
        """Warn once when there are none any more: their tasks wait."""
        with suppress(OSError):  # of a scheduler that is gone futures tell
            deserted = not self._client.nthreads()
            if deserted and not self._deserted:
                warning = f"{label(logging.WARNING)}the scheduler has no workers; projects wait until it has"
                say(f"{warning} (docs/cluster.md says how to start one)")
            self._deserted = deserted

    def _submit(self, task: Task) -> None:
        """Have one of the workers stitch a project."""
        key = f"{task.project.stem}-{secrets.token_hex(6)}"
        self._tasks[key] = task
        future = self._client.submit(
            _perform, elsewhere(task), key, self._topic, self._level, version(), key=key, pure=False
        )
        future.add_done_callback(self._heard.put)

    def _hear_for(self, seconds: float) -> Iterator[Record]:
        """Take in what comes within a time."""
        end = time.monotonic() + seconds
        with suppress(queue.Empty):
            while True:
                yield from self._take_in(self._heard.get(timeout=max(0.0, end - time.monotonic())))

    def _take_in(self, heard: Any) -> Iterator[Record]:
        """Take in an event or a future that is done; gives the record of a task that is done."""
        if isinstance(heard, list | tuple):
            key, name, *values = heard
            if key not in self._tasks:
                return  # told late
            if name == "began":
                self._attempts[key] = self._attempts.get(key, 0) + 1
                self._listeners[key] = self._watcher.began(self._tasks[key])
            elif key in self._listeners:
                getattr(self._listeners[key], name)(*values)
            return
        key = heard.key
        task = self._tasks.pop(key)
        record = self._result(heard, task)
        record.attempts = max(1, self._attempts.get(key, 1))
        if key not in self._listeners:
            self._watcher.began(task)
        self._watcher.ended(task, record)
        yield record

    def _result(self, future: Any, task: Task) -> Record:
        """The record of a task, also where the workers gave none."""
        if future.status == "finished":
            record: Record = future.result()
            return record
        record = Record(task.project.absolute(), exit_code=ExitCode.CLUSTER)
        record.settings = settings_of(task)
        if future.status in ("cancelled", "lost"):
            record.message = (
                f"{task.project}: the scheduler is gone, or withdrew it; start it again, and run the same "
                "command, which goes on where this one was"
            )
            return record
        record.message = (
            f"{task.project}: the cluster gave it up ({future.exception()!r}); are {PROGRAM} and the shared "
            "folder on all machines, and is there memory enough?"
        )
        return record


def elsewhere(task: Task) -> Task:
    """The same task for another process: names of files do not depend on the current folder."""

    def absolute(value: Any) -> Any:
        if isinstance(value, list):
            return [absolute(one) for one in value]
        return value.absolute() if isinstance(value, Path) else value

    options: Mapping[str, Any] = {name: absolute(value) for name, value in task.options.items()}
    prefix = options.get("prefix")
    # a prefix may be meant from here or from the project's folder
    if prefix and glob.glob(f"{glob.escape(os.fspath(prefix))}*"):  # noqa: PTH207
        options = {**options, "prefix": os.path.join(Path.cwd(), prefix)}  # noqa: PTH118
    return replace(task, project=task.project.absolute(), options=options)

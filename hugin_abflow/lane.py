"""A queue of a device, with the memory that it may use again, and when it did what."""

from __future__ import annotations

import threading
import time
from collections import deque

import numpy as np
import pyopencl as cl

from hugin_abflow import trace
from hugin_abflow.spare import Spare


class _Times:
    """When a lane of the device did what; its queue does one thing after the other."""

    def __init__(self, queue: cl.CommandQueue, name: str) -> None:
        self._name = name
        self._events: deque[tuple[str, str, cl.Event]] = deque()
        self._lock = threading.Lock()
        # its clock to ours: the least of several, for we may be told late
        self._offset = min(self._lag(queue) for _ in range(8))

    @staticmethod
    def _lag(queue: cl.CommandQueue) -> float:
        """Seconds from the end of an event on the device's clock to now on ours."""
        event = cl.enqueue_fill_buffer(queue, cl.Buffer(queue.context, 0, 16), np.int32(0), 0, 16)
        event.wait()
        return time.perf_counter() - float(event.profile.end) * 1e-9

    def add(self, name: str, kind: str, event: cl.Event) -> None:
        """Have the trace told when this was done, later."""
        self._events.append((name, kind, event))
        if kind == trace.TRANSFER:
            self.tell()  # at once: the event keeps the host's array

    def tell(self) -> None:
        """Tell the trace what is done."""
        complete = cl.command_execution_status.COMPLETE
        with self._lock:
            while self._events and self._events[0][2].command_execution_status == complete:
                name, kind, event = self._events.popleft()
                start, end = (self._offset + ns * 1e-9 for ns in (event.profile.start, event.profile.end))
                trace.add(name, kind, start, end, self._name)


class StoppedError(Exception):
    """Nobody waits any more for what is done in a lane."""


class Lane:
    """A queue, which does one thing after the other.

    spare       memory that what comes may use. stopped: set when no kernel is to be started any more.
    number      of this lane among the device's. timing: whether the trace is told when what was done.
    """

    def __init__(self, context: cl.Context, number: int, timing: bool) -> None:
        profiling = cl.command_queue_properties.PROFILING_ENABLE if timing else 0
        self.queue = cl.CommandQueue(context, properties=profiling)
        self.spare = Spare()
        self._times = _Times(self.queue, f"device {number}" if number > 1 else "device") if timing else None
        self.stopped = threading.Event()

    def timed(self, name: str, kind: str, event: cl.Event) -> None:
        """Have the trace, where there is one, told later when this was done."""
        if self._times:
            self._times.add(name, kind, event)

    def tell_times(self) -> None:
        """Tell the trace what is done."""
        if self._times:
            self._times.tell()

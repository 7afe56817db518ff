"""A process that stitches one project after the other for the pool (pool.py) that started it.

Whatever ends such a process (a driver that crashes, memory that runs out) ends one project and no more. It
ends by itself, tidily, when the pool is gone.
"""

from __future__ import annotations

import _thread
import os
import queue
import signal
import threading
import time
from contextlib import nullcontext
from multiprocessing.connection import Connection
from typing import Any

from hugin_abflow import memory, process, scratch, trace
from hugin_abflow.batch.task import Task, perform
from hugin_abflow.signals import interruptible

# Time that a process has to end by itself once the pool is gone, seconds.
GRACE = 10.0


class _Sender:
    """Tells the pool what happens, as the names and arguments of the display's methods."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe, self._lock = pipe, threading.Lock()

    def send(self, name: str, *values: Any) -> None:
        with self._lock:
            try:
                self._pipe.send((name, *values))
            except OSError:  # the pool is gone: `_read` ends this process
                return

    def phase_began(self, name: str, total: int) -> None:
        self.send("phase_began", name, total)

    def advanced(self, name: str, units: int) -> None:
        self.send("advanced", name, units)

    def phase_ended(self, name: str, seconds: float) -> None:
        self.send("phase_ended", name, seconds)

    def message(self, level: int, text: str, left: str = "") -> None:
        self.send("message", level, text, left)


# What the pool answers to "turn_wanted".
GO = "go"


class _Turn:
    """A turn at the device, which the pool gives to one process at a time."""

    def __init__(self, sender: _Sender) -> None:
        self._sender, self._held = sender, False
        self.granted: queue.SimpleQueue[str] = queue.SimpleQueue()

    def take(self) -> None:
        if not self._held:
            self._sender.send("turn_wanted")
            self.granted.get()
            self._held = True

    def give_back(self) -> None:
        if self._held:
            self._sender.send("turn_done")
            self._held = False


def work(pipe: Connection, level: int, traced: bool, sharers: int) -> None:
    """Perform the tasks that come through `pipe`, until None comes or the other end is closed.

    level       of the messages that are sent. traced: send what is done and when as well.
    sharers     processes that share the memory that may be taken.
    """
    process.set_up()
    memory.share(sharers)
    orders: queue.SimpleQueue[Task | None] = queue.SimpleQueue()
    sender = _Sender(pipe)
    turn = _Turn(sender)
    try:
        with interruptible(), trace.collecting() if traced else nullcontext(list) as taken:
            threading.Thread(target=_read, args=(pipe, orders, turn), daemon=True).start()
            while (task := orders.get()) is not None:
                record = perform(task, sender, level, turn)
                sender.send("ended", record, taken())
    except KeyboardInterrupt:
        pass  # nobody is left to be told


def _read(pipe: Connection, orders: queue.SimpleQueue[Task | None], turn: _Turn) -> None:
    """Hand on what the pool sends; when it is gone, end this process as a signal would, or else at once: an
    interruption that comes while an object is collected is lost, and one that comes while a lock is held may
    wait for itself. A program that it waits for (nona) runs to its end then.
    """
    try:
        while (order := pipe.recv()) is not None:
            if order == GO:
                turn.granted.put(order)
            else:
                orders.put(order)
        orders.put(None)
    except (EOFError, OSError):
        if os.name == "nt":
            _thread.interrupt_main()
        else:  # which also ends a wait for nona
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)
        time.sleep(GRACE)
        try:
            scratch.tidy()
        finally:
            os._exit(1)

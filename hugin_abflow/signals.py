"""The signals that end a run."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")  # Windows has no SIGHUP
_ENDING = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]


@contextmanager
def interruptible() -> Iterator[None]:
    """Let SIGTERM and SIGHUP unwind the program as Ctrl-C does, so that temporary files go."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may set handlers
        return
    last = -float("inf")

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal last
        if time.monotonic() - last < 2.0:
            return  # an impatient second Ctrl-C would break off the tidying up
        last = time.monotonic()
        sys.unraisablehook = lambda unraisable: None  # what was being made may complain as it goes, at length
        raise KeyboardInterrupt

    # What is ignored stays ignored: that is how nohup works.
    before = {number: signal.getsignal(number) for number in _ENDING}
    changed = [number for number in _ENDING if before[number] is not signal.SIG_IGN]
    for number in changed:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number in changed:
            signal.signal(number, before[number])


@contextmanager
def held() -> Iterator[None]:
    """Have drivers of OpenCL set themselves up, or compile, with nothing to interrupt it; signals come after.

    A shell sends Ctrl-C to all that a program has started. PoCL ends us where its linker is ended: what is
    started meanwhile, by threads that are started meanwhile too, never gets these signals.

    LLVM, in PoCL and others, puts handlers in place of Python's. At the first signal they give way to the
    system's for a moment, in which a second one, as of `timeout`, would end us with nothing tidied up. After
    this Python's handlers are in place again, and LLVM does not repeat it.
    """
    if os.name == "nt":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING)
    try:
        yield
    finally:
        try:
            _reinstall()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _reinstall() -> None:
    """Put Python's handlers in place, which it believes they are; only its main thread may."""
    if threading.current_thread() is threading.main_thread():
        for number in _ENDING:
            handler = signal.getsignal(number)
            if handler is not None:  # set by somebody else, before Python was started
                signal.signal(number, handler)

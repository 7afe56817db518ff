"""The signals that end a run."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")  # Windows has no SIGHUP
_ENDING = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]
_Handler = Callable[[int, FrameType | None], None] | signal.Handlers
_installed: dict[int, _Handler] = {}  # while `interruptible`
_waiting: list[int] | None = None  # signals that came while `deferred`; None: none has to wait


@contextmanager
def interruptible() -> Iterator[None]:
    """Let SIGTERM and SIGHUP unwind the program as Ctrl-C does, so that temporary files go."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may set handlers
        return
    last = -float("inf")

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal last
        if _waiting is not None:
            _waiting.append(number)
            return
        if time.monotonic() - last < 2.0:
            return  # an impatient second Ctrl-C would break off the tidying up
        last = time.monotonic()
        sys.unraisablehook = lambda unraisable: None  # what was being made may complain as it goes, at length
        raise KeyboardInterrupt

    # What is ignored stays ignored, whatever drivers do with it: that is how nohup works.
    before = {number: signal.getsignal(number) for number in _ENDING}
    changed = [number for number in _ENDING if before[number] is not signal.SIG_IGN]
    _installed.update(dict.fromkeys(_ENDING, signal.SIG_IGN) | dict.fromkeys(changed, interrupt))
    _install()
    try:
        yield
    finally:
        _installed.clear()
        for number in changed:
            signal.signal(number, before[number])


@contextmanager
def deferred() -> Iterator[None]:
    """Have signals of `interruptible` wait for the end of the ``with`` block, for work that must not be
    broken off in the middle: a process that was just started would go on with nobody who knows it.

    Unlike in `held` they are not blocked: what is started in the block gets them.
    """
    global _waiting
    if threading.current_thread() is not threading.main_thread():
        yield  # signals are raised in the main thread alone
        return
    came: list[int] = []
    _waiting = came
    try:
        yield
    finally:
        _waiting = None
        if came:
            signal.raise_signal(came[0])


@contextmanager
def held() -> Iterator[None]:
    """Let drivers of OpenCL set themselves up, or compile, and what they start not get these signals.

    A shell sends Ctrl-C to all that a program has started, and PoCL ends us where its linker is ended. This
    thread and those that are started meanwhile hold signals back, and so does whatever these start. Other
    threads may still get them: Python then raises what it has to between two calls of the driver.

    LLVM, in PoCL and others, puts handlers in place of Python's. At the first signal they give way to the
    system's for a moment, in which a second one, as of `timeout`, would end us with nothing tidied up. After
    this those of `interruptible` are in place again, and LLVM does not repeat it. Handlers of programs that
    use us as a library are theirs.
    """
    if os.name == "nt":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    try:
        signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING)  # may raise when it is done
        yield
    finally:
        try:
            if threading.current_thread() is threading.main_thread():
                _install()
        finally:
            try:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
            except BaseException:  # Python told of one that another thread got, with nothing done yet
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
                raise


def _install() -> None:
    """Put the handlers of `interruptible` in place."""
    for number, handler in _installed.items():
        signal.signal(number, handler)

"""Signals while drivers of OpenCL set themselves up; what they do to a run is in test_terminal.py."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyopencl as cl
import pytest

from hugin_abflow import signals
from hugin_abflow.opencl import Device

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="drivers are looked at by Linux's means")

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@pytest.fixture(autouse=True)
def restored() -> Iterator[None]:
    """Handlers are as before after a test."""
    before = {number: signal.getsignal(number) for number in ENDING}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def handler_of(number: int) -> int:
    """The address that the system calls: Python's own `getsignal` gives what it set itself."""
    action = (ctypes.c_size_t * 64)()
    assert ctypes.CDLL(None).sigaction(number, None, action) == 0
    return action[0]


def test_signals_come_after() -> None:
    came = []
    for number in ENDING:
        signal.signal(number, lambda number, frame: came.append(number))
    with signals.held():
        for number in ENDING:
            signal.pthread_kill(threading.get_ident(), number)  # other threads may not hold it
        with signals.held():
            pass
        assert not came
    assert sorted(came) == sorted(ENDING)


def test_handlers_of_others_go() -> None:
    """As LLVM's, which take one signal only."""
    system = ctypes.CDLL(None)
    system.signal.argtypes, system.signal.restype = (ctypes.c_int, ctypes.c_void_p), ctypes.c_void_p
    ours = handler_of(signal.SIGINT)
    ignored = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with signals.held():
        for number in ENDING:
            system.signal(number, ctypes.cast(system.abort, ctypes.c_void_p))
        assert handler_of(signal.SIGINT) != ours
    assert handler_of(signal.SIGINT) == ours
    assert handler_of(signal.SIGHUP) == signal.SIG_IGN != ignored


def test_other_threads_may_hold_them_too() -> None:
    """Which may not set handlers; layers are read, and kernels built, beside the main thread."""
    before, inside, after = [], [], []

    def masked() -> set[int]:
        return set(signal.pthread_sigmask(signal.SIG_BLOCK, ()))

    def work() -> None:
        before.append(masked())
        with signals.held():
            inside.append(masked())
        after.append(masked())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert inside[0] >= set(ENDING) and before == after and not before[0] & set(ENDING)


@pytest.mark.parametrize("what", ["get_platforms", "Context", "CommandQueue", "Program"])
def test_they_are_held_whatever_a_driver_does_with_them(monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    """Each starts threads and programs when it likes."""
    original, masks = getattr(cl, what), []

    def observed(*arguments: Any, **keywords: Any) -> Any:
        masks.append(signal.pthread_sigmask(signal.SIG_BLOCK, ()))
        return original(*arguments, **keywords)

    monkeypatch.setattr(cl, what, observed)
    Device().build("pyramid")
    assert masks and all(mask >= set(ENDING) for mask in masks)
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, ()) & set(ENDING)


def test_drivers_threads_never_get_them_and_handlers_are_pythons(tmp_path: Path) -> None:
    """PoCL's linker is started by these threads, with what they get; kernels are built for the first time."""
    code = """
import os, signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from test_signals import ENDING, handler_of
from hugin_abflow.opencl import Device
from hugin_abflow.signals import interruptible
others = set(os.listdir("/proc/self/task"))
with interruptible():
    ours = [handler_of(number) for number in ENDING]
    device = Device()
    image = device.zeros((4, 4))
    device.run("pyramid", "pyramid_reduce", (2, 2), image, image, (4, 4, 0, 0), image, image, (2, 2))
    device.finish()
    assert [handler_of(number) for number in ENDING] == ours
for task in set(os.listdir("/proc/self/task")) - others:
    status = Path("/proc/self/task", task, "status").read_text()
    masked = int(status.partition("SigBlk:")[2].split()[0], 16)
    assert all(masked >> number - 1 & 1 for number in ENDING), status
print(device.name, len(os.listdir("/proc/self/task")) - len(others))
"""
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path), "POCL_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", code, str(Path(__file__).parent)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    if "Portable" in done.stdout:
        assert int(done.stdout.split()[-1]) > 0

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
from hugin_abflow.devices import list_devices
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


def set_beside_python(number: int) -> int:
    """Set a handler as LLVM does, of which Python does not know; its address."""
    system = ctypes.CDLL(None)
    system.signal.argtypes, system.signal.restype = (ctypes.c_int, ctypes.c_void_p), ctypes.c_void_p
    address = ctypes.cast(system.abort, ctypes.c_void_p)
    system.signal(number, address)
    return int(address.value or 0)


def test_handlers_of_drivers_give_way_to_those_of_a_run() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # nohup
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    with signals.interruptible():
        ours = [handler_of(number) for number in ENDING]
        with signals.held():
            theirs = [set_beside_python(number) for number in ENDING]
            assert [handler_of(number) for number in ENDING] == theirs
        assert [handler_of(number) for number in ENDING] == ours
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
    assert handler_of(signal.SIGTERM) == signal.SIG_DFL


def test_deferred_signals_come_at_the_end() -> None:
    done = []
    with pytest.raises(KeyboardInterrupt), signals.interruptible():
        with signals.deferred():
            signal.raise_signal(signal.SIGTERM)
            done.append("block")
        done.append("more")
    with signals.interruptible(), signals.deferred():
        done.append("no signal")
    assert done == ["block", "no signal"]


def test_a_second_signal_after_a_deferred_one_breaks_nothing_off() -> None:
    tidied = False
    with pytest.raises(KeyboardInterrupt), signals.interruptible():
        try:
            with signals.deferred():
                signal.raise_signal(signal.SIGINT)
        finally:
            signal.raise_signal(signal.SIGINT)
            tidied = True
    assert tidied


def test_handlers_of_programs_that_use_the_library_stay() -> None:
    theirs = [set_beside_python(number) for number in ENDING]
    with signals.held():
        pass
    assert [handler_of(number) for number in ENDING] == theirs


def test_nothing_stays_held_back() -> None:
    """Where a signal that came before is told when they begin to be held, and when they no longer are."""
    code = """
import os, signal, threading, time
from hugin_abflow import signals
def interrupt(number, frame):
    if armed:
        armed.clear()
        raise KeyboardInterrupt
def bother():
    for _ in range(300):
        time.sleep(0.001)
        os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.5)  # the last one is told by then
    done.append(True)
armed, done, caught = [], [], 0
signal.signal(signal.SIGINT, interrupt)
threading.Thread(target=bother).start()
while not done:
    try:
        armed.append(True)
        while not done:
            with signals.held():
                pass
    except KeyboardInterrupt:
        caught += 1
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, ()), caught
print(caught)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout and int(done.stdout) > 30, done.stderr


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
    if what == "get_platforms":
        list_devices()
    Device().build("pyramid")
    assert masks and all(mask >= set(ENDING) for mask in masks)
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, ()) & set(ENDING)


@pytest.mark.parametrize("nohup", [False, True])
def test_drivers_threads_never_get_them_and_handlers_are_pythons(tmp_path: Path, nohup: bool) -> None:
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
    command = [*["nohup"] * nohup, sys.executable, "-c", code, str(Path(__file__).parent)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    if "Portable" in done.stdout:
        assert int(done.stdout.split()[-1]) > 0

"""The commands' processes are their own; a program that uses the library is not changed."""

from __future__ import annotations

import subprocess
import sys

import pytest

from hugin_abflow import process

COMMANDS = {
    "hugin-abflow": ("hugin_abflow.cli", "module.main(['--version'])"),
    "abflow-enblend": ("hugin_abflow.dropin.enblend", "module.main(['--version'])"),
    "a worker": ("hugin_abflow.batch.worker", "other.close(); module.work(pipe, 20, False, 1)"),
}
CHILD = """
import multiprocessing, sys
from importlib import import_module
module = import_module("{module}")
pipe, other = multiprocessing.Pipe()
before = sys.getswitchinterval()
{run}
print("switched:", before, sys.getswitchinterval())
"""


@pytest.mark.parametrize("name", list(COMMANDS))
def test_threads_take_turns_soon(name: str) -> None:
    module, run = COMMANDS[name]
    child = [sys.executable, "-c", CHILD.format(module=module, run=run)]
    said = subprocess.run(child, check=True, capture_output=True, text=True, timeout=60).stdout
    before, after = map(float, said.rpartition("switched:")[2].split())
    assert before == 0.005 > 10 * after > 0


def test_memory_is_managed(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[object] = []
    monkeypatch.setattr(process.memory, "manage", lambda: done.append("memory"))
    monkeypatch.setattr(process.sys, "setswitchinterval", done.append)
    process.set_up()
    assert len(done) == 2 and "memory" in done

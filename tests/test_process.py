"""The commands' processes are their own; a program that uses the library is not changed."""

from __future__ import annotations

import subprocess
import sys

import pytest

COMMANDS = {
    "hugin-abflow": "from hugin_abflow import cli; cli.main(['--version'])",
    "abflow-enblend": "from hugin_abflow.dropin import enblend; enblend.main(['--version'])",
    "a worker": "from hugin_abflow.batch import worker; other.close(); worker.work(pipe, 20, False, 1)",
}
CHILD = """
import multiprocessing, sys
import hugin_abflow
pipe, other = multiprocessing.Pipe()
before = sys.getswitchinterval()
{run}
print("switched:", before, sys.getswitchinterval())
"""


@pytest.mark.parametrize("name", list(COMMANDS))
def test_threads_take_turns_soon(name: str) -> None:
    child = [sys.executable, "-c", CHILD.format(run=COMMANDS[name])]
    said = subprocess.run(child, check=True, capture_output=True, text=True, timeout=60).stdout
    before, after = map(float, said.rpartition("switched:")[2].split())
    assert before == 0.005 > 10 * after > 0

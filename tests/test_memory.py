"""Sizes as users write them, limits, and what is told of this process."""

from __future__ import annotations

import re
import subprocess
import sys
from types import SimpleNamespace

import psutil
import pytest

from hugin_abflow import memory
from hugin_abflow.errors import SettingsError

MIB = 1 << 20


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("800M", 800 * MIB),
        ("1G", 1024 * MIB),
        ("1.5g", 1536 * MIB),
        (" 2GiB ", 2048 * MIB),
        ("64kB", 65536),
        ("1T", 1 << 40),
        ("1048576", MIB),
    ],
)
def test_sizes_are_read(text: str, count: int) -> None:
    assert memory.parse_size(text) == count


@pytest.mark.parametrize("text", ["", "much", "-1G", "1X", "1G5", "nan"])
def test_what_is_no_size_is_refused(text: str) -> None:
    with pytest.raises(SettingsError, match=re.escape(repr(text))):
        memory.parse_size(text)


def test_sizes_in_words_are_read_back() -> None:
    for count in (500 << 10, 3 * MIB, 812 * MIB, 20 << 30):
        assert memory.parse_size(memory.size(count).replace(" ", "")) == count
    assert (memory.size(1 << 30), memory.size(1067 * MIB)) == ("1.00 GiB", "1.04 GiB")


def test_the_limit_is_half_of_the_machine_unless_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "machine", lambda: 8 << 30)
    assert memory.limit(0) == 4 << 30
    assert memory.limit(MIB) == MIB


def test_processes_side_by_side_share_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "_sharers", 1)
    memory.share(4)
    assert memory.limit(8 * MIB) == 2 * MIB
    given, remedy = memory.shortage(8 * MIB, 3 * MIB)
    assert given == "--max-memory 8.0 MiB, for each of 4 --jobs 2.0 MiB,"
    assert remedy == "give 13M, or fewer --jobs"
    monkeypatch.setattr(memory, "machine", lambda: 64 * MIB)
    assert memory.shortage(0, 9 * MIB)[0].startswith("half of the machine's memory, 32.0 MiB, for each of 4")


def test_processes_side_by_side_share_what_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "_sharers", 1)
    monkeypatch.setattr(memory, "machine", lambda: 64 * MIB)
    for available, whole in ((40 * MIB, 40 * MIB), (99 * MIB, 64 * MIB)):  # of the host; a container has less
        monkeypatch.setattr(
            psutil, "virtual_memory", lambda available=available: SimpleNamespace(available=available)
        )
        memory.share(1)
        assert memory.unused() == whole
        memory.share(4)
        assert memory.unused() == whole // 4


def test_a_container_has_less_than_the_machine(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    whole = memory.machine()
    assert whole > 100 * MIB
    bounded, unbounded = tmp_path / "memory.max", tmp_path / "unbounded"
    bounded.write_text("52428800\n")
    unbounded.write_text("max\n")
    for names, expected in (([unbounded], whole), ([bounded, unbounded], 50 * MIB)):
        monkeypatch.setattr(memory, "_CONTAINER_LIMITS", [str(name) for name in names])
        assert memory.machine() == expected or names == [unbounded]


CHILD = """
import numpy as np
from hugin_abflow import memory
{manage}
empty = memory.resident()
# blocks that glibc keeps by itself, each followed by one that stays
kept, gone = [], []
for _ in range(100):
    gone.append(np.ones(4 << 20, np.uint8))
    kept.append(np.ones(50_000, np.uint8))
full = memory.resident()
gone.clear()
memory.give_back()
print(empty, full, memory.resident(), memory.peak())
"""


@pytest.mark.parametrize("manage", ["memory.manage()", ""])
def test_freed_memory_is_given_back_and_the_peak_remembered(manage: str) -> None:
    run = [sys.executable, "-c", CHILD.format(manage=manage)]
    empty, full, after, peak = map(int, subprocess.check_output(run, text=True).split())
    assert full - empty > 380 * MIB
    assert after - empty < 100 * MIB
    assert peak >= full - MIB  # what the system counts lags a little

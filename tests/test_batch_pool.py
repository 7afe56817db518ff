"""Processes side by side: every project's record comes, whatever becomes of its process."""

from __future__ import annotations

import logging
import os
from pathlib import Path

import pytest
from shoots import write_project

from hugin_abflow.batch.pool import ATTEMPTS, Pool
from hugin_abflow.batch.record import Record
from hugin_abflow.batch.task import Task
from hugin_abflow.errors import ExitCode
from hugin_abflow.settings import Settings

posix = pytest.mark.skipif(os.name == "nt", reason="the stand-in for nona is a shell script")


class Ear:
    """Hears a task and keeps what it hears."""

    def __init__(self) -> None:
        self.phases: list[str] = []
        self.messages: list[str] = []
        self.units = 0

    def phase_began(self, name: str, total: int) -> None:
        self.phases.append(name)

    def advanced(self, name: str, units: int) -> None:
        self.units += units

    def phase_ended(self, name: str, seconds: float) -> None:
        self.phases.append(f"{name} done")

    def message(self, level: int, text: str) -> None:
        self.messages.append(text)


class Watch:
    def __init__(self) -> None:
        self.ears: dict[str, Ear] = {}
        self.begun: list[str] = []
        self.done: list[str] = []

    def began(self, task: Task) -> Ear:
        self.begun.append(task.project.stem)
        return self.ears.setdefault(task.project.stem, Ear())

    def ended(self, task: Task, record: Record) -> None:
        self.done.append(task.project.stem)


def perform(tasks: list[Task], jobs: int) -> tuple[dict[str, Record], Watch]:
    watch = Watch()
    with Pool(jobs, logging.INFO, watch) as pool:
        records = {record.project.stem: record for record in pool.run(tasks)}
    return records, watch


def tasks_in(folder: Path, *names: str, **options: object) -> list[Task]:
    settings = {"settings": Settings()} | options
    return [Task(write_project(folder / f"{name}.pto"), settings) for name in names]


def stand_in(folder: Path, script: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A program that is called in nona's place."""
    programs = folder / "bin"
    programs.mkdir()
    (programs / "nona").write_text(f'#!/bin/sh\n[ "$1" = --help ] && exit 0\n{script}\n')
    (programs / "nona").chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")


def test_projects_are_stitched_side_by_side_and_heard(tmp_path: Path) -> None:
    tasks = tasks_in(tmp_path, "a", "b", "c")
    (tmp_path / "b0000.tif").write_bytes(b"no picture")
    records, watch = perform(tasks, 2)
    assert {name: record.result for name, record in records.items()} == {
        "a": "made", "b": "failed", "c": "made",
    }  # fmt: skip
    assert records["b"].exit_code == ExitCode.IMAGE_READ and "b0000.tif" in records["b"].message
    assert sorted(watch.begun) == sorted(watch.done) == ["a", "b", "c"]
    for name in "ac":
        record, ear = records[name], watch.ears[name]
        (made,) = record.files
        assert made == tmp_path / f"{name}.tif" and record.bytes == made.stat().st_size
        assert ear.phases[0] == "read" and ear.phases[-1] == "blend done" and ear.units >= 125
        assert set(record.phases) == {"read", "flow", "align", "blend"}
        assert record.seconds > sum(record.phases.values())
        assert record.device and record.memory and record.memory > 10 << 20
        assert any("canvas: 250 x 125" in text for text in ear.messages)


@posix
def test_process_that_dies_costs_an_attempt_and_no_other_project(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As when the system kills it because memory runs out."""
    stand_in(tmp_path, f'echo x >> "{tmp_path}/count"; kill -9 $PPID', monkeypatch)
    for name in ("left.png", "right.png"):
        (tmp_path / name).write_bytes(b"nobody looks at this")
    doomed = tasks_in(tmp_path, "doomed", remap="always")
    records, _ = perform([*doomed, *tasks_in(tmp_path, "a", "b")], 1)
    assert records["a"].result == records["b"].result == "made"
    assert records["doomed"].exit_code == ExitCode.FAILED and records["doomed"].attempts == ATTEMPTS
    assert "was ended by SIGKILL" in records["doomed"].message and "memory" in records["doomed"].message
    assert (tmp_path / "count").read_text() == "x\n" * ATTEMPTS


@posix
def test_process_that_died_once_is_forgiven(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    count = tmp_path / "count"
    stand_in(tmp_path, f'[ -e "{count}" ] || {{ touch "{count}"; kill -9 $PPID; }}\nexit 3', monkeypatch)
    for name in ("left.png", "right.png"):
        (tmp_path / name).write_bytes(b"nobody looks at this")
    records, watch = perform(tasks_in(tmp_path, "a", remap="always"), 1)
    assert records["a"].exit_code == ExitCode.NONA and records["a"].attempts == 2
    assert watch.begun == ["a", "a"] and watch.done == ["a"]


def test_pool_can_be_used_again(tmp_path: Path) -> None:
    watch = Watch()
    with Pool(1, logging.WARNING, watch) as pool:
        for name in "ab":
            (record,) = pool.run(tasks_in(tmp_path, name))
            assert record.result == "made"
    assert watch.done == ["a", "b"]

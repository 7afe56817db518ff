"""Processes side by side: every project's record comes, whatever becomes of its process."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
from collections.abc import Iterator
from itertools import groupby
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any

import pytest
from shoots import write_project

from hugin_abflow import cli
from hugin_abflow.batch import pool, worker
from hugin_abflow.batch.pool import ATTEMPTS, Pool
from hugin_abflow.batch.record import Record
from hugin_abflow.batch.task import Task
from hugin_abflow.batch.task import perform as perform_alone
from hugin_abflow.errors import ExitCode
from hugin_abflow.opencl import Device
from hugin_abflow.settings import Settings
from hugin_abflow.signals import interruptible

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

    def message(self, level: int, text: str, left: str = "") -> None:
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
    with Pool(jobs, logging.INFO, watch) as processes:
        records = {record.project.stem: record for record in processes.run(tasks)}
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
    assert records["doomed"].settings["remap"] == "always"
    assert records["doomed"].started and records["doomed"].seconds > 0
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


def test_memory_is_shared_among_no_more_than_there_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Else --jobs 64 would leave each of two projects a 64th."""
    projects = [str(task.project) for task in tasks_in(tmp_path, "a", "b")]
    assert cli.main([*projects, "--jobs", "64", "--max-memory", "1G"]) == 0
    assert "too little" not in capsys.readouterr().err
    assert cli.main([*projects, "--force", "--max-memory", "30M", "--jobs", "2"]) == ExitCode.ALL_FAILED
    assert "--max-memory 30.0 MiB, for each of 2 --jobs 15.0 MiB, is too" in capsys.readouterr().err


@posix
def test_ctrl_c_while_a_process_starts_is_neither_lost_nor_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A shell sends it to both; the process tidies up, and is not left alone."""
    start = SpawnProcess.start
    codes: list[int | None] = []

    def interrupted(process: SpawnProcess) -> None:
        start(process)
        os.kill(process.pid or 0, signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        process.join(0.5)
        codes.append(process.exitcode)

    monkeypatch.setattr(SpawnProcess, "start", interrupted)
    with pytest.raises(KeyboardInterrupt), interruptible():
        perform(tasks_in(tmp_path, "a", "b"), 2)
    assert codes == [None] and not multiprocessing.active_children()


def test_pool_can_be_used_again(tmp_path: Path) -> None:
    watch = Watch()
    with Pool(1, logging.WARNING, watch) as processes:
        for name in "ab":
            (record,) = processes.run(tasks_in(tmp_path, name))
            assert record.result == "made"
    assert watch.done == ["a", "b"]


def test_pool_does_not_ask_for_tasks_to_hear_of_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where a folder is watched: what a process sends is taken in at once."""
    monkeypatch.setattr(pool, "PAUSE", 3600.0)
    (task,) = tasks_in(tmp_path, "a")
    asked: list[int] = []

    def source() -> Iterator[Task | None]:
        yield task
        while True:
            asked.append(1)
            yield None

    with Pool(2, logging.INFO, Watch()) as processes:
        assert next(processes.run(source())).result == "made"
    assert len(asked) == 1


def work_with_graphics_card(*arguments: Any) -> None:
    """A worker that takes its device for a graphics card."""
    Device.kind = "GPU"
    worker.work(*arguments)


@pytest.mark.parametrize("card", [True, False])
def test_one_project_at_a_time_computes_on_a_graphics_card(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, card: bool
) -> None:
    told: list[tuple[str, str]] = []

    class Teller(Ear):
        def __init__(self, name: str) -> None:
            super().__init__()
            self.name = name

        def phase_began(self, name: str, total: int) -> None:
            told.append((self.name, name))

        def phase_ended(self, name: str, seconds: float) -> None:
            told.append((self.name, f"{name} done"))

    if card:
        monkeypatch.setattr(pool, "work", work_with_graphics_card)
    watch = Watch()
    watch.ears = {name: Teller(name) for name in "abcd"}
    tasks = tasks_in(tmp_path, *"abcd")
    (tmp_path / "c0000.tif").write_bytes(
        (tmp_path / "c0000.tif").read_bytes()[:90_000]
    )  # fails in the middle
    with Pool(2, logging.WARNING, watch) as processes:
        results = {record.project.stem: record.result for record in processes.run(tasks)}
    assert results == {"a": "made", "b": "made", "c": "failed", "d": "made"}
    computing = [(who, what) for who, what in told if what.split()[0] in ("flow", "align", "blend")]
    turns = [who for who, _ in groupby(computing, key=lambda event: event[0])]
    if card:
        assert sorted(turns) == sorted(set(turns)) and set(turns) >= set("abd")


@pytest.mark.parametrize("method", ["joint", "sequential"])
def test_every_phase_but_those_before_it_computes_has_a_turn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    class Turn:
        held = False

        def take(self) -> None:
            self.held = True

        def give_back(self) -> None:
            self.held = False

    class Watcher(Ear):
        def phase_began(self, name: str, total: int) -> None:
            (with_turn if turn.held else without).add(name)

    turn, with_turn, without = Turn(), set[str](), set[str]()
    monkeypatch.setattr(Device, "kind", "GPU")
    (todo,) = tasks_in(tmp_path, "a", settings=Settings(merge=method))
    assert perform_alone(todo, Watcher(), turn=turn).result == "made"
    assert without <= {"remap", "read"} and with_turn >= {"flow", "align", "blend"}
    assert not turn.held


def test_turn_of_a_dead_process_goes_to_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool, "work", work_until_blend)
    records, _ = perform(tasks_in(tmp_path, "doomed", "a", "b"), 2)
    assert records["a"].result == records["b"].result == "made"
    assert "ended with code 3" in records["doomed"].message and records["doomed"].attempts == ATTEMPTS


def work_until_blend(*arguments: Any) -> None:
    """A worker with a graphics card that dies at it, of one of the projects."""

    def die(listener: object, name: str, total: int) -> None:
        if name == "blend" and doomed[-1]:
            os._exit(3)

    doomed: list[bool] = []
    real = worker.perform

    def perform_or_die(task: Task, *rest: Any) -> Record:
        doomed.append(task.project.stem == "doomed")
        return real(task, *rest)

    worker.perform = perform_or_die
    worker._Sender.phase_began = die
    work_with_graphics_card(*arguments)

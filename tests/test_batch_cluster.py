"""A real scheduler and real workers on the loopback: results as on one machine, also where a worker dies."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from shoots import write_project
from test_batch_pool import posix, stand_in

from hugin_abflow import cli
from hugin_abflow.batch.cluster import elsewhere
from hugin_abflow.batch.task import Task
from hugin_abflow.errors import ExitCode

pytest.importorskip("distributed")


@pytest.fixture
def processes() -> Iterator[list[subprocess.Popen[bytes]]]:
    """A scheduler and its workers, which are ended with the test."""
    running: list[subprocess.Popen[bytes]] = []
    yield running
    for process in running:
        process.kill()
    for process in running:
        process.wait()


@pytest.fixture
def cluster(
    processes: list[subprocess.Popen[bytes]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[int], str]:
    """Starts a scheduler with so many workers, and gives its address."""
    scratch = tmp_path / "dask"
    scratch.mkdir()
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES", "2")
    file = scratch / "scheduler.json"

    def start(module: str, *arguments: object) -> None:
        command = [sys.executable, "-m", f"distributed.cli.{module}", *map(str, arguments)]
        log = (scratch / f"{len(processes)}.log").open("wb")
        processes.append(subprocess.Popen(command, stdout=log, stderr=log, cwd=scratch))

    def started(workers: int) -> str:
        local = "--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", file
        start("dask_scheduler", *local, "--port", 0)
        deadline = time.monotonic() + 60
        # the scheduler makes the file, and then fills it
        while not (file.exists() and file.read_text().endswith("}")) and time.monotonic() < deadline:
            time.sleep(0.05)
        for _ in range(workers):
            start("dask_worker", *local, "--no-nanny", "--nthreads", 1)
        return str(json.loads(file.read_text())["address"])

    return started


@posix
def test_project_of_a_dead_worker_is_stitched_by_another(
    cluster: Callable[[int], str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    shoot, layers, begun = tmp_path / "shoot", tmp_path / "layers", tmp_path / "begun"
    write_project(layers / "l.pto")
    for number in range(5):
        write_project(shoot / f"b{number}.pto")
    for name in ("left.png", "right.png"):
        (shoot / name).write_bytes(b"nobody looks at this")
    # in nona's place: tells whose project it is, takes a second, and hands out layers
    script = (
        f'echo "$PPID" >> "{begun}"; sleep 1\n'
        'while [ "$1" != -o ]; do shift; done\n'
        f'for n in 0000 0001; do cp "{layers}/l$n.tif" "$2$n.tif"; done'
    )
    stand_in(tmp_path, script, monkeypatch)
    arguments = [str(shoot), "--remap", "always"]
    assert cli.main([*arguments, "--jobs", "2"]) == 0
    alone = {path.name: path.read_bytes() for path in shoot.glob("b?.tif")}
    assert len(alone) == 5
    capsys.readouterr()
    begun.unlink()

    address, report = cluster(2), tmp_path / "report.json"
    command = [sys.executable, "-m", "hugin_abflow", *arguments, "--force", "--scheduler", address]
    child = subprocess.Popen(
        [*command, "--report", report], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 60
    while not begun.exists() and child.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(0.3)  # for the event that tells of it to leave the worker; nona takes a second
    dead = int(begun.read_text().split()[0])
    os.kill(dead, signal.SIGKILL)  # in the middle of its first project
    out, said = child.communicate(timeout=120)
    assert child.returncode == 0, said
    assert sorted(out.split()) == [str(shoot / f"b{number}.tif") for number in range(5)]
    assert {path.name: path.read_bytes() for path in shoot.glob("b?.tif")} == alone
    records = json.loads(report.read_text("utf-8"))["projects"]
    assert [Path(record["project"]).name for record in records] == [f"b{n}.pto" for n in range(5)]
    assert {record["result"] for record in records} == {"made"}
    assert sorted(record["attempts"] for record in records) == [1, 1, 1, 1, 2]
    assert all(set(record["phases"]) >= {"remap", "read", "blend"} for record in records)
    workers = [int(line) for line in begun.read_text().split()]
    assert workers.count(dead) == 1 and len(set(workers)) == 2 and len(workers) == 6
    assert "5/5" in said and "what went wrong" in said
    assert list(shoot.rglob(".abflow-*")) == []  # what the dead one left was removed

    again = subprocess.run(
        [*command[:-3], "--scheduler", address], capture_output=True, text=True, timeout=120
    )
    assert again.returncode == 0 and again.stderr.count("left as it is") == 5


@posix
def test_failures_come_back_as_on_one_machine(
    cluster: Callable[[int], str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a", "b"):
        write_project(tmp_path / f"{name}.pto")
    (tmp_path / "a0000.tif").write_bytes(b"no picture")
    assert cli.main([str(tmp_path), "--scheduler", cluster(1), "-v"]) == ExitCode.PARTIAL
    output = capsys.readouterr()
    assert output.out == f"{tmp_path / 'b.tif'}\n"
    assert "a0000.tif cannot be read" in output.err and "b.pto: blend: " in output.err
    assert "b.pto: canvas: 250 x 125" in output.err


def test_scheduler_without_workers_is_told_and_may_go(
    cluster: Callable[[int], str], processes: list[subprocess.Popen[bytes]], tmp_path: Path
) -> None:
    projects = [write_project(tmp_path / f"{name}.pto") for name in "ab"]
    command = [sys.executable, "-m", "hugin_abflow", *projects, "--scheduler", cluster(0)]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert child.stderr is not None
    assert "the scheduler has no workers; projects wait" in child.stderr.readline()
    processes[0].kill()
    _, said = child.communicate(timeout=60)
    assert child.returncode == ExitCode.ALL_FAILED and "Traceback" not in said, said
    assert said.count("error: ") == 2 and "a.pto: the scheduler is gone" in said


def test_scheduler_that_does_not_answer(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hugin_abflow.batch.cluster._TIMEOUT", "0.5s")
    address = "tcp://127.0.0.1:9"
    code = cli.main([str(write_project(tmp_path / "a.pto")), "--scheduler", address])
    assert code == ExitCode.CLUSTER
    said = capsys.readouterr().err
    assert f"no scheduler answers at {address}" in said and "docs/cluster.md" in said


@pytest.mark.parametrize("address", ["host", "tcp://host", "tcp://host:x", "tcp://[::1", "nonsense://x:1"])
def test_what_is_no_address_is_told_before_a_client_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, address: str
) -> None:
    """One that cannot begin waits for 20 s where it is collected."""
    monkeypatch.setattr("distributed.Client", lambda *arguments, **keywords: pytest.fail("a client"))
    assert cli.main([str(tmp_path / "a.pto"), "--scheduler", address]) == ExitCode.CLUSTER
    said = capsys.readouterr().err
    assert f"{address} is no scheduler's address (" in said and "tcp://host:8786" in said


def test_dask_that_is_not_installed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert cli.main([str(tmp_path / "a.pto"), "--scheduler", "tcp://x:1"]) == ExitCode.CLUSTER
    assert "pip install 'hugin-abflow[cluster]'" in capsys.readouterr().err


def test_names_of_files_do_not_depend_on_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "here0000.tif").touch()
    options = {"output": Path("o.tif"), "layers": [Path("l.tif")], "prefix": "here", "jpeg_quality": 3}
    sent = elsewhere(Task(Path("a.pto"), options))
    assert sent.project == tmp_path / "a.pto"
    assert sent.options == {
        "output": tmp_path / "o.tif",
        "layers": [tmp_path / "l.tif"],
        "prefix": str(tmp_path / "here"),
        "jpeg_quality": 3,
    }
    assert elsewhere(Task(Path("a.pto"), {"prefix": "there"})).options == {"prefix": "there"}

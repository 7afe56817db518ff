"""What goes wrong in the middle of a night: a clear error for one project, the others made, nothing lost or
half-written, and the next run goes on where this one ended."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pyopencl as cl
import pytest
import tifffile
from conftest import names_in, on_small_disk
from shoots import HEIGHT, WIDTH, write_project
from test_batch_pool import Watch, perform, posix, stand_in, tasks_in

from hugin_abflow import kept, opencl
from hugin_abflow.batch import pool, task, worker
from hugin_abflow.errors import ExitCode

linux = pytest.mark.skipif(sys.platform != "linux", reason="needs Linux's file systems")


@pytest.fixture
def shoot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of eight projects, b0 to b7. No temporary file is left in the end."""
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setenv("TMPDIR", str(scratch))
    folder = tmp_path / "shoot"
    for number in range(8):
        write_project(folder / f"b{number}.pto")
    yield folder
    assert names_in(scratch) == []
    assert temporary(folder) == []


def temporary(folder: Path) -> list[str]:
    return [str(path) for path in folder.rglob(".abflow-*")]


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "hugin_abflow", *map(str, arguments)]


def run(*arguments: object, before: Sequence[str] = ()) -> tuple[int, str]:
    done = subprocess.run([*before, *command(*arguments)], capture_output=True, text=True, timeout=120)
    assert "Traceback" not in done.stderr
    return done.returncode, done.stderr


def results(report: Path) -> dict[str, dict[str, Any]]:
    """Of a report, by the projects' names."""
    found = json.loads(report.read_text("utf-8"))["projects"]
    return {Path(record["project"]).stem: record for record in found}


def whole(folder: Path) -> list[str]:
    """The panoramas that are there, each of which is complete."""
    made = sorted(folder.glob("b?.tif"))
    assert all(tifffile.imread(path).shape == (HEIGHT, WIDTH, 4) for path in made)
    return [path.stem for path in made]


@linux
def test_each_fault_fails_its_project_alone(shoot: Path, tmp_path: Path) -> None:
    for ending in ("0000", "0001"):
        (shoot / f"b1{ending}.tif").unlink()  # its photos are not there either
    layer = shoot / "b20000.tif"
    layer.write_bytes(layer.read_bytes()[:60_000])
    (shoot / "b30000.tif").unlink()
    (shoot / "b30000.tif").symlink_to("/proc/self/mem")  # as on a disk with errors
    (shoot / "b4.pto").write_bytes(b"\x89PNG\r\n\x1a\n")
    report = tmp_path / "report.json"
    code, said = run(shoot, "--jobs", 2, "--report", report)
    assert code == ExitCode.PARTIAL
    found = results(report)
    for name, its_code, part in (
        ("b1", ExitCode.LAYERS_MISSING, "left.png (image 0) is not there"),
        ("b2", ExitCode.IMAGE_READ, "b20000.tif cannot be read"),
        ("b3", ExitCode.IMAGE_READ, "b30000.tif cannot be read"),
        ("b4", ExitCode.PROJECT, "b4.pto: found"),
    ):
        record = found.pop(name)
        assert (record["result"], record["exit_code"]) == ("failed", its_code)
        assert part in record["message"] and record["message"] in said
    assert {record["result"] for record in found.values()} == {"made"}
    assert whole(shoot) == sorted(found) == ["b0", "b5", "b6", "b7"]


@posix
def test_nona_that_is_killed_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(tmp_path, "kill -9 $$", monkeypatch)
    for name in ("left.png", "right.png"):
        (tmp_path / name).write_bytes(b"nobody looks at this")
    killed = tasks_in(tmp_path, "a", remap="always")
    records, _ = perform([*killed, *tasks_in(tmp_path, "b")], 1)
    assert records["a"].exit_code == ExitCode.NONA and "was killed (SIGKILL)" in records["a"].message
    assert records["a"].attempts == 1 and records["b"].result == "made"


def mounted(shoot: Path, size: str, script: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run the program on a part of `shoot` on a small disk, after the shell's `script`; list the disk."""
    disk = shoot.parent / "disk"
    disk.mkdir()
    words = shlex.join(command(disk, *arguments))
    copied = f"cp {shlex.quote(str(shoot))}/b[0-2]* ."
    done = on_small_disk(disk, size, f"{copied} && {script} {{ {words} >/dev/null; echo $?; ls -A; }}")
    assert "Traceback" not in done.stderr
    return done


def test_full_disk(shoot: Path) -> None:
    """Room for three projects and one panorama and a half."""
    room = sum(path.stat().st_size for path in shoot.glob("b[0-2]*")) + WIDTH * HEIGHT * 4
    done = mounted(shoot, f"{room // 1024 + 100}k", "", "--jobs", 1, "--compression", "none")
    code, *names = done.stdout.split()
    assert code == str(ExitCode.PARTIAL), done.stderr
    assert [name for name in names if name in ("b0.tif", "b1.tif", "b2.tif")] == ["b0.tif"]
    assert "b1.tif cannot be written: " in done.stderr and "is there room in the folder" in done.stderr
    assert [name for name in names if name.startswith(".abflow-")] == []


def test_folder_that_cannot_be_written(shoot: Path) -> None:
    done = mounted(shoot, "9m", "mount -o remount,ro . &&")
    code, *names = done.stdout.split()
    assert code == str(ExitCode.ALL_FAILED)
    assert done.stderr.count("hugin-abflow: error: ") == 3
    assert "Read-only file system" in done.stderr and "choose another folder" in done.stderr
    assert [name for name in names if "abflow" in name or name == "b0.tif"] == []


def lose_device(after: int) -> None:
    """Let the device fail once, after so many kernels."""
    real = cl.enqueue_nd_range_kernel
    left = [after]

    def enqueue(*arguments: Any) -> Any:
        left[0] -= 1
        if left[0] == 0:
            code = cl.status_code.DEVICE_NOT_AVAILABLE
            raise cl.RuntimeError(cl._cl._ErrorRecord("lost", code, "clEnqueueNDRangeKernel"))
        return real(*arguments)

    opencl.cl.enqueue_nd_range_kernel = enqueue


def work_with_lost_device(*arguments: Any) -> None:
    """A worker whose device is lost in its first project."""
    lose_device(after=4)
    worker.work(*arguments)


def test_lost_device_costs_an_attempt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool, "work", work_with_lost_device)
    records, watch = perform(tasks_in(tmp_path, "a", "b"), 1)
    assert {name: (r.result, r.attempts) for name, r in records.items()} == {
        "a": ("made", 2),
        "b": ("made", 1),
    }
    assert watch.begun == ["a", "a", "b"]
    assert temporary(tmp_path) == []


def test_lost_device_is_told_and_not_used_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opencl.cl, "enqueue_nd_range_kernel", opencl.cl.enqueue_nd_range_kernel)
    kept._kept.clear()
    first, second = tasks_in(tmp_path, "a", "b")
    lose_device(after=4)
    listener = Watch().began(first)
    record = task.perform(first, listener)
    assert record.exit_code == ExitCode.DEVICE and "the OpenCL device failed" in record.message
    assert temporary(tmp_path) == [] and not (tmp_path / "a.tif").exists()
    assert not kept._kept
    assert task.perform(second, listener).result == "made"
    assert len(kept._kept) == 1


def started(*arguments: object) -> subprocess.Popen[str]:
    """A run with its processes in a group of their own."""
    return subprocess.Popen(
        command(*arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )


def wait_for(folder: Path, count: int, child: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 60
    while len(list(folder.glob("b?.tif"))) < count and child.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)


def group_is_gone(number: int) -> bool:
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        try:
            os.killpg(number, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


@posix
@pytest.mark.parametrize("which", ["everything", "the pool"])
def test_killed_run_goes_on_where_it_was(shoot: Path, tmp_path: Path, which: str) -> None:
    child = started(shoot, "--jobs", 2)
    wait_for(shoot, 3, child)
    if which == "everything":
        os.killpg(child.pid, signal.SIGKILL)
    else:
        child.kill()  # its processes notice, and tidy up
    child.communicate(timeout=30)
    assert child.returncode == -signal.SIGKILL and group_is_gone(child.pid)
    before = whole(shoot)
    assert 3 <= len(before) < 8
    if which == "the pool":
        assert temporary(shoot) == []
    remembered = [name.split(".")[0] for name in names_in(shoot / ".abflow") if name[0] != "."]
    assert set(remembered) <= set(before) and len(remembered) >= 1
    times = {name: (shoot / f"{name}.tif").stat().st_mtime_ns for name in remembered}
    report = tmp_path / "report.json"
    assert run(shoot, "--jobs", 2, "--report", report)[0] == 0
    found = {name: record["result"] for name, record in results(report).items()}
    assert found == {f"b{n}": "skipped" if f"b{n}" in remembered else "made" for n in range(8)}
    assert whole(shoot) == [f"b{n}" for n in range(8)]
    assert {name: (shoot / f"{name}.tif").stat().st_mtime_ns for name in remembered} == times
    assert len({(shoot / f"b{n}.tif").read_bytes() for n in range(8)}) == 1  # all show the same


@posix
def test_control_c_reaches_all_and_leaves_nothing(shoot: Path, tmp_path: Path) -> None:
    """On a terminal every process of the run gets it."""
    report = tmp_path / "report.json"
    child = started(shoot, "--jobs", 2, "--report", report)
    wait_for(shoot, 3, child)  # so that one process has done two, and told of the first
    os.killpg(child.pid, signal.SIGINT)
    _, said = child.communicate(timeout=30)
    assert child.returncode == ExitCode.INTERRUPTED and "Traceback" not in said, said
    *_, rest, last = filter(None, said.splitlines())
    assert last == "hugin-abflow: interrupted"
    left = 8 - len(results(report))
    assert rest.endswith(f" {left} of 8 projects left; the same command goes on from here")
    assert group_is_gone(child.pid) and temporary(shoot) == []
    made = [name for name, record in results(report).items() if record["result"] == "made"]
    assert made and set(made) <= set(whole(shoot))


@posix
def test_a_process_that_an_interruption_does_not_end_is_ended_and_leaves_nothing(tmp_path: Path) -> None:
    """The pool is gone, and the interruption is lost, as one is that comes while an object is collected."""
    program = f"""
import multiprocessing, pathlib, queue, time
from hugin_abflow import scratch
from hugin_abflow.batch import worker
from hugin_abflow.signals import interruptible

worker.GRACE = 0.3
pipe, other = multiprocessing.Pipe()
with interruptible(), scratch.part_beside(pathlib.Path({str(tmp_path / "pano.tif")!r})) as part:
    print(part.exists(), flush=True)
    other.close()
    reader = worker.threading.Thread(target=worker._read, args=(pipe, queue.SimpleQueue(), None))
    while True:
        try:
            if reader.ident is None:
                reader.start()
            time.sleep(9)
        except KeyboardInterrupt:
            print("lost", flush=True)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout.split(), done.stderr) == (1, ["True", "lost"], "")
    assert names_in(tmp_path) == []


@linux
@pytest.mark.parametrize("locked", ["project", "folder"])
def test_a_project_that_must_not_be_read_stops_no_other(shoot: Path, locked: str) -> None:
    """Of whoever stitches; to root nothing is forbidden unless that is dropped."""
    bound = ["setpriv", "--bounding-set=-dac_override,-dac_read_search"] if os.geteuid() == 0 else []
    (shoot / "day").mkdir()
    own = write_project(shoot / "day" / "own.pto")
    forbidden = own if locked == "project" else own.parent
    forbidden.chmod(0)
    try:
        code, said = run(own, before=bound)
        assert code == ExitCode.PROJECT and f"{own}: cannot be read (Permission denied)" in said
        code, said = run(own, shoot / "b1.pto", before=bound)
    finally:
        forbidden.chmod(0o700)
    assert code == ExitCode.PARTIAL and f"{own}: cannot be read" in said
    assert (shoot / "b1.tif").is_file()

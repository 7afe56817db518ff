"""Temporary files and folders: what is in use stays, what nobody uses goes."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import age, names_in

from hugin_abflow import scratch
from hugin_abflow.errors import OutputError
from hugin_abflow.images import write_image
from hugin_abflow.programs import move_whole
from hugin_abflow.scratch import part_beside, sweep, work_folder, write_whole

# A process that makes both kinds, says so, and waits to be killed.
HOLDER = """
import sys, time
from pathlib import Path
from hugin_abflow.scratch import part_beside, work_folder
with part_beside(Path(sys.argv[1]) / "pano.tif") as part, work_folder() as folder:
    part.write_text("half"), (folder / "layer.tif").write_text("half")
    print("ready", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    return tmp_path


def hold(root: Path) -> subprocess.Popen[str]:
    child = subprocess.Popen([sys.executable, "-c", HOLDER, root], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None and child.stdout.readline() == "ready\n"
    return child


def test_nothing_is_left(root: Path) -> None:
    final = root / "pano.tif"
    with part_beside(final) as part, work_folder() as folder:
        assert part.parent == root and part.suffix == ".tif" and part.read_bytes() == b""
        assert folder.parent == root
        part.write_text("whole")
        part.replace(final)
    assert names_in(root) == ["pano.tif"] and final.read_text() == "whole"


def test_place_that_takes_no_folder_is_told(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (root / "file").write_bytes(b"")
    monkeypatch.setattr(scratch, "root", lambda: root / "file")
    with pytest.raises(OutputError, match=r"in .*file: .*TMPDIR chooses another place"), work_folder():
        pass


def test_what_fails_leaves_nothing(root: Path) -> None:
    with pytest.raises(ZeroDivisionError), part_beside(root / "a.tif", ".png") as part, work_folder():
        assert part.suffix == ".png"
        raise ZeroDivisionError
    assert names_in(root) == []


def test_what_is_in_use_stays_and_what_was_left_goes(root: Path) -> None:
    child = hold(root)
    before = names_in(root)
    assert len(before) == 2
    sweep(root)
    with part_beside(root / "other.tif"), work_folder():  # the next run sweeps
        pass
    assert names_in(root) == before
    child.kill()
    child.wait()
    assert names_in(root) == before  # nobody tidied up
    with work_folder():
        pass
    assert names_in(root) == []


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGSTOP")
def test_a_run_that_is_stopped_still_uses_its_files(root: Path) -> None:
    child = hold(root)
    child.send_signal(signal.SIGSTOP)
    before = names_in(root)
    sweep(root)
    assert names_in(root) == before
    child.kill()
    child.wait()


def test_leftovers_of_other_computers_go_after_a_week(root: Path) -> None:
    foreign = root / ".abflow-0123abcd-0123456789ab.tif"
    foreign.touch()
    sweep(root)
    assert foreign.exists()
    age(foreign, 8 * 24 * 3600)
    sweep(root)
    assert not foreign.exists()


def test_what_is_not_ours_stays(root: Path) -> None:
    """Names alike, a link, a folder that another computer is only just making."""
    (root / "target").touch()
    link = f".abflow-{scratch._HOST}-0123456789ab.tif"
    (root / link).symlink_to(root / "target")
    (root / ".abflow").mkdir()
    (root / ".abflow-notes.txt").touch()
    (root / "hugin-abflow-0123abcd-abcdefgh").mkdir()
    before = names_in(root)
    sweep(root)
    assert names_in(root) == before


def test_a_folder_without_its_lock_goes(root: Path) -> None:
    """Its process was killed while it was made, or removed."""
    left = root / f"hugin-abflow-{scratch._HOST}-0123456789ab"
    left.mkdir()
    (left / "layer.tif").touch()
    foreign = root / "hugin-abflow-0123abcd-0123456789ab"
    foreign.mkdir()
    age(foreign, 8 * 24 * 3600)
    sweep(root)
    assert names_in(root) == []


@pytest.mark.parametrize("step", ["made", "opened", "locked"])
def test_a_folder_that_is_swept_while_it_is_made_is_made_anew(
    root: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    steps: list[str] = []
    mkdir, lock = Path.mkdir, scratch._lock

    def swept(name: str) -> None:
        steps.append(name)
        if name == step and steps.count(name) == 1:
            with monkeypatch.context() as patch:
                patch.setattr(scratch, "_lock", lock)
                sweep(root)

    def make(path: Path, mode: int) -> None:
        mkdir(path, mode)
        swept("made")

    def locked(descriptor: int, wait: bool = True) -> bool:
        swept("opened")
        result = lock(descriptor, wait)
        swept("locked")
        return result

    monkeypatch.setattr(Path, "mkdir", make)
    monkeypatch.setattr(scratch, "_lock", locked)
    with work_folder() as folder:
        assert names_in(root) == [folder.name] and names_in(folder) == ["in use"]
        assert steps.count("made") == (1 if step == "locked" else 2)
    assert names_in(root) == []


@pytest.mark.skipif(sys.platform == "win32", reason="another mechanism there")
@pytest.mark.parametrize("late", ["maker", "sweeper"])
def test_a_lock_that_is_gone_is_nobodys(root: Path, monkeypatch: pytest.MonkeyPatch, late: str) -> None:
    """While one waits for the lock of a folder it goes, and another one, of the same name, is held."""
    lock, held = scratch._lock, list[int]()

    def waited(descriptor: int, wait: bool = True) -> bool:
        if wait == (late == "maker") and not held:
            (name,) = names_in(root)
            (root / name / "in use").unlink()
            held.append(os.open(root / name / "in use", os.O_CREAT | os.O_RDWR, 0o600))
            assert lock(held[0], False)
        return lock(descriptor, wait)

    monkeypatch.setattr(scratch, "_lock", waited)
    if late == "maker":
        with work_folder() as folder:
            assert len(names_in(root)) == 2 and (folder / "in use").exists()
        assert len(names_in(root)) == 1
    else:
        (root / f"hugin-abflow-{scratch._HOST}-0123456789ab").mkdir()
        sweep(root)
        assert len(names_in(root)) == 1
    os.close(held[0])
    sweep(root)
    assert names_in(root) == []


@pytest.mark.skipif(sys.platform == "win32", reason="another mechanism there")
def test_what_vanishes_is_not_made_anew_and_links_are_not_followed(root: Path, tmp_path: Path) -> None:
    part = root / f".abflow-{scratch._HOST}-0123456789ab.tif"
    part.touch()
    (entry,) = os.scandir(root)
    part.unlink()
    scratch._remove_abandoned(entry, part, scratch._HOST, part.unlink)
    assert names_in(root) == []
    folder = root / f"hugin-abflow-{scratch._HOST}-0123456789ab"
    folder.mkdir()
    (folder / "in use").symlink_to(root / "elsewhere")
    sweep(root)
    assert not (root / "elsewhere").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="another mechanism there")
def test_what_is_swept_is_locked_until_it_is_gone(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else it could go when somebody who has made it just now holds its lock."""
    left = root / f".abflow-{scratch._HOST}-0123456789ab.tif"
    left.touch()
    locked: list[bool] = []
    unlink = Path.unlink

    def look_and_unlink(path: Path, missing_ok: bool = False) -> None:
        descriptor = os.open(path, os.O_RDWR)
        locked.append(not scratch._lock(descriptor, wait=False))
        os.close(descriptor)
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", look_and_unlink)
    sweep(root)
    assert locked == [True] and not left.exists()


def test_control_c_before_a_file_is_used(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is there, but nobody knows of it but the process."""

    def interrupted(descriptor: int, wait: bool = True) -> bool:
        raise KeyboardInterrupt

    monkeypatch.setattr(scratch, "_lock", interrupted)
    with pytest.raises(KeyboardInterrupt), part_beside(root / "pano.tif"):
        pass
    with pytest.raises(KeyboardInterrupt), work_folder():
        pass
    assert len(names_in(root)) == 1
    scratch.tidy()  # when the process ends
    assert names_in(root) == []


def test_control_c_while_a_folder_is_removed(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(folder: Path, ignore_errors: bool) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", interrupted)
        with pytest.raises(KeyboardInterrupt), work_folder():
            pass
        with pytest.raises(KeyboardInterrupt):
            scratch.tidy()
    assert len(names_in(root)) == 1
    scratch.tidy()
    assert names_in(root) == []


def test_what_must_not_be_looked_at_keeps_nothing_else(root: Path) -> None:
    """As a folder that is closed, or a name that is too long, which root's system refuses, too."""
    with pytest.raises(OSError, match="File name too long"), part_beside(root / ("x" * 300) / "a.tif"):
        pass
    (left := root / "left").touch()
    scratch._ours.add(left)
    scratch.tidy()
    assert not left.exists() and not scratch._ours


@pytest.mark.skipif(sys.platform == "win32", reason="another mechanism there")
def test_file_system_without_locks_keeps_everything(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import fcntl

    def refuse(descriptor: int, how: int) -> None:
        raise OSError(37, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    left = root / f".abflow-{scratch._HOST}-0123456789ab.tif"
    left.touch()
    with part_beside(root / "a.tif") as part:
        assert part.exists() and left.exists()


def test_folder_that_cannot_be_listed_is_no_error(root: Path) -> None:
    sweep(root / "gone")


@pytest.mark.skipif(os.name == "nt", reason="it has other permissions")
@pytest.mark.parametrize("how", ["data", "panorama", "moved", "moved from elsewhere"])
def test_what_replaces_a_file_takes_its_permissions(
    root: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    final, fresh = root / "final.tif", root / "fresh.tif"
    for file in (final, fresh):
        if file == final:
            file.touch()
            file.chmod(0o600)
        if how == "data":
            write_whole(file, b"new")
        elif how == "panorama":
            write_image(file, np.zeros((2, 3, 4), np.uint8))
        else:
            (made := root / "made.tif").write_bytes(b"new")
            made.chmod(0o644)
            if how == "moved from elsewhere":  # a file cannot be renamed into another file system
                monkeypatch.setattr(Path, "replace", failing_once(Path.replace))
            move_whole(made, file, "")
        assert file.stat().st_size
    assert final.stat().st_mode & 0o777 == 0o600
    assert fresh.stat().st_mode & 0o777 == (0o666 & ~umask() if how != "moved" else 0o644)


def failing_once(function: Callable[..., Any]) -> Callable[..., Any]:
    calls: list[int] = []

    def call(*arguments: Any) -> Any:
        calls.append(1)
        if len(calls) == 1:
            raise OSError("another file system")
        return function(*arguments)

    return call


def umask() -> int:
    os.umask(mask := os.umask(0))
    return mask

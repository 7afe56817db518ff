"""The profile: what a trace viewer needs is there, true, and only where it was asked for."""

from __future__ import annotations

import errno
import itertools
import json
import os
import sys
import threading
import weakref
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, TextIO

import numpy as np
import pytest
from layer_files import write_layer

from hugin_abflow import cli, trace
from hugin_abflow.errors import ExitCode, OutputError
from hugin_abflow.opencl import Device

CANVAS = (200, 100)


def events(path: Path) -> list[dict[str, Any]]:
    """The spans of a trace, each with the name of its lane."""
    found = json.loads(path.read_text("utf-8"))["traceEvents"]
    lanes = {event["tid"]: event["args"]["name"] for event in found if event["ph"] == "M"}
    return [event | {"lane": lanes[event["tid"]]} for event in found if event["ph"] == "X"]


def end(event: dict[str, Any]) -> float:
    return float(event["ts"] + event["dur"])


def project(folder: Path) -> Path:
    """A project of two layers, which are there."""
    random = np.random.default_rng(1)
    for k, left in enumerate((0, 80)):
        pixels = random.integers(0, 256, (CANVAS[1], 120, 4), np.uint8)
        pixels[..., 3] = 255
        write_layer(folder / f"pano{k:04d}.tif", pixels, left, 0, CANVAS)
    path = folder / "pano.pto"
    path.write_text(f'p f0 w{CANVAS[0]} h{CANVAS[1]} v50 n"TIFF_m"\nm i0\n' + 'i w9 h9 f0 v50 n"a.jpg"\n' * 2)
    return path


def test_nothing_is_kept_unless_asked_for(tmp_path: Path) -> None:
    assert not trace.is_recording()
    with trace.recording(None), trace.span("a", trace.FILE):
        assert not trace.is_recording()
    with trace.recording(tmp_path / "trace.json"):
        assert trace.is_recording()
    assert not trace.is_recording()
    assert events(tmp_path / "trace.json") == []


def test_spans_of_threads_have_lanes_of_their_own(tmp_path: Path) -> None:
    def work() -> None:
        with trace.span("inside", trace.FILE, rows=7):
            pass

    with trace.recording(tmp_path / "trace.json"), trace.span("outside", trace.PHASE):
        thread = threading.Thread(target=work, name="decoder")
        thread.start()
        thread.join()
    inside, outside = events(tmp_path / "trace.json")
    assert (inside["name"], inside["cat"], inside["lane"]) == ("inside", "file", "decoder")
    assert inside["args"] == {"rows": 7}
    assert inside["tid"] != outside["tid"]
    assert outside["ts"] <= inside["ts"] <= end(inside) <= end(outside)


def test_each_event_that_is_taken_has_its_lanes_name() -> None:
    """Also while other threads, in lanes of their own, go on."""
    interval = sys.getswitchinterval()

    def add(thread: int) -> None:
        for number in range(2000):
            trace.add("a", trace.FILE, 0, 1, f"{thread} {number}")

    threads = [threading.Thread(target=add, args=(number,)) for number in range(2)]
    named: set[int] = set()
    sys.setswitchinterval(1e-6)
    try:
        with trace.collecting() as take:
            for thread in threads:
                thread.start()
            while any(thread.is_alive() for thread in threads):
                taken = take()
                named.update(event["tid"] for event in taken if event["ph"] == "M")
                assert named.issuperset(event["tid"] for event in taken)
    finally:
        sys.setswitchinterval(interval)
        for thread in threads:
            thread.join()


@pytest.mark.parametrize("record", [lambda: trace.add("a", trace.FILE, 0, 1, "b"), lambda: trace.extend([])])
def test_another_thread_may_end_the_recording_meanwhile(
    record: Callable[[], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the first line: tracing does here what a thread can do."""

    lines = itertools.count()

    def end_recording(frame: FrameType, event: str, _: object) -> Callable[..., Any]:
        if event == "line" and frame.f_globals is vars(trace) and next(lines):
            monkeypatch.setattr(trace, "_recorder", None)
        return end_recording

    before = sys.gettrace()
    with trace.collecting():
        sys.settrace(end_recording)
        try:
            record()
        finally:
            sys.settrace(before)
    assert next(lines) > 1


def test_what_fails_is_recorded_too(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="mine"), trace.recording(tmp_path / "t"), trace.span("a", trace.FILE):
        raise OSError("mine")
    assert [event["name"] for event in events(tmp_path / "t")] == ["a"]


def test_kernels_are_recorded_on_the_hosts_clock(tmp_path: Path) -> None:
    with trace.recording(tmp_path / "trace.json"):
        device = Device()
        with trace.span("all", trace.PHASE):
            mask = device.zeros((65, 129), np.uint8)
            pixels = device.zeros((65, 129, 4))
            grid = (129, 65, 0, 0)
            device.run("coefficient", "coefficient_mask", grid[:2], pixels, grid[:2] * 2, grid, grid, mask)
            mask.get()
    found = {event["name"]: event for event in events(tmp_path / "trace.json")}
    assert list(found) == ["coefficient_mask", "download", "all"]
    assert [event["cat"] for event in found.values()] == ["kernel", "transfer", "phase"]
    assert found["coefficient_mask"]["lane"] == found["download"]["lane"] == "device"
    slack = 1e3  # us: clocks are compared once
    assert found["all"]["ts"] - slack <= found["coefficient_mask"]["ts"]
    assert end(found["coefficient_mask"]) <= found["download"]["ts"] + slack
    assert end(found["download"]) <= end(found["all"]) + slack


def test_a_run_tells_phases_kernels_and_files(tmp_path: Path) -> None:
    profile = tmp_path / "profile.json"
    arguments = [str(project(tmp_path)), "--prefix", "pano", "-o", str(tmp_path / "out.tif")]
    assert cli.main([*arguments, "--profile", str(profile)]) == 0
    found = events(profile)
    phases = {event["name"]: event for event in found if event["cat"] == "phase"}
    assert list(phases) == ["read", "flow", "align", "blend"]
    for kind, name, phase in (
        ("kernel", "working_reduce", "read"),
        ("kernel", "flow_warp", "flow"),
        ("kernel", "blend_band", "blend"),
        ("file", "encode", "blend"),
    ):
        (*_, event) = (event for event in found if (event["cat"], event["name"]) == (kind, name))
        assert phases[phase]["ts"] <= event["ts"], name
    decoded = [event for event in found if event["name"] == "decode"]
    assert {event["args"]["file"] for event in decoded} == {"pano0000.tif", "pano0001.tif"}
    starts = sorted(event["ts"] for event in decoded)
    assert starts[0] < end(phases["read"]) < phases["blend"]["ts"] < starts[-1]


def test_a_profile_keeps_nothing_that_was_uploaded(tmp_path: Path) -> None:
    """Else all layers that are decoded stay in memory."""
    with trace.recording(tmp_path / "profile.json"):
        device = Device()
        host = np.zeros((4, 5), np.float32)
        watched = weakref.ref(host)
        device.upload(host)
        del host
        assert watched() is None


def test_a_profile_that_cannot_be_written_ends_the_run_before_it_starts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(OutputError, match="cannot be written"), trace.recording(tmp_path):
        raise AssertionError
    assert cli.main([str(project(tmp_path)), "--profile", str(tmp_path)]) == ExitCode.OUTPUT
    assert "name another" in capsys.readouterr().err
    assert not (tmp_path / "pano.tif").exists()


def test_half_a_profile_is_told_and_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fill(values: object, file: TextIO) -> None:
        file.write("half")
        raise OSError(errno.ENOSPC, "No space left")

    monkeypatch.setattr(json, "dump", fill)
    (tmp_path / "link").symlink_to(tmp_path / "trace.json")
    with pytest.raises(OutputError, match="No space left"), trace.recording(tmp_path / "link"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["link"]
    with pytest.raises(ValueError, match="mine"), trace.recording(tmp_path / "trace.json"):
        raise ValueError("mine")  # not hidden by the other
    assert [path.name for path in tmp_path.iterdir()] == ["link"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_profile_that_fails_as_it_is_closed_is_told(tmp_path: Path) -> None:
    """That is when a short one is written; what is no ordinary file stays."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    with pytest.raises(OutputError, match="pipe cannot be written"), trace.recording(pipe):
        os.close(reader)
    assert pipe.is_fifo()


def test_processes_side_by_side_have_one_trace(tmp_path: Path) -> None:
    profile = tmp_path / "profile.json"
    folders = [tmp_path / name for name in ("a", "b")]
    for folder in folders:
        folder.mkdir()
    assert cli.main([*(str(project(f)) for f in folders), "--jobs", "2", "--profile", str(profile)]) == 0
    found = events(profile)
    processes = {event["pid"] for event in found}
    assert len(processes) == 2 and os.getpid() not in processes
    for process in processes:
        own = [event for event in found if event["pid"] == process]
        (flow,) = (event for event in own if event["name"] == "flow")
        warped = [event for event in own if event["name"] == "flow_warp"]
        assert warped and all(flow["ts"] - 1e3 <= event["ts"] <= end(flow) + 1e3 for event in warped)

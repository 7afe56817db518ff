"""The report: its fields are the documented ones, and it is whole or not there."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
from shoots import HEIGHT, WIDTH, textured, write_project

from hugin_abflow import cli
from hugin_abflow.batch import run
from hugin_abflow.batch.record import Record, write_json
from hugin_abflow.batch.report import SCHEMA, summary, write_report
from hugin_abflow.errors import ClusterError, ExitCode, OutputError

PAGE = (Path(__file__).resolve().parent.parent / "docs" / "report.md").read_text("utf-8")


def documented(heading: str) -> set[str]:
    """The fields in the table of a section of docs/report.md."""
    section = PAGE.split(f"## {heading}\n")[1].split("\n## ")[0]
    return set(re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE))


def test_every_field_is_documented() -> None:
    report = summary([Record(Path("a.pto"))], ["a.pto"])
    assert set(report) == documented("The run")
    assert set(report["projects"][0]) == documented("A project")
    assert f"`schema` is {SCHEMA}" in PAGE


def test_overlaps_are_in_the_report(tmp_path: Path) -> None:
    """A picture beside itself, moved by three pixels."""
    project = write_project(tmp_path / "a.pto")
    path = tmp_path / "a0001.tif"
    layer = tifffile.imread(path)
    layer[..., :3] = np.roll(textured(HEIGHT, WIDTH), 3, axis=1) * (layer[..., 3:] > 0)
    tifffile.imwrite(path, layer, photometric="rgb", extrasamples=["unassalpha"])
    for arguments in ([], ["--no-flow"]):
        report = tmp_path / "r.json"
        assert cli.main([str(project), "--report", str(report), *arguments]) == 0
        (overlap,) = json.loads(report.read_text("utf-8"))["projects"][0]["overlaps"]
        assert sorted(overlap["layers"]) == ["a0000.tif", "a0001.tif"]
        if arguments:
            assert set(overlap) == {"layers", "one_layer"} and overlap["one_layer"] == 1
        else:
            assert set(overlap) == documented("An overlap")
            # lengths are angles, in pixels of the equator: at 45 degrees the shift is shorter
            assert overlap["parallax_median"] == pytest.approx(3 * np.sqrt(0.5), abs=0.2)
            assert overlap["parallax_max"] == pytest.approx(3, abs=0.5)
            assert 0.7 < overlap["consistent"] <= 1
            assert 0 <= overlap["one_layer"] <= 0.2


def test_report_of_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    projects = [write_project(tmp_path / f"{name}.pto") for name in "ab"]
    (tmp_path / "b0001.tif").unlink()
    (tmp_path / "b0000.tif").write_bytes(b"no picture")
    report = tmp_path / "report.json"
    arguments = [*map(str, projects), "--remap", "never", "--report", str(report)]
    assert cli.main(arguments) == ExitCode.PARTIAL
    written = json.loads(report.read_text("utf-8"))
    assert (written["schema"], written["made"], written["failed"], written["skipped"]) == (SCHEMA, 1, 1, 0)
    assert written["arguments"] == arguments
    made, failed = written["projects"]
    assert made["project"] == str(projects[0]) and made["result"] == "made" and made["exit_code"] == 0
    assert made["outputs"] == [
        {"file": str(tmp_path / "a.tif"), "bytes": (tmp_path / "a.tif").stat().st_size}
    ]
    assert made["settings"]["merge"] == "joint" and made["settings"]["remap"] == "never"
    assert made["versions"]["hugin-abflow"] and made["device"] and made["memory"] > 0
    assert set(made["phases"]) == {"read", "flow", "align", "blend"}
    assert failed["result"] == "failed" and "b0000.tif" in failed["message"]
    assert failed["exit_code"] == ExitCode.IMAGE_READ and failed["outputs"] == []
    assert failed["warnings"] == ["no layer of image 1 (right.png): it is left out"]
    assert "b0000.tif" in capsys.readouterr().err


def test_report_that_cannot_be_written_ends_the_run_before_it_starts(
    replace: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    replace(lambda path, **keywords: path.with_suffix(".tif"))
    assert cli.main(["a.pto", "--report", str(tmp_path / "no" / "r.json")]) == ExitCode.OUTPUT
    output = capsys.readouterr()
    assert output.out == "" and "--report" in output.err


def test_report_that_cannot_be_written_hides_no_other_end(
    replace: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = tmp_path / "folder" / "r.json"
    report.parent.mkdir()

    def interrupted(path: Path, **_: object) -> None:
        shutil.rmtree(report.parent)
        raise KeyboardInterrupt

    replace(interrupted)
    assert cli.main(["a.pto", "--report", str(report)]) == ExitCode.INTERRUPTED
    assert "--report" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ([], "2 of 3 projects left; the same command goes on from here"),
        (["--force"], "2 of 3 projects left; with --force the same command begins anew"),
        (["--quiet"], ""),
    ],
)
def test_what_is_left_of_a_run_is_told(
    replace: Callable[..., None], capsys: pytest.CaptureFixture[str], arguments: list[str], told: str
) -> None:
    """Behind the table."""

    def interrupted(path: Path, **_: object) -> Path:
        if path.stem == "b":
            raise KeyboardInterrupt
        return path.with_suffix(".tif")

    replace(interrupted)
    assert cli.main(["a.pto", "b.pto", "c.pto", *arguments]) == ExitCode.INTERRUPTED
    said = capsys.readouterr().err.removesuffix("hugin-abflow: interrupted\n").strip()
    assert said.endswith(told) and ("left" in said) == bool(told)
    assert cli.main(["b.pto", "--resume"]) == ExitCode.INTERRUPTED
    assert capsys.readouterr().err.strip() == "hugin-abflow: interrupted"


def test_what_is_left_after_an_error_is_not_what_the_same_command_makes(
    replace: Callable[..., None], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The error says what to do."""

    def fail(*_: object) -> None:
        raise ClusterError("no scheduler answers; start one")

    replace(lambda path, **keywords: path.with_suffix(".tif"))
    monkeypatch.setattr(run, "_performers", fail)
    assert cli.main(["a.pto", "b.pto"]) == ExitCode.CLUSTER
    rest, error = capsys.readouterr().err.splitlines()
    assert rest.endswith("2 of 2 projects left") and error.endswith("no scheduler answers; start one")


def test_report_is_replaced_whole(tmp_path: Path) -> None:
    report = tmp_path / "r.json"
    report.write_text("older")
    write_report(report, [Record(Path("caf\udce9 Küste.pto"))], [])
    text = report.read_text("utf-8")
    assert "Küste" in text and json.loads(text)["projects"][0]["project"] == "caf\udce9 Küste.pto"
    assert [path.name for path in tmp_path.iterdir()] == ["r.json"]
    report.unlink()
    report.mkdir()
    with pytest.raises(OutputError, match="--report"):
        write_report(report, [], [])
    assert [path.name for path in tmp_path.iterdir()] == ["r.json"]


def test_report_follows_links(tmp_path: Path) -> None:
    (tmp_path / "else").mkdir()
    link, report = tmp_path / "link.json", tmp_path / "else" / "r.json"
    link.symlink_to(report)
    for _ in range(2):  # of a new file, and of one that is replaced
        write_report(link, [Record(Path("a.pto"))], [])
        assert json.loads(report.read_text("utf-8"))["projects"] and link.is_symlink()
    assert [path.name for path in report.parent.iterdir()] == ["r.json"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_gets_one_report(replace: Callable[..., None], tmp_path: Path) -> None:
    replace(lambda path, **keywords: path.with_suffix(".tif"))
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    try:
        assert cli.main([str(tmp_path / "a.pto"), "--report", str(tmp_path / "link")]) == 0
        assert len(json.loads(os.read(reader, 1 << 16))["projects"]) == 1
    finally:
        os.close(reader)
    assert (tmp_path / "pipe").is_fifo() and (tmp_path / "link").is_symlink()


@pytest.mark.skipif(not Path("/dev/stdout").exists(), reason="needs a name of stdout")
def test_stdout_gets_one_report_also_where_it_is_a_file(tmp_path: Path) -> None:
    """It is not replaced, and keeps the panorama's name; a trace comes behind. Nothing else is there."""
    write_project(tmp_path / "a.pto")
    (tmp_path / "link").symlink_to("/dev/stdout")
    words = ["a.pto", "--no-flow", "--report", "link", "--profile", "/dev/fd/1"]
    command = [sys.executable, "-m", "hugin_abflow", *words]
    folder = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parent.parent)}
    with (tmp_path / "out").open("w") as out:
        subprocess.run(command, check=True, cwd=tmp_path, env=folder, stdout=out)
        out.write("next")  # as of a script's next command
    name, _, rest = (tmp_path / "out").read_text().partition("\n")
    report, end = json.JSONDecoder().raw_decode(rest)
    assert Path(name).name == "a.tif" and report["made"] == 1
    assert json.loads(rest[end:].removesuffix("next"))["traceEvents"] and rest.endswith("next")
    assert {path.name for path in tmp_path.iterdir()} == {
        "a.pto", "a0000.tif", "a0001.tif", "a.tif", "link", "out"
    }  # fmt: skip


def test_what_is_remembered_goes_through_no_links(tmp_path: Path) -> None:
    """As into a photo; nobody names that file, as he names a report."""
    (tmp_path / "photo.jpg").write_text("photo")
    (tmp_path / "pano.pto.json").symlink_to("photo.jpg")
    write_json(tmp_path / "pano.pto.json", {"schema": 1})
    assert (tmp_path / "photo.jpg").read_text() == "photo"
    assert json.loads((tmp_path / "pano.pto.json").read_text()) == {"schema": 1}

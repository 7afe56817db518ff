"""Options from a file: which file, what it may say, and that the command line has the last word."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hugin_abflow import cli
from hugin_abflow.errors import ExitCode
from hugin_abflow.settings import Settings

Calls = dict[str, dict[str, Any]]


@pytest.fixture
def shoot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("a.pto", "day/b.pto", "day/late/c.pto"):
        (tmp_path / "shoot" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "shoot" / name).touch()
    monkeypatch.chdir(tmp_path)
    return tmp_path / "shoot"


@pytest.fixture
def calls(replace: Callable[..., None]) -> Calls:
    """What each project is stitched with."""
    seen: Calls = {}

    def merge(path: Path, **keywords: Any) -> Path:
        seen[path.stem] = keywords
        return path.with_suffix(".tif")

    replace(merge)
    return seen


def test_options_of_a_file_are_those_of_the_command_line(calls: Calls, shoot: Path) -> None:
    (shoot / "abflow.toml").write_text(
        'flow-quality = "best"\nseam = "off"\nno-flow = true\nsoftmax-sharpness = 3\njpeg-quality = 80\n'
        'prefix = "room"\nkeep-layers = true\n'
    )
    assert cli.main(["shoot/a.pto"]) == 0
    assert calls["a"]["settings"] == Settings(
        flow_quality="best", seam=False, flow=False, softmax_sharpness=3.0
    )
    assert [calls["a"][name] for name in ("jpeg_quality", "prefix", "keep_layers")] == [80, "room", True]


def test_command_line_has_the_last_word(calls: Calls, shoot: Path) -> None:
    (shoot / "abflow.toml").write_text('flow-quality = "best"\njpeg-quality = 80')
    assert cli.main(["shoot/a.pto", "--flow-quality", "normal"]) == 0
    assert calls["a"]["settings"].flow_quality == "normal" and calls["a"]["jpeg_quality"] == 80


@pytest.mark.parametrize(
    ("text", "arguments", "expected"),
    [
        ("quiet = true", ["-v"], {}),
        ("verbose = true", ["-q"], {}),
        ("resume = true", ["--force"], {}),
        ("force = true", ["--resume"], {}),
        ('prefix = "d"', ["--layers", "x.tif"], {"prefix": None, "layers": [Path("x.tif")]}),
        ('layers = ["x.tif"]', ["--prefix", "d"], {"prefix": "d", "layers": None}),
        ('prefix = "d"', ["--remap", "always"], {"prefix": None, "remap": "always"}),
        ('remap = "always"', ["--prefix", "d"], {"prefix": "d", "remap": "auto"}),
        ('prefix = "d"', ["--remap", "never"], {"prefix": "d", "remap": "never"}),
        ("keep-layers = true", ["--no-keep-layers"], {"keep_layers": False}),
        ("no-metadata = true", ["--metadata"], {"metadata": True}),
        ("no-flow = true", ["--flow"], {"settings": Settings()}),
    ],
)
def test_what_the_command_line_says_against_it_counts(
    calls: Calls, shoot: Path, text: str, arguments: list[str], expected: dict[str, Any]
) -> None:
    (shoot / "abflow.toml").write_text(text)
    assert cli.main(["shoot/a.pto", *arguments]) == 0
    assert {name: calls["a"][name] for name in expected} == expected


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["-q", "-v"], "-q and -v contradict"),
        (["--resume", "--force"], "--resume and --force contradict"),
        (["--prefix", "d", "--layers", "x.tif"], "--prefix and --layers both name the layers"),
    ],
)
def test_rivals_on_the_command_line_are_refused(
    calls: Calls, shoot: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    (shoot / "abflow.toml").write_text("threads = 1")  # says nothing against them
    assert cli.main(["shoot/a.pto", *arguments]) == ExitCode.USAGE
    assert capsys.readouterr().err.startswith(f"hugin-abflow: error: {said}") and calls == {}


def test_a_file_that_begins_with_a_byte_order_mark_is_read(calls: Calls, shoot: Path) -> None:
    """As Windows' editor saves it."""
    (shoot / "abflow.toml").write_text("jpeg-quality = 80", encoding="utf-8-sig")
    assert cli.main(["shoot/a.pto"]) == 0
    assert calls["a"]["jpeg_quality"] == 80


def test_each_project_takes_the_nearest_file_up_to_the_named_folder(calls: Calls, shoot: Path) -> None:
    (shoot.parent / "abflow.toml").write_text("jpeg-quality = 1")
    (shoot / "abflow.toml").write_text("jpeg-quality = 10")
    (shoot / "day" / "abflow.toml").write_text("jpeg-quality = 20")
    assert cli.main(["--recursive", "shoot"]) == 0
    assert {name: call["jpeg_quality"] for name, call in calls.items()} == {"a": 10, "b": 20, "c": 20}
    (shoot / "day" / "abflow.toml").unlink()
    assert cli.main(["shoot/a.pto", "shoot/day/late"]) == 0
    assert {name: calls[name]["jpeg_quality"] for name in "ac"} == {"a": 10, "c": None}
    assert cli.main(["--recursive", "shoot", "--config", "abflow.toml"]) == 0
    assert {call["jpeg_quality"] for call in calls.values()} == {1}


def test_files_are_meant_from_the_folder_of_the_settings(calls: Calls, shoot: Path) -> None:
    (shoot / "abflow.toml").write_text('output = "../out.png"\nlayers = ["l.tif", "/m.tif"]\nlog = "log.txt"')
    assert cli.main(["shoot/a.pto"]) == 0
    assert calls["a"]["output"] == shoot / "../out.png"
    assert calls["a"]["layers"] == [shoot / "l.tif", Path("/m.tif")]
    assert "a.pto" in (shoot / "log.txt").read_text()


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ('flow-qualty = "best"', ["'flow-qualty'", "did you mean 'flow-quality'?"]),
        ('flow_quality = "best"', ["did you mean 'flow-quality'?"]),
        ('"--seam" = "off"', ["did you mean 'seam'?"]),
        ('o = "a.tif"', ["'o'", "did you mean 'output'?"]),
        ('"-v" = true', ["did you mean 'verbose'?"]),
        ("zzz = 1", ["'zzz'", "--help"]),
        ("[blending]\nseam = 1", ["no sections; give options without [blending] above"]),
        ('[seam]\nflow-quality = "best"', ["no sections; give options without [seam] above"]),
        ("help = true", ["'help'", "for the command line alone"]),
        ('config = "other.toml"', ["'config' for such files; it is for the command line alone"]),
        ('watch = "."', ["'watch' for such files; it is for the command line alone"]),
        ("list-devices = true", ["'list-devices'", "for the command line alone"]),
        ("seam = false", ['seam is false; give "auto" or "off"']),
        ('seam = ""', ['seam is empty; give "auto" or "off", or leave it out']),
        ("flow-quality = 1", ['flow-quality is 1; give "fast", "normal" or "best"']),
        ('compression = ""', ['compression is empty; give some text in quotes ("..."), or leave it out']),
        ('keep-layers = "yes"', ["keep-layers is 'yes'", "true or false"]),
        ("jobs = 2.5", ["jobs is 2.5", "a whole number"]),
        ("jobs = true", ["jobs is true", "a whole number"]),
        ('softmax-sharpness = "3"', ["a number"]),
        ('layers = "a.tif"', ["a list of texts"]),
        ("layers = [true]", ["layers is [true]; give a list of texts"]),
        ('layers = ["a", {b = 1.5}]', ["layers is ['a', {b = 1.5}]; give"]),
        ("jobs = 2026-11-30", ["jobs is 2026-11-30; give a whole number"]),
        ('seam = "maybe"', ["--seam", "maybe"]),
        ('prefix = ""', ["prefix is empty", "some text"]),
        ('layers = ["a.tif", ""]', ["a list of texts"]),
        ("jpeg-quality = 101", ["--jpeg-quality", "101"]),
        ("softmax-sharpness = nan", ["'--softmax-sharpness': nan; choose a value from 0 to 1000"]),
        ("seam = off", ["no TOML", "line 1"]),
        (f"jobs = {'9' * 5000}", ["cannot be read", "digits", "delete that"]),
        (f"jobs = 0x{'9' * 5000}", ["jobs is a number of more than 64 bits; give a whole number"]),
        (f"layers = {'[' * 5000}", ["cannot be read", "nested lists", "delete that"]),
        ("resume = true\nforce = true", ["abflow.toml: --resume and --force contradict"]),
    ],
)
def test_mistake_is_told_with_the_file(
    calls: Calls, shoot: Path, capsys: pytest.CaptureFixture[str], text: str, parts: list[str]
) -> None:
    (shoot / "abflow.toml").write_text(text)
    assert cli.main(["shoot/a.pto"]) == ExitCode.USAGE
    said = capsys.readouterr().err
    assert said.startswith("hugin-abflow: error: ") and all(part in said for part in parts), said
    assert "abflow.toml" in said
    assert calls == {}


def test_file_that_is_not_there(calls: Calls, shoot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["shoot/a.pto", "--config", "gone.toml"]) == ExitCode.USAGE
    assert "gone.toml cannot be read" in capsys.readouterr().err and calls == {}


@pytest.mark.parametrize("arguments", [["shoot"], ["shoot", "--config", "shoot/abflow.toml"]])
@pytest.mark.parametrize("option", ["output", "layers"])
def test_files_of_one_project_are_refused_for_several(
    calls: Calls, shoot: Path, capsys: pytest.CaptureFixture[str], option: str, arguments: list[str]
) -> None:
    """With the name of the file that says so; or of the option, if it is the command line's."""
    (shoot / "b.pto").touch()
    (shoot / "abflow.toml").write_text('output = "out.tif"' if option == "output" else 'layers = ["l.tif"]')
    assert cli.main(arguments) == ExitCode.USAGE
    assert f"shoot/abflow.toml: {option} is for one project, but there are 2" in capsys.readouterr().err
    assert cli.main([*arguments, f"--{option}", "other.tif", "--remap=auto"]) == ExitCode.USAGE
    assert "abflow.toml" not in capsys.readouterr().err and calls == {}


@pytest.mark.skipif(os.name == "nt", reason="links need rights there")
@pytest.mark.parametrize(
    ("target", "why"),
    [("gone.toml", "No such file"), ("abflow.toml", "Too many levels"), (None, "Is a directory")],
)
def test_file_that_cannot_be_read_is_told(
    calls: Calls, shoot: Path, capsys: pytest.CaptureFixture[str], target: str | None, why: str
) -> None:
    """Such as a link that leads nowhere, for which the run went on without settings."""
    if target:
        (shoot / "abflow.toml").symlink_to(target)
    else:
        (shoot / "abflow.toml").mkdir()
    assert cli.main(["shoot/a.pto"]) == ExitCode.USAGE
    assert f"shoot/abflow.toml cannot be read: {why}" in capsys.readouterr().err and calls == {}
    assert cli.main(["shoot/a.pto", "--config", os.devnull]) == ExitCode.OK


def test_what_concerns_the_whole_run_is_said_in_one_place(
    calls: Calls, shoot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (shoot / "abflow.toml").write_text("quiet = true\nrecursive = true")
    assert cli.main(["shoot"]) == 0
    assert sorted(calls) == ["a", "b", "c"] and capsys.readouterr() == ("", "")
    (shoot / "day" / "abflow.toml").write_text("jobs = 2")
    assert cli.main(["shoot"]) == ExitCode.USAGE
    assert "day/abflow.toml: jobs is for the whole run" in capsys.readouterr().err


def test_printed_options_can_be_read_again(
    calls: Calls, shoot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (shoot / "abflow.toml").write_text('seam = "off"')
    assert cli.main(["shoot", "--print-config", "--flow-quality", "best", "--jobs", "2"]) == 0
    text = capsys.readouterr().out
    assert text.startswith(f"# {shoot}/abflow.toml\n# for shoot/a.pto\n") and calls == {}
    options = tomllib.loads(text)
    assert (options["seam"], options["flow-quality"], options["jobs"]) == ("off", "best", 2)
    assert "output" not in options and "config" not in options and options["softmax-sharpness"] == 10.0
    (shoot / "abflow.toml").write_text(text)
    assert cli.main(["shoot", "--print-config"]) == 0
    assert tomllib.loads(capsys.readouterr().out) == options


def test_printed_options_without_a_project(
    shoot: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["--print-config"]) == 0
    assert tomllib.loads(capsys.readouterr().out)["merge"] == "joint"
    monkeypatch.chdir(shoot)
    (shoot / "abflow.toml").write_text('merge = "sequential"')
    assert cli.main(["--print-config"]) == 0
    assert tomllib.loads(capsys.readouterr().out)["merge"] == "sequential"

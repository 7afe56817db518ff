"""The command line by itself: options, messages, exit codes, signals. `merge_project` is replaced here;
tests/test_cli_end_to_end.py runs the real one."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Callable
from dataclasses import fields
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hugin_abflow import cli, errors
from hugin_abflow.errors import AbflowError, ExitCode, OutputError
from hugin_abflow.settings import Settings

Calls = list[tuple[Path, dict[str, Any]]]
Replace = Callable[[Callable[..., Path]], None]


@pytest.fixture
def calls(replace: Replace) -> Calls:
    """What `merge_project` is called with, while every project succeeds."""
    seen: Calls = []

    def record(path: Path, **keywords: Any) -> Path:
        seen.append((path, keywords))
        return path.with_suffix(".tif")

    replace(record)
    return seen


def failing_for(name: str, error: BaseException) -> Callable[..., Path]:
    """A `merge_project` that raises `error` for the project `name`."""

    def merge(path: Path, **keywords: Any) -> Path:
        if path.name == name:
            raise error
        return path.with_suffix(".tif")

    return merge


# Options


def test_defaults_are_those_of_settings(calls: Calls) -> None:
    assert cli.main(["a.pto"]) == 0
    ((path, keywords),) = calls
    assert path == Path("a.pto")
    assert keywords.pop("settings") == Settings()
    assert callable(keywords.pop("progress")) and callable(keywords.pop("open_device"))
    assert keywords.pop("leave") == []
    assert keywords == {
        "output": None,
        "prefix": None,
        "layers": None,
        "remap": "auto",
        "keep_layers": False,
        "compression": None,
        "jpeg_quality": None,
        "metadata": True,
    }


@pytest.mark.parametrize(
    ("arguments", "name", "value"),
    [
        (["-o", "x.jpg"], "output", Path("x.jpg")),
        (["--output=x.jpg"], "output", Path("x.jpg")),
        (["--prefix", "room"], "prefix", "room"),
        (["--remap", "never"], "remap", "never"),
        (["--keep-layers"], "keep_layers", True),
        (["--compression", "DEFLATE"], "compression", "DEFLATE"),
        (["--jpeg-quality", "92"], "jpeg_quality", 92),
        (["--layers", "b.tif", "a.tif"], "layers", [Path("b.tif"), Path("a.tif")]),
    ],
)
def test_option_reaches_merge_project(calls: Calls, arguments: list[str], name: str, value: object) -> None:
    assert cli.main(["a.pto", *arguments]) == 0
    assert calls[0][1][name] == value


@pytest.mark.parametrize(
    ("arguments", "name", "value"),
    [
        (["--merge", "sequential"], "merge", "sequential"),
        (["--exposure", "off"], "exposure", False),
        (["--guides", "off"], "guides", False),
        (["--seam", "off"], "seam", False),
        (["--clones", "off"], "clones", False),
        (["--softmax-sharpness", "3.5"], "softmax_sharpness", 3.5),
        (["--flow-magnitude", "0"], "flow_magnitude", 0.0),
        (["--no-flow"], "flow", False),
        (["--flow-quality", "best"], "flow_quality", "best"),
        (["--device", "0"], "device", "0"),
        (["--max-memory", "1.5G"], "max_memory", 3 << 29),
        (["--threads", "2"], "threads", 2),
    ],
)
def test_option_changes_one_setting(calls: Calls, arguments: list[str], name: str, value: object) -> None:
    assert cli.main(["a.pto", *arguments]) == 0
    settings = calls[0][1]["settings"]
    changed = {f.name: getattr(settings, f.name) for f in fields(Settings)}
    assert changed == {f.name: getattr(Settings(), f.name) for f in fields(Settings)} | {name: value}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            "--no-flow --large-motion on --flow-magnitude 5",
            "--large-motion on, --flow-magnitude, since --no-flow",
        ),
        ("--no-flow --large-motion off --guides off --clones off --flow-quality fast", ""),
        ("--large-motion on --flow-magnitude 5", ""),
        ("--keep-layers --prefix a", "--keep-layers, since --prefix"),
        ("--keep-layers --layers a.tif", "--keep-layers, since --layers"),
        ("--keep-layers --remap never", "--keep-layers, since --remap never"),
        ("--keep-layers --remap always", ""),
        ("--jpeg-quality 80 -o a.png", "--jpeg-quality, since a.png is no JPEG"),
        ("--jpeg-quality 80 -o a.tif --compression JPEG", ""),
        ("--jpeg-quality 80 -o a.JPG", ""),
        ("--jpeg-quality 80", ""),
        ("--scheduler tcp://a:1 --jobs 2", "--jobs, since --scheduler"),
    ],
)
@pytest.mark.parametrize(
    "also", [[], ["-q"], ["b.pto"], ["--dry-run"]], ids=["one", "quiet", "several", "shown"]
)
def test_options_of_no_effect_are_warned_of_once(
    calls: Calls, arguments: str, said: str, also: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    if (also == ["b.pto"] and "-o" in arguments) or "--layers" in arguments:
        also = []  # these are for one project
    cli.main(["a.pto", *also, *arguments.split()])
    warnings = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    assert len(warnings) == bool(said)
    assert not said or f"hugin-abflow: warning: of no effect: {said}" in warnings[0]


def test_a_folder_for_temporary_files_that_is_not_there_is_told_once(
    calls: Calls, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for named in (tmp_path, ""):
        monkeypatch.setenv("TMPDIR", str(named))
        assert cli.main(["a.pto"]) == 0
        assert "TMPDIR" not in capsys.readouterr().err
    monkeypatch.setenv("TMPDIR", str(tmp_path / "none"))
    for arguments in (["a.pto"], ["a.pto", "b.pto", "-q"]):
        assert cli.main(arguments) == 0
        (line,) = [line for line in capsys.readouterr().err.splitlines() if "TMPDIR" in line]
        assert f"warning: TMPDIR is {tmp_path / 'none'}, and no such folder is there: " in line


@pytest.mark.parametrize(
    ("given", "layers", "projects"),
    [
        ("p.pto --layers a.tif b.tif c.tif", "a.tif b.tif c.tif", "p.pto"),
        ("--layers a.tif b.tif p.pto", "a.tif b.tif", "p.pto"),
        ("--layers a.tif b.tif P.PTO", "a.tif b.tif", "P.PTO"),
        ("--layers=a.tif b.tif p.pto", "a.tif b.tif", "p.pto"),
        ("--layers a.tif --layers b.tif p.pto", "a.tif b.tif", "p.pto"),
        ("--layers a.tif b.tif -q p.pto", "a.tif b.tif", "p.pto"),
        ("--layers a.tif b.tif --remap never p", "a.tif b.tif", "p"),
        ("--layers a.tif b.tif -- huginpto_1a2b", "a.tif b.tif", "huginpto_1a2b"),
        ("huginpto_1a2b --layers a.tif", "a.tif", "huginpto_1a2b"),
        ("-q -- --layers", "", "--layers"),
    ],
)
def test_layers_takes_several_files(calls: Calls, given: str, layers: str, projects: str) -> None:
    assert cli.main(given.split()) == 0
    assert [str(path) for path, _ in calls] == projects.split()
    assert [str(layer) for layer in calls[0][1]["layers"] or []] == layers.split()


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ([], "PROJECT"),
        (["--no-such-option", "a.pto"], "--no-such-option"),
        (["-o", "x.tif", "a.pto", "b.pto"], "-o is for one project, but there are 2"),
        (["a.pto", "b.pto", "--layers", "x.tif"], "--layers is for one project, but there are 2"),
        (["a.pto", "--prefix", "x", "--layers", "x.tif"], "--prefix and --layers"),
        (["-q", "-v", "a.pto"], "-q and -v"),
        ([""], "'PROJECT...': it is empty"),  # pathlib's current folder
        *(
            ([option, "", "a.pto"], f"'{option}': it is empty")
            for option in ("--prefix", "--layers", "--device", "--scheduler", "--config", "--report", "--log")
        ),
        (["-o", "", "a.pto"], "'--output': it is empty"),
        (["--remap", "sometimes", "a.pto"], "sometimes"),
        (["--jpeg-quality", "101", "a.pto"], "101"),
        (["--softmax-sharpness", "nan", "a.pto"], "'--softmax-sharpness': nan; choose a value"),
        (["--softmax-sharpness", "-1", "a.pto"], "-1"),
        (["--flow-magnitude", "1e9", "a.pto"], "'--flow-magnitude': 1000000000.0; choose a value"),
        (["--compression", "jpeg:85", "a.pto"], "'--compression': 'jpeg:85' is no compression; choose"),
        (["--max-memory", "0", "a.pto"], "'--max-memory': 0 is out of range"),
        (["--max-memory", "0.1B", "a.pto"], "'--max-memory': 0.1B is out of range"),
        (["--max-memory", "1025T", "a.pto"], "choose more than 0, at most 1024T"),
        (["--max-memory", "9" * 400, "a.pto"], "is no size"),
        (["a.pto", "--layers"], "--layers"),
        (["--report", "a.pto", "b.pto"], "'--report': a.pto is a project"),  # from --report *.pto
        (["--log", "a.PTO", "b.pto"], "'--log': a.PTO is a project"),
        (["--profile", "a.pto", "b.pto"], "'--profile': a.pto is a project"),
        (["-o", "a.pto", "b.pto"], "a.pto is a project"),
        (["--report", "a.jpg", "b.pto"], "'--report': a.jpg is an image"),  # from --report *.jpg
        (["--log", "a.TIFF", "b.pto"], "'--log': a.TIFF is an image"),
        (["--profile", "a.tif", "-o", "a.tif", "b.pto"], "'--profile': a.tif is an image"),
        (["--profile", "a", "--report", "./a", "b.pto"], "--report and --profile both name"),
        (["--log", "a", "--report", "a", "b.pto"], "--report and --log both name a; give each its own"),
    ],
)
def test_wrong_command_line(
    calls: Calls, capsys: pytest.CaptureFixture[str], arguments: list[str], part: str
) -> None:
    assert cli.main(arguments) == ExitCode.USAGE
    output = capsys.readouterr()
    assert output.err.startswith("hugin-abflow: error: ") and part in output.err
    assert "Traceback" not in output.err and output.out == ""
    assert calls == []


def test_what_a_link_leads_to_is_not_overwritten(
    calls: Calls, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    for name in ("a.pto", "photo.jpg"):
        link = tmp_path / f"{name}.json"
        link.symlink_to(name)
        assert cli.main(["b.pto", "--report", str(link)]) == ExitCode.USAGE
        assert f"{link} is " in capsys.readouterr().err
    assert calls == []


def test_devices_take_several_outputs(calls: Calls) -> None:
    assert cli.main(["a.pto", "--log", os.devnull, "--report", os.devnull, "--profile", os.devnull]) == 0


# Results, errors and exit codes


def test_stdout_is_the_names_of_the_panoramas(calls: Calls, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["a.pto", "with space.pto"]) == 0
    output = capsys.readouterr()
    assert output.out.splitlines() == ["a.tif", "with space.tif"]
    assert cli.main(["a.pto"]) == 0
    assert capsys.readouterr() == ("a.tif\n", "")


def test_quiet_prints_nothing(calls: Calls, capsys: pytest.CaptureFixture[str]) -> None:
    for projects in (["a.pto"], ["a.pto", "b.pto"]):
        assert cli.main(["-q", *projects]) == 0
        assert capsys.readouterr() == ("", "")


def every_error() -> list[type[AbflowError]]:
    found = [e for e in vars(errors).values() if isinstance(e, type) and issubclass(e, AbflowError)]
    assert len(found) > 10
    return found


@pytest.mark.parametrize("kind", every_error())
def test_error_gives_its_message_and_exit_code(
    replace: Replace, capsys: pytest.CaptureFixture[str], kind: type[AbflowError]
) -> None:
    error = kind("x.pto", 3, "w-1", "a width") if kind is errors.PtoError else kind("x0001.tif: it is broken")
    replace(failing_for("x.pto", error))
    assert cli.main(["-v", "x.pto"]) == kind.exit_code
    assert capsys.readouterr() == ("", f"hugin-abflow: error: {error}\n")


def test_bug_asks_for_a_report_and_hides_the_traceback(
    replace: Replace, capsys: pytest.CaptureFixture[str]
) -> None:
    replace(failing_for("x.pto", ZeroDivisionError("division by zero")))
    assert cli.main(["x.pto"]) == ExitCode.FAILED
    text = capsys.readouterr().err
    assert "x.pto: ZeroDivisionError: division by zero" in text and "report" in text
    assert "Traceback" not in text
    assert cli.main(["-v", "x.pto"]) == ExitCode.FAILED
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "part"),
    [
        (PermissionError(13, "Permission denied", "scratch"), "'scratch'"),
        (MemoryError(), "not enough memory"),
    ],
)
def test_trouble_with_the_machine_is_no_bug(
    replace: Replace, capsys: pytest.CaptureFixture[str], error: Exception, part: str
) -> None:
    replace(failing_for("x.pto", error))
    assert cli.main(["x.pto"]) == ExitCode.FAILED
    text = capsys.readouterr().err
    assert text.startswith("hugin-abflow: error: x.pto: ") and part in text and "report" not in text


@pytest.mark.parametrize("error", [OutputError("disk full"), RuntimeError("a bug")])
def test_failure_stops_no_other_project(
    replace: Replace, capsys: pytest.CaptureFixture[str], error: Exception
) -> None:
    replace(failing_for("b.pto", error))
    assert cli.main(["a.pto", "b.pto", "c.pto"]) == ExitCode.PARTIAL
    output = capsys.readouterr()
    assert output.out.split() == ["a.tif", "c.tif"]
    assert output.err.count("hugin-abflow: error: ") == 1
    table = output.err.split("what went wrong")[1]
    assert [row.split()[:2] for row in table.splitlines() if ".pto" in row.split(" ", 2)[1]] == [
        ["a.pto", "made"],
        ["b.pto", "failed"],
        ["c.pto", "made"],
    ]
    assert str(error) in table


@pytest.mark.parametrize(
    ("codes", "combined"),
    [
        ([ExitCode.OK], ExitCode.OK),
        ([ExitCode.OK, ExitCode.OK], ExitCode.OK),
        ([ExitCode.OUTPUT], ExitCode.OUTPUT),
        ([ExitCode.OUTPUT, ExitCode.OUTPUT], ExitCode.ALL_FAILED),
        ([ExitCode.OUTPUT, ExitCode.OK], ExitCode.PARTIAL),
        ([ExitCode.OUTPUT, ExitCode.NONA], ExitCode.ALL_FAILED),
    ],
)
def test_exit_code_of_several_projects(replace: Replace, codes: list[ExitCode], combined: ExitCode) -> None:
    def merge(path: Path, **keywords: Any) -> Path:
        code = ExitCode(int(path.stem.split("-")[1]))
        if code:
            error = AbflowError("broken")
            error.exit_code = code
            raise error
        return path

    replace(merge)
    assert cli.main([f"{i}-{int(code)}.pto" for i, code in enumerate(codes)]) == combined


def test_every_exit_code_has_a_meaning() -> None:
    assert set(errors.EXIT_CODES) == set(ExitCode)


# Information


def test_help_is_grouped_and_complete(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    headings = re.findall(r"^(\w[\w ]*):$", text, re.MULTILINE)
    assert headings == [
        "Result",
        "Layers",
        "Blending",
        "Many projects",
        "Resources",
        "Information",
        "Examples",
        "Exit codes",
    ]
    for parameter in cli.command.params:
        for name in (n for n in parameter.opts if n.startswith("-")):
            assert re.search(rf"^  (-\w, )?{name}\b", text, re.MULTILINE) or f"  {name}," in text
    for code in ExitCode:
        assert re.search(rf"^  {int(code)} ", text, re.MULTILINE)
    assert max(map(len, text.splitlines())) <= 80


def test_defaults_in_help_are_bare(capsys: pytest.CaptureFixture[str]) -> None:
    cli.main(["--help"])
    text = " ".join(capsys.readouterr().out.split())
    for default in ("10", "100", "joint", "auto"):
        assert f"[default: {default}]" in text
    assert "[default: (" not in text


def test_examples_in_help_are_valid(calls: Calls, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "shoot" / "day").mkdir(parents=True)
    (tmp_path / "shoot" / "day" / "a.pto").touch()
    monkeypatch.chdir(tmp_path)
    for example, _ in cli.EXAMPLES:
        program, *arguments = example.split()
        assert program == "hugin-abflow"
        assert cli.main(arguments) == 0


def test_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    text = capsys.readouterr().out
    try:
        metadata.version("hugin-abflow")
    except metadata.PackageNotFoundError:
        assert text == "hugin-abflow (run from its source, not installed)\n"
    else:
        pyproject = tomllib.loads((Path(__file__).parent.parent / "pyproject.toml").read_text("utf-8"))
        assert text == f"hugin-abflow {pyproject['project']['version']}\n"


def test_list_devices(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    cpu = SimpleNamespace(
        index=0, name="pthread-x", platform="PoCL", kind="CPU", memory=6 << 30, default=False
    )
    gpu = SimpleNamespace(index=1, name="Fast 1", platform="Maker", kind="GPU", memory=3 << 29, default=True)
    monkeypatch.setattr(cli, "list_devices", lambda: [cpu, gpu])
    assert cli.main(["--list-devices"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "0: pthread-x (CPU, 6.0 GiB, PoCL)",
        "1: Fast 1 (GPU, 1.5 GiB, Maker, default)",
    ]


def test_no_device_at_all(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The message that says what to install, as a run without a device has it."""
    monkeypatch.setattr("pyopencl.get_platforms", lambda: [])
    assert cli.main(["--list-devices"]) == ExitCode.DEVICE
    output = capsys.readouterr()
    assert output.out == "" and "no OpenCL device found; " in output.err and "pocl" in output.err

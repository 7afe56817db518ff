"""README is true: every option and exit code is in it, and what it shows runs."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest

from hugin_abflow import cli
from hugin_abflow.errors import EXIT_CODES, OutputError
from hugin_abflow.images import write_image

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text("utf-8")


def rows(heading: str) -> list[list[str]]:
    """The cells of the table in the section `heading`, without its head."""
    section = README.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]


OPTIONS = {names: (text, default) for names, text, default in rows("Options") if not names.startswith("**")}


def names_of(option: click.Option) -> list[str]:
    return sorted(option.opts)


@pytest.mark.parametrize("option", [p for p in cli.command.params if isinstance(p, click.Option)], ids=str)
def test_option_is_documented(option: click.Option) -> None:
    (row,) = (cell for cell in OPTIONS if sorted(re.findall(r"(?<!\S)`?(-[\w-]+)", cell)) == names_of(option))
    text, default = OPTIONS[row]
    if isinstance(option.type, click.Choice):
        assert row.endswith(" " + r"\|".join(option.type.choices) + "`")
        assert default == f"`{option.default}`"
    elif isinstance(option.type, click.types.FloatParamType):
        assert default == f"`{option.default:g}`"
    elif isinstance(option.type, click.IntRange):
        assert f"{option.type.min} to {option.type.max}" in text
    if option.metavar:
        assert row.endswith(f" {option.metavar}`")


def test_compressions_are_those_of_help_and_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text, _ = OPTIONS["`--compression NAME`"]
    documented = re.findall(r"(TIFF|EXR): ([`\w, ]+)", text)
    assert [kind for kind, _ in documented] == ["TIFF", "EXR"]
    cli.main(["--help"])
    shown = " ".join(capsys.readouterr().out.split())
    for kind, names in documented:
        names = names.replace("`", "").strip()
        assert f"{kind}: {names}{';' if kind == 'TIFF' else '.'}" in shown
        suffix, dtype = (".tif", np.uint8) if kind == "TIFF" else (".exr", np.float32)
        with pytest.raises(OutputError, match=f"choose one of {names}$"):
            write_image(tmp_path / f"x{suffix}", np.ones((1, 1, 4), dtype), compression="best")
        for name in names.split(", "):
            write_image(tmp_path / f"x{suffix}", np.ones((1, 1, 4), dtype), compression=name)


def test_no_other_option_is_documented() -> None:
    known = {name for p in cli.command.params for name in p.opts if name.startswith("-")}
    shown = {name for cell in OPTIONS for name in re.findall(r"(?<!\S)`?(-[\w-]+)", cell)}
    assert shown == known


def test_options_are_in_the_groups_of_help(capsys: pytest.CaptureFixture[str]) -> None:
    cli.main(["--help"])
    text = capsys.readouterr().out.split("Examples:")[0]
    in_help = re.findall(r"^(?:(\w[\w ]*):|  (?:-\w, )?(--[\w-]+).*)$", text, re.MULTILINE)
    in_readme = [
        (names.strip("*"), "") if names.startswith("**") else ("", re.findall(r"--[\w-]+", names)[0])
        for names, *_ in rows("Options")
    ]
    assert in_readme == in_help


def test_exit_codes_are_documented() -> None:
    assert rows("Exit codes") == [[str(int(code)), text] for code, text in EXIT_CODES.items()]


@pytest.mark.usefixtures("shoot")
def test_commands_are_valid() -> None:
    commands = re.findall(r"^ {4,}(hugin-abflow [^\[\n]*)$", README, re.MULTILINE)
    commands += re.findall(r"`(hugin-abflow [^`\n]*)`", README)
    assert len(commands) >= 4
    for line in commands:
        assert cli.main(shlex.split(line)[1:]) == 0, line


def test_python_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    examples = re.findall(r"^```python\n(.*?)^```", README, re.MULTILINE | re.DOTALL)
    assert len(examples) == 3
    (tmp_path / "sample_projects").symlink_to(ROOT / "sample_projects")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for example in examples:
        exec(compile(example, "README.md", "exec"), names)
    assert names["pixels"].shape == (1024, 2048, 4)
    assert {path.name for path in tmp_path.iterdir()} == {"sample_projects", "room.tif", "room.png"}


def test_files_that_are_named_exist() -> None:
    links = [link for link in re.findall(r"\]\(([^)]+)\)", README) if "://" not in link]
    files = re.findall(r"`((?:[\w-]+/)*[A-Z]+\.md|[\w-]+/)`", README)
    assert "docs/before-after.jpg" in links and "ARCHITECTURE.md" in files
    assert [name for name in links + files if not (ROOT / name).exists()] == []


def test_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text("utf-8")
    for target in re.findall(r"^ {4}make (\w+)", README, re.MULTILINE):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE)

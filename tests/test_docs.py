"""The pages for photographers are true: links lead somewhere, commands are understood, options exist."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from hugin_abflow import cli
from hugin_abflow.dropin import setup
from hugin_abflow.dropin.places import places
from hugin_abflow.dropin.request import HELP, OPTIONS, read_command_line

ROOT = Path(__file__).resolve().parent.parent
PAGES = {path.name: path.read_text("utf-8") for path in sorted((ROOT / "docs").glob("*.md"))}
KNOWN = {name for option in OPTIONS for name in option.names}


def headings(path: Path) -> set[str]:
    """The names that links can have behind ``#``."""
    lines = re.findall(r"^#+ (.+)$", path.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", line).lower().replace(" ", "-") for line in lines}


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page: str) -> None:
    links = [link for link in re.findall(r"\]\(([^)]+)\)", PAGES[page]) if "://" not in link]
    assert links
    for link in links:
        name, _, heading = link.partition("#")
        target = (ROOT / "docs" / name).resolve()
        assert target.is_file(), link
        assert not heading or heading in headings(target), link


def test_pages_are_reached_from_the_first() -> None:
    linked = set(re.findall(r"\]\(([\w-]+\.md)", PAGES["hugin.md"]))
    assert set(PAGES) == linked | {"hugin.md"} and "docs/hugin.md" in (ROOT / "README.md").read_text("utf-8")


@pytest.mark.usefixtures("shoot")
def test_commands_are_understood(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hugin_abflow.batch.run.show_project", lambda path, **keywords: [])
    monkeypatch.setattr(setup, "install", lambda *given: [])
    monkeypatch.setattr(setup, "uninstall", lambda *given: [])
    text = "\n".join(PAGES.values())
    lines = re.findall(r"^ {4}(\S*abflow.*)$", text, re.MULTILINE)
    lines += re.findall(r"`((?:hugin-abflow|hugin-abflow-setup|abflow-enblend) [^`\n]+)`", text)
    run = {
        "hugin-abflow": lambda words: cli.main(words),
        "hugin-abflow-setup": lambda words: setup.main(words),
        "abflow-enblend": lambda words: 0 if read_command_line(words) else 1,
    }
    seen = set()
    for line in lines:
        program, *words = shlex.split(line)
        assert run[program](words) == 0, line
        seen.add(program)
    assert seen == set(run)


def test_options_of_help_are_listed() -> None:
    section = PAGES["command-line.md"].split("## abflow-enblend")[1]
    rows = re.findall(r"^\| `(-.*?)` \|", section, re.MULTILINE)
    listed = {name for row in rows for name in re.findall(r"(?<![\w-])--?[a-zA-Z][\w-]*", row)}
    assert len(listed) > 10 and listed <= KNOWN
    assert set(re.findall(r"(?<![\w-])--?[a-zA-Z][\w-]*", HELP)) <= listed | {
        "-h",
        "--help",
        "-V",
        "--version",
    }


def test_sequences_and_places_are_the_real_ones() -> None:
    text = "\n".join(PAGES.values())
    assert set(re.findall(r"abflow_\w+\.executor", text)) <= set(setup.sequences())
    titles = re.findall(r"^\| (Panorama by optical flow.*?) \|", PAGES["hugin-window.md"], re.MULTILINE)
    shipped = [re.search(r"^Description=(.*)$", c, re.MULTILINE)[1] for c in setup.sequences().values()]
    assert sorted(titles) == sorted(shipped)
    assert f"`{places('linux', {}, '~').preferences}`" in text
    assert f"`{places('darwin', {}, '~').preferences}`" in text

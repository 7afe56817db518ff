"""Click's options as ours are: files that are written to are none of somebody's."""

from __future__ import annotations

import os
from pathlib import Path

import click
import pytest

from hugin_abflow import cli
from hugin_abflow.errors import ExitCode
from hugin_abflow.options import NewFile, OldFile

JPEG, RAW, MOVED = b"\xff\xd8\xff\xe0\0\x10JFIF\0", b"II*\0\x10\0\0\0CR\2\0", b"\0\0\0\x18ftypheic"


@pytest.mark.parametrize(
    "photo", [JPEG, b"\xff\xd8\xff\xfe\x20\x20no NUL so far", RAW, MOVED, b"FUJIFILMCCD-RAW 0201FF383501\0\0"]
)
def test_no_photo_is_written_to_whatever_its_name(tmp_path: Path, photo: bytes) -> None:
    """Camera raw has many endings, and a hard link may have none; -o looks at photos itself."""
    for name in ("photo.CR2", "log"):
        (tmp_path / name).write_bytes(photo)
        with pytest.raises(
            click.BadParameter,
            match=rf"{name} is there, and may be a photo: it is no text; name another file",
        ):
            NewFile().convert(str(tmp_path / name), None, None)
        assert NewFile(image=True).convert(str(tmp_path / name), None, None).read_bytes() == photo


def test_no_project_is_written_to_whatever_its_name(tmp_path: Path) -> None:
    """Hugin's temporary ones have no ending; hard links and backups may have any."""
    (tmp_path / "project").write_text('p f2 w90 h30 v130\ni w48 h36 f0 v60 n"a.jpg"\n')
    (tmp_path / "windows.bak").write_bytes(b"\xef\xbb\xbf# Hugin project file\r\n")
    (tmp_path / "lines.txt").write_text('# made by a script\ni w48 h36 f0 v60 n"a.jpg"\n')
    for name in ("project", "windows.bak", "lines.txt"):
        for kind in (NewFile(), NewFile(replaced=True)):
            with pytest.raises(click.BadParameter, match=f"{name} holds a project, which is never"):
                kind.convert(str(tmp_path / name), None, None)


def test_what_is_replaced_was_written_by_us(tmp_path: Path) -> None:
    """Or may have been; a text to the end of which something is added loses nothing."""
    texts = {"photo.xmp": "<x:xmpmeta", "abflow.toml": "jobs = 2", "notes": "p 1", "notes.rtf": r"{\rtf1"}
    for name, text in texts.items():
        file = tmp_path / name
        file.write_text(text)
        with pytest.raises(click.BadParameter, match=f"{name} is there, and would be replaced, but is no J"):
            NewFile(replaced=True).convert(str(file), None, None)
        assert NewFile().convert(str(file), None, None) == file
    for text in ("", "\n", "{\n", "{}", '{\n  "schema": 1', '{"traceEvents": []}'):
        file.write_text(text)
        assert NewFile(replaced=True).convert(str(file), None, None) == file


@pytest.mark.parametrize(("option", "kept"), [("--report", True), ("--profile", True), ("--log", False)])
def test_reports_and_profiles_replace_no_notes(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], option: str, kept: bool
) -> None:
    """To which a log may be added."""
    notes = tmp_path / "notes"
    notes.write_text("of somebody\n")
    assert cli.main([str(tmp_path / "none.pto"), option, str(notes)]) != ExitCode.OK
    assert notes.read_text().startswith("of somebody\n")
    assert (f"Invalid value for '{option}': {notes} is there, and would" in capfd.readouterr().err) == kept
    assert (notes.read_text() == "of somebody\n") == kept


def test_a_name_that_no_file_can_have_is_refused() -> None:
    """On a command line it cannot be; in abflow.toml it may."""
    for kind in (NewFile(), OldFile()):
        for name in ("", "a\0b"):
            with pytest.raises(click.BadParameter):
                kind.convert(name, None, None)


def test_what_may_be_ours_is_written_to(tmp_path: Path) -> None:
    """Texts, what is empty or not there yet, what is no file, and a pipe that nobody writes into."""
    for name, text in (("log", "Küste.pto: made\n"), ("empty", "")):
        (tmp_path / name).write_text(text, "utf-8")
    names = ["log", "empty", "new", "."]
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        names.append("pipe")
    for name in names:
        assert NewFile().convert(str(tmp_path / name), None, None) == Path(tmp_path / name)

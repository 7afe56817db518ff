"""Files that cannot be written, or must not be replaced, are told with the option that names them."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import pytest
from shoots import write_project

from hugin_abflow import cli
from hugin_abflow.errors import ExitCode, OutputError
from hugin_abflow.project import file_key
from hugin_abflow.targets import explained, final_file, refuse_input, unwritable


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("folder", "folder is a folder; name a file with --x"),
        ("link", "link is no ordinary file; name one with --x"),
        ("closed", "closed is write-protected; allow writing, or name another file with --x"),
        ("a\0b", "it has a NUL; choose another with --x"),
        ("\udce9/a", "is not valid UTF-8; rename that, or choose another with --x"),
    ],
)
@pytest.mark.skipif(sys.platform == "win32", reason="has no such files")
def test_the_option_is_named(tmp_path: Path, name: str, said: str) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to(os.devnull)
    (tmp_path / "closed").touch(0o444)
    with pytest.raises(OutputError, match=said):
        final_file(tmp_path / name, "--x")


def test_what_the_system_says_of_the_folder(tmp_path: Path) -> None:
    file = tmp_path / "none" / "a"
    said = f"^a cannot be written: {tmp_path / 'none'}: No such file .*; choose another folder with --x$"
    with pytest.raises(OutputError, match=said), explained(Path("a"), file, "--x"):
        file.touch()


@pytest.mark.skipif(os.name == "nt", reason="names ignore case there")
def test_names_that_differ_by_case_are_one_where_the_file_is(tmp_path: Path) -> None:
    """A disk that ignores case finds one file by both names, as here a second link makes it."""
    (tmp_path / "photo.jpg").write_bytes(b"photo")
    with_capitals = tmp_path / "PHOTO.JPG"
    assert file_key(tmp_path / "none.jpg") == file_key(tmp_path / "NONE.JPG")
    with suppress(FileExistsError):  # on such a disk
        os.link(tmp_path / "photo.jpg", with_capitals)
    with pytest.raises(OutputError, match=r"PHOTO\.JPG is an input"):
        refuse_input(with_capitals, [tmp_path / "photo.jpg"])


@pytest.mark.parametrize("option", ["--log", "--report", "--profile"])
@pytest.mark.parametrize(
    ("name", "why"), [("none/a", "No such file"), ("file/a", "Not a dir"), ("folder", "Is a directory")]
)
@pytest.mark.skipif(sys.platform == "win32", reason="says it in other words")
def test_what_the_run_could_not_write_is_refused_where_it_is_only_shown(
    replace: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str],
    option: str, name: str, why: str,
) -> None:  # fmt: skip
    replace(lambda path, **keywords: pytest.fail("it begins"))
    project = write_project(tmp_path / "a.pto")
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    said = []
    for also in ([], ["--dry-run"]):
        assert cli.main([str(project), option, str(tmp_path / name), *also]) == ExitCode.OUTPUT
        output = capsys.readouterr()
        assert output.out == ""
        said.append(output.err)
    assert said[0] == said[1] and why in said[0] and f"; name another file with {option}" in said[0]


@pytest.mark.parametrize("option", ["--log", "--report", "--profile"])
def test_what_is_only_shown_writes_nothing(tmp_path: Path, option: str) -> None:
    project = write_project(tmp_path / "a.pto")
    (tmp_path / "there").write_text("{}")
    for name in ("new", "there", os.devnull):
        assert cli.main(["--dry-run", str(project), option, str(tmp_path / name)]) == 0
    assert (tmp_path / "there").read_text() == "{}" and not (tmp_path / "new").exists()


@pytest.mark.skipif(sys.platform == "win32" or os.geteuid() == 0, reason="nothing is closed to this user")
def test_what_is_closed_is_told_without_writing(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch(0o444)
    assert unwritable(file, replaced=False) and not unwritable(file, replaced=True)
    tmp_path.chmod(0o555)
    assert unwritable(file, replaced=True) and unwritable(tmp_path / "new", replaced=False)
    tmp_path.chmod(0o755)


@pytest.mark.skipif(sys.platform == "win32", reason="tells it in other ways")
def test_a_read_only_disk_is_told_from_permissions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the run itself does: other permissions help nothing there."""
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert unwritable(tmp_path / "new", replaced=True) == os.strerror(errno.EACCES)
    monkeypatch.setattr(os, "statvfs", lambda path: SimpleNamespace(f_flag=os.ST_RDONLY | os.ST_NOSUID))
    assert unwritable(tmp_path / "new", replaced=True) == os.strerror(errno.EROFS)

"""Files that cannot be written, or must not be replaced, are told with the option that names them."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from hugin_abflow.errors import OutputError
from hugin_abflow.project import file_key
from hugin_abflow.targets import explained, final_file, refuse_input


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

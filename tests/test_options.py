"""Click's options as ours are: files that are written to are none of somebody's."""

from __future__ import annotations

import os
from pathlib import Path

import click
import pytest

from hugin_abflow.options import NewFile, OldFile

JPEG, RAW, MOVED = b"\xff\xd8\xff\xe0\0\x10JFIF\0", b"II*\0\x10\0\0\0CR\2\0", b"\0\0\0\x18ftypheic"


@pytest.mark.parametrize("photo", [JPEG, RAW, MOVED, b"FUJIFILMCCD-RAW 0201" + b"FF383501\0\0"])
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

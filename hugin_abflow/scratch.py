"""Temporary files and folders, locked while in use, so that a run knows what a killed one left behind.

A lock goes with its process, however that ends. A shared folder need not show the locks of other computers:
their files are taken for leftovers only after a week.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import platform
import re
import secrets
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TextIO

from hugin_abflow.errors import OutputError

_HOST = hashlib.blake2b(platform.node().encode(), digest_size=4).hexdigest()
_PART = re.compile(r"\.abflow-([0-9a-f]{8})-[0-9a-f]{12}(\.\w+)?")
_FOLDER = re.compile(r"hugin-abflow-([0-9a-f]{8})-\w+")
_OPEN_FILES = re.compile(r"/dev/fd|/proc/\d+/(task/\d+/)?fd")  # folders of such
_LOCK = "in use"
_WEEK = 7 * 24 * 3600.0
_ours: set[Path] = set()  # what this process may have made and not yet removed


@atexit.register
def tidy() -> None:
    """Remove what this process left where Ctrl-C came between making and using, or while it was removed."""
    for path in tuple(_ours):
        if is_folder(path):
            shutil.rmtree(path, ignore_errors=True)
        else:
            with suppress(OSError):
                path.unlink(missing_ok=True)
        _ours.discard(path)  # not before: this, too, may be broken off, and begun anew


def is_special(path: Path) -> bool:
    """Whether it is a pipe, a device or what a process has open (/dev/stdout), or leads to such: it can be
    written to, but not replaced.
    """
    try:
        mode = path.stat().st_mode
    except OSError:  # there is nothing yet, or writing will tell why not
        return False
    if stat.S_ISDIR(mode):
        return False
    return not stat.S_ISREG(mode) or _leads_to_open_file(path)


def is_pipe(path: Path) -> bool:
    """Whether it is a pipe, as a shell's ``<(...)`` is; false where it must not be looked at."""
    try:
        return stat.S_ISFIFO(path.stat().st_mode)
    except (OSError, ValueError):  # ValueError: a NUL in the name
        return False


def open_to_add(path: Path, buffering: int = -1) -> TextIO:
    """A file to the end of which text is added. Where it is our stdout or stderr, their own place in it moves
    along: what is printed next comes behind. Raises OSError.
    """
    for number in (1, 2):
        with suppress(OSError):  # closed, or nothing is there
            if os.path.samestat(os.fstat(number), path.stat()):
                return os.fdopen(os.dup(number), "a", buffering, "utf-8", "backslashreplace")
    return path.open("a", buffering, "utf-8", "backslashreplace")


def _leads_to_open_file(path: Path) -> bool:
    """Whether a name that is there is one of a file that a process has open, or a link to such a name."""
    while True:
        folder = os.path.realpath(path.parent)
        if _OPEN_FILES.fullmatch(folder):
            return True
        try:
            path = Path(folder, path.readlink())
        except OSError:  # no link
            return False


def is_file(path: Path) -> bool:
    """Whether it is a file; false where it must not be looked at, of which `Path.is_file` raises an error."""
    return os.path.isfile(path)  # noqa: PTH113


def is_folder(path: Path) -> bool:
    """Whether it is a folder; false where it must not be looked at."""
    return os.path.isdir(path)  # noqa: PTH112


@contextmanager
def part_beside(final: Path, suffix: str | None = None) -> Iterator[Path]:
    """A new, empty file beside `final`, to be written and renamed; nothing else is left of it.

    suffix      of its name; default: that of `final`.

    What killed runs left in the folder is removed. Raises OSError.
    """
    sweep(final.parent)
    part, descriptor = _create(final, final.suffix if suffix is None else suffix)
    try:
        yield part
    finally:
        part.unlink(missing_ok=True)
        _ours.discard(part)
        if descriptor is not None:
            os.close(descriptor)


def write_whole(final: Path, data: bytes) -> None:
    """Write a file, which is replaced by the complete new one or not at all, and keeps its permissions.

    Raises OSError.
    """
    with part_beside(final, ".part") as part:
        part.write_bytes(data)
        put(part, final)


def put(part: Path, final: Path) -> None:
    """Give a file that is whole its final name; one that it replaces leaves it its permissions.

    Raises OSError.
    """
    with suppress(OSError):  # there is none, or a file system that knows no permissions
        shutil.copymode(final, part)
    part.replace(final)


def _create(final: Path, suffix: str) -> tuple[Path, int | None]:
    """A file that is in use until the descriptor is closed; Windows needs none."""
    while True:
        part = final.with_name(f".abflow-{_HOST}-{secrets.token_hex(6)}{suffix}")
        _ours.add(part)
        descriptor = os.open(part, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)  # never somebody else's file
        if sys.platform == "win32":
            os.close(descriptor)  # else it could not be renamed; what is written there cannot be removed
            return part, None
        _lock(descriptor)
        if os.fstat(descriptor).st_nlink:
            return part, descriptor
        os.close(descriptor)  # swept before it was locked


@contextmanager
def work_folder() -> Iterator[Path]:
    """A folder for temporary files under TMPDIR; nothing is left of it. Raises `OutputError`."""
    parent = root()
    sweep(parent)
    folder: Path | None = None
    descriptor: int | None = None
    try:
        try:
            while True:
                folder = parent / f"hugin-abflow-{_HOST}-{secrets.token_hex(6)}"
                _ours.add(folder)
                folder.mkdir(0o700)
                with suppress(FileNotFoundError):  # swept before it had a lock
                    descriptor = os.open(folder / _LOCK, os.O_CREAT | os.O_WRONLY, 0o600)
                    _lock(descriptor)
                    if os.fstat(descriptor).st_nlink:
                        break
                    os.close(descriptor)  # swept before it was locked
                    descriptor = None
        except OSError as error:
            raise OutputError(
                f"no temporary folder can be made in {parent}: {error.strerror}; TMPDIR chooses another place"
            ) from None
        yield folder
    finally:
        if descriptor is not None:
            os.close(descriptor)
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)
            _ours.discard(folder)


def root() -> Path:
    """The folder for temporary files: TMPDIR, asked each time, as Python remembers the first that it saw."""
    named = os.environ.get("TMPDIR", "")
    return Path(named if named and is_folder(Path(named)) else tempfile.gettempdir())


def misnamed_root() -> str | None:
    """What is to be said where TMPDIR names no folder, so that another one is taken; None where it does."""
    named, used = os.environ.get("TMPDIR", ""), root()
    if not named or used == Path(named):
        return None
    return f"TMPDIR is {named}, and no such folder is there: {used} is used; make it, or name another"


def sweep(folder: Path) -> None:
    """Remove temporary files and folders in `folder` that nobody uses any more."""
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if (found := _PART.fullmatch(entry.name)) and entry.is_file(follow_symlinks=False):
                part = Path(entry.path)
                _remove_abandoned(entry, part, found[1], partial(part.unlink, missing_ok=True))
            elif (found := _FOLDER.fullmatch(entry.name)) and entry.is_dir(follow_symlinks=False):
                remove = partial(shutil.rmtree, entry.path, ignore_errors=True)
                _remove_abandoned(entry, Path(entry.path) / _LOCK, found[1], remove)


def _remove_abandoned(entry: os.DirEntry[str], lock: Path, host: str, remove: Callable[[], None]) -> None:
    """Call `remove` if nobody holds `lock`: that of a folder, or the file itself. It is held meanwhile, and
    goes first: who waits for it, having made it just now or to remove it, too, has a file that is gone.
    """
    with suppress(OSError):
        if host != _HOST and time.time() - entry.stat(follow_symlinks=False).st_mtime < _WEEK:
            return
        if sys.platform == "win32":
            lock.unlink(missing_ok=True)  # refused while it is open
            remove()
            return
        # a folder whose process was killed before it had a lock, or while it was removed, has none
        make = os.O_CREAT if entry.is_dir() else 0
        descriptor = os.open(lock, os.O_RDWR | os.O_NOFOLLOW | make, 0o600)
        try:
            if _lock(descriptor, wait=False) and os.fstat(descriptor).st_nlink:
                remove()
        finally:
            os.close(descriptor)


def _lock(descriptor: int, wait: bool = True) -> bool:
    """Lock an open file; false if that is not possible (or, without `wait`, not now)."""
    if sys.platform == "win32":
        return True
    import fcntl  # Unix alone has it

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError:  # held by another, or a file system without locks: then nothing is ever removed
        return False
    return True

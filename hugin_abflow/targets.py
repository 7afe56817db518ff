"""Files that are to be written: which file a name means, and what forbids to write it, with what to do."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from hugin_abflow.errors import OutputError
from hugin_abflow.exif import is_photo
from hugin_abflow.project import file_key
from hugin_abflow.scratch import is_special


def final_file(path: Path, named_with: str) -> Path:
    """The file that is replaced: through a link what it points to, not the link.

    named_with      the option that names it, for messages.

    Raises `OutputError` for a name that no file can have, and for what must not be replaced.
    """
    if "\0" in str(path):
        raise OutputError(
            f"{str(path)!r} is no name of a file: it has a NUL; choose another with {named_with}"
        )
    final = Path(os.path.realpath(path))
    if not named_in_unicode(final.parent):
        raise OutputError(
            f"{path}: the path of its folder is not valid UTF-8; rename that, or choose another with "
            f"{named_with}"
        )
    with explained(path, final, named_with):
        if final.is_dir():
            raise OutputError(f"{path} is a folder; name a file with {named_with}")
        # a device or a pipe, reached by a link: the rename would take its place
        if is_special(final):
            raise OutputError(f"{path} is no ordinary file; name one with {named_with}")
        if final.exists() and not final.stat().st_mode & 0o222:  # which a rename does not ask
            raise OutputError(
                f"{path} is write-protected; allow writing, or name another file with {named_with}"
            )
    return final


def refuse_input(output: Path, inputs: Iterable[Path], named_with: str = "-o") -> None:
    """Raise `OutputError` for an output that is one of the inputs; named_with: the option that names it."""
    if file_key(output) in map(file_key, inputs):
        raise OutputError(f"{output} is an input of this panorama; choose another name with {named_with}")


def refuse_photo(output: Path, remedy: str = "choose another name with -o, or remove it") -> None:
    """Raise `OutputError` for an output that is a photo, whatever it belongs to; remedy: what to do."""
    if is_photo(output):
        raise OutputError(f"{output} is a photo: its EXIF tells an exposure time; {remedy}")


@contextmanager
def explained(path: Path, final: Path, named_with: str) -> Iterator[None]:
    """Raise `OutputError` for what the system says of the folder of `final`, which `path` means."""
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"{path} cannot be written: {final.parent}: {error.strerror}; choose another folder with "
            f"{named_with}"
        ) from None


def unwritable(path: Path, replaced: bool) -> str | None:
    """Why the system would not let a file be written, in its words; None if it would, as far as that is told
    without writing anything.

    replaced    by a new file of its name; else it is opened, and made if it is not there.
    """
    final = Path(os.path.realpath(path))
    if is_special(final):  # who opens a pipe waits until somebody reads
        return None
    try:
        os.stat(f"{final.parent}{os.sep}")  # noqa: PTH116 - so a file is no folder
        if final.is_dir():
            return os.strerror(errno.EISDIR)
        written = final if final.exists() and not replaced else final.parent
    except OSError as error:
        return error.strerror
    if os.access(written, os.W_OK):
        return None
    # access(2) knows the reason, but Python does not tell it
    return os.strerror(errno.EROFS if _is_read_only(written) else errno.EACCES)


def _is_read_only(path: Path) -> bool:
    """Whether its file system is; false where that is not known."""
    return sys.platform != "win32" and bool(os.statvfs(path).f_flag & os.ST_RDONLY)


def may_grow(path: Path, more: int) -> bool:
    """Whether a file may grow by so many bytes, by what the system allows for one (``ulimit -f``)."""
    if sys.platform == "win32":
        return True
    import resource  # Unix alone has it

    most = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    return most == resource.RLIM_INFINITY or path.stat().st_size + more <= most


def named_in_unicode(path: Path) -> bool:
    """Whether OpenImageIO can be told the path: bytes that are no UTF-8 (an old archive's) it cannot."""
    return not any("\ud800" <= letter <= "\udfff" for letter in str(path))

"""`Project` to bytes: what was read, with the edited fields changed."""

from __future__ import annotations

from pathlib import Path

from hugin_abflow.errors import OutputError
from hugin_abflow.pto.model import Project
from hugin_abflow.scratch import write_whole


def dumps(project: Project) -> bytes:
    """The bytes of a project's file; those that were read, if nothing was edited."""
    lines = [line if isinstance(line, bytes) else line.raw for line in project.lines]
    added = b"".join(line.raw for line in project.added)
    before = b"".join(lines[: project.end])
    if added and before and not before.endswith((b"\n", b"\r")):
        before += project.newline
    return b"".join([project.bom, before, added, *lines[project.end :]])


def dump(project: Project, path: str | Path) -> None:
    """Write a project; an existing file is replaced by the complete new one or not at all.

    Raises `OutputError` where the file cannot be written.
    """
    data = dumps(project)
    try:
        write_whole(Path(path).resolve(), data)  # a link stays a link
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        reason = getattr(error, "strerror", None) or error
        raise OutputError(f"{path}: cannot be written ({reason}); check folder and permissions") from error

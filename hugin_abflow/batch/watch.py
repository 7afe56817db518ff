"""Projects of a folder, as they are saved.

The folder is looked through again and again: that works on network shares too, which tell of no changes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

from hugin_abflow.batch.queue import projects_in
from hugin_abflow.errors import AbflowError
from hugin_abflow.project import read_plan
from hugin_abflow.scratch import is_folder

# Seconds for which a project and its photos must have stayed as they are.
_SETTLED = 3.0

Sign = tuple[tuple[str, int, int], ...]


def watch(
    folder: Path, recursive: bool, *, clock: Callable[[], float] = time.monotonic
) -> Iterator[Path | str | None]:
    """Projects under `folder` that were saved, or whose photos came or changed, once they stay as they are;
    those that are there in the beginning too. None when there is nothing at the moment; ask again
    after a while. Never ends; a folder that is gone may come back: what comes up once then is a warning.
    """
    seen: dict[Path, tuple[Sign, float]] = {}  # what each looked like, and since when
    done: dict[Path, Sign] = {}
    told = False
    while True:
        now = clock()
        gone = not is_folder(folder)
        if gone and not told:
            yield f"{folder} is no longer there, or closed to you; it is looked for again"
        told = gone
        for project in projects_in(folder, recursive):
            sign = _sign(project)
            if project not in seen or seen[project][0] != sign:
                seen[project] = sign, now
            elif now - seen[project][1] >= _SETTLED and done.get(project) != sign:
                done[project] = sign
                yield project
        yield None


def _sign(project: Path) -> Sign:
    """Names, times and sizes of a project and of its photos that are there."""
    files = [project]
    with suppress(AbflowError, OSError):  # half-written, or no project: its own times tell enough
        files += [image.photo for image in read_plan(project).images]
    sign = []
    for file in files:
        with suppress(OSError):
            status = file.stat()
            sign.append((str(file), status.st_mtime_ns, status.st_size))
    return tuple(sign)

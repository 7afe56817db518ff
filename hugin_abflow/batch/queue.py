"""Which projects are meant: files, folders and patterns become a list without repeats."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from hugin_abflow.errors import ProjectError


def find_projects(places: Iterable[Path], recursive: bool = False) -> list[Path]:
    """The projects at `places`, each once, in the order of `places`; those of a folder by name.

    places      projects; folders, of which the files that end in .pto are meant; or patterns with ``*``,
                ``?`` and ``**``, which not every shell expands.
    recursive   look into the folders' folders too; hidden ones are left out.

    A file that is not there stays in the list: it fails by itself. Raises `ProjectError` for a folder or a
    pattern without any project.
    """
    found: dict[str, Path] = {}
    for place in places:
        for project in _projects(place, recursive):
            # not resolved: photos are looked for beside a link, not beside what it points to
            found.setdefault(os.path.normcase(os.path.abspath(project)), project)  # noqa: PTH100
    return list(found.values())


def _projects(place: Path, recursive: bool) -> list[Path]:
    if place.is_dir():
        projects = projects_in(place, recursive)
        if not projects:
            remedy = "" if recursive else ", or add --recursive to look into its folders"
            raise ProjectError(f"{place}: there is no project (.pto) in this folder; name another{remedy}")
        return projects
    if glob.has_magic(str(place)) and not place.exists():
        # Path.glob takes no absolute patterns
        matches = sorted(Path(name) for name in glob.glob(str(place), recursive=True))  # noqa: PTH207
        if not matches:
            raise ProjectError(f"{place}: no project has such a name; check the pattern")
        return [project for match in matches for project in _projects(match, recursive)]
    return [place]


def projects_in(folder: Path, recursive: bool) -> list[Path]:
    """Projects of a folder, and of the folders in it, by name; what cannot be listed is passed over."""
    return sorted(_walk(folder, recursive))


def _walk(folder: Path, recursive: bool) -> Iterator[Path]:
    for parent, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if recursive and not name.startswith("."))
        for name in files:
            if name.lower().endswith(".pto") and not name.startswith("."):
                yield Path(parent) / name

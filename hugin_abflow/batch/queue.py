"""Which projects are meant: files, folders and patterns become a list without repeats."""

from __future__ import annotations

import glob
import logging
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from hugin_abflow.errors import OutputError, ProjectError, SameOutputError
from hugin_abflow.exif import is_ours, read_exif
from hugin_abflow.outputs import results
from hugin_abflow.project import read_plan
from hugin_abflow.scratch import is_file, is_folder, is_special
from hugin_abflow.terminal import label, say


def find_projects(places: Iterable[Path], recursive: bool = False) -> list[Path]:
    """The projects at `places`, each once, in the order of `places`; those of a folder by name.

    places      projects; folders, of which the files that end in .pto are meant; or patterns with ``*``,
                ``?`` and ``**``, which not every shell expands.
    recursive   look into the folders' folders too; hidden ones are left out.

    A file that is not there stays in the list: it fails by itself. Folders that are links are not looked
    into, unless they are named: they may lead back. Raises `ProjectError` for a folder or a pattern without
    any project.
    """
    found: dict[str, Path] = {}
    for place in places:
        for project in _projects(place, recursive):
            found.setdefault(_key(project), project)
    return list(found.values())


def _key(file: Path) -> str:
    """Equal for a file's names by way of different folders. A link to a file is a file of its own: photos are
    looked for, and panoramas written, beside it.
    """
    return os.path.normcase(file.parent.resolve() / file.name)


def refuse_same_output(projects: Mapping[Path, Mapping[str, Any]]) -> None:
    """Raise `SameOutputError` for projects that would write the same file, by the names that files have where
    no layers are there yet; `OutputError` for one that would replace a photo of another, unless that is a
    panorama of ours or of Hugin's.

    projects    with the keywords of `stitch.stitch_project`; where a prefix is named, the ordinary panorama
                alone is made.
    """
    remedy = "rename one, or stitch it alone with -o"
    writers: dict[str, tuple[Path, Path]] = {}
    photos: dict[str, Path] = {}
    for project, its in projects.items():
        with suppress(ProjectError, OSError):  # it will fail by itself
            plan = read_plan(project)
            photos.update((_key(photo), project) for photo in plan.photos)
            alone = [plan.default_output()] if its["prefix"] else None
            for output in alone or results(plan, its["keep_layers"]):
                other, _ = writers.setdefault(_key(output), (project, output))
                if other != project:
                    raise SameOutputError(f"{other} and {project} would both write {output}; {remedy}")
    for key in writers.keys() & photos.keys():
        project, output = writers[key]
        if is_file(output) and not is_ours(read_exif(output)):
            raise OutputError(f"{project} would replace {output}, a photo of {photos[key]}; {remedy}")


def _projects(place: Path, recursive: bool) -> list[Path]:
    if is_folder(place):
        projects = projects_in(place, recursive, _warn)
        if not projects:
            remedy = "" if recursive else ", or add --recursive to look into its folders"
            raise ProjectError(f"{place}: there is no project (.pto) in this folder; name another{remedy}")
        return projects
    if glob.has_magic(str(place)) and not is_file(place):
        matches = sorted(_matches(place))
        if not matches:
            raise ProjectError(f"{place}: no project has such a name; check the pattern")
        return [project for match in matches for project in _projects(match, recursive)]
    return [place]


def _matches(pattern: Path) -> Iterator[Path]:
    """What fits a pattern; as in a shell no hidden files, unless the pattern names them. No pipes."""
    top = Path(pattern.anchor)
    wanted = pattern.relative_to(top) if pattern.anchor else pattern
    shown = {part for part in wanted.parts if part.startswith(".")}
    # unlike glob.glob it follows no links for **, which may lead back
    for match in top.glob(str(wanted)):
        hidden = any(part.startswith(".") and part not in shown for part in match.relative_to(top).parts)
        if not hidden and not is_special(match):
            yield match


def _warn(error: OSError) -> None:
    """Say which folder cannot be listed."""
    what = f"{error.filename} cannot be listed ({error.strerror}); its projects are left out"
    say(f"{label(logging.WARNING)}{what}")


def projects_in(folder: Path, recursive: bool, tell: Callable[[OSError], None] | None = None) -> list[Path]:
    """Projects of a folder, and of the folders in it, by name; `tell` is called for what cannot be listed."""
    return sorted(_walk(folder, recursive, tell))


def _walk(folder: Path, recursive: bool, tell: Callable[[OSError], None] | None) -> Iterator[Path]:
    for parent, folders, files in os.walk(folder, onerror=tell):
        folders[:] = sorted(name for name in folders if recursive and not name.startswith("."))
        for name in files:
            project = Path(parent) / name
            # who opens a pipe waits until somebody writes
            if name.lower().endswith(".pto") and not name.startswith(".") and not is_special(project):
                yield project

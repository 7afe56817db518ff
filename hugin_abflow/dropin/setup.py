"""``hugin-abflow-setup``: make Hugin call us, and undo it."""

from __future__ import annotations

import argparse
import itertools
import re
import shutil
from collections.abc import Sequence
from importlib import resources
from pathlib import Path, PureWindowsPath

from hugin_abflow.dropin import wxconfig
from hugin_abflow.dropin.places import Places, our_places, program
from hugin_abflow.errors import ExitCode, SetupError
from hugin_abflow.metadata import version
from hugin_abflow.scratch import write_whole
from hugin_abflow.terminal import catching, print_result

NAME = "hugin-abflow-setup"
_GROUP = "Enblend"
_BLENDER = "abflow-enblend"
_PROGRAMS = ("hugin-abflow", _BLENDER)

_OURS = re.compile(rf"^Program=(?:.*[/\\])?({'|'.join(_PROGRAMS)})(\.exe)?$", re.MULTILINE | re.IGNORECASE)

_CLICK_INSTALL = """\
In Hugin, once: File, Preferences, tab Programs; as Enblend executable choose
    {program}
(tick "Use alternative Enblend program" first, where there is such a box)."""
_CLICK_UNINSTALL = """\
In Hugin: File, Preferences, tab Programs; untick "Use alternative Enblend program", or write enblend as the
Enblend executable."""
_AFTERWARDS = """\
If Hugin is open, it will write its own preferences over these when it ends: close it, and run this again.
Then its Stitch! button blends by optical flow, and the menu Output, User defined output sequences, has the
sequences (the menu is there once Interface, Advanced is chosen). Undo: hugin-abflow-setup uninstall"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``hugin-abflow-setup`` with `arguments` (default: the process's own); gives its exit code."""
    parser = argparse.ArgumentParser(
        NAME, description="Make Hugin blend by optical flow: its Stitch! button, and output sequences."
    )
    parser.add_argument("action", choices=["install", "uninstall"])
    parser.add_argument("--dry-run", action="store_true", help="say what would be done, and do nothing")
    parser.add_argument("--version", action="version", version=f"{NAME} {version()}")
    try:
        given = parser.parse_args(arguments)
    except SystemExit as end:  # argparse has printed why
        return int(end.code or 0)
    with catching(NAME, verbose=False, program=NAME) as failures:
        action = install if given.action == "install" else uninstall
        done = action(our_places(), given.dry_run)
        print_result("\n".join(["Nothing is done; without --dry-run:", *done] if given.dry_run else done))
    return failures[0] if failures else ExitCode.OK


def install(places: Places, dry_run: bool = False) -> list[str]:
    """Set Hugin's preferences and put the sequences into its folder; gives what was done, in words.

    Raises `SetupError` where our programs are not installed, or files cannot be read or written.
    """
    paths = {name: program(name) for name in _PROGRAMS}
    done: list[str] = []
    for name, content in sequences().items():
        for one, path in paths.items():
            content = content.replace(f"Program={one}\n", f"Program={wxconfig.quoted(path)}\n")
        file = Path(places.data, name)
        done += [*_keep_edited(file, content, dry_run), *_write(file, content, dry_run)]
    # last: where something fails, Hugin's button does what it did
    return [*done, *_set_preferences(places, paths[_BLENDER], dry_run), _AFTERWARDS]


def uninstall(places: Places, dry_run: bool = False) -> list[str]:
    """Undo `install`; gives what was done, in words. Raises `SetupError` as it does."""
    done = _restore_preferences(places, dry_run)
    for name, content in sequences().items():
        path = Path(places.data, name)
        if path.exists():
            done += [*_keep_edited(path, content, dry_run), *_remove(path, dry_run)]
    return done


def sequences() -> dict[str, str]:
    """The output sequences that we ship, by their files' names."""
    folder = resources.files("hugin_abflow.dropin") / "sequences"
    files = sorted(folder.iterdir(), key=lambda file: file.name)
    return {file.name: file.read_text("utf-8") for file in files if file.name.endswith(".executor")}


def _keep_edited(path: Path, shipped: str, dry_run: bool) -> list[str]:
    """Copy a sequence that differs from what we ship to a name that Hugin does not list; what was done."""
    now = _read(path) if path.exists() else None  # where no folder is, writing tells it
    if now is None or _by_name(now) == _by_name(shipped):
        return []
    endings = itertools.chain([".edited"], map(".edited{}".format, itertools.count(2)))
    copies = (path.with_name(path.name + ending) for ending in endings)
    copy = next(copy for copy in copies if _read(copy) in (None, now))  # a second edit is another one
    return [
        f"{path} differs from what this version installs: it is kept as {copy.name}; to have it in Hugin's "
        "menu, give it a name of its own that ends in .executor",
        *_write(copy, now, dry_run),
    ]


def _by_name(sequence: str) -> str:
    """A sequence that calls our programs wherever they are."""
    return _OURS.sub(r"Program=\1", sequence.replace("\r\n", "\n"))


def _set_preferences(places: Places, blender: str, dry_run: bool) -> list[str]:
    click = _CLICK_INSTALL.format(program=blender)
    if places.preferences is None:
        return [click]
    path = Path(places.preferences)
    before = _read(path)
    if before is None and not places.may_create:
        return [
            f"{path} is not there: Hugin has not been run yet, or keeps its preferences elsewhere.",
            click,
        ]
    values = {"Custom": "1", "Exe": wxconfig.quoted(blender)}
    after = wxconfig.changed(before or "", _GROUP, values)
    if after == before:
        return [f"{path}: is set already"]
    # a second time the backup would be what we made of the first
    saved = [] if before is None or _is_ours(before) else _write(_backup(path), before, dry_run)
    if saved and not dry_run:
        shutil.copymode(path, _backup(path))  # what only its owner may read stays so
    return [*saved, *_write(path, after, dry_run), f"    [{_GROUP}] Custom=1 and Exe={blender}"]


def _restore_preferences(places: Places, dry_run: bool) -> list[str]:
    """What was there before; if other preferences were changed since, only ours are taken back."""
    if places.preferences is None:
        return [_CLICK_UNINSTALL]
    path = Path(places.preferences)
    now, before = _read(path), _read(_backup(path))
    if now is None or not _is_ours(now):
        return [f"{path}: another blender is set, or none; left as it is"]
    only_ours = wxconfig.changed(before or "", _GROUP, _values(now)) == now
    restored = before if only_ours else wxconfig.changed(now, _GROUP, _values(before or ""))
    done = _remove(path, dry_run) if restored is None else _write(path, restored, dry_run)
    return done if before is None else [*done, *_remove(_backup(path), dry_run)]


def _values(content: str) -> dict[str, str | None]:
    """What the two keys that we set are; None: not there."""
    return {key: wxconfig.stored(content, _GROUP, key) for key in ("Custom", "Exe")}


def _is_ours(content: str) -> bool:
    return PureWindowsPath(_values(content)["Exe"] or "").stem == _BLENDER


def _backup(path: Path) -> Path:
    return path.with_name(f"{path.name}.before-abflow")


def _read(path: Path) -> str | None:
    """The text of a file; None: there is none. Bytes that are no UTF-8 come through unchanged."""
    try:
        return path.read_bytes().decode("utf-8", "surrogateescape")
    except FileNotFoundError:
        return None
    except OSError as error:
        raise SetupError(f"{path} cannot be read: {error.strerror}") from None


def _write(path: Path, content: str, dry_run: bool) -> list[str]:
    """Write a file whole or not at all; what was done, in words."""
    final = path.resolve()  # through a link: what it points to is replaced, not the link
    if not dry_run:
        try:
            final.parent.mkdir(parents=True, exist_ok=True)
            write_whole(final, content.encode("utf-8", "surrogateescape"))
        except OSError as error:
            raise SetupError(
                f"{path} cannot be written: {error.strerror}; allow writing there, then try again"
            ) from None
    return [f"wrote {path}"]


def _remove(path: Path, dry_run: bool) -> list[str]:
    if not dry_run:
        try:
            path.resolve().unlink()  # through a link, as it was written
        except OSError as error:
            raise SetupError(f"{path} cannot be removed: {error.strerror}") from None
    return [f"removed {path}"]

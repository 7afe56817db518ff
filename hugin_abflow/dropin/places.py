"""Where Hugin keeps what a user may change, and where our programs are."""

from __future__ import annotations

import os
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path, PurePath, PurePosixPath, PureWindowsPath

from hugin_abflow.errors import SetupError


@dataclass(frozen=True)
class Places:
    """Hugin's places on one system.

    preferences     the file of its preferences; None: they are not in a file (Windows has a registry).
    data            the folder in which it looks for output sequences.
    may_create      the preferences may be begun by us; else they are only edited.
    """

    preferences: PurePath | None
    data: PurePath
    may_create: bool


def places(platform: str, environment: dict[str, str], home: str) -> Places:
    """The places on a `sys.platform`, by its environment variables.

    Linux: seen with Hugin 2022.0 (``~/.hugin`` of older ones is not read by it). Windows and macOS: from
    documentation; so on macOS only preferences that are there already are edited.
    """
    if platform == "win32":
        roaming = environment.get("APPDATA") or str(PureWindowsPath(home, "AppData", "Roaming"))
        return Places(None, PureWindowsPath(roaming, "hugin"), False)
    data = PurePosixPath(environment.get("XDG_DATA_HOME") or f"{home}/.local/share", "hugin")
    if platform == "darwin":
        return Places(PurePosixPath(home, "Library", "Preferences", "hugin Preferences"), data, False)
    config = environment.get("XDG_CONFIG_HOME") or f"{home}/.config"
    return Places(PurePosixPath(config, "hugin.conf"), data, True)


def our_places() -> Places:
    """The places on this system."""
    return places(sys.platform, dict(os.environ), str(Path.home()))


def program(name: str) -> str:
    """The full path of one of our programs: beside the one that runs, else in PATH.

    Raises `SetupError` where it is not installed.
    """
    beside = Path(sys.argv[0]).absolute().parent
    found = shutil.which(name, path=str(beside)) or shutil.which(name)
    if found is None:
        raise SetupError(
            f"{name} is neither beside {sys.argv[0]} nor in PATH; install hugin-abflow (pip install .) first"
        )
    return str(Path(found).absolute())

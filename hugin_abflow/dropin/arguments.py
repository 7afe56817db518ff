"""Command lines in GNU getopt's manner, and response files: what scripts written for enblend rely on.

Options may follow files, long names may be shortened as long as they are unambiguous, values that may be
missing must be attached (``-w both`` is an option without a value, and a file), ``--`` ends the options.
"""

from __future__ import annotations

import glob
import logging
import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from hugin_abflow.errors import CommandLineError, LayersMissingError

_log = logging.getLogger(__name__)

_GLOBBING = re.compile(r"#\s*(?:glob|globbing|filename-globbing)\s*:\s*(\S.*)", re.IGNORECASE)


@dataclass(frozen=True)
class Option:
    """One option: its names with their dashes, the first of which is what it is called.

    value       whether it takes one: "optional" ones count only if they are attached (``-w1``, ``--wrap=1``).
    """

    names: tuple[str, ...]
    value: Literal["none", "required", "optional"] = "none"


# An option that was given, with its value.
Given = tuple[Option, str | None]


def parse(arguments: Iterable[str], options: Sequence[Option]) -> tuple[list[Given], list[str]]:
    """Options with their values, in the order given; and what is left, the files.

    Raises `CommandLineError` for an unknown or ambiguous option, a value that is missing or not wanted.
    """
    given: list[Given] = []
    files: list[str] = []
    remaining = iter(arguments)
    for argument in remaining:
        if argument == "--":
            files += remaining
        elif argument.startswith("--"):
            given.append(_long(argument, options, remaining))
        elif argument.startswith("-") and argument != "-":
            given += _short(argument, options, remaining)
        else:
            files.append(argument)
    return given, files


def _long(argument: str, options: Sequence[Option], remaining: Iterable[str]) -> Given:
    """``--name``, ``--name=value`` or ``--name value``."""
    name, equals, attached = argument.partition("=")
    option = _by_long_name(name, options)
    if equals and option.value == "none":
        raise CommandLineError(f"{name} takes no value")
    if equals:
        return option, attached
    return option, _next(name, remaining) if option.value == "required" else None


def _by_long_name(name: str, options: Sequence[Option]) -> Option:
    matches = [option for option in options if name in option.names]
    matches = matches or [option for option in options if any(n.startswith(name) for n in option.names)]
    if not matches:
        raise CommandLineError(f"unknown option {name}")
    if len(matches) > 1:
        names = ", ".join(n for option in matches for n in option.names if n.startswith(name))
        raise CommandLineError(f"{name} may mean any of {names}")
    return matches[0]


def _short(argument: str, options: Sequence[Option], remaining: Iterable[str]) -> list[Given]:
    """``-a``, several as ``-ab``, the last of them with a value: ``-w1``, ``-o name``, ``-oname``."""
    given: list[Given] = []
    for at, letter in enumerate(argument[1:], 2):
        option = next((option for option in options if f"-{letter}" in option.names), None)
        if option is None:
            raise CommandLineError(f"unknown option -{letter}")
        if option.value == "none":
            given.append((option, None))
            continue
        attached = argument[at:] or None
        if attached is None and option.value == "required":
            attached = _next(f"-{letter}", remaining)
        return [*given, (option, attached)]
    return given


def _next(name: str, remaining: Iterable[str]) -> str:
    for argument in remaining:
        return argument
    raise CommandLineError(f"{name} needs a value")


def expand(names: Iterable[str]) -> tuple[list[Path], list[Path]]:
    """Files, where ``@list`` stands for the names in a response file; and the response files that were read.

    A list holds one name a line, relative to its folder; ``#`` begins a comment line; lists may name lists.
    ``#glob: wildcard`` makes patterns of the names that follow, with ``* ? [ ]``, ``#glob: shell`` with
    braces and ``~``, too, and ``#glob: literal`` ends that. A list that names itself is warned of and passed
    over. Raises `CommandLineError` for an empty name, `LayersMissingError` for a list that cannot be read or
    names an empty one, and for a pattern that no file fits.
    """
    files: list[Path] = []
    lists: list[Path] = []
    for name in names:
        if name in ("", "@"):  # as a path it would be the current folder
            wanted = "a list of layers after @" if name else "a layer"
            raise CommandLineError(f"'{name}' among the arguments names no file; name {wanted}")
        files += _listed(Path(name[1:]), lists) if name.startswith("@") else [Path(name)]
    return files, lists


def _listed(
    response: Path, lists: list[Path], globbing: str = "literal", outer: tuple[Path, ...] = ()
) -> list[Path]:
    """The files of a response file, which the lists `outer` name; globbing: how they take names.

    It and those that it names are added to `lists`.
    """
    if response.resolve() in outer:
        _log.warning("%s names itself; passed over", response)
        return []
    lists.append(response)
    files: list[Path] = []
    for number, line in enumerate(_lines(response), 1):
        if chosen := _GLOBBING.fullmatch(line):
            if chosen[1].lower() in _PATTERNS:
                globbing = chosen[1].lower()
            else:
                known = ", ".join(_PATTERNS)
                _log.warning("%s, line %d: '%s' is none of %s", response, number, chosen[1], known)
        elif line == "@":
            raise LayersMissingError(f"{response}, line {number}: @ names no list; correct the list")
        elif line.startswith("@"):
            files += _listed(response.parent / line[1:], lists, globbing, (*outer, response.resolve()))
        elif line and not line.startswith("#"):
            found = _PATTERNS[globbing](line, response.parent)
            if not found:
                raise LayersMissingError(f"{response}, line {number}: no file fits {line}; correct the list")
            files += [response.parent / name for name in found]
    return files


def _fitting(pattern: str, folder: Path) -> list[str]:
    """Names of the files that fit a pattern."""
    return sorted(glob.glob(pattern, root_dir=folder))  # noqa: PTH207 - Path's has no absolute patterns


def _fitting_shells(pattern: str, folder: Path) -> list[str]:
    """The same, of one that may begin with ``~``, and name several in braces, which tell the order."""
    braces = re.search(r"\{([^{}]*)\}", pattern)
    if not braces:
        return _fitting(os.path.expanduser(pattern), folder)  # noqa: PTH111 - as `glob` has it, a text
    before, after = pattern[: braces.start()], pattern[braces.end() :]
    found = [_fitting_shells(before + part + after, folder) for part in braces[1].split(",")]
    return list(dict.fromkeys(name for names in found for name in names))


# How names in a list are taken, by the names that enblend has for that.
_PATTERNS: dict[str, Callable[[str, Path], list[str]]] = {
    "literal": lambda name, folder: [name],
    "none": lambda name, folder: [name],
    "wildcard": _fitting,
    "shell": _fitting_shells,
    "sh": _fitting_shells,
}


def _lines(response: Path) -> list[str]:
    """The lines of a response file, without blanks around them."""
    try:
        return [os.fsdecode(line.strip()) for line in response.read_bytes().splitlines()]
    except OSError as error:
        raise LayersMissingError(
            f"the list {response} cannot be read: {error.strerror}; a name after @ is that of a text file "
            "with a layer's name on each line"
        ) from None

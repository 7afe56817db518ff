"""Options for a shoot: ``abflow.toml`` beside the projects, with the names of the command's options."""

from __future__ import annotations

import difflib
import os
import tomllib
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import tomli_w

from hugin_abflow.errors import ConfigError
from hugin_abflow.scratch import is_folder, is_special

NAME = "abflow.toml"
_MOST_BITS = 64  # of a whole number, as TOML has it


def find_config(project: Path, places: Iterable[Path]) -> Path | None:
    """The settings of a project: in its folder, else in the next one above, up to a folder of `places`.

    What has their name and cannot be read (a link that leads nowhere, a folder) is given, too: `read_config`
    tells of it. A pipe or a device says nothing.
    """
    folder = project.absolute().parent
    tops = {place.absolute() for place in places if is_folder(place)}
    above = [folder, *folder.parents]
    top = next((number for number, one in enumerate(above) if one in tops), 0)
    files = (one / NAME for one in above[: top + 1])
    return next((file for file in files if os.path.lexists(file) and not is_special(file)), None)


def read_config(
    file: Path,
    kinds: Mapping[str, str],
    paths: Iterable[str],
    choices: Mapping[str, Sequence[str]],
    others: Collection[str],
    short: Mapping[str, str],
) -> dict[str, Any]:
    """The options that a file gives, by their names without dashes in front.

    kinds       of each option: "bool", "int", "float", "str" or "list" (of texts).
    paths       options that are files; relative ones are meant from the file's folder.
    choices     of options that take one of a few texts.
    others      options that only the command line can give.
    short       other names that options have on the command line, without dashes, and the options' names.

    Raises `ConfigError` for a file that cannot be read, a section, an unknown option (with a suggestion), or
    a value of another kind.
    """
    try:
        values = tomllib.loads(file.read_text("utf-8-sig"))
    except OSError as error:
        raise ConfigError(
            f"{file} cannot be read: {error.strerror}; mend or remove it, or check --config"
        ) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file} is no TOML: {error}") from None
    except (ValueError, RecursionError):  # which tomllib has for these alone
        raise ConfigError(
            f"{file} cannot be read: it holds a number of thousands of digits, or hundreds of nested lists; "
            "delete that"
        ) from None
    for name, value in values.items():
        if isinstance(value, dict):
            raise ConfigError(
                f"{file}: such files have no sections; give options without [{name}] above them"
            )
        if name in others:
            raise ConfigError(
                f"{file}: there is no option {name!r} for such files; it is for the command line alone"
            )
        if name not in kinds:
            raise ConfigError(
                f"{file}: there is no option {name!r} for such files; {_suggestion(name, kinds, short)}"
            )
        _check(file, name, value, kinds[name], choices.get(name, ()))
    for name in set(paths) & set(values):
        value = values[name]
        values[name] = (
            [str(file.parent / one) for one in value] if isinstance(value, list) else str(file.parent / value)
        )
    return values


def write_config(values: Mapping[str, Any]) -> str:
    """The text of a file that gives these options; those that say nothing are named in a comment."""
    plain = {
        name: [str(one) for one in value]
        if isinstance(value, list | tuple)
        else str(value)
        if isinstance(value, Path)
        else value
        for name, value in values.items()
        if value is not None and value != ()
    }
    silent = ", ".join(name for name in values if name not in plain)
    return tomli_w.dumps(plain) + (f"# not given: {silent}\n" if silent else "")


def _suggestion(name: str, known: Collection[str], short: Mapping[str, str]) -> str:
    """What may have been meant."""
    meant = short.get(name.lstrip("-"))
    if meant in known:
        return f"did you mean {meant!r}?"
    close = difflib.get_close_matches(
        name.replace("_", "-").lstrip("-").lower(), list(known), n=1, cutoff=0.5
    )
    return f"did you mean {close[0]!r}?" if close else "--help lists them, without their dashes"


_WORDS = {
    "bool": "true or false",
    "int": "a whole number",
    "float": "a number",
    "str": 'some text in quotes ("...")',
    "list": 'a list of texts (["...", "..."])',
}


def _check(file: Path, name: str, value: object, kind: str, choices: Sequence[str]) -> None:
    """Raise `ConfigError` unless a value is of its kind; which of its choices it is, is not asked."""
    number = isinstance(value, int) and not isinstance(value, bool) and value.bit_length() <= _MOST_BITS
    fits = {
        "bool": isinstance(value, bool),
        "int": number,
        "float": number or isinstance(value, float),
        "str": isinstance(value, str) and value != "",
        "list": isinstance(value, list) and all(isinstance(one, str) and one for one in value),
    }[kind]
    if not fits:
        *most, last = [f'"{choice}"' for choice in choices] or [_WORDS[kind]]
        wanted = f"{', '.join(most)} or {last}" if most else last
        if value == "":
            raise ConfigError(f"{file}: {name} is empty; give {wanted}, or leave it out")
        raise ConfigError(f"{file}: {name} is {_as_written(value)}; give {wanted}")


def _as_written(value: object) -> str:
    """A value as TOML has it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{', '.join(map(_as_written, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{name} = {_as_written(one)}' for name, one in value.items())}}}"
    if isinstance(value, int) and value.bit_length() > _MOST_BITS:
        return f"a number of more than {_MOST_BITS} bits"  # thousands of digits are an error to str
    return repr(value) if isinstance(value, str) else str(value)

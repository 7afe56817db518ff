"""Click's options and commands as ours are: help with headings, and options that take several files."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import click

from hugin_abflow import memory
from hugin_abflow.encoding import COMPRESSIONS, ENDINGS
from hugin_abflow.errors import SettingsError
from hugin_abflow.formats import holds_project, holds_text, picture_format
from hugin_abflow.scratch import is_special
from hugin_abflow.settings import MOST_MEMORY, Settings

# Enough of a file's beginning to tell a text from a picture, and a project from other texts.
_BEGINNING = 4096
# How JSON that we write begins, be it cut; RTF and other things have a brace, too.
_JSON = re.compile(rb'\s*\{\s*(?:["}]|$)')

# Where a context keeps the arguments as they were given.
ARGUMENTS = "hugin_abflow.arguments"


class Option(click.Option):
    """An option that appears in --help under the heading `group`."""

    def __init__(self, *arguments: Any, group: str, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        self.group = group


class Size(click.ParamType):  # type: ignore[type-arg]
    """Bytes of memory, as `memory.parse_size` reads them; 0, which is no choice in `Settings`, is none."""

    name = "size"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """The number of bytes; ends with click's message for what is none, or out of range."""
        try:
            size = memory.parse_size(value)
        except SettingsError as error:
            self.fail(str(error), param, ctx)
        if not 0 < size <= MOST_MEMORY:
            most = f"{MOST_MEMORY >> 40}T"
            self.fail(f"{value} is out of range; choose more than 0, at most {most}", param, ctx)
        return size


class Compression(click.ParamType):  # type: ignore[type-arg]
    """A name of a compression that some type of file has: it is asked for before layers are made."""

    name = "compression"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The name as it was given; ends with click's message for any other."""
        known = dict.fromkeys(name for names in COMPRESSIONS.values() for name in names)
        if str(value).lower() not in known:
            self.fail(f"{value!r} is no compression; choose one of {', '.join(known)}", param, ctx)
        return str(value)


class Number(click.types.FloatParamType):
    """A number that the setting of the option's name may have, by `Settings`' own range."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """The number; ends with click's message, which names the option, for one out of range."""
        number = float(super().convert(value, param, ctx))
        if param is not None:
            chosen: dict[str, Any] = {str(param.name): number}
            try:
                Settings(**chosen)
            except SettingsError as error:
                self.fail(str(error).removeprefix(f"{param.name} is "), param, ctx)
        return number


class Text(click.ParamType):  # type: ignore[type-arg]
    """A text that is not empty, as where a script's variable is not set."""

    name = "text"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The text; ends with click's message where there is none."""
        _refuse_no_name(self, value, param, ctx)
        return str(value)


def _refuse_no_name(
    kind: click.ParamType,  # type: ignore[type-arg]
    value: object,
    param: click.Parameter | None,
    ctx: click.Context | None,
) -> None:
    if value == "":  # of a path pathlib would make the current folder
        kind.fail("it is empty; name something, or leave it out (is a variable not set?)", param, ctx)
    if isinstance(value, str) and "\0" in value:
        kind.fail("it has a NUL, which no file's name has; choose another", param, ctx)


class OldFile(click.Path):
    """A file to be read, or a folder; whether it can be is told where it is: of several projects it stops
    none but its own.
    """

    def __init__(self) -> None:
        super().__init__(readable=False, path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Its path; ends with click's message where it has no name."""
        _refuse_no_name(self, value, param, ctx)
        return Path(os.fsdecode(super().convert(value, param, ctx)))


class NewFile(click.Path):
    """A file to be written, which must not be a project, nor a photo: somebody who writes ``--log *.pto``
    forgot the log's name, and named a project. Both are told by their names and by what they hold, since
    camera raws, hard links and Hugin's temporary projects have other names.

    image           an image is written; that it takes no photo's place is seen to later.
    replaced        JSON is written in place of what is there, which has to be JSON as well: notes, settings
                    and sidecars of photos are texts, too. Else a text is written, to the end of the file.
    """

    def __init__(self, image: bool = False, replaced: bool = False) -> None:
        super().__init__()
        self.image, self.replaced = image, replaced

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Its path; ends with click's message if it is empty, or what is there must stay."""
        _refuse_no_name(self, value, param, ctx)
        path = Path(os.fsdecode(super().convert(value, param, ctx)))
        for name in (str(path).lower(), os.path.realpath(path).lower()):
            if name.endswith(".pto"):
                self.fail(f"{value} is a project, which is never written to; name another file", param, ctx)
            if name.endswith(tuple(ENDINGS)) and not self.image:
                self.fail(f"{value} is an image by its name; name another file", param, ctx)
        data = b"" if self.image else _beginning(path)
        if not holds_text(data) or picture_format(data):
            self.fail(f"{value} is there, and may be a photo: it is no text; name another file", param, ctx)
        if holds_project(data):
            self.fail(f"{value} holds a project, which is never written to; name another file", param, ctx)
        if self.replaced and data.strip() and not _JSON.match(data):
            self.fail(
                f"{value} is there, and would be replaced, but is no JSON, so another program wrote it; name "
                "another file, or remove it",
                param,
                ctx,
            )
        return path


def _beginning(path: Path) -> bytes:
    """The first bytes of a file; none of one that is not there, or that cannot be looked into."""
    with suppress(OSError):  # writing will tell what is the matter
        if not is_special(path):  # who opens a pipe waits until somebody writes
            with path.open("rb") as file:
                return file.read(_BEGINNING)
    return b""


class Command(click.Command):
    """A command whose help has headings, and whose `--layers` takes several files.

    examples    commands and what they do, exit_codes: and what they mean; shown at the end of the help.
    """

    def __init__(
        self,
        *arguments: Any,
        examples: Sequence[tuple[str, str]],
        exit_codes: Mapping[Any, str],
        **keywords: Any,
    ) -> None:
        super().__init__(*arguments, **keywords)
        self.examples, self.exit_codes = examples, exit_codes

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse `args` after spreading `--layers`."""
        ctx.meta[ARGUMENTS] = list(args)
        return super().parse_args(ctx, spread_layers(args))

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, a section for each group in order of first appearance."""
        groups: dict[str, list[tuple[str, str]]] = {}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is not None and isinstance(parameter, click.Option):
                groups.setdefault(getattr(parameter, "group", "Information"), []).append(record)
        for heading, records in groups.items():
            with formatter.section(heading):
                formatter.write_dl(records)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write examples and exit codes."""
        with formatter.section("Examples"):
            for example, effect in self.examples:
                formatter.write(f"  {example}\n      {effect}\n")
        with formatter.section("Exit codes"):
            formatter.write_dl([(str(int(code)), text) for code, text in self.exit_codes.items()])


def spread_layers(arguments: Sequence[str]) -> list[str]:
    """Write ``--layers a b`` as ``--layers a --layers b``, the only form that click understands.

    The list ends at the next option, at ``--`` and at a name that ends in .pto: that is a project.
    """
    spread: list[str] = []
    remaining = iter(arguments)
    listing = False
    for argument in remaining:
        if argument == "--":
            return [*spread, argument, *remaining]
        if argument.startswith("-") and argument != "-":
            listing = argument == "--layers" or argument.startswith("--layers=")
        elif argument.lower().endswith(".pto"):
            listing = False
        elif listing and spread[-1] != "--layers":
            spread.append("--layers")
        spread.append(argument)
    return spread


def long_name(option: click.Option) -> str:
    """Its name without dashes in front."""
    return max(option.opts, key=len).lstrip("-")


def long_names(command: click.Command) -> dict[str, click.Option]:
    """The options of a command that take part in settings, by their long names without dashes in front."""
    return {
        long_name(option): option
        for option in command.params
        if isinstance(option, click.Option) and option.expose_value and not option.is_eager
    }


def kind_of(option: click.Option) -> str:
    """What kind of value an option takes: "bool", "int", "float", "str" or "list" (of texts)."""
    if option.is_flag:
        return "bool"
    if option.multiple:
        return "list"
    if isinstance(option.type, click.types.IntParamType):  # click.IntRange is one
        return "int"
    return "float" if isinstance(option.type, click.types.FloatParamType) else "str"

"""What a user chose: options of the command line, else of a file of settings, else the defaults."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from hugin_abflow.batch.config import NAME, read_config, write_config
from hugin_abflow.encoding import ENDINGS
from hugin_abflow.errors import ConfigError
from hugin_abflow.oneline import commented
from hugin_abflow.options import kind_of, long_name, long_names
from hugin_abflow.settings import Settings

# Options that a file of settings cannot give.
_UNSETTLED = frozenset({"config", "print-config", "dry-run", "watch"})
# Parameters that are not about one project, but the run as a whole.
OF_THE_RUN = frozenset(
    {
        "projects", "recursive", "watch", "resume", "force", "jobs", "report", "log", "quiet", "verbose",
        "profile", "scheduler", "config", "print_config", "dry_run",
    }
)  # fmt: skip

# Parameters of which only one may be given, and what is said of both.
_RIVALS = (
    ("quiet", "verbose", "-q and -v contradict each other"),
    ("resume", "force", "--resume and --force contradict each other"),
    ("prefix", "layers", "--prefix and --layers both name the layers; give one of them"),
)
# Parameters that say what is made of which files; `shown.show_project` puts them into its commands.
_OF_FILES = frozenset(
    {"output", "prefix", "layers", "remap", "keep_layers", "compression", "jpeg_quality"}
)  # fmt: skip


def choose(
    command: click.Command, arguments: Sequence[str], file: Path | None, alone: bool = True
) -> dict[str, Any]:
    """All options of a command by their parameters.

    arguments   of the command line. What they say against an option of the file, that says nothing.
    file        of settings; None: there is none.
    alone       the file may say something about the run as a whole.

    Raises `ConfigError` for what the file should not say, and `click.UsageError` for the arguments.
    """
    values = {} if file is None else _read(command, file)
    names = long_names(command)
    whole = sorted(name for name in values if names[name].name in OF_THE_RUN)
    if whole and not alone:
        raise ConfigError(
            f"{file}: {whole[0]} is for the whole run; give it on the command line, or in {NAME} beside "
            "what is named first"
        )
    defaults = {str(names[name].name): value for name, value in values.items()}
    try:
        params, given = _parsed(command, arguments, defaults)
        overruled = {rival for name in given for rival in _rivals(name, params)} & defaults.keys() - given
        if overruled:
            rest = {name: value for name, value in defaults.items() if name not in overruled}
            params, _ = _parsed(command, arguments, rest)
    except click.UsageError as error:
        if file is None:
            raise
        raise ConfigError(f"{file}: {error.format_message()}") from None
    for one, other, both in _RIVALS:
        if params.get(one) and params.get(other):
            raise click.UsageError(both) if given >= {one, other} else ConfigError(f"{file}: {both}")
    return params


def _parsed(
    command: click.Command, arguments: Sequence[str], defaults: Mapping[str, Any]
) -> tuple[dict[str, Any], set[str]]:
    """All options by their parameters, and which of these the command line gives; a flag that it takes back
    is not given.
    """
    with command.make_context(command.name, list(arguments), default_map=dict(defaults)) as context:
        typed = click.core.ParameterSource.COMMANDLINE
        given = {name for name in context.params if context.get_parameter_source(name) is typed}
        return dict(context.params), {name for name in given if context.params[name]}


def _rivals(name: str, params: Mapping[str, Any]) -> set[str]:
    """The parameters that say something against one."""
    rivals = {other if name == one else one for one, other, _ in _RIVALS if name in (one, other)}
    if name in ("prefix", "layers") and params["remap"] == "always":
        rivals.add("remap")
    if name == "remap" and params["remap"] == "always":
        rivals |= {"prefix", "layers"}
    return rivals


def ineffective(values: Mapping[str, Any]) -> list[str]:
    """Warnings of options that are chosen and change nothing beside others that are. What is switched off
    twice is none of them.
    """
    warnings = []

    def warn(options: Sequence[str], reason: str) -> None:
        if options:
            warnings.append(f"of no effect: {', '.join(options)}, since {reason}")

    if values["no_flow"]:
        searched = ["--large-motion on"] if values["large_motion"] == "on" else []
        weighed = ["--flow-magnitude"] if values["flow_magnitude"] != Settings.flow_magnitude else []
        warn(searched + weighed, "--no-flow finds no flow; leave out one or the other")
    if values["keep_layers"]:
        named = next((f"--{name}" for name in ("prefix", "layers") if values[name]), None)
        taken = named or ("--remap never" if values["remap"] == "never" else None)
        warn(["--keep-layers"] if taken else [], f"{taken} takes layers that are there")
    if values["jpeg_quality"] and (output := values["output"]):
        is_jpeg = (
            ENDINGS.get(output.suffix.lower()) == "jpeg" or (values["compression"] or "").lower() == "jpeg"
        )
        warn([] if is_jpeg else ["--jpeg-quality"], f"{output} is no JPEG, nor is --compression jpeg given")
    if values["scheduler"] and values["jobs"]:
        warn(["--jobs"], "--scheduler takes as many projects at a time as the cluster has workers")
    return warnings


def for_several(values: Mapping[str, Any], why: str, file: Path | None) -> None:
    """Raise `click.UsageError` for options that name the files of one project, `ConfigError` if it is `file`
    that gives them; why: there may be several.
    """
    source = click.get_current_context().get_parameter_source
    for name, option in (("output", "-o"), ("layers", "--layers")):
        if values[name] and source(name) is click.core.ParameterSource.COMMANDLINE:
            raise click.UsageError(f"{option} is for one project, but {why}")
        if values[name]:
            raise ConfigError(f"{file}: {name} is for one project, but {why}")


def words(command: click.Command, values: Mapping[str, Any]) -> list[str]:
    """What one would type for `values` that are not the defaults, but for those of the run and of files."""
    context = click.Context(command)
    said: list[str] = []
    for name, option in long_names(command).items():
        value = values[str(option.name)]
        if option.name not in OF_THE_RUN | _OF_FILES and value not in (None, option.get_default(context)):
            said += [f"--{name}"] if option.is_flag else [f"--{name}", str(value)]
    return said


def _known(command: click.Command) -> dict[str, str]:
    """Kinds of the options that a file may give."""
    return {name: kind_of(option) for name, option in long_names(command).items() if name not in _UNSETTLED}


def _read(command: click.Command, file: Path) -> dict[str, Any]:
    """What a file gives. Raises `ConfigError`."""
    names = long_names(command)
    kinds = _known(command)
    types = {name: option.type for name, option in names.items()}
    paths = [name for name in kinds if isinstance(types[name], click.Path)]
    choices = {name: list(kind.choices) for name, kind in types.items() if isinstance(kind, click.Choice)}
    options = [param for param in command.params if isinstance(param, click.Option)]
    others = set(map(long_name, options)) - kinds.keys()
    short = {one.lstrip("-"): name for name, option in names.items() for one in option.opts}
    return read_config(file, kinds, paths, choices, others, short)


def config_texts(
    command: click.Command, chosen: Mapping[Path, tuple[Path | None, Mapping[str, Any]]]
) -> Iterator[str]:
    """The answer to --print-config: options as they would be in a file of settings, once for each such file.

    chosen      by project: its file, if it has one, and its options; a path without a name is no project.
    """
    names = long_names(command)
    for file in dict.fromkeys(file for file, _ in chosen.values()):
        projects = [project for project, (its_file, _) in chosen.items() if its_file == file]
        values = chosen[projects[0]][1]
        plain = {name: values[str(names[name].name)] for name in _known(command)}
        origin = [str(file or f"no {NAME}"), *(f"for {one}" for one in projects if one.name)]
        yield "\n".join([*map(commented, origin), write_config(plain)])

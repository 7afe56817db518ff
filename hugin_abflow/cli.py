"""The command line: options become `Settings`, errors become messages and exit codes."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, get_args

import click

from hugin_abflow import trace
from hugin_abflow.errors import AbflowError, ExitCode
from hugin_abflow.images import COMPRESSIONS
from hugin_abflow.merge import merge_project
from hugin_abflow.metadata import PROGRAM, version
from hugin_abflow.nona import Remap
from hugin_abflow.opencl import list_devices
from hugin_abflow.settings import FlowQuality, MergeMode, Settings
from hugin_abflow.terminal import (
    catching,
    complain,
    display_progress,
    interruptible,
    messages,
    phase_table,
    print_path,
    say,
)

EXIT_CODES = {
    ExitCode.OK: "every panorama was written",
    ExitCode.FAILED: "any other error; with several projects: all failed, for different reasons",
    ExitCode.USAGE: "the command line is wrong",
    ExitCode.PROJECT: "the project cannot be read, or makes no panorama",
    ExitCode.LAYERS_MISSING: "layers or photos are missing",
    ExitCode.LAYERS_MISMATCH: "the layers do not belong together (size, depth or channels)",
    ExitCode.IMAGE_READ: "a layer cannot be decoded",
    ExitCode.OUTPUT: "the panorama cannot be written",
    ExitCode.NONA: "nona is missing, or failed",
    ExitCode.DEVICE: "no usable OpenCL device",
    ExitCode.PARTIAL: "several projects: some succeeded, some failed",
    ExitCode.INTERRUPTED: "interrupted (Ctrl-C, SIGTERM); nothing half-written is left",
}

EXAMPLES = (
    ("hugin-abflow harbour.pto", "remap with nona, blend, write beside the project"),
    ("hugin-abflow -o harbour.jpg --jpeg-quality 92 harbour.pto", "choose name and type"),
    ("hugin-abflow --prefix harbour harbour.pto", "use harbour0000.tif, harbour0001.tif ..."),
    ("hugin-abflow harbour.pto --layers a.tif b.tif c.tif", "use these layers"),
    ("hugin-abflow */*.pto", "one panorama for each project"),
)

_DEFAULTS = Settings()


class _Option(click.Option):
    """An option that appears in --help under the heading `group`."""

    def __init__(self, *arguments: Any, group: str, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        self.group = group


class _Command(click.Command):
    """A command whose help has headings, and whose `--layers` takes several files."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse `args` after spreading `--layers`."""
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
            for example, effect in EXAMPLES:
                formatter.write(f"  {example}\n      {effect}\n")
        with formatter.section("Exit codes"):
            formatter.write_dl([(str(int(code)), text) for code, text in EXIT_CODES.items()])


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


def _print_devices(context: click.Context, parameter: click.Parameter, wanted: bool) -> None:
    """Answer --list-devices and end."""
    if not wanted or context.resilient_parsing:
        return
    for device in list_devices():
        default = ", default" if device.default else ""
        memory = f"{device.memory / 2**30:.1f} GiB"
        click.echo(f"{device.index}: {device.name} ({device.kind}, {memory}, {device.platform}{default})")
    context.exit(ExitCode.OK)


def _names_of_compressions() -> str:
    """``TIFF: none, lzw ...; EXR: ...``."""
    return "; ".join(f"{kind}: {', '.join(names)}" for kind, names in COMPRESSIONS.items())


_file = click.Path(path_type=Path)
_layers = partial(click.option, cls=_Option, group="Layers")
_blending = partial(click.option, cls=_Option, group="Blending", show_default=True)
_result = partial(click.option, cls=_Option, group="Result")
_information = partial(click.option, cls=_Option, group="Information")


@click.command(cls=_Command, add_help_option=False)
@click.argument("projects", metavar="PROJECT...", nargs=-1, required=True, type=_file)
@_result(
    "-o",
    "--output",
    metavar="FILE",
    type=_file,
    help="The panorama; its ending chooses the type: .tif, .jpg, .png or .exr. Only with one project. "
    "[default: name and type that the project asks for, beside it]",
)
@_result(
    "--compression",
    metavar="NAME",
    help=f"Compression of the file. {_names_of_compressions()}. "
    "[default: the project's; TIFF: else lzw; EXR: else zip]",
)
@_result(
    "--jpeg-quality",
    metavar="PERCENT",
    type=click.IntRange(1, 100),
    help="JPEG quality. [default: the project's]",
)
@_result(
    "--no-metadata",
    is_flag=True,
    help="Write no camera, date and place of the first photo, and nothing that tells viewers of 360-degree "
    "panoramas how to show it.",
)
@_layers(
    "--prefix",
    metavar="PREFIX",
    help="Take the layers PREFIX0000.tif, PREFIX0001.tif ..., as they are; relative to the current or the "
    "project's folder. [default: the project's name, then Hugin's default prefix]",
)
@_layers(
    "--layers",
    metavar="FILE...",
    multiple=True,
    type=_file,
    help="Take these layers, as they are, whatever their names. The list ends at the next option or at a "
    "name that ends in .pto. Only with one project.",
)
@_layers(
    "--remap",
    type=click.Choice(get_args(Remap)),
    default="auto",
    show_default=True,
    help="Make the layers with nona. auto: only if they are missing or older than the project or its photos.",
)
@_layers("--keep-layers", is_flag=True, help="Keep the layers that nona made, beside the project.")
@_blending(
    "--merge",
    type=click.Choice(get_args(MergeMode)),
    default=_DEFAULTS.merge,
    help="joint: all layers at once. sequential: two at a time, as published; for comparison.",
)
@_blending(
    "--exposure",
    type=click.Choice(["auto", "off"]),
    default="auto" if _DEFAULTS.exposure else "off",
    help="Match brightness and colour of the layers. off: leave them as nona made them.",
)
@_blending(
    "--guides",
    type=click.Choice(["auto", "off"]),
    default="auto" if _DEFAULTS.guides else "off",
    help="Let the project's control points lead the flow where it goes astray. off: leave them aside.",
)
@_blending(
    "--large-motion",
    type=click.Choice(["on", "off"]),
    default="on" if _DEFAULTS.large_motion else "off",
    help="Search for motion of up to a tenth of the canvas's width: very near things; grids may mislead it.",
)
@_blending(
    "--seam",
    type=click.Choice(["auto", "off"]),
    default="auto" if _DEFAULTS.seam else "off",
    help="Take from one photo, whole, what flow cannot explain (somebody who walked). off: blend it.",
)
@_blending(
    "--softmax-sharpness",
    metavar="NUMBER",
    type=float,
    default=_DEFAULTS.softmax_sharpness,
    show_default=False,  # click would write 10.0
    help="How suddenly one layer takes over from the next, 0 (average) to 1000 (cut). "
    f"[default: {_DEFAULTS.softmax_sharpness:g}]",
)
@_blending(
    "--flow-magnitude",
    metavar="NUMBER",
    type=float,
    default=_DEFAULTS.flow_magnitude,
    show_default=False,
    help="How much a layer in which near things shift is preferred, 0 (not) to 10000. "
    f"[default: {_DEFAULTS.flow_magnitude:g}]",
)
@_blending(
    "--no-flow",
    is_flag=True,
    show_default=False,  # click would write False
    help="Do not bring the photos together by optical flow: match brightness and colour, and cut where it "
    "shows least.",
)
@_blending(
    "--flow-quality",
    type=click.Choice(get_args(FlowQuality)),
    default=_DEFAULTS.flow_quality,
    help="Time against quality of the optical flow. fast: coarser, in less than half the flow's time. "
    "best: finer on panoramas above 2 megapixels, in up to three times of it.",
)
@_blending(
    "--device",
    metavar="DEVICE",
    show_default=False,
    help="The OpenCL device: its number in --list-devices, or a part of its name. "
    "[default: the fastest GPU, else the CPU]",
)
@_information(
    "--list-devices",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_devices,
    help="List the OpenCL devices and exit.",
)
@_information("-q", "--quiet", is_flag=True, help="Print nothing but warnings and errors.")
@_information("-v", "--verbose", is_flag=True, help="Say what is done and how long it takes.")
@_information(
    "--profile",
    metavar="FILE",
    type=_file,
    help="Write where the time goes, as a trace (JSON) that chrome://tracing and ui.perfetto.dev open.",
)
@click.version_option(
    version(), prog_name=PROGRAM, message="%(prog)s %(version)s", help="Print the version and exit."
)
@click.help_option("-h", "--help", help="Show this help and exit.")
def command(
    projects: tuple[Path, ...],
    output: Path | None,
    compression: str | None,
    jpeg_quality: int | None,
    no_metadata: bool,
    prefix: str | None,
    layers: tuple[Path, ...],
    remap: Remap,
    keep_layers: bool,
    merge: MergeMode,
    exposure: str,
    guides: str,
    large_motion: str,
    seam: str,
    softmax_sharpness: float,
    flow_magnitude: float,
    no_flow: bool,
    flow_quality: FlowQuality,
    device: str | None,
    quiet: bool,
    verbose: bool,
    profile: Path | None,
) -> ExitCode:
    """Blend the photos of Hugin projects into panoramas, by optical flow.

    PROJECT is a .pto file as Hugin saves it. Its photos must already be aligned; they are remapped with
    Hugin's nona where no layers are at hand. Things that stand in different places in two photos, because the
    camera moved, are brought together where the photos overlap instead of being cut or shown twice.

    The names of the panoramas are printed, a line each.
    """
    if len(projects) > 1 and (output or layers):
        option = "-o" if output else "--layers"
        raise click.UsageError(f"{option} is for one project, but there are {len(projects)}")
    if prefix is not None and layers:
        raise click.UsageError("--prefix and --layers both name the layers; give one of them")
    if quiet and verbose:
        raise click.UsageError("-q and -v contradict each other")
    settings = Settings(
        merge=merge,
        softmax_sharpness=softmax_sharpness,
        flow_magnitude=flow_magnitude,
        flow=not no_flow,
        flow_quality=flow_quality,
        exposure=exposure == "auto",
        guides=guides == "auto",
        seam=seam == "auto",
        large_motion=large_motion == "on",
        device=device,
    )
    merge_one = partial(
        merge_project,
        settings=settings,
        output=output,
        prefix=prefix,
        layers=list(layers) or None,
        remap=remap,
        keep_layers=keep_layers,
        compression=compression,
        jpeg_quality=jpeg_quality,
        metadata=not no_metadata,
    )
    codes = []
    with messages(logging.INFO if verbose else logging.WARNING), trace.recording(profile):
        for project in projects:
            heading = f"{project.name}: " if len(projects) > 1 else ""
            with (
                catching(str(project), verbose) as failures,
                display_progress(heading, quiet, verbose) as display,
                phase_table(heading, trace.phases(display), verbose) as progress,
            ):
                panorama = merge_one(project, progress=progress)
            if not failures and not quiet:
                print_path(panorama)
            codes.append(failures[0] if failures else ExitCode.OK)
    return _combine(codes)


def _combine(codes: Sequence[ExitCode]) -> ExitCode:
    """The exit code of a run whose projects ended with `codes`."""
    if len(set(codes)) == 1:
        return codes[0]
    return ExitCode.PARTIAL if ExitCode.OK in codes else ExitCode.FAILED


def _run(arguments: Sequence[str] | None) -> int:
    """Run click's command; every error that ends a run passes here."""
    try:
        return int(command.main(arguments, prog_name=PROGRAM, standalone_mode=False))
    except (click.Abort, KeyboardInterrupt):
        say(f"{PROGRAM}: interrupted")
        return ExitCode.INTERRUPTED
    except click.ClickException as error:
        complain(f"{error.format_message()}\nTry '{PROGRAM} --help'.")
        return ExitCode.USAGE
    except AbflowError as error:
        complain(str(error))
        return error.exit_code


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``hugin-abflow`` with `arguments` (default: the process's own) and return its exit code."""
    with interruptible():
        return _run(arguments)

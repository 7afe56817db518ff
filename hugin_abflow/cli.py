"""The command line: options become `Settings`, errors become messages and exit codes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, get_args

import click

from hugin_abflow import process
from hugin_abflow.batch.config import NAME, find_config
from hugin_abflow.batch.queue import find_projects, refuse_same_output
from hugin_abflow.batch.run import Run, default_jobs, run, show
from hugin_abflow.batch.task import Task
from hugin_abflow.batch.watch import watch
from hugin_abflow.choices import OF_THE_RUN, choose, config_texts, for_several, ineffective, words
from hugin_abflow.devices import list_devices
from hugin_abflow.encoding import COMPRESSIONS
from hugin_abflow.errors import EXIT_CODES, AbflowError, ExitCode
from hugin_abflow.found import Remap
from hugin_abflow.metadata import PROGRAM, version
from hugin_abflow.options import ARGUMENTS, Command, Compression, NewFile, Number, OldFile, Option, Size, Text
from hugin_abflow.scratch import is_folder, misnamed_root
from hugin_abflow.settings import FlowQuality, LargeMotion, MergeMode, Settings
from hugin_abflow.signals import interruptible
from hugin_abflow.terminal import complain, print_result, say, system_error

EXAMPLES = (
    ("hugin-abflow harbour.pto", "remap with nona, blend, write beside the project"),
    ("hugin-abflow -o harbour.jpg --jpeg-quality 92 harbour.pto", "choose name and type"),
    ("hugin-abflow --prefix harbour harbour.pto", "use harbour0000.tif, harbour0001.tif ..."),
    ("hugin-abflow harbour.pto --layers a.tif b.tif c.tif", "use these layers"),
    ("hugin-abflow --recursive shoot", "one panorama for each project in a folder and its folders"),
)

_DEFAULTS = Settings()
_COMPRESSIONS = "; ".join(f"{kind}: {', '.join(names)}" for kind, names in COMPRESSIONS.items())


def _print(text: Callable[[click.Context], str]) -> Callable[..., None]:
    """The callback of an option that is answered by a text, and ends the run."""

    def callback(context: click.Context, parameter: click.Parameter, wanted: bool) -> None:
        if wanted and not context.resilient_parsing:
            print_result(text(context))
            context.exit(ExitCode.OK)

    return callback


def _devices(context: click.Context) -> str:
    """The answer to --list-devices."""
    return "\n".join(
        f"{one.index}: {one.name} ({one.kind}, {one.memory / 2**30:.1f} GiB, {one.platform}"
        f"{', default' if one.default else ''})"
        for one in list_devices()
    )


_file, _new_file, _new_image = OldFile(), NewFile(replaced=True), NewFile(image=True)
_layers = partial(click.option, cls=Option, group="Layers")
_blending = partial(click.option, cls=Option, group="Blending", show_default=True)
_switch = partial(_blending, type=click.Choice(["auto", "off"]), default="auto")
_result = partial(click.option, cls=Option, group="Result")
_batch = partial(click.option, cls=Option, group="Many projects")
_resources = partial(click.option, cls=Option, group="Resources")
_information = partial(click.option, cls=Option, group="Information")
_question = partial(_information, is_flag=True, is_eager=True, expose_value=False)


@click.command(cls=Command, examples=EXAMPLES, exit_codes=EXIT_CODES, add_help_option=False)
@click.argument("projects", metavar="PROJECT...", nargs=-1, type=_file)
@_result(
    "-o",
    "--output",
    metavar="FILE",
    type=_new_image,
    help="The panorama; its ending chooses the type: .tif, .jpg, .png or .exr. Only with one project. "
    "[default: name and type that the project asks for, beside it]",
)
@_result(
    "--compression",
    metavar="NAME",
    type=Compression(),
    help=f"Compression of the file. {_COMPRESSIONS}. [default: the project's; TIFF: else lzw; EXR: else zip]",
)
@_result(
    "--jpeg-quality",
    metavar="PERCENT",
    type=click.IntRange(1, 100),
    help="Quality of JPEG, and of jpeg in TIFF. [default: the project's]",
)
@_result(
    "--no-metadata/--metadata",
    is_flag=True,
    help="Write no camera, date, place, title, authors, rights and keywords of the first photo, and nothing "
    "that tells viewers of 360-degree panoramas how to show it.",
)
@_layers(
    "--prefix",
    metavar="PREFIX",
    type=Text(),
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
    help="Make the layers with nona. auto: only if they are missing or older than the project or its photos, "
    "or some cannot be opened, have no alpha or are of another canvas.",
)
@_layers(
    "--keep-layers/--no-keep-layers",
    is_flag=True,
    help="Keep the layers that nona made, beside the project.",
)
@_blending(
    "--merge",
    type=click.Choice(get_args(MergeMode)),
    default=_DEFAULTS.merge,
    help="joint: all layers at once. sequential: two at a time, as published; for comparison.",
)
@_switch(
    "--exposure",
    help="Match brightness and colour, and blend low frequencies widely. off: leave both as nona made them.",
)
@_switch(
    "--guides",
    help="Let the project's control points lead the flow where it goes astray. off: leave them aside.",
)
@_blending(
    "--large-motion",
    type=click.Choice(get_args(LargeMotion)),
    default=_DEFAULTS.large_motion,
    help="Search for motion of up to a tenth of the canvas's width (very near things). auto: keep what makes "
    "photos clearly more alike, unless it is small and walked; on: all that is found, even if grids mislead.",
)
@_switch(
    "--seam",
    help="Take from one photo, whole, what flow cannot explain (somebody who walked). off: blend it.",
)
@_switch(
    "--clones",
    help="Show somebody once whom two photos show at two places, unless that cuts him. off: at both.",
)
@_blending(
    "--softmax-sharpness",
    metavar="NUMBER",
    type=Number(),
    default=_DEFAULTS.softmax_sharpness,
    show_default=False,  # click would write 10.0
    help="How suddenly one layer takes over from the next, 0 (average) to 1000 (cut). "
    f"[default: {_DEFAULTS.softmax_sharpness:g}]",
)
@_blending(
    "--flow-magnitude",
    metavar="NUMBER",
    type=Number(),
    default=_DEFAULTS.flow_magnitude,
    show_default=False,
    help="How much a layer in which near things shift is preferred, 0 (not) to 10000. "
    f"[default: {_DEFAULTS.flow_magnitude:g}]",
)
@_blending(
    "--no-flow/--flow",
    is_flag=True,
    show_default=False,  # click would write False
    help="Do not bring the photos together by optical flow: cut where it shows least, and blend across the "
    "cuts in bands of frequencies.",
)
@_blending(
    "--flow-quality",
    type=click.Choice(get_args(FlowQuality)),
    default=_DEFAULTS.flow_quality,
    help="Time against quality of the optical flow. fast: coarser, in three quarters of the flow's time or "
    "less. best: much finer on panoramas above 1.6 megapixels, in up to 15 times of it.",
)
@_blending(
    "--device",
    metavar="DEVICE",
    type=Text(),
    show_default=False,
    help="The OpenCL device: its number in --list-devices, or a part of its name. "
    "[default: the fastest GPU, else the CPU]",
)
@_batch("--recursive", is_flag=True, help="Look for projects in the folders of folders, too.")
@_batch(
    "--watch",
    metavar="FOLDER",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="Stitch the projects of FOLDER as they are saved, until interrupted.",
)
@_batch(
    "--resume",
    is_flag=True,
    help="Skip panoramas that still hold: same project, photos, settings and version as when they were made. "
    "This is what happens where several projects or a folder are named.",
)
@_batch("--force", is_flag=True, help="Make all panoramas anew, also those that hold or that you changed.")
@_batch(
    "--jobs",
    metavar="N",
    type=click.IntRange(1, 64),
    help="Projects at a time, 1 to 64: while one computes, layers of the next are made. "
    f"[default: {default_jobs()} on this machine]",
)
@_batch(
    "--scheduler",
    metavar="ADDRESS",
    type=Text(),
    help="Have the workers of a Dask cluster do the work, over shared storage. ADDRESS: of its scheduler, "
    "such as tcp://host:8786.",
)
@_batch(
    "--report",
    metavar="FILE",
    type=_new_file,
    help="Write what became of each project, with times and figures, into FILE, as JSON.",
)
@_batch(
    "--config",
    metavar="FILE",
    type=_file,
    help=f"Take options from FILE. [default: {NAME} beside each project, or above it up to a named folder]",
)
@_batch("--print-config", is_flag=True, help=f"Print all options as they would be in {NAME}, and exit.")
@_batch("--log", metavar="FILE", type=NewFile(), help="Add all messages, with the time, to the end of FILE.")
@_resources(
    "--max-memory",
    metavar="SIZE",
    type=Size(),
    help="Memory that may be taken, the device's included, such as 800M or 1.5G; it changes no pixel. "
    "[default: half of the machine's]",
)
@_resources(
    "--threads",
    metavar="NUMBER",
    type=click.IntRange(1, 1024),
    help="Processor cores to use, 1 to 1024; it changes no pixel. [default: all]",
)
@_question("--list-devices", callback=_print(_devices), help="List the OpenCL devices and exit.")
@_information(
    "--dry-run", is_flag=True, help="Print what would be made, and the commands that make it; do nothing."
)
@_information("-q", "--quiet", is_flag=True, help="Print nothing but warnings and errors.")
@_information("-v", "--verbose", is_flag=True, help="Say what is done and how long it takes.")
@_information(
    "--profile",
    metavar="FILE",
    type=_new_file,
    help="Write where the time goes, as a trace (JSON) that chrome://tracing and ui.perfetto.dev open.",
)
@_question(
    "--version", callback=_print(lambda _: f"{PROGRAM} {version()}"), help="Print the version and exit."
)
@_question("-h", "--help", callback=_print(click.Context.get_help), help="Show this help and exit.")
def command(projects: tuple[Path, ...], **given: Any) -> ExitCode:
    """Blend the photos of Hugin projects into panoramas, by optical flow.

    PROJECT is a .pto file as Hugin saves it, or a folder of such files. Its photos must already be aligned;
    they are remapped with Hugin's nona where no layers are at hand. Things that stand in different places in
    two photos, because the camera moved, are brought together where the photos overlap instead of being cut
    or shown twice.

    The names of the panoramas are printed, a line each.
    """
    config: Path | None = given["config"]
    places = [*projects, given["watch"]] if given["watch"] else list(projects)
    if not places and not given["print_config"]:
        named = " --layers takes all files that follow it; name the project first." if given["layers"] else ""
        raise click.UsageError(f"Missing argument 'PROJECT...'.{named}")
    if projects and given["watch"]:
        raise click.UsageError("--watch names the folder; leave out PROJECT")
    if given["dry_run"] and given["watch"]:
        raise click.UsageError("--dry-run is about projects that are there; leave out --watch")
    # what concerns the run as a whole is said beside what is named first
    place = places[0] if places else Path()
    first = config or find_config(place / "any" if is_folder(place) else place, places)
    values = _chosen(first)
    recursive, resume, force = (values[name] for name in ("recursive", "resume", "force"))
    how = _how_to_run(values)

    def options(project: Path) -> tuple[Path | None, dict[str, Any]]:
        file = config or find_config(project, places)
        values = _chosen(file, alone=file == first)
        if given["watch"]:
            for_several(values, "--watch takes all of a folder", file)
        return file, values

    if given["watch"]:
        options(place / "any")  # what is wrong already is told at once
        return run(_saved(watch(given["watch"], recursive), options, force), how)
    found = find_projects(projects, recursive)
    chosen = {project: options(project) for project in found}
    if given["print_config"]:
        for text in config_texts(command, chosen or {Path(): (first, _chosen(first))}):
            print_result(text)
        return ExitCode.OK
    keywords = {project: _options(**values) for project, (_, values) in chosen.items()}
    if len(found) > 1:
        for file, values in chosen.values():
            for_several(values, f"there are {len(found)}", file)
        refuse_same_output(keywords)
    remember = resume or force or len(found) > 1 or any(map(is_folder, projects))
    tasks = [Task(project, its, remember and not force, remember) for project, its in keywords.items()]
    if given["dry_run"]:
        ours = {project: words(command, values) for project, (_, values) in chosen.items()}
        return show(tasks, ours, how)
    return run(tasks, how, lone=len(found) == 1)


def _chosen(file: Path | None, alone: bool = True) -> dict[str, Any]:
    """What is chosen by the command line and a file of settings, see `choices.choose`."""
    return choose(command, click.get_current_context().meta[ARGUMENTS], file, alone)


def _saved(
    projects: Iterable[Path | str | None],
    options: Callable[[Path], tuple[Path | None, dict[str, Any]]],
    force: bool,
) -> Iterator[Task | str | None]:
    """Tasks for projects as they are saved, and warnings; settings that are wrong at the time are told, and
    no more.
    """
    for project in projects:
        if not isinstance(project, Path):
            yield project
            continue
        try:
            yield Task(project, _options(**options(project)[1]), not force, True)
        except (AbflowError, click.UsageError) as error:
            complain(f"{project}: {error.format_message() if isinstance(error, click.UsageError) else error}")


def _how_to_run(values: Mapping[str, Any]) -> Run:
    """What all options say about the run as a whole."""
    named = ("jobs", "report", "log", "quiet", "verbose", "profile", "scheduler")
    misnamed = misnamed_root()
    return Run(
        **{name: values[name] for name in named},
        arguments=click.get_current_context().meta[ARGUMENTS],
        warnings=[*ineffective(values), *([misnamed] if misnamed else [])],
    )


def _options(
    *,
    no_metadata: bool,
    prefix: str | None,
    layers: tuple[Path, ...],
    merge: MergeMode,
    exposure: str,
    guides: str,
    large_motion: LargeMotion,
    seam: str,
    clones: str,
    softmax_sharpness: float,
    flow_magnitude: float,
    no_flow: bool,
    flow_quality: FlowQuality,
    device: str | None,
    max_memory: int | None,
    threads: int | None,
    **others: Any,
) -> dict[str, Any]:
    """The keywords of `merge_project` that the command's options mean; `others` are such by themselves."""
    settings = Settings(
        merge=merge,
        softmax_sharpness=softmax_sharpness,
        flow_magnitude=flow_magnitude,
        flow=not no_flow,
        flow_quality=flow_quality,
        exposure=exposure == "auto",
        guides=guides == "auto",
        seam=seam == "auto",
        clones=clones == "auto",
        large_motion=large_motion,
        device=device,
        max_memory=max_memory or 0,
        threads=threads or 0,
    )
    return {
        "settings": settings,
        "prefix": prefix,
        "layers": list(layers) or None,
        "metadata": not no_metadata,
        **{name: value for name, value in others.items() if name not in OF_THE_RUN},
    }


def _run(arguments: Sequence[str] | None) -> int:
    """Run click's command; every error that ends a run passes here."""
    try:
        return int(command.main(arguments, prog_name=PROGRAM, standalone_mode=False))
    except (click.Abort, KeyboardInterrupt):
        say(f"{PROGRAM}: interrupted")
        return ExitCode.INTERRUPTED
    except OSError as error:
        if isinstance(error.__context__, KeyboardInterrupt):
            return ExitCode.INTERRUPTED  # with a terminal that is gone, which click would write to
        complain(system_error(error))
        return ExitCode.FAILED
    except click.ClickException as error:
        complain(f"{error.format_message()}\nTry '{PROGRAM} --help'.")
        return ExitCode.USAGE
    except AbflowError as error:
        complain(str(error))
        return error.exit_code


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``hugin-abflow`` with `arguments` (default: the process's own) and return its exit code."""
    process.set_up()
    with interruptible():
        return _run(arguments)

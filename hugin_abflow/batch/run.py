"""A run: tasks go to those who perform them; results are printed, shown, reported."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from hugin_abflow import scratch, trace
from hugin_abflow.batch.cluster import Cluster
from hugin_abflow.batch.display import Display, choose_display, name_of, open_log
from hugin_abflow.batch.pool import Alone, Pool
from hugin_abflow.batch.record import Record
from hugin_abflow.batch.report import print_table, write_report
from hugin_abflow.batch.task import Task, left_alone
from hugin_abflow.errors import AbflowError, ExitCode, OutputError, SameOutputError
from hugin_abflow.oneline import commented
from hugin_abflow.shown import show_project
from hugin_abflow.targets import unwritable
from hugin_abflow.terminal import complain, label, messages, print_path, print_result, say


@dataclass(frozen=True)
class Run:
    """What a command line says about the run as a whole.

    jobs        projects at a time; None: as many as `default_jobs` says.
    report      file for the report.
    log         file to the end of which everything is written.
    arguments   the command line, for the report.
    profile     file for the trace, see trace.py.
    scheduler   address of a Dask scheduler, whose workers do the work; None: this machine does.
    warnings    what is to be said of the command line itself, once.

    Raises `SameOutputError` where two of the files are one.
    """

    jobs: int | None = None
    report: Path | None = None
    log: Path | None = None
    quiet: bool = False
    verbose: bool = False
    arguments: Sequence[str] = ()
    profile: Path | None = None
    scheduler: str | None = None
    warnings: Sequence[str] = ()

    def __post_init__(self) -> None:
        named: dict[str, str] = {}
        for option, file in self.files.items():
            if not scratch.is_special(file):  # a terminal or /dev/null takes all of them
                other = named.setdefault(os.path.realpath(file), option)
                if other != option:
                    raise SameOutputError(f"{other} and {option} both name {file}; give each its own file")

    @property
    def files(self) -> dict[str, Path]:
        """The files that are wanted beside panoramas, by the options that name them."""
        named = {"--report": self.report, "--log": self.log, "--profile": self.profile}
        return {option: file for option, file in named.items() if file}


def default_jobs() -> int:
    """One project computes, the next one's layers are made, the last one's panorama is encoded."""
    return min(3, os.cpu_count() or 1)


def run(tasks: Iterable[Task | str | None], how: Run, lone: bool = False) -> ExitCode:
    """Perform tasks; print the panoramas' names on stdout. Raises `OutputError` for a log or a report that
    cannot be written, and, in the end, for stdout.

    tasks       None means that there is none at the moment; a text is a warning.
    lone        there is but one: it is done in this process, and no table follows.
    """
    records: list[Record] = []
    order: dict[Path, int] = {}
    running: set[Path] = set()
    unprinted: OutputError | None = None
    complete = interrupted = False
    with ExitStack() as stack:
        log = stack.enter_context(open_log(how.log))
        stack.enter_context(trace.recording(how.profile))
        if how.report and not scratch.is_special(how.report):  # who reads a pipe expects one report
            write_report(how.report, [], how.arguments)  # now: a run may be long
        scratch.sweep(scratch.root())  # of killed runs: where all projects hold nobody else does
        display = choose_display(lone, how.quiet, how.verbose, log)
        try:
            with display:
                for text in how.warnings:
                    display.warn(text)
                if isinstance(tasks, Sequence):
                    display.expect(len(tasks))
                    order = {task.project.absolute(): place for place, task in enumerate(filter(None, tasks))}
                else:
                    tasks = _announced(tasks, running, display)
                with _performers(how, len(order), lone, display) as performers:
                    for record in performers.run(tasks):
                        records.append(record)
                        running.discard(record.project)
                        unprinted = (None if how.quiet else _print_files(record)) or unprinted
            complete = True
        except KeyboardInterrupt:
            interrupted = True
            raise
        finally:
            records.sort(key=lambda record: order.get(record.project, 0))
            if records and not lone and not how.quiet:
                print_table(records)
            if not complete and not lone and isinstance(tasks, Sequence):
                display.note(_rest(tasks, len(records), interrupted))
            _report(how, records, complete)
    if unprinted:
        raise unprinted
    return combine([record.exit_code for record in records])


def _print_files(record: Record) -> OutputError | None:
    """Print the names of a project's panoramas. An error is returned, not raised: it must not keep the run
    from the projects that are left.
    """
    try:
        for file in record.files:
            print_path(file)
    except OutputError as error:
        return error
    return None


def _report(how: Run, records: Sequence[Record], complete: bool) -> None:
    """Write the report, if one is wanted. complete: whether the run came to its end; else something is being
    raised, and an error of ours is only told.
    """
    if not how.report:
        return
    try:
        write_report(how.report, records, how.arguments)
    except OutputError as error:
        if complete:
            raise
        complain(str(error))


def _rest(tasks: Sequence[Task | str | None], done: int, interrupted: bool) -> str:
    """How much is left of a run over several projects that ends too early; if somebody interrupted it, what
    to do, too. An error says that itself, and the same command might end in the same.
    """
    left = f"{len(tasks) - done} of {len(tasks)} projects left"
    if not interrupted:
        return left
    resumed = all(task.resume for task in tasks if isinstance(task, Task))
    remedy = "the same command goes on from here" if resumed else "with --force the same command begins anew"
    return f"{left}; {remedy}"


def _performers(how: Run, count: int, lone: bool, display: Display) -> Alone | Pool | Cluster:
    """Who performs the tasks; count: how many there are, 0 if nobody knows."""
    # figures of overlaps are told as messages
    level = logging.INFO if how.verbose or how.log or how.report or not lone else logging.WARNING
    if how.scheduler:
        return Cluster(how.scheduler, level, display)
    if lone:
        return Alone(level, display)
    jobs = how.jobs or default_jobs()
    # processes share the memory: there must be no more than have something to do
    return Pool(min(jobs, count) if count else jobs, level, display)


def _announced(
    tasks: Iterable[Task | str | None], running: set[Path], display: Display
) -> Iterator[Task | None]:
    """The tasks, while the display is told of each, and of warnings. A project that was saved again while it
    is stitched waits until that is done: else the older panorama might be the last to be written.

    running     projects that are being stitched; here they are added.
    """
    waiting: dict[Path, Task] = {}
    for task in tasks:
        if isinstance(task, str):
            display.warn(task)
        elif task is not None:
            waiting[task.project.absolute()] = task
        project = next((one for one in waiting if one not in running), None)
        if project is None:
            yield None
        else:
            display.expect(1)
            running.add(project)
            yield waiting.pop(project)


def show(tasks: Iterable[Task], words: Mapping[Path, Sequence[str]], how: Run) -> ExitCode:
    """Print on stdout what would be done for each task. words: of its project, options of our own.

    Raises `OutputError` for a log, a report or a profile that cannot be written, as `run` does.
    """
    for option, file in sorted(how.files.items()):  # in the order in which a run opens them
        if why := unwritable(file, replaced=option == "--report"):
            raise OutputError(f"{file} cannot be written: {why}; name another file with {option}")
    codes = []
    for text in how.warnings:
        say(label(logging.WARNING) + text)
    with messages(logging.WARNING):
        for one in tasks:
            try:
                nothing, left = left_alone(one)
                if nothing:
                    names = ", ".join(file.name for file in left)
                    what = f"{names}: made before, left as it is (--force: anew)"
                    print_result(commented(f"{name_of(one.project)}: {what}"))
                else:
                    options = words[one.project]
                    lines = show_project(one.project, **one.options, options=options, leave=left)
                    print_result("\n".join(lines))
                codes.append(ExitCode.OK)
            except AbflowError as error:
                complain(str(error))
                codes.append(error.exit_code)
    return combine(codes)


def combine(codes: Sequence[ExitCode]) -> ExitCode:
    """The exit code of a run whose projects ended with `codes`."""
    if len(codes) == 1:
        return codes[0]
    failed = sum(code != ExitCode.OK for code in codes)
    if failed:
        return ExitCode.ALL_FAILED if failed == len(codes) else ExitCode.PARTIAL
    return ExitCode.OK

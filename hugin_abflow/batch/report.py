"""What became of all projects: a table for people, JSON for programs (docs/report.md)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hugin_abflow.batch.display import duration, name_of
from hugin_abflow.batch.record import Record, as_json, write_json
from hugin_abflow.errors import OutputError
from hugin_abflow.memory import size
from hugin_abflow.metadata import PROGRAM, version
from hugin_abflow.scratch import is_special, open_to_add
from hugin_abflow.terminal import console

SCHEMA = 1


def print_table(records: Sequence[Record]) -> None:
    """Projects, results, times, sizes, and what went wrong, on stderr."""
    from rich import box  # takes a while to load, and is needed here only
    from rich.table import Table
    from rich.text import Text

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("project", overflow="fold")
    table.add_column("result")
    table.add_column("time", justify="right")
    table.add_column("size", justify="right")
    table.add_column("what went wrong, what to do", overflow="fold")
    for record in records:
        table.add_row(
            Text(name_of(record.project)),
            record.result,
            duration(record.seconds),
            size(record.bytes) if record.outputs else "",
            Text(record.message or "; ".join(record.warnings)),
        )
    shown_on = console()
    if not shown_on.is_terminal:
        shown_on.width = 160  # a file is read in an editor, which does not mind
    shown_on.print(table)


def write_report(path: Path, records: Sequence[Record], arguments: Sequence[str]) -> None:
    """Write the report: whole or not at all, through links; into a pipe, a device or stdout directly.

    Raises `OutputError`.
    """
    report = summary(records, arguments)
    try:
        if is_special(path):
            with open_to_add(path) as file:
                file.write(as_json(report))
        else:
            write_json(Path(os.path.realpath(path)), report)  # what a link leads to, not the link
    except OSError as error:
        raise OutputError(
            f"{path} cannot be written: {error.strerror}; name another file with --report"
        ) from None


def summary(records: Sequence[Record], arguments: Sequence[str]) -> dict[str, Any]:
    """The report as plain values; `arguments`: of the command line."""
    results = [record.result for record in records]
    return {
        "schema": SCHEMA,
        "program": PROGRAM,
        "version": version(),
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
        "arguments": list(arguments),
        "made": results.count("made"),
        "skipped": results.count("skipped"),
        "failed": results.count("failed"),
        "projects": [record.to_json() for record in records],
    }

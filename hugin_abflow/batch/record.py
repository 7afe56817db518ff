"""The noun: what became of one project."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from hugin_abflow.errors import ExitCode
from hugin_abflow.scratch import part_beside

Result = Literal["made", "skipped", "failed"]


@dataclass
class Record:
    """What became of one project; plain values, as they stand in a report (docs/report.md).

    project     its file, absolute.
    result      "made", "skipped" (what was made before still holds, or was changed since) or "failed".
    outputs     the files that were made, with "file" and "bytes"; of a failed one those before the failure,
                of a skipped one those that are left.
    inputs      the project, its photos, and layers that were there before, as `outputs`.
    message     what went wrong and what to do; empty if nothing.
    exit_code   what a run of this project alone ends with.
    started     UTC, ISO 8601. seconds: the whole time, phases: of each phase.
    memory      largest resident memory of the process, bytes; None if nothing was begun.
    attempts    how often it was begun.
    overlaps    figures of each overlap.
    """

    project: Path
    result: Result = "failed"
    outputs: list[dict[str, Any]] = field(default_factory=list)
    inputs: list[dict[str, Any]] = field(default_factory=list)
    message: str = ""
    exit_code: ExitCode = ExitCode.OK
    warnings: list[str] = field(default_factory=list)
    started: str = ""
    seconds: float = 0.0
    phases: dict[str, float] = field(default_factory=dict)
    memory: int | None = None
    attempts: int = 1
    settings: dict[str, Any] = field(default_factory=dict)
    device: str = ""
    versions: dict[str, str] = field(default_factory=dict)
    overlaps: list[dict[str, Any]] = field(default_factory=list)

    @property
    def files(self) -> list[Path]:
        """The panorama's files."""
        return [Path(output["file"]) for output in self.outputs]

    @property
    def bytes(self) -> int:
        """Size of the outputs together."""
        return sum(int(output["bytes"]) for output in self.outputs)

    def to_json(self) -> dict[str, Any]:
        """Plain values for JSON."""
        values = asdict(self)
        for file in values["inputs"] + values["outputs"]:
            file["file"] = str(Path(file["file"]).absolute())
        return {**values, "project": str(self.project), "exit_code": int(self.exit_code)}


def as_json(values: object) -> str:
    """Readable JSON; names that are not UTF-8 are to be written as escapes (``backslashreplace``)."""
    return json.dumps(values, indent=2, ensure_ascii=False) + "\n"


def write_json(final: Path, values: object) -> None:
    """Write values as JSON; a file, or a link, is replaced whole or not at all. Raises OSError."""
    with part_beside(final) as part:
        with part.open("wb") as file:
            # names that are not UTF-8 stay readable for JSON's readers
            file.write(as_json(values).encode("utf-8", "backslashreplace"))
            file.flush()
            os.fsync(file.fileno())  # else a power cut may leave an empty file of the final name
        part.replace(final)

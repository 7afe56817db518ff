"""What took how long? ``python benchmarks/phases.py PROFILE.json``

Reads what ``hugin-abflow --profile PROFILE.json`` wrote: for each phase its wall time, how long the device
calculated and copied, and how long files were decoded and encoded (on several cores at a time, so this may be
longer than the phase); then the kernels that took longest.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from pathlib import Path
from typing import Any

KINDS = ("kernel", "transfer", "file")
MOST = 12  # kernels that are named


def read_spans(path: Path) -> list[dict[str, Any]]:
    """The spans of a trace, in the order of their starts; times in microseconds."""
    events = json.loads(path.read_text(encoding="utf-8"))["traceEvents"]
    return sorted((event for event in events if event["ph"] == "X"), key=lambda event: event["ts"])


def by_phase(spans: list[dict[str, Any]]) -> dict[str, Counter[str]]:
    """Seconds of each phase: "wall", and those of KINDS that began in it."""
    phases = [span for span in spans if span["cat"] == "phase"]
    result: dict[str, Counter[str]] = {}
    for phase in phases:
        seconds = result.setdefault(phase["name"], Counter())
        seconds["wall"] += phase["dur"] / 1e6
        for span in spans:
            begins_here = phase["ts"] <= span["ts"] < phase["ts"] + phase["dur"]
            if span["cat"] in KINDS and begins_here and span["pid"] == phase["pid"]:
                seconds[span["cat"]] += span["dur"] / 1e6
    return result


def table(spans: list[dict[str, Any]]) -> str:
    """Phases, then kernels, as Markdown."""
    lines = ["| phase | wall s | kernels s | transfers s | files s |", "|---|---|---|---|---|"]
    phases = by_phase(spans)
    for name, seconds in phases.items():
        shown = " | ".join(f"{seconds[kind]:.3f}" for kind in ("wall", *KINDS))
        lines.append(f"| {name} | {shown} |")
    device = sum(phases[name][kind] for name in phases if name != "read" for kind in KINDS[:2])
    lines += ["", f"Flow and blend on the device: {device:.3f} s", ""]
    kernels, calls = Counter[str](), Counter[str]()
    for span in spans:
        if span["cat"] == "kernel":
            kernels[span["name"]] += span["dur"] / 1e6
            calls[span["name"]] += 1
    lines += ["| kernel | s | calls |", "|---|---|---|"]
    lines += [f"| {name} | {seconds:.3f} | {calls[name]} |" for name, seconds in kernels.most_common(MOST)]
    return "\n".join(lines)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("profile", type=Path)
    print(table(read_spans(parser.parse_args().profile)))


if __name__ == "__main__":
    main()

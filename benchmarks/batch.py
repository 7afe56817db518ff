"""Many projects in one run, against a run for each: ``python benchmarks/batch.py [--projects 20] [--runs 3]``

Copies of the sample room on a small canvas are remapped by nona and blended, by one run and by as many
single ones, in turns; medians. Wall and CPU time (user + system, all processes) are the system's; "cores
busy" is CPU over wall. "In kernels" is from the profile of a further run: seconds that kernels ran. The
projects are small, because there starting the program counts most. The table is Markdown.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.speed import Run, measure
from hugin_abflow import pto

ROOT = Path(__file__).resolve().parent.parent
ROOM = ROOT / "sample_projects" / "room"
PROGRAM = [sys.executable, "-m", "hugin_abflow"]


def make_shoot(folder: Path, projects: int, width: int) -> list[Path]:
    """Folders with the sample's photos and its project at another size, each; what was there is removed."""
    shutil.rmtree(folder, ignore_errors=True)
    made = []
    for number in range(projects):
        place = folder / f"{number:03d}"
        place.mkdir(parents=True)
        for photo in ROOM.glob("photo*.jpg"):
            shutil.copy(photo, place)
        project = pto.load(ROOM / "room.pto")
        project.panorama.width, project.panorama.height, project.panorama.crop = width, width // 2, None
        made.append(place / f"room{number:03d}.pto")
        made[-1].write_bytes(pto.dumps(project))
    return made


def clear(folder: Path) -> None:
    """Remove what runs made."""
    for path in folder.rglob("*.tif"):
        path.unlink()
    for state in list(folder.rglob(".abflow")):
        shutil.rmtree(state)


def together(runs: list[Run]) -> Run:
    """Runs one after the other, as one."""
    return Run(sum(run.wall for run in runs), sum(run.cpu for run in runs), max(run.peak for run in runs))


def said(run: Run) -> str:
    """A run, in words."""
    return f"{run.wall:.1f} s, {run.cpu:.1f} s of processor"


def kernel_seconds(profile: Path) -> float:
    """How long kernels ran, of all processes of a run."""
    events = json.loads(profile.read_text("utf-8"))["traceEvents"]
    return sum(event["dur"] for event in events if event.get("cat") == "kernel") * 1e-6


def table(singles: list[Run], batches: dict[str, list[Run]]) -> str:
    """Medians, and their ratios to the single runs."""
    lines = ["| | wall s | CPU s | cores busy | wall ratio | CPU ratio |", "|---|---|---|---|---|---|"]
    base: tuple[float, float] | None = None
    for name, runs in {"single runs": singles, **batches}.items():
        wall, cpu = (statistics.median(getattr(run, key) for run in runs) for key in ("wall", "cpu"))
        base = base or (wall, cpu)
        ratios = f"{wall / base[0]:.2f} | {cpu / base[1]:.2f}"
        lines.append(f"| {name} | {wall:.1f} | {cpu:.1f} | {cpu / wall:.2f} | {ratios} |")
    return "\n".join(lines)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--projects", type=int, default=20)
    parser.add_argument("--width", type=int, default=1000, help="of the canvas, px")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--jobs", type=int, nargs="*", default=[], help="compare these numbers of --jobs")
    parser.add_argument("--cache", type=Path, default=ROOT / "build" / "benchmarks")
    options = parser.parse_args()
    folder = options.cache / "batch"
    projects = make_shoot(folder, options.projects, options.width)
    choices = {f"one run, --jobs {jobs}": ["--jobs", str(jobs)] for jobs in options.jobs} or {"one run": []}
    singles: list[Run] = []
    batches: dict[str, list[Run]] = {name: [] for name in choices}
    measure([*PROGRAM, str(projects[0])])  # builds kernels that a machine builds once
    for turn in range(options.runs):
        clear(folder)
        singles.append(together([measure([*PROGRAM, str(project)]) for project in projects]))
        print(f"run {turn + 1}, single runs: {said(singles[-1])}", file=sys.stderr)
        for name, choice in choices.items():
            clear(folder)
            batches[name].append(measure([*PROGRAM, "--recursive", str(folder), *choice]))
            print(f"run {turn + 1}, {name}: {said(batches[name][-1])}", file=sys.stderr)
    clear(folder)
    profile = options.cache / "batch.json"
    measure([*PROGRAM, "--recursive", str(folder), "--profile", str(profile)])
    size = f"{options.width}x{options.width // 2}"
    print(f"{options.projects} projects of {size}, {options.runs} runs, medians:\n")
    print(table(singles, batches))
    print(f"\nIn kernels: {kernel_seconds(profile):.1f} s of one run.")


if __name__ == "__main__":
    main()

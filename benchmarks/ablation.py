"""What is each part of the engine good for? ``python benchmarks/ablation.py [--rigs ring] [--seeds 1 2]``

Blends the sets of quality.py with the default settings and with one part at a time switched off or on, and
prints a Markdown table. A part that has no setting cannot be left out here.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.quality import add_set_options, row
from benchmarks.rigs import make_set
from hugin_abflow import Settings, merge_project

# What differs from the defaults. Guides are not among them: the sets have no control points.
PARTS: dict[str, Mapping[str, Any]] = {
    "default": {},
    "no flow": {"flow": False},
    "no flow, no seam": {"flow": False, "seam": False},
    "no seam": {"seam": False},
    "no clones": {"clones": False},
    "no movers": {"movers": False},
    "no foreground": {"foreground": False},
    "no relay": {"relay": False},
    "no exposure": {"exposure": False},
    "no highlights": {"highlights": False},
    "transition as published": {"transition_strain": 0.0},
    "no flow magnitude": {"flow_magnitude": 0.0},
    "average instead of softmax": {"softmax_sharpness": 0.0},
    "flow that starts there": {"intermediate": False},
    "no large motion": {"large_motion": "off"},
    "large motion always": {"large_motion": "on"},
    "flow fast": {"flow_quality": "fast"},
    "flow best": {"flow_quality": "best"},
    "nearest pixels": {"interpolation": "nearest"},
    "sequential": {"merge": "sequential"},
}


def run_set(folder: Path, name: str, width: int, parts: list[str]) -> None:
    """Blend a set with each of `parts`, print one table row each."""
    for part in parts:
        out = folder / f"ablation-{part.replace(' ', '_')}.tif"
        start = time.perf_counter()
        merge_project(
            folder / "project.pto", Settings(**PARTS[part]), prefix=str(folder / "layer"), output=out
        )
        print(f"| {name} | {part} {row(folder, out, width, time.perf_counter() - start)}", flush=True)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_set_options(parser)
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS))
    options = parser.parse_args()
    print("| set | engine | false % | worst breaks px | broken % | holes px | sharp | s |")
    print("|---|---|---|---|---|---|---|---|")
    for rig in options.rigs:
        for seed in options.seeds:
            folder = options.cache / f"{rig}-{seed}-{options.width}"
            make_set(folder, rig, seed, options.width)
            run_set(folder, f"{rig} {seed}", options.width, options.parts)


if __name__ == "__main__":
    main()

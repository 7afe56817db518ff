"""The benchmark of many projects: its projects can be stitched, its figures add up."""

from __future__ import annotations

import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.batch import clear, kernel_seconds, make_shoot, table, together
from benchmarks.speed import Run
from hugin_abflow.project import read_plan


def test_projects_are_whole_and_of_the_wanted_size(tmp_path: Path) -> None:
    made = make_shoot(tmp_path / "shoot", 2, 400)
    assert [path.name for path in made] == ["room000.pto", "room001.pto"]
    for path in made:
        plan = read_plan(path)
        assert (plan.canvas.crop.width, plan.canvas.crop.height) == (400, 200)
        assert len(plan.images) == 6 and all(image.photo.is_file() for image in plan.images)
    (tmp_path / "shoot" / "000" / ".abflow").mkdir()
    (tmp_path / "shoot" / "000" / "room000.tif").touch()
    clear(tmp_path / "shoot")
    assert {path.suffix for path in (tmp_path / "shoot" / "000").iterdir()} == {".pto", ".jpg"}


def test_runs_add_up_and_medians_are_compared() -> None:
    one = together([Run(1.0, 2.0, 30.0), Run(3.0, 4.0, 20.0)])
    assert one == Run(4.0, 6.0, 30.0)
    rows = table([one, Run(8.0, 9.0, 1.0)], {"one run": [Run(3.0, 6.0, 1.0)]}).splitlines()[2:]
    assert rows == [
        "| single runs | 6.0 | 7.5 | 1.25 | 1.00 | 1.00 |",
        "| one run | 3.0 | 6.0 | 2.00 | 0.50 | 0.80 |",
    ]


def test_kernels_of_all_processes_count(tmp_path: Path) -> None:
    events = [{"cat": "kernel", "dur": 5e5, "pid": pid} for pid in (1, 2)] + [{"cat": "file", "dur": 9e9}]
    (tmp_path / "t.json").write_text(json.dumps({"traceEvents": [*events, {"name": "thread_name"}]}))
    assert kernel_seconds(tmp_path / "t.json") == 1.0

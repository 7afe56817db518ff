"""Stacks and layers of one exposure, beside the groups in Hugin's own commands."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path

import pytest
from conftest import ProjectMaker, require_program
from test_hugin import CANVAS, stacked

from hugin_abflow.errors import ProgramFailedError, ProgramMissingError
from hugin_abflow.pano_trafo import read_guides
from hugin_abflow.project import read_plan
from hugin_abflow.stacks import exposure_layers, stacks


def hugins(project: Path, *kinds: str) -> list[list[int]]:
    """The images of each input group, by hugin_executor's commands for the first of the outputs `kinds`."""
    executor = require_program("hugin_executor")
    others = ("LDRBlended", "LDRStacks", "LDRExposureLayers", "HDRBlended")
    wanted = [f"#hugin_output{kind} {str(kind in kinds).lower()}" for kind in others]
    asked = project.with_name(f"asked {project.name}")
    asked.write_bytes(project.read_bytes() + ("\n".join(["", *wanted, ""])).encode())
    command = [executor, "-s", "-d", "-p", str(project.parent / "x"), str(asked)]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    lines = [shlex.split(line) for line in shown.splitlines() if line.startswith(("enfuse", "enblend"))]
    return [[int(re.findall(r"\d{4}", name)[-1]) for name in line[line.index("--") + 1 :]] for line in lines]


@pytest.mark.parametrize(
    ("yaws", "extra"),
    [
        ((0, 60, 170), ""),
        ((0, 10, 21, 40, 60, 62), ""),
        ((0, 10, 21, 40, 60, 62), "#hugin_outputStacksMinOverlap 0.9"),
        ((0, 10, 21, 40, 60, 62), "#hugin_outputStacksMinOverlap 0.2"),
        ((175, -175, 0, 3), "#hugin_outputStacksMinOverlap nonsense"),
    ],
)
def test_stacks_are_hugins(make_project: ProjectMaker, pano_trafo: str, yaws: tuple, extra: str) -> None:
    project = make_project(panorama=CANVAS, yaws=yaws, extra=extra)
    found = stacks(read_plan(project), range(len(yaws)))
    assert found == hugins(project, "LDRStacks")


def test_stacks_of_exposures(make_project: ProjectMaker, pano_trafo: str) -> None:
    project = stacked(make_project(panorama=CANVAS, disabled=[]))
    assert stacks(read_plan(project), range(6)) == [[0, 1], [2, 3], [4, 5]] == hugins(project, "LDRStacks")
    # an image that nona has no layer of
    assert stacks(read_plan(project), [0, 2, 3, 5]) == [[0], [2, 3], [5]]
    assert stacks(read_plan(project), [4]) == [[4]]


def test_cropped_photos(make_project: ProjectMaker, pano_trafo: str) -> None:
    """Only what is used counts: halves of one view are no stack; a fisheye's crop is a circle."""
    project = make_project(panorama=CANVAS, yaws=(0, 0, 30, 40))
    text = project.read_text()
    crops = iter(["S0,90,0,151", "S100,203,0,151", "", ""])
    text = re.sub(r" Vm5 ", lambda match: f" Vm5 {next(crops)} ", text)
    project.write_text(text)
    assert stacks(read_plan(project), range(4)) == hugins(project, "LDRStacks")
    project.write_text(text.replace(" f0 v80 ", " f2 v80 ").replace("Vm5  n", "Vm5 S30,180,-5,160 n"))
    assert stacks(read_plan(project), range(4)) == hugins(project, "LDRStacks")


@pytest.mark.parametrize(
    ("lens", "yaws", "crop"),
    [
        (" f2 v170 ", (60, 90, 0, 20), "S-20,223,-46,197"),
        (" f2 v170 ", (0, 90, 40, 45), "S20,183,-66,217"),
        (" f0 v80 ", (15, 20, 5, 30), "S0,290,0,230"),
        (" f0 v80 ", (40, 20, 0, 15), "S50,300,-60,151"),
    ],
)
def test_crops_that_reach_beyond_the_photo(
    make_project: ProjectMaker, pano_trafo: str, lens: str, yaws: tuple, crop: str
) -> None:
    """As of a circular fisheye that is larger than the sensor."""
    project = make_project(panorama=CANVAS, yaws=yaws)
    project.write_text(project.read_text().replace(" f0 v80 ", lens).replace(" Vm5 ", f" Vm5 {crop} "))
    assert stacks(read_plan(project), range(4)) == hugins(project, "LDRStacks")


@pytest.mark.parametrize("difference", ["", "0.9", "1.1", "3"])
def test_exposure_layers_are_hugins(make_project: ProjectMaker, difference: str) -> None:
    project = stacked(make_project(panorama=CANVAS), f"#hugin_outputLayersExposureDiff {difference}")
    project.write_text(project.read_text().replace(" Eev1 ", " Eev1.4 ", 1))
    assert exposure_layers(read_plan(project), range(6)) == hugins(project, "LDRExposureLayers")


def test_program_that_is_missing_or_fails(
    make_project: ProjectMaker, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    plan = read_plan(make_project())
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ProgramMissingError, match=r"pano_trafo is not in PATH; install"):
        stacks(plan, range(3))
    (tmp_path / "pano_trafo").write_text("#!/bin/sh\necho no such project >&2; exit 3\n")
    (tmp_path / "pano_trafo").chmod(0o755)
    with pytest.raises(ProgramFailedError, match=r"pano_trafo failed \(exit code 3\).*\n  no such project"):
        stacks(plan, range(3))


def test_points_within_a_stack_are_no_guides(make_project: ProjectMaker, pano_trafo: str) -> None:
    """Between stacks they are, whichever photos of these they were set in."""
    points = ("c n0 N1 x90 y70 X91 Y70 t0", "c n1 N2 x190 y70 X20 Y70 t0", "c n0 N3 x180 y60 X10 Y61 t0")
    project = stacked(make_project(panorama=CANVAS), "\n".join(points))
    found = read_guides(read_plan(project), {0: 0, 1: 0, 2: 1, 3: 1})
    assert [(guide.a, guide.b) for guide in found] == [(0, 1), (0, 1)]

"""Files, folders and patterns as a list of projects."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from shoots import write_project

from hugin_abflow import cli
from hugin_abflow.batch.queue import find_projects, refuse_same_output
from hugin_abflow.errors import ExitCode, OutputError, ProjectError, SameOutputError


@pytest.fixture
def shoot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("b.pto", "a.PTO", "a.tif", "day 1/c.pto", "day 1/late/d.pto", ".trash/e.pto", ".f.pto"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def found(*places: str, recursive: bool = False) -> list[str]:
    return [path.as_posix() for path in find_projects(map(Path, places), recursive)]


@pytest.mark.usefixtures("shoot")
@pytest.mark.parametrize(
    ("places", "recursive", "projects"),
    [
        (["."], False, ["a.PTO", "b.pto"]),
        (["."], True, ["a.PTO", "b.pto", "day 1/c.pto", "day 1/late/d.pto"]),
        (["day 1", "b.pto"], False, ["day 1/c.pto", "b.pto"]),
        (["b.pto", ".", "day 1/../b.pto"], False, ["b.pto", "a.PTO"]),
        (["**/*.pto"], False, ["b.pto", "day 1/c.pto", "day 1/late/d.pto"]),
        (["day ?"], False, ["day 1/c.pto"]),
        (["gone.pto", "b.pto"], False, ["gone.pto", "b.pto"]),
        (["huginpto_1a2b"], False, ["huginpto_1a2b"]),
    ],
)
def test_projects_are_found_once_and_in_order(
    places: list[str], recursive: bool, projects: list[str]
) -> None:
    assert found(*places, recursive=recursive) == projects


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_pipes_are_no_projects_of_a_folder(shoot: Path) -> None:
    """To open one waits for ever; one that is named is meant. What is not there fails by itself."""
    os.mkfifo(shoot / "day 1" / "pipe.pto")
    (shoot / "day 1" / "link.pto").symlink_to("pipe.pto")
    (shoot / "day 1" / "nowhere.pto").symlink_to("gone.pto")
    projects = ["day 1/c.pto", "day 1/nowhere.pto"]
    assert found("day 1") == found("day 1/*.pto") == projects
    assert found("day 1/pipe.pto") == ["day 1/pipe.pto"]


@pytest.mark.skipif(os.name == "nt", reason="links need rights there")
def test_links_lead_nowhere_twice(shoot: Path) -> None:
    """Two that lead back make endless ways to each project."""
    (shoot / "day 1" / "up").symlink_to("..")
    (shoot / "day 1" / "late" / "up").symlink_to("../..")
    (shoot / "same day").symlink_to("day 1")
    (shoot / "link.pto").symlink_to("b.pto")
    projects = ["b.pto", "day 1/c.pto", "day 1/late/d.pto", "link.pto"]
    assert found("**/*.pto") == projects
    assert found(str(shoot / "**" / "*.pto")) == [str(shoot / project) for project in projects]
    assert found(".", recursive=True) == ["a.PTO", *projects]
    assert found("day 1", "same day", "day 1/up/day 1") == ["day 1/c.pto"]


def test_hidden_files_fit_a_pattern_that_names_them(shoot: Path) -> None:
    assert found(".trash/*.pto", f"../{shoot.name}/.trash/*.pto", "*/*.pto") == [
        ".trash/e.pto",
        "day 1/c.pto",
    ]


def chosen(prefix: str | None = None, keep_layers: bool = False) -> dict[str, Any]:
    return {"prefix": prefix, "keep_layers": keep_layers}


def refuse(*projects: Path) -> None:
    refuse_same_output({project: chosen() for project in projects})


def test_a_photo_of_another_project_is_not_replaced(shoot: Path) -> None:
    """Though no EXIF tells that it is one; but a panorama that is joined to others is."""
    rows, whole = write_project(shoot / "row.pto"), write_project(shoot / "whole.pto")
    whole.write_text(whole.read_text().replace("left.png", "row.tif"))
    refuse(rows, whole)  # it is not there yet
    photo = shoot / "row.tif"
    tifffile.imwrite(photo, np.zeros((4, 5, 3), np.uint8), photometric="rgb", software="")
    with pytest.raises(
        OutputError, match=r"row\.pto would replace .*row\.tif, a photo of .*whole\.pto; .* -o"
    ):
        refuse(rows, whole)
    refuse(rows)
    tifffile.imwrite(photo, np.zeros((4, 5, 3), np.uint8), photometric="rgb", software="Hugin 2022.0")
    refuse(rows, whole)


def test_two_projects_with_one_panorama_are_refused(shoot: Path) -> None:
    """Also where it is the fused panorama of one, and the ordinary one of the other."""
    one, two, fused = (write_project(shoot / "new" / name) for name in ("n.pto", "n.PTO", "n_fused.pto"))
    refuse(one, fused, shoot / "gone.pto", shoot / "b.pto")
    with pytest.raises(SameOutputError, match=r"n\.pto and .*n\.PTO would both write .*n\.tif; .* -o"):
        refuse(one, fused, two)
    assert cli.main([str(shoot / "new")]) == ExitCode.USAGE and not (shoot / "new" / "n.tif").exists()
    two.write_text(two.read_text().replace("ImageType tif", "ImageType jpg"))
    refuse(one, two)
    one.write_text(one.read_text() + "#hugin_outputLDRExposureBlended true\n")
    with pytest.raises(SameOutputError, match=r"n_fused\.tif"):
        refuse(one, fused)
    refuse_same_output({one: chosen(prefix="layer"), fused: chosen()})


@pytest.mark.parametrize(
    ("kind", "other"),
    [
        ("LDRLayers", "n0001.pto"),
        ("LDRExposureRemapped", "n_exposure_layers_0000.pto"),
        ("LDRExposureLayers", "n_exposure_0001.pto"),
        ("LDRStacks", "n_stack_ldr_0000.pto"),
        ("HDRLayers", "n_hdr_0001.pto"),
        ("HDRStacks", "n_stack_hdr_0001.pto"),
    ],
)
def test_outputs_that_are_no_panoramas_are_not_replaced_by_some(shoot: Path, kind: str, other: str) -> None:
    one, two = write_project(shoot / "new" / "n.pto"), write_project(shoot / "new" / other)
    if "HDR" in kind:
        two.write_text(two.read_text().replace("ImageType tif", "ImageType exr"))
    refuse(one, two)
    one.write_text(f"{one.read_text()}#hugin_output{kind} true\n")
    with pytest.raises(SameOutputError, match=f"would both write .*{two.stem}[.]"):
        refuse(one, two)


def test_kept_layers_are_not_replaced_by_panoramas(shoot: Path) -> None:
    one, two = write_project(shoot / "new" / "n.pto"), write_project(shoot / "new" / "n0001.pto")
    refuse_same_output({one: chosen(), two: chosen(keep_layers=True)})
    with pytest.raises(SameOutputError, match=r"n0001\.tif"):
        refuse_same_output({one: chosen(keep_layers=True), two: chosen()})
    refuse_same_output({one: chosen(prefix="n", keep_layers=True), two: chosen()})
    assert cli.main(["--keep-layers", "-q", str(one), str(two)]) == ExitCode.USAGE


def test_folder_that_cannot_be_listed_is_told(
    shoot: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    listed = os.scandir

    def scandir(folder: str) -> Any:
        if Path(folder).name == "late":
            raise PermissionError(13, "Permission denied", folder)
        return listed(folder)

    monkeypatch.setattr(os, "scandir", scandir)
    assert found(".", recursive=True) == ["a.PTO", "b.pto", "day 1/c.pto"]
    said = capsys.readouterr().err
    assert "warning: " in said and "late cannot be listed (Permission denied)" in said


def test_name_with_a_star_is_a_name_if_there_is_such_a_file(shoot: Path) -> None:
    (shoot / "b*.pto").touch()
    (shoot / "[1].pto").touch()
    assert found("b*.pto", "[1].pto") == ["b*.pto", "[1].pto"]


@pytest.mark.usefixtures("shoot")
@pytest.mark.parametrize(
    ("place", "recursive", "part"),
    [
        (".trash/..", True, None),
        ("empty", False, "--recursive"),
        ("empty", True, "empty"),
        ("x*.pto", False, "x"),
    ],
)
def test_place_without_a_project_is_told(shoot: Path, place: str, recursive: bool, part: str | None) -> None:
    (shoot / "empty").mkdir()
    if part is None:
        assert found(place, recursive=recursive)
        return
    with pytest.raises(ProjectError, match=part):
        found(place, recursive=recursive)

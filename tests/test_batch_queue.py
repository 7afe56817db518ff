"""Files, folders and patterns as a list of projects."""

from __future__ import annotations

from pathlib import Path

import pytest

from hugin_abflow.batch.queue import find_projects
from hugin_abflow.errors import ProjectError


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

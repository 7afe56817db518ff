"""What ships: the wheel has everything that the program needs at run time, and nothing else."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]

BUILD = "import sys; from hatchling.build import build_wheel; build_wheel(sys.argv[1])"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of this checkout, built with what is installed."""
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run([sys.executable, "-c", BUILD, folder], cwd=ROOT, check=True, capture_output=True)
    (path,) = folder.glob("*.whl")
    return path


def test_wheel_has_all_modules_kernels_and_sequences_and_nothing_else(wheel: Path) -> None:
    modules = {p.relative_to(ROOT).as_posix() for p in (ROOT / "hugin_abflow").rglob("*.py")}
    kernels = {f"hugin_abflow/kernels/{p.name}" for p in (ROOT / "kernels").glob("*.cl")}
    folder = "hugin_abflow/dropin/sequences"
    sequences = {f"{folder}/{p.name}" for p in (ROOT / folder).glob("*.executor")}
    assert len(modules) > 10 and len(kernels) > 5 and len(sequences) == 3
    names = set(zipfile.ZipFile(wheel).namelist())
    information = {name for name in names if name.split("/")[0].endswith(".dist-info")}
    notes = {name for name in names if name.startswith("hugin_abflow/kernels/") and name.endswith(".md")}
    assert names - information - notes == modules | kernels | sequences | {"hugin_abflow/py.typed"}
    assert any(name.endswith("licenses/LICENSE") for name in information)


def test_wheel_has_the_commands(wheel: Path) -> None:
    archive = zipfile.ZipFile(wheel)
    (points,) = (name for name in archive.namelist() if name.endswith("entry_points.txt"))
    expected = [f"{name} = {target}" for name, target in PROJECT["scripts"].items()]
    assert expected[0] == "hugin-abflow = hugin_abflow.__main__:main"
    assert archive.read(points).decode().splitlines()[1:] == sorted(expected)
    for target in PROJECT["scripts"].values():
        module, function = target.split(":")
        assert callable(getattr(importlib.import_module(module), function))


def test_unpacked_wheel_runs_outside_the_checkout(wheel: Path, tmp_path: Path) -> None:
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "site")}
    for arguments, expected in (
        (["-m", "hugin_abflow", "--version"], f"hugin-abflow {PROJECT['version']}"),
        (["-c", "import hugin_abflow; print(hugin_abflow.__file__)"], str(tmp_path / "site")),
    ):
        done = subprocess.run(
            [sys.executable, *arguments], cwd=tmp_path, env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        assert done.stdout.startswith(expected)


def test_source_archive_has_what_its_tests_need(tmp_path: Path) -> None:
    pytest.importorskip("hatchling")
    build = BUILD.replace("build_wheel", "build_sdist")
    subprocess.run([sys.executable, "-c", build, tmp_path], cwd=ROOT, check=True, capture_output=True)
    (path,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    folders = ("hugin_abflow", "kernels", "tests", "benchmarks", "sample_projects", "docs")
    endings = ("*.py", "*.cl", "*.pto", "*.jpg", "*.md", "*.executor")
    needed = {
        path.relative_to(ROOT).as_posix()
        for folder in folders
        for ending in endings
        for path in (ROOT / folder).rglob(ending)
    }
    needed |= {path.name for path in ROOT.glob("*.md")} | {"Makefile", ".ci/run", "pyproject.toml", "LICENSE"}
    assert len(needed) > 80
    assert sorted(needed - names) == []


def test_changelog_has_the_version() -> None:
    assert f"## [{PROJECT['version']}]" in (ROOT / "CHANGELOG.md").read_text("utf-8")


@pytest.mark.skipif(os.name == "nt", reason="make and bash")
def test_makefile_and_ci_are_runnable() -> None:
    assert os.access(ROOT / ".ci" / "run", os.X_OK)
    subprocess.run(["bash", "-n", ".ci/run"], cwd=ROOT, check=True)
    for target in ("sample", "test", "lint", "clean"):
        subprocess.run(["make", "--dry-run", target], cwd=ROOT, check=True, capture_output=True)

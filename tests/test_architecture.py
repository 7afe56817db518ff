"""The layout is what `ARCHITECTURE.md` and the import contract in `pyproject.toml` say."""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

import pytest

from hugin_abflow import chart, consistency, flow, geometry, hidden, intermediate, search

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "hugin_abflow"
MODULES = {path.stem for path in PACKAGE.glob("*.py")} - {"__init__"} | {"pto", "dropin", "batch"}
KERNELS = {path.name for path in (ROOT / "kernels").glob("*.cl")}
# what is too long for one file
PARTS = {one for one in KERNELS if any(one.startswith(other.removesuffix(".cl") + "_") for other in KERNELS)}

# The modules that may know a library; no other imports it.
USERS = {
    "click": {"choices", "cli", "options", "terminal"},
    "rich": {"batch", "terminal"},
    "distributed": {"batch"},
    "OpenImageIO": {"images", "imagewriter"},
    "pyopencl": {"compiler", "devices", "lane", "launch", "opencl"},
    "tifffile": {"tiffreader", "tiffwriter"},
    "imagecodecs": {"tiffwriter"},
}


def levels() -> list[set[str]]:
    """The layers of the import contract, highest first."""
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]
    contracts = tools["importlinter"]["contracts"]
    (contract,) = (c for c in contracts if c["containers"] == ["hugin_abflow"])
    assert contract["exhaustive"] is True and contract["type"] == "layers"
    return [{name.strip() for name in level.split("|")} for level in contract["layers"]]


def sources(module: str) -> list[Path]:
    path = PACKAGE / module
    return sorted(path.rglob("*.py")) if path.is_dir() else [path.with_suffix(".py")]


def imports(module: str) -> set[str]:
    """Everything that `module` imports, with dots: ``numpy``, ``hugin_abflow.errors`` ..."""
    found: set[str] = set()
    for source in sources(module):
        for node in ast.walk(ast.parse(source.read_text("utf-8"))):
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{source}: relative import"
                base = str(node.module)
                found |= {f"{base}.{a.name}" for a in node.names} if base == "hugin_abflow" else {base}
    return found


def test_contract_is_exhaustive_and_names_each_module_once() -> None:
    names = [name for level in levels() for name in level]
    assert sorted(names) == sorted(MODULES)


@pytest.mark.parametrize("module", sorted(MODULES))
def test_imports_point_downwards(module: str) -> None:
    height = {name: -depth for depth, level in enumerate(levels()) for name in level}
    for imported in imports(module):
        parts = imported.split(".")
        if parts[0] == "hugin_abflow" and parts[1] != module:
            assert height[parts[1]] < height[module], f"{module} imports {imported}"


@pytest.mark.parametrize("library", sorted(USERS))
def test_only_its_door_knows_a_library(library: str) -> None:
    users = {module for module in MODULES if library in {name.split(".")[0] for name in imports(module)}}
    assert users == USERS[library]


def test_architecture_names_every_module_and_kernel_and_no_other() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text("utf-8")
    rows = re.findall(r"^\| `([\w./]+)` \|", text, re.MULTILINE)
    files = {path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py")}
    modules = {name for name in files if not name.endswith("__init__.py")}
    assert sorted(rows) == sorted(modules | KERNELS)


@pytest.mark.parametrize("kernel", sorted(KERNELS - PARTS - {"common.cl"}))
def test_kernel_file_belongs_to_the_module_of_its_name(kernel: str) -> None:
    assert kernel.removesuffix(".cl") in MODULES


def test_modules_have_the_numbers_of_their_kernels() -> None:
    """Else kernels would leave pixels out, or write beside their arrays."""
    text = "\n".join((ROOT / "kernels" / name).read_text("utf-8") for name in sorted(KERNELS))
    numbers = {name: float(value) for name, value in re.findall(r"#define (\w+) ([\d.e]+)f?\s", text)}
    (values,) = re.findall(r"enum board_value \{(.*?)\}", text, re.DOTALL)
    board = re.findall(r"\bBOARD_\w+", values)
    assert board.index("BOARD_PLANES") == len(board) - 1 == flow._PLANES
    for name, number in {
        "CHART_CHUNK": chart._CHUNK,
        "FLOW_CHUNK": search._MEDIAN_CHUNK,
        "GEOMETRY_CHUNK": geometry._CHUNK,
        "HIDDEN_CHUNK": hidden._CHUNK,
        "INTERMEDIATE_CHUNK": intermediate._CHUNK,
        "SEARCH_MARGIN": search._MARGIN,
        "SEARCH_RADIUS": search._LARGEST_RADIUS,
        "EXCLUDED": consistency.EXCLUDED,
    }.items():
        assert numbers[name] == number, name


def test_no_file_is_longer_than_450_lines() -> None:
    files = [
        path
        for folder, ending in (
            ("hugin_abflow", "py"),
            ("kernels", "cl"),
            ("tests", "py"),
            ("benchmarks", "py"),
        )
        for path in (ROOT / folder).rglob(f"*.{ending}")
    ]
    assert len(files) > 30
    lengths = {str(path.relative_to(ROOT)): len(path.read_text("utf-8").splitlines()) for path in files}
    assert {name: length for name, length in lengths.items() if length > 450} == {}

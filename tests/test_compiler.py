"""Every kernel builds alone and has a twin; which files are built together, and what is told of it."""

from __future__ import annotations

import importlib
import os
import re
import subprocess
import sys
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import pyopencl as cl
import pytest

from hugin_abflow import compiler, working
from hugin_abflow.compiler import Compiler, kernel_source
from hugin_abflow.errors import DeviceError
from hugin_abflow.opencl import Device

KERNELS = Path(__file__).parent.parent / "kernels"
# files that are no module's own, but in front of one, or of all
PARTS = {"blend_rows": "blend", "blend_sample": "blend"}
SHARED = ["common_numbers", "common"]
MODULES = sorted({path.stem for path in KERNELS.glob("*.cl")} - PARTS.keys() - set(SHARED))


def kernels_of(module: str) -> list[str]:
    return re.findall(r"__kernel\s+void\s+(\w+)", (KERNELS / f"{module}.cl").read_text())


def option_sets(module: str) -> list[str]:
    """All that the host builds a file with: per depth and channel count where samples are read."""
    if module not in ("working", "blend"):
        return [""]
    sets = []
    for (name, white), samples, together in product(working.PIXEL.values(), (2, 4), (2, 4)):
        full_scale = f" -DWHITE={white:.1f}f -DINTEGER={int(white > 1)} -DPIXELS={together} -DBLOCK=64"
        sets.append(f"-DPIXEL={name} -DSAMPLES={samples}{full_scale if module == 'blend' else ''}")
    return sorted(set(sets))


@pytest.mark.parametrize("module", MODULES)
def test_every_kernel_has_a_twin_of_its_name(module: str) -> None:
    names = kernels_of(module)
    assert names
    twins = importlib.import_module(f"reference.{module}")
    missing = [name for name in names if not callable(getattr(twins, name, None))]
    assert not missing, f"tests/reference/{module}.py has no twin of {', '.join(missing)}"


@pytest.mark.parametrize("module", MODULES)
def test_kernels_are_named_after_their_file(module: str) -> None:
    assert all(name.startswith(f"{module}_") for name in kernels_of(module))


@pytest.mark.parametrize(("module", "options"), [(m, o) for m in MODULES for o in option_sets(m)])
def test_every_file_builds_alone_without_warnings(device: Device, module: str, options: str) -> None:
    pocl = "Portable" in device.device.platform.name
    program = cl.Program(device.context, kernel_source(module))
    program.build(["-cl-std=CL1.2", *["-Werror"] * pocl, *options.split()], cache_dir=False)
    built = sorted(kernel.function_name for kernel in program.all_kernels())
    assert built == sorted(kernels_of(module))


@pytest.mark.parametrize(
    ("module", "source", "said"),
    [
        ("broken", "__kernel void broken( {", r"(?s)kernels/broken\.cl does not build on .*driver"),
        ("hollow", "int nothing(void) { return 0; }", r"kernels/hollow\.cl has no kernels for .*--device"),
    ],
)
def test_a_file_that_gives_no_kernels_is_a_device_error_with_its_name(
    device: Device, monkeypatch: pytest.MonkeyPatch, module: str, source: str, said: str
) -> None:
    monkeypatch.setattr(compiler, "kernel_source", lambda *modules: source)
    with pytest.raises(DeviceError, match=said):
        device.kernel(module, module)


def test_files_without_options_are_built_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """To read OpenCL's headers takes a driver longer than each of them."""
    device, built = Device(), []

    def build(modules: tuple[str, ...], options: str) -> dict[str, cl.Kernel]:
        built.append((modules, options))
        return Compiler._build(device._compiler, modules, options)

    monkeypatch.setattr(device._compiler, "_build", build)
    names = {name for module in MODULES for name in kernels_of(module)}
    own = {name for module in ("blend", "working") for name in kernels_of(module)}
    assert set(device.build("flow")) == set(device.build("seam")) == names - own
    assert sorted(device.build("flow", "-DWRAPS=1")) == sorted(kernels_of("flow"))
    sizes = [(len(modules), options) for modules, options in built]
    assert sizes == [(len(MODULES) - 2, ""), (1, "-DWRAPS=1")]


@pytest.mark.parametrize("exact", [True, False])
def test_quotients_are_rounded_as_processors_do_where_devices_can(
    monkeypatch: pytest.MonkeyPatch, exact: bool
) -> None:
    """Compilers refuse the option where they can not."""
    asked, build = [], cl.Program.build
    can = cl.device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT if exact else cl.device_fp_config.FMA
    device = Device()
    monkeypatch.setattr(compiler, "kernel_source", lambda *modules: "__kernel void nothing() {}")
    monkeypatch.setattr(device._compiler, "_device", SimpleNamespace(single_fp_config=can, name="none"))
    monkeypatch.setattr(cl.Program, "build", lambda self, options: asked.append(options) or build(self))
    device.build("pyramid")
    (options,) = asked
    assert ("-cl-fp32-correctly-rounded-divide-sqrt" in options) == exact


def test_where_one_file_does_not_build_the_others_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """Perhaps it is not needed; else it is named."""
    device, built = Device(), []
    broken = {**compiler._kernel_files(), "seam": "__kernel void broken( {"}
    monkeypatch.setattr(compiler, "_kernel_files", lambda: broken)
    monkeypatch.setattr(
        compiler, "kernel_source", lambda *modules: built.append(modules) or kernel_source(*modules)
    )
    assert sorted(device.build("flow")) == sorted(kernels_of("flow"))
    assert sorted(device.build("pyramid")) == sorted(kernels_of("pyramid"))
    with pytest.raises(DeviceError, match=r"(?s)^kernels/seam\.cl does not build on .*driver"):
        device.build("seam")
    assert built[1:] == [("flow",), ("pyramid",), ("seam",)]  # all together once


def test_what_is_built_does_not_wait_for_what_is_being_built(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Layers are read while kernels of what follows are built."""
    first = device.kernel("working", "working_compare", "-DPIXEL=uchar -DSAMPLES=4")
    monkeypatch.setattr(device._compiler, "_building", None)  # nobody gets this lock
    assert device.kernel("working", "working_compare", "-DPIXEL=uchar -DSAMPLES=4") is first


@pytest.mark.parametrize(("seconds", "told"), [(-1.0, 1), (1e9, 0)])
def test_that_kernels_were_compiled_is_told_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, seconds: float, told: int
) -> None:
    monkeypatch.setattr(compiler, "_COMPILED", seconds)
    device = Device()
    with caplog.at_level("INFO", compiler.__name__):
        device.build("pyramid")
        device.build("flow", "-DWRAPS=0")
    assert [record.message.startswith("kernels: compiled") for record in caplog.records] == [True] * told


def test_kernels_of_one_version_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """A version that is installed while this one runs must not mix its kernels with this one's host code."""
    kernel_source("working")
    monkeypatch.setattr(Path, "read_text", lambda *_: "of another version")
    assert "flow_warp" in kernel_source("flow")


def test_kernels_are_read_whatever_the_locale() -> None:
    """Comments name people who do not write themselves in ASCII."""
    code = "from hugin_abflow.compiler import kernel_source; kernel_source('flow')"
    plain = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    subprocess.run([sys.executable, "-c", code], env={**os.environ, **plain}, check=True)


def test_source_lines_keep_their_own_file_and_number() -> None:
    source = kernel_source("working")
    assert source.startswith('#line 1 "common_numbers.cl"\n')
    own = source.partition('#line 1 "working.cl"\n')[2]
    assert own.rstrip("\n") == (KERNELS / "working.cl").read_text().rstrip("\n")


def test_a_part_is_in_front_of_its_file_alone() -> None:
    for part, module in PARTS.items():
        heads = [line for line in kernel_source(module).splitlines() if line.startswith("#line")]
        parts = sorted(name for name, its in PARTS.items() if its == module)
        assert heads == [f'#line 1 "{name}.cl"' for name in (*SHARED, *parts, module)]
        assert all(f'"{part}.cl"' not in kernel_source(other) for other in MODULES if other != module)


def test_a_kernel_is_built_once(device: Device) -> None:
    assert device.kernel("pyramid", "pyramid_reduce") is device.kernel("pyramid", "pyramid_reduce")


# Of a number, by its type's letter.
_BYTES = {
    **dict.fromkeys((b"c", b"h"), 1),
    **dict.fromkeys((b"s", b"t"), 2),
    **dict.fromkeys((b"i", b"j", b"f"), 4),
    **dict.fromkeys((b"l", b"m", b"d"), 8),
}

_BUILDING_RUN = """
import sys
from hugin_abflow.opencl import Device

device = Device(threads=1)
for options in sys.argv[1:]:
    for module in ("seam", "working", "blend"):  # with the first come all that know of no pixels
        device.build(module, options if module != "seam" else "")
"""


@pytest.mark.parametrize("kind", ["uchar", "ushort", "float"])
def test_functions_of_the_library_get_no_long_vector(kind: str, device: Device, tmp_path: Path) -> None:
    """Of more than 32 bytes: those for AVX-512 take them in another way than what is compiled for AVX2."""
    if "PoCL" not in device.device.version:
        pytest.skip("the device is none of PoCL's")
    whole = "INTEGER=0" if kind == "float" else "INTEGER=1"
    options = [
        f"-DPIXEL={kind} -DSAMPLES={samples} -DWHITE=255.0f -D{whole} -DPIXELS=4 -DBLOCK=64"
        for samples in (2, 4)
    ]
    subprocess.run(
        [sys.executable, "-c", _BUILDING_RUN, *options],
        timeout=120,
        env=os.environ | {"POCL_CACHE_DIR": str(tmp_path), "PYOPENCL_NO_CACHE": "1"},
        check=True,
    )
    programs = b"".join(path.read_bytes() for path in tmp_path.rglob("program.bc"))
    # as C++ writes names: Dv, the length, and the type of its numbers
    taken = {(int(length), of) for length, of in re.findall(rb"_Z\w*?Dv(\d+)_([a-z])", programs)}
    assert (4, b"f") in taken  # short ones it does get
    assert all(length * _BYTES[of] <= 32 for length, of in taken)
    assert not re.search(rb"convert_(float|u?int)16|convert_(double|u?long)8", programs)  # nor returns one

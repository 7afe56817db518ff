"""Choosing a device; every kernel builds alone and has a twin."""

from __future__ import annotations

import importlib
import os
import re
import subprocess
import sys
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest

from hugin_abflow import opencl, spare, working
from hugin_abflow.errors import DeviceError, ExitCode
from hugin_abflow.opencl import Device, kernel_source, list_devices

KERNELS = Path(__file__).parent.parent / "kernels"
MODULES = sorted(path.stem for path in KERNELS.glob("*.cl") if path.stem != "common")


def kernels_of(module: str) -> list[str]:
    return re.findall(r"__kernel\s+void\s+(\w+)", (KERNELS / f"{module}.cl").read_text())


def option_sets(module: str) -> list[str]:
    """All that the host builds a file with: per depth and channel count where samples are read."""
    if module not in ("working", "blend"):
        return [""]
    sets = []
    for (name, white), samples, together in product(working.PIXEL.values(), (2, 4), (2, 4)):
        full_scale = f" -DWHITE={white:.1f}f -DINTEGER={int(white > 1)} -DPIXELS={together}"
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
    monkeypatch.setattr(opencl, "kernel_source", lambda module: source)
    with pytest.raises(DeviceError, match=said):
        device.kernel(module, module)


def test_what_is_built_does_not_wait_for_what_is_being_built(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Layers are read while kernels of what follows are built."""
    first = device.kernel("working", "working_compare", "-DPIXEL=uchar -DSAMPLES=4")
    monkeypatch.setattr(device, "_building", None)  # nobody gets this lock
    assert device.kernel("working", "working_compare", "-DPIXEL=uchar -DSAMPLES=4") is first


def test_kernels_of_one_version_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """A version that is installed while this one runs must not mix its kernels with this one's host code."""
    kernel_source("working")
    monkeypatch.setattr(Path, "read_text", lambda *_: "of another version")
    assert "flow_warp" in kernel_source("flow")


def test_kernels_are_read_whatever_the_locale() -> None:
    """Comments name people who do not write themselves in ASCII."""
    code = "from hugin_abflow.opencl import kernel_source; kernel_source('flow')"
    plain = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    subprocess.run([sys.executable, "-c", code], env={**os.environ, **plain}, check=True)


def test_source_lines_keep_their_own_file_and_number() -> None:
    source = kernel_source("working")
    assert source.startswith('#line 1 "common.cl"\n')
    own = source.partition('#line 1 "working.cl"\n')[2]
    assert own.rstrip("\n") == (KERNELS / "working.cl").read_text().rstrip("\n")


def test_a_kernel_is_built_once(device: Device) -> None:
    assert device.kernel("pyramid", "pyramid_reduce") is device.kernel("pyramid", "pyramid_reduce")


def fake(name: str, kind: int, units: int = 4, platform: str = "Some platform") -> SimpleNamespace:
    return SimpleNamespace(
        name=f"{name} ", type=kind, max_compute_units=units, max_clock_frequency=1000,
        global_mem_size=1 << 30, platform=SimpleNamespace(name=platform),
    )  # fmt: skip


@pytest.fixture
def shelf(monkeypatch: pytest.MonkeyPatch) -> list[SimpleNamespace]:
    """Four devices of two platforms, and a platform whose query fails, as a broken driver's does."""
    devices = [
        fake("Big CPU", cl.device_type.CPU, 128),
        fake("Small GPU", cl.device_type.GPU, 2, "Grey platform"),
        fake("Large GPU", cl.device_type.GPU, 60, "Grey platform"),
        fake("Odd one", cl.device_type.ACCELERATOR),
    ]

    def fails() -> None:
        raise cl.RuntimeError("clGetDeviceIDs failed: DEVICE_NOT_FOUND")

    platforms = [
        SimpleNamespace(name="broken", get_devices=fails),
        SimpleNamespace(name="first", get_devices=lambda: devices[:1]),
        SimpleNamespace(name="second", get_devices=lambda: devices[1:]),
    ]
    monkeypatch.setattr(cl, "get_platforms", lambda: platforms)
    return devices


@pytest.mark.parametrize(
    "names", [[], ["POCL_DEVICES"], ["OCL_ICD_VENDORS", "POCL_DEVICES", "POCL_CACHE_DIR"]]
)
def test_environment_that_may_hide_devices_is_named(
    monkeypatch: pytest.MonkeyPatch, names: list[str]
) -> None:
    """Those variables that are set, with their values, beside what to install."""
    monkeypatch.setattr(cl, "get_platforms", lambda: [])
    for name in ("OCL_ICD_VENDORS", "POCL_DEVICES", "POCL_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)
    for name in names:
        monkeypatch.setenv(name, f"/wrong/{name.lower()}")
    with pytest.raises(DeviceError, match=r"no OpenCL device found; .*(pocl|driver)") as caught:
        list_devices()
    found = re.findall(r"(\w+) is '/wrong/(\w+)'", str(caught.value))
    assert found == [(name, name.lower()) for name in names]
    assert ("unset it" in str(caught.value)) == bool(names)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have other loaders")
@pytest.mark.parametrize("name", ["OCL_ICD_VENDORS", "POCL_DEVICES", "POCL_CACHE_DIR"])
def test_environment_that_hides_devices_is_named_by_the_program(name: str) -> None:
    """These variables really do what the message says; they are read when OpenCL is loaded."""
    if "Portable" not in Device().device.platform.name:
        pytest.skip("another driver may take no notice")  # POCL_DEVICES is PoCL's own
    command = [sys.executable, "-m", "hugin_abflow", "--list-devices"]
    environment = os.environ | {name: "/dev/null/none"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == ExitCode.DEVICE
    assert f"{name} is '/dev/null/none'" in done.stderr and done.stdout == ""


def test_default_is_the_fastest_gpu(shelf: list[SimpleNamespace]) -> None:
    assert opencl.choose(None) is shelf[2]
    assert [d.default for d in list_devices()] == [False, False, True, False]


def test_without_a_gpu_the_cpu_is_the_default(shelf: list[SimpleNamespace]) -> None:
    del shelf[1:3]
    assert opencl.choose(None) is shelf[0]


@pytest.mark.parametrize(("wanted", "index"), [("0", 0), ("3", 3), ("large", 2), ("GREY", 1), ("odd ONE", 3)])
def test_a_device_is_chosen_by_index_or_part_of_its_name(
    shelf: list[SimpleNamespace], wanted: str, index: int
) -> None:
    assert opencl.choose(wanted) is shelf[index]


@pytest.mark.parametrize("wanted", ["4", "99", "no such"])
def test_an_unknown_device_names_what_there_is(shelf: list[SimpleNamespace], wanted: str) -> None:
    with pytest.raises(DeviceError) as caught:
        Device(wanted)
    message = str(caught.value)
    assert f"--device {wanted}" in message
    assert all(f"{i}: {d.name.strip()}" in message for i, d in enumerate(shelf))
    assert caught.value.exit_code == ExitCode.DEVICE


def test_list_devices_describes_each(shelf: list[SimpleNamespace]) -> None:
    found = list_devices()
    assert [d.index for d in found] == [0, 1, 2, 3]
    assert [d.kind for d in found] == ["CPU", "GPU", "GPU", "other"]
    assert found[1].name == "Small GPU"
    assert found[1].platform == "Grey platform"
    assert found[0].memory == 1 << 30


def no_platforms() -> list[object]:
    return []


def no_loader() -> list[object]:
    raise cl.LogicError("clGetPlatformIDs failed: PLATFORM_NOT_FOUND_KHR")


@pytest.mark.parametrize("platforms", [no_platforms, no_loader])
@pytest.mark.parametrize(
    ("system", "remedy"), [("linux", "pocl"), ("win32", "driver"), ("darwin", "pocl"), ("plan9", "pocl")]
)
def test_without_any_device_the_error_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, platforms: object, system: str, remedy: str
) -> None:
    monkeypatch.setattr(cl, "get_platforms", platforms)
    monkeypatch.setattr(sys, "platform", system)
    for needs_one in (Device, list_devices):
        with pytest.raises(DeviceError, match=f"no OpenCL device found; .*{remedy}"):
            needs_one()


def test_buffers_carry_arrays_of_any_size(device: Device) -> None:
    values = np.arange(77 * 53 * 3, dtype=np.uint16).reshape(53, 77, 3)
    buffer = device.upload(values[:, ::-1])
    assert buffer.nbytes == values.nbytes
    assert np.array_equal(buffer.get(), values[:, ::-1])
    assert np.array_equal(device.upload(values, np.float32).get(), values.astype(np.float32))
    assert (device.empty((5, 7)).fill(1.5).get() == 1.5).all()
    assert device.zeros((0, 3)).get().shape == (0, 3)


def test_a_copy_is_another_array(device: Device) -> None:
    host = np.arange(15, dtype=np.float32).reshape(3, 5)
    source = device.upload(host)
    copy = device.copy(source)
    source.fill(7)
    assert np.array_equal(copy.get(), host)


def test_parts_of_buffers_are_copied(device: Device) -> None:
    values = np.arange(40 * 3, dtype=np.uint16).reshape(40, 3)
    source, target = device.upload(values.reshape(4, 10, 3)), device.zeros((20, 3), np.uint16)
    target.copy(2, source, 25, 9)
    target.put(11, values[:5, ::-1].reshape(1, 5, 3))
    expected = np.zeros((20, 3), np.uint16)
    expected[2:11], expected[11:16] = values[25:34], values[:5, ::-1]
    assert np.array_equal(target.get(), expected)
    target.copy(20, source, 40, 0)
    target.put(20, values[:0])
    assert np.array_equal(target.get(), expected)


def test_running_over_nothing_does_nothing(device: Device) -> None:
    image = device.empty((0, 7))
    device.run("pyramid", "pyramid_reduce", (7, 0), image, image, (7, 0, 0, 0), image, image, (4, 0))
    device.finish()


def test_kernels_are_repeated_where_a_driver_keeps_no_program(monkeypatch: pytest.MonkeyPatch) -> None:
    """As Intel's for processors, whose kernels had programs that could not be used."""
    monkeypatch.delattr(cl.Kernel, "program")
    device = Device()
    image, mask = device.upload(np.arange(16, dtype=np.float32).reshape(4, 4)), device.empty((4, 4)).fill(1)
    results = [(device.empty((2, 2)), device.empty((2, 2))) for _ in range(3)]
    calls = [(image, mask, (4, 4, 0, 0), *result, (2, 2)) for result in results]
    device.repeat("pyramid", "pyramid_reduce", (2, 2), calls, 2)
    means = [mean.get() for mean, _ in results]
    assert all(np.allclose(mean, 15 - mean[::-1, ::-1]) for mean in means)


def test_memory_of_buffers_that_are_gone_is_used_again() -> None:
    """By one of the same size, and of no other; up to a bound; until it is given back."""
    device = Device()
    first = device.upload(np.full((300, 1000), 7, np.float32))
    memory = first.data
    del first
    assert device.empty((300, 999)).data != memory
    second = device.zeros((1000, 300))
    assert second.data == memory and not second.get().any()
    del second
    device.give_back()
    for _ in range(1000):
        device.empty((1 << 20,))
    assert device.spare._total <= spare.MOST_BYTES
    many = [device.empty((k,)) for k in range(1, 500)]
    del many
    assert len(device.spare._kept) <= spare.MOST_BLOCKS


def test_a_processor_uses_as_many_cores_as_it_may() -> None:
    whole = Device()
    units = whole.device.max_compute_units
    if whole.device.type & cl.device_type.CPU and units > 1:
        assert Device(threads=1).device.max_compute_units == 1
    assert Device(threads=units).device.max_compute_units == units


def test_only_memory_of_its_own_counts_for_the_device() -> None:
    device = Device()
    kept = device.zeros((1 << 20,))
    assert device.own_memory == (0 if device.device.host_unified_memory else kept.nbytes)

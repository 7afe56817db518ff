"""Choosing a device, and what is said where there is none."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from types import SimpleNamespace

import pyopencl as cl
import pytest

from hugin_abflow.devices import choose, list_devices
from hugin_abflow.errors import DeviceError, ExitCode
from hugin_abflow.opencl import Device


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
@pytest.mark.parametrize("name", ["OCL_ICD_VENDORS", "POCL_DEVICES"])  # find_cache removes POCL_CACHE_DIR
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
    assert choose(None) is shelf[2]
    assert [d.default for d in list_devices()] == [False, False, True, False]


def test_without_a_gpu_the_cpu_is_the_default(shelf: list[SimpleNamespace]) -> None:
    del shelf[1:3]
    assert choose(None) is shelf[0]


@pytest.mark.parametrize(("wanted", "index"), [("0", 0), ("3", 3), ("large", 2), ("GREY", 1), ("odd ONE", 3)])
def test_a_device_is_chosen_by_index_or_part_of_its_name(
    shelf: list[SimpleNamespace], wanted: str, index: int
) -> None:
    assert choose(wanted) is shelf[index]


@pytest.mark.parametrize("wanted", ["4", "99", "no such"])
def test_an_unknown_device_names_what_there_is(shelf: list[SimpleNamespace], wanted: str) -> None:
    with pytest.raises(DeviceError) as caught:
        Device(wanted)
    message = str(caught.value)
    assert f"--device {wanted}" in message
    assert all(f"{i} ({d.name.strip()})" in message for i, d in enumerate(shelf))
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


def test_a_processor_uses_as_many_cores_as_it_may() -> None:
    whole = Device()
    units = whole.device.max_compute_units
    if whole.device.type & cl.device_type.CPU and units > 1:
        assert Device(threads=1).device.max_compute_units == 1
    assert Device(threads=units).device.max_compute_units == units

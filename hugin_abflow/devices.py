"""The devices that OpenCL's drivers offer, and the one that is meant."""

from __future__ import annotations

import logging
import os
import sys
from contextlib import suppress
from dataclasses import dataclass

import pyopencl as cl

from hugin_abflow import pocl, signals
from hugin_abflow.errors import DeviceError

_log = logging.getLogger(__name__)

_INSTALL = {
    "linux": "install a CPU runtime with `pip install 'pyopencl[pocl]'` (or Debian's pocl-opencl-icd), "
    "or your graphics card's OpenCL driver",
    "win32": "install your graphics card's driver, or Intel's CPU runtime for OpenCL",
    "darwin": "use a macOS with Apple's OpenCL, or install pocl from conda-forge",
}

# Where drivers are looked for, which devices PoCL offers, where it keeps kernels: a wrong one hides them all.
_HIDING = ("OCL_ICD_VENDORS", "POCL_DEVICES", "POCL_CACHE_DIR")


@dataclass
class Drivers:
    """What became of OpenCL's drivers in this process.

    inherited   its parent had loaded them before it was forked from that: their threads are not here, and who
                waits for them waits for ever.
    """

    loaded: bool = False
    inherited: bool = False

    def refuse_inherited(self) -> None:
        """Raise `DeviceError` where they do not work."""
        if self.inherited:
            raise DeviceError(
                "this process was forked from one in which OpenCL is in use, and cannot use it; start "
                "processes by 'spawn' or 'forkserver' (multiprocessing.set_start_method), or merge in forked "
                "ones alone"
            )

    def after_fork(self) -> None:
        """In a process that has just been forked."""
        self.inherited = self.loaded


drivers = Drivers()
if hasattr(os, "register_at_fork"):  # not on Windows, which does not fork
    os.register_at_fork(after_in_child=drivers.after_fork)


@dataclass(frozen=True)
class DeviceInfo:
    """One line of ``--list-devices``. memory: bytes; kind: "GPU", "CPU" or "other"."""

    index: int
    name: str
    platform: str
    kind: str
    memory: int
    default: bool


def kind_of(device: cl.Device) -> str:
    """ "GPU", "CPU" or "other"."""
    if device.type & cl.device_type.GPU:
        return "GPU"
    return "CPU" if device.type & cl.device_type.CPU else "other"


def _devices(threads: int = 0) -> list[cl.Device]:
    """All devices of all platforms. threads: as of `Device`.

    Raises `DeviceError` where there is none, and in a process forked from one that has loaded drivers.
    """
    drivers.refuse_inherited()
    drivers.loaded = True
    pocl.find_cache()
    if kept := pocl.kernel_folder():
        pocl.mend(kept)
    found, platforms = [], []
    with pocl.cores(threads), signals.held():  # drivers are loaded
        with suppress(cl.Error):
            platforms = cl.get_platforms()
        for platform in platforms:
            try:
                found += platform.get_devices()
            except cl.Error as error:  # a platform without devices must not hide the others
                _log.debug("%s: %s", platform.name, error)
    if not found:
        remedy = _INSTALL.get(sys.platform, _INSTALL["linux"])
        raise DeviceError(f"no OpenCL device found; {_hidden()}{remedy}")
    return found


def _hidden() -> str:
    """What the environment says that may hide devices, with what to do about it; empty: nothing."""
    found = [f"{name} is {os.environ[name]!r}" for name in _HIDING if name in os.environ]
    return f"in the environment {' and '.join(found)}: if that is wrong, unset it; else " if found else ""


def _speed(device: cl.Device) -> tuple[bool, int]:
    """Sort key: GPUs first, then by units x clock. Vendors count units differently; it is a guess."""
    return kind_of(device) == "GPU", device.max_compute_units * max(device.max_clock_frequency, 1)


def list_devices() -> list[DeviceInfo]:
    """All OpenCL devices, at least one; the one that is used by default is marked.

    Raises `DeviceError`, which says what to install, where there is none.
    """
    found, best = _devices(), choose(None)
    return [
        DeviceInfo(i, d.name.strip(), d.platform.name.strip(), kind_of(d), d.global_mem_size, d == best)
        for i, d in enumerate(found)
    ]


def choose(wanted: str | None, threads: int = 0) -> cl.Device:
    """The device that --device means; None: the one used by default. Raises `DeviceError`: there is none."""
    found = _devices(threads)
    if wanted is None:
        return max(found, key=_speed)
    if wanted.isdecimal():
        if int(wanted) < len(found):
            return found[int(wanted)]
    else:
        for device in found:
            if wanted.lower() in f"{device.name} {device.platform.name}".lower():
                return device
    names = ", ".join(f"{i} ({d.name.strip()})" for i, d in enumerate(found))
    raise DeviceError(f"no OpenCL device fits --device {wanted}; those of this machine, by number: {names}")


def limited(device: cl.Device, threads: int) -> cl.Device:
    """As many of a processor's cores as are allowed, where its driver can be told."""
    by_counts = cl.device_partition_property.BY_COUNTS
    if (
        not threads
        or kind_of(device) != "CPU"
        or threads >= device.max_compute_units
        or by_counts not in device.partition_properties
    ):
        return device
    (part,) = device.create_sub_devices([by_counts, threads, 0])
    return part

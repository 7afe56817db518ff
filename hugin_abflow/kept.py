"""Devices that all merges of this process share: a driver never frees all memory of one that is gone."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from hugin_abflow import trace
from hugin_abflow.devices import drivers
from hugin_abflow.errors import DeviceError
from hugin_abflow.opencl import Device, DeviceMemoryError

# By what was asked for, and whether they tell their times.
_kept: dict[tuple[str | None, int, bool], Device] = {}
_opening = threading.Lock()


def kept_device(wanted: str | None, threads: int) -> Device:
    """What `Device` gives, with all kernels built so far; the same one until it is lost. For any thread.

    Raises `DeviceError` as `Device` does.
    """
    key = wanted, threads, trace.is_recording()
    drivers.refuse_inherited()  # devices are, too
    with _opening:
        if key not in _kept:
            _kept[key] = Device(wanted, threads)
        return _kept[key]


@contextmanager
def in_use(device: Device) -> Iterator[None]:
    """Give back its memory at the end, and keep it no longer if it is lost: it does not come back, but its
    successor may.
    """
    try:
        yield
    except DeviceMemoryError:
        raise  # it is too small, not lost
    except DeviceError:
        _forget(device)
        raise
    finally:
        try:
            device.give_back()
        except DeviceError:
            _forget(device)  # whatever was told: it does not even finish


def _forget(lost: Device) -> None:
    with _opening:
        for key in [key for key, device in _kept.items() if device is lost]:
            del _kept[key]

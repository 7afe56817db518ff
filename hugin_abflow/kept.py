"""Devices that all merges of this process share: drivers keep some of the memory of one that is gone."""

from __future__ import annotations

import threading

from hugin_abflow import trace
from hugin_abflow.opencl import Device

# By what was asked for, and whether they tell their times.
_kept: dict[tuple[str | None, int, bool], Device] = {}
_opening = threading.Lock()


def kept_device(wanted: str | None, threads: int) -> Device:
    """What `Device` gives, with all kernels built so far; the same one until it is forgotten. For any thread.

    Raises `DeviceError` as `Device` does.
    """
    key = wanted, threads, trace.is_recording()
    with _opening:
        if key not in _kept:
            _kept[key] = Device(wanted, threads)
        return _kept[key]


def forget(lost: Device) -> None:
    """No longer keep a device that is lost: it does not come back, but its successor may. One whose memory
    was too small is not lost.
    """
    with _opening:
        for key in [key for key, device in _kept.items() if device is lost]:
            del _kept[key]

"""Devices that merges of one process share."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from pictures import merged, noise

from hugin_abflow import kept, opencl
from hugin_abflow.errors import DeviceError
from hugin_abflow.layer import Canvas, Layer

CANVAS = Canvas.plane(131, 77)
LAYERS = [Layer.from_array("a", noise(77, 80)), Layer.from_array("b", noise(77, 81, seed=1), 50)]


def test_merges_of_one_process_share_a_device_until_it_is_lost(monkeypatch):
    """Drivers keep some of the memory of each device that is gone."""
    opened, given_back = [], []
    monkeypatch.setattr(kept, "Device", lambda *wanted: opened.append(wanted) or opencl.Device(*wanted))
    monkeypatch.setattr(kept, "_kept", {})
    first, again = (merged(LAYERS, CANVAS, flow=False) for _ in range(2))
    assert opened == [(None, 0)] and np.array_equal(first, again)
    merged(LAYERS, CANVAS, flow=False, threads=1)
    assert opened == [(None, 0), (None, 1)]

    def failing(error, last=None):
        def fail(*_, **__):
            raise error

        def give_back():
            given_back.append(error)
            if last:
                raise last

        with monkeypatch.context() as patch, pytest.raises(DeviceError, match="is"):
            patch.setattr(opencl.Device, "run", fail)
            patch.setattr(kept._kept[None, 0, False], "give_back", give_back)
            merged(LAYERS, CANVAS, flow=False, working_pixels=1024)
        assert given_back[-1] is error
        assert np.array_equal(merged(LAYERS, CANVAS, flow=False), first)

    failing(opencl.DeviceMemoryError("its memory is too small"))
    assert opened == [(None, 0), (None, 1)]
    failing(DeviceError("the device is lost"))
    assert opened == [(None, 0), (None, 1), (None, 0)]
    failing(opencl.DeviceMemoryError("it is lost, says its memory is too small"), DeviceError("it is lost"))
    assert opened == [(None, 0), (None, 1), (None, 0), (None, 0)]
    merged(LAYERS, CANVAS, flow=False, threads=1)
    assert len(opened) == 4  # others are kept


def test_merges_at_a_time_open_one_device(monkeypatch):
    opened = []
    monkeypatch.setattr(kept, "Device", lambda *wanted: time.sleep(0.05) or opened.append(wanted) or wanted)
    monkeypatch.setattr(kept, "_kept", {})
    with ThreadPoolExecutor(4) as pool:
        got = list(pool.map(lambda _: kept.kept_device("x", 2), range(4)))
    assert opened == [("x", 2)] and got == [("x", 2)] * 4

"""Devices that merges of one process share."""

from __future__ import annotations

import os
import subprocess
import sys
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


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked there")
@pytest.mark.parametrize("first", ["merge()", "list_devices()", "choose('0', 1)", ""])
def test_a_forked_process_is_told_that_its_parents_device_is_not_there(first):
    """It waited for threads that only its parent has, for ever. If the parent has none, it works."""
    code = f"""
import os
import numpy as np
from hugin_abflow import Canvas, Layer, merge_layers
from hugin_abflow.devices import choose, list_devices
from hugin_abflow.errors import DeviceError

pixels = np.full((30, 40, 4), 255, np.uint8)
merge = lambda: merge_layers([Layer.from_array("a", pixels)], Canvas.plane(40, 30))
{first}
child = os.fork()
if not child:
    try:
        merge()
    except DeviceError as error:
        os._exit(3 if "forked" in str(error) and "spawn" in str(error) else 4)
    os._exit(0)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True
    )
    assert int(done.stdout) == (3 if first else 0)

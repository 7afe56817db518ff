"""Queues of one device side by side, each with memory of its own to use again."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from hugin_abflow.lane import StoppedError
from hugin_abflow.opencl import Buffer, Device


@pytest.fixture
def device() -> Iterator[Device]:
    """One whose memory nothing else uses."""
    yield Device()


def halve(device: Device, image: Buffer) -> None:
    """Start a kernel."""
    side = image.shape[0]
    small, share = (device.empty((side // 2,) * 2) for _ in range(2))
    grid, size = (side, side, 0, 0), (side // 2,) * 2
    device.run("pyramid", "pyramid_reduce", size, image, image, grid, small, share, size)


def test_what_is_made_in_a_lane_is_there_for_all_when_it_ends(device: Device) -> None:
    image = device.upload(np.arange(700**2, dtype=np.float32).reshape(700, 700))
    with device.lane(threading.Event()):
        lane, copies = device.current, [image]
        for _ in range(20):
            copies.append(device.copy(copies[-1]))
    assert device.current is not lane
    assert np.array_equal(device.copy(copies[-1]).get(), image.get())


def test_a_lane_is_used_again(device: Device) -> None:
    """Two at a time take two, whatever came before."""
    lanes = set()
    for _ in range(3):
        with device.lane(threading.Event()):
            lanes.add(device.current)
            other = threading.Thread(target=lambda: lanes.add(device.current))
            other.start()
            other.join()
    assert len(lanes) == 2  # the other thread has entered none: its is the first


SHAPE = (8, 8)
USES: dict[str, Callable[[Device, Buffer], object]] = {
    "fill": lambda device, buffer: buffer.fill(3),
    "set": lambda device, buffer: buffer.set(np.ones(SHAPE, np.float32)),
    "put": lambda device, buffer: buffer.put(1, np.ones((2, 8), np.float32)),
    "get": lambda device, buffer: buffer.get(),
    "copy from": lambda device, buffer: device.empty((16, 8)).copy(3, buffer, 0, 8),
    "copy to": lambda device, buffer: buffer.copy(0, device.zeros((16, 8)), 5, 8),
    "run": halve,
    "repeat": lambda device, buffer: device.repeat(
        "pyramid", "pyramid_reduce", (4, 4),
        [(buffer, buffer, (8, 8, 0, 0), device.empty((4, 4)), device.empty((4, 4)), (4, 4))], 2,
    ),
}  # fmt: skip


@pytest.mark.parametrize("use", USES)
def test_memory_waits_for_what_used_it_last(device: Device, use: str) -> None:
    """What another lane may still work on is not for this one."""
    with device.lane(threading.Event()):
        made, kept = device.zeros(SHAPE), device.zeros(SHAPE)
        own = device.current
    memory = made.data
    USES[use](device, made)  # by the first lane, which may not have begun
    del made
    with device.lane(threading.Event()):
        assert device.current is own
        assert device.empty(SHAPE).data != memory
        before = kept.data
        del kept
        assert device.empty(SHAPE).data == before
    assert device.empty(SHAPE).data == memory


def test_lanes_within_lanes_end_where_they_began(device: Device) -> None:
    with device.lane(threading.Event()):
        outer = device.current
        with device.lane(threading.Event()):
            assert device.current is not outer
        assert device.current is outer
    with device.lane(threading.Event()), device.lane(threading.Event()):
        assert len(device._lanes) == 3


def test_each_thread_starts_kernels_with_its_own_arguments(device: Device) -> None:
    """A kernel has one set of them, and threads may change at any time."""
    wrong = list[int]()

    def start(value: int) -> None:
        with device.lane(threading.Event()):
            image, mask, share = (device.empty(SHAPE).fill(one) for one in (value, 1, 0))
            found = [device.zeros((4, 4)) for _ in range(500)]
            for one in found:
                device.run("pyramid", "pyramid_reduce", (4, 4), image, mask, (8, 8, 0, 0), one, share, (4, 4))
            wrong.extend(value for one in found if not np.allclose(one.get(), value))

    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        threads = [threading.Thread(target=start, args=(value,)) for value in range(1, 5)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(before)
    assert not wrong


def test_memory_of_all_lanes_is_given_back(device: Device) -> None:
    with device.lane(threading.Event()):
        lane = device.current
        device.zeros((33, 7))
    assert lane.spare._kept
    device.give_back()
    assert not lane.spare._kept


@pytest.mark.parametrize("how", ["run", "repeat"])
def test_nothing_is_started_in_a_lane_that_is_stopped(device: Device, how: str) -> None:
    stopped, image = threading.Event(), device.zeros((8, 8))
    with pytest.raises(StoppedError), device.lane(stopped):
        halve(device, image)
        stopped.set()
        if how == "run":
            halve(device, image)
        else:
            device.repeat("pyramid", "pyramid_reduce", (4, 4), [], 1)
    halve(device, image)
    with device.lane(threading.Event()):
        halve(device, image)

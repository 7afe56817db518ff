"""Buffers and runs."""

from __future__ import annotations

import numpy as np
import pyopencl as cl
import pytest

from hugin_abflow import flow, spare
from hugin_abflow.grid import Border
from hugin_abflow.opencl import Device


def test_the_largest_group_of_a_kernel_can_be_started(device: Device) -> None:
    most = device.largest_group("flow", "flow_relax_small")
    assert 0 < most <= device.device.max_work_group_size
    board = flow.Board.of(device, 1, Border(5, 3, 0))
    device.run(
        "flow", "flow_relax_small", (most, 1, 1), board.grid, board.pitch, 1, 1.5, board.planes, group=most
    )
    assert not board.planes.get().any()


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
    assert device.current.spare._total <= spare.MOST_BYTES
    many = [device.empty((k,)) for k in range(1, 500)]
    del many
    assert len(device.current.spare._kept) <= spare.MOST_BLOCKS


def test_little_memory_is_not_given_back_where_much_is_asked_for() -> None:
    """What was freed since it was given back last counts, however often less than that was."""
    device = Device()
    kept = device.current.spare._kept
    for _ in range(2):
        device.empty((1000,))
        device.give_back(4001)
        assert len(kept) == 1
        still_in_use = device.empty((2000,))
        device.give_back(4001)
        assert len(kept) == 1
        device.empty((1,))
        device.give_back(4001)
        assert not kept
        del still_in_use
        device.give_back()
        assert not kept


def test_only_memory_of_its_own_counts_for_the_device() -> None:
    device = Device()
    kept = device.zeros((1 << 20,))
    assert device.own_memory == (0 if device.device.host_unified_memory else kept.nbytes)

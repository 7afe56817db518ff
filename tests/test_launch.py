"""What kernels are started with arrives there, of the type that they ask for."""

from __future__ import annotations

import numpy as np
import pyopencl as cl
import pytest

from hugin_abflow import launch
from hugin_abflow.opencl import Buffer, Device

SOURCE = """
__kernel void told(__global float *result, int4 a, float b, __global float *added, int c, float2 d, float16 e)
{
    const float values[] = {a.x, a.w, b, c, d.y, e.s0, e.sf, added[0]};
    for (int i = 0; i < 8; ++i)
        result[i] = values[i];
}
"""


def test_vectors_are_of_their_numbers_kind() -> None:
    """(1, 1) equals (1.0, 1.0), but a kernel reads other bits."""
    for values in ((1, 1), (1.0, 1.0), (1, 2, 3, 4), (1.0, 2.0, 3.0, 4.0), np.arange(16, dtype=np.float32)):
        vector = launch.argument(values)
        kind = np.int32 if isinstance(values[0], int) else np.float32
        assert vector.tobytes()[: 4 * len(values)] == np.array(values, kind).tobytes()
    assert launch.argument(np.arange(4, dtype=np.uint32)).dtype == np.int32
    assert launch.argument((True, False)).dtype == np.int32
    for truth in (True, np.True_):
        assert launch.argument(truth).dtype == np.int32
    assert launch.argument(2).dtype == np.int32
    assert launch.argument(2.0).dtype == np.float32


def test_arguments_arrive_each_time(device: Device) -> None:
    (kernel,) = cl.Program(device.context, SOURCE).build().all_kernels()
    result, nine, ten = device.empty((8,)), device.zeros((1,)).fill(9), device.zeros((1,)).fill(10)
    wide = np.arange(16, dtype=np.float32)
    for given, expected in (
        (((1, 2, 3, 4), 0.5, nine, -7, (1.5, 2.5), wide), [1, 4, 0.5, -7, 2.5, 0, 15, 9]),
        # numbers of NumPy and Python, whole ones for a float as well
        (((5, 6, 7, 8), 2, ten, np.int64(3), (1.0, -1.0), wide + 1), [5, 8, 2, 3, -1, 1, 16, 10]),
        (((5, 6, 7, 8), np.float64(0.25), ten, True, (1.0, 0.5), wide), [5, 8, 0.25, 1, 0.5, 0, 15, 10]),
    ):
        values = [value.data if isinstance(value, Buffer) else value for value in given]
        launch.set_arguments(kernel, [result.data, *values])
        cl.enqueue_nd_range_kernel(device.current.queue, kernel, *launch.work_groups((1,), 1))
        np.testing.assert_array_equal(result.get(), expected)


@pytest.mark.parametrize("wrong", [1 << 40, (1 << 40, 2), np.array([4e9, 2]).astype(np.uint32)])
def test_a_number_that_is_too_large_is_told(wrong: object) -> None:
    with pytest.raises(OverflowError):
        launch.argument(wrong)


@pytest.mark.parametrize("wrong", [None, "3", 1j, np.eye(4), (1.0, None)])
def test_what_is_no_number_is_told(wrong: object) -> None:
    with pytest.raises(TypeError):
        launch.argument(wrong)


def test_a_fraction_is_no_whole_number(device: Device) -> None:
    (kernel,) = cl.Program(device.context, "__kernel void whole(int a) {}").build().all_kernels()
    launch.set_arguments(kernel, [3])
    with pytest.raises(RuntimeError):
        launch.set_arguments(kernel, [3.5])


def test_work_groups_are_whole() -> None:
    assert launch.work_groups((257, 3), 256) == ((512, 3), (256, 1))
    assert launch.work_groups((256, 3, 2), 64) == ((256, 3, 2), (64, 1, 1))

"""The OpenCL device: its memory, and what it runs.

With `compiler`, `devices`, `lane` and `launch` the only module that uses pyopencl.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt
import pyopencl as cl

from hugin_abflow import launch, memory, pocl, signals, trace
from hugin_abflow.compiler import Compiler
from hugin_abflow.devices import choose, kind_of, limited
from hugin_abflow.errors import DeviceError
from hugin_abflow.lane import Lane, StoppedError

# Bytes of buffers that are worth giving back after each of many layers or pairs.
MUCH = 16 << 20

# Bytes up to which what is uploaded comes with its buffer: a copy in a queue waits for all before it.
_SMALL = 1 << 16

# Work-group: rows suit both a GPU's wavefronts and the vector units of a CPU.
_GROUP = 256


class DeviceMemoryError(DeviceError):
    """The device's memory is too small for what was asked; smaller pieces may fit."""


_OUT_OF_MEMORY = frozenset(
    {
        cl.status_code.MEM_OBJECT_ALLOCATION_FAILURE,
        cl.status_code.OUT_OF_RESOURCES,
        cl.status_code.OUT_OF_HOST_MEMORY,
        cl.status_code.INVALID_BUFFER_SIZE,
    }
)


@contextmanager
def _device_errors(doing: str) -> Iterator[None]:
    """Turn pyopencl's errors into ours."""
    try:
        yield
    except cl.Error as error:
        remedy = "close other programs that use it, or choose another --device"
        kind = DeviceMemoryError if error.code in _OUT_OF_MEMORY else DeviceError
        raise kind(f"the OpenCL device failed while {doing} ({error}); {remedy}") from error


class Buffer:
    """An array on the device: shape and dtype with a `cl.Buffer`. Freed with the object.

    host    what is in it from the start, of its shape and dtype; else that is anything.
    lane    where it was used last: what is done there afterwards may have its memory. What several lanes use
            has to live until all but one of them have ended.
    """

    def __init__(
        self,
        device: Device,
        shape: tuple[int, ...],
        dtype: npt.DTypeLike,
        host: npt.NDArray[Any] | None = None,
    ) -> None:
        self.shape, self.dtype = shape, np.dtype(dtype)
        self.nbytes = math.prod(map(int, shape)) * self.dtype.itemsize
        self._device, self.lane = device, device.current
        self.data = self.lane.spare.take(self.nbytes) if host is None else None
        if self.data is None:
            with _device_errors(f"allocating {self.nbytes} bytes"):
                flags, size = cl.mem_flags.READ_WRITE, max(self.nbytes, 16)
                if host is not None:
                    flags, size = flags | cl.mem_flags.COPY_HOST_PTR, 0  # its own
                self.data = cl.Buffer(device.context, flags, size, host)
        device.count(self.nbytes)

    def __del__(self) -> None:
        if getattr(self, "data", None) is not None:  # else there was no room for it
            self._device.count(-self.nbytes)
            self.lane.spare.keep(self.nbytes, self.data)

    def _transfer(self, name: str, *places: Any, **offsets: int) -> None:
        """Copy between arrays, the target first."""
        self.lane = self._device.current
        self.lane.timed(name, trace.TRANSFER, cl.enqueue_copy(self.lane.queue, *places, **offsets))

    def get(self) -> npt.NDArray[Any]:
        """Copy to the host."""
        host = np.empty(self.shape, self.dtype)
        if host.size:
            with _device_errors("copying to the host"):
                self._transfer("download", host, self.data)
            self.lane.tell_times()
        return host

    def set(self, host: npt.NDArray[Any]) -> Buffer:
        """Copy from the host; `host` has this buffer's shape."""
        if host.size:
            with _device_errors("copying from the host"):
                self._transfer("upload", self.data, np.ascontiguousarray(host, self.dtype))
        return self

    def put(self, start: int, host: npt.NDArray[Any]) -> None:
        """Copy from the host to this buffer's pixels from `start` on; the last axis is one pixel."""
        if host.size:
            with _device_errors("copying from the host"):
                rows = np.ascontiguousarray(host, self.dtype)
                self._transfer("upload", self.data, rows, dst_offset=start * self._pixel)

    def copy(self, start: int, source: Buffer, first: int, count: int) -> None:
        """Copy `count` pixels of another buffer, from its `first` on, to this one's from `start` on."""
        if count:
            source.lane = self._device.current
            with _device_errors("copying on the device"):
                self._transfer(
                    "copy", self.data, source.data, byte_count=count * self._pixel,
                    src_offset=first * self._pixel, dst_offset=start * self._pixel,
                )  # fmt: skip

    @property
    def _pixel(self) -> int:
        """Bytes of the last axis."""
        return self.shape[-1] * self.dtype.itemsize

    def fill(self, value: float) -> Buffer:
        """Set every element."""
        if self.nbytes:
            pattern = np.array(value, self.dtype)
            self.lane = self._device.current
            with _device_errors("filling a buffer"):
                cl.enqueue_fill_buffer(self.lane.queue, self.data, pattern, 0, self.nbytes)
        return self


class Device:
    """A device with its queues and built kernels.

    wanted      as `Settings.device`.
    threads     cores that a processor may use; 0: all. PoCL keeps to the first number in a process.

    Raises `DeviceError` if there is none, none fits `wanted`, or a kernel does not build.
    """

    def __init__(self, wanted: str | None = None, threads: int = 0) -> None:
        with signals.held():  # the driver starts its threads, from which PoCL starts its linker
            chosen = choose(wanted, threads)
            pocl.name_processor(chosen.version, chosen.driver_version, chosen.int_ptr)
            self.device = limited(chosen, threads)
            self.context = cl.Context([self.device])
            self._timing, self._lanes = trace.is_recording(), list[Lane]()
            self._first = self._another_lane()
        self._free, self._entering, self._entered = list[Lane](), threading.Lock(), threading.local()
        self._bytes, self._counting = 0, threading.RLock()  # buffers may be collected while it is held
        self._freed = 0
        self._compiler = Compiler(self.device, self.context)
        self._arguments = threading.Lock()  # a kernel keeps its arguments from when they are set to its start

    @property
    def name(self) -> str:
        """What device it is, and whose driver runs it."""
        return f"{self.device.name.strip()} ({self.device.platform.name.strip()})"

    @property
    def own_memory(self) -> int:
        """Bytes that buffers take and the host's count does not hold: those of a graphics card."""
        shared = self.device.host_unified_memory
        return 0 if shared else self._bytes

    def count(self, more: int) -> None:
        """Have buffers take so many bytes more. For any thread."""
        with self._counting:
            self._bytes += more
            self._freed += max(0, -more)

    @property
    def vector_floats(self) -> int:
        """How many floats it calculates with at a time: 8 with AVX, 16 with AVX-512; graphics cards 1."""
        return int(self.device.native_vector_width_float)

    @property
    def kind(self) -> str:
        """ "GPU", "CPU" or "other"."""
        return kind_of(self.device)

    @property
    def current(self) -> Lane:
        """The lane of this thread: the first one, unless it entered another."""
        lane: Lane = getattr(self._entered, "lane", self._first)
        return lane

    @contextmanager
    def lane(self, stopped: threading.Event) -> Iterator[None]:
        """Have what this thread starts done beside what others start, and done at the end of the block.

        Until then no other thread may use what it makes, nor it what others are not done with.
        stopped: from when this is set on, to start a kernel raises `StoppedError`.
        """
        with self._entering, _device_errors("starting another queue"):
            lane, before = self._free.pop() if self._free else self._another_lane(), self.current
        lane.stopped, self._entered.lane = stopped, lane
        try:
            yield
        finally:
            try:
                self.finish()
            finally:
                self._entered.lane = before
                self._free.append(lane)

    def _another_lane(self) -> Lane:
        with signals.held():  # as where the driver sets itself up
            self._lanes.append(Lane(self.context, len(self._lanes) + 1, self._timing))
        return self._lanes[-1]

    def empty(self, shape: Sequence[int], dtype: npt.DTypeLike = np.float32) -> Buffer:
        """An uninitialised array."""
        return Buffer(self, tuple(shape), dtype)

    def zeros(self, shape: Sequence[int], dtype: npt.DTypeLike = np.float32) -> Buffer:
        """An array of zeros."""
        return self.empty(shape, dtype).fill(0)

    def upload(self, host: npt.NDArray[Any], dtype: npt.DTypeLike | None = None) -> Buffer:
        """A copy of a host array."""
        host = np.asarray(host, dtype, order="C")
        if 0 < host.nbytes <= _SMALL:
            return Buffer(self, host.shape, host.dtype, host)
        return self.empty(host.shape, host.dtype).set(host)

    def copy(self, source: Buffer) -> Buffer:
        """A copy of an array on the device."""
        result = self.empty(source.shape, source.dtype)
        if source.nbytes:
            result.copy(0, source, 0, source.nbytes // source._pixel)
        return result

    def kernel(self, module: str, name: str, options: str = "") -> cl.Kernel:
        """Kernel `name` of ``kernels/<module>.cl``, built once per set of options."""
        return self.build(module, options)[name]

    def build(self, module: str, options: str = "") -> Mapping[str, cl.Kernel]:
        """The kernels of ``kernels/<module>.cl`` by name, built if they are not yet. For any thread."""
        return self._compiler.build(module, options)

    def largest_group(self, module: str, name: str, options: str = "") -> int:
        """How many work items a work-group of a kernel may have."""
        asked = cl.kernel_work_group_info.WORK_GROUP_SIZE
        return int(self.kernel(module, name, options).get_work_group_info(asked, self.device))

    def run(
        self,
        module: str,
        name: str,
        size: Sequence[int],
        *args: object,
        options: str = "",
        group: int | tuple[int, ...] = _GROUP,
    ) -> None:
        """Run a kernel over `size` (columns, rows, or columns, rows, layers) work items.

        Arguments: `Buffer`, int (int32), float (float32), or a tuple / array of 2, 4 or 16 numbers,
        which becomes an int or float vector. The run size is rounded up to whole work-groups; every
        kernel checks bounds first. Several threads may call it at a time.
        """
        if min(size) <= 0:
            return
        lane, kernel = self._started(), self.kernel(module, name, options)
        with self._arguments, _device_errors(f"running {name}"):
            launch.set_arguments(kernel, _values(args, lane))
            event = cl.enqueue_nd_range_kernel(lane.queue, kernel, *launch.work_groups(size, group))
        lane.timed(name, trace.KERNEL, event)

    def repeat(
        self,
        module: str,
        name: str,
        size: Sequence[int],
        calls: Sequence[Sequence[object]],
        times: int,
        options: str = "",
        group: int = _GROUP,
    ) -> None:
        """Run a kernel with each of the argument lists `calls` in turn, `times` over.

        Arguments are set once: on small grids that is most of what a launch costs.
        """
        lane, groups = self._started(), launch.work_groups(size, group)
        self.build(module, options)  # before others have to wait
        with self._arguments, _device_errors(f"running {name}"):
            kernels = self._compiler.instances(module, name, options, len(calls))
            for kernel, args in zip(kernels, calls, strict=True):
                launch.set_arguments(kernel, _values(args, lane))
            for _ in range(times):
                for kernel in kernels:
                    event = cl.enqueue_nd_range_kernel(lane.queue, kernel, *groups)
                    lane.timed(name, trace.KERNEL, event)

    def give_back(self, least: int = 0) -> None:
        """Return freed memory to the system, on the device and the host, at the end of a step. The driver
        keeps what other lanes still work with.

        least: bytes of buffers that are freed by then, or it is left to later steps: it takes milliseconds.
        """
        with self._counting:
            if self._freed < least:
                return
            self._freed = 0
        self.finish()  # what still waits for its kernels would stay
        for lane in self._lanes:
            lane.spare.release()
        memory.give_back()

    def finish(self) -> None:
        """Wait for all that this thread's lane started; raises `DeviceError` if the device failed."""
        with _device_errors("finishing"):
            self.current.queue.finish()
        self.current.tell_times()

    def flush(self) -> None:
        """Have all that this thread's lane started begun, while the host does something else."""
        with _device_errors("starting"):
            self.current.queue.flush()

    def _started(self) -> Lane:
        """The lane of this thread, unless that is stopped."""
        lane = self.current
        if lane.stopped.is_set():
            raise StoppedError
        return lane


def _values(arguments: Sequence[object], lane: Lane) -> list[object]:
    values = list(arguments)
    for index, value in enumerate(values):
        if isinstance(value, Buffer):
            value.lane, values[index] = lane, value.data
    return values

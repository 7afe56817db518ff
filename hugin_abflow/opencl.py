"""The OpenCL device: build, run. With `devices` and `launch` the only module that uses pyopencl."""

from __future__ import annotations

import math
import threading
import time
import warnings
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any
from weakref import WeakSet

import numpy as np
import numpy.typing as npt
import pyopencl as cl

from hugin_abflow import launch, memory, pocl, signals, trace
from hugin_abflow.devices import choose, kind_of, limited
from hugin_abflow.errors import DeviceError
from hugin_abflow.spare import Spare

# Work-group: rows suit both a GPU's wavefronts and the vector units of a CPU.
_GROUP = 256


@cache
def _kernel_files() -> dict[str, str]:
    """By name, in the package (wheel) or beside it (checkout); read once: they may be replaced meanwhile."""
    package = Path(__file__).resolve().parent
    folder = next(f for f in (package / "kernels", package.parent / "kernels") if f.is_dir())
    return {path.stem: path.read_text("utf-8") for path in folder.glob("*.cl")}


def kernel_source(module: str) -> str:
    """Source of ``kernels/<module>.cl`` with common.cl in front; #line keeps messages true."""
    return "".join(f'#line 1 "{name}.cl"\n{_kernel_files()[name]}\n' for name in ("common", module))


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
    """An array on the device: shape and dtype with a `cl.Buffer`. Freed with the object."""

    def __init__(self, device: Device, shape: tuple[int, ...], dtype: npt.DTypeLike) -> None:
        self.shape, self.dtype = shape, np.dtype(dtype)
        self.nbytes = math.prod(map(int, shape)) * self.dtype.itemsize
        self._device = device
        self.data = device.spare.take(self.nbytes)
        if self.data is None:
            with _device_errors(f"allocating {self.nbytes} bytes"):
                self.data = cl.Buffer(device.context, cl.mem_flags.READ_WRITE, max(self.nbytes, 16))
        device.buffers.add(self)

    def __del__(self) -> None:
        if getattr(self, "data", None) is not None:  # else there was no room for it
            self._device.spare.keep(self.nbytes, self.data)

    def _transfer(self, name: str, *places: Any, **offsets: int) -> None:
        """Copy between arrays, the target first."""
        self._device.timed(name, trace.TRANSFER, cl.enqueue_copy(self._device.queue, *places, **offsets))

    def get(self) -> npt.NDArray[Any]:
        """Copy to the host."""
        host = np.empty(self.shape, self.dtype)
        if host.size:
            with _device_errors("copying to the host"):
                self._transfer("download", host, self.data)
            self._device.tell_times()
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
            with _device_errors("filling a buffer"):
                cl.enqueue_fill_buffer(self._device.queue, self.data, pattern, 0, self.nbytes)
        return self


class _Times:
    """When the device did what; its queue does one thing after the other."""

    def __init__(self, queue: cl.CommandQueue) -> None:
        self._events: deque[tuple[str, str, cl.Event]] = deque()
        self._lock = threading.Lock()
        # its clock to ours: the least of several, for we may be told late
        self._offset = min(self._lag(queue) for _ in range(8))

    @staticmethod
    def _lag(queue: cl.CommandQueue) -> float:
        """Seconds from the end of an event on the device's clock to now on ours."""
        event = cl.enqueue_fill_buffer(queue, cl.Buffer(queue.context, 0, 16), np.int32(0), 0, 16)
        event.wait()
        return time.perf_counter() - float(event.profile.end) * 1e-9

    def add(self, name: str, kind: str, event: cl.Event) -> None:
        """Have the trace told when this was done, later."""
        self._events.append((name, kind, event))
        if kind == trace.TRANSFER:
            self.tell()  # at once: the event keeps the host's array

    def tell(self) -> None:
        """Tell the trace what is done."""
        complete = cl.command_execution_status.COMPLETE
        with self._lock:
            while self._events and self._events[0][2].command_execution_status == complete:
                name, kind, event = self._events.popleft()
                start, end = (self._offset + ns * 1e-9 for ns in (event.profile.start, event.profile.end))
                trace.add(name, kind, start, end, "device")


class Device:
    """A device with its queue and built kernels.

    wanted      as `Settings.device`.
    threads     cores that a processor may use; 0: all. PoCL keeps to the first number in a process.

    Raises `DeviceError` if there is none, none fits `wanted`, or a kernel does not build.
    """

    def __init__(self, wanted: str | None = None, threads: int = 0) -> None:
        timing = cl.command_queue_properties.PROFILING_ENABLE if trace.is_recording() else 0
        with signals.held():  # the driver starts its threads, from which PoCL starts its linker
            chosen = choose(wanted, threads)
            pocl.name_processor(chosen.version, chosen.int_ptr)
            self.device = limited(chosen, threads)
            self.context = cl.Context([self.device])
            self.queue = cl.CommandQueue(self.context, properties=timing)
        self._times = _Times(self.queue) if timing else None
        self.buffers: WeakSet[Buffer] = WeakSet()
        self.spare = Spare()
        self._kernels: dict[tuple[str, str], dict[str, cl.Kernel]] = {}
        self._programs: dict[tuple[str, str], cl.Program] = {}  # Intel's driver does not keep a kernel's own
        self._building = threading.Lock()
        self._repeated: dict[tuple[str, str, str], list[cl.Kernel]] = {}
        self._arguments = threading.Lock()  # a kernel keeps its arguments from when they are set to its start

    @property
    def name(self) -> str:
        """What device it is, and whose driver runs it."""
        return f"{self.device.name.strip()} ({self.device.platform.name.strip()})"

    @property
    def own_memory(self) -> int:
        """Bytes that buffers take and the host's count does not hold: those of a graphics card."""
        shared = self.device.host_unified_memory
        return 0 if shared else sum(buffer.nbytes for buffer in self.buffers)

    @property
    def has_long_vectors(self) -> bool:
        """Whether it calculates with 16 floats at a time, as processors with AVX-512 do."""
        return bool(self.device.native_vector_width_float >= 16)

    @property
    def kind(self) -> str:
        """ "GPU", "CPU" or "other"."""
        return kind_of(self.device)

    def empty(self, shape: Sequence[int], dtype: npt.DTypeLike = np.float32) -> Buffer:
        """An uninitialised array."""
        return Buffer(self, tuple(shape), dtype)

    def zeros(self, shape: Sequence[int], dtype: npt.DTypeLike = np.float32) -> Buffer:
        """An array of zeros."""
        return self.empty(shape, dtype).fill(0)

    def upload(self, host: npt.NDArray[Any], dtype: npt.DTypeLike | None = None) -> Buffer:
        """A copy of a host array."""
        return self.empty(host.shape, dtype or host.dtype).set(host)

    def copy(self, source: Buffer) -> Buffer:
        """A copy of an array on the device."""
        result = self.empty(source.shape, source.dtype)
        if source.nbytes:
            result.copy(0, source, 0, source.nbytes // source._pixel)
        return result

    def kernel(self, module: str, name: str, options: str = "") -> cl.Kernel:
        """Kernel `name` of ``kernels/<module>.cl``, built once per set of options."""
        return self.build(module, options)[name]

    def build(self, module: str, options: str = "") -> dict[str, cl.Kernel]:
        """The kernels of ``kernels/<module>.cl`` by name, built if they are not yet. For any thread."""
        key = module, options
        if key not in self._kernels:  # what is built does not wait for what is being built
            with self._building:
                self._kernels[key] = self._kernels.get(key) or self._build(module, options)
        return self._kernels[key]

    def _build(self, module: str, options: str) -> dict[str, cl.Kernel]:
        try:
            # compilers chat; errors come with the exception
            with warnings.catch_warnings(), signals.held():
                warnings.simplefilter("ignore", cl.CompilerWarning)
                program = cl.Program(self.context, kernel_source(module))
                program.build(["-cl-std=CL1.2", *options.split()])
        except cl.Error as error:
            raise DeviceError(
                f"kernels/{module}.cl does not build on {self.device.name.strip()}: {error}; "
                "update the OpenCL driver or choose another --device"
            ) from error
        self._programs[module, options] = program
        kernels = {kernel.function_name: kernel for kernel in program.all_kernels()}
        if not kernels:  # some drivers call that a success
            raise DeviceError(
                f"kernels/{module}.cl has no kernels for {self.device.name.strip()}; use another --device"
            )
        return kernels

    def run(
        self,
        module: str,
        name: str,
        size: Sequence[int],
        *args: object,
        options: str = "",
        group: int = _GROUP,
    ) -> None:
        """Run a kernel over `size` (columns, rows, or columns, rows, layers) work items.

        Arguments: `Buffer`, int (int32), float (float32), or a tuple / array of 2, 4 or 16 numbers,
        which becomes an int or float vector. The run size is rounded up to whole work-groups; every
        kernel checks bounds first. Several threads may call it at a time.
        """
        if min(size) <= 0:
            return
        with self._arguments, _device_errors(f"running {name}"):
            kernel = self.kernel(module, name, options)
            launch.set_arguments(kernel, _values(args))
            event = cl.enqueue_nd_range_kernel(self.queue, kernel, *launch.work_groups(size, group))
        self.timed(name, trace.KERNEL, event)

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
        groups = launch.work_groups(size, group)
        with self._arguments, _device_errors(f"running {name}"):
            kernels = self._instances(module, name, options, len(calls))
            for kernel, args in zip(kernels, calls, strict=True):
                launch.set_arguments(kernel, _values(args))
            for _ in range(times):
                for kernel in kernels:
                    event = cl.enqueue_nd_range_kernel(self.queue, kernel, *groups)
                    self.timed(name, trace.KERNEL, event)

    def _instances(self, module: str, name: str, options: str, count: int) -> list[cl.Kernel]:
        """Objects of one kernel, each with arguments of its own; they are slow to make."""
        first = self.kernel(module, name, options)
        made = self._repeated.setdefault((module, name, options), [first])
        made += [cl.Kernel(self._programs[module, options], name) for _ in range(count - len(made))]
        return made[:count]

    def give_back(self) -> None:
        """Return freed memory to the system, on the device and the host, at the end of a step."""
        self.finish()  # what still waits for its kernels would stay
        self.spare.release()
        memory.give_back()

    def finish(self) -> None:
        """Wait for all that was started; raises `DeviceError` if the device failed."""
        with _device_errors("finishing"):
            self.queue.finish()
        self.tell_times()

    def flush(self) -> None:
        """Have all that was started begun, while the host does something else."""
        with _device_errors("starting"):
            self.queue.flush()

    def timed(self, name: str, kind: str, event: cl.Event) -> None:
        """Have the trace, where there is one, told later when this was done."""
        if self._times:
            self._times.add(name, kind, event)

    def tell_times(self) -> None:
        """Tell the trace what is done."""
        if self._times:
            self._times.tell()


def _values(arguments: Sequence[object]) -> list[object]:
    return [value.data if isinstance(value, Buffer) else value for value in arguments]

"""Kernels, compiled for a device: their source, and which files are built as one program."""

from __future__ import annotations

import logging
import threading
import time
import warnings
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import pyopencl as cl

from hugin_abflow import pocl, signals
from hugin_abflow.errors import DeviceError

_log = logging.getLogger(__name__)

# A build that takes more seconds than this compiled the program; one that takes less found it in the driver's
# cache.
_COMPILED = 0.5

# Modules whose kernels are built for a kind of pixels, each alone. All others are built as one program: PoCL
# keeps what it compiled, but for each program it reads OpenCL's headers, which takes longer than all of ours.
_OF_PIXELS = frozenset({"blend", "working"})


@cache
def _kernel_files() -> dict[str, str]:
    """By name, in the package (wheel) or beside it (checkout); read once: they may be replaced meanwhile."""
    package = Path(__file__).resolve().parent
    folder = next(f for f in (package / "kernels", package.parent / "kernels") if f.is_dir())
    return {path.stem: path.read_text("utf-8") for path in folder.glob("*.cl")}


def kernel_source(*modules: str) -> str:
    """The source of modules as one text: common.cl, then each ``kernels/<module>.cl``; in front of each file
    its parts, as blend_rows.cl in front of blend.cl. By #line compilers name the file and line that is meant.
    """
    names = [name for one in ("common", *modules) for name in (*_parts(one), one)]
    return "".join(f'#line 1 "{name}.cl"\n{_kernel_files()[name]}\n' for name in names)


def _parts(module: str) -> list[str]:
    """The parts of a module's file, which are told by their names: "blend_rows" is one of "blend"."""
    return sorted(name for name in _kernel_files() if name.startswith(f"{module}_"))


def _built_with(module: str, options: str) -> tuple[str, ...]:
    """The modules that are built with this one, and itself."""
    files = _kernel_files().keys()
    parts = {part for one in files for part in _parts(one)}
    others = sorted(files - parts - _OF_PIXELS - {"common"})
    return tuple(others) if module in others and not options else (module,)


class Compiler:
    """Builds kernels for one device, each file once per set of build options. `build` is for any thread.

    Raises `DeviceError` if a kernel does not build.
    """

    def __init__(self, device: cl.Device, context: cl.Context) -> None:
        self._device, self._context = device, context
        self._kernels: dict[tuple[str, str], dict[str, cl.Kernel]] = {}
        self._programs: dict[tuple[str, str], cl.Program] = {}  # Intel's driver does not keep a kernel's own
        self._instances: dict[tuple[str, str, str], list[cl.Kernel]] = {}
        self._building, self._one_by_one, self._told = threading.Lock(), False, False

    def build(self, module: str, options: str = "") -> Mapping[str, cl.Kernel]:
        """The kernels of ``kernels/<module>.cl`` by name, built if they are not yet."""
        key = module, options
        if key not in self._kernels:  # what is built does not wait for what is being built
            with self._building:
                if key not in self._kernels:
                    self._build_with_others(module, options)
        return self._kernels[key]

    def instances(self, module: str, name: str, options: str, count: int) -> list[cl.Kernel]:
        """Objects of one kernel, each with arguments of its own; they are slow to make."""
        first = self.build(module, options)[name]
        made = self._instances.setdefault((module, name, options), [first])
        made += [cl.Kernel(self._programs[module, options], name) for _ in range(count - len(made))]
        return made[:count]

    def _build_with_others(self, module: str, options: str) -> None:
        modules = (module,) if self._one_by_one else _built_with(module, options)
        try:
            kernels = self._build(modules, options)
        except DeviceError:
            if len(modules) == 1:
                raise
            # perhaps the one that fails is not needed; if it is, the error names it
            self._one_by_one = True
            modules, kernels = (module,), self._build((module,), options)
        self._kernels |= {(one, options): kernels for one in modules}

    def _build(self, modules: Sequence[str], options: str) -> dict[str, cl.Kernel]:
        """The kernels of some modules, built as one program."""
        # the name is told where one module is built: errors of several are not told, but each is built again
        file, began = f"kernels/{modules[0]}.cl", time.perf_counter()
        try:
            # compilers chat; errors come with the exception
            with warnings.catch_warnings(), signals.held():
                warnings.simplefilter("ignore", cl.CompilerWarning)
                program = cl.Program(self._context, kernel_source(*modules))
                program.build(["-cl-std=CL1.2", *self._exactness, *options.split()])
        except cl.Error as error:
            raise DeviceError(
                f"{file} does not build on {self._device.name.strip()}: {error}; "
                "update the OpenCL driver or choose another --device"
            ) from error
        if not self._told and time.perf_counter() - began > _COMPILED:
            self._told = True
            _log.info("kernels: compiled for this device, and kept: later runs take less time")
        self._programs |= {(one, options): program for one in modules}
        kernels = {kernel.function_name: kernel for kernel in program.all_kernels()}
        if not kernels:  # some drivers call that a success
            kept = pocl.kernel_folder() if "pocl" in self._device.version.lower() else None
            remedy = f"remove {kept}, which may be damaged, or " if kept else ""
            raise DeviceError(
                f"{file} has no kernels for {self._device.name.strip()}; {remedy}use another --device"
            )
        return kernels

    @property
    def _exactness(self) -> tuple[str, ...]:
        """Build options: quotients and roots rounded as processors round them, where the device can do that.
        OpenCL allows 2.5 ulp, with which a share of a sum of one is not 1.
        """
        exact = self._device.single_fp_config & cl.device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT
        return ("-cl-fp32-correctly-rounded-divide-sqrt",) if exact else ()

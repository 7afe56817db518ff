"""What a kernel is started with: its work-groups and arguments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyopencl as cl


def work_groups(size: Sequence[int], group: int | tuple[int, ...]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """A run size in whole work-groups, and the size of these. group: columns, or columns, rows."""
    group = (group,) if isinstance(group, int) else group
    local = (*group, *(1 for _ in range(len(size) - len(group))))
    return tuple(-(-int(wanted) // its) * its for wanted, its in zip(size, local, strict=True)), local


def set_arguments(kernel: cl.Kernel, values: Sequence[object]) -> None:
    """Set a kernel's arguments: `cl.Buffer`, int (int32), float (float32), or a tuple / array of 2, 4 or 16
    numbers, an int or float vector. Each has the type that it had the first time.
    """
    arguments = [value if isinstance(value, cl.Buffer) else argument(value) for value in values]
    if not hasattr(kernel, "abflow_typed"):
        # told once: to find types out each time takes forty times as long as all that is left
        kernel.set_arg_types([None if isinstance(one, cl.Buffer) else _type(one) for one in arguments])
        kernel.abflow_typed = True
    kernel.set_args(*arguments)


def argument(value: Any) -> Any:
    """A number or several, int32 or float32, as a kernel takes them."""
    if isinstance(value, int | np.integer | np.bool_):
        return np.int32(value)
    if isinstance(value, float | np.floating):
        return np.float32(value)
    several = np.asarray(value)
    if several.ndim != 1 or several.dtype.kind not in "biuf":
        raise TypeError(f"no kernel takes {value!r}")
    # from Python's numbers: of NumPy's those that are too large would become others
    return np.array(several.tolist(), np.float32 if several.dtype.kind == "f" else np.int32)


def _type(value: Any) -> np.dtype[Any]:
    """What `argument` gave, as OpenCL's types. A vector's bytes are taken as they are: pyopencl's own way to
    make one takes thirty times as long.
    """
    kind = "int" if value.dtype.kind == "i" else "float"
    vector: np.dtype[Any] = getattr(cl.cltypes, f"{kind}{value.size}") if value.ndim else value.dtype
    return vector

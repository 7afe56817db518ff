"""How much memory a run may take, how much it takes, and giving back what is free.

Host and device count together: the device may be the host's own processor.
"""

from __future__ import annotations

import ctypes
import math
import re
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import psutil

from hugin_abflow.errors import SettingsError

_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")
_NAMES = ((1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB"))
_UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}
# What containers may take at most (Linux, control groups 2 and 1).
_CONTAINER_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")


def parse_size(text: str) -> int:
    """Bytes of ``800M``, ``1.5G``, ``2GiB``; units are powers of 1024. Raises `SettingsError`."""
    # so many digits that a float still holds them
    found = re.fullmatch(r"(\d{1,99}(?:\.\d*)?)\s*([KMGT]?)(?:i?B)?", text.strip(), re.IGNORECASE)
    if not found:
        raise SettingsError(f"{text!r} is no size; give a number with K, M or G, such as 800M or 1.5G")
    return int(float(found[1]) * _UNITS[found[2].upper()])


def size(number: int) -> str:
    """A number of bytes for people, so exactly that a limit and what is a little more are told apart."""
    for unit, name in _NAMES:
        if number >= unit:
            return f"{number / unit:.{1 if unit < 1 << 30 else 2}f} {name}"
    return f"{number} bytes"


def machine() -> int:
    """Bytes that the machine has, or that the container which we are in may take."""
    sizes = [int(psutil.virtual_memory().total)]
    for name in _CONTAINER_LIMITS:
        try:
            sizes.append(int(Path(name).read_text()))
        except (OSError, ValueError):  # there is none, or it is "max"
            continue
    return min(sizes)


_sharers = 1


def share(processes: int) -> None:
    """Have what this process may take be one of so many parts: the others run beside it."""
    global _sharers
    _sharers = processes


def limit(max_memory: int) -> int:
    """Bytes that this process may take: its share of `max_memory`, or of half of the machine's for 0."""
    return (max_memory or machine() // 2) // _sharers


def unused() -> int:
    """Bytes that nobody uses, or this process's share of them; the system's file cache counts as not used."""
    return min(machine(), int(psutil.virtual_memory().available)) // _sharers


def shortage(max_memory: int, needed: int) -> tuple[str, str]:
    """For messages where `limit` is less than `needed`: whose limit that is, and what to do."""
    whole = size(limit(max_memory) * _sharers)
    given = f"--max-memory {whole}" if max_memory else f"half of the machine's memory, {whole}"
    if _sharers == 1:
        return given, f"give {_enough(needed)}"
    return (
        f"{given}, for each of {_sharers} --jobs {size(limit(max_memory))},",
        f"give {_enough(needed * _sharers)}, or fewer --jobs",
    )


def _enough(needed: int) -> str:
    """For so many bytes, as `--max-memory` takes it; a little more, since what a process holds varies."""
    return f"{math.ceil(needed * 1.03 / (1 << 20))}M"


def resident() -> int:
    """Bytes of this process that are in memory."""
    return int(psutil.Process().memory_info().rss)


def reset_peak() -> None:
    """Begin anew, so that `peak` tells of what follows; only Linux can."""
    with suppress(OSError):
        _RESET.write_text("5")


def peak() -> int:
    """The most that `resident` was."""
    with suppress(OSError):
        found = re.search(r"^VmHWM:\s+(\d+) kB$", _STATUS.read_text(), re.MULTILINE)
        if found:
            return int(found[1]) << 10
    if sys.platform == "win32":
        return int(psutil.Process().memory_info().peak_wset)
    import resource  # Unix alone has it

    kilobytes = 1 if sys.platform == "darwin" else 1 << 10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * kilobytes


# glibc's names of what `mallopt` sets, and what is set: blocks from _BLOCK bytes on are taken from the system
# and given back at once; of smaller ones as much as _TOP is kept for the next.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_BLOCK, _TOP = 5 << 19, 16 << 20


@cache
def _glibc() -> Any:
    """The C library, if it is glibc; others give freed memory back by themselves."""
    library = ctypes.CDLL(None) if sys.platform == "linux" else None
    return library if hasattr(library, "malloc_trim") else None


def manage() -> None:
    """For commands, whose process is theirs: have the C library keep less of what is freed.

    By itself glibc keeps blocks of up to 32 MiB, with gaps between them that nothing fits into: half as much
    again as is used.
    """
    if _glibc():
        _glibc().mallopt(_M_TRIM_THRESHOLD, _TOP)
        _glibc().mallopt(_M_MMAP_THRESHOLD, _BLOCK)


def give_back() -> None:
    """Return freed memory to the system; it takes milliseconds."""
    if _glibc():
        _glibc().malloc_trim(0)

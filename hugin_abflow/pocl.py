"""Where PoCL, OpenCL on the processor, would not work: it is helped.

**A processor that is newer than its compiler.** PoCL asks its LLVM for the processor's name. Where LLVM is
older it may say "generic", which its own compiler then refuses: no program builds at all (PoCL's issue 1049).
So does PoCL 3.0 of PyPI, with LLVM 14, on AMD's Zen 5. Or it says what came before: on Zen 4, Zen 3, which
has no AVX-512, while PoCL loads its functions for AVX-512. They pass long vectors in another way, and the
compiler does not end. Either device is given the name of another processor.

**Code that is slow.** What PoCL 3.0 compiles for AVX-512 takes a third longer on Intel's processors than what
it compiles for AVX2. So their devices are given the name of a processor with AVX2. PoCL still loads its
functions for AVX-512; that is harmless, since kernels hand them no vector that is longer than AVX2's.

**A home that cannot be written**, as in containers, and of services. PoCL keeps what it compiled there, and
offers no device if it cannot; pyopencl fails as well. On a full disk, or one that no program may be run from,
it ends the process. They are given a folder among temporary files. POCL_CACHE_DIR is passed over where it
names such a place.

**Empty files among what it compiled**, as a power cut or a full disk leaves them. PoCL takes them for whole:
each run after that is ended by the system, or finds programs without kernels. They are removed.

**Fewer cores.** PoCL 3.0 says that a part of a processor (a sub-device) has as many as were asked for, and
calculates on all of them; with TBB, newer ones offer no parts. It is told by variables that it reads once.
"""

from __future__ import annotations

import ctypes
import logging
import os
import platform
import re
import stat
import struct
import sys
import time
from collections.abc import Iterator, Set
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

_log = logging.getLogger(__name__)

# The processor's name in a version of PoCL's, behind LLVM's name of the system: "...-pc-linux-gnu-znver3". On
# openSUSE that is "-linux-" alone, on Alpine "-linux-musl-".
_NAME = re.compile(r"-linux(?:-(?:gnu|musl)\w*)?-(.+)$")

# What LLVM calls processors that it may not know; programs for these use no AVX-512.
_GUESSES = ("generic", "znver1", "znver2", "znver3")

# Code for AVX-512 is slow if CL_DRIVER_VERSION begins so, on processors of this maker. AMD's lose by AVX2;
# others were not measured.
_SLOW = "3.0"
_SLOW_ON = "GenuineIntel"

# PoCL's libraries of functions. Of each: the feature, as /proc/cpuinfo calls it, by which alone PoCL chooses
# it; the processor for which it was compiled; and what else programs for that processor may use.
_PROCESSORS: tuple[tuple[str, str, Set[str]], ...] = (
    ("avx512f", "skylake-avx512", {"avx512bw", "avx512cd", "avx512dq", "avx512vl", "adx", "clflushopt"}),
    ("avx2", "haswell", {"sse4_2", "popcnt", "fma", "f16c", "bmi1", "bmi2", "abm", "movbe"}),
)

# Where PoCL and pyopencl keep things, in a folder for caches.
_CACHES = ("pocl/kcache", "pytools")

# The ends of the names of what PoCL compiled.
_PROGRAMS = (".so", ".bc")
# Seconds after which none of that is still being written.
_WRITTEN = 60.0

# Where temporary files may be, beside where TMPDIR says.
_PLACES = ("/tmp", "/var/tmp")

# What tells PoCL how many cores it may use: since 5.0, and before.
_CORES = ("POCL_CPU_MAX_CU_COUNT", "POCL_MAX_PTHREAD_COUNT")

# Compiled kernels take several MiB for each depth and number of channels.
_LEAST_ROOM = 32 << 20

# The first bytes of a device's record (`struct _cl_device_id`); in PoCL 3.0 the name's address is at 640.
_RECORD = 1536


def find_cache() -> None:
    """Have compiled kernels kept among temporary files where there is no home that can hold them.

    To be called before OpenCL's drivers are loaded. Sets XDG_CACHE_HOME, which PoCL and pyopencl ask, and
    removes a POCL_CACHE_DIR that cannot hold them.
    """
    if sys.platform != "linux":
        return
    named = os.environ.get("POCL_CACHE_DIR")
    if named is not None and not (named and _holds_programs(Path(named))):
        del os.environ["POCL_CACHE_DIR"]
        _log.warning(
            "POCL_CACHE_DIR is '%s', which cannot hold compiled kernels, and is not used: name a folder that "
            "you can write, with %d MiB of room, on a disk from which programs may be run, or unset it",
            named,
            _LEAST_ROOM >> 20,
        )
    try:
        own = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:  # the system does not know the user
        own = None
    if own and all(_holds_programs(own / name) for name in _CACHES):
        if "HOME" not in os.environ:  # PoCL would take a folder that all users share, or cannot
            os.environ["XDG_CACHE_HOME"] = str(own)
        return
    for place in (os.environ.get("TMPDIR") or _PLACES[0], *_PLACES):
        folder = Path(place, f"hugin-abflow-cache-{os.getuid()}").absolute()
        if _holds_programs(folder) and _make_private(folder):
            os.environ["XDG_CACHE_HOME"] = str(folder)
            return
    _log.warning(
        "no folder is found for compiled kernels, OpenCL may fail: set XDG_CACHE_HOME to one that you can "
        "write, with %d MiB of room, on a disk from which programs may be run",
        _LEAST_ROOM >> 20,
    )


def kernel_folder() -> Path | None:
    """Where PoCL keeps what it compiled; None where that is not known."""
    if own := os.environ.get("POCL_CACHE_DIR"):
        return Path(own)
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / _CACHES[0]
    except RuntimeError:  # the system does not know the user
        return None


@cache
def mend(folder: Path) -> None:
    """Remove programs without content from PoCL's folder, which compiles them anew; once in a process.

    To be called before OpenCL's drivers are loaded. What is new may still be written by another process. It
    takes 1 to 2 ms for the files of some panoramas' kinds of pixels.
    """
    settled = time.time() - _WRITTEN
    folders = [os.fspath(folder)]
    while folders:
        with suppress(OSError), os.scandir(folders.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    folders.append(entry.path)
                elif entry.name.endswith(_PROGRAMS):  # others are empty as it is
                    with suppress(OSError):  # another process was faster
                        status = entry.stat(follow_symlinks=False)
                        if not status.st_size and status.st_mtime < settled:
                            os.unlink(entry.path)  # noqa: PTH108
                            _log.debug("%s was empty, and is compiled anew", entry.path)


@contextmanager
def cores(count: int) -> Iterator[None]:
    """Have PoCL use so many cores, and no more than there are, if its drivers are loaded meanwhile; 0: all.

    What the environment says already counts. Nothing is left in it.
    """
    told = {} if not count or any(name in os.environ for name in _CORES) else dict.fromkeys(_CORES)
    for name in told:
        os.environ[name] = str(min(count, os.cpu_count() or count))
    try:
        yield
    finally:
        for name in told:
            os.environ.pop(name, None)


def _holds_programs(folder: Path) -> bool:
    """Whether programs can be written to a folder, which may have to be made itself, and run from there."""
    try:
        there = folder.absolute()
        while not there.exists() and not there.is_symlink():
            there = there.parent
        system = os.statvfs(there)
    except OSError:  # it must not even be looked at, or leads nowhere
        return False
    full = system.f_blocks and system.f_bavail * system.f_frsize < _LEAST_ROOM  # some systems do not tell
    return (
        not full
        and not system.f_flag & os.ST_NOEXEC
        and there.is_dir()
        and os.access(there, os.W_OK | os.X_OK)
    )


def _make_private(folder: Path) -> bool:
    """Make a folder in which nobody else may write, if it is not there; returns whether it is such now."""
    with suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022
    return False


def name_processor(version: str, driver: str, record: int) -> None:
    """Have PoCL compile for a processor that its compiler knows, and makes quick code for.

    version     what the device says of itself (CL_DEVICE_VERSION); PoCL's ends with the processor's name.
    driver      which version of PoCL it is (CL_DRIVER_VERSION).
    record      the address of its `cl_device_id`; parts of it (sub-devices) have to be made afterwards.

    Nothing happens on other systems than Linux on x86-64, on processors that can do less than AVX2, where the
    name will do, or if the record is not as expected: that programs do not build is told there.
    """
    named = _NAME.search(version)
    if not named or "pocl" not in version.lower():
        return
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return
    own = named[1]
    try:
        maker, features = _processor()
        slow = driver.startswith(_SLOW) and maker == _SLOW_ON
        name = _better(own, features, slow)
        if name and _rename(record, own, name):
            _log.debug("PoCL takes this processor for %s; it compiles for %s", own, name)
    except OSError as error:
        _log.debug("PoCL takes this processor for %s, and cannot be told otherwise: %s", own, error)


def _processor() -> tuple[str, Set[str]]:
    """Who made this processor, and what it can do, in the words of /proc/cpuinfo."""
    lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    told = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    return told.get("vendor_id", ""), set(told.get("flags", "").split())


def _better(own: str, features: Set[str], slow: bool) -> str | None:
    """What to call a processor with these features, which PoCL calls `own`; None if that is to stay.

    slow: whether code for AVX-512 is slow; then it is called as one that has all but that.
    """
    if slow and "avx512f" in features and (name := _like(features - {"avx512f"})):
        return name
    unknown = own in _GUESSES if "avx512f" in features else own == _GUESSES[0]
    return _like(features) if unknown else None


def _like(features: Set[str]) -> str | None:
    """A processor for which PoCL's functions are compiled, and which has no other features than these."""
    for decisive, name, others in _PROCESSORS:
        if decisive in features:
            return name if others <= features else None
    return None


def _rename(record: int, guess: str, name: str) -> bool:
    """Have the device's record hold this name in place of the guess; returns whether it held that."""
    wanted = guess.encode() + b"\0"
    # this file fails where an address leads nowhere, and a pointer would end the process
    memory = os.open("/proc/self/mem", os.O_RDWR)
    try:
        words = os.pread(memory, _RECORD, record)
        for place in range(0, len(words) - 7, 8):
            (address,) = struct.unpack_from("@Q", words, place)
            if _read(memory, address, len(wanted)) == wanted:
                os.pwrite(memory, struct.pack("@Q", _copied(name)), record + place)
                return True
        return False
    finally:
        os.close(memory)


def _read(memory: int, address: int, size: int) -> bytes:
    """So many bytes; none where there is no memory."""
    try:
        return os.pread(memory, size, address)
    except (OSError, OverflowError):
        return b""


def _copied(name: str) -> int:
    """The address of a copy that PoCL may free as its own."""
    duplicate = ctypes.CDLL(None).strdup
    duplicate.restype = ctypes.c_size_t
    return int(duplicate(name.encode()))

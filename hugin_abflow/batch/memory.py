"""The largest resident memory of this process, of one project at a time where the system can tell."""

from __future__ import annotations

import re
import sys
from contextlib import suppress
from pathlib import Path

_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def reset_peak() -> None:
    """Begin anew, so that `peak` tells of what follows; only Linux can."""
    with suppress(OSError):
        _RESET.write_text("5")


def peak() -> int | None:
    """Bytes; None on Windows."""
    with suppress(OSError):
        found = re.search(r"^VmHWM:\s+(\d+) kB$", _STATUS.read_text(), re.MULTILINE)
        if found:
            return int(found[1]) << 10
    if sys.platform == "win32":
        return None
    import resource  # Unix alone has it

    kilobytes = 1 if sys.platform == "darwin" else 1 << 10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * kilobytes

"""Settings of the whole process. Only the commands make them: a program that uses the library has its own."""

from __future__ import annotations

import sys

from hugin_abflow import memory

# Seconds until a thread that waits for Python's lock gets it. By itself 5 ms: as long as a decoder takes for
# a strip, or the device for dozens of kernels, in which a core has nothing to do.
_SWITCH = 2e-4


def set_up() -> None:
    """Keep less of what is freed, and let threads that decode, start kernels and encode take turns soon."""
    memory.manage()
    sys.setswitchinterval(_SWITCH)

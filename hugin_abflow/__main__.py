"""The commands: to load what they need takes a while, in which Ctrl-C or SIGTERM may come."""

import gc
import os
import sys
from importlib import import_module

from hugin_abflow.signals import deferred, interruptible


def main() -> int:
    """Run ``hugin-abflow``, which is also ``python -m hugin_abflow``; gives its exit code."""
    return _run("hugin-abflow", "hugin_abflow.cli")


def enblend() -> int:
    """Run ``abflow-enblend``; gives its exit code."""
    return _run("abflow-enblend", "hugin_abflow.dropin.enblend")


def setup() -> int:
    """Run ``hugin-abflow-setup``; gives its exit code."""
    return _run("hugin-abflow-setup", "hugin_abflow.dropin.setup")


def _run(program: str, module: str) -> int:
    # before NumPy is loaded: idle threads of its BLAS turn round and round, on cores that others need
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    gc.disable()  # what is loaded stays: there is nothing to be found, now or later
    try:
        # deferred: modules in C++, such as pyopencl, abort the process if an import of theirs is broken off
        with interruptible(), deferred():
            command = import_module(module).main
    except KeyboardInterrupt:
        print(f"{program}: interrupted", file=sys.stderr)
        return 130  # ExitCode.INTERRUPTED
    gc.freeze()
    gc.enable()
    try:
        return int(command())
    finally:
        _drop_what_nobody_reads()


def _drop_what_nobody_reads() -> None:
    """Python itself would try to write that once more when it ends, and then make the exit code 120."""
    for stream in filter(None, (sys.stdout, sys.stderr)):
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


if __name__ == "__main__":
    sys.exit(main())

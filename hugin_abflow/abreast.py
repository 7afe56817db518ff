"""Work side by side on one device: each piece in a queue of its own, so that cores which one leaves idle,
between its kernels or on small grids, do what another one has for them.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from hugin_abflow.lane import StoppedError
from hugin_abflow.opencl import Device

T = TypeVar("T")


def side_by_side(device: Device, work: Iterable[Callable[[], T]], lanes: int) -> Generator[T, None, None]:
    """What the pieces give, in their order; so many are worked on at a time, none of which needs another.
    Where that is one, it is done in this thread and its lane.

    Raises what the first one raises that fails. Those that are not done then, or when it is closed, are left,
    or stopped at their next kernel.
    """
    if lanes == 1:
        for piece in work:
            yield piece()
        return
    device.finish()  # each may use what was made before
    stopped, failed = threading.Event(), list[BaseException]()

    def perform(piece: Callable[[], T]) -> T:
        try:
            if stopped.is_set():
                raise StoppedError
            with device.lane(stopped):
                return piece()
        except BaseException as error:
            failed.append(error)
            stopped.set()  # after that: the first is no `StoppedError`
            raise

    threads = ThreadPoolExecutor(lanes, "lane")
    try:
        jobs = [threads.submit(perform, piece) for piece in work]
        while jobs:
            try:
                result = jobs.pop(0).result()
            except StoppedError:
                raise failed[0] from None
            yield result
            del result
    finally:
        stopped.set()
        threads.shutdown(cancel_futures=True)
        failed.clear()  # else what they hold would live on

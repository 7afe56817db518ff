"""Work side by side on one device: each piece in a queue of its own, so that cores which one leaves idle,
between its kernels or on small grids, do what another one has for them.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from hugin_abflow.opencl import Device

T = TypeVar("T")


def side_by_side(device: Device, work: Iterable[Callable[[], T]], lanes: int) -> Generator[T, None, None]:
    """What the pieces give, in their order; so many are worked on at a time, none of which needs another.

    Raises what a piece raises. Those that are not done then, or when it is closed, are left, or stopped at
    their next kernel.
    """
    device.finish()  # each may use what was made before
    stopped = threading.Event()

    def perform(piece: Callable[[], T]) -> T:
        with device.lane(stopped):
            return piece()

    threads = ThreadPoolExecutor(lanes, "lane")
    try:
        jobs = [threads.submit(perform, piece) for piece in work]
        while jobs:
            yield jobs.pop(0).result()
    finally:
        stopped.set()
        threads.shutdown(cancel_futures=True)

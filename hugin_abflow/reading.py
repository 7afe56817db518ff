"""All layers on the working grid. Where cores are more than layers, these are decoded in parts."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from hugin_abflow import memory, working
from hugin_abflow.grid import Grid
from hugin_abflow.layer import Layer
from hugin_abflow.opencl import Device
from hugin_abflow.progress import Progress
from hugin_abflow.settings import Settings
from hugin_abflow.working import Reduction, WorkingLayer

# Parts, for each core, where cores are more than layers: so that all are done at a time.
_PARTS = 4
# The share of the memory that rows being read may take.
_SHARE = 0.25
# How often each row is there: decoded, kept for the next ones, joined with these, on the device.
_COPIES = 4


def read(
    device: Device, layers: Sequence[Layer], grid: Grid, progress: Progress, settings: Settings
) -> list[WorkingLayer]:
    """The layers on the working grid. Their order does not depend on the caller's: by place and size, and by
    what they show where these are the same.

    Raises `ImageReadError` for a layer that cannot be decoded, `DeviceError`.
    """
    lock = threading.Lock()

    def progressed(rows: int) -> None:
        with lock:
            advance(rows)

    places = Counter(layer.box for layer in layers)
    threads = _threads(device, layers, settings)
    decoders = ThreadPoolExecutor(threads, "decoder")
    with progress("read", sum(layer.box.height for layer in layers)) as advance:
        try:
            started = [
                Reduction(device, layer, grid, checked=places[layer.box] > 1)
                for layer in sorted(layers, key=lambda one: -one.box.width * one.box.height)
            ]
            count = -(-_PARTS * threads // len(layers)) if threads > len(layers) else 1
            parts = [one.parts(count) for one in started]
            # the first of all layers, then the second: one thread at a time keeps rows of a layer (spool.py)
            turns = sorted((turn, which) for which, its in enumerate(parts) for turn in range(len(its)))
            jobs = [
                decoders.submit(started[which].read, *parts[which][turn], progressed) for turn, which in turns
            ]
            for job in jobs:
                job.result()
            reduced = [one.result() for one in started]
        finally:
            decoders.shutdown(cancel_futures=True)
        device.give_back()  # it waits: else the last rows' time would be told as that of what follows
    return sorted(reduced, key=_place)


def _threads(device: Device, layers: Sequence[Layer], settings: Settings) -> int:
    """How many decode at a time: as many as there are cores, and memory holds."""
    most = max(one.row_bytes * (working.rows_at_a_time(device, one) + one.strip) for one in layers)
    fitting = int(_SHARE * memory.limit(settings.max_memory)) // (_COPIES * most)
    return max(1, min(settings.cores, fitting))


def _place(layer: WorkingLayer) -> tuple[int, ...]:
    box = layer.layer.box
    return box.top, box.left, box.bottom, box.right, layer.checksum

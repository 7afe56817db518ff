"""Device memory that is free, kept for the next buffer of its size."""

from __future__ import annotations

import threading
from typing import Any

# Bytes, and blocks, that are kept at most.
MOST_BYTES, MOST_BLOCKS = 32 << 20, 64


class Spare:
    """Memory of buffers that are gone, for the next ones of their size: the flow asks for the same few sizes
    thousands of times, and to clear new pages takes as long as to fill them. A lane's queue is in order, so
    what still uses them is done before what comes.
    """

    def __init__(self) -> None:
        self._kept: list[tuple[int, Any]] = []
        self._total = 0
        self._lock = threading.RLock()  # buffers may be collected while it is held

    def take(self, size: int) -> Any | None:
        """Memory of that size, if there is any; what was used last is still in the caches."""
        with self._lock:
            for index in reversed(range(len(self._kept))):
                if self._kept[index][0] == size:
                    self._total -= size
                    return self._kept.pop(index)[1]
        return None

    def keep(self, size: int, data: Any) -> None:
        """Keep memory, up to a bound; the oldest goes first."""
        if size > MOST_BYTES // 4:
            return
        with self._lock:
            self._kept.append((size, data))
            self._total += size
            while self._total > MOST_BYTES or len(self._kept) > MOST_BLOCKS:
                self._total -= self._kept.pop(0)[0]

    def release(self) -> None:
        """Keep none."""
        with self._lock:
            self._kept.clear()
            self._total = 0

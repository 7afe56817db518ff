"""How long steps report progress: any callable of this shape will do.

``progress(phase, total)`` opens a phase of ``total`` units and is a context manager; what it yields
is called with the number of units done since the last call.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

Advance = Callable[[int], None]
Progress = Callable[[str, int], AbstractContextManager[Advance]]


@contextmanager
def silent(phase: str, total: int) -> Iterator[Advance]:
    """Report nothing: the library's default."""
    yield lambda units: None

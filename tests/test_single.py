"""What is taken from one photo: of both kinds, and of all pairs."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from hugin_abflow import foreground, movers, single
from hugin_abflow.cells import SingleSource


@pytest.mark.parametrize("movers_too", [False, True])
@pytest.mark.parametrize("foreground_too", [False, True])
def test_both_kinds_are_taken_whole(
    monkeypatch: pytest.MonkeyPatch, movers_too: bool, foreground_too: bool
) -> None:
    rng = np.random.default_rng(1)
    one, other = (SingleSource(rng.random((9, 9)) < 0.3, rng.random((9, 9)) < 0.3) for _ in range(2))
    monkeypatch.setattr(movers, "find", lambda *given: one if given == (1, 2, 3, 4, 5) else None)
    monkeypatch.setattr(foreground, "find", lambda *given: other if given == (1, 2, 3, 4) else None)
    found = single.find(1, 2, 3, 4, 5, SimpleNamespace(movers=movers_too, foreground=foreground_too))
    wanted = [its for its, on in ((one, movers_too), (other, foreground_too)) if on]
    assert (found is None) == (not wanted)
    for name in ("first", "second") if wanted else ():
        assert np.array_equal(getattr(found, name), np.any([getattr(its, name) for its in wanted], 0))


def test_places_of_all_pairs_count() -> None:
    """Each on the chart of its own pair; pairs in which there is nothing have none."""
    cells = np.random.default_rng(1).random((3, 60, 120)) < 0.1
    found = [SimpleNamespace(on_canvas=lambda chart, _: cells[chart]) for _ in range(2)]
    on_canvas = partial(single.on_canvas, cells=None)
    assert np.array_equal(on_canvas([None, *found], [0, 1, 2]), cells[1] | cells[2])
    assert on_canvas([None] * 3, [0, 1, 2]) is None and on_canvas([], []) is None

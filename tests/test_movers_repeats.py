"""What repeats and stands still is no mover, though flow takes it for the next one: scenes of scenes.py."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from rooms import Thing
from scenes import UP, Scene, scene

Array = np.ndarray
AHEAD = (0.0, 1.0, 0.0)


def bars() -> tuple[Scene, tuple[Array, Array]]:
    """Something near of bars that are 10 px apart, and the flow that takes each for the second next one."""
    one = scene(Thing(AHEAD, 0 * UP, 0.2, 1.1))
    columns = np.mgrid[: one.chart.height, : one.chart.width][1]
    places = columns, columns + one.flows[1][..., 0]  # in the first photo
    views, other = [], []
    for view, shown, place, flow in zip(one.views, one.shown[0], places, one.flows, strict=True):
        image = np.where(shown, np.sin(2 * np.pi * place / 10), view.image)
        views.append(replace(view, image=image.astype(np.float32)))
        other.append(flow.copy())
        other[-1][shown, 0] -= 20 * np.sign(flow[shown, 0].mean())
    return replace(one, views=tuple(views)), tuple(other)


def lost(one: Scene) -> Scene:
    """A scene whose flow does not lead back from the first thing, as if one photo showed it nearer."""
    flows = one.flows[0].copy(), one.flows[1]
    shown = one.shown[0][0]
    flows[0][shown, 0] += 5 * np.sign(flows[0][shown, 0])
    found = replace(one, flows=flows)
    assert found.found() is None
    return found


def test_bars_that_stand_still_are_none_though_refused_flow_takes_them_for_others() -> None:
    """It fits them as well, and leads elsewhere than parallax; but the flow that is used has them right. It
    shows somebody where that follows what is behind him, or does not lead back."""
    one, other = bars()
    assert one.found() is None
    assert one.found(refused=other) is None
    behind = replace(one, flows=scene().flows)
    assert behind.found() is None
    assert behind.found(refused=other) is not None
    assert lost(one).found(refused=other) is not None


def test_refused_flow_has_to_fit() -> None:
    """Better than what is around does, however little the flow that is used tells of the place."""
    one, he = (scene(Thing(AHEAD, step, 0.2, 1.1)) for step in (0 * UP, UP))
    assert lost(one).found(refused=he.flows) is None
    assert lost(replace(one, views=he.views)).found(refused=he.flows) is not None


def test_flow_that_hardly_leads_back_shows_nobody() -> None:
    """Where nothing is matched, as bars of a railing with the next ones in one direction alone, it leads
    anywhere; from a fifth of what both photos show of somebody it leads back."""
    one = scene(Thing(AHEAD, UP, 0.15))
    for part, expected in ((4, True), (12, False)):
        back, astray = one.flows[1].copy(), one.shown[0][1].copy()
        rows = np.flatnonzero(astray.any(1))
        astray[: rows[0] + len(rows) // part] = False
        back[astray, 1] *= 1.5
        assert (replace(one, flows=(one.flows[0], back)).found() is not None) == expected

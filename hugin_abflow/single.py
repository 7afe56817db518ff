"""What is taken from one photo of a pair, whole, though flow matches it: what moved by itself (movers.py),
and what is so near that it would be bent (foreground.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from operator import or_

import numpy as np

from hugin_abflow import foreground, movers
from hugin_abflow.cells import Flows, Mask, Places, SingleSource, View
from hugin_abflow.chart import Chart
from hugin_abflow.decision import Refused
from hugin_abflow.grid import Grid
from hugin_abflow.settings import Settings


def find(
    chart: Chart,
    flows: Flows,
    views: tuple[View, View],
    control_points: tuple[Places, Places],
    refused: Sequence[Refused],
    settings: Settings,
) -> SingleSource | None:
    """All of it in one pair; None: nothing. The arguments are those of `movers.find`."""
    found = []
    if settings.movers:
        found.append(movers.find(chart, flows, views, control_points, refused))
    if settings.foreground:
        found.append(foreground.find(chart, flows, views, control_points))
    some = [one for one in found if one]
    return reduce(or_, some) if some else None


def on_canvas(found: Sequence[SingleSource | None], charts: Sequence[Chart], cells: Grid) -> Mask | None:
    """Where it is of any pair, on a grid over the canvas; None: nowhere."""
    places = [one.on_canvas(chart, cells) for one, chart in zip(found, charts, strict=True) if one]
    return np.logical_or.reduce(places) if places else None

"""What --flow-quality means: how much work the flow is worth.

Told as changes of the solver's own defaults, which are those of "normal". The working canvas that belongs to
each is in settings.py: a coarser one saves more time for less loss than fewer steps do, and a finer one gains
where more steps gain nothing.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from hugin_abflow import flow
from hugin_abflow.settings import FlowQuality, LargeMotion

_CHANGES: dict[FlowQuality, dict[str, Any]] = {
    # small overlaps cost by steps, not by pixels
    "fast": {"warps": (1, 3)},
    "normal": {},
    "best": {},
}

# Flow is solved on every second pixel of a working canvas, in x and y, if that leaves so many: it is smoother
# than pictures are, but for thin things.
_LEAST_PIXELS: dict[FlowQuality, float] = {"fast": 100_000, "normal": 400_000, "best": math.inf}
# Large motion is decided on the first level on which a canvas has no more pixels, but never the finest: finer
# levels show more that looks alike.
_DECIDED_PIXELS = 400_000


def coarseness(quality: FlowQuality, pixels: int) -> int:
    """Pixels of a working canvas of `pixels` per pixel of the charts on which flow is solved."""
    return 2 if pixels >= 4 * _LEAST_PIXELS[quality] else 1


def flow_parameters(quality: FlowQuality, large_motion: LargeMotion, pixels: float) -> flow.FlowParameters:
    """The solver's parameters for `Settings.flow_quality` and `Settings.large_motion`.

    pixels: of a canvas that is as fine as the charts.
    """
    parameters = replace(flow.FlowParameters(), **_CHANGES[quality])
    level = max(parameters.decide_on, math.ceil(math.log(pixels / _DECIDED_PIXELS, 4)))
    search = replace(parameters.search, always=large_motion == "on")
    return replace(parameters, search=search, decide_on=level, choose_from=level)

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

# Flow is found on every second pixel of a working canvas, in x and y, if that leaves so many: it is smoother
# than pictures are, but for thin things.
_LEAST_PIXELS: dict[FlowQuality, float] = {"fast": 100_000, "normal": 400_000, "best": 400_000}
# And then it is refined on all of them, if all overlaps' charts have at most this share of the canvas's.
_REFINED: dict[FlowQuality, float] = {"fast": 0.0, "normal": 0.5, "best": math.inf}


def coarseness(quality: FlowQuality, pixels: int) -> int:
    """Pixels of a working canvas of `pixels` per pixel of the charts on which flow is found."""
    return 2 if pixels >= 4 * _LEAST_PIXELS[quality] else 1


def refined(quality: FlowQuality, pixels: int, charts: int) -> bool:
    """Whether flow is refined on all pixels of a working canvas of `pixels`.

    charts: the pixels that this is about, those of charts twice as fine as those on which it was found.
    """
    return 0 < charts <= _REFINED[quality] * pixels


def flow_parameters(quality: FlowQuality, large_motion: LargeMotion) -> flow.FlowParameters:
    """The solver's parameters for `Settings.flow_quality` and `Settings.large_motion`."""
    parameters = replace(flow.FlowParameters(), **_CHANGES[quality])
    return replace(parameters, search=replace(parameters.search, always=large_motion == "on"))

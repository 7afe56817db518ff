"""What --flow-quality means: how much work the flow is worth.

Told as changes of the solver's own defaults, which are those of "normal". The working canvas that belongs to
each is in settings.py: a coarser one saves more time for less loss than fewer steps do, and a finer one gains
where more steps gain nothing.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from hugin_abflow import flow
from hugin_abflow.settings import FlowQuality

_CHANGES: dict[FlowQuality, dict[str, Any]] = {
    # small overlaps cost by steps, not by pixels
    "fast": {"warps": (1, 3)},
    "normal": {},
    "best": {},
}


def flow_parameters(quality: FlowQuality) -> flow.FlowParameters:
    """The solver's parameters for a setting of `Settings.flow_quality`."""
    return replace(flow.FlowParameters(), **_CHANGES[quality])

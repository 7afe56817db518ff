"""Layers brought together: what is compared, corrected and cut."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from hugin_abflow.coefficient import Masks
from hugin_abflow.geometry import Pair
from hugin_abflow.grid import Grid
from hugin_abflow.opencl import Buffer, Device
from hugin_abflow.working import WorkingLayer


@dataclass(frozen=True)
class Scene:
    """Layers on the working grid, aligned by fields.

    pairs       of layers that overlap.
    fields      where each layer is sampled, and its colour weight (geometry.py); steps change them in place.
    """

    device: Device
    layers: Sequence[WorkingLayer]
    pairs: Sequence[Pair]
    fields: Sequence[Buffer]
    masks: Masks
    grid: Grid

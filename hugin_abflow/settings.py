"""The engine's settings: each with its default, unit and range."""

from __future__ import annotations

import os
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Literal, get_args

from hugin_abflow.errors import SettingsError

MergeMode = Literal["joint", "sequential"]
Interpolation = Literal["bicubic", "nearest"]
FlowQuality = Literal["fast", "normal", "best"]
LargeMotion = Literal["auto", "on", "off"]

_WORKING_PIXELS: dict[FlowQuality, int] = {"fast": 500_000, "normal": 2_100_000, "best": 6_300_000}
# Of `Settings.working_pixels`, at least.
_LEAST_WORKING_PIXELS = 1024
# The same, at most: kernels count the 22 floats that a board (kernels/common.cl) has of each pixel of a chart
# in 32 bits, and its rows are some hundredths longer than the chart's.
MOST_WORKING_PIXELS = 90_000_000
MOST_MEMORY = 1 << 50  # of `Settings.max_memory`


@dataclass(frozen=True)
class Settings:
    """Frozen set of engine settings. Raises `SettingsError` for a value out of range or of a wrong type.

    merge               "joint": all layers at once; "sequential": the paper's iteration, two at a time.
    softmax_sharpness   kSoftmaxSharpness of the paper (Code 1); 0..1000, no unit.
    flow_magnitude      kFlowMagCoef of the paper (Code 1); 0..10000, no unit.
    flow                bring the layers together by optical flow; else they stay where they are, and every
                        overlap is cut along the seam that shows least.
    flow_quality        how much time the flow may take: "fast", "normal" or "best".
    large_motion        search for motion of up to a tenth of the canvas's width, and half of the root of the
                        overlap's area, for very near things:
                        "auto" keeps what makes at least a quarter of an overlap clearly more alike, both
                        ways, or what moves as things do that stand still when the camera moves; "on" all
                        that is found; what repeats (grids, tiles) and who walks may mislead it. "off":
                        no search.
    exposure            match exposure and colour of the layers where they overlap, spread it smoothly, and
                        blend low frequencies widely.
    highlights          take what one layer shows clipped from another that does not.
    seam                take from one layer, whole, what flow cannot explain (people who moved, occlusions).
    clones              with it, show somebody once whom two layers show at two places, if that cuts nobody.
    movers              with it, take so, too, what flow matches although it moved by itself, where flow tells
                        how the camera moved.
    foreground          and near things that would be bent, where one layer shows all of them.
    relay               where flow of a pair of layers contradicts that of others, or is not sure where theirs
                        is, take theirs, by way of a third layer; and do not find it where they share little
                        that others show in much larger overlaps.
    transition_strain   by how much changing over from one layer's geometry to the next may stretch it, where
                        the overlap is wide enough; transitions go round what shifts by much. 0..1, 0:
                        nothing is looked for, and they take the whole overlap, as published.
    guides              let control points lead the flow where it goes astray.
    interpolation       how layers are sampled; "nearest" is for comparison with the paper's own code.
    working_pixels      upper bound of the pixels of the working canvas (flow, coefficients, colour), 1024
                        to 90 million; 0: chosen by flow_quality.
    intermediate        where layer k is sampled is told by the flows that pass through p on their way from
                        one layer to the other, and kept within the canvas; else by F_jk, which starts at p,
                        as published.
    band_rows           rows of a full-resolution band; 0: chosen from the canvas width and `max_memory`.
    max_memory          bytes that host and device may take together; 0: half of the machine's memory. It
                        changes no pixel.
    threads             processor cores that are used at a time; 0: all. It changes no pixel. PoCL keeps to
                        the first number that it is opened with in a process.
    device              index in ``--list-devices`` or part of a device's name; None: the fastest GPU,
                        else CPU.
    """

    merge: MergeMode = "joint"
    softmax_sharpness: float = 10.0
    flow_magnitude: float = 100.0
    flow: bool = True
    flow_quality: FlowQuality = "normal"
    large_motion: LargeMotion = "auto"
    exposure: bool = True
    highlights: bool = True
    seam: bool = True
    clones: bool = True
    movers: bool = True
    foreground: bool = True
    relay: bool = True
    transition_strain: float = 0.07
    guides: bool = True
    interpolation: Interpolation = "bicubic"
    working_pixels: int = 0
    intermediate: bool = True
    band_rows: int = 0
    max_memory: int = 0
    threads: int = 0
    device: str | None = None

    def __post_init__(self) -> None:
        for name, low, high in (
            ("softmax_sharpness", 0, 1000),
            ("flow_magnitude", 0, 10_000),
            ("working_pixels", _LEAST_WORKING_PIXELS if self.working_pixels else 0, MOST_WORKING_PIXELS),
            ("transition_strain", 0, 1),
            ("band_rows", 0, 1 << 20),
            ("max_memory", 0, MOST_MEMORY),
            ("threads", 0, 1024),
        ):
            value = getattr(self, name)
            whole = type(getattr(type(self), name)) is int
            fits: bool = isinstance(value, Integral if whole else Real) and not isinstance(value, bool)
            if not fits:
                kind = "whole number" if whole else "number"
                raise SettingsError(f"{name} is {value!r}; choose a {kind} from {low} to {high}")
            if not low <= value <= high:  # NaN neither
                raise SettingsError(f"{name} is {value}; choose a value from {low} to {high}")
            # else kernels would read the bits of an integer as a float
            object.__setattr__(self, name, int(value) if whole else float(value))
        for name, kinds in (
            ("merge", MergeMode),
            ("interpolation", Interpolation),
            ("flow_quality", FlowQuality),
            ("large_motion", LargeMotion),
        ):
            value, choices = getattr(self, name), get_args(kinds)
            if not isinstance(value, str) or value not in choices:
                expected = " or ".join(map(repr, choices))
                raise SettingsError(f"{name} is {value!r}; choose {expected}")
        for name in (
            "flow", "exposure", "highlights", "seam", "clones", "movers", "foreground", "relay", "guides",
            "intermediate",
        ):  # fmt: skip
            if not isinstance(getattr(self, name), bool):
                raise SettingsError(f"{name} is {getattr(self, name)!r}; choose True or False")
        if self.device is not None and not isinstance(self.device, str):
            raise SettingsError(
                f"device is {self.device!r}; choose an index or a part of a name, as text, or None"
            )

    @property
    def cores(self) -> int:
        """`threads`, or all of the machine's cores."""
        return self.threads or os.cpu_count() or 1

    @property
    def working_limit(self) -> int:
        """`working_pixels`, or what `flow_quality` chooses."""
        return self.working_pixels or _WORKING_PIXELS[self.flow_quality]

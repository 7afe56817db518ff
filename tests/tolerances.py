"""How far a kernel may be from its twin, named once.

Kernels calculate in float32, and PoCL contracts a * b + c to one rounding (FMA), other devices do not; twins
calculate in float64. So they never agree to the bit, except where results are integers or copies.
"""

from __future__ import annotations

import numpy as np

# Sums of up to a hundred products of numbers around 1: some ten float32 roundings of 6e-8.
SUM = 2e-6
# The same after sin, cos, atan2, exp or log, which OpenCL allows 4 to 6 ulp each.
TRIGONOMETRY = 2e-5
# Positions in pixels after trigonometry: angles of up to pi (rounded to 2e-7) times pixels per radian.
POSITION = 1e-4
# Share of pixels where a decision (a mask's threshold, a whole pixel) may fall the other way by rounding.
DECISIONS = 1e-3


def assert_close(
    kernel: np.ndarray, twin: np.ndarray, tolerance: float, decisions: float = 0.0, scale: float = 1.0
) -> None:
    """Kernel and twin agree within tolerance x max(scale, |twin|), but for a share of pixels."""
    assert kernel.shape == twin.shape
    assert np.isfinite(kernel).all() and np.isfinite(twin).all()
    off = np.abs(kernel.astype(np.float64) - twin) > tolerance * np.maximum(scale, np.abs(twin))
    wrong = np.argwhere(off)
    assert off.mean() <= decisions, (
        f"{len(wrong)} of {off.size} differ, first at {wrong[0]}: "
        f"{kernel[tuple(wrong[0])]} is not {twin[tuple(wrong[0])]}"
    )

"""The twins of what measures exposure, against exposures that are known."""

from __future__ import annotations

import numpy as np
import pytest
from grids import plane
from reference import common
from reference.colour import colour_difference, colour_misfit
from test_colour import NEVER, SPREAD, share, smooth_layer


@pytest.mark.parametrize("shoulder", [1.0, 0.75, 0.5, 0.25])
def test_twin_of_misfit_knows_the_scale(shoulder: float) -> None:
    """Layers that differ by one gain on a scale: on that one nothing is left, on others it is."""
    grid = plane()
    a = smooth_layer(20, 77, 53).astype(np.float64)
    a[..., :3] = 0.1 + 0.5 * a[..., :3]
    b = a.copy()
    b[..., :3] = common.exposure_shift(a[..., :3], np.array([0.4, 0.2, 0.3]), shoulder)
    still, box, shoulders = np.zeros_like(a), (0, 0, 77, 53), (1.0, 0.75, 0.5, 0.25)
    sides = [a, still, box, b, still, box]
    misfit = colour_misfit(*sides, grid.border, grid.lonlat, (7, 3, 0, 0), shoulders, *NEVER).sum((0, 1))
    right = shoulders.index(shoulder)
    assert misfit[right] < 1e-9
    assert (np.delete(misfit, right) > 1e-4).all()


@pytest.mark.parametrize("shoulder", [0.0, 0.5, 1.0])
def test_twin_of_difference_measures_a_gain(shoulder: float) -> None:
    """Layers that differ by a shift: that shift less what the floor hides, trusted by what pixels tell."""
    grid = plane()
    a = smooth_layer(20, 77, 53).astype(np.float64)
    gains = np.array([0.3, -0.1, 0.2])
    b, middle = a.copy(), a.copy()
    b[..., :3] = common.exposure_shift(a[..., :3], -gains, shoulder)
    middle[..., :3] = common.exposure_shift(a[..., :3], -gains / 2, shoulder)
    still = np.zeros_like(a)
    box = (0, 0, 77, 53)
    result, *_ = colour_difference(
        a, still, box, b, still, box, grid.border, grid.lonlat, (7, 3, 0, 0), shoulder, *NEVER, SPREAD
    )
    known = result[..., 3] > 0
    assert known.mean() > 0.8
    for j, i in np.argwhere(known):
        cell = np.s_[j * 53 // 3 : (j + 1) * 53 // 3 : 2, i * 11 : (i + 1) * 11 : 2]
        used = a[cell][..., 3] > 0
        brightest = np.minimum(a[cell][used][:, :3].max(1), b[cell][used][:, :3].max(1))
        told = np.clip((brightest - 0.05) / 0.25, 0, 1) if shoulder else np.ones(len(brightest))
        shown = np.average(share(middle[cell][used][:, :3], shoulder), 0, told)
        assert (shown > 0.8).all()
        # the slope in the middle of the way stands for all of it: good to the third order of the gain
        assert np.allclose(result[j, i, :3], shown * gains, atol=2e-3)
        assert result[j, i, 3] == pytest.approx(told.sum() / used.size, abs=0.1)

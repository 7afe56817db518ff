"""Label problems of regions.py, at random, and what a labelling costs."""

from __future__ import annotations

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from scipy import ndimage

from hugin_abflow import regions

# Price of a cut, in cells.
CUT = 10.0


def label(rows, columns, residual, shares, cover, wraps, whole_factor=None, clipping=None) -> np.ndarray:
    """The layers of a region's cells, with cuts of that price."""
    shape = residual.mean.shape
    more = None if whole_factor is None else np.full(shape, whole_factor)
    whole = np.zeros(shape, bool)
    whole[rows, columns] = True
    return regions.Choice(whole, residual, shares, cover, wraps, CUT, more, clipping).label(rows, columns)[0]


def energies(labels, rows, columns, residual, shares, cover, wraps) -> np.ndarray:
    """The sum in regions.py for each of the labellings (n, cells), cell by cell."""
    height, width = residual.mean.shape
    number = {(y, x): k for k, (y, x) in enumerate(zip(rows.tolist(), columns.tolist(), strict=True))}
    total = np.zeros(len(labels))
    for (y, x), k in number.items():
        chosen = labels[:, k]
        r, t = residual.mean[y, x], residual.rms[y, x]
        total += np.where(cover[chosen, y, x], r * (1 - shares[chosen, y, x]), regions._FORBIDDEN)
        for down, right in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            v, u = y + down, x + right
            if not 0 <= v < height or not (wraps or 0 <= u < width):
                continue
            u %= width
            total += CUT * t * (cover[:, v, u].any() & ~cover[chosen, v, u])
            if (v, u) in number and down + right > 0:
                pair = CUT * (t + residual.rms[v, u]) / 2
                total += pair * (chosen != labels[:, number[v, u]])
    return total


def favoured(labels, rows, columns, residual, shares, cover, wraps) -> np.ndarray:
    """What of it is not seen: that the softmax favours other layers."""
    return (residual.mean[rows, columns] * (1 - shares[labels, rows, columns])).sum(1)


def cuts_of(labels, rows, columns, residual, shares, cover, wraps) -> float:
    """The mean residual along the cuts of a labelling; 0 without any."""
    grid = np.full(residual.rms.shape, -1)
    grid[rows, columns] = labels
    found = []
    for axis in (0, 1):
        beside, rms = (np.roll(one, -1, axis) for one in (grid, residual.rms))
        cut = (grid >= 0) & (beside >= 0) & (grid != beside)
        if axis == 0 or not wraps:
            cut[(-1, slice(None)) if axis == 0 else (slice(None), -1)] = False
        found.append(((residual.rms + rms) / 2)[cut])
    found = np.concatenate(found)
    return float(found.mean()) if found.size else 0.0


@st.composite
def problems(draw, layers: int, most: int):
    """A connected region of at most `most` cells on a small grid; each is covered by one layer at least."""
    height, width = draw(st.integers(1, 5)), draw(st.integers(1, 5))
    wraps = draw(st.booleans())
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    region = np.zeros((height, width), bool)
    region[random.integers(height), random.integers(width)] = True
    for _ in range(draw(st.integers(1, most)) - 1):
        beside = np.pad(region, ((0, 0), (1, 1)), "wrap" if wraps else "constant")
        beside = ndimage.binary_dilation(beside)[:, 1:-1] & ~region
        if beside.any():
            region.flat[random.choice(np.flatnonzero(beside))] = True
    # from all alike to a few cells that count for all
    low, rough = random.random((2, height, width)) ** draw(st.sampled_from([0.1, 1, 4]))
    scale = draw(st.sampled_from([0.5, 3]))
    residual = regions.Residuals(scale * low, scale * rough)
    shares = random.random((layers, height, width)) ** draw(st.sampled_from([0.2, 1, 20]))
    shares /= np.maximum(shares.sum(0), 1e-9)
    cover = random.random((layers, height, width)) < draw(st.sampled_from([0.4, 0.8, 1]))
    cover[random.integers(layers), region & ~cover.any(0)] = True
    rows, columns = np.nonzero(region)
    return rows, columns, residual, shares, cover, wraps


many = settings(max_examples=150)


def alike(residual: np.ndarray) -> regions.Residuals:
    """Layers that differ by low frequencies alone."""
    return regions.Residuals(residual, residual)

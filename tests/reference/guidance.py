"""Twins of kernels/guidance.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import Array, bilinear, pixels
from reference.flow import beside, flow_warp

MOST_COST = 0.5


def share_of(near: Array) -> Array:
    """How much of the flow is the guides': all within 1.2 sigma, nothing beyond 4."""
    return np.clip(2 * near.astype(np.float64) - 1e-3, 0, 1)


def guidance_start(
    flow: Array, grid: Sequence[int], guides: Array, sigmas: Array, scale: float, size: Sequence[int]
) -> tuple[Array, Array]:
    """Start (height, width, 2), px of the level, and nearness (height, width)."""
    x, y = pixels(size[0], size[1])
    x, y = scale * (x + 0.5), scale * (y + 0.5)
    # the last pixels of a coarse level may lie beyond the chart
    total, taps = bilinear(
        flow, grid, x if grid[2] else np.minimum(x, grid[0] - 0.5), np.minimum(y, grid[1] - 0.5)
    )
    across = x[..., None] - guides[:, 0]
    if grid[2]:
        across = (across + grid[0] / 2) % grid[0] - grid[0] / 2
    distance = np.hypot(across, y[..., None] - guides[:, 1])
    weights = np.exp(-0.5 * (distance / sigmas) ** 2)
    near = weights.max(-1)
    mean = weights @ guides[:, 2:] / np.maximum(weights.sum(-1), 1e-300)[..., None]
    return (total / taps[..., None] + share_of(near)[..., None] * mean) / scale, near


def guidance_pull(
    start: Array, near: Array, strength: float, left_side: Array, right_side: Array
) -> tuple[Array, Array]:
    """The system of flow_system and k/2 |flow - start|^2: k on the diagonal, k start on the right."""
    k = strength * share_of(near)
    left, right = left_side.astype(np.float64), right_side.astype(np.float64)
    left[..., 0] += k
    left[..., 2] += k
    right[..., :2] += k[..., None] * start
    return left, right


def guidance_bring(feature: Array, flow: Array, grid: Sequence[int]) -> Array:
    """The feature at q + flow(q), as for the flow itself."""
    return flow_warp(feature, flow, grid)


def cost(a: Array, b: Array) -> Array:
    """How badly a feature fits another."""
    off = np.abs(a.astype(np.float64) - b)
    return np.minimum(off[..., 0] + 2 * off[..., 1] + 2 * off[..., 2], MOST_COST)


def guidance_vote(
    feature: Array,
    old: Array,
    new: Array,
    near: Array,
    grid: Sequence[int],
    evidence: float,
    trust: float,
    contrast: float,
) -> tuple[Array, Array]:
    """The system whose solution is -1 where the old flow is better, 1 where the new one is."""
    seen = feature[..., 3] * old[..., 3] * new[..., 3] > 0
    gain = np.where(seen, evidence * (cost(feature, old) - cost(feature, new)), 0.0)
    seed = trust * near.astype(np.float64) ** 16
    far = 1 - share_of(near)
    links = []
    for dx, dy in ((1, 0), (0, 1)):
        there, exists = beside(feature, grid, dx, dy)
        both = feature[..., 3] * there[..., 3] > 0
        likeness = np.exp(-np.abs(feature[..., 0].astype(np.float64) - there[..., 0]) / contrast)
        links.append(np.where(exists, np.where(both, likeness, 1.0), 0.0))
    zero = np.zeros_like(gain)
    return (
        np.stack([np.abs(gain) + seed + far, zero, zero, links[0]], -1),
        np.stack([gain + seed - far, zero, links[1], zero], -1),
    )


def guidance_choose(vote: Array, new: Array, flow: Array) -> Array:
    """The new flow where the vote is for it."""
    return np.where(vote[..., :1] > 0, new, flow)


def guidance_blend(refined: Array, near: Array, flow: Array) -> Array:
    """The refined flow around guides, fading to the old one where their share falls below a tenth."""
    weight = np.minimum(10 * share_of(near), 1)[..., None]
    return (1 - weight) * flow.astype(np.float64) + weight * refined

"""Twins of kernels/hidden.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reference.common import Array


def hidden_mark(fields: Sequence[Array], boxes: Sequence[Sequence[int]], share: float) -> list[Array]:
    """Fields on parts of a grid; weights below a share of their sum turn negative, or are."""
    width, height = (max(box[i] + box[i + 2] for box in boxes) for i in (0, 1))
    places = [np.s_[top : top + rows, left : left + columns] for left, top, columns, rows in boxes]
    total = np.zeros((height, width))
    for field, place in zip(fields, places, strict=True):
        total[place] += np.maximum(field[..., 3], 0)
    hidden = [field.copy() for field in fields]
    for field, place in zip(hidden, places, strict=True):
        least, w = share * total[place], field[..., 3]
        field[..., 3] -= np.where(w > least, least**2 / np.where(w > least, w, 1), least)
    return hidden

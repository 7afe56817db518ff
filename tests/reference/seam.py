"""Twins of kernels/seam.cl."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from reference.common import (
    Array,
    Numbers,
    bilinear,
    canvas_point,
    canvas_position,
    cell_parts,
    exposure_shift,
    gains_at,
    layer_look,
    layer_seen,
    on_box,
    pixels,
)


def seam_difference(
    layer_a: Array,
    field_a: Array,
    box_a: Sequence[int],
    gain_a: Array,
    layer_b: Array,
    field_b: Array,
    box_b: Sequence[int],
    gain_b: Array,
    border: Sequence[int],
    lonlat: Numbers,
    colours: Sequence[int],
    cells: Sequence[int],
    shoulder: float,
    clipped_a: Numbers,
    clipped_b: Numbers,
    darker: float,
) -> tuple[Array, Array, Array]:
    """Mean corrected difference a - b of every cell's pixels, every other one in x and y, with their share,
    the largest channel's mean square, and, means of the channels', the variances of a and b, those of the
    means of blocks of four, their covariance, and zeros; samples brighter than `clipped` of their layer are
    left out, but where the other's are `darker` than what has that brightness."""
    sides = (layer_a, field_a, box_a, gain_a), (layer_b, field_b, box_b, gain_b)
    seen, looks = zip(
        *(layer_look(*side, border, lonlat, colours, cells, shoulder) for side in sides), strict=True
    )
    usable = (seen[0][..., 3] > 0) & (seen[1][..., 3] > 0)
    gains = [gains_at(gain, border, colours, cells) for gain in (gain_a, gain_b)]
    for first, clipped in enumerate((clipped_a, clipped_b)):
        brighter = gains[first] - gains[1 - first]
        ratio = exposure_shift(np.full_like(brighter, 0.5), brighter, shoulder) / 0.5
        limit = np.float32(clipped)[:3]
        other = seen[1 - first][..., :3] < np.minimum(ratio, 1) * limit - darker
        usable &= ((seen[first][..., :3] <= limit) | other).all(-1)
    result, square, texture = (np.zeros((cells[1], cells[0], *n)) for n in ((4,), (), (8,)))
    for place, part in cell_parts(border, cells, 2):
        values = (looks[0] - looks[1])[part][usable[part]]
        if len(values):
            result[place] = [*values.mean(0), len(values) / usable[part].size]
            square[place] = (values**2).mean(0).max()
            shown = [look[part][usable[part]] for look in looks]
            blocks = [np.array(list(block_means(look[part], usable[part]))) for look in looks]
            a, b = (one - one.mean(0) for one in blocks)
            spread = [one.var(0).mean() for one in (*shown, *blocks)]
            texture[place] = [*spread, (a * b).mean(), 0, 0, 0]
    return result, square, texture


def block_means(values: Array, usable: Array) -> Iterator[Array]:
    """Of 2 x 2 places, in turn, the means of those that are usable, if any is."""
    for y in range(0, values.shape[0], 2):
        for x in range(0, values.shape[1], 2):
            some = usable[y : y + 2, x : x + 2]
            if some.any():
                yield values[y : y + 2, x : x + 2][some].mean(0)


def seam_yield(
    field: Array,
    box: Sequence[int],
    border: Sequence[int],
    yields: Array,
    same: Array,
    cells: Sequence[int],
    trace: float,
) -> Array:
    """The field (height, width, 4) with the weight of a layer that yields, all but a trace, and before that
    weighs like all others where they are the `same`; both are on the cells."""
    columns, rows = pixels(box[2], box[3], box[0], box[1])
    x, y = (columns + 0.5) * cells[0] / border[0], (rows + 0.5) * cells[1] / border[1]
    (given, share), (alike, _) = (bilinear(one, cells, x, y) for one in (yields, same))
    result = field.astype(np.float64)
    weighs = result[..., 3] > 0
    result[weighs, 3] **= (1 - alike / share)[weighs]
    result[..., 3] *= np.maximum((1 - given / share) ** 4, trace)
    return result


def seam_weights(field: Array, box: Sequence[int], rows: Array, columns: Array) -> Array:
    """A layer's colour weight in rows and columns of the working grid; 0 where it is not."""
    weights = np.zeros((max(box[1] + box[3], rows.max() + 1), max(box[0] + box[2], columns.max() + 1)))
    weights[box[1] :, box[0] :][: box[3], : box[2]] = field[..., 3]
    return weights[np.ix_(rows, columns)]


BEYOND = 0.5


def seam_shown(
    layer: Array,
    field: Array,
    box: Sequence[int],
    border: Sequence[int],
    lonlat: Numbers,
    cells: Sequence[int],
) -> Array:
    """The cells (height, width) of which every second pixel that the layer covers is sampled where it shows
    something, but for half a pixel."""
    columns, rows = pixels(box[2], box[3], box[0], box[1])
    points = canvas_point(columns + 0.5, rows + 0.5, lonlat) + field[..., :3]
    x, y = canvas_position(points, lonlat)
    around = 2 * np.pi / lonlat[1] if lonlat[1] else np.inf
    across = x - columns - 0.5
    across -= np.rint(across / around) * around if lonlat[1] else 0
    length = np.hypot(across, y - rows - 0.5)
    part = np.maximum(1 - BEYOND / np.maximum(length, 1e-9), 0)[..., None]
    shorter = np.concatenate([part * field[..., :3], field[..., 3:]], -1).astype(np.float32)
    ends = (layer[..., 3] > 0) & (layer_seen(layer, shorter, box, columns, rows, border, lonlat)[..., 3] == 0)
    beyond = np.zeros((border[1], border[0]), bool)
    beyond[on_box(box)] = ends
    result = np.ones((cells[1], cells[0]), bool)
    for place, its in cell_parts(border, cells, 2):
        result[place] = not beyond[its].any()
    return result


def seam_clamp(
    layer: Array,
    field: Array,
    box: Sequence[int],
    border: Sequence[int],
    lonlat: Numbers,
    taken: Array,
    cells: Sequence[int],
) -> Array:
    """The field, in the cells that are taken, with displacements that end, found by five halvings, where the
    layer shows something."""
    columns, rows = pixels(box[2], box[3], box[0], box[1])
    x, y = columns + 0.5, rows + 0.5
    its = taken[
        np.minimum(np.floor(y * cells[1] / border[1]).astype(int), cells[1] - 1),
        np.minimum(np.floor(x * cells[0] / border[0]).astype(int), cells[0] - 1),
    ]
    its = (its > 0) & (layer[..., 3] > 0)
    result = field.astype(np.float64)

    def shown(part: Array) -> Array:
        there = np.concatenate([part[..., None] * result[..., :3], result[..., 3:]], -1).astype(np.float32)
        return layer_seen(layer, there, box, columns, rows, border, lonlat)[..., 3] > 0

    part = np.ones(its.shape)
    short = its & ~shown(part)
    part[short] = 0
    for n in range(1, 6):
        part += 0.5**n * (short & shown(part + 0.5**n))
    result[..., :3] *= part[..., None]
    return result

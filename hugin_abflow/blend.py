"""The full-resolution pass: band by band, every layer sampled once, softmax-weighted (kernels/blend.cl).

Rows of the next band are decoded, several layers at a time, while the device calculates this one.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from hugin_abflow import hidden, memory
from hugin_abflow.content import Unlike
from hugin_abflow.grid import Grid, Place
from hugin_abflow.layer import Box, Layer
from hugin_abflow.opencl import Buffer, Device, DeviceMemoryError
from hugin_abflow.progress import Advance
from hugin_abflow.settings import Settings
from hugin_abflow.slices import Band, Coarse, Slices, Span, coarse_rows
from hugin_abflow.working import device_dtype, device_rows, pixel_options

_log = logging.getLogger(__name__)

# Output pixels of a band, about, where the settings leave the choice and memory allows it.
_BAND_PIXELS = 1 << 20
# The same on graphics cards, which start slowly.
_BAND_PIXELS_ON_CARD = 1 << 22
# Rows of a band, at least.
_LEAST_ROWS = 4
# Rows that files keep of each layer between two reads.
_STRIP_ROWS = 64
# Bytes that are allocated beside those which are reckoned.
_SLACK = 48 << 20
# Bytes of a strip up to which bands end where strips do, although they hold some rows more then.
_WHOLE_STRIP = 2 << 20
# A layer with less than this share of a pixel's weight changes it by less than a quarter of a level, and need
# not be sampled; of a level of 16 bits for floats.
_QUARTER_LEVEL = {np.dtype(np.uint8): 0.25 / 255}
_QUARTER_FINE_LEVEL = 0.25 / 65535

# A weight that nothing brings above 0.
NEVER = -1e30

# Pixels of a row for which it is found out first which layers they show.
_BLOCK = 64

# A row of the table of layers: `blend_layer` of kernels/blend.cl.
_LAYER = np.dtype(
    [
        *((box, np.int32, 4) for box in ("place", "field", "gain", "offset")),
        *((number, np.int32) for number in ("fields", "gains", "offsets", "ring", "turn", "unused")),
        ("rows", np.int64),
    ]
)


@dataclass(frozen=True)
class BlendLayer:
    """What the full-resolution pass knows of one layer.

    box     place of `field` on the working grid: left, top, width, height.
    field   displacement and colour weight, float32 (height, width, 4).
    reach   per row of `field`, how far from it at most rows are sampled, working px (geometry.py).
    gain    on the exposure scale and the colour grid, float32 (height, width, 4); None: no correction.
    offset  what is added after that (multiband.py), its place on its grid and float32 (height, width, 4);
            None: nothing.

    Of weights those above 0 count. Within a band what nobody would see is made 0 or less (hidden.py), and not
    sampled, unless most of what counts leads outside its layer: then all are raised by a share of their sum,
    and what was hidden stands in. `NEVER` stays below 0 even so: such a layer shows only where no other is.
    """

    layer: Layer
    box: Place
    field: Buffer
    reach: Sequence[float]
    gain: Buffer | None
    offset: Coarse | None = None


@dataclass(frozen=True)
class Prepared:
    """All that the full-resolution pass needs, on the device.

    full        the canvas's grid at full resolution; grid, gain_grid, offset_grid: those of the layers'
                fields, gains and offsets.
    shoulder    of the exposure scale (colour.py).
    light_unit  of floats, the value that counts as full scale of what they are coded as (unit.py).
    unlike      where layers show different things, by which offsets were made; None: nowhere.
    carried     on a grid, uint8 (height, width): where what one layer alone shows is sampled as its field
                says, too (rim.py). None: nowhere.
    """

    layers: tuple[BlendLayer, ...]
    full: Grid
    grid: Grid
    gain_grid: Grid
    offset_grid: Grid
    shoulder: float
    light_unit: float = 1.0
    unlike: Unlike | None = None
    carried: tuple[Grid, Buffer] | None = None


def bands(
    device: Device, prepared: Prepared, crop: Box, settings: Settings, advance: Advance
) -> Iterator[npt.NDArray[Any]]:
    """Rows of the panorama, from the crop's top to its bottom: (rows, crop width, channels + 1) in the
    layers' dtype, alpha last. `crop` is in canvas pixels; `advance` counts rows.
    """
    height = settings.band_rows or _band_height(device, prepared, crop, settings)
    top = crop.top
    while top < crop.bottom:
        rest = Box(crop.left, top, crop.right, crop.bottom)
        try:
            for out in _bands(device, prepared, rest, height, settings):
                yield out
                advance(len(out))
                top += len(out)
        except DeviceMemoryError:
            if height <= _LEAST_ROWS:
                raise
            height = max(_LEAST_ROWS, height // 2)  # the device is smaller than it says


def _band_height(device: Device, prepared: Prepared, crop: Box, settings: Settings) -> int:
    """Rows of a band: as many as are quick and memory holds."""
    pixels = _BAND_PIXELS_ON_CARD if device.kind == "GPU" else _BAND_PIXELS
    height = max(_LEAST_ROWS, pixels // crop.width)
    device.give_back()
    limit = memory.limit(settings.max_memory)
    used = memory.resident() + device.own_memory + _SLACK
    while True:
        plan = _plan(prepared, crop, height)
        needed = used + _pass_memory(prepared.layers, plan, prepared.grid.row_height)
        if needed <= limit or height <= _LEAST_ROWS:
            break
        height = max(_LEAST_ROWS, height // 2)
    _log.info("memory: %s of %s for bands of %d rows", memory.size(needed), memory.size(limit), height)
    if needed > limit:
        given, remedy = memory.shortage(settings.max_memory, needed)
        _log.warning(
            "%s is too little for this panorama, which takes about %s; going on with that (better: %s)",
            given, memory.size(needed), remedy,
        )  # fmt: skip
    return height


def _pass_memory(layers: Sequence[BlendLayer], plan: Sequence[Band], scale: float) -> int:
    """Bytes that the bands take on host and device beside what is there before.

    scale: rows of the panorama per row of the working grid.
    """
    first, part = layers[0].layer, plan[0].part
    pixel = (first.channels + 1) * device_dtype(first).itemsize
    shelves = _shelves([one.layer for one in layers], [band.rows for band in plan])
    out = part.width * part.height * pixel
    # rows of the next band are held on the host until their turn comes; files hold rows as they decode them
    fresh = max(
        sum(
            one.layer.box.width * (part.height + 2 * _STRIP_ROWS)
            for one, (start, end) in zip(layers, band.rows, strict=True)
            if start < end
        )
        for band in plan
    )
    coarse = math.ceil(part.height / scale) + 4
    slices = sum(16 * (one.box[2] + (one.offset[0][2] if one.offset else 0)) * coarse for one in layers)
    return shelves.total * pixel + fresh * pixel + 4 * out + slices


def build_options(device: Device, first: Layer) -> str:
    """Of what makes the panorama's pixels, which are as the first layer's."""
    pixel, white = pixel_options(first)
    integer, together = int(first.dtype.kind == "u"), _pixels_together(device)
    return f"{pixel} -DWHITE={white:.1f}f -DINTEGER={integer} -DPIXELS={together} -DBLOCK={_BLOCK}"


def _pixels_together(device: Device) -> int:
    """How many pixels of a row are made together."""
    return 4 if device.vector_floats >= 8 else 2


def _bands(
    device: Device, prepared: Prepared, crop: Box, height: int, settings: Settings
) -> Iterator[npt.NDArray[Any]]:
    """Bands of `height` rows."""
    layers, full, grid = prepared.layers, prepared.full, prepared.grid
    region, first = full.region, layers[0].layer
    together, options = _pixels_together(device), build_options(device, first)
    share = _QUARTER_LEVEL.get(first.dtype, _QUARTER_FINE_LEVEL)
    whole = (0, 0, prepared.gain_grid.width, prepared.gain_grid.height)
    longitudes = _sines_cosines(device, full.lonlat[0], full.lonlat[1], crop.left - region.left, crop.width)
    strips = (0, 0, 0, 0) if prepared.carried is None else prepared.carried[0].border
    carried = device.zeros((1, 1), np.uint8) if prepared.carried is None else prepared.carried[1]
    plan = _plan(prepared, crop, height)
    # all that lie in a band tell what nobody sees
    fields = Slices(device, [(layer.box, layer.field) for layer in layers], grid, plan, everywhere=True)
    corrections = [None if layer.gain is None else (whole, layer.gain) for layer in layers]
    gains = Slices(device, corrections, prepared.gain_grid, plan)
    offsets = Slices(device, [layer.offset for layer in layers], prepared.offset_grid, plan)
    spans = [band.rows for band in plan]
    with _Store(device, [layer.layer for layer in layers], spans, settings.cores) as store:
        for band in plan:
            part = band.part
            size = part.width, part.height
            groups = -(-part.width // together), part.height
            store.next()
            places = [slices.take(band) for slices in (fields, gains, offsets)]
            top, bottom = coarse_rows((0, 0, grid.width, grid.height), part, grid.row_height)
            read = places[0][places[0][:, 3] > 0]
            hidden.mark(device, fields.values, read, (0, top, grid.width, bottom - top), share)
            touched = device.upload(_table(layers, band, store.shelves, places, region))
            marks = _mark(device, store.rows, touched, fields.values, full, grid, part, options)
            latitudes = _sines_cosines(device, full.lonlat[2], -full.lonlat[3], part.top, part.height)
            out = device.empty((part.height, part.width, first.channels + 1), device_dtype(first))
            device.run(
                "blend", "blend_band", groups, store.rows, touched, touched.shape[0], fields.values,
                gains.values, offsets.values, longitudes, latitudes, full.border, full.lonlat, grid.border,
                prepared.gain_grid.border, prepared.offset_grid.border, (part.left, part.top, *size),
                (region.left, region.top), prepared.shoulder, math.sqrt(prepared.light_unit),
                int(settings.interpolation == "nearest"), share, marks, marks.shape[-1],
                carried, strips, out, options=options,
            )  # fmt: skip
            yield _stored(out.get(), first.dtype)


def _table(
    layers: Sequence[BlendLayer],
    band: Band,
    shelves: _Shelves,
    places: Sequence[npt.NDArray[np.int32]],
    region: Box,
) -> npt.NDArray[Any]:
    """The layers that a band samples, as blend.cl takes them. places: of their fields, gains and offsets
    (`Slices.take`).
    """
    used = np.flatnonzero(band.samples)
    table = np.zeros(used.size, _LAYER)
    for row, k in zip(table, used.tolist(), strict=True):
        box, ring, (start, end) = layers[k].layer.box, shelves.rings[k], band.rows[k]
        row["place"] = box.left - region.left, box.top - region.top + start, box.width, end - start
        row["rows"], row["ring"], row["turn"] = ring.start, ring.rows, start % ring.rows
    for name, its_places in zip(("field", "gain", "offset"), places, strict=True):
        table[name], table[name + "s"] = its_places[used, :4], its_places[used, 4]
    return table


def _stored(values: npt.NDArray[Any], dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """Samples as the layers have them; light beyond what half floats hold becomes the most that they do."""
    if dtype == np.float16:
        most = np.finfo(np.float16).max
        np.clip(values, -most, most, out=values)
    return values.astype(dtype, copy=False)


def _sines_cosines(device: Device, angle: float, step: float, first: int, count: int) -> Buffer:
    """Sine and cosine at the centres of pixels, float32 (n, 2); angle: of the border of pixel 0."""
    angles = angle + (np.arange(first, first + count) + 0.5) * step
    return device.upload(np.stack([np.sin(angles), np.cos(angles)], -1).astype(np.float32))


def _mark(
    device: Device,
    rows: Buffer,
    layers: Buffer,
    fields: Buffer,
    full: Grid,
    grid: Grid,
    part: Box,
    options: str,
) -> Buffer:
    """Which of `layers` blocks of a band show, and which weigh something there: bits of uint32 (rows, blocks,
    2, words).
    """
    count = layers.shape[0]
    words, blocks = max(1, -(-count // 32)), -(-part.width // _BLOCK)
    marks = device.empty((part.height, blocks, 2, words), np.uint32)
    band = part.left, part.top, part.width, part.height
    device.run(
        "blend", "blend_mark", (blocks, part.height), rows, layers, count, fields, full.border, grid.border,
        band, words, marks, options=options,
    )  # fmt: skip
    return marks


def _rows_needed(layer: BlendLayer, full: Grid, part: Box, scale: float) -> Span:
    """Layer rows (from, to) that a band may sample; equal if none."""
    box = layer.layer.box
    offset = box.top - full.region.top
    if part.bottom <= offset or part.top >= offset + box.height:
        return 0, 0
    first, last = (row - layer.box[1] for row in coarse_rows(layer.box, part, scale))
    beyond = math.ceil(max(layer.reach[first:last]) * scale) + 3  # 3: bicubic taps, rounding
    start, end = max(0, part.top - beyond - offset), min(box.height, part.bottom + beyond - offset)
    # whole strips, unless they are large: parts would have to be cut and joined again
    strip, row = layer.layer.strip, layer.layer.row_bytes
    return start, min(box.height, end + (-end % strip if strip * row <= _WHOLE_STRIP else 0))


def _plan(prepared: Prepared, crop: Box, height: int) -> list[Band]:
    """The bands from top to bottom. No band needs a row that the one before it has let go of."""
    layers, full, scale = prepared.layers, prepared.full, prepared.grid.row_height
    left, top = full.region.left, full.region.top
    parts = [
        Box(crop.left - left, start - top, crop.right - left, min(start + height, crop.bottom) - top)
        for start in range(crop.top, crop.bottom, height)
    ]
    spans = [[_rows_needed(layer, full, part, scale) for layer in layers] for part in parts]
    for k in range(len(layers)):
        touched = [i for i, rows in enumerate(spans) if rows[k][0] < rows[k][1]]
        for before, after in pairwise(touched):
            spans[after][k] = spans[after][k][0], max(spans[before][k][1], spans[after][k][1])
        for before, after in reversed(list(pairwise(touched))):
            spans[before][k] = min(spans[before][k][0], spans[after][k][0]), spans[before][k][1]
    return [Band(part, tuple(rows)) for part, rows in zip(parts, spans, strict=True)]


@dataclass(frozen=True)
class _Ring:
    """Where a layer's rows lie in the store: row r at r modulo `rows`. start: pixels before it."""

    start: int
    rows: int


@dataclass(frozen=True)
class _Shelves:
    """The store's layout. total: its pixels."""

    rings: tuple[_Ring, ...]
    total: int


def _shelves(layers: Sequence[Layer], spans: Sequence[Sequence[Span]]) -> _Shelves:
    """Room for all rows that a band needs of each layer; layers that no band needs together may share it."""
    rings, total = [_Ring(0, 1)] * len(layers), 0
    placed: list[tuple[int, int, int]] = []  # from, to, last band
    lives = []
    for k in range(len(layers)):
        needed = [i for i, band in enumerate(spans) if band[k][0] < band[k][1]]
        if needed:
            lives.append((needed[0], needed[-1], k))
    for first, last, k in sorted(lives):
        rows = max(end - start for start, end in (band[k] for band in spans))
        need, at = rows * layers[k].box.width, 0
        for start, end, their_last in sorted(placed):
            if their_last < first:
                continue  # it comes before: layers are placed in the order of their first bands
            if at + need <= start:
                break
            at = max(at, end)
        placed.append((at, at + need, last))
        rings[k] = _Ring(at, rows)
        total = max(total, at + need)
    return _Shelves(tuple(rings), total)


class _Store:
    """Rows of all layers on the device, those that a band needs. Each row is decoded and uploaded once.

    spans   for each band, the rows of each layer; from band to band neither end goes back, but for a layer
            that is not needed: its are equal.
    rows    stored samples (n, channels + 1); shelves: where each layer's are.
    """

    def __init__(
        self, device: Device, layers: Sequence[Layer], spans: Sequence[Sequence[Span]], threads: int
    ) -> None:
        self.shelves = _shelves(layers, spans)
        self.rows = device.empty((self.shelves.total, layers[0].channels + 1), device_dtype(layers[0]))
        self._layers = layers
        self._spans = iter(spans)
        self._held: Sequence[Span] = [(0, 0)] * len(layers)
        self._decoders = ThreadPoolExecutor(threads, "decoder")
        self._coming = self._decode()

    def __enter__(self) -> _Store:
        return self

    def __exit__(self, *reason: object) -> None:
        self._decoders.shutdown(cancel_futures=True)

    def _decode(self) -> tuple[Sequence[Span], list[tuple[int, int, Future[npt.NDArray[Any]]]]]:
        """Begin to decode what the next band needs beyond what is held: layer, first row, rows."""
        spans = next(self._spans, self._held)
        coming = []
        for k, ((start, end), (_, held)) in enumerate(zip(spans, self._held, strict=True)):
            first = max(start, held)
            if first < end:
                coming.append((k, first, self._decoders.submit(device_rows, self._layers[k], first, end)))
        return spans, coming

    def next(self) -> None:
        """Have `rows` hold what the next band needs."""
        spans, coming = self._coming
        for k, first, rows in coming:
            self._put(self.shelves.rings[k], first, rows.result())
        self._held = spans
        self._coming = self._decode()

    def _put(self, ring: _Ring, first: int, rows: npt.NDArray[Any]) -> None:
        """Upload rows of a layer from its row `first` on, over those that are needed no more."""
        width = rows.shape[1]
        while len(rows):
            at = first % ring.rows
            fitting = rows[: ring.rows - at]
            self.rows.put(ring.start + at * width, fitting.reshape(-1, rows.shape[2]))
            first, rows = first + len(fitting), rows[len(fitting) :]

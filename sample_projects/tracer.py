"""A small ray tracer for rooms with diffuse light, on any OpenCL device (``tracer.cl``, ``textures.cl``).

Axes: metres, x right (east), y ahead (north), z up. A `Scene` collects primitives; a `Tracer` bakes their
light once and then answers "what colour and how far" for any rays from any point. Results are the same on
every run on one machine.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyopencl as cl

from hugin_abflow import pocl

Floats = npt.NDArray[np.float32]
Vector = Sequence[float] | npt.NDArray[np.float64]

PRIM_STRIDE = 48  # as in tracer.cl
FACES = {0: 6, 1: 1, 2: 3}  # light-map faces of each shape


class Shape(IntEnum):
    """Unit shapes; `SHAPE_*` in tracer.cl."""

    BOX = 0
    SPHERE = 1
    FRUSTUM = 2


class Material(IntEnum):
    """Procedural textures; `MAT_*` in textures.cl."""

    PAINT = 0
    WOOD = 1
    PARQUET = 2
    PLASTER = 3
    WALLPAPER = 4
    PAINTING = 5
    WEAVE = 6
    CHECK = 7
    STRIPES = 8
    RUG = 9
    BOOK = 10
    PAGES = 11
    LEAF = 12
    CERAMIC = 13
    CLOCK = 14
    GLOW = 15


@dataclass
class Scene:
    """Primitives and lights. Colours are linear RGB, sizes metres, angles degrees."""

    primitives: list[Floats] = field(default_factory=list)
    frames: list[npt.NDArray[np.float64]] = field(default_factory=list)
    lights: list[Floats] = field(default_factory=list)

    def _add(
        self,
        shape: Shape,
        centre: Vector,
        axes: npt.NDArray[np.float64],
        half: Vector,
        material: Material,
        colour: Vector,
        second: Vector,
        taper: float,
        texel: float,
    ) -> None:
        """`axes`: columns are the local axes in world space, unit length."""
        forward = np.eye(4)
        forward[:3, :3] = axes * np.asarray(half)
        forward[:3, 3] = centre
        row = np.zeros(PRIM_STRIDE, np.float32)
        row[0:12] = np.linalg.inv(forward)[:3].ravel()
        row[12:24] = forward[:3].ravel()
        row[24:27] = half
        row[27:30] = shape, taper, material
        row[30:33], row[33:36] = colour, second
        row[36] = 17 + 31 * len(self.primitives) % 60013
        if shape == Shape.BOX:
            counts = [np.ceil(2 * size / texel) + 1 for size in half]
        else:
            around = np.ceil(2 * np.pi * max(half[0], half[1]) / texel) + 3
            counts = [around, np.ceil(2 * half[2] / texel) + 2, np.ceil(2 * half[0] / texel) + 2]
        row[38:41] = np.clip(counts, 2, 400)
        self.primitives.append(row)
        self.frames.append(forward)

    def box(
        self,
        low: Vector,
        high: Vector,
        material: Material,
        colour: Vector,
        second: Vector = (0, 0, 0),
        *,
        turn: float = 0.0,
        tilt: float = 0.0,
        texel: float = 0.03,
    ) -> None:
        """A box between two corners, then turned about its vertical and tilted about its own x axis."""
        low_corner, high_corner = np.asarray(low, float), np.asarray(high, float)
        axes = rotation_z(turn) @ rotation_x(tilt)
        half = np.maximum((high_corner - low_corner) / 2, 1e-4)
        centre = (low_corner + high_corner) / 2
        self._add(Shape.BOX, centre, axes, half, material, colour, second, 1.0, texel)

    def ball(
        self,
        centre: Vector,
        radii: float | Vector,
        material: Material,
        colour: Vector,
        second: Vector = (0, 0, 0),
        *,
        axes: npt.NDArray[np.float64] | None = None,
        texel: float = 0.02,
    ) -> None:
        """A sphere, or an ellipsoid along `axes`."""
        half = np.broadcast_to(np.asarray(radii, float), 3)
        frame = np.eye(3) if axes is None else axes
        self._add(Shape.SPHERE, centre, frame, half, material, colour, second, 1.0, texel)

    def rod(
        self,
        start: Vector,
        end: Vector,
        radius: float,
        material: Material,
        colour: Vector,
        second: Vector = (0, 0, 0),
        *,
        end_radius: float | None = None,
        squash: float = 1.0,
        texel: float = 0.03,
    ) -> None:
        """A cylinder, or a frustum if `end_radius` differs; `squash` flattens one diameter."""
        a, b = np.asarray(start, float), np.asarray(end, float)
        length = float(np.linalg.norm(b - a))
        axis = (b - a) / length
        helper = np.array([0.0, 1.0, 0.0]) if abs(axis[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
        side = np.cross(helper, axis)
        side /= np.linalg.norm(side)
        axes = np.stack([side, np.cross(axis, side), axis], axis=1)
        taper = 1.0 if end_radius is None else end_radius / radius
        half = (radius, radius * squash, length / 2)
        self._add(Shape.FRUSTUM, (a + b) / 2, axes, half, material, colour, second, taper, texel)

    def sun(self, direction: Vector, colour: Vector, half_angle: float) -> None:
        """Parallel light from `direction`, softened by `half_angle` (radians)."""
        unit = np.asarray(direction, float) / np.linalg.norm(direction)
        self.lights.append(_light(0, colour, [*unit, half_angle]))

    def window(self, centre: Vector, half_width: float, half_height: float, colour: Vector) -> None:
        """Skylight through an upright rectangle that faces -y."""
        spread = 4 * half_width * half_height / np.pi
        shine = np.asarray(colour) * spread
        self.lights.append(_light(1, shine, [*centre, half_width, 0, 0, 0, 0, half_height]))

    def lamp(self, centre: Vector, radius: float, colour: Vector) -> None:
        """A ball that shines; `radius` should exceed that of the ball one sees."""
        self.lights.append(_light(2, colour, [*centre, radius]))


def _light(kind: int, colour: Vector, rest: list[float]) -> Floats:
    row = np.zeros(16, np.float32)
    row[: 4 + len(rest)] = [kind, *colour, *rest]
    return row


def rotation_z(degrees: float) -> npt.NDArray[np.float64]:
    """Counter-clockwise seen from above."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def rotation_x(degrees: float) -> npt.NDArray[np.float64]:
    """From y towards z."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])


def _bounds(frame: npt.NDArray[np.float64], shape: int, taper: float) -> npt.NDArray[np.float64]:
    """(2, 3): lowest and highest corner of a primitive."""
    linear, centre = frame[:3, :3], frame[:3, 3]
    if shape == Shape.SPHERE:
        reach = np.linalg.norm(linear, axis=1)
    else:
        wide = max(1.0, taper) if shape == Shape.FRUSTUM else 1.0
        reach = np.abs(linear) @ np.array([wide, wide, 1.0])
    return np.stack([centre - reach - 1e-5, centre + reach + 1e-5])


def _hierarchy(boxes: npt.NDArray[np.float64]) -> Floats:
    """Nodes in depth-first order, (nodes, 8): low, high, node to go on with when missed, primitive or -1."""
    rows: list[list[float]] = []

    def grow(members: npt.NDArray[np.int64]) -> None:
        low, high = boxes[members, 0].min(0), boxes[members, 1].max(0)
        mine = len(rows)
        rows.append([*low, *high, 0.0, -1.0])
        if len(members) == 1:
            rows[mine][7] = float(members[0])
        else:
            first, second = _split(members, boxes)
            grow(first)
            grow(second)
        rows[mine][6] = float(len(rows))

    grow(np.arange(len(boxes)))
    return np.array(rows, np.float32)


def _split(
    members: npt.NDArray[np.int64], boxes: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Two groups with the least sum of surface times members, split along one axis."""

    def surfaces(ordered: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        low = np.minimum.accumulate(boxes[ordered, 0])
        size = np.maximum.accumulate(boxes[ordered, 1]) - low
        return np.asarray(size[:, 0] * size[:, 1] + size[:, 1] * size[:, 2] + size[:, 2] * size[:, 0])

    best = (np.inf, members, members)
    number = np.arange(1, len(members))
    for axis in range(3):
        ordered = members[np.argsort(boxes[members].mean(1)[:, axis], kind="stable")]
        cost = surfaces(ordered)[:-1] * number + surfaces(ordered[::-1])[:-1][::-1] * number[::-1]
        cut = int(np.argmin(cost))
        if cost[cut] < best[0]:
            best = (float(cost[cut]), ordered[: cut + 1], ordered[cut + 1 :])
    return best[1], best[2]


class Tracer:
    """A scene made ready: geometry on the device, light baked.

    Parameters: `cache`, a folder that keeps the baked light (about 10 MB a scene) between runs;
    `samples`, shadow rays per texel and light.
    """

    def __init__(self, scene: Scene, cache: Path | None = None, samples: int = 24) -> None:
        prims, texels = self._light_map_layout(scene)
        boxes = np.stack(
            [
                _bounds(frame, int(row[27]), float(row[28]))
                for frame, row in zip(scene.frames, prims, strict=True)
            ]
        )
        nodes = _hierarchy(boxes)
        self._context = cl.Context([_device()])
        self._queue = cl.CommandQueue(self._context)
        source = "".join(
            Path(__file__).with_name(name).read_text(encoding="utf-8")
            for name in ("textures.cl", "tracer.cl")
        )
        options = [f"-DSHAPE_{s.name}={s.value}" for s in Shape]
        options += [f"-DMAT_{m.name}={m.value}" for m in Material]
        program = cl.Program(self._context, source).build(options=options)
        self._render = cl.Kernel(program, "render")
        self._bake_direct = cl.Kernel(program, "bake_direct")
        self._bake_bounce = cl.Kernel(program, "bake_bounce")
        self._prims, self._nodes = self._upload(prims), self._upload(nodes)
        self._node_count = np.int32(len(nodes))
        lights = np.stack(scene.lights)
        key = hashlib.sha256(
            b"".join([source.encode(), prims.tobytes(), lights.tobytes(), bytes([samples])])
        ).hexdigest()[:16]
        stored = cache / f"light-{key}.npy" if cache is not None else None
        if stored is not None and stored.exists():
            light = np.load(stored)
        else:
            light = self._bake(texels, lights, samples)
            if stored is not None:
                stored.parent.mkdir(parents=True, exist_ok=True)
                np.save(stored, light)
        self._light = self._upload(light)

    @staticmethod
    def _light_map_layout(scene: Scene) -> tuple[Floats, npt.NDArray[np.int32]]:
        """Primitives with their first texel filled in, and the texel table (primitive, face, column, row)."""
        prims = np.stack(scene.primitives)
        tables = []
        start = 0
        for index, row in enumerate(prims):
            row[37] = start
            a, b, c = (int(n) for n in row[38:41])
            if row[27] == Shape.BOX:
                sizes = [(b, c), (b, c), (a, c), (a, c), (a, b), (a, b)]
            else:
                sizes = [(a, b), (c, c), (c, c)]
            for face, (columns, rows) in enumerate(sizes):
                y, x = np.mgrid[0:rows, 0:columns]
                table = np.stack([np.full_like(x, index), np.full_like(x, face), x, y], -1).reshape(-1, 4)
                tables.append(table)
                start += len(table)
        return prims, np.concatenate(tables).astype(np.int32)

    def _upload(self, array: npt.NDArray[Any]) -> cl.Buffer:
        flags = cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR
        return cl.Buffer(self._context, flags, hostbuf=np.ascontiguousarray(array))

    def _bake(self, texels: npt.NDArray[np.int32], lights: Floats, samples: int) -> Floats:
        """Irradiance / pi of each texel, (texels, 3): lights, two bounces, and a little for all the rest."""
        count = len(texels)
        table, lamps = self._upload(texels), self._upload(lights)
        target = cl.Buffer(self._context, cl.mem_flags.WRITE_ONLY, count * 12)
        result = np.empty((count, 3), np.float32)
        scene = (self._prims, self._nodes, self._node_count, table, np.int32(count))
        size = (-(-count // 64) * 64,)
        self._bake_direct(
            self._queue, size, (64,), *scene, lamps, np.int32(len(lights)), np.int32(samples), target
        )
        cl.enqueue_copy(self._queue, result, target)
        direct = result.copy()
        light = direct
        for _ in range(2):
            self._bake_bounce(
                self._queue, size, (64,), *scene, self._upload(light), np.int32(2 * samples), target
            )
            cl.enqueue_copy(self._queue, result, target)
            light = direct + _smooth_faces(result, texels)
        mean = light.mean(0)
        return np.ascontiguousarray(light + 0.06 * mean, np.float32)

    def look(
        self, eye: Vector, rays: Floats, *, grid: int = 2, exposure: float = 1.0
    ) -> tuple[Floats, Floats]:
        """Colours (n, 3; display values 0..1) and distances (n; metres) along rays from `eye`.

        `rays` is (n, 3, 3): direction, its change per pixel to the right, and per pixel down.
        `grid` x `grid` samples are taken of each pixel.
        """
        count = len(rays)
        colours, depths = np.empty((count, 3), np.float32), np.empty(count, np.float32)
        step = 1 << 20
        for first in range(0, count, step):
            part = slice(first, min(count, first + step))
            n = part.stop - part.start
            out_colour = cl.Buffer(self._context, cl.mem_flags.WRITE_ONLY, n * 12)
            out_depth = cl.Buffer(self._context, cl.mem_flags.WRITE_ONLY, n * 4)
            self._render(
                self._queue,
                (-(-n // 64) * 64,),
                (64,),
                self._prims,
                self._nodes,
                self._node_count,
                self._light,
                *(np.float32(v) for v in eye),
                self._upload(rays[part].astype(np.float32)),
                np.int32(n),
                np.int32(grid),
                np.float32(exposure),
                out_colour,
                out_depth,
            )
            cl.enqueue_copy(self._queue, colours[part], out_colour)
            cl.enqueue_copy(self._queue, depths[part], out_depth)
        return colours, depths


def _device() -> cl.Device:
    """A CPU where there is one, for the same picture everywhere; else the first device."""
    pocl.find_cache()
    devices = [device for platform in cl.get_platforms() for device in platform.get_devices()]
    if not devices:
        raise RuntimeError("no OpenCL device; install one, such as PoCL (pip install 'pyopencl[pocl]')")
    cpus = [device for device in devices if device.type & cl.device_type.CPU]
    device = (cpus or devices)[0]
    pocl.name_processor(device.version, device.driver_version, device.int_ptr)
    return device


def _smooth_faces(light: Floats, texels: npt.NDArray[np.int32]) -> Floats:
    """Average light over 3x3 texels of the same face: bounced light is soft, its sampling is not."""
    result = np.empty_like(light)
    key = texels[:, 0].astype(np.int64) * 8 + texels[:, 1]
    starts = np.flatnonzero(np.r_[True, np.diff(key) != 0, True])
    for first, last in pairwise(starts):
        columns, rows = texels[last - 1, 2] + 1, texels[last - 1, 3] + 1
        face = light[first:last].reshape(rows, columns, 3)
        for _ in range(2):
            padded = np.pad(face, ((1, 1), (1, 1), (0, 0)), mode="edge")
            shifted = [padded[y : y + rows, x : x + columns] for y in range(3) for x in range(3)]
            face = np.mean(shifted, axis=0, dtype=np.float32)
        result[first:last] = face.reshape(-1, 3)
    return result

"""Pairs of images with known flow, for flow.py: readers of public pairs, and synthetic ones.

A truth is float64 (h, w, 2), px, x right and y down: what one image shows at q, the other shows at
q + truth[q]; NaN where that is unknown, hidden, or beyond the other image's border.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

Pixels = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float64]

# Two truths that differ by more than this at one place are of two surfaces, one of which hides the other.
_SAME_SURFACE = 1.0


@dataclass(frozen=True)
class Pair:
    """a, b: uint8 BGR (h, w, 3); forward: truth from a to b; backward: from b to a."""

    name: str
    a: Pixels
    b: Pixels
    forward: Floats
    backward: Floats


def _targets(truth: Floats) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Which pixels land inside the other image, and the nearest pixel there."""
    height, width = truth.shape[:2]
    y, x = np.mgrid[0:height, 0:width]
    known = np.isfinite(truth).all(-1)
    to_x, to_y = (np.where(known, p + truth[..., i], -1.0) for i, p in ((0, x), (1, y)))
    inside = (to_x >= 0) & (to_x <= width - 1) & (to_y >= 0) & (to_y <= height - 1)
    column, row = (np.where(inside, np.rint(p), 0).astype(np.intp) for p in (to_x, to_y))
    return inside, row, column


def visible(truth: Floats, back: Floats) -> Floats:
    """The truth without what the other image hides, where that image's own truth shows another surface."""
    inside, row, column = _targets(truth)
    answer = back[row, column]
    hidden = np.linalg.norm(truth + np.nan_to_num(answer), axis=-1) > _SAME_SURFACE + 0.02 * np.linalg.norm(
        np.nan_to_num(truth), axis=-1
    )
    keep = inside & ~(hidden & np.isfinite(answer).all(-1))
    return np.where(keep[..., None], truth, np.nan)


def reverse(truth: Floats, depth: Floats) -> Floats:
    """The other direction's truth: each pixel's motion, carried to where it lands.

    Where several surfaces land on one pixel, the one of the least `depth` (h, w) is in front.
    """
    inside, row, column = _targets(truth)
    order = np.flatnonzero(inside)[np.argsort(-depth[inside], kind="stable")]
    back = np.full_like(truth, np.nan)
    # of several that land on one pixel the last stays
    back[row.ravel()[order], column.ravel()[order]] = -truth.reshape(-1, 2)[order]
    return back


def unlikeness(a: Pixels, b: Pixels, truth: Floats) -> Floats:
    """Mean grey difference of a and what b shows there, in windows of 5 px."""
    y, x = np.mgrid[0 : a.shape[0], 0 : a.shape[1]]
    to = (np.nan_to_num(truth) + np.stack([x, y], -1)).astype(np.float32)
    there = cv2.remap(b, to[..., 0], to[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    difference = np.abs(there.astype(np.float64) - a).mean(-1)
    return np.asarray(cv2.blur(difference, (5, 5)), np.float64)


def make_pair(
    name: str, a: Pixels, b: Pixels, forward: Floats, backward: Floats | None, stereo: bool
) -> Pair:
    """A pair whose truths show visible pixels only.

    backward None: found from `forward`; what is in front is in stereo what moves most, else what looks alike.
    """
    if backward is None:
        moved = -np.linalg.norm(np.nan_to_num(forward), axis=-1)
        backward = reverse(forward, moved if stereo else unlikeness(a, b, forward))
    return Pair(name, a, b, visible(forward, backward), visible(backward, forward))


def read_flo(path: Path) -> Floats:
    """Middlebury's .flo: a float32 tag, width, height, then float32 pairs; over 1e9 is unknown."""
    data = path.read_bytes()
    if data[:4] != b"PIEH":
        raise SystemExit(f"{path} is no .flo file")
    width, height = np.frombuffer(data, "<i4", 2, 4)
    truth = np.frombuffer(data, "<f4", width * height * 2, 12).reshape(height, width, 2).astype(np.float64)
    truth[(np.abs(truth) > 1e9).any(-1)] = np.nan
    return truth


def _image(path: Path) -> Pixels:
    found = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if found is None:
        raise SystemExit(f"{path} cannot be read")
    return np.asarray(found, np.uint8)


def _across(disparity: Floats, sign: int) -> Floats:
    """Flow of a rectified pair; disparity 0 or infinite is unknown."""
    known = np.isfinite(disparity) & (disparity != 0)
    return np.stack([np.where(known, sign * disparity, np.nan), np.where(known, 0.0, np.nan)], -1)


def _disparity(path: Path, scale: float, sign: int) -> Floats:
    return _across(_image(path)[..., 0].astype(np.float64) / scale, sign)


def _rubber(folder: Path) -> Pair:
    a, b = (_image(folder / f"RubberWhale{i}.png") for i in (1, 2))
    return make_pair("rubber", a, b, read_flo(folder / "RubberWhale.flo"), None, False)


def _chairs(number: int) -> Callable[[Path], Pair]:
    def read(folder: Path) -> Pair:
        a, b = (_image(folder / f"{number}img{i}.ppm") for i in (0, 1))
        return make_pair(f"chairs{number}", a, b, read_flo(folder / f"{number}flow.flo"), None, False)

    return read


def _middlebury(name: str, scale: int) -> Callable[[Path], Pair]:
    def read(folder: Path) -> Pair:
        a, b = (_image(folder / f"im{i}.png") for i in (2, 6))
        other = folder / "disp6.png"
        backward = _disparity(other, scale, 1) if other.exists() else None
        return make_pair(name, a, b, _disparity(folder / "disp2.png", scale, -1), backward, True)

    return read


def _kitti(folder: Path) -> Pair:
    raw = cv2.imread(str(folder / "flow_gt.png"), cv2.IMREAD_UNCHANGED).astype(np.float64)
    forward = np.where(raw[..., :1] > 0, (raw[..., 2:0:-1] - 32768) / 64, np.nan)
    a, b = (_image(folder / f"frame{i}.png") for i in (1, 2))
    return make_pair("kitti", a, b, forward, None, False)


def _motorcycle(folder: Path) -> Pair:
    with np.load(folder / "motorcycle_disp.npz") as archive:
        disparity = archive[archive.files[0]].astype(np.float64)
    a, b = (_image(folder / f"motorcycle_{side}.png") for side in ("left", "right"))
    return make_pair("motorcycle", a, b, _across(disparity, -1), None, True)


def _aloe(folder: Path) -> Pair:
    a, b = (_image(folder / f"aloe{side}.jpg") for side in "LR")
    return make_pair("aloe", a, b, _disparity(folder / "aloeGT.png", 1, -1), None, True)


_PUBLIC: list[tuple[str, Callable[[Path], Pair]]] = [
    ("middlebury_rubberwhale", _rubber),
    ("flyingchairs", _chairs(0)),
    ("flyingchairs", _chairs(1)),
    ("middlebury_stereo_cones", _middlebury("cones", 4)),
    ("middlebury_stereo_teddy", _middlebury("teddy", 4)),
    ("middlebury_stereo_venus", _middlebury("venus", 8)),
    ("middlebury_stereo_tsukuba", _middlebury("tsukuba", 16)),
    ("kitti_pair_mid2015", _kitti),
    ("middlebury2014_motorcycle", _motorcycle),
    ("opencv_aloe", _aloe),
]


def public_pairs(folder: Path) -> Iterator[Pair]:
    """The pairs that `folder` holds, each in a folder of its name."""
    for name, read in _PUBLIC:
        if (folder / name).is_dir():
            yield read(folder / name)


@dataclass(frozen=True)
class Sheet:
    """A flat thing in front of those before it: where a shows it, and how it moves from a to b.

    covers    (x, y) in a to whether it is there.
    matrix, shift    q in a lies at matrix q + shift in b; px from the image's centre.
    texture   float32, grey 0..255, larger than the image by `_PAD` on each side.
    """

    covers: Callable[[Floats, Floats], npt.NDArray[np.bool_]]
    matrix: Floats
    shift: Floats
    texture: npt.NDArray[np.float32]


_PAD = 160
_WIDTH, _HEIGHT = 640, 400


def _texture(random: np.random.Generator, contrast: float) -> npt.NDArray[np.float32]:
    """Noise of many scales around a grey of its own, with calm areas."""
    shape = (_HEIGHT + 2 * _PAD, _WIDTH + 2 * _PAD)
    total = np.zeros(shape, np.float32)
    for blur in (1.2, 3.0, 8.0, 20.0):
        noise = cv2.GaussianBlur(random.standard_normal(shape).astype(np.float32), (0, 0), blur)
        total += noise / noise.std()
    calm = cv2.GaussianBlur(random.standard_normal(shape).astype(np.float32), (0, 0), 30)
    share = 1 / (1 + np.exp(-4 * calm / calm.std()))
    return np.asarray(random.uniform(80, 170) + contrast * total * share, np.float32)


def _sheets(random: np.random.Generator, far: tuple[float, float], near: tuple[float, float]) -> list[Sheet]:
    """A wall that moves by `far`, boards that move by up to `near`, and two rods that move by `near`."""

    def sheet(
        covers: Callable[[Floats, Floats], npt.NDArray[np.bool_]], share: float, contrast: float
    ) -> Sheet:
        shift = np.asarray(far) + share * (np.array(near) - far)
        matrix = np.eye(2) + random.uniform(-0.02, 0.02, (2, 2))
        return Sheet(covers, matrix, shift, _texture(random, contrast))

    sheets = [sheet(lambda x, y: np.ones(x.shape, bool), 0.0, 14)]
    for share in (0.3, 0.5, 0.7, 0.85, 1.0):
        cx, cy = random.uniform(-220, 220), random.uniform(-120, 120)
        w, h = random.uniform(35, 90), random.uniform(30, 70)
        power = random.choice([2, 8])

        def board(
            x: Floats, y: Floats, cx: float = cx, cy: float = cy, w: float = w, h: float = h, p: int = power
        ) -> npt.NDArray[np.bool_]:
            return np.asarray(np.abs((x - cx) / w) ** p + np.abs((y - cy) / h) ** p < 1)

        sheets.append(sheet(board, share, 22))
    for at in (-150.0, 170.0):
        lean = random.uniform(-0.3, 0.3)
        sheets.append(sheet(lambda x, y, at=at, k=lean: np.abs(x - at - k * y) < 2.5, 1.0, 30))  # type: ignore[misc]
    return sheets


def _views(sheets: list[Sheet]) -> tuple[list[Floats], list[npt.NDArray[np.intp]], list[Floats]]:
    """Grey images a and b, the topmost sheet's number in each, and both truths before hiding."""
    y, x = np.mgrid[0:_HEIGHT, 0:_WIDTH].astype(np.float64)
    here = np.stack([x - _WIDTH / 2, y - _HEIGHT / 2], -1)
    images, numbers, truths = [], [], []
    for forward in (True, False):
        image, number, truth = np.zeros(x.shape), np.zeros(x.shape, np.intp), np.zeros(here.shape)
        for index, sheet in enumerate(sheets):
            there = here @ sheet.matrix.T + sheet.shift
            origin = (here - sheet.shift) @ np.linalg.inv(sheet.matrix).T
            place = here if forward else origin  # where a has what this image shows
            at = (place + np.array([_WIDTH / 2 + _PAD, _HEIGHT / 2 + _PAD])).astype(np.float32)
            drawn = cv2.remap(sheet.texture, at[..., 0], at[..., 1], cv2.INTER_CUBIC)
            shown = sheet.covers(place[..., 0], place[..., 1])
            image, number = np.where(shown, drawn, image), np.where(shown, index, number)
            truth = np.where(shown[..., None], (there if forward else origin) - here, truth)
        images.append(image)
        numbers.append(number)
        truths.append(truth)
    return images, numbers, truths


def _shown(truth: Floats, own: npt.NDArray[np.intp], other: npt.NDArray[np.intp]) -> Floats:
    """The truth where the other image shows the same sheet."""
    inside, row, column = _targets(truth)
    return np.where((inside & (other[row, column] == own))[..., None], truth, np.nan)


def _exposed(grey: Floats, random: np.random.Generator, gain: float, fall: float, noise: float) -> Pixels:
    """Grey times a gain that falls towards the corners, with noise; uint8 BGR."""
    y, x = np.mgrid[0:_HEIGHT, 0:_WIDTH]
    radius = ((x - _WIDTH / 2) ** 2 + (y - _HEIGHT / 2) ** 2) / (_WIDTH**2 + _HEIGHT**2) * 4
    seen = grey * gain * (1 - fall * radius) + noise * random.standard_normal(grey.shape)
    return np.repeat(np.rint(seen).clip(0, 255).astype(np.uint8)[..., None], 3, 2)


def synthetic_pair(
    name: str, seed: int, far: tuple[float, float], near: tuple[float, float], exposure: float = 1.0,
    fall: float = 0.0, noise: float = 1.0,
) -> Pair:  # fmt: skip
    """A wall that moves by `far` px behind boards and rods that move by up to `near`.

    exposure: how much brighter b is; fall: share of the light lost in the corners; noise: grey levels.
    """
    random = np.random.default_rng(seed)
    (a, b), (in_a, in_b), (forward, backward) = _views(_sheets(random, far, near))
    gain = 1 / np.sqrt(exposure)
    return Pair(
        name,
        _exposed(a, random, gain, fall, noise),
        _exposed(b, random, gain * exposure, fall, noise),
        _shown(forward, in_a, in_b),
        _shown(backward, in_b, in_a),
    )


def synthetic_pairs() -> list[Pair]:
    """Vertical motion; motion of a tenth of the width; one stop brighter with vignetting and noise."""
    return [
        synthetic_pair("vertical", 1, (0.5, 4.0), (-1.0, 24.0)),
        synthetic_pair("tenth", 2, (30.0, -3.0), (64.0, 4.0)),
        synthetic_pair("exposure", 3, (3.0, 1.0), (16.0, -4.0), 2.0, 0.5, 4.0),
    ]

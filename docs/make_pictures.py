"""Make docs/before-after.jpg: enblend's panorama of the sample beside ours, at 100 %.

.venv/bin/python docs/make_pictures.py              where the two differ most
.venv/bin/python docs/make_pictures.py --at 700,420 --at 1200,500
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import OpenImageIO as oiio

from hugin_abflow import merge_project

Picture = npt.NDArray[np.uint8]

ROOM = Path(__file__).resolve().parent.parent / "sample_projects" / "room"
RESULT = Path(__file__).resolve().parent / "before-after.jpg"
GAP, CAPTION = 8, 34  # pixels between the crops, and above them for the captions


def read_rgba(path: Path) -> Picture:
    """The 8-bit RGBA pixels of `path`: (height, width, 4)."""
    image = oiio.ImageBuf(str(path))
    pixels = image.get_pixels(oiio.UINT8)
    if pixels is None or pixels.shape[2] != 4:
        raise SystemExit(
            f"{path}: expected RGBA, found {pixels.shape if pixels is not None else image.geterror()}"
        )
    return np.asarray(pixels, np.uint8)


def make_panoramas(folder: Path) -> tuple[Picture, Picture]:
    """The sample blended by enblend and by us, as photographers would run them."""
    layers = sorted(ROOM.glob("room[0-9][0-9][0-9][0-9].tif"))
    before, after = folder / "enblend.tif", folder / "abflow.tif"
    merge_project(ROOM / "room.pto", prefix="room", output=after)
    size = f"-f{read_rgba(after).shape[1]}x{read_rgba(after).shape[0]}"
    subprocess.run(["enblend", "-w", size, "-o", before, "--", *layers], check=True, capture_output=True)
    return read_rgba(before), read_rgba(after)


def find_places(
    before: Picture, after: Picture, width: int, height: int, count: int
) -> list[tuple[int, int]]:
    """Upper left corners (x, y) of `count` windows where the two differ most, none touching another."""
    opaque = (before[..., 3] == 255) & (after[..., 3] == 255)
    difference = np.abs(before[..., :3].astype(float) - after[..., :3]).sum(axis=2) * opaque
    # Towards the poles pixels are stretched: a window there counts for less than it shows.
    rows = np.arange(len(difference)) + 0.5
    difference *= np.sin(rows / len(difference) * np.pi)[:, None] ** 2
    places: list[tuple[int, int]] = []
    for _ in range(count):
        sums = np.pad(difference, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
        windows = (
            sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
        )
        y, x = np.unravel_index(np.argmax(windows), windows.shape)
        places.append((int(x), int(y)))
        difference[max(0, y - height) : y + height, max(0, x - width) : x + width] = 0
    return places


def side_by_side(
    before: Picture, after: Picture, places: list[tuple[int, int]], width: int, height: int
) -> Picture:
    """A row of two crops for each place, under captions: (rows, columns, 3)."""
    page = np.full((CAPTION + len(places) * (height + GAP) - GAP, 2 * width + GAP, 3), 255, np.uint8)
    for column, caption in ((0, "enblend"), (width + GAP, "hugin-abflow")):
        cv2.putText(
            page, caption, (column + 4, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.75, (40, 40, 40), 1, cv2.LINE_AA
        )
    for row, (x, y) in enumerate(places):
        top = CAPTION + row * (height + GAP)
        for column, picture in ((0, before), (width + GAP, after)):
            page[top : top + height, column : column + width] = picture[y : y + height, x : x + width, :3]
    return page


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--at", action="append", metavar="X,Y", help="centre of a crop; may be repeated")
    parser.add_argument(
        "--size", default="420x300", metavar="WxH", help="size of a crop (default: %(default)s)"
    )
    parser.add_argument("--count", type=int, default=2, help="how many places, without --at (default: 2)")
    parser.add_argument(
        "--output", type=Path, default=RESULT, help="the picture (default: docs/before-after.jpg)"
    )
    options = parser.parse_args()
    width, height = (int(number) for number in options.size.split("x"))
    with tempfile.TemporaryDirectory() as folder:
        before, after = make_panoramas(Path(folder))
    if options.at:
        centres = [tuple(map(int, place.split(","))) for place in options.at]
        limits = after.shape[1] - width, after.shape[0] - height
        places = [
            (min(max(x - width // 2, 0), limits[0]), min(max(y - height // 2, 0), limits[1]))
            for x, y in centres
        ]
    else:
        places = find_places(before, after, width, height, options.count)
    page = side_by_side(before, after, places, width, height)
    if not cv2.imwrite(str(options.output), page[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92]):
        raise SystemExit(f"{options.output}: cannot be written")
    print(f"{options.output}: crops around", *(f"{x + width // 2},{y + height // 2}" for x, y in places))


if __name__ == "__main__":
    main()

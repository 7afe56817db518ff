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

from hugin_abflow import merge_project, read_layer
from hugin_abflow.layer import Layer

Picture = npt.NDArray[np.uint8]
Place = tuple[int, int]  # x, y in pixels of the panorama

ROOM = Path(__file__).resolve().parent.parent / "sample_projects" / "room"
RESULT = Path(__file__).resolve().parent / "before-after.jpg"
NEIGHBOURHOOD = 41  # pixels across in which a break is looked for
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


def layer_files() -> list[Path]:
    return sorted(ROOM.glob("room[0-9][0-9][0-9][0-9].tif"))


def make_panoramas(folder: Path) -> tuple[Picture, Picture]:
    """The sample blended by enblend and by us, as photographers would run them."""
    before, after = folder / "enblend.tif", folder / "abflow.tif"
    merge_project(ROOM / "room.pto", prefix="room", output=after)
    size = f"-f{read_rgba(after).shape[1]}x{read_rgba(after).shape[0]}"
    subprocess.run(
        ["enblend", "-w", size, "-o", before, "--", *layer_files()], check=True, capture_output=True
    )
    return read_rgba(before), read_rgba(after)


def find_places(before: Picture, layers: list[Layer], width: int, height: int, count: int) -> list[Place]:
    """Upper left corners of `count` crops around the worst breaks of `before`, none touching another.

    A break: a neighbourhood of which no single layer shows all, and which so was put together from
    layers that disagree.
    """
    least = np.full(before.shape[:2], np.inf)
    for layer in layers:
        box = layer.box
        pixels = layer.read(0, box.height).astype(np.float32)
        difference = np.full(before.shape[:2], 255.0, np.float32)  # where the layer shows nothing
        covered = np.abs(before[box.top : box.bottom, box.left : box.right, :3] - pixels[..., :3]).mean(
            axis=2
        )
        difference[box.top : box.bottom, box.left : box.right] = np.where(pixels[..., 3] > 127, covered, 255)
        least = np.minimum(least, cv2.blur(difference, (NEIGHBOURHOOD, NEIGHBOURHOOD)))
    # Towards the poles pixels are stretched: what looks big there is small.
    rows = (np.arange(len(least)) + 0.5) / len(least)
    least *= np.sin(rows * np.pi)[:, None] ** 2
    places: list[Place] = []
    for _ in range(count):
        y, x = np.unravel_index(np.argmax(least), least.shape)
        places.append(corner(int(x), int(y), width, height, before))
        least[max(0, y - height) : y + height, max(0, x - width) : x + width] = 0
    return places


def corner(x: int, y: int, width: int, height: int, picture: Picture) -> Place:
    """The upper left corner of a crop around (x, y) that lies inside the picture."""
    left = min(max(x - width // 2, 0), picture.shape[1] - width)
    return left, min(max(y - height // 2, 0), picture.shape[0] - height)


def side_by_side(before: Picture, after: Picture, places: list[Place], width: int, height: int) -> Picture:
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
        "--size", default="380x240", metavar="WxH", help="size of a crop (default: %(default)s)"
    )
    parser.add_argument("--count", type=int, default=3, help="how many places, without --at (default: 3)")
    parser.add_argument(
        "--output", type=Path, default=RESULT, help="the picture (default: docs/before-after.jpg)"
    )
    options = parser.parse_args()
    width, height = (int(number) for number in options.size.split("x"))
    with tempfile.TemporaryDirectory() as folder:
        before, after = make_panoramas(Path(folder))
    if options.at:
        centres = [tuple(map(int, place.split(","))) for place in options.at]
        places = [corner(x, y, width, height, after) for x, y in centres]
    else:
        layers = [read_layer(path) for path in layer_files()]
        places = find_places(before, layers, width, height, options.count)
    page = side_by_side(before, after, places, width, height)
    if not cv2.imwrite(str(options.output), page[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92]):
        raise SystemExit(f"{options.output}: cannot be written")
    print(f"{options.output}: crops around", *(f"{x + width // 2},{y + height // 2}" for x, y in places))


if __name__ == "__main__":
    main()

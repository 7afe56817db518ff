"""The least that a blender can take: ``python benchmarks/floor.py RESULT.npy OUTPUT.tif LAYER...``

Decodes the layers twice (a stream looks at them at working resolution first) and encodes a result that is at
hand, with hugin-abflow's libraries and threads and nothing in between. `speed.py` runs it.
"""

from __future__ import annotations

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from hugin_abflow.images import ImageWriter, read_layer

ROWS = 64


def decode(path: str) -> None:
    """All rows of a layer, none kept."""
    layer = read_layer(path)
    for top in range(0, layer.box.height, ROWS):
        layer.read(top, min(top + ROWS, layer.box.height))


def encode(pixels: np.ndarray, path: str) -> None:
    """Pixels (height, width, channels + 1) to a file, as panoramas are written."""
    height, width, samples = pixels.shape
    with ImageWriter(path, width, height, samples - 1, pixels.dtype) as writer:
        for top in range(0, height, ROWS):
            writer.write_rows(pixels[top : top + ROWS])


def main() -> None:
    """The command line."""
    result, output, *layers = sys.argv[1:]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(decode, layers))
        # the full pass decodes while the bands before are encoded
        encoded = pool.submit(encode, np.load(result, mmap_mode="r"), output)
        list(pool.map(decode, layers))
        encoded.result()


if __name__ == "__main__":
    main()

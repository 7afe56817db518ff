"""Strips of TIFF files in compressions that OpenImageIO's wheels are built without.

With tifffile and imagecodecs, as `tiffwriter`, which writes zstd.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hugin_abflow.errors import ImageReadError

COMPRESSIONS = {50000: "zstd", 34925: "lzma"}  # by TIFF's number


def read_strips(path: Path, page: int, first: int, last: int) -> npt.NDArray[Any]:
    """Rows `first` to `last` of a page: (last - first, width, samples), in the machine's byte order.

    Samples lie side by side (TIFF's PlanarConfiguration 1), rows in strips, not tiles; strips are decoded
    whole. Raises `ImageReadError` for a file that is broken.
    """
    import tifffile  # takes a while to load

    try:
        with tifffile.TiffFile(path) as file:
            found = file.pages[page]
            step = found.rowsperstrip
            strips = []
            for index in range(first // step, -(-last // step)):
                file.filehandle.seek(found.dataoffsets[index])
                encoded = file.filehandle.read(found.databytecounts[index])
                decoded = found.decode(encoded, index)[0]
                strips.append(decoded[0])  # of one depth
    except (OSError, RuntimeError, ValueError, LookupError, TypeError, struct.error) as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise ImageReadError(f"{path} cannot be read ({reason}); make the layer again") from None
    rows = np.concatenate(strips)[first % step :][: last - first]
    return rows.astype(rows.dtype.newbyteorder("="), copy=False)

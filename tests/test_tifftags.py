"""What tags of TIFF files tell of a layer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from layer_files import FULL_WIDTH, RATIONAL, X_POSITION, Y_POSITION

from hugin_abflow.errors import ImageReadError
from hugin_abflow.images import read_layers

_FLOAT = 11


@pytest.mark.parametrize(
    ("tag", "kind", "value", "said"),
    [
        (X_POSITION, RATIONAL, (4_000_000_000, 1), "XPosition tells 6e+11 pixels"),
        (Y_POSITION, _FLOAT, -70_000.0, "YPosition tells -10500000 pixels"),
        (X_POSITION, _FLOAT, float("nan"), "XPosition tells nan pixels"),
        (Y_POSITION, _FLOAT, float("inf"), "YPosition tells inf pixels"),
        (FULL_WIDTH, _FLOAT, float("nan"), "ImageFullWidth tells nan pixels"),
    ],
)
def test_places_that_cannot_be_name_the_layer_and_the_tag(
    tmp_path: Path, tag: int, kind: int, value: Any, said: str
) -> None:
    """They ended in an error about the panorama, or about what Python does."""
    path = tmp_path / "a.tif"
    tifffile.imwrite(
        path, np.zeros((9, 9, 4), np.uint8), photometric="rgb", extrasamples=["unassalpha"],
        resolution=(150, 150), extratags=[(tag, kind, 1, value, True)],
    )  # fmt: skip
    with pytest.raises(ImageReadError) as error:
        read_layers(path)
    assert f"{path}: its tag {said}; make the layer again" in str(error.value)

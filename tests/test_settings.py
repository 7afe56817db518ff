"""The engine's settings: what they take, and what they refuse."""

from __future__ import annotations

import numpy as np
import pytest

from hugin_abflow.errors import SettingsError
from hugin_abflow.settings import MOST_WORKING_PIXELS, Settings


@pytest.mark.parametrize(
    "values",
    [
        {"softmax_sharpness": "10"},
        {"softmax_sharpness": True},
        {"softmax_sharpness": None},
        {"softmax_sharpness": float("nan")},
        {"softmax_sharpness": np.ones(2)},
        {"flow_magnitude": 1j},
        {"flow_magnitude": float("inf")},
        {"working_pixels": 2e6},
        {"threads": "1"},
        {"band_rows": False},
        {"merge": ["joint"]},
        {"merge": np.array(["joint", "joint"])},
        {"interpolation": None},
        {"flow_quality": 2},
        {"exposure": 1},
        {"seam": "auto"},
        {"flow": "off"},
        {"guides": "off"},
        {"large_motion": True},
        {"exposure": "auto"},
        {"device": 0},
    ],
)
def test_settings_of_a_wrong_type(values):
    with pytest.raises(SettingsError, match=next(iter(values))):
        Settings(**values)


def test_numbers_become_what_kernels_take():
    """An integer's bits would be read as those of a tiny float."""
    settings = Settings(softmax_sharpness=np.float32(3), flow_magnitude=7, working_pixels=np.int64(5000))
    numbers = settings.softmax_sharpness, settings.flow_magnitude, settings.working_pixels
    assert numbers == (3, 7, 5000) and list(map(type, numbers)) == [float, float, int]


@pytest.mark.parametrize(
    "values",
    [
        {"softmax_sharpness": -1},
        {"flow_magnitude": 1e5},
        {"working_pixels": 1},
        {"working_pixels": MOST_WORKING_PIXELS + 1},
        {"flow_magnitude": float("nan")},
        {"band_rows": -1},
        {"merge": "average"},
        {"interpolation": "sinc"},
        {"flow_quality": "better"},
    ],
)
def test_settings_out_of_range(values):
    with pytest.raises(SettingsError, match=next(iter(values))):
        Settings(**values)

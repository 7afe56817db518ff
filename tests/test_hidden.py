"""What of layers nobody sees: the kernel against its twin."""

from __future__ import annotations

import numpy as np
import pytest
from bands import field_of
from grids import sphere
from reference import hidden as twin
from tolerances import SUM, assert_close

from hugin_abflow import hidden
from hugin_abflow.opencl import Device


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_what_is_hidden_equals_its_twin(device: Device, share: float) -> None:
    """Fields of parts of the grid; small weights turn negative, within the part that is asked for."""
    grid = sphere().resized(48, 25)
    boxes = [(2, 0, 31, 24), (0, 3, 48, 9), (40, 20, 5, 4)]
    fields = [field_of(7 + i, grid, box, 1.5) for i, box in enumerate(boxes)]
    fields[2][..., 3] = -1e30  # one that shall not be seen anywhere
    begins = np.cumsum([0, *(field.size // 4 for field in fields)])
    places = np.array([(*box, begin, 0, 0, 0) for box, begin in zip(boxes, begins, strict=False)], np.int32)
    packed = device.upload(np.concatenate([field.reshape(-1, 4) for field in fields]))
    hidden.mark(device, packed, places, (3, 5, 42, 16), share)
    expected = []
    for field, whole, box in zip(fields, twin.hidden_mark(fields, boxes, share), boxes, strict=True):
        rows, columns = np.indices(field.shape[:2])
        rows, columns = rows + box[1], columns + box[0]
        within = (rows >= 5) & (rows < 21) & (columns >= 3) & (columns < 45)
        expected.append(np.where(within[..., None], whole, field))
    for found, wanted in zip(np.split(packed.get(), begins[1:-1]), expected, strict=True):
        assert_close(found.reshape(wanted.shape), wanted, SUM)
    assert any((field[..., 3] < 0).any() for field in expected[:2]) == (share > 0)


def test_rows_are_marked_to_their_end(device: Device) -> None:
    """Of a width that no work-group divides."""
    box = 0, 0, 2051, 1
    fields = device.upload(np.ones((2051, 4), np.float32))
    hidden.mark(device, fields, np.array([(*box, 0, 0, 0, 0)], np.int32), box, 0.5)
    assert (fields.get()[:, 3] == 0.75).all()

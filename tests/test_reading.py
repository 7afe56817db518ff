"""All layers on the working grid: by all cores, in an order that is not the caller's, within the memory."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from pictures import noise

from hugin_abflow import reading, working
from hugin_abflow.errors import ImageReadError
from hugin_abflow.grid import Grid, full_grid
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.opencl import Device
from hugin_abflow.progress import Advance, silent
from hugin_abflow.settings import Settings
from hugin_abflow.working import WorkingLayer

CANVAS = Canvas.plane(123, 301)


def stripped(seed: int, left: int = 0, width: int = 77) -> Layer:
    """A layer in memory that is read as a file of strips."""
    pixels = noise(301, width, seed=seed)
    return replace(Layer.from_array(f"layer {seed}", pixels, left), strip=8)


def grid_of(layers: list[Layer]) -> Grid:
    return full_grid(CANVAS, layers).resized(41, 97)


def rows_at_a_time(monkeypatch: pytest.MonkeyPatch, rows: int) -> None:
    """On processors and cards alike."""
    for name in ("_ROWS", "_ROWS_FOR_CARD"):
        monkeypatch.setattr(working, name, rows)


def read(device: Device, layers: list[Layer], **settings: int) -> list[WorkingLayer]:
    return reading.read(device, layers, grid_of(layers), silent, Settings(**settings))


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_layers_do_not_depend_on_threads_nor_on_their_order(device: Device, threads: int) -> None:
    """Also where three lie on one place."""
    layers = [stripped(1), stripped(2), stripped(3), stripped(4, left=46)]
    expected = [working.reduce_layer(device, one, grid_of(layers), lambda rows: None) for one in layers]
    pixels = {one.layer.name: one.pixels.get() for one in expected}
    names = None
    for order in list(permutations(layers))[::5]:
        found = read(device, list(order), threads=threads)
        names = names or [one.layer.name for one in found]
        assert [one.layer.name for one in found] == names
        assert names[-1] == "layer 4"
        assert all(np.array_equal(one.pixels.get(), pixels[one.layer.name]) for one in found)
    order_of_checksums = [one.checksum for one in sorted(expected[:3], key=lambda one: one.checksum)]
    assert order_of_checksums == [one.checksum for one in found[:3]]


def test_checksums_do_not_depend_on_how_many_rows_are_read_at_a_time(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A graphics card's layers have the same order."""
    layers, found = [stripped(1), stripped(2)], []
    for rows in (7, 64, 1000):
        rows_at_a_time(monkeypatch, rows)
        found.append([one.checksum for one in read(device, layers)])
    assert found[0] == found[1] == found[2]


def test_no_more_threads_than_memory_holds_rows_for(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    rows_at_a_time(monkeypatch, 16)
    layers, row = [stripped(1), stripped(2)], 77 * 4
    for strip, rows in ((8, 24), (32, 48)):
        several = [replace(one, strip=strip) for one in layers]
        for threads in (1, 3, 8):
            limit = threads * 4 * rows * row * 4
            assert reading._threads(device, several, Settings(threads=8, max_memory=limit)) == threads
            assert reading._threads(device, several, Settings(threads=2, max_memory=limit)) == min(threads, 2)
    assert reading._threads(device, layers, Settings(threads=8, max_memory=1)) == 1


def test_two_threads_read_one_layer(device: Device) -> None:
    both, met = threading.Barrier(2, timeout=60), threading.Event()
    layer = stripped(1)

    def rows(top: int, bottom: int) -> np.ndarray:
        if not met.is_set():
            both.wait()  # forever, if one thread read all parts
            met.set()
        return layer.read(top, bottom)

    (found,) = read(device, [replace(layer, read=rows)], threads=2)
    assert found.pixels.get()[..., 3].all()


def test_where_layers_are_as_many_as_cores_each_is_one_part(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of many layers few are open at a time."""
    asked = list[int]()
    parts = working.Reduction.parts
    monkeypatch.setattr(
        reading.Reduction, "parts", lambda self, count: asked.append(count) or parts(self, count)
    )
    layers = [stripped(1), stripped(2), stripped(3)]
    for threads in (1, 2, 3, 4):
        read(device, layers, threads=threads)
    assert asked == [1] * 9 + [6] * 3


def test_every_row_is_counted_once(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    rows_at_a_time(monkeypatch, 64)
    told = list[int]()

    @contextmanager
    def progress(name: str, total: int) -> Iterator[Advance]:
        assert (name, total) == ("read", 602)
        yield told.append

    layers = [stripped(1), stripped(4, left=46)]
    reading.read(device, layers, grid_of(layers), progress, Settings(threads=3))
    assert sum(told) == 602 and len(told) > 4


def test_what_cannot_be_decoded_is_told(device: Device, caplog: pytest.LogCaptureFixture) -> None:
    def broken(top: int, bottom: int) -> np.ndarray:
        raise ImageReadError("b.tif cannot be read")

    layers = [stripped(1), replace(stripped(2), read=broken), stripped(3)]
    with caplog.at_level(logging.WARNING), pytest.raises(ImageReadError, match=r"b\.tif"):
        read(device, layers, threads=2)
    assert not caplog.records

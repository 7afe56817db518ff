"""Decoded rows, kept from one reading to the next: the same rows, decoded once, and nothing depends on it."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import psutil
import pytest
from conftest import DTYPES, names_in
from hypothesis import given
from hypothesis import strategies as st
from pictures import noise

from hugin_abflow import joint, memory, merge, scratch, spool
from hugin_abflow.layer import Canvas, Layer
from hugin_abflow.merge import merge_layers
from hugin_abflow.opencl import Device
from hugin_abflow.progress import silent
from hugin_abflow.settings import MergeMode, Settings
from hugin_abflow.spool import spooled

HEIGHT, WIDTH = 13, 7
PLENTY = 1 << 40

pytestmark = pytest.mark.skipif(not hasattr(os, "preadv"), reason="what is tested needs preadv")


@pytest.fixture(autouse=True)
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(memory, "unused", lambda: PLENTY)
    return tmp_path


def counted(name: str = "a", dtype: npt.DTypeLike = np.uint8, seed: int = 0) -> tuple[Layer, list[int]]:
    """A layer that is compressed in its file, as it says, and how often each of its rows was decoded."""
    pixels = np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 4)).astype(dtype)
    return counting(Layer.from_array(name, pixels))


def counting(layer: Layer) -> tuple[Layer, list[int]]:
    times = [0] * layer.box.height

    def read(top: int, bottom: int) -> npt.NDArray[Any]:
        for row in range(top, bottom):
            times[row] += 1
        return layer.read(top, bottom)

    return replace(layer, read=read, compressed=True), times


@pytest.mark.parametrize("dtype", DTYPES)
def test_rows_are_decoded_once_and_stay_the_same(dtype: npt.DTypeLike) -> None:
    (a, times_a), (b, times_b) = counted("a", dtype, 1), counted("b", dtype, 2)
    want = a.read(0, HEIGHT), b.read(0, HEIGHT)
    with spooled([a, b]) as kept:
        for _ in range(2):
            for layer, pixels in zip(kept, want, strict=True):
                for top in range(0, HEIGHT, 5):
                    rows = layer.read(top, min(top + 5, HEIGHT))
                    assert rows.dtype == pixels.dtype
                    np.testing.assert_array_equal(rows, pixels[top : top + 5])
    assert times_a == times_b == [2] * HEIGHT  # with `want`


def sparse() -> Layer:
    """Nothing in its upper rows, then in the middle of wide rows, then on both sides, then but one value."""
    pixels = np.zeros((HEIGHT, 9 * spool._GAP, 4), np.uint8)
    noise = np.random.default_rng(3).integers(0, 256, pixels.shape)
    pixels[3:7, 1000:1300] = noise[3:7, 1000:1300]
    pixels[6:9, :77], pixels[6:9, -91:] = noise[6:9, :77], noise[6:9, -91:]
    pixels[10, 500, 1] = 1  # transparent, and not black
    return Layer.from_array("sparse", pixels)


@pytest.mark.parametrize("step", [1, 4, HEIGHT])
def test_zeros_take_no_room(monkeypatch: pytest.MonkeyPatch, step: int) -> None:
    write, written = os.pwrite, [0]

    def pwrite(file: int, rows: memoryview, place: int) -> int:
        written[0] += rows.nbytes
        return write(file, rows, place)

    monkeypatch.setattr(os, "pwrite", pwrite)
    layer, times = counting(sparse())
    want = sparse().read(0, HEIGHT)
    with spooled([layer]) as (kept,):
        for first in range(0, HEIGHT, step):
            kept.read(first, min(first + step, HEIGHT))
        assert 0 < written[0] < (HEIGHT * (300 + 77 + 91 + 2 * spool._GAP)) * 4
        for top, bottom in ((0, HEIGHT), (5, 11), (7, 8), (0, 3)):
            np.testing.assert_array_equal(kept.read(top, bottom), want[top:bottom])
    assert times == [1] * HEIGHT


@given(
    st.lists(
        st.tuples(st.integers(0, HEIGHT), st.integers(0, HEIGHT)).map(lambda span: tuple(sorted(span))),
        max_size=12,
    )
)
def test_rows_are_right_in_any_order(spans: list[tuple[int, int]]) -> None:
    for want in (counted()[0], sparse()):
        layer, times = counting(want)
        with spooled([layer]) as (kept,):
            for top, bottom in spans:
                np.testing.assert_array_equal(kept.read(top, bottom), want.read(top, bottom))
            for row in range(HEIGHT):
                np.testing.assert_array_equal(kept.read(row, row + 1), want.read(row, row + 1))
            before = list(times)
            np.testing.assert_array_equal(kept.read(0, HEIGHT), want.read(0, HEIGHT))
        assert times == before


def test_errors_of_the_layer_are_its_own() -> None:
    layer, _ = counted()

    def read(top: int, bottom: int) -> npt.NDArray[Any]:
        raise IndexError(f"rows {top}..{bottom}")

    with spooled([replace(layer, read=read)]) as (kept,), pytest.raises(IndexError, match=r"rows 5\.\.99"):
        kept.read(5, 99)


def test_what_is_not_compressed_is_left_as_it_is() -> None:
    layer = Layer.from_array("a", np.zeros((3, 5, 4), np.uint8))
    with spooled([layer]) as kept:
        assert kept == [layer]


@pytest.mark.parametrize("scarce", ["memory", "disk"])
def test_what_does_not_fit_is_left_as_it_is(monkeypatch: pytest.MonkeyPatch, scarce: str) -> None:
    layers = [counted(name)[0] for name in "abc"]
    room = spool._SHARE * (2 * WIDTH * HEIGHT * 4 + 1)  # for two of them
    if scarce == "memory":
        monkeypatch.setattr(memory, "unused", lambda: room)
    else:
        monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=room))
    with spooled(layers) as kept:
        assert [a is b for a, b in zip(kept, layers, strict=True)] == [False, False, True]


def full_disk(file: int, rows: memoryview, place: int) -> int:
    raise OSError(errno.ENOSPC, "no space left")


def nearly_full_disk(
    write: Callable[[int, Any, int], int], left: int = 2 * WIDTH * 4 + 5
) -> Callable[[int, memoryview, int], int]:
    return lambda file, rows, place: write(file, rows[:left], place)


@pytest.mark.parametrize("left", [0, 2])
def test_a_full_disk_costs_time_alone(monkeypatch: pytest.MonkeyPatch, left: int) -> None:
    layer, times = counted()
    want = Layer.from_array("a", layer.read(0, HEIGHT)).read
    monkeypatch.setattr(os, "pwrite", nearly_full_disk(os.pwrite) if left else full_disk)
    with spooled([layer]) as (kept,):
        for _ in range(2):
            np.testing.assert_array_equal(kept.read(0, 9), want(0, 9))
    assert times[:9] == [3] * 9  # `want` has read them, too


@pytest.mark.parametrize("left", [0, 2 * WIDTH * 4 + 5])
def test_what_was_not_written_is_not_recalled(monkeypatch: pytest.MonkeyPatch, left: int) -> None:
    """The file goes on behind the layer, so that what is missing would be zeros."""
    (a, _), (b, _) = counted("a"), counted("b", seed=1)
    want, write = a.read(0, HEIGHT), os.pwrite
    with spooled([a, b]) as (first, second):
        second.read(0, HEIGHT)
        monkeypatch.setattr(os, "pwrite", nearly_full_disk(write, left) if left else full_disk)
        first.read(0, HEIGHT)
        for row in range(HEIGHT):
            np.testing.assert_array_equal(first.read(row, row + 1), want[row : row + 1])


@pytest.mark.parametrize("failure", ["error", "short"])
def test_a_disk_that_fails_costs_time_alone(monkeypatch: pytest.MonkeyPatch, failure: str) -> None:
    layer, times = counted()

    def preadv(file: int, buffers: list[memoryview], place: int) -> int:
        if failure == "error":
            raise OSError(errno.EIO, "input/output error")
        return 3

    with spooled([layer]) as (kept,):
        first = kept.read(0, HEIGHT)
        monkeypatch.setattr(os, "preadv", preadv)
        np.testing.assert_array_equal(kept.read(0, HEIGHT), first)
    assert times == [2] * HEIGHT


def test_no_folder_is_no_error(monkeypatch: pytest.MonkeyPatch, root: Path) -> None:
    monkeypatch.setattr(scratch, "root", lambda: root / "gone")
    layer, _ = counted()
    with spooled([layer]) as kept:
        assert kept == [layer]


def test_nothing_is_left(root: Path) -> None:
    before = psutil.Process().num_fds()
    layer, _ = counted()
    with pytest.raises(KeyboardInterrupt), spooled([layer]) as (kept,):
        kept.read(0, HEIGHT)
        raise KeyboardInterrupt
    assert names_in(root) == [] and psutil.Process().num_fds() == before


@pytest.mark.parametrize("mode", ["joint", "sequential"])
def test_a_panorama_is_the_same_of_layers_decoded_once(mode: MergeMode) -> None:
    canvas = Canvas.plane(151, 103)
    layers = [Layer.from_array(name, noise(103, 97, seed=left), left) for name, left in (("a", 0), ("b", 54))]
    settings = Settings(merge=mode, band_rows=7)
    pairs = [counting(layer) for layer in layers]
    np.testing.assert_array_equal(
        merge_layers([layer for layer, _ in pairs], canvas, settings), merge_layers(layers, canvas, settings)
    )
    assert all(times == [1] * layer.box.height for layer, times in pairs)


def test_the_file_is_there_until_nobody_reads_layers(monkeypatch: pytest.MonkeyPatch) -> None:
    layer, times = counted()
    again = []

    def bands(device: Device, layers: Sequence[Layer], *_: object) -> Generator[npt.NDArray[Any], None, None]:
        try:
            yield layers[0].read(0, HEIGHT)
        finally:
            again.append(layers[0].read(0, HEIGHT))

    monkeypatch.setattr(joint, "merge", bands)
    rows = merge._bands([layer], Canvas.plane(WIDTH, HEIGHT), Settings(), silent, ())
    first = next(rows)
    rows.close()
    np.testing.assert_array_equal(first, again[0])
    assert times == [1] * HEIGHT


def test_the_number_of_the_file_is_not_used_afterwards(root: Path) -> None:
    """Threads may live on; then another file has it."""
    layer, times = counted()
    want = layer.read(0, HEIGHT)
    with spooled([layer]) as (kept,):
        kept.read(0, 5)
    with (root / "other").open("w+b") as other:
        for _ in range(2):
            np.testing.assert_array_equal(kept.read(0, HEIGHT), want)
        assert other.seek(0, os.SEEK_END) == 0
    assert times == [4] * 5 + [3] * (HEIGHT - 5)

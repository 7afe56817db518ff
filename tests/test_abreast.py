"""Pieces of work side by side on one device."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from hugin_abflow import trace
from hugin_abflow.abreast import side_by_side
from hugin_abflow.lane import StoppedError
from hugin_abflow.opencl import Device


def piece(device: Device, number: int, turn: threading.Barrier | None = None) -> np.ndarray:
    """Its number, after a while on the device."""
    if turn:
        turn.wait(60)
    values = device.empty((300, 300)).fill(number)
    copies = [values]
    for _ in range(10):
        copies.append(device.copy(copies[-1]))
    return copies[-1].get()


@pytest.mark.parametrize("lanes", [1, 2, 3])
def test_all_give_what_they_find_in_their_order(device: Device, lanes: int) -> None:
    found = list(side_by_side(device, [partial(piece, device, k) for k in range(17)], lanes))
    assert all((values == k).all() for k, values in enumerate(found)) and len(found) == 17


def test_so_many_are_worked_on_at_a_time(device: Device) -> None:
    """Each waits until all others have begun."""
    turn = threading.Barrier(3)
    assert len(list(side_by_side(device, [partial(piece, device, k, turn) for k in range(6)], 3))) == 6


def test_all_may_use_what_was_made_before(device: Device) -> None:
    values = device.zeros((1000, 1000))
    for k in range(200):
        values.fill(k)
    found = list(side_by_side(device, [lambda: device.copy(values).get()] * 4, 2))
    assert all((one == 199).all() for one in found)


def _until_stopped(device: Device, begun: threading.Event, ended: list[BaseException]) -> None:
    image = device.zeros((8, 8))
    outs = [device.empty((4, 4)) for _ in range(2)]
    try:
        for _ in range(1_000_000):
            device.run("pyramid", "pyramid_reduce", (4, 4), image, image, (8, 8, 0, 0), *outs, (4, 4))
            begun.set()
    except BaseException as error:
        ended.append(error)
        raise


def _fail(begun: threading.Event) -> None:
    """Where another has begun."""
    assert begun.wait(60)
    raise OSError("mine")


def test_where_one_fails_the_others_are_stopped_or_left(device: Device) -> None:
    begun, ended, left = threading.Event(), list[BaseException](), list[int]()

    def wait(number: int) -> None:
        left.append(number)
        time.sleep(0.05)

    work: list[Callable[[], None]] = [partial(_fail, begun), partial(_until_stopped, device, begun, ended)]
    work += [partial(wait, k) for k in range(100)]
    with pytest.raises(OSError, match="mine"):
        list(side_by_side(device, work, 2))
    assert [type(error) for error in ended] == [StoppedError] and not left


def test_what_fails_first_is_told_at_once(device: Device) -> None:
    """Not when its turn comes; that others were stopped for it is nothing to tell."""
    begun, ended, late = threading.Event(), list[BaseException](), list[int]()
    work: list[Callable[[], None]] = [partial(_until_stopped, device, begun, ended), partial(_fail, begun)]
    work += [partial(late.append, k) for k in range(5)]
    with pytest.raises(OSError, match="mine") as told:
        list(side_by_side(device, work, 2))
    assert [type(error) for error in ended] == [StoppedError] and not late
    assert told.value.__suppress_context__


def test_one_at_a_time_is_done_here(device: Device) -> None:
    """Where no second queue can be had, as well."""
    places = list(side_by_side(device, [lambda: (threading.current_thread(), device.current)] * 3, 1))
    assert places == [(threading.current_thread(), device.current)] * 3


def test_where_nobody_wants_more_they_are_stopped(device: Device) -> None:
    """As with Ctrl-C while one of them is looked at."""
    begun, ended = threading.Event(), list[BaseException]()
    work: list[Callable[[], object]] = [lambda: begun.wait(60), partial(_until_stopped, device, begun, ended)]
    with closing(side_by_side(device, work, 2)) as found:
        assert next(found)
    assert [type(error) for error in ended] == [StoppedError]


def test_each_lane_is_told_apart_in_a_trace(tmp_path: Path) -> None:
    """One after the other in each: a viewer shows nothing else of one track."""
    with trace.collecting() as collected:
        device, turn = Device(), threading.Barrier(2)
        list(side_by_side(device, [partial(piece, device, k, turn) for k in range(4)], 2))
        events = collected()
    names = {event["tid"]: event["args"]["name"] for event in events if event["ph"] == "M"}
    done = [(names[one["tid"]], one["ts"], one["ts"] + one["dur"]) for one in events if one["ph"] == "X"]
    assert {lane for lane, _, _ in done} == {"device 2", "device 3"} and len(done) == 44
    for lane in ("device 2", "device 3"):
        spans = sorted((start, end) for name, start, end in done if name == lane)
        assert all(end <= start + 1 for (_, end), (start, _) in pairwise(spans))

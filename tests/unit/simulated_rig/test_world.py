"""Clocks, and the record of what the projector showed when."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from simulated_rig.light import Lamp, LightTable, VirtualClock, nanoseconds
from slrig.devices import SystemClock


def table(level: float) -> LightTable:
    return LightTable(np.full(4, level, np.float32), np.ones(4, np.float32), 0)


DARK, RED, BLUE = table(0.0), table(0.5), table(1.0)


def test_virtual_time_passes_only_by_waiting() -> None:
    clock, stop = VirtualClock(100), threading.Event()
    assert clock.now_ns() == clock.now_ns() == 100
    clock.wait_until(5_000_000_000_000, stop)
    assert clock.now_ns() == 5_000_000_000_000
    clock.wait_until(7, stop)
    assert clock.now_ns() == 5_000_000_000_000


def test_virtual_time_stands_still_for_a_stopped_device() -> None:
    clock, stop = VirtualClock(100), threading.Event()
    stop.set()
    clock.wait_until(200, stop)
    assert clock.now_ns() == 100


def test_real_time_is_waited_for() -> None:
    clock, stop = SystemClock(), threading.Event()
    until = time.monotonic_ns() + 2_000_000
    clock.wait_until(until, stop)
    assert time.monotonic_ns() >= until


def test_real_waiting_ends_when_the_device_is_stopped() -> None:
    clock, stop = SystemClock(), threading.Event()
    waiter = threading.Thread(target=clock.wait_until, args=(time.monotonic_ns() + nanoseconds(600), stop))
    waiter.start()
    stop.set()
    waiter.join(timeout=10)
    assert not waiter.is_alive()


def test_the_lamp_remembers_what_it_showed() -> None:
    lamp = Lamp(DARK)
    assert lamp.light_at(5) is DARK
    lamp.show(RED, at_ns=100)
    lamp.show(BLUE, at_ns=200)
    assert [lamp.light_at(t) for t in (99, 100, 199, 200, 10**15)] == [DARK, RED, RED, BLUE, BLUE]


def test_an_exposure_across_changes_sees_each_light_for_its_share() -> None:
    lamp = Lamp(DARK)
    lamp.show(RED, at_ns=100)
    lamp.show(BLUE, at_ns=200)
    shares = lamp.light_between(60, 260)
    assert [light for _, light in shares] == [DARK, RED, BLUE]
    assert [share for share, _ in shares] == pytest.approx([0.2, 0.5, 0.3])
    assert lamp.light_between(120, 180) == [(1.0, RED)]
    assert lamp.light_between(200, 300) == [(1.0, BLUE)]
    assert lamp.light_between(150, 150) == [(1.0, RED)]


def test_a_later_order_never_comes_before_an_earlier_one() -> None:
    lamp = Lamp(DARK)
    lamp.show(RED, at_ns=300)
    assert lamp.show(BLUE, at_ns=200) == 300
    assert lamp.light_at(299) is DARK
    assert lamp.light_at(300) is BLUE


def test_darkening_takes_back_what_was_still_to_come() -> None:
    lamp = Lamp(DARK)
    lamp.show(RED, at_ns=100)
    lamp.show(BLUE, at_ns=500)
    lamp.darken(at_ns=300)
    assert [lamp.light_at(t) for t in (299, 300, 600)] == [RED, DARK, DARK]

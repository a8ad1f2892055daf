"""The serial projector and its box against bad lines, restarts and dying hosts."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from itertools import groupby
from pathlib import Path
from typing import cast

import pytest

from drivers.serial_projector import open_projector
from drivers.serial_projector.projector import SerialProjector
from slrig.errors import DeviceGoneError
from tests.unit.drivers.serial_projector.conftest import SEQUENCE, Bench
from tests.unit.drivers.serial_projector.line import Line, Noise

ROOT = Path(__file__).resolve().parents[2]
LOSS = CORRUPTION = 0.08
LONG_S = 30.0
SLACK_S = 0.2
"""How late a box's program may come to its watchdog on a machine that is busy with other tests."""


@dataclass
class Tallied:
    """What happened in all sessions."""

    exact: int = 0
    restarts: int = 0
    reopened: int = 0
    again: int = 0
    lost: int = 0
    damaged: int = 0
    wrong: list[str] = field(default_factory=list)

    def __add__(self, other: Tallied) -> Tallied:
        return Tallied(*(getattr(self, each.name) + getattr(other, each.name) for each in fields(self)))


def played_session(seed: int) -> Tallied:
    """Open, load, show every pattern, close, over a bad line, with a box that restarts once; judge what was lit."""
    rng, tallied = random.Random(seed), Tallied()
    # At any of the 37 commands that a session has at least, obeyed or not before its answer could leave.
    restart_at, obeyed_first = rng.randint(1, 37), rng.random() < 0.5

    def on_command(line: Line, count: int, data: bytes) -> bool:
        if count != restart_at:
            return True
        tallied.restarts += 1
        if obeyed_first:
            line.engine.feed(data)
        line.restart()
        return False

    noise = Noise(LOSS, CORRUPTION, seed)
    box = Bench(drift=rng.uniform(-1e-4, 1e-4), noise=noise, on_command=on_command)
    projector, index = box.loaded(), 0
    while index < len(SEQUENCE):
        try:
            assert projector.show(index).index == index
            index += 1
        except DeviceGoneError:
            # As a person does: open the rig again, and ask for the same pattern again.
            tallied.reopened += 1
            projector.close()
            projector = box.loaded()
    tallied.again += projector.client.link.tally.again
    box.close()
    tallied.lost, tallied.damaged = noise.lost, noise.damaged
    order, twice = [], 0
    for pattern, shows in groupby(box.scene.shown, key=lambda each: each[0]):
        boots = [boot for _, boot in shows]
        order.append(pattern)
        twice += len(boots) - len(set(boots))
    if order == list(range(len(SEQUENCE))) and not twice and box.lit is None:
        tallied.exact += 1
    else:
        tallied.wrong.append(f"session {seed}: {box.scene.shown}")
    return tallied


@pytest.mark.parametrize("sessions", [16, pytest.param(500, marks=pytest.mark.slow)])
def test_sessions_over_a_bad_line_are_exact(sessions: int) -> None:
    tallied = sum(map(played_session, range(1_000, 1_000 + sessions)), Tallied())
    print(f"\n{tallied}")  # noqa: T201 - the figures of the test
    assert tallied.exact == tallied.restarts == sessions, tallied.wrong
    assert min(tallied.again, tallied.lost, tallied.damaged, tallied.reopened) > sessions / 4


# Hosts that die, and boxes that measure how long that takes.


@dataclass
class BoxProcess:
    """A box in a process of its own. `lights` : (pattern or None, CLOCK_MONOTONIC ns), as they come."""

    process: subprocess.Popen[str]
    port: str
    hosts: list[subprocess.Popen[str]] = field(default_factory=list)

    def next_light(self) -> tuple[int | None, int]:
        assert self.process.stdout is not None
        word, pattern, t_ns = self.process.stdout.readline().split()
        assert word == "light"
        return (None if pattern == "-" else int(pattern)), int(t_ns)

    def host(self, doing: str, watchdog_s: float) -> subprocess.Popen[str]:
        """A host that has lit it."""
        self.hosts.append(_started(doing, self.port, str(watchdog_s)))
        assert self.hosts[-1].stdout is not None
        assert self.hosts[-1].stdout.readline() == "lit\n"
        return self.hosts[-1]


@pytest.fixture
def box() -> Iterator[BoxProcess]:
    process = _started("box")
    assert process.stdout is not None
    box = BoxProcess(process, process.stdout.readline().split()[1])
    yield box
    for host in box.hosts:
        host.kill()
        host.communicate(timeout=LONG_S)
    process.communicate(timeout=LONG_S)


def _started(*words: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "tests.unit.drivers.serial_projector.processes", *words]
    return subprocess.Popen(  # noqa: S603 - our own module
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("end", "watchdog_s"),
    [(signal.SIGKILL, 0.25), (signal.SIGKILL, 1.0), (signal.SIGTERM, 0.25), (signal.SIGSTOP, 0.25), (None, 0.25)],
)
def test_a_host_that_dies_leaves_darkness_within_the_watchdogs_time(
    box: BoxProcess, end: signal.Signals | None, watchdog_s: float
) -> None:
    host = box.host("show" if end else "crash", watchdog_s)
    assert box.next_light()[0] == 3
    ended_ns = time.monotonic_ns()
    if end is not None:
        host.send_signal(end)
    pattern, dark_ns = box.next_light()
    assert pattern is None
    assert 0 < (dark_ns - ended_ns) / 1e9 <= watchdog_s + SLACK_S


@pytest.mark.realtime
def test_a_host_that_is_killed_ends_a_play(box: BoxProcess) -> None:
    host = box.host("play", 0.25)
    assert box.next_light()[0] == 0
    ended_ns = time.monotonic_ns()
    host.kill()
    host.wait(LONG_S)
    lights = [box.next_light()]
    # A host that comes after it finds the box dark, and may have it.
    again = cast("SerialProjector", open_projector({"port": box.port}, Path()))
    again.load(SEQUENCE)
    again.show(25)
    while lights[-1][0] != 25:
        lights.append(box.next_light())
    again.close()
    *played, _ = lights
    assert played[-1][0] is None
    assert (played[-1][1] - ended_ns) / 1e9 <= 0.25 + SLACK_S
    assert max(pattern for pattern, _ in played if pattern is not None) <= 3

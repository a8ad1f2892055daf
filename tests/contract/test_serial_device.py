"""The serial projector and its box against bad lines, restarts and dying hosts."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field, fields
from itertools import groupby
from pathlib import Path

import pytest

from slrig.errors import DeviceGoneError
from tests.unit.drivers.serial_projector.conftest import CRC32, SEQUENCE, Bench
from tests.unit.drivers.serial_projector.engines import CoreEngine, Scene, description
from tests.unit.drivers.serial_projector.line import Line, Noise, SerialLine

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


# Hosts that die, in processes of their own.

HOST = """
import sys
from pathlib import Path
from drivers.serial_projector import open_projector
from tests.unit.drivers.serial_projector.conftest import SEQUENCE

projector = open_projector({"port": sys.argv[1], "watchdog_s": float(sys.argv[2])}, Path())
projector.load(SEQUENCE)
projector.show(3)
print("lit", flush=True)
sys.stdin.readline()
raise RuntimeError("an error that is not caught")
"""


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("end", "watchdog_s"),
    [(signal.SIGKILL, 0.25), (signal.SIGKILL, 1.0), (signal.SIGTERM, 0.25), (signal.SIGSTOP, 0.25), (None, 0.25)],
)
def test_a_host_that_dies_leaves_darkness_within_the_watchdogs_time(
    end: signal.Signals | None, watchdog_s: float
) -> None:
    dark = threading.Event()
    scene = Scene(watch=[lambda pattern: dark.set() if pattern is None else None])
    line = SerialLine(CoreEngine(scene, description(CRC32)))
    with subprocess.Popen(  # noqa: S603 - our own program
        [sys.executable, "-c", HOST, line.path, str(watchdog_s)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        cwd=ROOT,
    ) as host:
        assert host.stdout is not None
        assert host.stdin is not None
        assert host.stdout.readline() == b"lit\n"
        ended_ns = time.monotonic_ns()
        if end is None:
            host.stdin.close()
        else:
            host.send_signal(end)
        assert dark.wait(LONG_S)
        host.kill()
    line.close()
    assert [change.pattern for change in scene.changes] == [3, None]
    assert 0 < (scene.changes[-1].t_ns - ended_ns) / 1e9 <= watchdog_s + SLACK_S

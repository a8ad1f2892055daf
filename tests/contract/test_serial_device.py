"""The serial projector and its box against bad lines, restarts and dying hosts."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields
from itertools import groupby
from pathlib import Path
from typing import cast

import pytest

from drivers.serial_projector import open_projector
from drivers.serial_projector.projector import SerialProjector
from slrig.conformance import Outcome, run
from slrig.errors import DeviceGoneError
from tests.contract.serial_bench import bench
from tests.unit.drivers.serial_projector.conftest import CRC32, SEQUENCE
from tests.unit.drivers.serial_projector.engines import (
    CoreEngine,
    Engine,
    MicroPythonEngine,
    Scene,
    description,
    micropython_package,
)
from tests.unit.drivers.serial_projector.line import Noise, SerialLine

ROOT = Path(__file__).resolve().parents[2]
LOSS = CORRUPTION = 0.08
LONG_S = 30.0
SLACK_S = 0.2
"""How late a box's program may come to its watchdog on a machine that is busy with other tests."""


@pytest.mark.slow
def test_the_contract_holds_on_a_bad_line(tmp_path: Path) -> None:
    examined = bench(tmp_path, noise=Noise(LOSS / 2, CORRUPTION / 2, seed=5), reply_s=0.06)
    report = run(examined.open_rig, examined.sequence)
    failed = [str(result.failure) for result in report.results if result.outcome is Outcome.FAILED]
    assert not failed
    passed = [result for result in report.results if result.outcome is Outcome.PASSED]
    assert len(passed) >= 25, "a camera with software and wire trigger leaves few checks out"


# Sessions.


@dataclass
class Tallied:
    """What happened in all sessions."""

    sessions: int = 0
    exact: int = 0
    twice: int = 0
    restarts: int = 0
    reopened: int = 0
    again: int = 0
    lost: int = 0
    damaged: int = 0
    wrong: list[str] = field(default_factory=list)

    def __add__(self, other: Tallied) -> Tallied:
        return Tallied(*(getattr(self, each.name) + getattr(other, each.name) for each in fields(self)))

    def __str__(self) -> str:
        return (
            f"{self.exact} of {self.sessions} sessions of {len(SEQUENCE)} patterns exact, {self.twice} patterns shown "
            f"twice; {self.lost} lines lost, {self.damaged} damaged, {self.again} commands sent again, {self.restarts} "
            f"restarts of the box, {self.reopened} of them found while it was lit"
        )


def play_session(seed: int, engine: Engine, scene: Scene, tallied: Tallied, *, reply_s: float) -> None:
    """Open, load, show every pattern, close, over a bad line, with a box that restarts once; judge what was lit."""
    rng = random.Random(seed)
    # At any of the 37 commands that a session has at least, obeyed or not before its answer could leave.
    restart_at, obeyed_first = rng.randint(1, 37), rng.random() < 0.5

    def on_command(line: SerialLine, count: int, data: bytes) -> bool:
        if count != restart_at:
            return True
        tallied.restarts += 1
        if obeyed_first:
            line.engine.feed(data)
        line.restart()
        return False

    noise = Noise(LOSS, CORRUPTION, seed)
    line = SerialLine(engine, noise=noise, on_command=on_command)

    def opened() -> SerialProjector:
        projector = cast("SerialProjector", open_projector({"port": line.path, "reply_s": reply_s}, Path()))
        projector.load(SEQUENCE)
        return projector

    try:
        projector = opened()
        index = 0
        while index < len(SEQUENCE):
            try:
                assert projector.show(index).index == index
                index += 1
            except DeviceGoneError:
                # As a person does: open the rig again, and ask for the same pattern again.
                tallied.again += projector.client.link.tally.again
                tallied.reopened += 1
                projector.close()
                projector = opened()
        tallied.again += projector.client.link.tally.again
        projector.close()
    finally:
        line.close()
    tallied.sessions += 1
    tallied.lost += noise.lost
    tallied.damaged += noise.damaged
    order, twice = [], 0
    for pattern, shows in groupby(scene.shown, key=lambda each: each[0]):
        boots = [boot for _, boot in shows]
        order.append(pattern)
        twice += len(boots) - len(set(boots))
    tallied.twice += twice
    if order == list(range(len(SEQUENCE))) and not twice and scene.lit is None:
        tallied.exact += 1
    else:
        tallied.wrong.append(f"session {seed}: {scene.shown}")


@pytest.mark.slow
def test_sessions_of_micropython_over_a_bad_line_are_exact() -> None:
    tallied, sessions = Tallied(), 3
    for seed in range(sessions):
        scene = Scene()
        # Its process takes a quarter of a second to start again, and longer beside other work.
        engine = MicroPythonEngine(scene, description(CRC32), micropython_package())
        play_session(seed, engine, scene, tallied, reply_s=0.25)
    assert (tallied.exact, tallied.twice) == (sessions, 0), tallied.wrong
    assert tallied.restarts == sessions
    assert tallied.lost > 0
    assert tallied.damaged > 0


@pytest.mark.realtime
def test_500_sessions_over_a_bad_line_are_exact(capsys: pytest.CaptureFixture[str]) -> None:
    def played(seed: int) -> Tallied:
        tallied, scene = Tallied(), Scene()
        engine = CoreEngine(scene, description(CRC32), drift=random.Random(seed).uniform(-1e-4, 1e-4))
        # Beside other work, answers of this process to itself were 20 ms late twelve times in a row.
        play_session(seed, engine, scene, tallied, reply_s=0.06)
        return tallied

    # Most of a session is waiting for what was lost.
    with ThreadPoolExecutor(12) as pool:
        tallied = sum(pool.map(played, range(1_000, 1_500)), Tallied())
    with capsys.disabled():
        sys.stdout.write(f"\n{tallied}\n")
    assert (tallied.exact, tallied.twice) == (500, 0), tallied.wrong
    assert tallied.restarts == 500


# Hosts that die.


@dataclass
class BoxProcess:
    """A box in a process of its own. `lights` : (pattern or None, CLOCK_MONOTONIC ns), as they come."""

    process: subprocess.Popen[str]
    port: str

    def next_light(self) -> tuple[int | None, int]:
        assert self.process.stdout is not None
        word, pattern, t_ns = self.process.stdout.readline().split()
        assert word == "light"
        return (None if pattern == "-" else int(pattern)), int(t_ns)


@pytest.fixture
def box() -> Iterator[BoxProcess]:
    process = _started("box_process")
    assert process.stdout is not None
    yield BoxProcess(process, process.stdout.readline().split()[1])
    process.communicate(timeout=LONG_S)


@pytest.fixture
def host(box: BoxProcess) -> Iterator[Callable[[str, float], subprocess.Popen[str]]]:
    started: list[subprocess.Popen[str]] = []

    def start(doing: str, watchdog_s: float) -> subprocess.Popen[str]:
        started.append(_started("host_process", box.port, str(watchdog_s), doing))
        assert started[-1].stdout is not None
        assert started[-1].stdout.readline() == "lit\n"
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate(timeout=LONG_S)


def _started(name: str, *words: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", f"tests.unit.drivers.serial_projector.{name}", *words]
    return subprocess.Popen(  # noqa: S603 - our own module
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("end", "watchdog_s"),
    [(signal.SIGKILL, 0.25), (signal.SIGKILL, 1.0), (signal.SIGTERM, 0.25), (signal.SIGSTOP, 0.25)],
)
def test_a_host_that_is_killed_leaves_darkness_within_the_watchdogs_time(
    box: BoxProcess, host: Callable[[str, float], subprocess.Popen[str]], end: signal.Signals, watchdog_s: float
) -> None:
    running = host("show", watchdog_s)
    assert box.next_light()[0] == 3
    ended_ns = time.monotonic_ns()
    running.send_signal(end)
    pattern, dark_ns = box.next_light()
    assert pattern is None
    assert 0 < (dark_ns - ended_ns) / 1e9 <= watchdog_s + SLACK_S


@pytest.mark.slow
def test_a_host_that_crashes_leaves_darkness(
    box: BoxProcess, host: Callable[[str, float], subprocess.Popen[str]]
) -> None:
    running = host("crash", 0.25)
    assert box.next_light()[0] == 3
    assert running.wait(LONG_S) == 1
    ended_ns = time.monotonic_ns()
    pattern, dark_ns = box.next_light()
    assert pattern is None
    assert (dark_ns - ended_ns) / 1e9 <= 0.25 + SLACK_S


def test_a_host_that_is_killed_ends_a_play(
    box: BoxProcess, host: Callable[[str, float], subprocess.Popen[str]]
) -> None:
    running = host("play", 0.25)
    assert box.next_light()[0] == 0
    ended_ns = time.monotonic_ns()
    running.kill()
    running.wait(LONG_S)
    assert box.process.stdin is not None
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

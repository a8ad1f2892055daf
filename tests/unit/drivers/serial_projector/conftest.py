"""Boxes on a line in memory, and projectors on them, closed after each test. Time is the tests' own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.serial_projector.client import SerialProjectorOptions, pattern_checksums
from drivers.serial_projector.projector import SerialProjector
from slrig.model import Size
from tests.contract.suite import whole_scan
from tests.unit.drivers.serial_projector.engines import CoreEngine, Scene, description
from tests.unit.drivers.serial_projector.line import MemoryLine
from tests.virtual_clock import VirtualClock

SIZE = Size(400, 300)


SEQUENCE = whole_scan(SIZE, period_px=8, line_width_px=1)
CRC32 = pattern_checksums(SEQUENCE)


class Bench:
    """A box with SEQUENCE in its flash, on a line: what it did, and how to open it. `line` : options of `Line`."""

    def __init__(self, *, drift: float = 0.0, **line: Any) -> None:
        self.clock = VirtualClock(threads=["serial projector"])
        self.scene = Scene(at_ns=self.clock.now_ns())
        self.engine = CoreEngine(self.scene, description(CRC32), drift=drift)
        self.line = MemoryLine(self.engine, self.clock, **line)
        self._opened: list[SerialProjector] = []

    def open(self, folder: Path = Path(), **options: Any) -> SerialProjector:
        table = SerialProjectorOptions(port="the line", **options)
        projector = SerialProjector(self.line.opened, table, export_folder=folder / "patterns", clock=self.clock)
        self._opened.append(projector)
        return projector

    def loaded(self, **options: Any) -> SerialProjector:
        projector = self.open(**options)
        projector.load(SEQUENCE)
        return projector

    def advance(self, seconds: float) -> None:
        self.clock.advance(seconds)
        self.line.catch_up()

    @property
    def lit(self) -> int | None:
        self.line.catch_up()
        return self.scene.lit

    @property
    def patterns(self) -> list[int]:
        return [pattern for pattern, _boot in self.scene.shown]

    def close(self) -> None:
        for projector in self._opened:
            projector.close()


@pytest.fixture
def make_bench() -> Iterator[Callable[..., Bench]]:
    made: list[Bench] = []

    def make(**how: Any) -> Bench:
        made.append(Bench(**how))
        return made[-1]

    yield make
    for bench in made:
        bench.close()


@pytest.fixture
def bench(make_bench: Callable[..., Bench]) -> Bench:
    return make_bench()

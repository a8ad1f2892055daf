"""Boxes on a serial line, and projectors on them, closed after each test."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import pytest

from drivers.serial_projector import open_projector
from drivers.serial_projector.pattern_set import crc32_of_each
from drivers.serial_projector.projector import SerialProjector
from slrig.model import PatternSequence, Size
from slrig.patterns.sequence import encode, scan_patterns
from tests.unit.drivers.serial_projector.engines import (
    CoreEngine,
    Engine,
    MicroPythonEngine,
    Scene,
    description,
    micropython_package,
)
from tests.unit.drivers.serial_projector.line import SerialLine

SIZE = Size(400, 300)


def whole_sequence(size: Size = SIZE, *, line_width_px: int = 1) -> PatternSequence:
    """The 26 patterns of a usual scan at 400 x 300."""
    patterns = scan_patterns(
        size, line_shift=True, period_px=8, line_width_px=line_width_px, gray_cell_px=None, gray_offset_px=0, rows=False
    )
    return encode(patterns, size)


SEQUENCE = whole_sequence()
CRC32 = crc32_of_each(SEQUENCE)


@dataclass
class Bench:
    """A box on a line, what it did, and how to open it."""

    line: SerialLine
    scene: Scene
    open: Callable[..., SerialProjector]

    @property
    def core(self) -> CoreEngine:
        assert isinstance(self.line.engine, CoreEngine)
        return self.line.engine


@pytest.fixture
def make_bench() -> Iterator[Callable[..., Bench]]:
    """Makes a box with SEQUENCE in its flash; the options are those of `SerialLine`."""
    made: list[Bench] = []
    opened: list[SerialProjector] = []

    def make(*, engine: Callable[[Scene], Engine] | None = None, drift: float = 0.0, **line: Any) -> Bench:
        scene = Scene()
        inside = CoreEngine(scene, description(CRC32), drift=drift) if engine is None else engine(scene)
        serial_line = SerialLine(inside, **line)

        def open_it(folder: Path = Path(), **options: object) -> SerialProjector:
            table = {"port": serial_line.path, "reply_s": 0.1, **options}
            projector = cast("SerialProjector", open_projector(table, folder))
            opened.append(projector)
            return projector

        made.append(Bench(serial_line, scene, open_it))
        return made[-1]

    yield make
    for projector in opened:
        projector.close()
    for bench in made:
        bench.line.close()


@pytest.fixture
def bench(make_bench: Callable[..., Bench]) -> Bench:
    return make_bench()


@pytest.fixture(params=["CPython", "MicroPython"])
def either_bench(request: pytest.FixtureRequest, make_bench: Callable[..., Bench]) -> Bench:
    """The core in either interpreter."""
    if request.param == "CPython":
        return make_bench()
    package = micropython_package()
    return make_bench(engine=lambda scene: MicroPythonEngine(scene, description(CRC32), package))

"""A fake engine of each kind with three patterns to show, and what opens its driver."""

from __future__ import annotations

import os
import struct
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from drivers.dlpc350 import planes
from drivers.dlpc350.flash import Flash, write_pictures
from drivers.dlpc350.options import EngineOptions as Options350
from drivers.dlpc350.projector import DLPC350
from drivers.dlpc350.projector import LightEngine as LightEngine350
from drivers.dlpc900.options import EngineOptions as Options900
from drivers.dlpc900.projector import DLPC900
from drivers.dlpc900.projector import LightEngine as LightEngine900
from drivers.pattern_engine.link import Link
from slrig.model import Axis, Black, LineShift, PatternSequence, Pixels, White
from slrig.patterns.sequence import encode
from tests.contract import dlpc900_bench
from tests.contract.dlpc350_device import Cable, FakeEngine
from tests.contract.dlpc900_device import Fake900

LINES = LineShift(Axis.COLUMN, 1, 8)
PATTERNS = (White(), Black(), LINES)
SEQUENCE_350 = encode(PATTERNS, planes.MIRRORS)
SEQUENCE_900 = encode(PATTERNS, dlpc900_bench.MIRRORS)
LEDS, START_STOP = 0x1A07, 0x1A24


class Bench(ABC):
    """An engine and what opens it. played : set once its trigger output had a pulse per pattern."""

    engine: FakeEngine
    cable: Cable

    def __init__(self, sequence: PatternSequence) -> None:
        self.sequence = sequence
        self.pulses: list[int] = []
        self.played = threading.Event()

    @abstractmethod
    def open(self, **options: object) -> LightEngine350 | LightEngine900:
        """The driver at the other end of a new cable, with options for a fake."""

    @abstractmethod
    def held_us(self) -> tuple[int, int, int]:
        """Of what the engine was told to show: a pattern's light, its period, and how many periods there are."""

    def commands(self) -> list[int]:
        """The numbers of the commands since they were last asked for."""
        found = [command for command, _ in self.engine.commands]
        self.engine.commands.clear()
        return found

    def shows(self, profile: Pixels) -> bool:
        """Whether a pattern is lit, after a while: the fake's mirrors turn on a thread, which may be held up."""
        until_s = time.monotonic() + 2.0
        while not self._lit_as(profile) and time.monotonic() < until_s:
            os.sched_yield()
        return self._lit_as(profile)

    def _lit_as(self, profile: Pixels) -> bool:
        lit = self.engine.lit
        return lit is not None and np.array_equal(lit, profile)

    def _pulse(self, t_ns: int) -> None:
        self.pulses.append(t_ns)
        if len(self.pulses) == len(self.sequence):
            self.played.set()


class Bench350(Bench):
    """A DLPC350 with the flash's pictures."""

    def __init__(self, flash: Flash, **engine: Any) -> None:
        super().__init__(SEQUENCE_350)
        self.flash = flash
        pictures = {picture.flash_index: picture.content for picture in flash.pictures}
        self.engine = FakeEngine(pictures, **{"tag": flash.tag, "pulse": self._pulse, **engine})

    def open(self, **options: object) -> LightEngine350:
        self.cable = Cable(self.engine)
        usual = {"patterns": "p", "image_load_s": 0.0, "led_current_inverted": True}
        table = Options350.model_validate({**usual, **options})
        return LightEngine350(
            Link(self.cable.host, "light engine", DLPC350, answer_s=2.0), table, self.flash, serial="1"
        )

    def held_us(self) -> tuple[int, int, int]:
        exposure_us, period_us = struct.unpack("<II", self.engine.registers[0x1A29])
        return exposure_us, period_us, len(self.engine._entries())


class Bench900(Bench):
    """A DLPC900."""

    engine: Fake900

    def __init__(self, **engine: Any) -> None:
        super().__init__(SEQUENCE_900)
        self.engine = Fake900(**{"pulse": self._pulse, **engine})

    def open(self, **options: object) -> LightEngine900:
        self.cable = Cable(self.engine)
        table = Options900.model_validate({"start_s": 0.02, "led_current_inverted": False, **options})
        return LightEngine900(Link(self.cable.host, "light engine", DLPC900, answer_s=5.0), table, serial="1")

    def held_us(self) -> tuple[int, int, int]:
        pattern, end = self.engine.entries[0], self.engine.entries[len(self.sequence)]
        assert (end.leds, pattern.dark_us, end.dark_us) == (0, 0, 0), "the end is what is dark of a period"
        return pattern.exposure_us, pattern.exposure_us + end.exposure_us, self.engine._shown_of_order // 2


def bench_350(folder: Path, **engine: Any) -> Bench:
    """A DLPC350 whose pictures are in a folder."""
    return Bench350(write_pictures(folder, SEQUENCE_350), **engine)


def bench_900(_: Path, **engine: Any) -> Bench:
    """A DLPC900; it needs no folder."""
    return Bench900(**engine)


BENCHES: dict[str, Callable[..., Bench]] = {"dlpc350": bench_350, "dlpc900": bench_900}

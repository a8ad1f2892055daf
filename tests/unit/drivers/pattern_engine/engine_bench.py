"""A fake engine of each kind with three patterns to show, and what opens its driver, on a clock of tests."""

from __future__ import annotations

import struct
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np

from drivers.dlpc347x.bus import I2cBus
from drivers.dlpc347x.engine import Dlpc347xEngineOptions as Options347x
from drivers.dlpc347x.projector import Dlpc347xProjector as LightEngine347x
from drivers.dlpc350.engine import Dlpc350EngineOptions as Options350
from drivers.dlpc350.flash import MIRRORS, FlashContents, write_pictures
from drivers.dlpc350.projector import DLPC350
from drivers.dlpc350.projector import Dlpc350Projector as LightEngine350
from drivers.dlpc900.engine import Dlpc900EngineOptions as Options900
from drivers.dlpc900.projector import DLPC900
from drivers.dlpc900.projector import Dlpc900Projector as LightEngine900
from drivers.pattern_engine.usb import UsbLink
from slrig.model import Axis, Black, LineShift, PatternSequence, Pixels, White
from slrig.patterns.sequence import encode
from tests.contract import dlpc347x_bench, dlpc900_bench
from tests.contract.dlpc347x_device import Fake347x
from tests.contract.dlpc350_device import SEQUENCER, Cable, FakeEngine
from tests.contract.dlpc900_device import Fake900
from tests.unit.drivers.conftest import OPENED
from tests.virtual_clock import VirtualClock

LINES = LineShift(Axis.COLUMN, 1, 8)
PATTERNS = (White(), Black(), LINES)
SEQUENCE_350 = encode(PATTERNS, MIRRORS)
SEQUENCE_900 = encode(PATTERNS, dlpc900_bench.MIRRORS)
SEQUENCE_347X = encode(PATTERNS, dlpc347x_bench.MIRRORS)
LEDS, START_STOP = 0x1A07, 0x1A24


Engine = TypeVar("Engine", bound=LightEngine347x | LightEngine350 | LightEngine900)


def opened(projector: Engine) -> Engine:
    OPENED.append(projector)
    return projector


class Bench(ABC):
    """An engine and what opens it. leds : the command that switches them, off and by the sequence."""

    sequence: PatternSequence
    engine: FakeEngine | Fake347x
    leds: ClassVar[tuple[int, bytes, bytes]] = (LEDS, b"\0", b"\x08")

    def __init__(self) -> None:
        self.pulses: list[int] = []
        self.clock = VirtualClock(threads=["light engine", SEQUENCER])

    @abstractmethod
    def open(self, **options: Any) -> LightEngine347x | LightEngine350 | LightEngine900:
        """The driver at the other end of a new cable, with options for a fake."""

    @abstractmethod
    def unplug(self) -> None:
        """Pull the cable, and the engine's power."""

    def loaded(self, **options: Any) -> LightEngine347x | LightEngine350 | LightEngine900:
        """The same, with the three patterns, and nothing noted so far."""
        projector = self.open(**options)
        projector.load(self.sequence)
        self.engine.commands.clear()
        self.engine.shown.clear()
        return projector

    def commands(self) -> list[int]:
        """The numbers of the commands since the last call."""
        found = [command for command, _ in self.engine.commands]
        self.engine.commands.clear()
        return found

    def shows(self, profile: Pixels) -> bool:
        lit = self.engine.lit
        return lit is not None and np.array_equal(lit, profile)

    def died(self, projector: LightEngine347x | LightEngine350 | LightEngine900) -> None:
        """As if the driver's process were killed: nothing goes over the cable any more, and it is not pulled out."""
        projector._state.closed.set()


class UsbBench(Bench):
    """An engine with a USB port."""

    engine: FakeEngine
    cable: Cable

    @abstractmethod
    def open(self, **options: Any) -> LightEngine350 | LightEngine900: ...

    @abstractmethod
    def held_us(self) -> tuple[int, int, int]:
        """Of what the engine is to show: a pattern's light, its period, and how many periods there are."""

    def unplug(self) -> None:
        self.cable.unplug()


@cache
def flash_350() -> FlashContents:
    """The pictures of a DLPC350, made once for all tests."""
    with tempfile.TemporaryDirectory() as folder:
        return write_pictures(Path(folder), SEQUENCE_350)


class Bench350(UsbBench):
    """A DLPC350 with a flash's pictures."""

    sequence = SEQUENCE_350

    def __init__(self, flash: FlashContents | None = None, **engine: Any) -> None:
        super().__init__()
        self.flash = flash or flash_350()
        pictures = {picture.flash_index: picture.content for picture in self.flash.pictures}
        usual = {"tag": self.flash.tag, "pulse": self.pulses.append, "clock": self.clock}
        self.engine = FakeEngine(pictures, **{**usual, **engine})

    def open(self, **options: Any) -> LightEngine350:
        self.cable = Cable(self.engine)
        usual = {"patterns": "p", "image_load_s": 0.0, "led_current_inverted": True}
        table = Options350.model_validate({**usual, **options})
        link = UsbLink(self.cable.host, "light engine", DLPC350, answer_s=5.0)
        return opened(LightEngine350(link, table, self.flash, serial="1", clock=self.clock))

    def held_us(self) -> tuple[int, int, int]:
        exposure_us, period_us = struct.unpack("<II", self.engine.registers[0x1A29])
        return exposure_us, period_us, len(self.engine._entries())


class Bench900(UsbBench):
    """A DLPC900."""

    sequence = SEQUENCE_900
    engine: Fake900

    def __init__(self, **engine: Any) -> None:
        super().__init__()
        self.engine = Fake900(**{"pulse": self.pulses.append, "clock": self.clock, **engine})

    def open(self, **options: Any) -> LightEngine900:
        self.cable = Cable(self.engine)
        table = Options900.model_validate({"start_s": 0.02, "led_current_inverted": False, **options})
        link = UsbLink(self.cable.host, "light engine", DLPC900, answer_s=5.0)
        return opened(LightEngine900(link, table, serial="1", clock=self.clock))

    def held_us(self) -> tuple[int, int, int]:
        pattern, end = self.engine.entries[0], self.engine.entries[len(self.sequence)]
        assert (end.leds, pattern.dark_us, end.dark_us) == (0, 0, 0), "the end is what is dark of a period"
        return pattern.exposure_us, pattern.exposure_us + end.exposure_us, self.engine._shown_of_order // 2


class Bench347x(Bench):
    """A DLPC3478 whose flash holds the three patterns, or `flashed`."""

    sequence = SEQUENCE_347X
    engine: Fake347x
    leds = (0x52, b"\0", b"\7")

    def __init__(self, flashed: PatternSequence | None = SEQUENCE_347X, **engine: Any) -> None:
        super().__init__()
        self.engine = Fake347x(**{"pulse": self.pulses.append, "clock": self.clock, **engine})
        if flashed is not None:
            projector = self.open()
            projector.write_patterns(flashed)
            projector.close()
            self.engine.commands.clear()

    def open(self, **options: Any) -> LightEngine347x:
        usual = {"device": "/dev/i2c-1", "start_s": 0.02, "light_margin_s": 0.001, "led": "blue"}
        table = Options347x.model_validate({**usual, **options})
        return opened(LightEngine347x(I2cBus(self.engine, "light engine"), table, clock=self.clock))

    def unplug(self) -> None:
        self.engine.unplug()


BENCHES: dict[str, Callable[..., Bench]] = {"dlpc347x": Bench347x, "dlpc350": Bench350, "dlpc900": Bench900}

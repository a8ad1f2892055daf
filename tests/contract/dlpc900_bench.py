"""The DLPC900's driver before a camera on its trigger wire: a bench for the contract suite."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from drivers import dlpc900
from drivers.dlpc900.engine import Dlpc900EngineOptions
from drivers.dlpc900.projector import DLPC900, Dlpc900Projector
from drivers.pattern_engine.usb import UsbLink
from slrig.model import Size
from tests.contract.dlpc350_device import Cable
from tests.contract.dlpc900_device import Fake900
from tests.contract.suite import Bench, BenchHead, WiredTable, whole_scan

MIRRORS = Size(1920, 1080)
# The fake is a thread, which a busy machine keeps waiting for a while.
_USUAL: dict[str, object] = {"start_s": 0.1, "light_margin_s": 0.002, "led_current_inverted": False}


class Table(WiredTable):
    """A stage, and a fake engine that lights it."""

    def __init__(self, **engine: Any) -> None:
        super().__init__(MIRRORS, columns_per_px=2.9)
        self.engine = Fake900(light=self.stage.show, pulse=self.pulse, **engine)

    def connected(self, **more: object) -> BenchHead:
        link = UsbLink(Cable(self.engine).host, "light engine", DLPC900, answer_s=5.0)
        return self.head(Dlpc900Projector(link, Dlpc900EngineOptions.model_validate(_USUAL | more), serial="LCR6500-1"))

    def opened(self, **more: object) -> BenchHead:
        """The driver as a rig opens it, on whatever engine the kernel has."""
        return self.head(dlpc900.open_projector(_USUAL | more, Path()))


def bench(_: Path) -> Bench:
    return Bench(Table().connected, whole_scan(MIRRORS))

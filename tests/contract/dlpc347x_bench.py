"""The DLPC347x's driver before a camera on its trigger wire: a bench for the contract suite."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from drivers.dlpc347x.bus import I2cBus
from drivers.dlpc347x.engine import Dlpc347xEngineOptions
from drivers.dlpc347x.projector import Dlpc347xProjector
from slrig.model import Pixels, Size
from slrig.patterns.sequence import merge_sequences
from tests.contract.dlpc347x_device import Fake347x
from tests.contract.suite import Bench, BenchHead, WiredTable, whole_scan

MIRRORS = Size(1280, 720)
# The fake is a thread, which a busy machine keeps waiting for a while.
_USUAL: dict[str, object] = {"device": "/dev/i2c-1", "start_s": 0.1, "light_margin_s": 0.001, "led": "blue"}


class Table(WiredTable):
    """A stage, and a fake engine that lights it."""

    def __init__(self, **engine: Any) -> None:
        super().__init__(
            MIRRORS, columns_per_px=1.9, rows_per_px=7.0, white=0.7, usual_s=0.005, exposures_s=(1e-4, 0.0055)
        )
        self.engine = Fake347x(light=self._change, pulse=self.pulse, **engine)

    def opened(self) -> Dlpc347xProjector:
        return Dlpc347xProjector(I2cBus(self.engine, "light engine"), Dlpc347xEngineOptions.model_validate(_USUAL))

    def connected(self) -> BenchHead:
        return self.head(self.opened())

    def _change(self, lit: Pixels | None, at_ns: int) -> None:
        self.stage.show(lit, asked_ns=at_ns)


def bench(_: Path) -> Bench:
    """The contract suite's bench, its flash written once."""
    table = Table()
    projector = table.opened()
    projector.write_patterns(merge_sequences([whole_scan(MIRRORS, rows=True)]))
    projector.close()
    return Bench(table.connected, whole_scan(MIRRORS))

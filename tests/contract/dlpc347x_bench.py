"""The DLPC347x's driver before a camera on its trigger wire: a bench for the contract suite."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from drivers.dlpc347x.bus import Bus
from drivers.dlpc347x.options import EngineOptions
from drivers.dlpc347x.projector import LightEngine
from slrig.model import PatternSequence, Pixels, Size
from slrig.patterns.sequence import encode, scan_patterns, united
from tests.contract.bench_head import BenchHead
from tests.contract.dlpc347x_device import Fake347x
from tests.contract.stage import Stage
from tests.contract.suite import Bench
from tests.contract.wired_camera import WiredCamera
from tests.unit.capture.fake_rig import Scene

MIRRORS = Size(1280, 720)
# The fake is a thread, which a busy machine keeps waiting for a while.
_USUAL: dict[str, object] = {"device": "/dev/i2c-1", "start_s": 0.1, "light_margin_s": 0.001, "led": "blue"}


def sequence(*, rows: bool = False) -> PatternSequence:
    """White, black, Gray code with inverses, shifted lines, and white and black again."""
    patterns = scan_patterns(
        MIRRORS, line_shift=True, period_px=16, line_width_px=2, gray_cell_px=None, gray_offset_px=0, rows=rows
    )
    return encode(patterns, MIRRORS)


class Table:
    """A stage, and a fake engine that lights it; used by one head."""

    def __init__(self, **engine: Any) -> None:
        scene = Scene(
            camera=Size(640, 100),
            projector=MIRRORS,
            columns_per_px=1.9,
            rows_per_px=7.0,
            blur_px=0.8,
            noise_dn=0.5,
            white=0.7,
        )
        self.stage = Stage(scene)
        self._camera: WiredCamera | None = None
        self.engine = Fake347x(light=self._change, pulse=self._pulse, **engine)

    def opened(self, **more: object) -> LightEngine:
        """The driver on a new bus."""
        return LightEngine(Bus(self.engine, "light engine"), EngineOptions.model_validate(_USUAL | more))

    def connected(self, **more: object) -> BenchHead:
        """The driver on a new bus, and a new camera."""
        self._camera = WiredCamera("left", self.stage, usual_s=0.005, exposures_s=(1e-4, 0.0055), gains=(1.0, 8.0))
        return BenchHead({"left": self._camera}, self.opened(**more))

    def _change(self, lit: Pixels | None, at_ns: int) -> None:
        self.stage.show(lit, asked_ns=at_ns)

    def _pulse(self, t_ns: int) -> None:
        if self._camera is not None:
            self._camera.pulse(t_ns)


def bench(_: Path) -> Bench:
    """The contract suite's bench, its flash written once."""
    table = Table()
    projector = table.opened()
    projector.write_patterns(united([sequence(rows=True)]))
    projector.close()
    return Bench(table.connected, sequence())

"""The DLPC900's driver before a camera on its trigger wire: a bench for the contract suite."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from drivers import dlpc900
from drivers.dlpc900.options import EngineOptions
from drivers.dlpc900.projector import DLPC900, LightEngine
from drivers.pattern_engine.link import Link
from slrig.devices import Projector
from slrig.model import PatternSequence, Size
from slrig.patterns.sequence import encode, scan_patterns
from tests.contract.bench_head import BenchHead
from tests.contract.dlpc350_device import Cable
from tests.contract.dlpc900_device import Fake900
from tests.contract.stage import Stage
from tests.contract.suite import Bench
from tests.contract.wired_camera import WiredCamera
from tests.unit.capture.fake_rig import Scene

MIRRORS = Size(1920, 1080)
# The fake is a thread, which a busy machine keeps waiting for a while.
_USUAL: dict[str, object] = {"start_s": 0.1, "light_margin_s": 0.002, "led_current_inverted": False}


def sequence(size: Size = MIRRORS, *, rows: bool = False) -> PatternSequence:
    """White, black, Gray code with inverses, shifted lines, and white and black again."""
    patterns = scan_patterns(
        size, line_shift=True, period_px=16, line_width_px=2, gray_cell_px=None, gray_offset_px=0, rows=rows
    )
    return encode(patterns, size)


class Table:
    """A stage, and a fake engine that lights it; used by one head."""

    def __init__(self, **engine: Any) -> None:
        self.stage = Stage(
            Scene(
                camera=Size(640, 100),
                projector=MIRRORS,
                columns_per_px=2.9,
                rows_per_px=10.0,
                blur_px=0.8,
                noise_dn=0.5,
                white=0.5,
            )
        )
        self._camera: WiredCamera | None = None
        self.engine = Fake900(light=self.stage.show, pulse=self._pulse, **engine)

    def connected(self, **more: object) -> BenchHead:
        """The driver at the other end of a new cable, and a new camera."""
        link = Link(Cable(self.engine).host, "light engine", DLPC900, answer_s=5.0)
        return self._head(LightEngine(link, EngineOptions.model_validate(_USUAL | more), serial="LCR6500-1"))

    def opened(self, **more: object) -> BenchHead:
        """The driver as a rig opens it, on whatever engine the kernel has."""
        return self._head(dlpc900.open_projector(_USUAL | more, Path()))

    def _head(self, projector: Projector) -> BenchHead:
        self._camera = WiredCamera("left", self.stage, usual_s=1 / 60, exposures_s=(1e-4, 0.5), gains=(1.0, 8.0))
        return BenchHead({"left": self._camera}, projector)

    def _pulse(self, t_ns: int) -> None:
        if self._camera is not None:
            self._camera.pulse(t_ns)


def bench(_: Path) -> Bench:
    """The contract suite's bench."""
    return Bench(Table().connected, sequence())

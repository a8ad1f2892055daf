"""The serial projector on a trigger box at the end of a pseudo-terminal, before cameras that the box triggers."""

from __future__ import annotations

import atexit
import time
from dataclasses import dataclass, field
from pathlib import Path

from drivers.serial_projector import open_projector
from drivers.serial_projector.client import pattern_checksums
from slrig.devices import Projector
from slrig.model import PatternSequence
from tests.contract.stage import Stage
from tests.contract.suite import Bench, BenchHead, whole_scan
from tests.contract.wired_camera import WiredCamera
from tests.unit.capture.fake_rig import PROJECTOR
from tests.unit.capture.fake_rig import Scene as World
from tests.unit.drivers.serial_projector.engines import CoreEngine, Scene, description
from tests.unit.drivers.serial_projector.line import SerialLine


@dataclass
class TriggerBox:
    """A box with a sequence in its flash, its light on a stage and its wire to cameras."""

    stage: Stage
    flashed: PatternSequence
    drift: float = 30e-6
    cameras: dict[str, WiredCamera] = field(default_factory=dict)
    line: SerialLine = field(init=False)

    def __post_init__(self) -> None:
        size = self.flashed.projector
        scene = Scene(watch=[self._lit], on_pulse=[self._pulsed])
        about = description(pattern_checksums(self.flashed), width_px=size.width_px, height_px=size.height_px)
        self.line = SerialLine(CoreEngine(scene, about, drift=self.drift))
        atexit.register(self.line.close)

    def projector(self, **options: object) -> Projector:
        """Open it with the real driver."""
        return open_projector({"port": self.line.path, **options}, Path())

    def _lit(self, pattern: int | None) -> None:
        self.stage.show(None if pattern is None else self.flashed.profiles[pattern])

    def _pulsed(self, _us: int) -> None:
        for camera in self.cameras.values():
            camera.pulse(time.monotonic_ns())


def bench(_: Path) -> Bench:
    """A box and two cameras as an instrument for the contract suite."""
    flashed = whole_scan(PROJECTOR, period_px=8, line_width_px=1)
    stage = Stage(World(noise_dn=0.8))
    box = TriggerBox(stage, flashed)

    def open_head() -> BenchHead:
        projector = box.projector()
        box.cameras = {name: WiredCamera(name, stage) for name in ("left", "right")}
        return BenchHead(dict(box.cameras), projector)

    return Bench(open_head, flashed)

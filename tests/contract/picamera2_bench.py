"""The picamera2 driver on a stand-in for the library, before a staged projector."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from drivers.picamera2 import open_camera
from slrig.devices import Camera, Projector
from slrig.model import Calibration, Truth
from slrig.patterns.sequence import encode, scan_patterns
from tests.contract.stage import Stage, StagedProjector
from tests.contract.suite import Bench
from tests.unit.capture.fake_rig import PROJECTOR, Scene
from tests.unit.drivers.picamera2.fake_picamera2 import Pi


class PiHead:
    """Implements `slrig.devices.Head`: the driver's camera, and a staged projector."""

    calibration: Calibration | None = None

    def __init__(self, pi: Pi, **options: object) -> None:
        self.projector: Projector = StagedProjector(pi.stage)
        with pi.connected():
            self.cameras: Mapping[str, Camera] = {
                "left": open_camera("left", {"device": pi.identity, **options}, Path())
            }

    def truth(self) -> Truth | None:
        """See `Head`."""
        return None


def bench(folder: Path) -> Bench:
    """The driver on a mono sensor of 10 bit."""
    del folder
    patterns = scan_patterns(
        PROJECTOR, line_shift=True, period_px=8, line_width_px=1, gray_cell_px=None, gray_offset_px=0, rows=False
    )

    def head() -> PiHead:
        return PiHead(Pi(Stage(Scene(noise_dn=0.8, bit_depth=10), latency_s=0.002, jitter_s=0.003)))

    return Bench(head, encode(patterns, PROJECTOR))

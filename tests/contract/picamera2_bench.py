"""The picamera2 driver on a stand-in for the library, before a staged projector, on virtual time."""

from __future__ import annotations

from pathlib import Path

from slrig.patterns.sequence import encode, scan_patterns
from tests.contract.bench_head import BenchHead
from tests.contract.stage import Stage, StagedProjector
from tests.contract.suite import Bench
from tests.unit.capture.fake_rig import PROJECTOR, Scene
from tests.unit.drivers.picamera2.fake_picamera2 import Pi
from tests.virtual_clock import VirtualClock


def bench(folder: Path) -> Bench:
    """The driver on a mono sensor of 10 bit."""
    del folder
    patterns = scan_patterns(
        PROJECTOR, line_shift=True, period_px=8, line_width_px=1, gray_cell_px=None, gray_offset_px=0, rows=False
    )

    def open_head() -> BenchHead:
        clock = VirtualClock()
        pi = Pi(Stage(Scene(noise_dn=0.8, bit_depth=10), latency_s=0.002, jitter_s=0.003, clock=clock))
        return BenchHead({"left": pi.opened()}, StagedProjector(pi.stage), clock=clock)

    return Bench(open_head, encode(patterns, PROJECTOR))

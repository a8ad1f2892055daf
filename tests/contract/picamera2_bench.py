"""The picamera2 driver on a stand-in for the library, before a staged projector, on virtual time."""

from __future__ import annotations

from pathlib import Path

from tests.contract.bench_head import BenchHead
from tests.contract.stage import Stage, StagedProjector
from tests.contract.suite import Bench, sequence_for
from tests.unit.capture.fake_rig import PROJECTOR, Scene
from tests.unit.drivers.picamera2.fake_picamera2 import Pi
from tests.virtual_clock import VirtualClock


def bench(folder: Path) -> Bench:
    """The driver on a mono sensor of 10 bit."""
    del folder

    def open_head() -> BenchHead:
        clock = VirtualClock()
        pi = Pi(Stage(Scene(noise_dn=0.8, bit_depth=10), latency_s=0.002, jitter_s=0.003, clock=clock))
        return BenchHead({"left": pi.opened()}, StagedProjector(pi.stage), clock=clock)

    return Bench(open_head, sequence_for(PROJECTOR))

"""Raspberry Pi cameras on a stand-in for the library, on virtual time: running freely, and by a trigger box."""

from __future__ import annotations

import tempfile
from collections import deque
from pathlib import Path
from unittest import mock

from drivers.picamera2 import camera
from tests.contract.stage import Stage, StagedProjector
from tests.contract.suite import Bench, BenchHead, sequence_for
from tests.unit.capture import fake_rig
from tests.unit.capture.fake_rig import Scene
from tests.unit.drivers.picamera2.fake_picamera2 import CONTROLS, Pi
from tests.unit.drivers.serial_projector.conftest import SEQUENCE
from tests.unit.drivers.serial_projector.conftest import Bench as BoxBench
from tests.virtual_clock import VirtualClock


def picamera2(_: Path) -> Bench:
    """A mono sensor of 10 bit that runs freely."""

    def open_head() -> BenchHead:
        clock = VirtualClock()
        pi = Pi(Stage(Scene(noise_dn=0.8, bit_depth=10), latency_s=0.002, jitter_s=0.003, clock=clock))
        return BenchHead({"left": pi.opened()}, StagedProjector(pi.stage), clock=clock)

    return Bench(open_head, sequence_for(fake_rig.PROJECTOR))


def global_shutter(scene: Scene, clock: VirtualClock) -> Pi:
    """An IMX296 that waits for pulses, with the limits that libcamera reports for it."""
    limits = {"ExposureTime": (29, 0, 0), "FrameDurationLimits": (16_562, 15_534_385, 33_333)}
    return Pi(Stage(scene, clock=clock), model="imx296", controls={**CONTROLS, **limits}, pulses=deque())


def connect(pi: Pi, box: BoxBench) -> None:
    """Let a trigger box light the stage before a camera, and expose the camera by its wire."""
    pulses = pi.pulses
    assert pulses is not None

    def light(pattern: int | None) -> None:
        pi.stage.show(None if pattern is None else SEQUENCE.profiles[pattern], asked_ns=box.scene.now_ns())

    pi.look = box.line.catch_up
    box.scene.watch.append(light)
    box.scene.on_pulse.append(lambda us: pulses.append((box.scene.now_ns(), box.scene.now_ns() + us * 1000)))


def wired_picamera2(folder: Path) -> Bench:
    """The global-shutter camera with a trigger box: the cheapest rig by wire."""
    mode = Path(tempfile.mkdtemp(dir=folder)) / "trigger_mode"
    mode.write_text("1")

    def open_head() -> BenchHead:
        box = BoxBench()
        scene = Scene(projector=SEQUENCE.projector, columns_per_px=3.0, noise_dn=0.8, bit_depth=10)
        pi = global_shutter(scene, box.clock)
        connect(pi, box)
        with mock.patch.object(camera, "TRIGGER_MODE", mode):
            return BenchHead({"left": pi.opened(external_trigger=True)}, box.open(), clock=box.clock)

    return Bench(open_head, SEQUENCE)

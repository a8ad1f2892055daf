"""Every driver before a device that loses, damages, repeats and delays frames, as a bench for counting wrong frames."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from drivers.opencv import open_camera as open_opencv_camera
from slrig.devices import Camera, CameraSettings, Rig, ScannerHead
from slrig.model import PatternSequence, Pixels, Size
from tests.contract import depthai_bench, genicam_bench, gentl_bench, opencv_bench, v4l2_bench
from tests.contract.genicam_bench import Fate, Relay
from tests.contract.genicam_peer import INTERFACE
from tests.contract.gentl_producer import MemoryCamera
from tests.contract.pairing import PairingResult, wrong_pairings
from tests.contract.stage import Stage, StagedProjector
from tests.contract.suite import BenchHead, rig_of, sequence_for
from tests.contract.v4l2_bench import Faked
from tests.contract.v4l2_sensor import GAIN_UNITS
from tests.unit.capture.fake_rig import PROJECTOR, Scene
from tests.unit.drivers.picamera2.fake_picamera2 import Pi
from tests.virtual_clock import VirtualClock

SLOW = pytest.mark.slow
# The tables of these promise how late a frame comes at most.
PROMISED = pytest.mark.realtime


@dataclass(frozen=True)
class Disturbed:
    """A device and its driver. `stage` is what the cameras see; of a gain of 1 if not told otherwise."""

    open_head: Callable[[], ScannerHead]
    stage: Stage
    sequence: PatternSequence
    exposure_s: float
    gain: float = 1.0
    timeout_s: float = 2.0
    longest_idle_s: float = 0.05

    def count(self, frames: int, *, seed: int = 1) -> PairingResult:
        """Scan, believing every frame that the driver gives, and compare each with what its pattern looks like."""

        def open_rig() -> Rig:
            rig = rig_of(self.open_head())
            return replace(rig, settings=dict.fromkeys(rig.cameras, CameraSettings(self.exposure_s, self.gain)))

        def expected(_: str, index: int) -> Pixels:
            return self.stage.expected(self.sequence.profiles[index], exposure_s=self.exposure_s * self.gain)

        return wrong_pairings(
            open_rig,
            self.sequence,
            expected,
            frames=frames,
            seed=seed,
            longest_idle_s=self.longest_idle_s,
            timeout_s=self.timeout_s,
            most_scans=200,
            proven=False,
        )


Opens = Callable[[ExitStack, Path], Disturbed]
"""Makes the device in a folder; what is to be let go afterwards is put on the stack."""


def v4l2(leaving: ExitStack, _: Path, *, stamp: str) -> Disturbed:
    faked = Faked(
        stamp=stamp, readout_s=0.0015, rolling=True, jitter_s=0.001, lost=0.1, corrupt=0.05, noise_when_corrupt=False
    )
    device = leaving.enter_context(v4l2_bench.VirtualDevice(v4l2_bench.virtually(noise_dn=1.0), faked))

    def open_head() -> BenchHead:
        camera = device.open_camera(frame_rate_hz=400, gain_unity=GAIN_UNITS)
        return BenchHead({"left": camera}, StagedProjector(device.stage), clock=device.clock)

    return Disturbed(open_head, device.stage, sequence_for(v4l2_bench.PROJECTOR), 0.0008, 8.0)


def picamera2(_: ExitStack, __: Path) -> Disturbed:
    scene = Scene(camera=Size(100, 75), columns_per_px=1.2, rows_per_px=1.2, noise_dn=0.8, bit_depth=10)
    pi = Pi(Stage(scene, latency_s=0.002, jitter_s=0.003, clock=VirtualClock()), lost=0.1, damaged=0.05)

    def open_head() -> BenchHead:
        return BenchHead({"left": pi.opened()}, StagedProjector(pi.stage), clock=pi.stage.clock)

    return Disturbed(open_head, pi.stage, sequence_for(PROJECTOR), 0.005)


def opencv_network(leaving: ExitStack, folder: Path) -> Disturbed:
    """Three network cameras, one of them through a pipe."""
    network = opencv_bench.NetworkCamera(
        v4l2_bench.staged(noise_dn=1.0),
        period_s=0.008,
        exposure_s=0.004,
        delay_s=0.008,
        least_delay_s=0.002,
        lost=0.1,
        cut=0.05,
    )
    tables = {}
    for index in range(3):
        own = replace(network, seed=index, gone=threading.Event())
        if index == 0:
            device = str(leaving.enter_context(opencv_bench.Piped(own, folder / "video.mjpeg")).path)
        else:
            device = leaving.enter_context(opencv_bench.Served(own)).url
        tables[f"eye{index}"] = own.options(device)

    def open_head() -> BenchHead:
        cameras: dict[str, Camera] = {name: open_opencv_camera(name, table, folder) for name, table in tables.items()}
        return BenchHead(cameras, StagedProjector(network.stage))

    return Disturbed(
        open_head, network.stage, sequence_for(v4l2_bench.PROJECTOR), network.exposure_s, longest_idle_s=0.1
    )


def oak(_: ExitStack, __: Path) -> Disturbed:
    library = pytest.importorskip("tests.unit.drivers.depthai.fake_oak")
    small = Size(64, 48)
    scene = Scene(camera=small, projector=small, columns_per_px=0.8, noise_dn=0.3)
    stage = Stage(scene, latency_s=0.001, jitter_s=0.002)
    fault = library.Fault(dropped=0.1, damaged=0.05, repeated=0.02, late_s=0.006)
    return Disturbed(partial(depthai_bench.oak_head, stage, fps=200.0, fault=fault), stage, sequence_for(small), 0.003)


def fates() -> Callable[[], Fate]:
    """Of all frames 10 % are lost, 5 % broken; all are exposed late by up to 3 ms, some by 40 ms, and some lie in the
    camera for 30 ms.
    """
    rng = np.random.default_rng(7)

    def fate() -> Fate:
        luck = rng.random()
        late_s = 0.04 if rng.random() < 0.005 else 0.003 * float(rng.random())
        held_s = 0.03 if rng.random() < 0.01 else 0.0
        return Fate(late_s, 1.0 if luck < 0.1 else 0.5 if luck < 0.15 else 0.0, held_s)

    return fate


def _by_genicam(stage: Stage, open_camera: Callable[..., Camera], *, free: bool, **options: object) -> Disturbed:
    """A camera that is triggered by software, or hides that it can be, and runs free."""

    def open_head() -> BenchHead:
        camera = open_camera(**options)
        return BenchHead({"left": genicam_bench.FreeOnly(camera) if free else camera}, StagedProjector(stage))

    return Disturbed(
        open_head,
        stage,
        sequence_for(genicam_bench.PROJECTOR),
        0.001,
        10.0,
        timeout_s=1.0 if free else 0.026,
        longest_idle_s=0.03,
    )


def _noisy() -> Stage:
    return Stage(genicam_bench.scene(noise_dn=1.0), latency_s=0.0005, jitter_s=0.002, seed=3)


def genicam(leaving: ExitStack, _: Path, *, free: bool, latched: bool = True) -> Disturbed:
    peer = leaving.enter_context(genicam_bench.FakeGigE(_noisy(), kind="sfnc", fate=fates()))
    device = INTERFACE
    if latched:
        device = leaving.enter_context(Relay()).address
    more = {"features": {"AcquisitionFrameRate": 125.0}, "transfer_s": 0.05} if free else {"answer_s": 0.02}
    return _by_genicam(peer.stage, genicam_bench.opened, free=free, device=device, packet_resend=False, **more)


def gentl(leaving: ExitStack, _: Path, *, free: bool) -> Disturbed:
    producer = leaving.enter_context(gentl_bench.serving(MemoryCamera(_noisy(), fate=fates())))
    return _by_genicam(producer.camera.stage, partial(gentl_bench.opened, producer), free=free, answer_s=0.02)


DISTURBED: Mapping[str, tuple[Opens, tuple[pytest.MarkDecorator, ...]]] = {
    **{
        f"v4l2, stamps: {stamp}": (partial(v4l2, stamp=stamp), () if stamp in {"start", "end"} else (SLOW,))
        for stamp in v4l2_bench.STAMPS
    },
    "picamera2": (picamera2, ()),
    "opencv, network": (opencv_network, (PROMISED,)),
    "depthai": (oak, ()),
    "genicam, software trigger": (partial(genicam, free=False, latched=False), (SLOW,)),
    "genicam, free": (partial(genicam, free=True), (SLOW,)),
    "genicam, free, no clock": (partial(genicam, free=True, latched=False), (PROMISED,)),
    "gentl, software trigger": (partial(gentl, free=False), (SLOW,)),
    "gentl, free": (partial(gentl, free=True), (SLOW,)),
}
"""By name, what makes the bench, and the marks of a test on it: those on virtual time are quick."""

"""Frames paired with patterns while frames are lost, broken and late, and the reader dawdles: no wrong pair, ever."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest

from drivers.genicam import GenicamCamera
from slrig.devices import CameraSettings, Trigger
from slrig.errors import FrameTimeoutError
from slrig.model import Frame
from tests.contract.genicam_bench import FakeGigE, Fate, scene, sequence
from tests.contract.genicam_relay import Relay
from tests.contract.pairing import FRAMES
from tests.contract.stage import REFERENCE_EXPOSURE_S, Stage, StagedProjector

Opened = Callable[..., GenicamCamera]
EXPOSURE_S, GAIN = 0.001, 10.0
"""As bright as the stage's reference, and short."""


class Disturbed:
    """What becomes of frames: 10 % are lost, 5 % broken; all are exposed late by up to 3 ms, some by 40 ms, and some
    lie in the camera for 30 ms.
    """

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self.counts: Counter[str] = Counter()

    def __call__(self) -> Fate:
        luck = self._rng.random()
        kind = "lost" if luck < 0.10 else "broken" if luck < 0.15 else "sound"
        self.counts[kind] += 1
        late_s = 0.04 if self._rng.random() < 0.005 else 0.003 * float(self._rng.random())
        held_s = 0.03 if self._rng.random() < 0.01 else 0.0
        return Fate(late_s, {"lost": 1.0, "broken": 0.5, "sound": 0.0}[kind], held_s)


class Pairing:
    """Shows random patterns, reads a frame of each, and asks of which pattern its image is."""

    def __init__(self, stage: Stage, camera: GenicamCamera, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._camera = camera
        self._sequence = sequence()
        self._projector = StagedProjector(stage)
        self._projector.load(self._sequence)
        truths = [stage.expected(profile, exposure_s=REFERENCE_EXPOSURE_S) for profile in self._sequence.profiles]
        self._truths = np.stack(truths).astype(np.float32)
        self._idle = threading.Event()
        self.accepted = 0
        self.wrong: list[tuple[int, int]] = []
        self.frames: list[Frame] = []

    def run(self, count: int, *, trigger: Trigger, timeout_s: float) -> None:
        while self.accepted < count:
            index = int(self._rng.integers(len(self._sequence)))
            shown = self._projector.show(index)
            if trigger is Trigger.SOFTWARE:
                self._camera.trigger()
            if self._rng.random() < 0.05:
                self._idle.wait(0.03 * float(self._rng.random()))
            try:
                frame = self._camera.read(shown.t_visible_ns + shown.t_err_ns, timeout_s)
            except FrameTimeoutError:
                continue
            self.accepted += 1
            self.frames.append(frame)
            seen = int(np.abs(self._truths - frame.image).mean(axis=(1, 2)).argmin())
            # White and black are in the sequence twice.
            if self._sequence.patterns[seen] != self._sequence.patterns[index]:
                self.wrong.append((index, seen))


def numbers_rise(frames: list[Frame]) -> bool:
    return bool((np.diff([frame.sequence_number for frame in frames]) > 0).all())


@pytest.fixture
def disturbed(peer: FakeGigE) -> Disturbed:
    peer.stage = Stage(scene(noise_dn=1.0), latency_s=0.0005, jitter_s=0.002, seed=3)
    fate = Disturbed(7)
    peer.fate = fate
    return fate


@pytest.mark.slow
def test_triggered_frames_show_what_they_are_paired_with(peer: FakeGigE, disturbed: Disturbed, opened: Opened) -> None:
    camera = opened(answer_s=0.02, packet_resend=False)
    camera.configure(CameraSettings(EXPOSURE_S, GAIN))
    camera.arm(100, Trigger.SOFTWARE)
    pairing = Pairing(peer.stage, camera, 1)
    pairing.run(FRAMES, trigger=Trigger.SOFTWARE, timeout_s=0.026)
    assert pairing.wrong == []
    assert numbers_rise(pairing.frames)
    # Every frame that was made is accounted for: delivered, lost, or passed over.
    assert disturbed.counts["lost"] > 0.075 * FRAMES
    assert disturbed.counts["broken"] > 0.03 * FRAMES
    dropped = pairing.frames[-1].dropped_count
    assert dropped >= disturbed.counts["lost"] - 5


@pytest.mark.slow
@pytest.mark.parametrize(("latched", "count"), [(True, FRAMES), (False, FRAMES // 2)])
def test_free_running_frames_show_what_they_are_paired_with(
    peer: FakeGigE, disturbed: Disturbed, opened: Opened, latched: bool, count: int
) -> None:
    with Relay() as relay:
        address = relay.address if latched else "127.0.0.1"
        features = {"AcquisitionFrameRate": 125.0}
        camera = opened(device=address, features=features, packet_resend=False, transfer_s=0.05)
        camera.configure(CameraSettings(EXPOSURE_S, GAIN))
        camera.arm(100, Trigger.FREE)
        pairing = Pairing(peer.stage, camera, 2)
        pairing.run(count, trigger=Trigger.FREE, timeout_s=1.0)
        camera.close()
    assert pairing.wrong == []
    assert numbers_rise(pairing.frames)
    assert disturbed.counts["lost"] > count / 20

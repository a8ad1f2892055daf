"""Pairing under disturbance: two thousand frames of a pair that loses, damages, repeats and delays them."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
import pytest

from slrig.devices import CameraSettings, Trigger
from slrig.model import PatternSequence, Size
from tests.contract.depthai_bench import oak_head, sequence
from tests.contract.pairing import FRAMES
from tests.unit.drivers.depthai.conftest import small_stage
from tests.unit.drivers.depthai.fake_oak import Fault

EXPOSURE_S = 0.003
FPS = 200.0


@dataclass
class Count:
    """What came of it: frames accepted, those that show another pattern, and the worst likeness, DN."""

    accepted: int = 0
    wrong: int = 0
    lost: int = 0
    worst_dn: float = 0.0


def run(frames: int, shown: PatternSequence) -> Count:
    rng = np.random.default_rng(7)
    stage = small_stage(latency_s=0.001, jitter_s=0.002)
    expected = np.stack([stage.expected(profile, exposure_s=EXPOSURE_S) for profile in shown.profiles]).astype(float)
    fault = Fault(dropped=0.1, damaged=0.05, repeated=0.02, late_s=0.006)
    head = oak_head(stage, fps=FPS, fault=fault)
    count = Count()
    idle = threading.Event()
    try:
        for camera in head.cameras.values():
            camera.configure(CameraSettings(EXPOSURE_S))
        for camera in head.cameras.values():
            camera.arm(frames, Trigger.FREE)
        head.projector.load(shown)
        index = 0
        while count.accepted < frames:
            # Never the same pattern twice running: a stale frame would look right.
            index = (index + int(rng.integers(1, len(shown)))) % len(shown)
            visible = head.projector.show(index)
            if rng.random() < 0.2:
                idle.wait(float(rng.uniform(0, 0.04)))
            for camera in head.cameras.values():
                frame = camera.read(visible.t_visible_ns + visible.t_err_ns, 5.0)
                off_dn = np.abs(expected - frame.image).mean(axis=(1, 2))
                count.accepted += 1
                count.wrong += int(np.argmin(off_dn)) != index
                count.worst_dn = max(count.worst_dn, float(off_dn[index]))
                count.lost = max(count.lost, frame.dropped_count)
    finally:
        head.close()
    return count


def apart_dn(shown: PatternSequence) -> float:
    """How little two patterns differ at least."""
    stage = small_stage()
    images = np.stack([stage.expected(profile, exposure_s=EXPOSURE_S) for profile in shown.profiles]).astype(float)
    off_dn = np.abs(images[:, None] - images[None]).mean(axis=(2, 3))
    return float(off_dn[~np.eye(len(images), dtype=bool)].min())


@pytest.mark.parametrize("frames", [120, pytest.param(FRAMES, marks=pytest.mark.slow)])
def test_no_frame_is_paired_with_another_pattern(frames: int) -> None:
    shown = sequence(Size(64, 48))
    shown = PatternSequence(shown.projector, shown.patterns[:12], shown.profiles[:12])
    count = run(frames, shown)
    assert count.accepted >= frames
    assert count.wrong == 0
    # A tenth of another pattern's light in a frame would be seen.
    assert count.worst_dn < 0.1 * apart_dn(shown) + 1
    assert count.lost > frames / 20

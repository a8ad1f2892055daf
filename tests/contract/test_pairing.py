"""No frame is paired with a pattern that it does not show, on a disturbed rendered rig; and what is counted counts."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slrig.devices import AppliedSettings, Camera, CameraInfo, CameraSettings, Rig, Trigger
from slrig.model import Frame, Shot
from tests.contract.benches import beamer, eyes, simulated
from tests.contract.pairing import FRAMES, PairingResult, Truths, seen_by, wrong_pairings
from tests.contract.suite import Bench

DISTURBED = {"drop_probability": 0.1, "corrupt_probability": 0.05, "stale_probability": 0.03, "jitter_s": 0.01}
SEEDS = [int(seed) for seed in os.environ.get("SLRIG_PAIRING_SEEDS", "3").split(",")]
# By name what a bench has and the ideal rig has not.
LIGHTS: dict[str, dict[str, Any]] = {
    "scaler": {"projector": beamer(signal_blur_px=0.55)},
    "webcam": {"camera": eyes(response=0.45)},
    "bright room": {"ambient": 0.3},
    "brighter picture": {"camera": eyes(saturation_s=0.0215)},
    "creeping exposure": {"camera": eyes(exposure_drift=0.0015)},
    "rolling bands": {"camera": eyes(line_time_s=3e-5), "ambient": 0.1, "ambient_flicker_depth": 0.3},
    "unresolved": {"camera": eyes(size_px=[80, 60], focal_px=[400.0, 400.0])},
    "out of focus": {"camera": eyes(blur_px=1.5)},
    "focus over depth": {"projector": beamer(focus_mm=400.0, defocus_px=5.0), "camera": eyes(defocus_px=8.0)},
}
FREE = frozenset({Trigger.FREE})


class FreeRunning:
    """A camera that runs by itself, with its four buffers. A broken one delivers what lies in them."""

    def __init__(self, camera: Camera, *, broken: bool) -> None:
        self._camera = camera
        self._broken = broken

    @property
    def info(self) -> CameraInfo:
        return replace(self._camera.info, triggers=FREE)

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        return self._camera.configure(settings)

    def arm(self, count: int, trigger: Trigger) -> None:
        self._camera.arm(count, trigger)

    def trigger(self) -> None:
        self._camera.trigger()

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        frame = self._camera.read(0 if self._broken else after_ns, timeout_s)
        # It does not say so, either.
        late_ns = max(after_ns - frame.t_start_ns, 0)
        return replace(frame, t_start_ns=frame.t_start_ns + late_ns, t_end_ns=frame.t_end_ns + late_ns)

    def disarm(self) -> None:
        self._camera.disarm()

    def close(self) -> None:
        self._camera.close()


@pytest.fixture
def sound(tmp_path: Path) -> Bench:
    (tmp_path / "sound").mkdir()
    return simulated(tmp_path / "sound")


def counted(
    bench: Bench, sound: Bench, *, frames: int, broken: bool | None = None, proven: bool = True, most_scans: int = 1000
) -> PairingResult:
    def open_rig() -> Rig:
        rig = bench.open_rig()
        if broken is None:
            return rig
        return replace(rig, cameras={name: FreeRunning(each, broken=broken) for name, each in rig.cameras.items()})

    expected = seen_by(sound.open_rig, sound.sequence)
    return wrong_pairings(
        open_rig, bench.sequence, expected, frames=frames, seed=5, proven=proven, most_scans=most_scans
    )


@pytest.mark.slow
@pytest.mark.parametrize("scene", LIGHTS.values(), ids=LIGHTS)
def test_real_light_is_no_alarm_and_hides_no_fault(tmp_path: Path, scene: dict[str, Any]) -> None:
    """Half of FRAMES for each of nine: 2000 of each were counted when this was written, three seeds.

    What light does to clean frames it does to every scan alike: a few scans show it.
    """
    frames = FRAMES // 2
    (tmp_path / "sound").mkdir()
    (tmp_path / "disturbed").mkdir()
    sound = simulated(tmp_path / "sound", **scene)
    clean = counted(sound, sound, frames=frames // 2)
    assert (clean.wrong, clean.examples, clean.shot_again, clean.refused_scans) == (0, (), 0, 0)
    for seed in SEEDS:
        disturbed = simulated(tmp_path / "disturbed", faults=DISTURBED, seed=seed, **scene)
        result = counted(disturbed, sound, frames=frames)
        assert result.frames >= frames
        assert (result.wrong, result.examples) == (0, ())
        assert result.shot_again > frames / 10


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1])
@pytest.mark.parametrize("free", [False, True], ids=["software trigger", "free-running"])
def test_no_wrong_pairing_in_many_frames(tmp_path: Path, sound: Bench, seed: int, free: bool) -> None:
    bench = simulated(tmp_path, faults=DISTURBED, seed=seed)
    result = counted(bench, sound, frames=FRAMES, broken=False if free else None)
    assert result.frames >= FRAMES
    assert (result.wrong, result.examples) == (0, ())
    assert result.shot_again > 0.15 * FRAMES
    assert result.refused_scans < result.scans / 2


def test_what_the_evidence_keeps_away_is_found_without_it(tmp_path: Path, sound: Bench) -> None:
    result = counted(simulated(tmp_path, faults=DISTURBED, seed=3), sound, frames=300, proven=False)
    assert 0.02 < result.wrong / result.frames < 0.15
    assert result.refused_scans < result.scans


@pytest.mark.slow
def test_a_driver_that_delivers_old_frames_is_found(tmp_path: Path, sound: Bench) -> None:
    alone = counted(simulated(tmp_path), sound, frames=200, broken=True, proven=False)
    assert alone.wrong > 20
    # A scan believes none of it.
    scanned = counted(simulated(tmp_path), sound, frames=200, broken=True, most_scans=4)
    assert (scanned.frames, scanned.wrong, scanned.refused_scans) == (0, 0, 4)


def test_a_sound_driver_needs_no_evidence(tmp_path: Path, sound: Bench) -> None:
    result = counted(simulated(tmp_path), sound, frames=200, broken=False, proven=False)
    assert (result.wrong, result.shot_again, result.refused_scans) == (0, 0, 0)


def test_a_frame_is_wrong_when_it_is_nearer_to_another_pattern_or_damaged(sound: Bench) -> None:
    truths = Truths.of("left", sound.sequence, seen_by(sound.open_rig, sound.sequence))
    images = [image.astype(np.uint8) for image in truths.images]
    assert all(truths.wrong(Shot(index, "left", image)) is None for index, image in enumerate(images))
    # White and black come twice, and either frame is right; nothing else is.
    count = len(images)
    alike = {0: count - 2, 1: count - 1, count - 2: 0, count - 1: 1}
    for index in range(count):
        for other in set(range(count)) - {index, alike.get(index, index)}:
            assert truths.wrong(Shot(index, "left", images[other])) is not None
    damaged = images[5].copy()
    damaged[40:50] = 255 - damaged[40:50]
    assert truths.wrong(Shot(5, "left", damaged)) == "camera 'left': the frame paired with pattern 5 is damaged"

"""No frame is paired with a pattern that it does not show: every driver on a disturbed device, and whole scans."""

from __future__ import annotations

import os
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slrig.devices import Camera, Rig
from slrig.model import Frame, Shot
from tests.contract.benches import beamer, eyes, simulated
from tests.contract.disturbed import DISTURBED, Opens
from tests.contract.genicam_bench import FreeOnly
from tests.contract.pairing import FRAMES, Expected, PairingResult, Truths, seen_by, wrong_pairings
from tests.contract.suite import Bench

FEW = 60
"""Frames that a test counts where a longer one counts FRAMES."""


# ---- what the drivers let pass


@pytest.mark.parametrize(
    ("opens", "frames"),
    [pytest.param(opens, FRAMES if marks else FEW, marks=marks, id=name) for name, (opens, marks) in DISTURBED.items()],
)
def test_a_driver_gives_no_frame_of_another_pattern(tmp_path: Path, opens: Opens, frames: int) -> None:
    with ExitStack() as leaving:
        result = opens(leaving, tmp_path).count(frames)
    assert result.frames >= frames
    assert (result.wrong, result.examples) == (0, ())


# ---- what the evidence of a scan lets pass, on the rendered rig

DAMAGED = {"drop_probability": 0.1, "corrupt_probability": 0.05, "stale_probability": 0.03, "jitter_s": 0.01}
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


class BrokenDriver(FreeOnly):
    """Delivers what lies in the camera's buffers, and says that it was exposed when it was asked for."""

    def __init__(self, camera: Camera) -> None:
        super().__init__(camera)
        self.read = self._read

    def _read(self, after_ns: int, timeout_s: float) -> Frame:
        frame = self._camera.read(0, timeout_s)
        late_ns = max(after_ns - frame.t_start_ns, 0)
        return replace(frame, t_start_ns=frame.t_start_ns + late_ns, t_end_ns=frame.t_end_ns + late_ns)


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return simulated(tmp_path_factory.mktemp("sound"))


@pytest.fixture(scope="module")
def truth(sound: Bench) -> Expected:
    return seen_by(sound.open_rig, sound.sequence)


def counted(
    bench: Bench,
    truth: Expected,
    *,
    frames: int,
    driver: type[FreeOnly] | None = None,
    proven: bool = True,
    most_scans: int = 1000,
) -> PairingResult:
    def open_rig() -> Rig:
        rig = bench.open_rig()
        if driver is None:
            return rig
        return replace(rig, cameras={name: driver(each) for name, each in rig.cameras.items()})

    return wrong_pairings(open_rig, bench.sequence, truth, frames=frames, seed=5, proven=proven, most_scans=most_scans)


@pytest.mark.slow
@pytest.mark.parametrize("scene", LIGHTS.values(), ids=LIGHTS)
def test_real_light_is_no_alarm_and_hides_no_fault(tmp_path: Path, scene: dict[str, Any]) -> None:
    """Half of FRAMES for each of nine: 2000 of each were counted when this was written, three seeds.

    What light does to clean frames it does to every scan alike: a few scans show it.
    """
    frames = FRAMES // 2
    bench = simulated(tmp_path, **scene)
    truth = seen_by(bench.open_rig, bench.sequence)
    clean = counted(bench, truth, frames=frames // 2)
    assert (clean.wrong, clean.examples, clean.shot_again, clean.refused_scans) == (0, (), 0, 0)
    for seed in SEEDS:
        result = counted(simulated(tmp_path, faults=DAMAGED, seed=seed, **scene), truth, frames=frames)
        assert result.frames >= frames
        assert (result.wrong, result.examples) == (0, ())
        assert result.shot_again > frames / 10


@pytest.mark.slow
@pytest.mark.parametrize("driver", [None, FreeOnly], ids=["software trigger", "free-running"])
def test_a_scan_believes_no_wrong_frame(tmp_path: Path, truth: Expected, driver: type[FreeOnly] | None) -> None:
    result = counted(simulated(tmp_path, faults=DAMAGED, seed=1), truth, frames=FRAMES, driver=driver)
    assert result.frames >= FRAMES
    assert (result.wrong, result.examples) == (0, ())
    assert result.shot_again > 0.15 * FRAMES
    assert result.refused_scans < result.scans / 2


def test_a_driver_that_delivers_old_frames_is_found(sound: Bench, truth: Expected) -> None:
    alone = counted(sound, truth, frames=1, driver=BrokenDriver, proven=False)
    assert alone.wrong > 5
    # A scan believes none of it.
    scanned = counted(sound, truth, frames=1, driver=BrokenDriver, most_scans=1)
    assert (scanned.frames, scanned.wrong, scanned.refused_scans) == (0, 0, 1)
    honest = counted(sound, truth, frames=1, driver=FreeOnly, proven=False)
    assert (honest.wrong, honest.shot_again, honest.refused_scans) == (0, 0, 0)


def test_a_frame_is_wrong_when_it_is_nearer_to_another_pattern_or_damaged(sound: Bench, truth: Expected) -> None:
    truths = Truths.of("left", sound.sequence, truth)
    images = [image.astype(np.uint8) for image in truths.images]
    assert all(truths.wrong(Shot(index, "left", image)) is None for index, image in enumerate(images))
    # White and black come twice, and either frame is right; nothing else is.
    count = len(images)
    alike = {0: count - 2, 1: count - 1, count - 2: 0, count - 1: 1}
    for index in range(2, count, 5):
        for other in set(range(count)) - {index, alike.get(index, index)}:
            assert truths.wrong(Shot(index, "left", images[other])) is not None
    damaged = images[5].copy()
    damaged[40:50] = 255 - damaged[40:50]
    assert truths.wrong(Shot(5, "left", damaged)) == "camera 'left': the frame paired with pattern 5 is damaged"

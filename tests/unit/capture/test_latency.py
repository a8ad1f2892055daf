"""The flash test on rendered rigs, and what a scan makes of what it found."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slrig.capture.latency import LatencyMeasurement, measure_latency, shutter_skew_s, stable_from_ns
from slrig.capture.latency_fit import Flash, FlashRows, RowLevels, rows_of
from slrig.config import read_rig
from slrig.devices import CameraSettings, Rig, Shown, Synchronisation, SystemClock, Trigger
from slrig.discovery import open_rig
from slrig.errors import ConfigError, ScanEvidenceError, UnsupportedByDeviceError
from tests.unit.capture.test_latency_fit import STATED_NS, World, both_ways, step
from tests.unit.simulated_rig.building import small_head


def rig(folder: Path, camera: Mapping[str, Any] | None = None, **head: Any) -> Rig:
    made = small_head(folder, camera={"line_time_s": 1e-4, **(camera or {})}, ambient=0.05, samples_per_axis=1, **head)
    return Rig("bench", made.cameras, made.projector, {"eye": CameraSettings(0.01)}, None, made, None, made.clock)


@pytest.mark.slow
def test_a_frame_after_the_measured_instant_shows_the_new_light_alone(tmp_path: Path) -> None:
    late = rig(tmp_path, faults={"light_delay_s": 0.03})
    found = measure_latency(late, trials=12)
    camera, projector = late.cameras["eye"], late.projector
    camera.arm(60, Trigger.FREE)
    means: dict[tuple[bool, int], list[float]] = {}
    for turn in range(40):
        index = turn % 2
        shown = projector.show(index)
        waits = turn % 4 < 2
        after_ns = stable_from_ns(shown, found.synchronisation if waits else None)
        means.setdefault((waits, index), []).append(float(camera.read(after_ns, 1.0).image.mean()))
        late.clock.wait_until(late.clock.now_ns() + 100_000_000 + turn * 1_300_000, threading.Event())
    assert np.ptp(means[True, 0]) < 1
    assert np.ptp(means[True, 1]) < 1
    # Without the measurement, frames of the old light are taken for the new.
    assert np.mean(means[False, 0]) < np.mean(means[True, 0]) - 5


@pytest.mark.parametrize("trigger", [Trigger.FREE, Trigger.SOFTWARE])
def test_frames_that_are_lost_do_no_harm(tmp_path: Path, trigger: Trigger) -> None:
    lossy = rig(tmp_path, faults={"light_delay_s": 0.012, "drop_probability": 0.1})
    found = measure_latency(lossy, trigger=trigger).cameras["eye"]
    assert found.latency_s == pytest.approx(0.012, abs=5e-4)
    assert found.line_time_s == pytest.approx(1e-4, rel=0.02)


def test_a_camera_in_step_with_the_display_is_started_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One at 120 frames a second before 240 refreshes saw 6 of 160 flashes, in the phase in which it had begun."""
    usual = rig(tmp_path, faults={"light_delay_s": 0.012})
    eye = usual.cameras["eye"]
    arm, armed = eye.arm, list[int]()

    def counted(count: int, trigger: Trigger) -> None:
        armed.append(0)
        arm(count, trigger)

    def rows(flash: Flash, levels: RowLevels) -> FlashRows | None:
        return rows_of(flash, levels) if len(armed) == 2 else None

    monkeypatch.setattr(eye, "arm", counted)
    monkeypatch.setattr("slrig.capture.latency.rows_of", rows)
    found = measure_latency(usual, trials=12).cameras["eye"]
    assert len(armed) == 2
    assert found.latency_s == pytest.approx(0.012, abs=5e-4)


@pytest.mark.parametrize("interrupted", [False, True])
def test_the_rig_is_dark_and_usable_after_the_test(tmp_path: Path, interrupted: bool) -> None:
    usual = rig(tmp_path)
    fractions: list[float] = []

    def told(_stage: str, fraction: float, _detail: str) -> None:
        fractions.append(fraction)
        if interrupted and fraction > 0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) if interrupted else nullcontext():
        measure_latency(usual, trials=8, told=told)
    usual.cameras["eye"].arm(1, Trigger.FREE)
    assert fractions[0] == 0
    assert interrupted or fractions[-1] == 1
    assert usual.head is not None
    assert not usual.head.projector.lit  # type: ignore[attr-defined]


def test_a_lamp_that_is_off_and_a_way_of_triggering_that_a_camera_has_not_end_the_test(tmp_path: Path) -> None:
    with pytest.raises(ScanEvidenceError, match="'eye' sees no flash"):
        measure_latency(rig(tmp_path, faults={"lamp_off": True}))
    with pytest.raises(UnsupportedByDeviceError, match="free, software"):
        measure_latency(rig(tmp_path), trigger=Trigger.HARDWARE)


def test_light_before_the_first_trigger_is_explained(tmp_path: Path) -> None:
    still = {"line_time_s": 0.0}
    with pytest.raises(ScanEvidenceError, match="between two exposures"):
        measure_latency(rig(tmp_path, still), trigger=Trigger.SOFTWARE)
    # Exposures that began before show and last until the light comes do see it.
    prompt = rig(tmp_path, still, projector={"latency_s": 0.006})
    found = measure_latency(prompt, trigger=Trigger.SOFTWARE, exposure_s=0.015, trials=10)
    assert found.cameras["eye"].latency_s == pytest.approx(0.0, abs=5e-4)


# ---- what is done with it


def test_a_pattern_is_stable_when_the_projector_says_so_unless_measured() -> None:
    shown = Shown(3, 1_000_000_000, 400_000)
    assert stable_from_ns(shown, None) == 1_000_400_000
    assert stable_from_ns(shown, Synchronisation(0.047, 0.002)) == 1_049_400_000
    assert stable_from_ns(shown, Synchronisation(-0.01, 0.002)) == 992_400_000


def test_the_slowest_camera_is_waited_for() -> None:
    quick = World(both_ways(step(0.004))).measured()
    slow = World(both_ways(step(0.012)), line_s=6e-5).measured()
    found = LatencyMeasurement({"quick": quick, "slow": slow}, 0.0005)
    kept = found.synchronisation
    assert kept.latency_s == slow.latency_s
    # Beyond the half millisecond that the projector states, next to nothing.
    assert -0.0005 < kept.latency_error_s < 0
    assert kept.earliest_s == quick.earliest_s
    assert set(kept.line_time_s) == {"slow"}
    for camera in (quick, slow):
        shown = Shown(0, STATED_NS, 500_000)
        assert stable_from_ns(shown, kept) >= STATED_NS + camera.latest_s * 1e9


def test_the_time_of_a_rig_on_metal_is_the_monotonic_clock() -> None:
    clock, stop = SystemClock(), threading.Event()
    before_ns = clock.now_ns()
    clock.wait_until(before_ns + 2_000_000, stop)
    assert clock.now_ns() >= before_ns + 2_000_000
    stop.set()
    # A day from now: only the event ends this wait.
    clock.wait_until(before_ns + 86_400_000_000_000, stop)
    assert clock.now_ns() < before_ns + 3_600_000_000_000


RIG = """
name = "bench"
[head]
driver = "simulated"
scene = "scene.toml"
[head.projector]
size_px = [80, 60]
focal_px = [400.0, 400.0]
position_mm = [60.0, 0.0, -500.0]
target_mm = [0.0, 0.0, 0.0]
[[head.camera]]
name = "eye"
size_px = [64, 48]
focal_px = [400.0, 400.0]
position_mm = [-60.0, 0.0, -500.0]
target_mm = [0.0, 0.0, 0.0]
"""


def rig_file(folder: Path, text: str) -> Path:
    small_head(folder)
    path = folder / "rig.toml"
    path.write_text(RIG + text)
    return path


def test_a_rig_file_keeps_what_was_measured(tmp_path: Path) -> None:
    path = rig_file(
        tmp_path, "[synchronisation]\nlatency_s = 0.047\nlatency_error_s = 0.001\nline_time_s = { eye = 15e-6 }\n"
    )
    with open_rig(read_rig(path)) as opened:
        assert opened.synchronisation == Synchronisation(0.047, 0.001, {"eye": 15e-6})
        skew_s = shutter_skew_s(opened.cameras["eye"], "eye", opened.synchronisation)
        assert skew_s == pytest.approx(47 * 15e-6)
        assert shutter_skew_s(opened.cameras["eye"], "eye", None) == 0
        # A rendered rig lives on time of its own, which begins at 1 s.
        assert opened.clock.now_ns() == 1_000_000_000
    with open_rig(read_rig(rig_file(tmp_path, ""))) as opened:
        assert opened.synchronisation is None


def test_a_line_time_of_no_camera_is_refused(tmp_path: Path) -> None:
    table = "[synchronisation]\nlatency_s = 0.0\nlatency_error_s = 0.0\nline_time_s = { nose = 15e-6 }\n"
    with pytest.raises(ConfigError, match="names nose, the rig's cameras are eye"):
        open_rig(read_rig(rig_file(tmp_path, table)))
    path = tmp_path / "two.toml"
    path.write_text(f'name = "two"\n{table}[projector]\ndriver = "x"\n[[camera]]\ndriver = "y"\nname = "left"\n')
    with pytest.raises(ConfigError, match=r"cameras of this rig \(left\), found nose"):
        read_rig(path)

"""The flash test on rendered rigs, and what a scan makes of what it found."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slrig.capture.latency import (
    DEFAULT_TRIALS,
    CameraLatency,
    LatencyMeasurement,
    LightChange,
    RowLevels,
    TransitionRows,
    find_transition_rows,
    fit_latency,
    measure_latency,
    row_levels,
    shutter_skew_s,
    stable_from_ns,
)
from slrig.config import read_rig
from slrig.devices import CameraSettings, DisplayedPattern, Rig, Synchronisation, SystemClock, Trigger
from slrig.discovery import open_rig
from slrig.errors import ConfigError, ScanEvidenceError, UnsupportedByDeviceError
from slrig.model import FloatArray, Pixels
from tests.core import parametrize_core
from tests.unit.simulated_rig.building import small_head


def rig(folder: Path, camera: Mapping[str, Any] | None = None, **head: Any) -> Rig:
    made = small_head(folder, camera={"line_time_s": 1e-4, **(camera or {})}, ambient=0.05, samples_per_axis=1, **head)
    return Rig("bench", made.cameras, made.projector, {"eye": CameraSettings(0.01)}, None, made, None, made.clock)


@pytest.mark.parametrize("trigger", [pytest.param(Trigger.FREE, marks=pytest.mark.slow), Trigger.SOFTWARE])
def test_lost_frames_are_tolerated(tmp_path: Path, trigger: Trigger) -> None:
    lossy = rig(tmp_path, faults={"light_delay_s": 0.012, "drop_probability": 0.1})
    found = measure_latency(lossy, trigger=trigger).cameras["eye"]
    assert found.latency_s == pytest.approx(0.012, abs=5e-4)
    assert found.line_time_s == pytest.approx(1e-4, rel=0.02)


def test_a_camera_in_phase_with_the_display_is_restarted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One at 120 frames a second before 240 refreshes saw 6 of 160 flashes, in the phase in which it had begun."""
    usual = rig(tmp_path, faults={"light_delay_s": 0.012})
    eye = usual.cameras["eye"]
    arm, armed = eye.arm, list[int]()

    def counted(count: int, trigger: Trigger) -> None:
        armed.append(0)
        arm(count, trigger)

    def rows(flash: LightChange, levels: RowLevels) -> TransitionRows | None:
        return find_transition_rows(flash, levels) if len(armed) == 2 else None

    monkeypatch.setattr(eye, "arm", counted)
    monkeypatch.setattr("slrig.capture.latency.find_transition_rows", rows)
    found = measure_latency(usual, trials=12).cameras["eye"]
    assert len(armed) == 2
    assert found.latency_s == pytest.approx(0.012, abs=5e-4)


@pytest.mark.parametrize("interrupted", [False, True])
def test_the_rig_is_dark_and_usable_after_the_test(tmp_path: Path, interrupted: bool) -> None:
    usual = rig(tmp_path)
    fractions: list[float] = []

    def on_progress(_stage: str, fraction: float, _detail: str) -> None:
        fractions.append(fraction)
        if interrupted and fraction > 0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) if interrupted else nullcontext():
        measure_latency(usual, trials=8, on_progress=on_progress)
    usual.cameras["eye"].arm(1, Trigger.FREE)
    assert fractions[0] == 0
    assert interrupted or fractions[-1] == 1
    assert usual.head is not None
    assert not usual.head.projector.is_lit  # type: ignore[attr-defined]


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
    shown = DisplayedPattern(3, 1_000_000_000, 400_000)
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
        shown = DisplayedPattern(0, STATED_NS, 500_000)
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


# ---- Latency from flashes: projectors and cameras of many kinds, each described by its light and its shutter in time


ROWS, COLUMNS = 60, 20
STATED_NS = 5_000_000_000
GRID_S = 2e-5

Light = Callable[[FloatArray], FloatArray]
"""Light at times since the instant that the projector stated, 0 to 1."""


def step(at_s: float) -> Light:
    return lambda t: (t >= at_s).astype(np.float64)


def ramp(begin_s: float, length_s: float) -> Light:
    return lambda t: np.clip((t - begin_s) / length_s, 0, 1)


@dataclass(frozen=True)
class World:
    """A projector by its light, and a camera. `light(to_white, rng)` is a change of light; steady light is 0 or 1."""

    light: Callable[[bool, np.random.Generator], Light]
    exposure_s: float = 0.01
    period_s: float = 0.012
    line_s: float = 0.0
    scan_s: float = 0.0
    stamp_offset_s: float = 0.0
    noise_dn: float = 0.7
    ambient_dn: float = 20.0
    white_dn: float = 150.0
    steady: Light = lambda t: np.ones_like(t)
    full_scale: int = 255

    def shares(self, light: Light, start_s: float) -> FloatArray:
        """(ROWS,) float64: the mean light on each row during its own exposure."""
        t = np.arange(-0.1, 0.4, GRID_S)
        gathered = np.concatenate([[0.0], np.cumsum(light(t[:-1]) * GRID_S)])
        begin = start_s + np.arange(ROWS) * (self.line_s - self.scan_s)
        return np.asarray(
            (np.interp(begin + self.exposure_s, t, gathered) - np.interp(begin, t, gathered)) / self.exposure_s
        )

    def image(self, shares: FloatArray, rng: np.random.Generator) -> Pixels:
        # Albedo differs between rows and between columns; the outer columns see no projector.
        albedo = np.linspace(0.5, 1.0, ROWS)[:, None] * np.linspace(1.0, 0.7, COLUMNS)
        albedo[:, :3] = 0
        dn = (
            self.ambient_dn
            + self.white_dn * albedo * shares[:, None]
            + self.noise_dn * rng.standard_normal(albedo.shape)
        )
        return np.clip(np.rint(dn), 0, self.full_scale).astype(np.uint16)

    def levels(self, rng: np.random.Generator) -> RowLevels:
        black = [self.image(np.zeros(ROWS), rng) for _ in range(8)]
        white = [self.image(self.shares(self.steady, float(rng.uniform(0, 0.1))), rng) for _ in range(8)]
        return row_levels("eye", black, white, full_scale=self.full_scale)

    def flashes(self, count: int, levels: RowLevels, rng: np.random.Generator) -> list[LightChange]:
        made = []
        for number in range(count):
            to_white = number % 2 == 1
            light = self.light(to_white, rng)
            first_s = -2 * self.period_s + float(rng.uniform(0, self.period_s))
            frames = []
            for start_s in first_s + self.period_s * np.arange(10):
                image = self.image(self.shares(light, start_s), rng)
                stamp_ns = STATED_NS + round((start_s + self.stamp_offset_s) * 1e9)
                frames.append((stamp_ns, self.exposure_s, levels.shares(image)))
            made.append(LightChange.from_frames(to_white, DisplayedPattern(0, STATED_NS, 500_000), frames))
        return made

    def measured(self, *, count: int = 60, seed: int = 0) -> CameraLatency:
        rng = np.random.default_rng(seed)
        levels = self.levels(rng)
        return fit_latency("eye", self.flashes(count, levels, rng), levels)


def both_ways(light: Light) -> Callable[[bool, np.random.Generator], Light]:
    """The same to white and to black, and the same every time."""
    return lambda to_white, _: light if to_white else (lambda t: 1 - light(t))


# ---- the fit


@parametrize_core(("latency_s", "line_s"), [(0.012, 0.0), (-0.004, 1.5e-5), (0.012, 6e-5), (-0.004, 3e-4)], core=[1, 2])
def test_latency_and_line_time_come_out_of_the_rows(latency_s: float, line_s: float) -> None:
    found = World(both_ways(step(latency_s)), line_s=line_s, period_s=0.032).measured()
    assert found.latency_s == pytest.approx(latency_s, abs=1e-4)
    assert found.line_time_s == pytest.approx(line_s, rel=0.02, abs=5e-7)
    assert abs(found.line_time_s - line_s) < 4 * found.line_time_error_s + 1e-9
    assert found.rolling is (line_s > 0)
    assert found.skew_s == pytest.approx((ROWS - 1) * line_s, rel=0.02)
    assert found.jitter_s < 1e-4
    assert found.settle_s == 0


@pytest.mark.slow
def test_the_stated_error_of_the_line_time_is_its_scatter_and_no_shutter_is_taken_for_another() -> None:
    found = [World(both_ways(step(0.003)), line_s=3e-5, noise_dn=3.0).measured(count=30, seed=s) for s in range(30)]
    scatter = np.std([each.line_time_s for each in found], ddof=1)
    stated = np.median([each.line_time_error_s for each in found])
    assert 0.6 < stated / scatter < 1.6
    for seed in range(40):
        still = World(both_ways(step(0.012)), noise_dn=2.0).measured(count=30, seed=seed)
        assert not still.rolling
        assert not still.scanned


def test_a_constant_error_of_the_time_stamps_is_part_of_the_latency() -> None:
    world = World(both_ways(step(0.012)), line_s=5e-5)
    late = replace(world, stamp_offset_s=-0.009).measured()
    assert late.latency_s == pytest.approx(0.003, abs=1e-4)
    assert late.line_time_s == pytest.approx(5e-5, rel=0.02)


def test_light_that_waits_for_the_refresh_is_measured_as_jitter() -> None:
    period_s = 1 / 60

    def at_next_refresh(to_white: bool, rng: np.random.Generator) -> Light:
        return both_ways(step(0.004 + float(rng.uniform(0, period_s))))(to_white, rng)

    found = World(at_next_refresh).measured(count=120)
    assert found.latency_s == pytest.approx(0.004 + period_s / 2, abs=4 * found.standard_error_s)
    assert found.jitter_s == pytest.approx(period_s / 12**0.5, rel=0.2)
    assert found.latency_s < found.latency_p95_s <= found.latest_s
    assert found.earliest_s == pytest.approx(0.004 - 0.6e-3, abs=1e-3)
    assert found.latest_s == pytest.approx(0.004 + period_s + 0.6e-3, abs=1e-3)


@parametrize_core("jitter_s", [0.0, 0.016], core=[1])
def test_a_picture_that_missed_its_refresh_does_not_widen_the_window(jitter_s: float) -> None:
    def world(*missed: int) -> World:
        shown = count()

        def light(to_white: bool, rng: np.random.Generator) -> Light:
            late_s = 0.034 * (next(shown) in missed)
            return both_ways(step(0.004 + late_s + float(rng.uniform(0, jitter_s))))(to_white, rng)

        return World(light, exposure_s=0.02, period_s=0.021)

    usual, found = world().measured(count=24), world(8).measured(count=24)
    assert (usual.late, usual.late_words) == (0, "")
    assert found.late == 1
    assert found.late_s == pytest.approx(0.034 - jitter_s / 2, abs=0.6 * jitter_s + 3e-4)
    assert f"1 of {found.flashes_used} flashes came late, by" in found.late_words
    error_s = 3 * usual.standard_error_s
    assert found.latest_s == pytest.approx(usual.latest_s, abs=error_s)
    assert found.earliest_s == pytest.approx(usual.earliest_s, abs=error_s)
    assert found.latency_s == pytest.approx(usual.latency_s, abs=error_s)
    # A light that is late more often than scans may shoot again is waited for.
    often = world(4, 9, 12, 17).measured(count=24)
    assert often.late == 0
    assert often.latest_s > 0.037


@pytest.mark.slow
def test_a_flash_that_came_late_asks_for_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usual = rig(tmp_path, faults={"light_delay_s": 0.012})
    fit = fit_latency

    def with_late_one(camera: str, flashes: Sequence[LightChange], levels: RowLevels) -> CameraLatency:
        return replace(fit(camera, flashes, levels), late=1)

    monkeypatch.setattr("slrig.capture.latency.fit_latency", with_late_one)
    assert measure_latency(usual, trials=10).cameras["eye"].flashes_used == DEFAULT_TRIALS


def halfway(at_s: float, length_s: float, level: float) -> Callable[[bool, np.random.Generator], Light]:
    """Light that stands at a level for a time, on its way to white and on that to black."""

    def light(to_white: bool, _: np.random.Generator) -> Light:
        def white(t: FloatArray) -> FloatArray:
            return np.select([t < at_s, t < at_s + length_s], [0.0, level if to_white else 1 - level], 1.0)

        return white if to_white else lambda t: 1 - white(t)

    return light


@parametrize_core("line_s", [0.0, 1e-4], core=[1])
@parametrize_core(
    ("light", "length_s"),
    [
        (halfway(0.01, 1 / 60, 0.5), 1 / 60),
        (halfway(0.01, 1 / 60, 0.22), 1 / 60),
        (both_ways(step(0.01)), 0.0),
        (both_ways(ramp(0.01, 0.012)), 0.0),
        (lambda to_white, rng: both_ways(step(0.004 + float(rng.uniform(0, 1 / 60))))(to_white, rng), 0.0),
        (lambda to_white, rng: both_ways(step(0.004 + float(rng.normal(0, 0.004))))(to_white, rng), 0.0),
    ],
    core=[0, 3, 4],
)
def test_a_picture_between_white_and_black_is_seen(
    light: Callable[[bool, np.random.Generator], Light], length_s: float, line_s: float
) -> None:
    found = World(light, exposure_s=1 / 30, period_s=1 / 30, line_s=line_s).measured(count=24, seed=1)
    assert found.halfway_s == pytest.approx(length_s, abs=1.5e-3)


def test_a_ramp_is_timed_at_its_middle_and_waited_for_to_its_end() -> None:
    found = World(both_ways(ramp(0.010, 0.008)), exposure_s=0.02, period_s=0.022).measured()
    assert found.latency_s == pytest.approx(0.014, abs=1e-3)
    # Rows that begin from 2.5 ms before the ramp's end miss less than 2 %: stable by what counts as steady.
    assert 0.0155 < found.latest_s < 0.019


def test_slower_darkening_than_brightening_is_measured_and_waited_for() -> None:
    found = World(lambda to_white, rng: both_ways(step(0.005 if to_white else 0.015))(to_white, rng)).measured()
    assert (found.rise_s, found.fall_s) == pytest.approx((0.005, 0.015), abs=1e-4)
    assert found.latest_s == pytest.approx(0.015, abs=3e-4)


@pytest.mark.slow
def test_a_colour_wheel_is_flicker_and_hardly_changes_the_latency() -> None:
    # Three colours of unlike brightness, each lit for a third of a turn, 120 turns a second, not in step with show.
    turn_s, colours = 1 / 120, np.array([1.5, 1.0, 0.5])

    def wheel(t: FloatArray) -> FloatArray:
        return np.asarray(colours[np.floor(3 * t / turn_s).astype(int) % 3])

    def light(to_white: bool, rng: np.random.Generator) -> Light:
        off_s = float(rng.uniform(0, turn_s))
        change = both_ways(step(0.012))(to_white, rng)
        return lambda t: change(t) * wheel(t + 1.0 + off_s)

    found = World(light, exposure_s=0.0125, period_s=0.0141, steady=lambda t: wheel(t + 1.0)).measured()
    assert found.flicker > 0.02
    assert found.latency_s == pytest.approx(0.012, abs=turn_s / 8)
    assert found.jitter_s < turn_s / 4
    assert not found.rolling
    # Exposures of whole turns see none of it.
    whole = World(light, exposure_s=2 * turn_s, period_s=0.0181, steady=lambda t: wheel(t + 1.0)).measured()
    assert whole.flicker < 0.005
    assert whole.latency_s == pytest.approx(0.012, abs=turn_s / 8)


def test_a_picture_built_up_row_by_row_is_waited_for_to_its_last_row() -> None:
    found = World(both_ways(step(0.003)), scan_s=2e-4, period_s=0.024).measured()
    assert found.scanned
    assert not found.rolling
    assert found.latency_s == pytest.approx(0.003, abs=2e-4)
    assert found.latest_s == pytest.approx(0.003 + (ROWS - 1) * 2e-4, abs=5e-4)


def test_saturated_and_unlit_pixels_do_not_count() -> None:
    # The upper right of the picture saturates; a share read from it would be too great.
    found = World(both_ways(step(0.012)), white_dn=300.0, line_s=6e-5).measured()
    assert found.latency_s == pytest.approx(0.012, abs=1e-4)
    assert found.line_time_s == pytest.approx(6e-5, rel=0.02)


def test_levels_leave_out_unusable_rows() -> None:
    world, rng = World(both_ways(step(0.0))), np.random.default_rng(0)
    shares = np.where(np.arange(ROWS) < 20, 0.0, 1.0)
    black = [world.image(np.zeros(ROWS), rng) for _ in range(8)]
    white = [world.image(shares, rng) for _ in range(8)]
    levels = row_levels("eye", black, white, full_scale=255)
    found = levels.shares(world.image(0.5 * shares, rng))
    assert np.isnan(found[:20]).all()
    assert found[20:] == pytest.approx(0.5, abs=0.03)


# ---- what cannot be measured


@pytest.mark.parametrize(
    ("world", "words"),
    [
        ({"white_dn": 0.0}, r"sees no flash.*lamp is on"),
        ({"white_dn": 3000.0}, r"saturated.*expose shorter"),
        ({"white_dn": 60.0, "noise_dn": 15.0}, "rows distinguish white from black"),
        ({"exposure_s": 5e-4, "period_s": 0.1}, r"between two exposures .* raise its frame rate"),
        ({"light": both_ways(step(0.35))}, "did not change within the search time"),
    ],
    ids=["lamp off", "too much light", "too noisy", "flashes between exposures", "light too late"],
)
def test_unmeasurable_light_is_reported(world: dict[str, Any], words: str) -> None:
    with pytest.raises(ScanEvidenceError, match=words):
        World(**{"light": both_ways(step(0.012)), **world}).measured(count=20)

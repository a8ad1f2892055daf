"""What a bracket is, which exposures are of use, and what several of them say against one another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from slrig.bundle.sidecars import RefusedFrame
from slrig.capture.exposure import (
    ExposureFault,
    ExposureSamples,
    bracket_summary,
    check_exposures,
    detect_movement,
    judge_exposure,
)
from slrig.capture.verifier import EvidenceSummary, Sampler, check_capture
from slrig.model import Black, Capture, Gray, LineShift, Shot, White, bracket_fault, exposure_groups
from slrig.patterns.sequence import encode
from tests.unit.capture.fake_rig import PROJECTOR, Scene, patterns_for

PATTERNS = patterns_for()
WHITE, BLACK = (encode([kind], PROJECTOR).profiles[0] for kind in (White(), Black()))


@pytest.mark.parametrize("exposures_s", [(0.01, 0.04), (0.04, 0.01), (0.01, 0.011), (1, 2, 3, 4, 5, 6)])
def test_two_to_six_different_times_are_a_bracket(exposures_s: Sequence[float]) -> None:
    assert bracket_fault(exposures_s) is None


@pytest.mark.parametrize(
    ("exposures_s", "words"),
    [
        ((), r"2 to 6 exposure times, found 0"),
        ((0.01,), r"2 to 6 exposure times, found 1 \(0\.01\).*one alone is exposure_s"),
        (tuple(range(1, 8)), r"2 to 6 exposure times, found 7"),
        ((0.01, 0.0), "finite times above 0 s, found 0.01, 0;"),
        ((0.01, float("nan")), "finite times above 0 s"),
        ((0.01, float("inf")), "finite times above 0 s"),
        ((0.01, 0.04, 0.0401), "differ by 10% at least, found 0.01, 0.04, 0.0401"),
        ((0.01, 0.01), "differ by 10% at least"),
    ],
)
def test_other_times_are_not_a_bracket_and_the_message_has_a_remedy(exposures_s: Sequence[float], words: str) -> None:
    fault = bracket_fault(exposures_s)
    assert fault is not None
    assert pytest.RaisesExc(ValueError, match=words).matches(ValueError(fault))


def test_nearly_equal_exposures_are_one_group() -> None:
    groups = exposure_groups([0.0100, 0.0101, 0.0099, 0.0102, 0.0400, 0.0404])
    assert set(groups.values()) == {0.0099, 0.0400}
    assert exposure_groups([]) == {}
    assert exposure_groups([None, None]) == {None: None}


def at_exposure(times: float, **options: float) -> Scene:
    """The scene as an exposure `times` as long sees it."""
    usual = {"white": 0.6, "ambient": 0.02, **options}
    return Scene(noise_dn=0.8, white=times * usual["white"], ambient=times * usual["ambient"])


@pytest.mark.parametrize(
    ("scene", "expected"),
    [
        *((at_exposure(times), ExposureFault.TOO_DARK) for times in (0.005, 0.02)),
        *((at_exposure(times), None) for times in (0.25, 1.0, 2.0)),
        (at_exposure(6.0), ExposureFault.TOO_BRIGHT),
        # A room that outshines the projector.
        (at_exposure(4.0, ambient=0.7), ExposureFault.TOO_BRIGHT),
    ],
)
def test_an_exposure_is_usable_unless_too_dark_or_too_bright(scene: Scene, expected: ExposureFault | None) -> None:
    white, black = scene.image(WHITE), scene.image(BLACK)
    verdict = judge_exposure(white, black, scene.format)
    assert (None if verdict is None else verdict.fault) is expected
    # White that is darker than black is no matter of exposure.
    assert expected is not None or judge_exposure(black, white, scene.format) is None


def shots_at(times: float, *, moved_px: float = 0.0, noise_dn: float = 0.8) -> list[Shot]:
    scene = at_exposure(times)
    scene.noise_dn = noise_dn
    scene.column_px = scene.column_px + moved_px * scene.columns_per_px
    return [replace(shot, exposure_s=0.01 * times) for shot in scene.shots(PATTERNS)]


def samples_of(shots: Sequence[Shot]) -> ExposureSamples:
    sampler = Sampler.from_size(Scene().camera)
    exposure_s = shots[0].exposure_s
    assert exposure_s is not None
    return ExposureSamples(exposure_s, {shot.pattern: sampler.take(shot.image) for shot in shots}, 0.8)


@pytest.mark.parametrize("times", [(0.25, 1.0), (0.1, 2.0), (1.0, 1.6)])
def test_one_scene_looks_the_same_at_every_exposure(times: tuple[float, float]) -> None:
    one, other = (samples_of(shots_at(each)) for each in times)
    assert detect_movement(one, other, PATTERNS, 255) is None


@pytest.mark.parametrize("moved_px", [1.5, -3.0])
def test_movement_between_two_exposures_is_detected(moved_px: float) -> None:
    one, other = samples_of(shots_at(0.25)), samples_of(shots_at(1.0, moved_px=moved_px))
    fault = detect_movement(one, other, PATTERNS, 255)
    assert fault is not None
    assert "looks different at 0.01 s and at 0.0025 s" in fault
    assert "moved between the two exposures" in fault


def test_a_frame_of_another_pattern_differs_from_the_other_exposure() -> None:
    line = next(i for i, pattern in enumerate(PATTERNS) if isinstance(pattern, LineShift))
    swapped = [replace(s, pattern={line: line + 1, line + 1: line}.get(s.pattern, s.pattern)) for s in shots_at(1.0)]
    fault = detect_movement(samples_of(shots_at(0.25)), samples_of(swapped), PATTERNS, 255)
    assert fault is not None
    assert f"pattern {line} " in fault


def test_exposures_without_common_clear_pixels_are_not_compared() -> None:
    bright = samples_of(shots_at(9.0, moved_px=5.0))
    assert detect_movement(samples_of(shots_at(0.25)), bright, PATTERNS, 255) is None
    without = ExposureSamples(0.01, {i: s for i, s in bright.frames.items() if PATTERNS[i] != Black()}, 0.8)
    assert detect_movement(samples_of(shots_at(0.25)), without, PATTERNS, 255) is None


def summary(verified: int, *, drift: float = 0.0, lit: float = 0.5, faults: tuple[str, ...] = ()) -> EvidenceSummary:
    return EvidenceSummary(20, verified, {"left": lit}, {"left": drift}, {"left": 1.0}, faults)


def test_a_bracket_has_verified_what_its_best_exposure_has() -> None:
    parts = [(0.01, summary(12, drift=0.01)), (0.04, summary(20, drift=-0.03, lit=0.7)), (0.16, summary(18))]
    refused = [
        RefusedFrame(0, "left", 1, "at 0.04 s, it is dark"),
        RefusedFrame(0, "left", 1, "0.64 s is too bright", left_out=True),
        RefusedFrame(1, "left", 1, "0.64 s is too bright", left_out=True),
    ]
    found = bracket_summary(parts, refused, ["something moved"], PATTERNS)
    assert str(found) == "20/20 patterns verified, 1 frame shot again"
    assert (found.lit["left"], found.light_drift["left"]) == (0.7, -0.03)
    assert found.faults == ("something moved",)
    assert found.left_out == ("0.64 s is too bright",)
    worse = bracket_summary([(0.01, summary(20, faults=("bit 3 is stale",)))], [], [], PATTERNS)
    assert worse.faults == ("at 0.01 s, bit 3 is stale",)


def make_capture(*shots: Shot) -> Capture:
    return Capture(PROJECTOR, PATTERNS, {"left": Scene().format}, shots)


@pytest.mark.slow
def test_a_recorded_bracket_is_checked_by_exposures() -> None:
    sound = make_capture(*shots_at(0.25), *shots_at(1.0), *shots_at(1.6))
    found = check_exposures(sound)
    assert (found.verified, found.patterns, found.faults) == (len(PATTERNS), len(PATTERNS), ())
    # A camera's own word of an exposure varies a little; a frame is in the wrong place at one exposure only.
    gray = next(i for i, pattern in enumerate(PATTERNS) if isinstance(pattern, Gray) and pattern.bit == 1)
    swapped = {gray: gray + 2, gray + 2: gray}
    wrong = [
        replace(shot, exposure_s=0.01 * (1 + 1e-4 * shot.pattern), pattern=swapped.get(shot.pattern, shot.pattern))
        for shot in shots_at(1.0)
    ]
    found = check_exposures(make_capture(*shots_at(0.25), *wrong))
    assert any(fault.startswith("at 0.01 s, camera 'left'") for fault in found.faults)
    assert any("moved between the two exposures" in fault for fault in found.faults)
    assert not any(fault.startswith("at 0.0025 s") for fault in found.faults)


def test_one_exposure_is_checked_like_a_capture() -> None:
    one = make_capture(*shots_at(1.0))
    refused = [RefusedFrame(3, "left", 1, "it is stale")]
    assert check_exposures(one, refused) == check_capture(one, refused)
    assert np.isfinite(check_exposures(one).noise_dn["left"])

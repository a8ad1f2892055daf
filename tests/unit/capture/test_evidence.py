"""Frames that show what they claim pass, in every kind of scene; frames that do not are refused with numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from slrig.capture.evidence import Evidence, check_capture
from slrig.errors import ScanEvidenceError
from slrig.model import Axis, Black, Capture, Gray, LineShift, Pattern, Pixels, Shot, Size, White
from tests.unit.capture.fake_rig import PROJECTOR, Scene, add, patterns_for

PATTERNS = patterns_for()
FIRST_LINE = next(i for i, pattern in enumerate(PATTERNS) if isinstance(pattern, LineShift))


def judged(scene: Scene, shots: Sequence[Shot], patterns: Sequence[Pattern] = PATTERNS) -> Evidence:
    evidence = Evidence(patterns, {"left": scene.format})
    for shot in shots:
        add(evidence, shot)
    return evidence


def with_image(shots: Sequence[Shot], index: int, image: Pixels) -> list[Shot]:
    return [replace(shot, image=image) if shot.pattern == index else shot for shot in shots]


SCENES = {
    "noise-free": Scene(),
    "noisy": Scene(noise_dn=2.5),
    "dark": Scene(white=0.06, ambient=0.0, noise_dn=1.0),
    "dark and noise-free": Scene(white=0.03, ambient=0.0),
    "strong ambient light": Scene(white=0.3, ambient=0.4, noise_dn=1.5),
    "sharp": Scene(blur_px=0.05),
    "defocused": Scene(blur_px=2.0, noise_dn=1.0),
    "camera with gamma 2.2": Scene(gamma=2.2, noise_dn=1.0),
    "12 bit": Scene(bit_depth=12, noise_dn=6.0),
    "16 bit, mostly empty range": Scene(bit_depth=16, white=0.01, ambient=0.0, noise_dn=15.0),
    "saturated in places": Scene(white=1.3, noise_dn=1.5),
    "behind a scaler": Scene(scaler_px=0.7, noise_dn=1.0),
    "behind a soft scaler": Scene(scaler_px=1.1, noise_dn=1.0),
    "small object": Scene(
        camera=Size(640, 480), columns_per_px=0.18, rows_per_px=0.19, shadow_until_px=560, noise_dn=1.5
    ),
}


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES.keys())
@pytest.mark.parametrize("line_shift", [True, False], ids=["line shift", "Gray only"])
def test_sound_frames_pass(scene: Scene, line_shift: bool) -> None:
    patterns = patterns_for(line_shift=line_shift, rows=True)
    summary = judged(scene, scene.shots(patterns), patterns).summary()
    assert summary.patterns == len(patterns)
    assert summary.faults == ()


@pytest.mark.parametrize(
    "name", ["noise-free", "noisy", "strong ambient light", "sharp", "camera with gamma 2.2", "12 bit"]
)
def test_every_pattern_of_a_good_scene_is_verified(name: str) -> None:
    scene = SCENES[name]
    summary = judged(scene, scene.shots(PATTERNS)).summary()
    assert summary.verified == summary.patterns == len(PATTERNS)
    assert summary.light_drift["left"] == pytest.approx(0, abs=0.01)
    assert 0.9 < summary.lit["left"] <= 1


def test_noise_is_measured() -> None:
    scene = Scene(noise_dn=2.0)
    assert judged(scene, scene.shots(PATTERNS)).summary().noise_dn["left"] == pytest.approx(2.0, rel=0.2)


@pytest.mark.parametrize("first_column_px", [2.0, 300.0, 880.0])
@pytest.mark.parametrize("noise_dn", [0.0, 1.5])
def test_bits_may_be_constant_where_the_camera_sees_a_part_of_the_projector(
    first_column_px: float, noise_dn: float
) -> None:
    size = Size(1024, 96)
    scene = Scene(projector=size, first_column_px=first_column_px, noise_dn=noise_dn)
    patterns = patterns_for(size)
    assert judged(scene, scene.shots(patterns), patterns).summary().verified == len(patterns)


def test_white_and_black_may_come_last() -> None:
    scene = Scene(noise_dn=1.0)
    patterns = PATTERNS[2:]
    summary = judged(scene, scene.shots(patterns), patterns).summary()
    assert summary.verified == len(patterns)


def test_line_frames_may_come_before_the_code() -> None:
    scene = Scene(noise_dn=1.0)
    shots = sorted(scene.shots(PATTERNS), key=lambda shot: isinstance(PATTERNS[shot.pattern], Gray))
    assert judged(scene, shots).summary().verified == len(PATTERNS)


def test_codes_of_one_pixel_and_offsets_are_understood() -> None:
    scene = Scene(noise_dn=1.0, blur_px=0.4)
    patterns = patterns_for(cell_px=1, offset_px=17)
    assert judged(scene, scene.shots(patterns), patterns).summary().verified == len(patterns)


def test_without_inverse_frames_bits_are_not_proven() -> None:
    scene = Scene(noise_dn=1.0)
    patterns = tuple(p for p in PATTERNS if not (isinstance(p, Gray) and p.inverted))
    summary = judged(scene, scene.shots(patterns), patterns).summary()
    bits = sum(isinstance(pattern, Gray) for pattern in patterns)
    assert summary.faults == ()
    assert summary.verified == len(patterns) - bits


def test_without_white_and_black_nothing_is_proven() -> None:
    scene = Scene()
    patterns = tuple(p for p in PATTERNS if isinstance(p, Gray))
    summary = judged(scene, scene.shots(patterns), patterns).summary()
    assert (summary.patterns, summary.verified, summary.faults) == (len(patterns), 0, ())


# ---- white and black


@pytest.mark.parametrize(
    ("scene", "swap", "words"),
    [
        (Scene(white=0.0, ambient=0.0, noise_dn=0.5), False, r"both are dark: is the lamp off"),
        (Scene(white=0.0, ambient=0.3, noise_dn=1.0), False, r"sees other light, and not the projector's"),
        (Scene(), True, r"white is darker than black .*inverted"),
        (Scene(ambient=3.0), False, r"the black frame is saturated on 100%.*shorten the exposure"),
        (Scene(white=5.0), False, r"the white frame is saturated on \d+%.*shorten the exposure"),
    ],
    ids=["lamp off in the dark", "lamp off in a lit room", "inverted", "all white", "over-exposed"],
)
def test_white_and_black_that_cannot_be_used(scene: Scene, swap: bool, words: str) -> None:
    white, black = scene.shots([White(), Black()])
    if swap:
        white, black = replace(white, image=black.image), replace(black, image=white.image)
    with pytest.raises(ScanEvidenceError, match=words):
        judged(scene, [white, black])


def test_an_all_black_recording_is_told_once() -> None:
    scene = Scene(white=0.0, ambient=0.0)
    capture = Capture(PROJECTOR, PATTERNS, {"left": scene.format}, tuple(scene.shots(PATTERNS)))
    summary = check_capture(capture)
    assert len(summary.faults) == 1
    assert summary.verified == 0


# ---- one frame that is not what it claims

Spoil = Callable[[list[Shot], int], Pixels]


def stale(shots: list[Shot], index: int) -> Pixels:
    return shots[index - 1].image


def stale_and_exposed_again(shots: list[Shot], index: int) -> Pixels:
    again = np.random.default_rng(5).normal(shots[index - 1].image, 1.0)
    return np.clip(np.rint(again), 0, 255).astype(np.uint8)


def dark(shots: list[Shot], index: int) -> Pixels:
    assert index != 1
    return shots[1].image


def garbled(shots: list[Shot], index: int) -> Pixels:
    image = shots[index].image.copy()
    image[50:100] = np.random.default_rng(6).integers(0, 256, (50, image.shape[1]), np.uint8)
    return image


def cut(shots: list[Shot], index: int) -> Pixels:
    image = shots[index].image.copy()
    image[-40:] = 0
    return image


@pytest.mark.parametrize("index", range(2, len(PATTERNS) - 2))
@pytest.mark.parametrize(
    "spoil", [stale, stale_and_exposed_again, dark, garbled, cut], ids=lambda spoil: spoil.__name__
)
@pytest.mark.parametrize("scaler_px", [0.0, pytest.param(0.7, marks=pytest.mark.slow)])
def test_a_frame_that_is_not_what_it_claims_is_refused(spoil: Spoil, index: int, scaler_px: float) -> None:
    scene = Scene(noise_dn=1.0, scaler_px=scaler_px)
    shots = scene.shots(PATTERNS)
    with pytest.raises(ScanEvidenceError, match=r"camera 'left', pattern \d+ \(column (Gray bit|lines)"):
        judged(scene, with_image(shots, index, spoil(shots, index)))


@pytest.mark.parametrize("bit", range(5))
def test_a_bit_exchanged_with_its_inverse_is_refused(bit: int) -> None:
    scene = Scene(noise_dn=1.0)
    shots = scene.shots(PATTERNS)
    i = PATTERNS.index(Gray(Axis.COLUMN, bit, 5, 4))
    swapped = with_image(with_image(shots, i, shots[i + 1].image), i + 1, shots[i].image)
    with pytest.raises(ScanEvidenceError, match="exchanged with its inverse"):
        judged(scene, swapped)


def test_a_coarse_bit_exchanged_with_its_inverse_is_refused_without_line_frames() -> None:
    scene = Scene(noise_dn=1.0, columns_per_px=0.2, first_column_px=40)
    patterns = patterns_for(line_shift=False)
    shots = scene.shots(patterns)
    i = patterns.index(Gray(Axis.COLUMN, 1, 6, 2))
    swapped = with_image(with_image(shots, i, shots[i + 1].image), i + 1, shots[i].image)
    with pytest.raises(ScanEvidenceError, match="bit 1 of the column code is exchanged with its inverse"):
        judged(scene, swapped, patterns)


@pytest.mark.parametrize("other", range(1, 8))
def test_line_frames_out_of_order_are_refused(other: int) -> None:
    scene = Scene(noise_dn=1.0)
    shots = scene.shots(PATTERNS)
    swapped = with_image(shots, FIRST_LINE, shots[FIRST_LINE + other].image)
    swapped = with_image(swapped, FIRST_LINE + other, shots[FIRST_LINE].image)
    with pytest.raises(ScanEvidenceError, match="lines"):
        judged(scene, swapped)


def test_the_message_names_the_twin_of_a_repeated_frame() -> None:
    scene = Scene(noise_dn=1.0)
    shots = scene.shots(PATTERNS)
    late = with_image(shots, FIRST_LINE + 3, shots[FIRST_LINE + 2].image)
    with pytest.raises(ScanEvidenceError, match=rf"lines, shift 3 of 8.*equals that of pattern {FIRST_LINE + 2} "):
        judged(scene, late)


# ---- the closing frames


def test_light_that_changed_is_told_in_percent() -> None:
    scene = Scene(noise_dn=1.0)
    shots = scene.shots(PATTERNS)
    brighter = replace(scene, white=0.75).shots(PATTERNS)[-2]
    with pytest.raises(ScanEvidenceError, match=r"the light changed by \+25% of white"):
        judged(scene, [*shots[:-2], brighter])


def test_an_object_that_moved_is_told() -> None:
    scene = Scene(noise_dn=1.0)
    shots = scene.shots(PATTERNS)
    moved = np.roll(shots[-2].image, 25, axis=1)
    with pytest.raises(ScanEvidenceError, match=r"\d+% of the pixels changed.*moved"):
        judged(scene, with_image(shots, len(PATTERNS) - 2, moved))


def test_a_small_drift_is_measured_and_passes() -> None:
    scene = Scene(noise_dn=1.0)
    shots = scene.shots(PATTERNS)
    closing = replace(scene, white=0.6 * 1.05).shots(PATTERNS)[-2]
    summary = judged(scene, [*shots[:-2], closing, shots[-1]]).summary()
    assert summary.light_drift["left"] == pytest.approx(0.05, abs=0.01)


# ---- the frame itself


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.zeros((150, 199), np.uint16), r"199 x 150, the camera is 200 x 150"),
        (np.zeros((150, 200), np.uint8), r"uint8, 12 bits come as uint16"),
        (np.full((150, 200), 5000, np.uint16), r"value 5000, 12 bits end at 4095"),
    ],
)
def test_a_frame_of_another_format_is_refused(image: Pixels, words: str) -> None:
    scene = Scene(bit_depth=12)
    with pytest.raises(ScanEvidenceError, match=words):
        judged(scene, [Shot(0, "left", image)])


# ---- a recorded capture


def test_a_recording_with_faults_is_judged_and_not_refused() -> None:
    scene = Scene(noise_dn=1.0)
    shots = with_image(shots := scene.shots(PATTERNS), 5, shots[4].image)
    summary = check_capture(Capture(PROJECTOR, PATTERNS, {"left": scene.format}, tuple(shots)))
    assert any("pattern 5 (column Gray bit 1 of 5, inverse)" in fault for fault in summary.faults)
    assert summary.verified < summary.patterns == len(PATTERNS)


def test_cameras_are_judged_apart_and_a_pattern_needs_both() -> None:
    left, right = Scene(noise_dn=1.0), Scene(noise_dn=1.0, seed=3, first_column_px=20)
    bad = right.shots(PATTERNS, "right")
    bad = with_image(bad, 5, bad[4].image)
    formats = {"left": left.format, "right": right.format}
    summary = check_capture(Capture(PROJECTOR, PATTERNS, formats, (*left.shots(PATTERNS), *bad)))
    assert all("camera 'right'" in fault for fault in summary.faults)
    assert summary.verified < summary.patterns


def test_a_bracket_is_judged_at_the_exposure_most_patterns_have() -> None:
    scene, brighter = Scene(noise_dn=1.0), Scene(noise_dn=1.0, white=0.9)
    usual = [replace(shot, exposure_s=0.01) for shot in scene.shots(PATTERNS)]
    long = [replace(shot, exposure_s=0.015) for shot in brighter.shots(PATTERNS)[:2]]
    capture = Capture(PROJECTOR, PATTERNS, {"left": scene.format}, (*long, *usual))
    summary = check_capture(capture)
    assert (summary.verified, summary.faults) == (len(PATTERNS), ())


def test_a_frame_taken_twice_is_no_repetition() -> None:
    scene = Scene(noise_dn=1.0)
    patterns = (*PATTERNS[:2], *PATTERNS[2:4], *PATTERNS[2:])
    assert judged(scene, scene.shots(patterns), patterns).summary().verified == len(patterns)

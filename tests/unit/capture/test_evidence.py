"""Frames that show what they claim pass, in every kind of scene; frames that do not are refused with numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations, product
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.bundle.sidecars import RefusedFrame
from slrig.capture.frame_checks import (
    NOISE_FLOOR_DN,
    ReferenceFrames,
    Samples,
    build_reference,
    find_repeated,
    line_sum_fault,
    pair_noise_dn,
    reference_level_fault,
    roughness_fault,
)
from slrig.capture.verifier import Evidence, EvidenceSummary, Sampler, check_capture
from slrig.errors import ScanEvidenceError
from slrig.model import Axis, Black, Capture, Gray, LineShift, Pattern, Pixels, SequenceName, Shot, Size, White
from slrig.patterns.sequence import encode
from slrig.scan.plan import PatternPlan, pattern_sequence
from tests.core import parametrize_core
from tests.unit.capture.fake_rig import PROJECTOR, Scene, add_agreeing_shot, patterns_for

PATTERNS = patterns_for()
COUNT = len(PATTERNS)
SCENE = Scene(noise_dn=1.0)
SHOTS = SCENE.shots(PATTERNS)
FIRST_LINE = next(i for i, pattern in enumerate(PATTERNS) if isinstance(pattern, LineShift))


def verify_shots(scene: Scene, shots: Sequence[Shot], patterns: Sequence[Pattern] = PATTERNS) -> Evidence:
    evidence = Evidence(patterns, {"left": scene.format})
    for shot in shots:
        add_agreeing_shot(evidence, shot)
    return evidence


def recorded_summary(shots: Sequence[Shot], patterns: Sequence[Pattern]) -> EvidenceSummary:
    return check_capture(Capture(PROJECTOR, tuple(patterns), {"left": SCENE.format}, tuple(shots)))


def make_capture(shots: Sequence[Shot]) -> Capture:
    return Capture(PROJECTOR, PATTERNS, {"left": SCENE.format}, tuple(shots))


def with_image(shots: Sequence[Shot], index: int, image: Pixels) -> list[Shot]:
    return [replace(shot, image=image) if shot.pattern == index else shot for shot in shots]


OTHER_PARTS = ((2.0, 1.5), (300.0, 1.5), (880.0, 0.0), (880.0, 1.5))

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


PROVEN = {"noise-free", "noisy", "strong ambient light", "sharp", "camera with gamma 2.2", "12 bit"}
"""Scenes so good that every pattern is verified."""
IN_THE_CORE = ("noisy", "16 bit, mostly empty range", "behind a scaler")


@pytest.mark.parametrize(
    ("name", "line_shift", "rows"),
    [
        *((name, True, name == "noisy") for name in IN_THE_CORE),
        *(pytest.param(name, shift, True, marks=pytest.mark.slow) for name in SCENES for shift in (True, False)),
    ],
)
def test_correct_frames_pass(name: str, line_shift: bool, rows: bool) -> None:
    scene, patterns = SCENES[name], patterns_for(line_shift=line_shift, rows=rows)
    summary = verify_shots(scene, scene.shots(patterns), patterns).summary()
    assert summary.patterns == len(patterns)
    assert summary.faults == ()
    if name in PROVEN:
        assert summary.verified == len(patterns)
        assert summary.light_drift["left"] == pytest.approx(0, abs=0.01)
        assert 0.9 < summary.lit["left"] <= 1


def test_noise_is_measured() -> None:
    scene = Scene(noise_dn=2.0)
    assert verify_shots(scene, scene.shots(PATTERNS)).summary().noise_dn["left"] == pytest.approx(2.0, rel=0.2)


@pytest.mark.parametrize(
    ("first_column_px", "noise_dn"),
    [(300.0, 0.0), *(pytest.param(*each, marks=pytest.mark.slow) for each in OTHER_PARTS)],
)
def test_bits_may_be_constant_where_the_camera_sees_a_part_of_the_projector(
    first_column_px: float, noise_dn: float
) -> None:
    size = Size(1024, 96)
    scene = Scene(projector=size, first_column_px=first_column_px, noise_dn=noise_dn)
    patterns = patterns_for(size)
    assert verify_shots(scene, scene.shots(patterns), patterns).summary().verified == len(patterns)


def lines_first(shots: list[Shot]) -> list[Shot]:
    return sorted(shots, key=lambda shot: isinstance(PATTERNS[shot.pattern], Gray))


@parametrize_core(
    ("patterns", "order"),
    [
        (PATTERNS[2:], list),
        (PATTERNS, lines_first),
        (patterns_for(cell_px=1, offset_px=17), list),
        # A frame that is taken twice is no repetition.
        ((*PATTERNS[:4], *PATTERNS[2:]), list),
    ],
    ids=["white and black at the end only", "lines before the code", "codes of one pixel and an offset", "twice"],
    core=[1, 3],
)
def test_other_sequences_are_understood(
    patterns: tuple[Pattern, ...], order: Callable[[list[Shot]], list[Shot]]
) -> None:
    scene = Scene(noise_dn=1.0, blur_px=0.4)
    assert verify_shots(scene, order(scene.shots(patterns)), patterns).summary().verified == len(patterns)


@pytest.mark.parametrize(
    ("patterns", "proven"),
    [
        (
            tuple(p for p in patterns_for(line_shift=False) if not (isinstance(p, Gray) and p.inverted)),
            lambda p: not isinstance(p, Gray),
        ),
        (tuple(p for p in PATTERNS if isinstance(p, Gray)), lambda _: False),
    ],
    ids=["without inverses and lines no bit", "without white and black nothing"],
)
def test_patterns_without_evidence_are_not_verified(
    patterns: tuple[Pattern, ...], proven: Callable[[Pattern], bool]
) -> None:
    summary = verify_shots(SCENE, SCENE.shots(patterns), patterns).summary()
    assert (summary.patterns, summary.faults) == (len(patterns), ())
    assert summary.verified == sum(map(proven, patterns))


# ---- sequences without inverses: bits are proven by lines

SINGLE = {
    name: pattern_sequence(PatternPlan(sequence=name), PROJECTOR).patterns
    for name in (SequenceName.STANDARD, SequenceName.FAST)
}


IN_TURN = [
    (SequenceName.FAST, 5),
    *(pytest.param(name, 1, marks=pytest.mark.slow) for name in (SequenceName.FAST, SequenceName.STANDARD)),
]
"""Each fifth fault of the shorter one; every fault of both in the long run."""


@pytest.mark.parametrize(
    ("name", "sequence"),
    [
        *((name, SequenceName.FAST) for name in ("noisy", "12 bit")),
        ("behind a soft scaler", SequenceName.STANDARD),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in product(SCENES, SINGLE)),
    ],
)
def test_bits_without_inverses_are_verified_by_the_lines(name: str, sequence: SequenceName) -> None:
    scene, patterns = SCENES[name], SINGLE[sequence]
    summary = verify_shots(scene, scene.shots(patterns), patterns).summary()
    assert (summary.patterns, summary.faults) == (len(patterns), ())
    if name in PROVEN:
        assert summary.verified == len(patterns)


def test_a_bit_equal_to_a_line_pattern_is_not_a_repetition() -> None:
    """With cells of one pixel the second finest bit but one is lit as lines of period 8 and 4 px are."""
    patterns = pattern_sequence(PatternPlan(gray_cell_px=1), PROJECTOR).patterns
    bits = [each for each in patterns if isinstance(each, Gray) and each.as_lines in patterns]
    assert len(bits) == 1
    summary = verify_shots(SCENE, SCENE.shots(patterns), patterns).summary()
    assert (summary.faults, summary.verified) == ((), len(patterns))
    whole = encode([bits[0], bits[0].as_lines or bits[0]], PROJECTOR)
    np.testing.assert_array_equal(whole.image(0), whole.image(1))


@pytest.mark.parametrize(("sequence", "every"), IN_TURN)
def test_a_single_wrong_frame_is_rejected(sequence: SequenceName, every: int) -> None:
    patterns = SINGLE[sequence]
    shots = SCENE.shots(patterns)
    passed = []
    faults = [*product(range(2, len(patterns) - (sequence is SequenceName.STANDARD)), SPOILS)]
    for index, spoil in faults[::every]:
        image = spoil(shots, index)
        changed = np.mean(np.abs(image.astype(float) - shots[index].image)) > 5
        if changed and not recorded_summary(with_image(shots, index, image), patterns).faults:
            passed.append((index, spoil.__name__))
    assert passed == []


@pytest.mark.parametrize(("sequence", "every"), IN_TURN)
def test_any_two_exchanged_frames_are_rejected(sequence: SequenceName, every: int) -> None:
    patterns = SINGLE[sequence]
    shots = SCENE.shots(patterns)
    passed = []
    for one, other in [*combinations(range(len(patterns)), 2)][::every]:
        if patterns[one] == patterns[other]:
            continue
        swapped = with_image(with_image(shots, one, shots[other].image), other, shots[one].image)
        if not recorded_summary(swapped, patterns).faults:
            passed.append((patterns[one], patterns[other]))
    assert passed == []


def test_a_bit_that_lines_contradict_is_suspect() -> None:
    patterns = SINGLE[SequenceName.STANDARD]
    shots = SCENE.shots(patterns)
    index = patterns.index(Gray(Axis.COLUMN, 3, 5, 4))
    image = shots[index].image.copy()
    image[60:110] = shots[1].image[60:110]
    evidence = Evidence(patterns, {"left": SCENE.format})
    found = [each for shot in with_image(shots, index, image) for each in evidence.add_shot(shot)]
    assert [index in each.suspects and len(each.suspects) < 3 for each in found] == [True]
    assert "have a code that their lines contradict" in found[0].cause
    evidence.retract("left", found[0].suspects)
    assert [each for suspect in found[0].suspects for each in evidence.add_shot(shots[suspect])] == []
    assert evidence.summary().verified == len(patterns)


def test_interreflections_are_no_fault_when_they_repeat() -> None:
    """Light that a wall of a hollow sends to another turns a bit over wherever it falls, in every exposure."""
    patterns = SINGLE[SequenceName.STANDARD]
    shots = SCENE.shots(patterns)
    index = patterns.index(Gray(Axis.COLUMN, 2, 5, 4))

    def lit_by_a_wall() -> Shot:
        image = SCENE.shots(patterns)[index].image.copy()
        image[100:120] = shots[0].image[100:120]
        return replace(shots[index], image=image)

    evidence = Evidence(patterns, {"left": SCENE.format})
    found = [each for shot in with_image(shots, index, lit_by_a_wall().image) for each in evidence.add_shot(shot)]
    (first,) = found
    evidence.retract("left", first.suspects)
    again = [each for i in sorted(first.suspects) for each in evidence.add_shot(
        lit_by_a_wall() if i == index else shots[i]
    )]  # fmt: skip
    assert again == []
    assert evidence.summary().verified < len(patterns)


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
def test_unusable_white_and_black_are_rejected(scene: Scene, swap: bool, words: str) -> None:
    white, black = scene.shots([White(), Black()])
    if swap:
        white, black = replace(white, image=black.image), replace(black, image=white.image)
    with pytest.raises(ScanEvidenceError, match=words):
        verify_shots(scene, [white, black])


def test_an_all_black_recording_is_reported_once() -> None:
    scene = Scene(white=0.0, ambient=0.0)
    summary = check_capture(make_capture(scene.shots(PATTERNS)))
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


SPOILS: tuple[Spoil, ...] = (stale, stale_and_exposed_again, dark, garbled, cut)
# Of the frames of a pair, of the finest bit and of lines one each by every kind of damage.
EACH_KIND = {3: (stale, garbled), FIRST_LINE + 5: (stale_and_exposed_again, dark, cut)}


@pytest.mark.parametrize(
    ("spoil", "index"),
    [
        pytest.param(
            spoil, index, marks=[] if spoil in EACH_KIND.get(index, ()) else pytest.mark.slow,
            id=f"{spoil.__name__} {index}",
        )
        for index in range(2, len(PATTERNS) - 2)
        for spoil in SPOILS
    ],
)  # fmt: skip
@pytest.mark.parametrize("scaler_px", [0.0, pytest.param(0.7, marks=pytest.mark.slow)])
def test_a_wrong_frame_is_rejected(spoil: Spoil, index: int, scaler_px: float) -> None:
    scene = Scene(noise_dn=1.0, scaler_px=scaler_px)
    shots = scene.shots(PATTERNS)
    with pytest.raises(ScanEvidenceError, match=r"camera 'left', pattern \d+ \(column (Gray bit|lines)"):
        verify_shots(scene, with_image(shots, index, spoil(shots, index)))


def exchange_frames(one: int, other: int) -> list[Shot]:
    return with_image(with_image(SHOTS, one, SHOTS[other].image), other, SHOTS[one].image)


BIT_0, BIT_4 = (PATTERNS.index(Gray(Axis.COLUMN, bit, 5, 4)) for bit in (0, 4))


@pytest.mark.parametrize(
    ("shots", "words"),
    [
        (exchange_frames(BIT_0, BIT_0 + 1), "exchanged with its inverse"),
        (exchange_frames(BIT_4, BIT_4 + 1), "exchanged with its inverse"),
        *((exchange_frames(FIRST_LINE, FIRST_LINE + other), "lines") for other in (1, 4, 7)),
        (
            with_image(SHOTS, FIRST_LINE + 3, SHOTS[FIRST_LINE + 2].image),
            rf"lines, shift 3 of 8.*equals that of pattern {FIRST_LINE + 2} ",
        ),
        (
            [*SHOTS[:-2], replace(SCENE, white=0.12).shots(PATTERNS)[-2]],
            r"the light changed by -\d+% of white",
        ),
        (
            with_image(SHOTS, COUNT - 2, np.roll(SHOTS[-2].image, 25, axis=1)),
            r"\d+% of the pixels changed.*moved",
        ),
    ],
    ids=["bit 0", "bit 4", "lines 1", "lines 4", "lines 7", "twin", "light", "moved"],
)
def test_contradicting_frames_are_rejected_with_a_reason(shots: list[Shot], words: str) -> None:
    with pytest.raises(ScanEvidenceError, match=words):
        verify_shots(SCENE, shots)


def test_an_inverted_coarse_bit_is_rejected_without_line_frames() -> None:
    scene = Scene(noise_dn=1.0, columns_per_px=0.2, first_column_px=40)
    patterns = patterns_for(line_shift=False)
    shots = scene.shots(patterns)
    i = patterns.index(Gray(Axis.COLUMN, 1, 6, 2))
    swapped = with_image(with_image(shots, i, shots[i + 1].image), i + 1, shots[i].image)
    with pytest.raises(ScanEvidenceError, match="bit 1 of the column code is exchanged with its inverse"):
        verify_shots(scene, swapped, patterns)


def test_a_small_drift_is_measured_and_passes() -> None:
    closing = replace(SCENE, white=0.6 * 1.05).shots(PATTERNS)[-2]
    summary = verify_shots(SCENE, [*SHOTS[:-2], closing, SHOTS[-1]]).summary()
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
def test_a_frame_of_another_format_is_rejected(image: Pixels, words: str) -> None:
    scene = Scene(bit_depth=12)
    with pytest.raises(ScanEvidenceError, match=words):
        verify_shots(scene, [Shot(0, "left", image)])


# ---- a recorded capture


def test_a_recording_with_faults_is_summarised_without_an_error() -> None:
    summary = check_capture(make_capture(with_image(SHOTS, 5, SHOTS[4].image)))
    assert any("pattern 5 (column Gray bit 1 of 5, inverse)" in fault for fault in summary.faults)
    assert summary.verified < summary.patterns == len(PATTERNS)


def test_cameras_are_checked_separately_and_a_pattern_needs_all() -> None:
    left, right = Scene(noise_dn=1.0), Scene(noise_dn=1.0, seed=3, first_column_px=20)
    bad = right.shots(PATTERNS, "right")
    bad = with_image(bad, 5, bad[4].image)
    formats = {"left": left.format, "right": right.format}
    summary = check_capture(Capture(PROJECTOR, PATTERNS, formats, (*left.shots(PATTERNS), *bad)))
    assert all("camera 'right'" in fault for fault in summary.faults)
    assert summary.verified < summary.patterns


def test_a_bracket_is_checked_at_the_exposure_of_most_patterns() -> None:
    usual = [replace(shot, exposure_s=0.01) for shot in SHOTS]
    long = [replace(shot, exposure_s=0.015) for shot in replace(SCENE, white=0.9).shots(PATTERNS)[:2]]
    summary = check_capture(make_capture([*long, *usual]))
    assert (summary.verified, summary.faults) == (len(PATTERNS), ())


# ---- frames that are taken back: what is left stands as if they had never come


def new_evidence(patterns: Sequence[Pattern] = PATTERNS) -> Evidence:
    return Evidence(patterns, {"left": SCENE.format})


@pytest.fixture(scope="module")
def clean() -> EvidenceSummary:
    """What all frames prove when none was wrong."""
    return verify_shots(SCENE, SHOTS).summary()


def summaries_equal(one: EvidenceSummary, other: EvidenceSummary) -> bool:
    same = [(each.patterns, each.verified, each.lit, each.faults) for each in (one, other)]
    return same[0] == same[1] and bool(one.noise_dn == pytest.approx(other.noise_dn))


# White, black, the first pair, the finest bit, the first line, and the last frame.
@pytest.mark.parametrize(
    "wrong", [0, 11, *(pytest.param(each, marks=pytest.mark.slow) for each in (1, 2, 12, COUNT - 1))]
)
def test_a_wrong_frame_that_is_retracted_and_replaced_leaves_no_trace(wrong: int, clean: EvidenceSummary) -> None:
    evidence = new_evidence()
    waiting = list(SHOTS)
    spoilt = replace(SHOTS[wrong], image=garbled(SHOTS, wrong))
    blamed: list[int] = []
    while waiting:
        shot = waiting.pop(0)
        found = evidence.add_shot(spoilt if shot.pattern == wrong and not blamed else shot)
        suspects = {s for each in found for s in (*each.suspects, *each.further_suspects)}
        if suspects:
            blamed += sorted(suspects)
            gone = evidence.retract("left", suspects)
            assert suspects <= set(gone)
            waiting = [SHOTS[index] for index in gone] + waiting
    assert wrong in blamed
    assert summaries_equal(evidence.summary(), clean)
    assert evidence.summary().light_drift == pytest.approx(clean.light_drift, abs=0.01)


@pytest.mark.parametrize("index", [12, *(pytest.param(each, marks=pytest.mark.slow) for each in (3, COUNT - 1))])
def test_a_correct_frame_may_be_retracted_and_added_again(index: int, clean: EvidenceSummary) -> None:
    evidence = new_evidence()
    for shot in SHOTS:
        add_agreeing_shot(evidence, shot)
    assert evidence.retract("left", [index]) == (index,)
    assert evidence.summary().patterns == COUNT - 1
    add_agreeing_shot(evidence, SHOTS[index])
    assert summaries_equal(evidence.summary(), clean)


@pytest.mark.parametrize("index", [0, 1])
def test_retracting_a_reference_frame_removes_all_frames(index: int, clean: EvidenceSummary) -> None:
    evidence = new_evidence()
    for shot in SHOTS[:6]:
        add_agreeing_shot(evidence, shot)
    assert evidence.retract("left", [index]) == (0, 1, 2, 3, 4, 5)
    assert evidence.summary().patterns == 0
    for shot in SHOTS:
        add_agreeing_shot(evidence, shot)
    assert summaries_equal(evidence.summary(), clean)


def test_an_unknown_frame_can_be_retracted() -> None:
    evidence = new_evidence()
    assert evidence.retract("left", [3]) == ()
    add_agreeing_shot(evidence, SHOTS[0])
    assert evidence.retract("left", [0, 7]) == (0,)


def test_frames_wait_while_white_and_black_are_rejected(clean: EvidenceSummary) -> None:
    evidence = new_evidence()
    add_agreeing_shot(evidence, replace(SHOTS[0], image=SHOTS[1].image))
    (found,) = evidence.add_shot(SHOTS[1])
    assert found.suspects == (0, 1)
    add_agreeing_shot(evidence, SHOTS[2])
    evidence.retract("left", found.suspects)
    for shot in (*SHOTS[:2], *SHOTS[3:]):
        add_agreeing_shot(evidence, shot)
    assert summaries_equal(evidence.summary(), clean)


def test_one_of_two_suspects_may_be_enough() -> None:
    evidence = new_evidence()
    for shot in SHOTS[:4]:
        add_agreeing_shot(evidence, shot)
    add_agreeing_shot(evidence, replace(SHOTS[4], image=garbled(SHOTS, 4)))
    found = evidence.add_shot(SHOTS[5])
    assert [each.suspects for each in found] == [(4, 5)]
    evidence.retract("left", [4])
    add_agreeing_shot(evidence, SHOTS[4])
    assert evidence.summary().faults == ()


def test_contradictions_of_remaining_frames_are_returned_with_the_next() -> None:
    # Bit 0 is shown twice; of the two frames that do not agree the right one is taken back.
    patterns = (*PATTERNS[:4], PATTERNS[2], *PATTERNS[4:])
    evidence = new_evidence(patterns)
    shots = SCENE.shots(patterns)
    for shot in shots[:4]:
        add_agreeing_shot(evidence, shot)
    (found,) = evidence.add_shot(replace(shots[4], image=garbled(shots, 4)))
    assert found.suspects == (4,)
    evidence.retract("left", [2])
    (again,) = evidence.add_shot(shots[5])
    assert again.suspects == (3, 4)
    assert evidence.add_shot(shots[6]) == ()
    assert evidence.summary().faults == (str(again),)


def test_unconfirmed_reference_frames_are_further_suspects() -> None:
    evidence = new_evidence()
    for shot in SHOTS[:3]:
        add_agreeing_shot(evidence, shot)
    (early,) = evidence.add_shot(replace(SHOTS[3], image=garbled(SHOTS, 3)))
    assert (early.suspects, early.further_suspects) == ((2, 3), (0, 1))
    assert str(early).startswith("camera 'left', pattern 3 (column Gray bit 0 of 5, inverse): compared with pattern 2 ")
    evidence.retract("left", [3])
    for shot in SHOTS[3:5]:
        add_agreeing_shot(evidence, shot)
    (late,) = evidence.add_shot(replace(SHOTS[5], image=garbled(SHOTS, 5)))
    assert (late.suspects, late.further_suspects) == ((4, 5), ())


def test_lines_make_the_code_suspect_until_one_agrees_with_it() -> None:
    first = 12
    evidence = new_evidence()
    for shot in SHOTS[:first]:
        add_agreeing_shot(evidence, shot)
    # The light is that of a line frame, and not where the code says.
    wrong = replace(SHOTS[first], image=SHOTS[first + 4].image)
    (found,) = evidence.add_shot(wrong)
    assert (found.suspects, found.further_suspects) == ((first,), tuple(range(2, first)))
    evidence.retract("left", [first])
    add_agreeing_shot(evidence, SHOTS[first])
    (found,) = evidence.add_shot(replace(SHOTS[first + 1], image=SHOTS[first + 5].image))
    assert (found.suspects, found.further_suspects) == ((first + 1,), ())


def test_rejected_exposures_stay_recorded_after_clear() -> None:
    evidence = new_evidence()
    add_agreeing_shot(evidence, SHOTS[0])
    evidence.record_refused(RefusedFrame(3, "left", 1, "stale", SHOTS[3]))
    evidence.record_refused(RefusedFrame(3, "left", 2, "stale", SHOTS[3]))
    evidence.clear()
    summary = evidence.summary()
    assert (summary.patterns, summary.shot_again) == (0, 2)
    assert summary.causes == ("camera 'left', pattern 3 (column Gray bit 0 of 5, inverse): stale",)
    assert str(summary) == "0/0 patterns verified, 2 frames shot again"


def test_a_recording_counts_repeated_exposures() -> None:
    summary = check_capture(
        make_capture(SHOTS), [RefusedFrame(3, "left", 1, "stale"), RefusedFrame(99, "left", 1, "of another sequence")]
    )
    assert str(summary) == "22/22 patterns verified, 1 frame shot again"


# ---- damage to the frames that choose the pixels that are looked at


def black_rows(shots: list[Shot], index: int) -> Pixels:
    image = shots[index].image.copy()
    image[30:80] = 0
    return image


def bright_rows(shots: list[Shot], index: int) -> Pixels:
    image = shots[index].image.copy()
    image[90:140] = 255
    return image


SLOW = product((0, 1, COUNT - 2, COUNT - 1), (garbled, black_rows, bright_rows), (0.3, 0.6, 0.9))
QUICK = [(1, bright_rows, 0.6), (COUNT - 2, black_rows, 0.6)]


@pytest.mark.parametrize(
    ("index", "damage", "white"), [*QUICK, *(pytest.param(*each, marks=pytest.mark.slow) for each in SLOW)]
)
def test_damage_to_white_or_black_is_found_by_the_end(index: int, damage: Spoil, white: float) -> None:
    scene = Scene(noise_dn=1.0, white=white, ambient=0.08)
    shots = scene.shots(PATTERNS)
    found = check_capture(make_capture(with_image(shots, index, damage(shots, index))))
    # Black that is darker still shows nothing: it is as dark as the room in truth.
    assert (found.faults == ()) == (index in {1, COUNT - 1} and damage is black_rows)


@parametrize_core("sequence", SINGLE)
@parametrize_core(
    ("index", "damage"), [(0, garbled), (0, black_rows), (0, bright_rows), (1, garbled), (1, bright_rows)], core=[0, 4]
)
def test_lines_reveal_damage_to_white_and_black(index: int, damage: Spoil, sequence: SequenceName) -> None:
    """Rows of a white frame that are full look like an exposure that is too long: lines tell that it is not."""
    scene, patterns = Scene(noise_dn=1.0, white=0.6), SINGLE[sequence]
    shots = scene.shots(patterns)
    assert recorded_summary(with_image(shots, index, damage(shots, index)), patterns).faults


@pytest.mark.parametrize("sequence", [SequenceName.FAST, SequenceName.STANDARD])
def test_what_overexposure_leaves_is_no_damage(sequence: SequenceName) -> None:
    patterns = SINGLE[sequence]
    shots, brighter = (
        Scene(noise_dn=1.0, white=white, gamma=2.2, ambient=0.05, blur_px=1.6).shots(patterns) for white in (2.0, 5.0)
    )
    assert recorded_summary(shots, patterns).faults == ()
    too_bright = recorded_summary(brighter, patterns).faults
    assert too_bright
    assert all("the white frame is saturated on" in each and "shorten the exposure" in each for each in too_bright)
    (spoilt, *_) = recorded_summary(with_image(shots, 5, garbled(shots, 5)), patterns).faults
    assert "pattern 5 " in spoilt
    assert "damaged" in spoilt


def test_a_line_frame_with_rows_of_another_is_found() -> None:
    """Lines at a quarter of their period light half of every cell: the code says nothing of them."""
    patterns = SINGLE[SequenceName.STANDARD]
    shots = Scene(noise_dn=4.0, white=0.3).shots(patterns)
    index, other = (patterns.index(LineShift(Axis.COLUMN, shift, 8, 4)) for shift in (2, 5))
    image = shots[index].image.copy()
    image[60:110] = shots[other].image[60:110]
    (fault,) = recorded_summary(with_image(shots, index, image), patterns).faults
    assert f"pattern {index} " in fault
    assert "its light does not fit the other line frames" in fault


def test_an_opening_frame_that_shows_half_of_white_is_found_by_the_closing_one() -> None:
    # A frame of the scan before: lit where a coarse bit was, and right wherever it is lit.
    summary = check_capture(make_capture(with_image(SHOTS, 0, SHOTS[2].image)))
    assert any("pattern 20 (white)" in fault for fault in summary.faults)


# ---- Damage that light alone does not contradict: by roughness, the sum of line frames, and the noise of pairs


Image = NDArray[np.float64]
SIZE = Size(200, 240)
SAMPLER = Sampler.from_size(SIZE)
NOISE_DN = 1.0
PERIOD = 8
RANDOM = np.random.default_rng(4)


def camera_image(light: NDArray[np.floating[Any]]) -> Image:
    """(H, W): what the camera sees of light that varies along the columns, 0 to 1, in a room that is not dark."""
    values = 230 * (0.03 + 0.9 * np.broadcast_to(light, SIZE.shape)) ** 0.45
    return np.asarray(values + RANDOM.normal(0, NOISE_DN, SIZE.shape))


def sample(image: Image) -> Samples:
    return SAMPLER.take(np.clip(np.rint(image), 0, 255).astype(np.uint8))


def stripes(width_px: int, shift: float = 0.0, *, period_px: int = PERIOD, blur_px: float = 1.2) -> Samples:
    """(W,): lit stripes of the projector, two of whose columns are five of the camera's, blurred."""
    fine = (np.arange(0, 40 * SIZE.width_px) / 40 / 2.5 - shift) % period_px < width_px
    reach = np.arange(-400, 401) / 40
    kernel = np.exp(-0.5 * (reach / (2.5 * blur_px)) ** 2)
    light = np.convolve(np.pad(fine.astype(float), 400, mode="wrap"), kernel / kernel.sum(), mode="valid")
    return np.asarray(light[::40], dtype=np.float32)


def noisy_band(
    image: Image,
) -> Image:
    """A third of the rows are any bytes."""
    out = image.copy()
    out[80:160] = RANDOM.integers(0, 256, out[80:160].shape)
    return out


@pytest.fixture(scope="module")
def ref() -> ReferenceFrames:
    one = np.ones(SIZE.width_px)
    white, black = sample(camera_image(one)), sample(camera_image(0 * one))
    return build_reference(white, black, threshold_dn=20, full_scale=255, row=SAMPLER.row)


@pytest.mark.parametrize("period_px", [2, 4, 16, 64])
def test_a_garbled_frame_is_rougher_than_its_inverse(ref: ReferenceFrames, period_px: int) -> None:
    bit = camera_image(stripes(period_px // 2, period_px=period_px))
    inverse = sample(camera_image(1 - stripes(period_px // 2, period_px=period_px)))
    assert roughness_fault(sample(bit), [inverse], ref, noise=NOISE_DN) is None
    assert roughness_fault(inverse, [sample(bit)], ref, noise=NOISE_DN) is None
    fault = roughness_fault(sample(noisy_band(bit)), [inverse], ref, noise=NOISE_DN)
    assert fault is not None
    assert "damaged in transfer" in fault
    assert roughness_fault(inverse, [sample(noisy_band(bit))], ref, noise=NOISE_DN) is None


@pytest.mark.parametrize("resolved", [True, False])
def test_a_bit_is_as_rough_as_lines_only_where_the_camera_resolves_them(ref: ReferenceFrames, resolved: bool) -> None:
    """A wall at a grazing view shows coarse bits, and lines as an even grey."""
    lights = [stripes(8, shift, period_px=16) if resolved else np.full(SIZE.width_px, 0.5) for shift in range(0, 16, 4)]
    lines, bit = [sample(camera_image(light)) for light in lights], camera_image(stripes(2, period_px=4, blur_px=0.2))
    if not resolved:
        assert roughness_fault(sample(bit), lines, ref, noise=NOISE_DN) is not None
    spoilt = bit if not resolved else noisy_band(camera_image(stripes(8, period_px=16)))
    fault = roughness_fault(sample(spoilt), lines, ref, noise=NOISE_DN, by_lines=True)
    assert (fault is not None) == resolved


def test_pixel_flicker_is_not_damage(ref: ReferenceFrames) -> None:
    """A projector that dithers: all is lit in one frame of a pair, and nothing in the other."""
    lit = camera_image(np.ones(SIZE.width_px)) * (1 + RANDOM.normal(0, 0.13, SIZE.shape))
    assert roughness_fault(sample(lit), [sample(camera_image(np.zeros(SIZE.width_px)))], ref, noise=NOISE_DN) is None


def lines(width_px: int = 1) -> list[Samples]:
    return [sample(camera_image(stripes(width_px, shift))) for shift in range(PERIOD)]


@pytest.mark.parametrize("width_px", [1, 3])
def test_line_frames_add_up_alike_everywhere_whatever_the_response(ref: ReferenceFrames, width_px: int) -> None:
    assert line_sum_fault(lines(width_px), ref, noise=NOISE_DN) is None


def test_lines_that_a_camera_resolves_less_in_places_are_no_damage(ref: ReferenceFrames) -> None:
    """Its response is compressed, so that they are brighter there on average."""
    frames = []
    for shift in range(PERIOD):
        image = camera_image(stripes(4, shift, blur_px=0.3))
        image[150:] = camera_image(stripes(4, shift, blur_px=2.0))[150:]
        frames.append(sample(image))
    assert line_sum_fault(frames, ref, noise=NOISE_DN, half=True) is None
    level = partial(reference_level_fault, threshold_dn=20, full_scale=255, row=SAMPLER.row)
    assert level(ref.white, ref.black, frames) is None
    darker = np.where(SAMPLER.row < 80, 0.7 * ref.white, ref.white).astype(np.float32)
    fault = level(darker, ref.black, frames)
    assert fault is not None
    assert "damaged in transfer" in fault


def test_a_garbled_line_frame_is_found_by_the_sum(ref: ReferenceFrames) -> None:
    frames = lines()
    frames[3] = sample(noisy_band(camera_image(stripes(1, 3))))
    found = line_sum_fault(frames, ref, noise=NOISE_DN)
    assert found is not None
    blamed, words = found
    assert 3 in blamed
    assert len(blamed) < PERIOD
    assert "do not add up" in words


def test_a_line_frame_that_shows_its_neighbours_lines_is_a_repetition_in_the_dark_too(ref: ReferenceFrames) -> None:
    """Two exposures of one pattern: in dark such a camera has several times the noise that bright pixels tell."""
    again = sample(camera_image(stripes(1, 2)) + RANDOM.normal(0, 3.0, SIZE.shape))
    assert find_repeated(again, lines(), ref, noise=0.5, factor=40.0) == 2
    assert (
        find_repeated(
            sample(camera_image(stripes(1, 2))), [sample(camera_image(stripes(1, 3)))], ref, noise=0.5, factor=40.0
        )
        is None
    )


def test_a_damaged_white_frame_does_not_count_as_noise(ref: ReferenceFrames) -> None:
    damaged = ReferenceFrames(
        RANDOM.uniform(120, 250, len(ref.white)).astype(np.float32), ref.black, ref.contrast, ref.lit, ref.tested,
        ref.row, ref.band,
    )  # fmt: skip
    first, second = (
        [sample(camera_image(stripes(16, period_px=32))), sample(camera_image(1 - stripes(16, period_px=32)))],
        [sample(camera_image(stripes(32, period_px=64))), sample(camera_image(1 - stripes(32, period_px=64)))],
    )
    assert pair_noise_dn(first[0], first[1], damaged) > 10 * NOISE_DN
    by_pairs = pair_noise_dn(second[0], second[1], damaged, sums=[first[0] + first[1]])
    assert NOISE_FLOOR_DN < by_pairs < 3 * NOISE_DN

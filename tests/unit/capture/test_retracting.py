"""Evidence can forget a frame: what is left stands as if it had never come. And damage to white or black shows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from slrig.bundle.refused import Refused
from slrig.capture.evidence import Evidence, EvidenceSummary, check_capture
from slrig.model import Capture, Pattern, Pixels, Shot
from tests.unit.capture.fake_rig import PROJECTOR, Scene, add, patterns_for

PATTERNS = patterns_for()
COUNT = len(PATTERNS)
SCENE = Scene(noise_dn=1.0)
SHOTS = SCENE.shots(PATTERNS)


def evidence_of(patterns: Sequence[Pattern] = PATTERNS) -> Evidence:
    return Evidence(patterns, {"left": SCENE.format})


def clean(shots: Sequence[Shot] = SHOTS) -> EvidenceSummary:
    evidence = evidence_of()
    for shot in shots:
        assert evidence.contradictions(shot) == ()
    return evidence.summary()


def damaged(image: Pixels, seed: int = 6) -> Pixels:
    out = image.copy()
    out[50:100] = np.random.default_rng(seed).integers(0, 256, (50, image.shape[1]), np.uint8)
    return out


def alike(one: EvidenceSummary, other: EvidenceSummary) -> bool:
    same = [(each.patterns, each.verified, each.lit, each.faults) for each in (one, other)]
    return same[0] == same[1] and bool(one.noise_dn == pytest.approx(other.noise_dn))


@pytest.mark.parametrize("wrong", range(COUNT))
def test_a_wrong_frame_that_is_retracted_and_replaced_leaves_no_trace(wrong: int) -> None:
    evidence = evidence_of()
    waiting = list(SHOTS)
    spoilt = replace(SHOTS[wrong], image=damaged(SHOTS[wrong].image))
    blamed: list[int] = []
    while waiting:
        shot = waiting.pop(0)
        found = evidence.contradictions(spoilt if shot.pattern == wrong and not blamed else shot)
        suspects = {s for each in found for s in (*each.suspects, *each.beyond)}
        if suspects:
            blamed += sorted(suspects)
            gone = evidence.retract("left", suspects)
            assert suspects <= set(gone)
            waiting = [SHOTS[index] for index in gone] + waiting
    assert wrong in blamed
    assert alike(evidence.summary(), clean())
    assert evidence.summary().light_drift == pytest.approx(clean().light_drift, abs=0.01)


@pytest.mark.parametrize("index", range(2, COUNT))
def test_a_right_frame_may_be_retracted_and_taken_again(index: int) -> None:
    evidence = evidence_of()
    for shot in SHOTS:
        add(evidence, shot)
    assert evidence.retract("left", [index]) == (index,)
    assert evidence.summary().patterns == COUNT - 1
    add(evidence, SHOTS[index])
    assert alike(evidence.summary(), clean())


@pytest.mark.parametrize("index", [0, 1])
def test_everything_rests_on_the_frames_that_tell_what_is_lit(index: int) -> None:
    evidence = evidence_of()
    for shot in SHOTS[:6]:
        add(evidence, shot)
    assert evidence.retract("left", [index]) == (0, 1, 2, 3, 4, 5)
    assert evidence.summary().patterns == 0
    for shot in SHOTS:
        add(evidence, shot)
    assert alike(evidence.summary(), clean())


def test_what_was_never_there_can_be_retracted() -> None:
    evidence = evidence_of()
    assert evidence.retract("left", [3]) == ()
    add(evidence, SHOTS[0])
    assert evidence.retract("left", [0, 7]) == (0,)


def test_frames_that_come_while_white_and_black_are_refused_are_judged_later() -> None:
    evidence = evidence_of()
    add(evidence, replace(SHOTS[0], image=SHOTS[1].image))
    (found,) = evidence.contradictions(SHOTS[1])
    assert found.suspects == (0, 1)
    add(evidence, SHOTS[2])
    evidence.retract("left", found.suspects)
    for shot in (*SHOTS[:2], *SHOTS[3:]):
        add(evidence, shot)
    assert alike(evidence.summary(), clean())


def test_one_of_two_suspects_may_be_enough() -> None:
    evidence = evidence_of()
    for shot in SHOTS[:4]:
        add(evidence, shot)
    add(evidence, replace(SHOTS[4], image=damaged(SHOTS[4].image)))
    found = evidence.contradictions(SHOTS[5])
    assert [each.suspects for each in found] == [(4, 5)]
    evidence.retract("left", [4])
    add(evidence, SHOTS[4])
    assert evidence.summary().faults == ()


def test_what_the_frames_left_contradict_is_told_with_the_next_one() -> None:
    # Bit 0 is shown twice; of the two frames that do not agree the right one is taken back.
    patterns = (*PATTERNS[:4], PATTERNS[2], *PATTERNS[4:])
    evidence = evidence_of(patterns)
    shots = SCENE.shots(patterns)
    for shot in shots[:4]:
        add(evidence, shot)
    (found,) = evidence.contradictions(replace(shots[4], image=damaged(shots[4].image)))
    assert found.suspects == (4,)
    evidence.retract("left", [2])
    (again,) = evidence.contradictions(shots[5])
    assert again.suspects == (3, 4)
    assert evidence.contradictions(shots[6]) == ()
    assert evidence.summary().faults == (str(again),)


def test_a_contradiction_names_what_it_rests_on_until_something_has_vouched_for_it() -> None:
    evidence = evidence_of()
    for shot in SHOTS[:3]:
        add(evidence, shot)
    (early,) = evidence.contradictions(replace(SHOTS[3], image=damaged(SHOTS[3].image)))
    assert (early.suspects, early.beyond) == ((2, 3), (0, 1))
    assert str(early).startswith("camera 'left', pattern 3 (column Gray bit 0 of 5, inverse): beside pattern 2 ")
    evidence.retract("left", [3])
    for shot in SHOTS[3:5]:
        add(evidence, shot)
    (late,) = evidence.contradictions(replace(SHOTS[5], image=damaged(SHOTS[5].image)))
    assert (late.suspects, late.beyond) == ((4, 5), ())


def test_lines_accuse_the_code_until_one_of_them_agrees_with_it() -> None:
    first = 12
    evidence = evidence_of()
    for shot in SHOTS[:first]:
        add(evidence, shot)
    # The light is that of a line frame, and not where the code says.
    wrong = replace(SHOTS[first], image=SHOTS[first + 4].image)
    (found,) = evidence.contradictions(wrong)
    assert (found.suspects, found.beyond) == ((first,), tuple(range(2, first)))
    evidence.retract("left", [first])
    add(evidence, SHOTS[first])
    (found,) = evidence.contradictions(replace(SHOTS[first + 1], image=SHOTS[first + 5].image))
    assert (found.suspects, found.beyond) == ((first + 1,), ())


def test_what_was_refused_stays_on_record_when_all_frames_are_forgotten() -> None:
    evidence = evidence_of()
    add(evidence, SHOTS[0])
    evidence.note(Refused(3, "left", 1, "stale", SHOTS[3]))
    evidence.note(Refused(3, "left", 2, "stale", SHOTS[3]))
    evidence.forget()
    summary = evidence.summary()
    assert (summary.patterns, summary.shot_again) == (0, 2)
    assert summary.causes == ("camera 'left', pattern 3 (column Gray bit 0 of 5, inverse): stale",)
    assert str(summary) == "0/0 patterns verified, 2 frames shot again"


def test_a_recording_knows_what_was_shot_again() -> None:
    capture = Capture(PROJECTOR, PATTERNS, {"left": SCENE.format}, tuple(SHOTS))
    summary = check_capture(capture, [Refused(3, "left", 1, "stale"), Refused(99, "left", 1, "of another sequence")])
    assert str(summary) == "22/22 patterns verified, 1 frame shot again"


# ---- damage to the frames that choose the pixels that are looked at


def noise(image: Pixels) -> Pixels:
    return damaged(image)


def dark(image: Pixels) -> Pixels:
    out = image.copy()
    out[30:80] = 0
    return out


def bright(image: Pixels) -> Pixels:
    out = image.copy()
    out[90:140] = 255
    return out


@pytest.mark.parametrize("index", [0, 1, COUNT - 2, COUNT - 1])
@pytest.mark.parametrize("damage", [noise, dark, bright], ids=lambda damage: damage.__name__)
@pytest.mark.parametrize("white", [0.3, 0.6, 0.9])
def test_damage_to_white_or_black_shows_by_the_end(
    index: int, damage: Callable[[Pixels], Pixels], white: float
) -> None:
    scene = Scene(noise_dn=1.0, white=white, ambient=0.08)
    shots = scene.shots(PATTERNS)
    spoilt = replace(shots[index], image=damage(shots[index].image))
    capture = Capture(PROJECTOR, PATTERNS, {"left": scene.format}, (*shots[:index], spoilt, *shots[index + 1 :]))
    black = index in {1, COUNT - 1}
    # Black that is darker still shows nothing: it is as dark as the room in truth.
    assert (check_capture(capture).faults == ()) == (black and damage is dark)


def test_an_opening_frame_that_shows_half_of_white_is_found_by_the_closing_one() -> None:
    # A frame of the scan before: lit where a coarse bit was, and right wherever it is lit.
    stale = replace(SHOTS[0], image=SHOTS[2].image)
    capture = Capture(PROJECTOR, PATTERNS, {"left": SCENE.format}, (stale, *SHOTS[1:]))
    summary = check_capture(capture)
    assert any("pattern 20 (white)" in fault for fault in summary.faults)

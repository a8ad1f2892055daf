"""One factor of light is free for each frame: lamps that follow the picture and automatic exposure are no faults, and
what is left after the factor still tells wrong frames from right ones.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from slrig.capture.frame_checks import ReferenceFrames, Samples, build_reference
from slrig.capture.frame_light import FrameLight, fit_pair_light, line_lights, pair_lights, repeat_light
from slrig.capture.verifier import EvidenceSummary, check_capture
from slrig.model import Axis, Black, Capture, Gray, LineShift, Pattern, Pixels, SequenceName, Shot, White
from slrig.scan.plan import PatternPlan, pattern_sequence
from tests.unit.capture.fake_rig import PROJECTOR, Scene, patterns_for

COUNT = 12_000
RNG = np.random.default_rng(8)
CONTRAST = RNG.uniform(60, 200, COUNT).astype(np.float32)
BLACK = (0.2 * CONTRAST + RNG.uniform(5, 30, COUNT)).astype(np.float32)
ROW = np.sort(RNG.integers(0, 200, COUNT)).astype(np.intp)


@pytest.fixture(scope="module")
def ref() -> ReferenceFrames:
    return build_reference(BLACK + CONTRAST, BLACK, threshold_dn=10, full_scale=255, row=ROW)


def frame(light: Samples, factor: float = 1.0, *, is_exposure: bool = False) -> Samples:
    """The samples under `light`, 0 to 1, whose own factor is the lamp's or the exposure's."""
    seen = factor * (BLACK + CONTRAST * light) if is_exposure else BLACK + factor * CONTRAST * light
    return np.asarray(seen + RNG.normal(0, 1, COUNT), dtype=np.float32)


def stripes(lit: float, blur: float) -> Samples:
    """The light of a bit that lights the fraction `lit` of the pixels, and has the fraction `blur` of them at edges."""
    place = RNG.uniform(0, 1, COUNT)
    return np.clip((lit - place) / max(blur, 1e-6) + 0.5, 0, 1).astype(np.float32)


@pytest.mark.parametrize("is_exposure", [False, True])
@pytest.mark.parametrize(("a", "b"), [(1.0, 1.0), (1.33, 1.33), (0.5, 0.5), (1.0, 0.5), (2.5, 0.7)])
@pytest.mark.parametrize(("lit", "blur"), [(0.5, 0.05), (0.8, 0.3), (0.5, 1.0), (0.95, 0.02)])
def test_the_light_of_a_pair_is_found(
    ref: ReferenceFrames, a: float, b: float, lit: float, blur: float, is_exposure: bool
) -> None:
    light = stripes(lit, blur)
    found = fit_pair_light(
        frame(light, a, is_exposure=is_exposure), frame(1 - light, b, is_exposure=is_exposure), ref,
        is_exposure=is_exposure,
    )  # fmt: skip
    assert found is not None
    assert [each.factor for each in found] == pytest.approx([a, b], rel=0.04)


@pytest.mark.parametrize(
    ("light", "inverse"),
    [
        (stripes(0.5, 0.05), None),
        (np.full(COUNT, 0.5, np.float32), np.full(COUNT, 0.5, np.float32)),
        (stripes(0.5, 0.05), np.ones(COUNT, np.float32)),
    ],
    ids=["a copy", "too fine", "white"],
)
def test_a_pair_that_determines_no_light_gets_none(
    ref: ReferenceFrames, light: Samples, inverse: Samples | None
) -> None:
    lights = pair_lights(frame(light), frame(light if inverse is None else inverse), ref, usual=1.3)
    assert set(lights) == {(FrameLight(), FrameLight()), (FrameLight(1.3), FrameLight(1.3))}


def test_light_is_undone(ref: ReferenceFrames) -> None:
    light = stripes(0.5, 0.2)
    for is_exposure in (False, True):
        seen = frame(light, 1.6, is_exposure=is_exposure)
        undone = FrameLight(1.6, is_exposure).undo(seen, ref.black)
        assert np.abs(undone - (BLACK + CONTRAST * light)).max() < 5


@pytest.mark.parametrize(("factor", "is_exposure"), [(0.6, False), (1.5, False), (0.6, True), (1.5, True)])
def test_the_light_of_a_repeated_frame_is_found(ref: ReferenceFrames, factor: float, is_exposure: bool) -> None:
    white = np.ones(COUNT, np.float32)
    found = repeat_light(frame(white), frame(white, factor, is_exposure=is_exposure), ref)
    assert found.factor == pytest.approx(factor, rel=0.02)
    assert found.is_exposure is is_exposure


def test_line_frames_are_compared_with_their_median(ref: ReferenceFrames) -> None:
    light = stripes(0.3, 0.1)
    lights = line_lights([frame(light, each) for each in (1.6, 1.6, 0.8, 1.6)], ref)
    assert [each.factor for each in lights] == pytest.approx([1, 1, 0.5, 1], rel=0.02)


# ---- whole sequences

LINES = patterns_for(rows=True)
SINGLE = pattern_sequence(PatternPlan(sequence=SequenceName.STANDARD), PROJECTOR).patterns
Factor = Callable[[int, Pattern], float]


def steady(_index: int, _pattern: Pattern) -> float:
    return 1.0


def follows_picture(_index: int, pattern: Pattern) -> float:
    """The less a pattern lights, the brighter the lamp."""
    if isinstance(pattern, Gray):
        return 1.33
    if isinstance(pattern, LineShift):
        return 1.33 if pattern.is_half_lit else 2.1
    return 1.0


def slowly_rises(index: int, _pattern: Pattern) -> float:
    return 1.0 + 0.02 * index


def slowly_falls(index: int, _pattern: Pattern) -> float:
    return 0.98**index


def flickers(index: int, _pattern: Pattern) -> float:
    return 1.0 if index < 2 else float(np.random.default_rng(index).uniform(0.75, 1.25))


def halves(index: int, _pattern: Pattern) -> float:
    return 0.5 if index > 8 else 1.0


@cache
def shots(
    patterns: tuple[Pattern, ...], factor: Factor, *, is_exposure: bool = False, noise_dn: float = 1.0
) -> tuple[Shot, ...]:
    """Frames of a sequence, each with light of its own factor: the projector's, or all."""
    scene = Scene(white=0.4, ambient=0.03)
    dark = scene.albedo * scene.ambient * 255
    found = []
    for index, shot in enumerate(replace(scene, bit_depth=16).shots(patterns)):
        image = shot.image.astype(np.float64) / 257
        own = factor(index, patterns[index])
        seen = own * image if is_exposure else dark + own * (image - dark)
        seen += np.random.default_rng(index).normal(0, noise_dn, seen.shape)
        found.append(replace(shot, image=np.clip(np.rint(seen), 0, 255).astype(np.uint8)))
    return tuple(found)


def summary(patterns: Sequence[Pattern], frames: Sequence[Shot]) -> EvidenceSummary:
    return check_capture(Capture(PROJECTOR, tuple(patterns), {"left": Scene().format}, tuple(frames)))


CHANGES = [
    (follows_picture, False),
    (slowly_rises, True),
    (slowly_falls, True),
    (flickers, False),
    (halves, False),
    (halves, True),
]
ONE_CHANGE = [CHANGES[0], *(pytest.param(*each, marks=pytest.mark.slow) for each in CHANGES[1:])]


@pytest.mark.parametrize(
    ("factor", "is_exposure", "patterns"),
    [
        (follows_picture, False, LINES),
        (halves, False, SINGLE),
        *(
            pytest.param(*change, patterns, marks=pytest.mark.slow)
            for change in CHANGES
            for patterns in (LINES, SINGLE)
        ),
    ],
)
def test_light_that_changes_is_no_fault(factor: Factor, is_exposure: bool, patterns: tuple[Pattern, ...]) -> None:
    found = summary(patterns, shots(patterns, factor, is_exposure=is_exposure))
    if patterns is SINGLE and factor is halves:
        # A step of light among the lines looks like damage of one of them.
        assert found.faults
        return
    assert found.faults == ()
    if patterns is LINES:
        assert found.verified == len(patterns)


@pytest.mark.slow
def test_the_light_of_each_kind_of_pattern_is_reported() -> None:
    light = summary(LINES, shots(LINES, follows_picture)).light["left"]
    assert light["column Gray code"].median == pytest.approx(1.33, rel=0.03)
    assert light["row Gray code"].median == pytest.approx(1.33, rel=0.03)
    assert light["column lines"].median == pytest.approx(2.1, rel=0.1)
    kinds = summary(LINES, shots(LINES, steady)).light["left"]
    assert all(each.is_steady for each in kinds.values())


FIRST_BIT = LINES.index(Gray(Axis.COLUMN, 1, 5, 4))
FIRST_LINE = LINES.index(LineShift(Axis.COLUMN, 0, 8))


def stale(images: list[Pixels], index: int) -> Pixels:
    return images[index - 1]


def dark(images: list[Pixels], _index: int) -> Pixels:
    return images[1]


def garbled(images: list[Pixels], index: int) -> Pixels:
    image = images[index].copy()
    image[50:100] = np.random.default_rng(6).integers(0, 256, (50, image.shape[1]), np.uint8)
    return image


@pytest.mark.parametrize(("factor", "is_exposure"), ONE_CHANGE)
@pytest.mark.parametrize(
    ("spoil", "index"),
    [(stale, FIRST_BIT), (garbled, FIRST_LINE),
     *(pytest.param(spoil, index, marks=pytest.mark.slow) for spoil in (stale, dark, garbled)
       for index in (FIRST_BIT, FIRST_BIT + 1, FIRST_LINE, FIRST_LINE + 5))],
)  # fmt: skip
def test_a_wrong_frame_is_found_in_light_that_changes(
    spoil: Callable[[list[Pixels], int], Pixels], index: int, factor: Factor, is_exposure: bool
) -> None:
    frames = list(shots(LINES, factor, is_exposure=is_exposure))
    image = spoil([shot.image for shot in frames], index)
    frames[index] = replace(frames[index], image=image)
    assert summary(LINES, frames).faults


def test_one_cause_is_one_fault_with_its_frames() -> None:
    """Half of the image gets other light after the white and black frames: a door that opens."""
    frames = list(shots(LINES, steady))
    for index, shot in enumerate(frames):
        if isinstance(LINES[index], Gray):
            image = shot.image.astype(np.int64)
            image[:, 100:] += 90
            frames[index] = replace(shot, image=np.clip(image, 0, 255).astype(np.uint8))
    found = summary(LINES, frames)
    assert 1 <= len(found.faults) <= 3
    assert re.search(r"patterns 2–\d+", found.faults[0])
    assert found.wrong == {}


def test_closing_frames_may_be_brighter() -> None:
    frames = shots(LINES, lambda index, _: 1.25 if index >= len(LINES) - 2 else 1.0)
    assert isinstance(LINES[-2], White)
    assert isinstance(LINES[-1], Black)
    found = summary(LINES, frames)
    assert (found.faults, found.verified) == ((), len(LINES))
    assert found.light["left"]["white"].median == pytest.approx(1.25, abs=0.02)
    assert found.light_drift["left"] == pytest.approx(0.25, abs=0.02)

"""Frames that show other patterns than their labels say are named; right sequences have no such explanation."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from slrig.capture.frame_order import describe_indices, find_code_fault, find_order_fault, relate_frames
from slrig.capture.verifier import EvidenceSummary, Sampler, check_capture
from slrig.model import Axis, Black, Capture, Gray, Pattern, Pixels, Shot, Size, White, to_gray
from tests.core import parametrize_core
from tests.unit.capture.fake_rig import PROJECTOR, Scene, patterns_for
from tests.unit.capture.test_evidence import SCENES

CODE: tuple[Pattern, ...] = (
    *(p for p in patterns_for(line_shift=False, rows=True, cell_px=1) if isinstance(p, Gray)),
    White(),
    Black(),
)
"""Columns, then rows, each bit before its inverse, then white and black, as OpenCV orders them."""
LAST = len(CODE) - 1
FINEST = CODE.index(Gray(Axis.COLUMN, 6, 7))


@cache
def images(noise_dn: float = 1.0) -> tuple[Pixels, ...]:
    return tuple(shot.image for shot in Scene(noise_dn=noise_dn).shots(CODE))


def summary(frames: Sequence[Pixels]) -> EvidenceSummary:
    shots = tuple(Shot(index, "left", image) for index, image in enumerate(frames))
    return check_capture(Capture(PROJECTOR, CODE, {"left": Scene().format}, shots))


def exchanged(one: int, other: int) -> list[Pixels]:
    frames = list(images())
    frames[one], frames[other] = frames[other], frames[one]
    return frames


def replaced(index: int, by: int) -> list[Pixels]:
    frames = list(images())
    frames[index] = frames[by]
    return frames


def shifted(by: int) -> list[Pixels]:
    return [images()[(index + by) % len(CODE)] for index in range(len(CODE))]


@parametrize_core(
    ("frames", "words"),
    [
        (shifted(1), "all frames are one frame ahead of their patterns: with the last frame moved to the front"),
        (shifted(-1), "all frames are one frame behind their patterns: with the first frame moved to the end"),
        (shifted(2), "all frames are 2 frames ahead"),
        (shifted(-5), "all frames are 5 frames behind"),
        ([*images()[:9], *images()[10:], images()[LAST]], "a frame is missing at pattern 9 "),
        ([*images()[:9], images()[8], *images()[9:-1]], "pattern [89] .* is one too many"),
        (exchanged(LAST, LAST - 1), r"\(white\) and pattern .* \(black\) are exchanged"),
        ([255 - image for image in images()], "all frames show the inverse of their patterns"),
    ],
    ids=["one ahead", "one behind", "two ahead", "five behind", "one missing", "one twice", "white, black", "inverted"],
    core=[0, 3, 6],
)
def test_a_sequence_in_another_order_is_named_and_of_no_use(frames: Sequence[Pixels], words: str) -> None:
    found = summary(frames)
    assert found.misordered is not None
    assert found.faults == (f"camera 'left': {found.misordered}",)
    assert re.search(words, found.misordered)
    assert found.verified == 0


@pytest.mark.parametrize(
    ("frames", "words", "wrong"),
    [
        (replaced(7, 6), "pattern 7 .* is a copy of pattern 6 ", {7}),
        pytest.param(
            replaced(FINEST + 1, FINEST),
            f"pattern {FINEST + 1} .* is a copy of pattern {FINEST} ",
            {FINEST + 1},
            marks=pytest.mark.slow,
        ),
        (replaced(6, 4), "pattern 6 .* is a copy of pattern 4 ", {6}),
        (replaced(6, LAST), "pattern 6 .* is dark everywhere", {6}),
        pytest.param(replaced(6, LAST - 1), "pattern 6 .* is white everywhere", {6}, marks=pytest.mark.slow),
        (exchanged(5, 7), "pattern 5 .* and pattern 7 .* are exchanged: with them exchanged back", {5, 7}),
        pytest.param(exchanged(4, 6), "pattern 4 .* and pattern 6 .* are exchanged", {4, 6}, marks=pytest.mark.slow),
        pytest.param(exchanged(4, 7), "pattern 4 .* and pattern 7 .* are exchanged", {4, 7}, marks=pytest.mark.slow),
        (exchanged(3, 20), "pattern 3 .* and pattern 20 .* are exchanged", {3, 20}),
        (exchanged(6, 7), "bit 5 of the column code is exchanged with its inverse", {6, 7}),
        pytest.param(
            exchanged(FINEST, FINEST + 1),
            "bit 6 of the column code is exchanged with its inverse",
            {FINEST, FINEST + 1},
            marks=pytest.mark.slow,
        ),
    ],
)
def test_frames_that_are_proven_wrong_are_named_once(frames: Sequence[Pixels], words: str, wrong: set[int]) -> None:
    found = summary(frames)
    assert found.misordered is None
    (fault,) = found.faults
    assert re.search(words, fault)
    assert found.wrong == {"left": frozenset(wrong)}


@pytest.mark.parametrize(
    "name", ["noisy", *(pytest.param(each, marks=pytest.mark.slow) for each in SCENES if each != "noisy")]
)
def test_right_sequences_need_no_explanation(name: str) -> None:
    scene = SCENES[name]
    patterns = patterns_for(rows=True)
    sampler = Sampler.from_size(scene.camera, neighbour_px=1)
    relations = relate_frames([sampler.take(shot.image) for shot in scene.shots(patterns)])
    assert relations is not None
    assert find_order_fault(patterns, relations, str) is None


def test_a_dark_sequence_has_no_relations() -> None:
    dark = np.zeros(2000, np.float32)
    assert relate_frames([dark] * 20) is None
    assert relate_frames([dark] * 3) is None


# ---- a code whose bits were confused


def differences(bits: int = 7, *, noise: float = 0.05) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """Bits less inverses of adjacent pixels that see adjacent columns; the second half of the pixels are neighbours."""
    rng = np.random.default_rng(2)
    first = rng.integers(0, 2**bits - 1, 4000)
    index = np.concatenate([first, first + 1])
    lit = (to_gray(index) >> np.arange(bits - 1, -1, -1)[:, np.newaxis]) & 1
    return (2.0 * lit - 1 + rng.normal(0, noise, lit.shape)).astype(np.float32)


def test_every_confusion_of_two_frames_of_a_code_is_found() -> None:
    right = differences()
    assert find_code_fault(right) is None
    for bit in range(1, 7):
        wrong = right.copy()
        wrong[bit] *= -1
        found = find_code_fault(wrong)
        assert found is not None
        assert (found.inverted, found.exchanged) == ((bit,), ())
        for other in range(bit):
            wrong = right.copy()
            wrong[[other, bit]] = right[[bit, other]]
            found = find_code_fault(wrong)
            assert found is not None
            assert (found.inverted, found.exchanged) == ((), ((other, bit),))
    found = find_code_fault(-right)
    assert found is not None
    assert found.inverted == tuple(range(7))


def test_bits_that_are_noise_are_not_confused() -> None:
    unresolved = differences()
    unresolved[5:] = np.random.default_rng(3).normal(0, 1, unresolved[5:].shape)
    assert find_code_fault(unresolved) is None


def test_frames_are_listed_in_ranges() -> None:
    assert describe_indices([12, 7, 8, 3, 9]) == "3, 7–9, 12"
    assert describe_indices([0, 1]) == "0, 1"


@pytest.mark.slow
def test_a_camera_that_sees_a_part_of_the_projector_needs_no_explanation() -> None:
    size = Size(1024, 96)
    for first_px in (2.0, 300.0, 880.0):
        scene = replace(Scene(noise_dn=1.5, projector=size, first_column_px=first_px))
        patterns = patterns_for(size)
        shots = tuple(scene.shots(patterns))
        sampler = Sampler.from_size(scene.camera, neighbour_px=1)
        relations = relate_frames([sampler.take(shot.image) for shot in shots])
        assert relations is not None
        assert find_order_fault(patterns, relations, str) is None
        assert check_capture(Capture(size, patterns, {"left": scene.format}, shots)).faults == ()

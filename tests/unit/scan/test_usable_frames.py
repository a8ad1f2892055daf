"""Frames that are proven wrong are not used: a bit comes from its inverse, other frames are left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slrig.bundle import BundleFiles, open_bundle, write_bundle
from slrig.capture.verifier import EvidenceSummary, check_capture
from slrig.model import Axis, Black, Capture, Gray, LineShift, Pattern, Pixels, Shot, Sine, White
from slrig.scan.preparation import UsableFiles, rebuilt_image, usable_files
from tests.core import parametrize_core
from tests.unit.capture.fake_rig import PROJECTOR, Scene, patterns_for

PATTERNS: tuple[Pattern, ...] = patterns_for(rows=True)
SCENE = Scene(noise_dn=1.0)
SHOTS = SCENE.shots(PATTERNS)
BIT = PATTERNS.index(Gray(Axis.COLUMN, 2, 5, 4))
ROW_BIT = next(i for i, p in enumerate(PATTERNS) if isinstance(p, Gray) and p.axis is Axis.ROW and p.bit == 1)
LINE = next(i for i, p in enumerate(PATTERNS) if isinstance(p, LineShift))


def bundle(folder: Path, copies: Mapping[int, int]) -> tuple[BundleFiles, EvidenceSummary]:
    """A bundle in which some frames are copies of others, and what it proves. copies : frame by wrong frame."""
    shots = tuple(Shot(s.pattern, s.camera, SHOTS[copies.get(s.pattern, s.pattern)].image) for s in SHOTS)
    capture = Capture(PROJECTOR, PATTERNS, {"left": SCENE.format}, shots)
    write_bundle(folder, capture, None)
    return open_bundle(folder), check_capture(capture)


def images(files: BundleFiles | UsableFiles) -> dict[int, Pixels]:
    shots: Sequence[Shot] = list(files.shots(range(len(files.outline.shots))))
    return {shot.pattern: shot.image for shot in shots}


def test_a_wrong_bit_is_rebuilt_from_its_inverse(tmp_path: Path) -> None:
    files, evidence = bundle(tmp_path / "b", {BIT + 1: BIT})
    assert evidence.wrong == {"left": frozenset({BIT + 1})}
    usable = usable_files(files, evidence, Axis.COLUMN)
    assert usable is not None
    assert usable.note == f"frames not used: {BIT + 1} of camera 'left', rebuilt from the inverse, white and black"
    found = images(usable)
    assert found.keys() == set(range(len(PATTERNS)))
    difference = found[BIT + 1].astype(int) - SHOTS[BIT + 1].image
    assert np.abs(difference).max() < 12
    assert np.abs(difference.mean()) < 0.2
    assert all(np.array_equal(found[i], SHOTS[i].image) for i in found if i != BIT + 1)


def test_a_bit_without_a_right_frame_and_a_line_frame_are_left_out(tmp_path: Path) -> None:
    files, evidence = bundle(tmp_path / "b", {LINE + 3: LINE + 2})
    assert evidence.wrong == {"left": frozenset({LINE + 3})}
    wrong = frozenset({BIT, BIT + 1, LINE + 3})
    usable = usable_files(files, replace(evidence, wrong={"left": wrong}), None)
    assert usable is not None
    assert images(usable).keys() == set(range(len(PATTERNS))) - wrong
    assert "left out" in usable.note


@pytest.mark.slow
def test_wrong_frames_of_the_other_axis_do_not_matter(tmp_path: Path) -> None:
    files, evidence = bundle(tmp_path / "b", {ROW_BIT + 1: ROW_BIT})
    assert evidence.wrong == {"left": frozenset({ROW_BIT + 1})}
    assert usable_files(files, evidence, Axis.COLUMN) is None
    assert usable_files(files, evidence, Axis.ROW) is not None
    right, nothing_wrong = bundle(tmp_path / "right", {})
    assert usable_files(right, nothing_wrong, None) is None


@pytest.mark.slow
def test_light_that_changes_within_a_pair_is_evened_out(tmp_path: Path) -> None:
    shots = tuple(
        replace(shot, image=np.rint(shot.image * (0.7 if shot.pattern % 2 else 1.0)).astype(np.uint8))
        if isinstance(PATTERNS[shot.pattern], Gray)
        else shot
        for shot in Scene().shots(PATTERNS)
    )
    capture = Capture(PROJECTOR, PATTERNS, {"left": SCENE.format}, shots)
    write_bundle(tmp_path / "b", capture, None)
    evidence = check_capture(capture)
    assert evidence.faults == ()
    usable = usable_files(open_bundle(tmp_path / "b"), evidence, Axis.COLUMN)
    assert usable is not None
    assert usable.note == ""
    found, right = images(usable), Scene().shots(PATTERNS)
    for index in usable.evened:
        assert np.abs(found[index].astype(int) - right[index].image).mean() < 1.5
    assert {index for index in usable.evened if index % 2}


@pytest.mark.parametrize("light", [0.7, 1.0, 1.33])
def test_a_rebuilt_bit_has_the_light_of_its_inverse(light: float) -> None:
    white, black = np.full((2, 3), 150, np.uint8), np.full((2, 3), 20, np.uint8)
    share = np.array([[0, 0.2, 0.5], [0.7, 1, 1]])
    inverse = np.rint(20 + light * 130 * (1 - share)).astype(np.uint8)
    found = rebuilt_image(inverse, white, black, light=light, full_scale=255)
    assert found.dtype == np.uint8
    np.testing.assert_allclose(found, 20 + light * 130 * share, atol=1)
    assert isinstance(PATTERNS[0], White)


# ---- sinusoids


def shifted(period_px: float, steps: int) -> tuple[Pattern, ...]:
    return tuple(Sine(Axis.COLUMN, period_px, shift, steps) for shift in range(steps))


@parametrize_core(
    "patterns",
    [
        (White(), Black(), *shifted(128, 4), *shifted(16, 4)),
        (White(), Black(), *shifted(128, 3), *shifted(16, 3)),
        (*shifted(128, 4), *shifted(16, 4)),
        (White(), Black(), *(Gray(Axis.COLUMN, bit, 4, 8) for bit in range(4)), *shifted(16, 4)),
    ],
    ids=["two of four", "2x3", "without white and black", "a code and four"],
    core=[0, 3],
)
@parametrize_core("scaler_px", [0.0, 0.7], core=[1])
def test_a_wrong_sinusoid_is_rebuilt_from_its_other_shifts(
    tmp_path: Path, patterns: tuple[Pattern, ...], scaler_px: float
) -> None:
    """Also with a projector whose gamma is 2.2."""
    scene = Scene(noise_dn=1.0, scaler_px=scaler_px)
    right, wrong = scene.shots(patterns), len(patterns) - 2
    shots = [replace(shot, image=right[wrong - 1].image) if shot.pattern == wrong else shot for shot in right]
    capture = Capture(PROJECTOR, patterns, {"left": scene.format}, tuple(shots))
    write_bundle(tmp_path / "b", capture, None)
    evidence = check_capture(capture)
    assert evidence.wrong == {"left": frozenset({wrong})}
    usable = usable_files(open_bundle(tmp_path / "b"), evidence, Axis.COLUMN)
    assert usable is not None
    assert usable.note == f"frames not used: {wrong} of camera 'left', rebuilt from the other shifts"
    difference = images(usable)[wrong].astype(int) - right[wrong].image
    assert np.percentile(np.abs(difference), 99) < 15

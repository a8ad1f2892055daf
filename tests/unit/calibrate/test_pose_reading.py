"""Poses read from the frames of a rendered rig, against its truth; and poses that no calibration should take."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slrig.bundle import write_bundle
from slrig.calibrate.pose_reading import axis_of_poses, bundle_device_sizes, moved_px, read_captured, read_pose
from slrig.calibrate.store import ReadPose
from slrig.calibration.board import COLUMN, ROW, Board, BoardKind, Correspondences
from slrig.calibration.detection.detection import board_mask, find_board
from slrig.calibration.poses.checks import LIMITS
from slrig.calibration.solution import PROJECTOR
from slrig.errors import PatternError, PoseRefusedError, TurntableRefusedError
from slrig.model import Axis, Black, Capture, Gray, LineShift, Pattern, Size, White
from tests.core import parametrize_core
from tests.unit.calibrate.shot_boards import BOARD, Standing, both, patterns_for, position_at, shot, truth_of
from tests.unit.scan.fakes import tame_calibration

ENDS = patterns_for(Size(384, 240))[:2]
"""White and black."""


@pytest.fixture(scope="module")
def pose() -> Capture:
    return shot()


@pytest.fixture(scope="module")
def read(pose: Capture) -> ReadPose:
    return read_captured(pose, BOARD, "pose 1")


def off_px(light: Correspondences) -> dict[int, tuple[float, float, int]]:
    """By axis: rms error on paper, rms of error over stated deviation on paper and ink, and count of both."""
    found = {}
    for axis in (COLUMN, ROW):
        mine = light.axis == axis
        off = light.position_px[mine] - position_at(truth_of(Standing()), light.pixels_px[mine], axis)
        assert np.isfinite(off).all()
        assert abs(off.mean()) < 0.003
        sigma = light.sigma_px[mine]
        paper = sigma < 4 * sigma.min()
        assert paper.mean() > 0.4
        ratio = off / sigma
        found[axis] = float(np.sqrt(np.mean(off[paper] ** 2))), float(np.sqrt(np.mean(ratio**2))), len(off)
    return found


def without(capture: Capture, *unwanted: type[Pattern], axis: Axis | None = None) -> Capture:
    """A capture that lacks the frames of some patterns; of one axis, if that is given."""

    def wanted(pattern: Pattern) -> bool:
        if axis is not None and isinstance(pattern, Gray | LineShift):
            return pattern.axis is not axis
        return not isinstance(pattern, unwanted)

    shots = tuple(each for each in capture.shots if wanted(capture.patterns[each.pattern]))
    return replace(capture, shots=shots)


def without_gray(capture: Capture, unwanted: Callable[[Gray], bool]) -> Capture:
    def wanted(pattern: Pattern) -> bool:
        return not (isinstance(pattern, Gray) and unwanted(pattern))

    return replace(capture, shots=tuple(each for each in capture.shots if wanted(capture.patterns[each.pattern])))


def test_pose_gives_every_corner_and_light_that_is_right_within_what_it_states(read: ReadPose) -> None:
    assert read.observation.name == "pose 1"
    assert read.observation.views["left"].corner.tolist() == list(range(BOARD.corner_count))
    for rms_px, ratio, count in off_px(read.observation.correspondences["left"]).values():
        assert count > 3000
        assert rms_px <= 0.02
        assert 0.8 <= ratio <= 1.25
    figures = read.figures["left"]
    assert figures.moved_px < 0.05
    assert figures.saturated == 0
    assert 0.6 < figures.contrast < 0.9
    assert figures.sharpness_px == pytest.approx(np.hypot(0.6, 12**-0.5), abs=0.1)
    assert figures.decoded > 0.9


@pytest.mark.slow
def test_without_line_shift_code_edges_give_the_light() -> None:
    found = read_captured(shot(line_shift=False), BOARD, "gray")
    for rms_px, ratio, count in off_px(found.observation.correspondences["left"]).values():
        # An edge every two columns.
        assert count > 1800
        assert rms_px <= 0.03
        assert 0.8 <= ratio <= 1.25


@pytest.mark.slow
def test_without_inverses_a_pose_is_read_all_the_same(pose: Capture) -> None:
    found = read_captured(without_gray(pose, lambda pattern: pattern.inverted), BOARD, "bare")
    for rms_px, _, count in off_px(found.observation.correspondences["left"]).values():
        assert count > 3000
        assert rms_px <= 0.02


@pytest.mark.slow
def test_bundle_reads_as_its_frames_do(pose: Capture, read: ReadPose, tmp_path: Path) -> None:
    write_bundle(tmp_path / "one", pose)
    again = read_pose(tmp_path / "one", BOARD, "pose 1")
    np.testing.assert_array_equal(
        again.observation.correspondences["left"].position_px, read.observation.correspondences["left"].position_px
    )
    assert again.figures == read.figures
    assert bundle_device_sizes(tmp_path / "one") == {"left": pose.cameras["left"].size, PROJECTOR: pose.projector}


@pytest.mark.slow
def test_white_alone_gives_corners_and_no_light(pose: Capture, tmp_path: Path) -> None:
    alone = without(pose, Black, Gray, LineShift)
    found = read_captured(alone, BOARD, "cameras")
    assert len(found.observation.views["left"].corner) == BOARD.corner_count
    assert not found.observation.correspondences
    figures = found.figures["left"]
    assert np.isnan(figures.decoded)
    assert 0.6 < figures.contrast < 0.9
    assert figures.moved_px < 0.05
    white_only = replace(alone, patterns=(White(),), shots=tuple(replace(each, pattern=0) for each in alone.shots[:1]))
    write_bundle(tmp_path / "white", white_only)
    assert PROJECTOR not in bundle_device_sizes(tmp_path / "white")
    assert np.isnan(read_captured(white_only, BOARD, "one frame").figures["left"].moved_px)


@pytest.mark.slow
def test_camera_that_does_not_see_the_board_leaves_the_other(pose: Capture) -> None:
    blind = both(without(pose, Gray, LineShift), shot(Standing(away=True), patterns=ENDS, camera="right"))
    found = read_captured(blind, BOARD, "half")
    assert set(found.observation.views) == set(found.figures) == {"left"}


def moved_px_of(shift_mm: tuple[float, float, float], seed: int = 1) -> float:
    """What is stated of a board that moved between the first and the last pair of white and black frames, px."""
    standing = Standing()
    seen = shot(standing, then=standing.shifted(shift_mm), patterns=(*ENDS, *ENDS), seed=seed)
    return read_captured(seen, BOARD, "moving").figures["left"].moved_px


@pytest.mark.slow
def test_board_that_stands_still_does_not_move() -> None:
    # Chance makes one of ten thousand poses move.
    assert [moved_px_of((0.0, 0.0, 0.0), seed) for seed in range(4)] == [0.0] * 4


@pytest.mark.parametrize(
    ("shift_mm", "warned"),
    [
        pytest.param((0.03, 0.0, 0.0), False, marks=pytest.mark.slow),
        ((0.0, 0.06, 0.0), True),
        pytest.param((0.0, 0.0, 0.15), False, marks=pytest.mark.slow),
        pytest.param((3.0, 0.0, 0.0), True, marks=pytest.mark.slow),
    ],
)
def test_movement_is_measured_and_above_a_limit_warned_of(shift_mm: tuple[float, float, float], warned: bool) -> None:
    """There are 0.94 px to a millimetre here; 0.04 px of all corners is where the warning begins.

    A board that comes nearer by a millimetre moves its corners by 0.19 px.
    """
    moved = moved_px_of(shift_mm)
    x, y, z = shift_mm
    assert moved == pytest.approx(np.hypot(0.94 * np.hypot(x, y), 0.19 * z), abs=0.006, rel=0.05)
    assert (moved > LIMITS.moved_px[0]) == warned


@pytest.mark.slow
def test_board_moved_by_two_squares_does_not_look_as_if_it_stood_still() -> None:
    standing = Standing(rotation_deg=(0.0, 0.0, 0.0))
    there = standing.shifted((2 * BOARD.square_mm, 0.0, 0.0))
    frames = [shot(each, patterns=ENDS).shots[0].image.astype(np.float32) for each in (standing, there)]
    view = find_board(frames[0], BOARD, full_scale=255.0)
    region = board_mask(view, BOARD, (frames[0].shape[0], frames[0].shape[1]))
    assert moved_px(frames, view, BOARD, region, 255.0) == pytest.approx(36.0 * 570 / 605, rel=0.1)


@pytest.mark.slow
def test_jolt_between_two_white_frames_shows_where_inverses_were_played(pose: Capture) -> None:
    half = len(pose.shots) // 2
    steps = slice(half - 8, half + 8)
    patterns = [pose.patterns[each.pattern] for each in pose.shots[steps]]
    jolted = shot(Standing().shifted((0.0, 0.5, 0.0)), patterns=patterns).shots
    # The board is back in its place when the sequence ends.
    moved = [replace(each, image=other.image) for each, other in zip(pose.shots[steps], jolted, strict=True)]
    seen = replace(pose, shots=(*pose.shots[: half - 8], *moved, *pose.shots[half + 8 :]))
    assert read_captured(seen, BOARD, "jolt").figures["left"].moved_px > 0.3


def unlit(pose: Capture) -> Capture:
    """The room lights the board, and every pattern shows the same."""
    return replace(pose, shots=tuple(replace(each, image=pose.shots[0].image) for each in pose.shots))


def bracket(pose: Capture) -> Capture:
    longer = tuple(replace(each, exposure_s=4 * (each.exposure_s or 1)) for each in pose.shots)
    return replace(pose, shots=(*pose.shots, *longer))


def moved_far(_: Capture) -> Capture:
    standing = Standing()
    return shot(standing, then=standing.shifted((40.0, 25.0, 0.0)), patterns=(*ENDS, *ENDS))


@parametrize_core(
    ("spoilt", "words"),
    [
        (lambda _: shot(Standing(away=True), patterns=ENDS), r"pose 'bad': no camera sees the board.*camera 'left'"),
        (moved_far, r"moved while the pose was shot.*hold it still"),
        (lambda pose: without(pose, axis=Axis.COLUMN), "rows alone.*with the column patterns as well.*inverses"),
        (lambda pose: without(pose, axis=Axis.ROW), "columns alone.*with the row patterns as well.*inverses"),
        (lambda pose: without_gray(pose, lambda pattern: pattern.bit == 2), r"pose 'bad'.*bits \[2\]"),
        (lambda pose: without(pose, White), "no white frame"),
        (bracket, "one exposure"),
        (unlit, r"codes cannot be read.*projector lights 0%.*projector's picture"),
    ],
    core=[0, 1, 7],
)
def test_bad_pose_is_refused_with_its_cause(pose: Capture, spoilt: Callable[[Capture], Capture], words: str) -> None:
    with pytest.raises((PoseRefusedError, PatternError), match=words):
        read_captured(spoilt(pose), BOARD, "bad")


@pytest.mark.slow
def test_another_board_is_refused(pose: Capture) -> None:
    with pytest.raises(PoseRefusedError, match="camera 'left'"):
        read_captured(pose, Board(BoardKind.CHESSBOARD, 6, 9, 18.0), "wrong")


@pytest.mark.slow
def test_clipped_paper_is_counted(pose: Capture) -> None:
    ends = without(pose, Gray, LineShift)
    bright = [replace(each, image=np.minimum(each.image.astype(int) * 2, 255).astype(np.uint8)) for each in ends.shots]
    assert read_captured(replace(ends, shots=tuple(bright)), BOARD, "bright").figures["left"].saturated > 0.3


def test_an_axis_of_a_board_that_was_not_seen_is_refused_with_the_reason() -> None:
    refused = {"-50°": "the board is not in view", "-30°": "the board is half in view"}
    with pytest.raises(TurntableRefusedError, match=r"in 0 of 2 poses, and an axis takes 3\. -50°: the board is"):
        axis_of_poses([], BOARD, tame_calibration(), [], refused=refused)

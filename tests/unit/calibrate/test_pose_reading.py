"""Poses read from the frames of a rendered rig, against its truth; and poses that no calibration should take."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slrig.bundle import write_bundle
from slrig.calibrate.pose_frames import bundle_device_sizes
from slrig.calibrate.pose_movement import moved_px
from slrig.calibrate.pose_reading import read_captured, read_pose
from slrig.calibrate.solving import ReadPose
from slrig.calibration.board import Board, BoardKind
from slrig.calibration.boards.detection import board_region, find_board
from slrig.calibration.observations import COLUMN, ROW, Correspondences
from slrig.calibration.poses.checks import LIMITS, check_same_devices
from slrig.calibration.solution import PROJECTOR
from slrig.errors import CalibrationError, PatternError, PoseRefusedError
from slrig.model import Axis, Black, Capture, Gray, LineShift, Pattern, Size, White
from tests.unit.calibrate.shot_boards import BOARD, Standing, both, patterns_for, position_at, shot, truth_of


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


def test_a_pose_gives_every_corner_and_light_that_is_right_within_what_it_states(read: ReadPose) -> None:
    assert read.observation.name == "pose 1"
    view = read.observation.views["left"]
    assert view.corner.tolist() == list(range(BOARD.corner_count))
    for rms_px, ratio, count in off_px(read.observation.correspondences["left"]).values():
        assert count > 3000
        assert rms_px <= 0.02
        assert 0.8 <= ratio <= 1.25


def test_figures_say_how_well_the_board_was_seen(read: ReadPose) -> None:
    figures = read.figures["left"]
    assert figures.moved_px < 0.05
    assert figures.saturated == 0
    assert 0.6 < figures.contrast < 0.9
    assert figures.sharpness_px == pytest.approx(np.hypot(0.6, 12**-0.5), abs=0.1)
    assert figures.decoded > 0.9


@pytest.mark.slow
def test_without_line_shift_code_edges_tell_the_light() -> None:
    found = read_captured(shot(line_shift=False), BOARD, "gray")
    for rms_px, ratio, count in off_px(found.observation.correspondences["left"]).values():
        # An edge every two columns.
        assert count > 1800
        assert rms_px <= 0.03
        assert 0.8 <= ratio <= 1.25


def test_without_inverses_a_pose_is_read_all_the_same(pose: Capture) -> None:
    bare = tuple(
        each
        for each in pose.shots
        if not (isinstance(pattern := pose.patterns[each.pattern], Gray) and pattern.inverted)
    )
    found = read_captured(replace(pose, shots=bare), BOARD, "bare")
    for rms_px, _, count in off_px(found.observation.correspondences["left"]).values():
        assert count > 3000
        assert rms_px <= 0.02


def test_a_bundle_reads_as_its_frames_do(pose: Capture, read: ReadPose, tmp_path: Path) -> None:
    write_bundle(tmp_path / "one", pose)
    again = read_pose(tmp_path / "one", BOARD, "pose 1")
    np.testing.assert_array_equal(
        again.observation.correspondences["left"].position_px, read.observation.correspondences["left"].position_px
    )
    assert again.figures == read.figures
    assert bundle_device_sizes(tmp_path / "one") == {"left": pose.cameras["left"].size, PROJECTOR: pose.projector}


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


def test_one_camera_that_does_not_see_the_board_leaves_the_other(pose: Capture) -> None:
    blind = shot(Standing(away=True), camera="right")
    found = read_captured(both(blind, pose), BOARD, "half")
    assert set(found.observation.views) == set(found.figures) == {"left"}
    assert set(found.observation.correspondences) == {"left"}


def test_a_board_in_no_camera_is_refused_by_camera_and_cause() -> None:
    blind = shot(Standing(away=True), line_shift=False)
    with pytest.raises(PoseRefusedError, match=r"pose 'far': no camera sees the board.*camera 'left'"):
        read_captured(blind, BOARD, "far")


def test_another_board_is_refused(pose: Capture) -> None:
    with pytest.raises(PoseRefusedError, match="camera 'left'"):
        read_captured(pose, Board(BoardKind.CHESSBOARD, 6, 9, 18.0), "wrong")


def moved_at_ends(shift_mm: tuple[float, float, float], seed: int = 1) -> float:
    """What is told of a board that moved between the first and the last pair of white and black frames, px."""
    standing = Standing()
    ends = patterns_for(Size(384, 240))[:2]
    seen = shot(standing, then=standing.shifted(shift_mm), patterns=(*ends, *ends), seed=seed)
    return read_captured(seen, BOARD, "moving").figures["left"].moved_px


def test_a_board_that_stands_still_does_not_move() -> None:
    # Chance makes one of ten thousand poses move.
    assert [moved_at_ends((0.0, 0.0, 0.0), seed) for seed in range(4)] == [0.0] * 4


@pytest.mark.parametrize(
    ("shift_mm", "warned"),
    [((0.03, 0.0, 0.0), False), ((0.0, 0.06, 0.0), True), ((0.0, 0.0, 0.15), False), ((0.0, 0.0, 0.3), True)],
)
def test_a_movement_is_warned_of_from_so_much_on(shift_mm: tuple[float, float, float], warned: bool) -> None:
    """There are 0.94 px to a millimetre here; 0.04 px of all corners is where the warning begins.

    A board that comes nearer by a millimetre moves its corners by 0.19 px.
    """
    moved = moved_at_ends(shift_mm)
    x, y, z = shift_mm
    assert moved == pytest.approx(np.hypot(0.94 * np.hypot(x, y), 0.19 * z), abs=0.006)
    assert (moved > LIMITS.moved_px[0]) == warned


@pytest.mark.parametrize("shift_mm", [0.4, 3.0])
def test_a_board_that_moved_says_by_how_much(shift_mm: float) -> None:
    standing = Standing()
    seen = shot(standing, then=standing.shifted((shift_mm, 0.0, 0.0)), line_shift=False)
    moved = read_captured(seen, BOARD, "moving").figures["left"].moved_px
    # 570 px of focal length, 605 mm away.
    assert moved == pytest.approx(shift_mm * 570 / 605, rel=0.1)


def test_a_board_that_moved_far_is_refused_as_moving() -> None:
    standing = Standing()
    ends = patterns_for(Size(384, 240))[:2]
    seen = shot(standing, then=standing.shifted((40.0, 25.0, 0.0)), patterns=(*ends, *ends))
    with pytest.raises(PoseRefusedError, match=r"moved while the pose was shot.*hold it still"):
        read_captured(seen, BOARD, "moving")


def test_a_board_moved_by_two_squares_does_not_look_as_if_it_stood_still() -> None:
    standing = Standing(rotation_deg=(0.0, 0.0, 0.0))
    there = standing.shifted((2 * BOARD.square_mm, 0.0, 0.0))
    ends = patterns_for(Size(384, 240))[:2]
    frames = [shot(each, patterns=ends).shots[0].image.astype(np.float32) for each in (standing, there)]
    view = find_board(frames[0], BOARD, full_scale=255.0)
    region = board_region(view, BOARD, (frames[0].shape[0], frames[0].shape[1]))
    assert moved_px(frames, view, BOARD, region, 255.0) == pytest.approx(36.0 * 570 / 605, rel=0.1)


def test_a_jolt_between_two_white_frames_shows_where_inverses_were_played(pose: Capture) -> None:
    standing = Standing()
    jolted = shot(standing.shifted((0.0, 0.5, 0.0)))
    half = len(pose.shots) // 2
    # The board is back in its place when the sequence ends.
    seen = replace(pose, shots=(*pose.shots[: half - 8], *jolted.shots[half - 8 : half + 8], *pose.shots[half + 8 :]))
    assert read_captured(seen, BOARD, "jolt").figures["left"].moved_px > 0.3


@pytest.mark.parametrize("axis", list(Axis))
def test_codes_of_one_axis_are_refused_with_what_to_shoot(pose: Capture, axis: Axis) -> None:
    other = next(each for each in Axis if each is not axis)
    with pytest.raises(PoseRefusedError, match=f"{other}s alone.*with the {axis} patterns as well.*inverses"):
        read_captured(without(pose, axis=axis), BOARD, "half")


def test_a_missing_bit_names_the_pose(pose: Capture) -> None:
    lacking = tuple(
        each
        for each in pose.shots
        if not (isinstance(pattern := pose.patterns[each.pattern], Gray) and pattern.bit == 2)
    )
    with pytest.raises(PatternError, match=r"pose 'cut'.*bits \[2\]"):
        read_captured(replace(pose, shots=lacking), BOARD, "cut")


def test_no_white_frame_is_refused(pose: Capture) -> None:
    with pytest.raises(PoseRefusedError, match="no white frame"):
        read_captured(without(pose, White), BOARD, "dark")


def test_a_bracket_is_refused(pose: Capture) -> None:
    longer = tuple(replace(each, exposure_s=4 * (each.exposure_s or 1)) for each in pose.shots)
    with pytest.raises(PoseRefusedError, match="one exposure"):
        read_captured(replace(pose, shots=(*pose.shots, *longer)), BOARD, "bracket")


def test_clipped_paper_is_counted_and_gives_no_light() -> None:
    standing = Standing(white=1.6)
    clipped = shot(standing)
    found = read_captured(clipped, BOARD, "bright")
    assert found.figures["left"].saturated > 0.3


def test_a_board_without_the_projectors_light_is_refused_by_cause(pose: Capture) -> None:
    # The room lights the board, and every pattern shows the same.
    (white,) = [each.image for each in pose.shots[:1]]
    still = replace(pose, shots=tuple(replace(each, image=white) for each in pose.shots))
    with pytest.raises(PoseRefusedError, match=r"codes cannot be read.*projector lights 0%.*projector's picture"):
        read_captured(still, BOARD, "unlit")


def test_a_capture_from_another_rig_is_told_apart(pose: Capture, tmp_path: Path) -> None:
    smaller = shot(Standing(scale=0.25), line_shift=False)
    sizes = []
    for name, each in enumerate((pose, pose, smaller, replace(pose, projector=Size(640, 480)))):
        write_bundle(tmp_path / str(name), each)
        sizes.append(bundle_device_sizes(tmp_path / str(name)))
    first, again, *others = sizes
    assert set(first) == {"left", PROJECTOR}
    check_same_devices("pose 1", again, first)
    for other in others:
        with pytest.raises(CalibrationError, match="another rig"):
            check_same_devices("pose 2", other, first)

"""Hand-eye calibration against made-up cells: stated errors hold, and wrong input is named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slrig.calibration.hand_eye import (
    HandEyeKind,
    RobotPoses,
    TargetPoses,
    check_hand_eye,
    solve_hand_eye,
)
from slrig.errors import CalibrationError, SolveRefusedError
from slrig.model import FloatArray
from tests.core import parametrize_core
from tests.unit.calibration.robot_cells import NOISE, RobotCell, cell, error_of, pose

KINDS = tuple(HandEyeKind)
SEEDS = 40


@parametrize_core(
    ("kind", "sphere", "stated"),
    [
        (HandEyeKind.IN_HAND, False, None),
        (HandEyeKind.FIXED, False, None),
        (HandEyeKind.IN_HAND, False, NOISE),
        (HandEyeKind.FIXED, False, NOISE),
        (HandEyeKind.IN_HAND, True, None),
        (HandEyeKind.FIXED, True, None),
    ],
    core=(0, 1),
)
def test_stated_errors_hold_both_ways(kind: HandEyeKind, sphere: bool, stated: tuple[float, float] | None) -> None:
    ratios, squares = [], []
    for seed in range(SEEDS):
        made = cell(kind, seed, sphere=sphere)
        found = solve_hand_eye(made.robot, made.seen, kind, robot_sigma=stated)
        assert not found.left_out
        back, covariance = found.inverse
        ways = (found.rig, found.rig_covariance, made.rig), (back, covariance, np.asarray(np.linalg.inv(made.rig)))
        for pose_found, own, true in ways:
            error = error_of(pose_found, true)
            ratios.append(np.abs(error) / np.sqrt(np.diagonal(own)))
            squares.append(error @ np.linalg.solve(own, error))
        if stated is None:
            np.testing.assert_allclose(found.robot_sigma, NOISE, rtol=0.6)
    # 40 x 6 numbers, about half of them independent: 2.5 standard deviations of a share.
    assert 0.58 < np.mean(np.array(ratios) < 1) < 0.79
    assert 0.90 < np.mean(np.array(ratios) < 2) < 0.995
    assert 4.4 < np.mean(squares) < 7.6


def test_errors_that_all_poses_share_are_no_noise_of_theirs() -> None:
    made = cell(HandEyeKind.FIXED, 1)
    shared = np.tile(np.diag([0.0, 0.0, 0.0, 0.0, 0.0, 0.5]), (12, 12))
    seen = replace(made.seen, covariance=made.seen.covariance + shared @ shared.T / 12)
    found = solve_hand_eye(made.robot, seen, HandEyeKind.FIXED)
    alone = solve_hand_eye(made.robot, made.seen, HandEyeKind.FIXED)
    np.testing.assert_allclose(found.robot_sigma, alone.robot_sigma, rtol=0.05)
    # What the calibration of the rig got wrong along its axis moves the rig by as much.
    along = made.rig[:3, 2] @ (found.rig_covariance - alone.rig_covariance)[3:, 3:] @ made.rig[:3, 2]
    assert along == pytest.approx(0.25, rel=0.2)


def test_print_that_is_larger_than_stated_moves_nothing_beyond_the_stated_error() -> None:
    ratios = []
    for seed in range(3):
        made = cell(HandEyeKind.FIXED, seed)
        poses = made.seen.poses.copy()
        poses[:, :3, 3] *= 1.01
        longer = 0.007 * np.hstack([np.zeros((len(poses), 3)), poses[:, :3, 3]]).ravel()
        known = [made.seen.covariance, made.seen.covariance + np.outer(longer, longer)]
        found = [solve_hand_eye(made.robot, TargetPoses(made.seen.names, poses, each), made.kind) for each in known]
        off = [error_of(each.rig, made.rig) / np.sqrt(np.diagonal(each.rig_covariance)) for each in found]
        ratios.append(np.abs(off).max(axis=1))
        (told,) = found[0].remarks
        assert 0.8 < float(told.split("measures ")[1].split(" %")[0]) < 1.2
        assert not found[1].remarks
    plain, aware = np.max(ratios, axis=0)
    assert plain > 4
    assert aware < 3.5


def turned(made: RobotCell, change: Callable[[Rotation], Rotation]) -> RobotPoses:
    poses = made.robot.poses.copy()
    poses[:, :3, :3] = change(Rotation.from_matrix(poses[:, :3, :3])).as_matrix()
    return replace(made.robot, poses=poses)


def in_metres(made: RobotCell) -> RobotPoses:
    poses = made.robot.poses.copy()
    poses[:, :3, 3] /= 1000
    return replace(made.robot, poses=poses)


WRONG: dict[str, tuple[Callable[[RobotCell], RobotPoses], str]] = {
    "metres": (in_metres, "the robot's positions are in m, and not in mm"),
    "inverse": (
        lambda made: replace(made.robot, poses=np.asarray(np.linalg.inv(made.robot.poses))),
        "poses of the base in the flange",
    ),
    "w first": (
        lambda made: turned(made, lambda turn: Rotation.from_quat(np.roll(turn.as_quat(), 1, axis=1))),
        "the quaternions are in the order w, x, y, z",
    ),
    "order of angles": (
        lambda made: replace(turned(made, lambda turn: Rotation.from_euler("ZYX", turn.as_euler("xyz"))), euler="ZYX"),
        "the angles are in the order xyz, and not ZYX",
    ),
    "late": (
        lambda made: made.robot.select(np.roll(np.arange(12), 1)),
        "each picture belongs to the pose listed after",
    ),
    "early": (lambda made: made.robot.select(np.roll(np.arange(12), -1)), "belongs to the pose listed before"),
    "radians": (
        lambda made: turned(made, lambda turn: Rotation.from_rotvec(np.radians(turn.as_rotvec()))),
        "are their angles in radians",
    ),
    "mixed up": (lambda made: made.robot.select(np.arange(12)[::-1].copy()), "in no other order or unit"),
}


@parametrize_core(
    ("kind", "wrong"), [(kind, wrong) for kind in KINDS for wrong in WRONG], core=(0, 4, 6, len(WRONG) + 2)
)
def test_wrong_reading_of_poses_is_named(kind: HandEyeKind, wrong: str) -> None:
    change, words = WRONG[wrong]
    made = cell(kind, 3)
    with pytest.raises(SolveRefusedError, match=words):
        solve_hand_eye(change(made), made.seen, kind)


def test_other_kind_is_named() -> None:
    made = cell(HandEyeKind.FIXED, 3)
    with pytest.raises(SolveRefusedError, match="the rig is fixed and not in-hand"):
        solve_hand_eye(made.robot, made.seen, HandEyeKind.IN_HAND)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("turns_deg", "sphere", "words"),
    [
        ((0, 0, 0), False, "moved without turning .* undetermined along all axes"),
        ((0, 0, 60), False, "all turns of the robot are about one axis, {z} .* about another axis as well"),
        ((40, 0.2, 0.2), True, "all turns of the robot are about one axis, {x} "),
    ],
)
def test_degenerate_motion_is_named(
    kind: HandEyeKind, turns_deg: tuple[float, float, float], sphere: bool, words: str
) -> None:
    made = cell(kind, 3, turns_deg=turns_deg, sphere=sphere)
    with pytest.raises(SolveRefusedError, match=words.split(" {")[0]) as refusal:
        solve_hand_eye(made.robot, made.seen, kind)
    if "{" in words:
        # The axis that the target turned about, in the frame in which the rig's place is told.
        told = np.array([float(part) for part in str(refusal.value).split("(")[1].split(")")[0].split(",")])
        assert abs(told @ made.rig[:3, 2 if "{z}" in words else 0]) > 0.995


@pytest.mark.slow
def test_sphere_at_one_place_of_the_view_leaves_the_turn_open() -> None:
    made = cell(HandEyeKind.IN_HAND, 3, sphere=True, spread_mm=0.0)
    with pytest.raises(SolveRefusedError, match=r"turn about .* of the flange is undetermined .* lie farther apart"):
        solve_hand_eye(made.robot, made.seen, HandEyeKind.IN_HAND)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("stated", [None, NOISE])
def test_pose_read_before_the_robot_stood_still_is_left_out(
    kind: HandEyeKind, stated: tuple[float, float] | None
) -> None:
    made = cell(kind, 5)
    poses = made.robot.poses.copy()
    poses[7] = poses[7] @ pose([0.1, 0.15, 0.0], [1.5, -0.5, 0.8])
    found = solve_hand_eye(replace(made.robot, poses=poses), made.seen, kind, robot_sigma=stated)
    assert list(found.left_out) == ["08"]
    assert "still moved" in found.left_out["08"]
    assert np.linalg.norm(error_of(found.rig, made.rig)[3:]) < 0.5


def test_noise_stated_too_small_widens_what_is_stated() -> None:
    made = cell(HandEyeKind.FIXED, 3)
    found = solve_hand_eye(made.robot, made.seen, HandEyeKind.FIXED, robot_sigma=(0.02, 0.004))
    honest = solve_hand_eye(made.robot, made.seen, HandEyeKind.FIXED, robot_sigma=NOISE)
    assert "times what a robot of 0.02 mm and 0.004° leaves" in found.remarks[0]
    assert not found.left_out
    wider = np.sqrt(np.diagonal(found.covariance) / np.diagonal(honest.covariance))
    assert wider.min() > 0.6
    assert wider.max() < 1.6


@pytest.mark.parametrize("kind", KINDS)
def test_next_pose_makes_the_rig_as_sure_as_it_says(kind: HandEyeKind) -> None:
    made = cell(kind, 2, count=6)
    found = solve_hand_eye(made.robot, made.seen, kind, robot_sigma=NOISE)
    assert found.next_move is not None
    flange = found.next_move.flange
    shown = np.linalg.inv(made.rig) @ (np.linalg.inv(flange) if kind is HandEyeKind.IN_HAND else flange) @ made.target
    assert abs(shown[2, 3] - 400) < 80, "the target left the view"
    more = RobotPoses((*made.robot.names, "next"), np.concatenate([made.robot.poses, flange[None]]))
    one = np.diag(made.seen.covariance)[:6]
    seen = TargetPoses(
        more.names, np.concatenate([made.seen.poses, shown[None]]),
        np.diag(np.concatenate([np.diag(made.seen.covariance), one])),
    )  # fmt: skip
    after = solve_hand_eye(more, seen, kind, robot_sigma=NOISE)
    worst = [float(np.sqrt(np.linalg.eigvalsh(each.rig_covariance[3:, 3:])[-1])) for each in (found, after)]
    assert worst[1] < worst[0]
    assert worst[1] == pytest.approx(found.next_move.sigma_mm, rel=0.05)


@pytest.mark.parametrize("kind", KINDS)
def test_drift_is_told_beyond_the_stated_error_alone(kind: HandEyeKind) -> None:
    fresh = [cell(kind, 100 + seed, count=3) for seed in range(20)]
    chances = []
    for seed, each in enumerate(fresh):
        made = cell(kind, seed)
        found = solve_hand_eye(made.robot, made.seen, kind)
        chances.append(check_hand_eye(found, each.robot, each.seen).probability)
    assert min(chances) > 2e-3
    assert 0.35 < float(np.mean(chances)) < 0.65
    moved = np.linalg.inv(pose([0.15, 0.0, 0.0], [0.0, 1.0, 0.0]))

    def after_a_bump(each: RobotCell) -> TargetPoses:
        # The rig moved in its own parent's frame: what it sees moves the other way.
        return replace(each.seen, poses=np.linalg.inv(made.rig) @ moved @ made.rig @ each.seen.poses)

    drift = check_hand_eye(found, fresh[0].robot, after_a_bump(fresh[0]))
    assert not drift.holds
    assert abs(drift.shift_mm - 1.0) < 3 * drift.sigma_mm
    assert abs(drift.turn_deg - 0.15) < 3 * drift.sigma_deg


def test_board_is_not_held_against_a_sphere() -> None:
    made, other = cell(HandEyeKind.FIXED, 1), cell(HandEyeKind.FIXED, 1, sphere=True)
    found = solve_hand_eye(made.robot, made.seen, made.kind)
    with pytest.raises(CalibrationError, match="is by a board, and these poses are of a sphere"):
        check_hand_eye(found, other.robot, other.seen)


@pytest.mark.parametrize("count", [3, 4])
def test_few_poses_are_refused_or_solved(count: int) -> None:
    made = cell(HandEyeKind.FIXED, 5, count=count)
    if count == 3:
        with pytest.raises(SolveRefusedError, match="expected 4 poses or more"):
            solve_hand_eye(made.robot, made.seen, HandEyeKind.FIXED)
        return
    found = solve_hand_eye(made.robot, made.seen, HandEyeKind.FIXED)
    assert np.all(np.abs(error_of(found.rig, made.rig)) < 4 * np.sqrt(np.diagonal(found.rig_covariance)))


@parametrize_core("sphere", [False, True])
def test_poses_of_nothing_end_in_a_refusal(sphere: bool) -> None:
    random = np.random.default_rng(0)
    for seed, reach_mm in enumerate((1.0, 1e3, 9e4)):
        made = cell(HandEyeKind.FIXED, seed, count=6, sphere=sphere)
        poses = [pose(random.uniform(-180, 180, 3), reach_mm * random.uniform(-1, 1, 3)) for _ in range(6)]
        with pytest.raises(SolveRefusedError):
            solve_hand_eye(RobotPoses(made.robot.names, np.array(poses)), made.seen, made.kind)
    with pytest.raises(CalibrationError, match="within 100 m"):
        RobotPoses(("1",), np.array([pose([0, 0, 9], [5e5, 0, 0])]))


@pytest.mark.parametrize("noise", [(0.0, 0.02), (0.1, -1.0), (0.1, float("nan"))])
def test_noise_that_is_none_is_refused(noise: tuple[float, float]) -> None:
    made = cell(HandEyeKind.FIXED, 5)
    with pytest.raises(CalibrationError, match="expected mm and degrees above 0"):
        solve_hand_eye(made.robot, made.seen, made.kind, robot_sigma=noise)


def test_pose_that_is_no_rigid_motion_is_refused() -> None:
    scaled: FloatArray = np.diag([1.02, 1.0, 1.0, 1.0])
    with pytest.raises(CalibrationError, match="robot pose '7': expected a rotation"):
        RobotPoses(("7",), scaled[None])

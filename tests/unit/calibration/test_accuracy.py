"""The error that a calibration states, against the errors of many calibrations drawn from its covariance."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slrig.calibration.accuracy import compare_calibrations, compare_halves, expected_error, sample_volume
from slrig.calibration.board import COLUMN, ROW, Board, BoardKind, Correspondences, Observations, PoseObservation
from slrig.calibration.judgement import Grade, judge_calibration
from slrig.calibration.solution import (
    BoardPose,
    HalfSolution,
    Solution,
    covariance_modes,
    point_sensitivity,
    project_out_rigid_motion,
    remove_rigid_motion,
)
from slrig.errors import CalibrationError
from slrig.model import Calibration, FloatArray, Pinhole, Size, SolveRecord
from slrig.reconstruction.surface_fit import stencils
from tests.unit.calibration.perturbed import (
    aligned,
    changed,
    covariance_by_known_points,
    draws,
    left_camera,
    light_source,
    met_with_projector,
    pixels,
    ray_directions,
    right_camera,
)
from tests.unit.calibration.test_judgement import EXPECTED

FITTED = float(np.sqrt((stencils()[0][0].astype(np.float64) ** 2).sum()))
"""What the fit of a scan makes of the noise of one pixel."""

BOARD = Board(BoardKind.CHESSBOARD, 10, 8, 10.0)


def poses(count: int = 8, seed: int = 3) -> dict[str, BoardPose]:
    random = np.random.default_rng(seed)
    middle = BOARD.points_mm.mean(axis=0)
    found = {}
    for index in range(count):
        turn = Rotation.from_euler("xyz", random.uniform(-30, 30, 3), degrees=True).as_matrix()
        place = np.array([0, 0, 600]) + random.uniform([-25, -20, -50], [25, 20, 50])
        found[f"pose {index}"] = BoardPose(turn, place - turn @ middle)
    return found


def light(sigma_px: float) -> Correspondences:
    axis = np.repeat([COLUMN, ROW], 50).astype(np.uint8)
    sigma = np.where(axis == COLUMN, sigma_px, 7.0)
    # Ink is most of the board.
    sigma[10:50] *= 8
    return Correspondences(np.zeros((100, 2)), axis, np.zeros(100), sigma)


def solved(
    cameras: dict[str, Pinhole], projector: Pinhole | None, *, sigma_px: float = 0.05, seed: int = 1
) -> tuple[Solution, Observations]:
    devices = [*cameras.values(), *([projector] if projector else [])]
    solution = Solution(
        calibration=Calibration(cameras, projector),
        covariance=covariance_by_known_points(devices, 1, sigma_px, seed),
        distortion={},
        poses=poses(),
        outliers={},
        residuals={},
    )
    seen = tuple(PoseObservation(name, {}, {"left": light(0.02)} if projector else {}) for name in solution.poses)
    sizes = {name: camera.size for name, camera in cameras.items()}
    return solution, Observations(BOARD, sizes, None if projector is None else projector.size, seen)


def along_rays(points: FloatArray, of: FloatArray, camera: Pinhole) -> FloatArray:
    ray = of - camera.centre_mm
    return np.asarray(np.einsum("ni,ni->n", points - of, ray / np.linalg.norm(ray, axis=1, keepdims=True)))


@pytest.mark.slow
def test_the_error_is_that_of_calibrations_drawn_from_the_covariance() -> None:
    camera, projector = left_camera(), light_source()
    solution, observations = solved({"left": camera}, projector)
    stated = expected_error(solution, observations)
    chosen = np.linspace(0, len(stated.grid_mm) - 1, 250).astype(int)
    places = stated.grid_mm[chosen]
    at, lit = pixels(camera, places), pixels(projector, places)[:, 0]
    pairs = np.random.default_rng(5).integers(0, len(places), (4000, 2))
    length = np.linalg.norm(places[pairs[:, 1]] - places[pairs[:, 0]], axis=1)
    half = np.linalg.norm(stated.volume_mm[1] - stated.volume_mm[0]) / 2
    pairs, length = pairs[np.abs(length / half - 1) < 0.05], length[np.abs(length / half - 1) < 0.05]
    squares = np.zeros(len(places))
    shares = 0.0
    count = 300
    for change in draws(solution.covariance, count, 2):
        wrong = changed(camera, change[:15]), changed(projector, change[15:])
        found = met_with_projector(*wrong, at, lit, places, 0)
        squares += along_rays(aligned(found, places), places, camera) ** 2 / count
        found_length = np.linalg.norm(found[pairs[:, 1]] - found[pairs[:, 0]], axis=1)
        shares += float(((found_length / length - 1) ** 2).mean()) / count
    assert np.sqrt(squares.mean()) == pytest.approx(np.sqrt((stated.grid_point_mm[chosen] ** 2).mean()), rel=0.05)
    assert np.sqrt(squares.mean()) == pytest.approx(stated.point_mm, rel=0.06)
    assert np.median(np.abs(np.sqrt(squares) / stated.grid_point_mm[chosen] - 1)) < 0.05
    assert np.sqrt(shares) == pytest.approx(stated.length_share, rel=0.06)


def test_noise_is_that_of_the_light_of_one_point() -> None:
    camera, projector = left_camera(), light_source()
    solution, observations = solved({"left": camera}, projector)
    stated = expected_error(solution, observations)
    places = stated.grid_mm
    at, lit = pixels(camera, places), pixels(projector, places)[:, 0]
    noise = np.random.default_rng(0).normal(0, 0.02 * FITTED, len(places))
    found = met_with_projector(camera, projector, at, lit + noise, places, 0)
    assert np.sqrt((along_rays(found, places, camera) ** 2).mean()) == pytest.approx(stated.noise_mm, rel=0.05)
    assert stated.total_mm == pytest.approx(np.hypot(stated.point_mm, stated.noise_mm))
    given = expected_error(solution, observations, noise_px=0.06 * FITTED)
    assert given.noise_mm == pytest.approx(3 * stated.noise_mm, rel=1e-3)


@pytest.mark.slow
def test_two_cameras_without_a_projector() -> None:
    left, right = left_camera(), right_camera()
    solution, observations = solved({"left": left, "right": right}, None)
    stated = expected_error(solution, observations, noise_px=0.03)
    assert np.isnan(expected_error(solution, observations).total_mm)
    chosen = np.linspace(0, len(stated.grid_mm) - 1, 200).astype(int)
    places = stated.grid_mm[chosen]
    at, other = pixels(left, places), pixels(right, places)
    squares = np.zeros(len(places))
    count = 200
    for change in draws(solution.covariance, count, 4):
        # The stripe runs across the epipolar line that the true calibration predicts, through the pixel seen.
        wrong, wrong_right = changed(left, change[:15]), changed(right, change[15:])
        directions = ray_directions(wrong, at)
        along = pixels(right, places * 1.0001) - other
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        depth = places @ wrong.rotation[2] + wrong.translation_mm[2]
        for _ in range(6):
            steps = [
                np.einsum("ni,ni->n", pixels(wrong_right, wrong.centre_mm + d[:, None] * directions) - other, along)
                for d in (depth, depth + 1e-3)
            ]
            depth = depth - steps[0] / (steps[1] - steps[0]) * 1e-3
        found = wrong.centre_mm + depth[:, None] * directions
        squares += along_rays(aligned(found, places), places, left) ** 2 / count
    assert np.sqrt(squares.mean()) == pytest.approx(stated.point_mm, rel=0.06)


def across_rays(points: FloatArray, of: FloatArray, camera: Pinhole) -> FloatArray:
    off, ray = points - of, of - camera.centre_mm
    return np.asarray(np.linalg.norm(np.cross(off, ray), axis=1) / np.linalg.norm(ray, axis=1))


def held_at_its_distance(camera: Pinhole, pixels_px: FloatArray, places: FloatArray) -> FloatArray:
    """(n, 3): points as far from a camera as the places are, on its rays through these pixels."""
    directions = ray_directions(camera, pixels_px)
    far = np.linalg.norm(places - camera.centre_mm, axis=1) / np.linalg.norm(directions, axis=1)
    return np.asarray(camera.centre_mm + far[:, None] * directions)


@pytest.mark.slow
def test_the_error_of_one_camera_alone_is_across_its_rays() -> None:
    camera = left_camera()
    solution, observations = solved({"left": camera}, None)
    stated = expected_error(solution, observations)
    assert stated.across
    places = stated.grid_mm
    squares = np.zeros(len(places))
    count = 200
    for change in draws(solution.covariance, count, 6):
        found = held_at_its_distance(changed(camera, change), pixels(camera, places), places)
        squares += across_rays(aligned(found, places), places, camera) ** 2 / count
    assert np.sqrt(squares.mean()) == pytest.approx(stated.point_mm, rel=0.06)
    assert np.median(np.abs(np.sqrt(squares) / stated.grid_point_mm - 1)) < 0.06


def test_what_one_camera_alone_cannot_measure_is_nan() -> None:
    solution, observations = solved({"left": left_camera()}, None)
    for noise_px in (None, 0.03):
        stated = expected_error(solution, observations, noise_px=noise_px)
        assert stated.point_mm > 0
        assert np.isnan([stated.noise_mm, stated.total_mm, stated.length_share]).all()
    assert not expected_error(*solved({"left": left_camera()}, light_source())).across


def test_several_cameras_are_better_than_each_of_them() -> None:
    left, right, projector = left_camera(), right_camera(), light_source()
    alone = expected_error(*solved({"left": left}, projector), noise_px=0.03)
    both = expected_error(*solved({"left": left, "right": right}, projector), noise_px=0.03)
    assert both.noise_mm < alone.noise_mm


def test_the_weighted_mean_of_two_cameras_is_what_a_scan_takes() -> None:
    """One camera is wrong: the mean moves by its share only, and a camera that does not see a point has none."""
    left, right, projector = left_camera(), right_camera(), light_source()
    away = replace(right, translation_mm=right.translation_mm + np.array([0.0, 0, -5000.0]))
    places = np.array([[0.0, 0, 600], [10.0, -15, 620]])
    alone = point_sensitivity([left], projector, places)
    both = point_sensitivity([left, away], projector, places)
    assert both.visible.all()
    assert both.by_parameter[:, :, :15] == pytest.approx(alone.by_parameter[:, :, :15])
    assert both.by_parameter[:, :, 30:] == pytest.approx(alone.by_parameter[:, :, 15:])
    assert not both.by_parameter[:, :, 15:30].any()


def test_a_rigid_motion_is_no_error() -> None:
    random = np.random.default_rng(0)
    places = random.normal(size=(50, 3)) * 40 + [0, 0, 600]
    motion = np.cross(np.array([1e-3, -2e-3, 5e-4]), places) + np.array([0.1, 0.2, 0.3])
    strain = (places - places.mean(axis=0)) * 1e-3
    fields = np.stack([motion, motion + strain], axis=2)
    left = project_out_rigid_motion(places, fields)
    assert np.abs(left[:, :, 0]).max() < 1e-12
    assert left[:, :, 1] == pytest.approx(strain, abs=1e-12)


def test_modes_give_the_covariance_again() -> None:
    covariance = covariance_by_known_points([left_camera(), light_source()], 1, 0.05, 0)
    modes = covariance_modes(covariance)
    scale = np.sqrt(np.maximum(np.diagonal(covariance), 1e-30))
    assert modes @ modes.T / np.outer(scale, scale) == pytest.approx(covariance / np.outer(scale, scale), abs=1e-9)
    assert covariance_modes(np.zeros((30, 30))).shape == (30, 0)


def test_an_exact_calibration_has_no_error() -> None:
    solution, observations = solved({"left": left_camera()}, light_source())
    stated = expected_error(replace(solution, covariance=np.zeros((30, 30))), observations, noise_px=0.0)
    assert stated.point_mm == stated.total_mm == stated.length_share == 0


def test_the_volume_is_where_the_board_was_and_the_devices_see_it() -> None:
    solution, observations = solved({"left": left_camera()}, light_source())
    box, places = sample_volume(solution, observations)
    corners = np.concatenate(
        [BOARD.points_mm @ pose.rotation.T + pose.translation_mm for pose in solution.poses.values()]
    )
    assert box == pytest.approx(np.stack([corners.min(axis=0), corners.max(axis=0)]))
    assert len(places) > 400
    for device in (left_camera(), light_source()):
        seen = pixels(device, places)
        assert ((seen > -0.5) & (seen < [device.size.width_px - 0.5, device.size.height_px - 0.5])).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lamp", "words"),
    [
        (light_source(), r"sees together with the projector, found 0 of .*hold the board where"),
        (None, r"that the first camera sees, found 0 of .*hold the board where all of it"),
    ],
    ids=["projector", "camera alone"],
)
def test_a_board_held_where_the_devices_do_not_see_it_is_refused(lamp: Pinhole | None, words: str) -> None:
    solution, observations = solved({"left": left_camera()}, lamp)
    up = np.array([0.0, 400, 0])
    aside = {name: BoardPose(pose.rotation, up + pose.translation_mm) for name, pose in solution.poses.items()}
    with pytest.raises(CalibrationError, match=words):
        expected_error(replace(solution, poses=aside), observations)


def test_a_board_that_never_left_one_plane_is_refused_with_words() -> None:
    solution, observations = solved({"left": left_camera()}, light_source())
    flat = {"only": BoardPose(np.eye(3), np.array([-45.0, -35, 600]))}
    with pytest.raises(CalibrationError, match=r"all corners of 1 poses in one plane.*tilt the board"):
        expected_error(replace(solution, poses=flat), observations)


# ---- Two halves of a solve against each other: in millimetres, without their rigid motion, against what they state


@cache
def whole() -> tuple[Solution, FloatArray]:
    """A solution of a camera and a projector, and some forty places in its volume."""
    solution, observations = solved({"left": left_camera()}, light_source())
    _, places = sample_volume(solution, observations)
    return solution, places[:: len(places) // 40]


def halved(odd: FloatArray, even: FloatArray, covariance: FloatArray) -> tuple[Solution, FloatArray]:
    """The same with halves that are off by so much."""
    solution, places = whole()
    names = tuple(solution.poses)
    halves = (HalfSolution(names[::2], odd, covariance), HalfSolution(names[1::2], even, covariance))
    return replace(solution, halves=halves), places


def covariance() -> FloatArray:
    return covariance_by_known_points([left_camera(), light_source()], 1, 0.05, 1)


@pytest.mark.slow
def test_halves_that_are_off_as_they_state_differ_by_what_is_stated() -> None:
    spread = covariance()
    off = draws(spread, 500, 5)
    found = []
    for odd, even in zip(off[::2], off[1::2], strict=True):
        made = compare_halves(*halved(odd, even, spread))
        assert made is not None
        found.append(made)
    ratio = np.array([each.ratio for each in found])
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.0, abs=0.09)
    assert (ratio <= 1).mean() == pytest.approx(0.62, abs=0.08)
    assert (ratio <= 2).mean() > 0.95
    # The chance is one: as often below a share as that share says, five of a hundred below 5 %.
    chance = np.array([each.chance for each in found])
    assert (chance < 0.05).mean() == pytest.approx(0.05, abs=0.045)
    assert (chance < 0.5).mean() == pytest.approx(0.5, abs=0.08)
    assert np.mean([each.fits for each in found]) > 0.98


def test_the_difference_is_how_far_apart_both_find_a_point() -> None:
    """By an oracle that projects with OpenCV and finds depth by the secant method."""
    camera, projector = left_camera(), light_source()
    odd, even = 0.1 * draws(covariance(), 2, 9)
    solution, places = halved(odd, even, covariance())
    at, lit = pixels(camera, places), pixels(projector, places)[:, 0]
    there = [
        met_with_projector(changed(camera, each[:15]), changed(projector, each[15:]), at, lit, places, 0)
        for each in (odd, even)
    ]
    apart = along_rays(aligned(there[0] - there[1] + places, places), places, camera)
    found = compare_halves(solution, places)
    assert found is not None
    assert found.difference_mm == pytest.approx(float(np.sqrt((apart**2).mean())), rel=0.005)
    assert found.poses == (4, 4)


def test_halves_that_are_moved_as_a_whole_do_not_differ() -> None:
    """The world is turned by 2e-5 rad about z and shifted: each device's pose changes, and no measurement does."""
    turn, shift = np.array([0.0, 0.0, 2e-5]), np.array([0.01, -0.02, 0.03])

    def change(device: Pinhole) -> FloatArray:
        rotation = device.rotation @ cv2.Rodrigues(turn)[0].T
        own = cv2.Rodrigues(rotation @ device.rotation.T)[0][:, 0]
        return np.concatenate([np.zeros(9), own, -(rotation @ shift)])

    moved = np.concatenate([change(left_camera()), change(light_source())])
    found = compare_halves(*halved(moved, np.zeros(30), covariance()))
    assert found is not None
    assert found.difference_mm < 1e-6
    assert found.motion.turn_deg == pytest.approx(np.degrees(2e-5), rel=1e-3)
    assert found.motion.shift_mm == pytest.approx(np.linalg.norm(shift), rel=0.2)
    assert found.fits


def test_a_difference_beyond_chance_is_a_reason_against_good() -> None:
    spread = covariance()
    odd, even = draws(spread, 2, 3)
    plain, large = (compare_halves(*halved(times * odd, times * even, spread)) for times in (1, 6))
    assert plain is not None
    assert large is not None
    assert large.stated_mm == pytest.approx(plain.stated_mm)
    assert large.difference_mm == pytest.approx(6 * plain.difference_mm)
    assert plain.fits
    assert not large.fits
    solution = halved(odd, even, spread)[0]
    assert large.words in judge_calibration(solution, EXPECTED, None, large, board=BOARD).reasons
    assert plain.words not in judge_calibration(solution, EXPECTED, None, plain, board=BOARD).reasons
    judged = {each.figure: each for each in judge_calibration(solution, EXPECTED, None, large, board=BOARD).figures}
    assert judged["odd_even"].grade is Grade.USABLE
    assert judged["odd_even"].value == large.ratio
    assert f"expect an error of {large.difference_mm / 2:.2g} mm at a point" in large.words
    assert "more than chance" in large.words


def test_without_halves_nothing_is_said() -> None:
    solution, places = halved(np.zeros(30), np.zeros(30), covariance())
    assert compare_halves(replace(solution, halves=()), places) is None
    assert "odd_even" not in {each.figure for each in judge_calibration(solution, EXPECTED, board=BOARD).figures}


# ---- Two calibrations compared: a change that was made is found again, in its size and in its σ


SIGMA = np.array([0.5, 0.5, 0.8, 0.8, *[1e-4] * 5, *[1e-4] * 3, *[0.02] * 3])


def rig(*, solved: bool = True) -> Calibration:
    """Two cameras and a projector, converging on a volume about 600 mm away; the first camera's frame is the world."""
    covariance = np.diag(np.concatenate([SIGMA, SIGMA, SIGMA]) ** 2)
    covariance[9:15] = covariance[:, 9:15] = 0.0
    volume = np.array([[-80.0, -60.0, 550.0], [80.0, 60.0, 650.0]])
    found = SolveRecord("a", "2026-11-22T10:00:00+00:00", covariance, volume, 0.01)
    cameras = {"left": left_camera(), "right": right_camera()}
    return Calibration(cameras, light_source(), found if solved else None)


def with_right(calibration: Calibration, **changes: Any) -> Calibration:
    cameras = {**calibration.cameras, "right": replace(calibration.cameras["right"], **changes)}
    return replace(calibration, cameras=cameras)


def test_calibration_is_the_same_as_itself() -> None:
    found = compare_calibrations(rig(), rig())
    assert found.missing == ()
    assert found.moved_rms_mm == found.moved_max_mm == found.turn_deg == found.shift_mm == 0
    assert found.words[0].startswith(
        "Points in the working volume move by 0 mm rms and at most 0 mm, in addition to a turn"
    )
    assert set(found.devices) == {"left", "right", "projector"}
    for each in found.devices.values():
        assert each.focal_percent.value == each.principal_px.value == 0
        assert "no more than chance" in each.focal_percent.words
    assert found.devices["left"].rotation_deg is None


def test_a_longer_focal_length_is_reported_in_percent_and_sigmas() -> None:
    matrix = rig().cameras["right"].matrix.copy()
    matrix[0, 0] *= 1.002
    matrix[1, 1] *= 1.002
    right = compare_calibrations(rig(), with_right(rig(), matrix=matrix)).devices["right"]
    assert right.focal_percent.value == pytest.approx(0.2)
    # The mean of fx and fy, each known to 0.5 px in both solves.
    assert right.focal_percent.sigma == pytest.approx(100 / 2202.2 * 0.5, rel=1e-3)
    assert right.focal_percent.sigmas == pytest.approx(0.002 * 2202.2 / 0.5, rel=1e-3)
    assert "camera 'right': the focal length differs by +0.2 %, 8.8 σ: a real change." in right.focal_percent.words


def test_turn_and_baseline_are_reported_with_their_deviations() -> None:
    before = rig().cameras["right"]
    turn = Rotation.from_rotvec([0.0, np.radians(0.05), 0.0]).as_matrix()
    found = compare_calibrations(
        rig(), with_right(rig(), rotation=turn @ before.rotation, translation_mm=turn @ before.translation_mm)
    )
    right = found.devices["right"]
    assert right.rotation_deg is not None
    assert right.baseline_mm is not None
    assert right.rotation_deg.value == pytest.approx(0.05)
    assert right.rotation_deg.sigma == pytest.approx(np.degrees(1e-4) * np.sqrt(2), rel=1e-6)
    assert right.baseline_mm.value == pytest.approx(0.0, abs=1e-9)
    moved = compare_calibrations(rig(), with_right(rig(), translation_mm=before.translation_mm * 1.001)).devices[
        "right"
    ]
    assert moved.baseline_mm is not None
    assert moved.baseline_mm.value == pytest.approx(1e-3 * np.linalg.norm([210.0, 8.0, 5.0]))
    assert moved.baseline_mm.sigma == pytest.approx(0.02 * np.sqrt(2), rel=1e-6)


def test_points_move_by_what_a_longer_baseline_makes_of_them() -> None:
    """A baseline of every device longer by a share makes everything larger by it, and points move in proportion."""
    share = 1.001
    first = rig()
    assert first.projector is not None
    cameras = {name: replace(each, translation_mm=each.translation_mm * share) for name, each in first.cameras.items()}
    second = Calibration(
        cameras, replace(first.projector, translation_mm=first.projector.translation_mm * share), first.solved
    )
    found = compare_calibrations(first, second)
    # The middle of the volume moves away, by 0.6 mm, and the rest about it: the farthest point is a corner.
    assert found.shift_mm == pytest.approx((share - 1) * 600, rel=1e-4)
    assert found.turn_deg < 1e-6
    assert found.moved_max_mm == pytest.approx((share - 1) * np.linalg.norm([80, 60, 50]), rel=1e-4)
    assert found.moved_rms_mm < found.moved_max_mm
    assert f"at most {found.moved_max_mm:.3g} mm, in addition to a turn of" in found.words[0]
    assert "and a shift of 0.6 mm of all of them" in found.words[0]


def test_a_motion_of_all_points_is_no_change_of_shape_however_large() -> None:
    random = np.random.default_rng(4)
    places = random.uniform([-80, -60, 550], [80, 60, 650], (200, 3))
    turn = Rotation.from_rotvec([0.2, -0.7, 0.4])
    strain = np.array([0.01, 0.0, 0.0]) * ((places - places.mean(axis=0)) / 80) ** 2
    moved = places.mean(axis=0) + turn.apply(places - places.mean(axis=0)) + [30.0, -20.0, 7.0]
    left, motion = remove_rigid_motion(places, moved)
    assert np.abs(left).max() < 1e-10
    assert motion.turn_deg == pytest.approx(np.degrees(turn.magnitude()))
    assert motion.shift_mm == pytest.approx(np.linalg.norm([30.0, -20.0, 7.0]))
    # What is left of a small strain is what the least squares of a small motion leaves of it.
    small, _ = remove_rigid_motion(places, places + strain)
    assert small == pytest.approx(project_out_rigid_motion(places, strain[:, :, None])[:, :, 0], abs=1e-6)


def test_world_frame_makes_no_difference() -> None:
    """An imported calibration may have its world anywhere."""
    first = rig(solved=False)
    assert first.projector is not None
    turn = Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix()
    shift = np.array([5.0, -7.0, 300.0])

    def moved(each: Pinhole) -> Pinhole:
        rotation = each.rotation @ turn
        return replace(each, rotation=rotation, translation_mm=each.translation_mm + rotation @ shift)

    second = Calibration({name: moved(each) for name, each in first.cameras.items()}, moved(first.projector))
    found = compare_calibrations(rig(), second)
    assert found.moved_max_mm < 1e-6
    right = found.devices["right"]
    assert right.rotation_deg is not None
    assert right.rotation_deg.value < 1e-5
    assert np.isnan(right.rotation_deg.sigma)
    assert "its standard deviation is not known" in right.rotation_deg.words
    nowhere = compare_calibrations(first, second)
    assert np.isnan(nowhere.moved_rms_mm)
    assert "neither calibration states a working volume" in nowhere.words[0]


def test_device_that_only_one_has_is_named() -> None:
    first = rig()
    second = Calibration({"left": first.cameras["left"]}, first.projector)
    found = compare_calibrations(first, second)
    assert found.missing == ("right",)
    assert set(found.devices) == {"left", "projector"}
    assert any("Only one calibration has right" in words for words in found.words)


def test_calibrations_of_two_rigs_are_refused() -> None:
    first = rig()
    other = Calibration({"top": first.cameras["left"]}, first.projector)
    with pytest.raises(CalibrationError, match=r"one has left, right, the other top"):
        compare_calibrations(first, other)
    smaller = with_right(first)
    smaller = replace(
        smaller, cameras={**smaller.cameras, "right": replace(smaller.cameras["right"], size=Size(640, 512))}
    )
    with pytest.raises(CalibrationError, match="right has 1200 x 1000 pixels in one and 640 x 512 in the other"):
        compare_calibrations(first, smaller)

"""The error that a calibration states, against the errors of many calibrations drawn from its covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slrig.calibration.board import Board, BoardKind, BoardShape
from slrig.calibration.displacement import modes_of, moved_points, rigid_free
from slrig.calibration.judging.expected_error import expected_error, volume_of
from slrig.calibration.observations import COLUMN, ROW, Correspondences, Observations, PoseObservation
from slrig.calibration.solution import BoardPose, Solution
from slrig.calibration.solving.solve import solve
from slrig.errors import CalibrationError
from slrig.model import Calibration, FloatArray, Pinhole
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
from tests.unit.calibration.synthetic import Recipe, made

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


@pytest.mark.slow
def test_solves_of_one_camera_are_as_far_off_as_they_state() -> None:
    """The truth is a made-up camera that the solve does not know, and its noise another one each time."""
    ratios = []
    for seed in range(8):
        observations, truth = made(Recipe(poses=12, projector=False, seed=seed))
        solution = solve(observations, board_shape=BoardShape.FLAT)
        stated = expected_error(solution, observations)
        true, places = truth.cameras["left"], stated.grid_mm
        found = held_at_its_distance(solution.calibration.cameras["left"], pixels(true, places), places)
        off = across_rays(aligned(found, places), places, true)
        ratios.append(np.sqrt((off**2).mean()) / stated.point_mm)
    assert 0.7 <= np.sqrt(np.mean(np.square(ratios))) <= 1.4, ratios
    assert max(ratios) < 3, ratios


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
    alone = moved_points([left], projector, places)
    both = moved_points([left, away], projector, places)
    assert both.seen.all()
    assert both.by_parameter[:, :, :15] == pytest.approx(alone.by_parameter[:, :, :15])
    assert both.by_parameter[:, :, 30:] == pytest.approx(alone.by_parameter[:, :, 15:])
    assert not both.by_parameter[:, :, 15:30].any()


def test_a_rigid_motion_is_no_error() -> None:
    random = np.random.default_rng(0)
    places = random.normal(size=(50, 3)) * 40 + [0, 0, 600]
    motion = np.cross(np.array([1e-3, -2e-3, 5e-4]), places) + np.array([0.1, 0.2, 0.3])
    strain = (places - places.mean(axis=0)) * 1e-3
    fields = np.stack([motion, motion + strain], axis=2)
    left = rigid_free(places, fields)
    assert np.abs(left[:, :, 0]).max() < 1e-12
    assert left[:, :, 1] == pytest.approx(strain, abs=1e-12)


def test_modes_give_the_covariance_again() -> None:
    covariance = covariance_by_known_points([left_camera(), light_source()], 1, 0.05, 0)
    modes = modes_of(covariance)
    scale = np.sqrt(np.maximum(np.diagonal(covariance), 1e-30))
    assert modes @ modes.T / np.outer(scale, scale) == pytest.approx(covariance / np.outer(scale, scale), abs=1e-9)
    assert modes_of(np.zeros((30, 30))).shape == (30, 0)


def test_an_exact_calibration_has_no_error() -> None:
    solution, observations = solved({"left": left_camera()}, light_source())
    stated = expected_error(replace(solution, covariance=np.zeros((30, 30))), observations, noise_px=0.0)
    assert stated.point_mm == stated.total_mm == stated.length_share == 0


def test_the_volume_is_where_the_board_was_and_the_devices_see_it() -> None:
    solution, observations = solved({"left": left_camera()}, light_source())
    box, places = volume_of(solution, observations)
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

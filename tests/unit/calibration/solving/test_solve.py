"""The whole solve: what comes out against the truth, what is refused, and prints of another size than they say."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from slrig.calibration.accuracy import expected_error
from slrig.calibration.board import BoardShape, Observations
from slrig.calibration.judgement import grade_board_size
from slrig.calibration.solution import CELLS, MIN_HALVED_POSES, PROJECTOR, DeviceResiduals, ExpectedError, Solution
from slrig.calibration.solving.adjustment import LENS_SIGMA, AdjustmentProblem, Fit, fit_geometry
from slrig.calibration.solving.covariance import inflate_by_held_out, make_folds, solve_halves
from slrig.calibration.solving.projection import device_difference
from slrig.calibration.solving.solve import solve
from slrig.errors import SolveRefusedError
from slrig.model import Calibration, FloatArray
from tests.unit.calibration.perturbed import aligned, met_with_projector, pixels
from tests.unit.calibration.solving.against_truth import in_deviations
from tests.unit.calibration.solving.test_adjustment import true_geometry
from tests.unit.calibration.synthetic import CHESSBOARD, Recipe, made

SMALL = Recipe(poses=8, side=12)


STEPS: dict[Recipe, list[tuple[str, float, str]]] = {}
"""What each solve said of its progress."""


@cache
def solved(recipe: Recipe) -> tuple[Solution, Calibration]:
    observations, truth = made(recipe)
    steps = STEPS[recipe] = []
    return solve(observations, progress=lambda *words: steps.append(words)), truth


@pytest.mark.parametrize(
    "recipe",
    [
        SMALL,
        pytest.param(replace(SMALL, lens_shift=False, seed=1), marks=pytest.mark.slow),
        pytest.param(replace(SMALL, cameras=2, seed=2), marks=pytest.mark.slow),
        pytest.param(replace(SMALL, cameras=2, projector=False, seed=3), marks=pytest.mark.slow),
        pytest.param(replace(SMALL, projector=False, seed=4), marks=pytest.mark.slow),
    ],
    ids=["shifted lens", "straight lens", "two cameras", "cameras alone", "one camera alone"],
)
def test_every_number_is_within_its_own_deviation(recipe: Recipe) -> None:
    solution, truth = solved(recipe)
    found = in_deviations(solution, truth)
    assert len(found) == 4 * (len(truth.cameras) + recipe.projector) + 4 * (recipe.cameras + recipe.projector - 1)
    assert max(np.abs(list(found.values()))) < 3.5, found
    for name, left in solution.residuals.items():
        assert left.rms_px == pytest.approx(0.0583 if name == PROJECTOR else 0.0707, rel=0.1)
        assert left.held_out_rms_px <= 1.3 * left.rms_px
    assert solution.outliers == {}
    assert set(solution.poses) == {f"pose {number}" for number in range(recipe.poses)}


def test_a_principal_point_outside_the_image_needs_no_help() -> None:
    solution, truth = solved(SMALL)
    assert truth.projector is not None
    assert solution.calibration.projector is not None
    row = solution.calibration.projector.matrix[1, 2]
    assert truth.projector.matrix[1, 2] > truth.projector.size.height_px
    assert row == pytest.approx(truth.projector.matrix[1, 2], abs=3 * np.sqrt(solution.covariance[18, 18]))
    assert np.sqrt(solution.covariance[18, 18]) < 6.0


def test_figures_of_a_device_agree_with_one_another() -> None:
    solution, _ = solved(SMALL)
    for name, left in solution.residuals.items():
        squares = left.map_count * np.nan_to_num(left.map_rms_px) ** 2
        assert left.map_count.shape == (CELLS, CELLS)
        assert left.map_count.sum() == left.count
        assert np.sqrt(squares.sum() / left.count) == pytest.approx(left.rms_px)
        assert set(left.pose_rms_px) == set(solution.poses)
        assert np.isnan(left.map_rms_px[left.map_count == 0]).all()
        assert 0 < left.outlying < 0.02 * left.count or name != PROJECTOR
        assert np.nanmax(np.abs(left.map_mean_px)) < 0.1


def test_the_world_is_the_first_camera() -> None:
    solution, _ = solved(SMALL)
    first = solution.calibration.cameras["left"]
    np.testing.assert_array_equal(first.rotation, np.eye(3))
    np.testing.assert_array_equal(first.translation_mm, 0)
    assert not solution.covariance[9:15].any()
    assert np.linalg.eigvalsh(solution.covariance).min() > -1e-9


def test_progress_is_reported_and_only_rises() -> None:
    solved(SMALL)
    shares = [share for _, share, _ in STEPS[SMALL]]
    assert shares == sorted(shares)
    assert shares[0] == 0
    assert shares[-1] == 1
    assert all(step and words for step, _, words in STEPS[SMALL])


@pytest.mark.slow
def test_the_same_poses_give_the_same_numbers() -> None:
    first, again = (solve(made(replace(SMALL, poses=5))[0]) for _ in range(2))
    np.testing.assert_allclose(first.covariance, again.covariance, rtol=1e-3, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("number", [3, 6])
def test_a_pose_in_which_the_board_moved_is_left_out_by_name(number: int) -> None:
    """The last but one too, where a device that moved before it would explain half of what is off."""
    solution, truth = solved(replace(SMALL, cameras=2, moved_pose=number, seed=5))
    assert set(solution.outliers) == {f"pose {number}"}
    assert "px from where the other poses put it" in solution.outliers[f"pose {number}"]
    assert f"pose {number}" not in solution.poses
    assert max(np.abs(list(in_deviations(solution, truth).values()))) < 4


@pytest.mark.slow
def test_with_next_to_no_noise_no_pose_is_called_off() -> None:
    """A lens that is not done justice to must not make outliers of the poses at the image's border."""
    solution, _ = solved(replace(SMALL, cameras=2, corner_px=0.003, match_px=0.01, alike_px=0.0, outlying=0.0, seed=9))
    assert solution.outliers == {}
    assert solution.residuals["right"].rms_px < 0.006


@pytest.mark.slow
def test_a_pose_that_no_camera_saw_is_left_out_by_name() -> None:
    observations, _ = made(replace(SMALL, poses=6))
    poses = (*observations.poses[:5], replace(observations.poses[5], views={}))
    solution = solve(replace(observations, poses=poses))
    assert "no camera saw" in solution.outliers["pose 5"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("recipe", "words"),
    [
        (
            replace(SMALL, bumped=(PROJECTOR, 5)),
            "camera 'left' and the projector .*between pose 'pose 4' and pose 'pose 5'",
        ),
        (replace(SMALL, projector=False, cameras=2, bumped=("right", 4)), "'right' .*moved between pose 'pose 3' and"),
        (replace(SMALL, cameras=2, bumped=("right", 5)), "^camera 'right' moved between pose 'pose 4' and"),
        (replace(SMALL, cameras=2, bumped=("left", 3)), "^camera 'left' moved between pose 'pose 2' and"),
        (replace(SMALL, cameras=2, bumped=(PROJECTOR, 5)), "^the projector moved between pose 'pose 4' and"),
        (
            replace(SMALL, poses=10, cameras=2, bumped=("right", 7), bump_mm=4.0),
            "^camera 'right' moved between pose 'pose 6' and",
        ),
        (
            replace(SMALL, poses=6, cameras=2, projector=False, bumped=("right", 4), bump_mm=4.0),
            "moved between pose 'pose 3' and pose 'pose 4'",
        ),
    ],
)  # fmt: skip
def test_a_device_that_was_bumped_is_named_with_the_pose(recipe: Recipe, words: str) -> None:
    with pytest.raises(SolveRefusedError, match=words) as refusal:
        solve(made(recipe)[0])
    assert "fasten" in str(refusal.value)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_poses_are_refused(count: int) -> None:
    observations, _ = made(replace(SMALL, poses=4))
    with pytest.raises(SolveRefusedError, match="shoot 15 to 20"):
        solve(replace(observations, poses=observations.poses[:count]))


def test_three_poses_solve_and_say_that_none_was_held_out() -> None:
    solution, _ = solved(replace(SMALL, poses=3, seed=7))
    assert all(np.isnan(left.held_out_rms_px) for left in solution.residuals.values())
    # A lens of which three poses tell next to nothing is as lenses are.
    for device in (solution.calibration.cameras["left"], solution.calibration.projector):
        assert device is not None
        assert (np.abs(device.distortion) < 3 * LENS_SIGMA).all()


@pytest.mark.slow
def test_poses_that_all_contradict_one_another_are_refused() -> None:
    observations, _ = made(replace(SMALL, cameras=2, projector=False))
    rng = np.random.default_rng(3)
    poses = []
    for number, pose in enumerate(observations.poses):
        views = dict(pose.views)
        if number % 2:
            shift = rng.uniform(-30, 30, 2)
            views["right"] = replace(views["right"], points_px=views["right"].points_px + shift)
        poses.append(replace(pose, views=views))
    with pytest.raises(SolveRefusedError, match=r"contradict"):
        solve(replace(observations, poses=tuple(poses)))


@pytest.mark.slow
@pytest.mark.parametrize("bow_mm", [0.2, 1.0])
def test_a_bowed_board_is_found_and_does_no_harm(bow_mm: float) -> None:
    recipe = replace(SMALL, poses=7, bow_mm=bow_mm)
    (shaped, truth), (observations, _) = solved(recipe), made(recipe)
    assert shaped.board_shape_mm is not None
    assert shaped.bow is not None
    assert shaped.bow.solved
    # The outermost corners stand a twelfth within the board's half extent; a parabola's height is the same there.
    assert abs(shaped.bow.height_mm - bow_mm) < 3.5 * shaped.bow.sigma_mm + 0.02 * bow_mm
    assert shaped.bow.sigma_mm < 0.02
    height: FloatArray = shaped.board_shape_mm[:, 2]
    assert np.ptp(height) == pytest.approx(shaped.bow.height_mm, rel=0.2)
    assert max(np.abs(list(in_deviations(shaped, truth).values()))) < 4
    flat = solve(observations, board_shape=BoardShape.FLAT)
    assert flat.board_shape_mm is None
    assert flat.bow is None
    assert flat.residuals["left"].rms_px > shaped.residuals["left"].rms_px
    # A lens that makes up for the bow is off by many deviations; held-out poses tell of it, and the covariance of them.
    told = max(left.held_out_rms_px / left.rms_px for left in flat.residuals.values())
    assert told * max(np.abs(list(in_deviations(flat, truth).values()))) > 4


@pytest.mark.parametrize(
    "recipe",
    [
        SMALL,
        pytest.param(replace(SMALL, poses=4, seed=508), marks=pytest.mark.slow),
        *(pytest.param(replace(SMALL, poses=5, seed=seed), marks=pytest.mark.slow) for seed in (600, 603, 604, 609)),
    ],
)
def test_a_flat_board_stays_flat(recipe: Recipe) -> None:
    """Of twelve seeds from 600 on, those of the largest bow, of the least sure one, and of the largest error."""
    solution, truth = solved(recipe)
    assert solution.board_shape_mm is None
    assert solution.bow is not None
    assert not solution.bow.solved
    assert solution.bow.height_mm < 6 * solution.bow.sigma_mm < 0.5
    assert max(np.abs(list(in_deviations(solution, truth).values()))) < 4


@pytest.mark.slow
def test_corners_that_lie_off_their_printed_places_are_found() -> None:
    offsets = np.zeros((88, 3))
    offsets[:, :2] = np.random.default_rng(4).normal(0, 0.08, (88, 2))
    observations, truth = made(replace(SMALL, poses=6, side=8, offsets_mm=offsets))
    solution = solve(observations)
    assert solution.board_shape_mm is not None
    found, placed = solution.board_shape_mm[:, :2], CHESSBOARD.points_mm[:, :2]
    # By the solve, offsets move, turn and scale the board by nothing.
    x, y = (placed - placed.mean(axis=0)).T
    zero, one = np.zeros(88), np.ones(88)
    moves = np.stack([np.stack(pair, axis=1).ravel() for pair in ((one, zero), (zero, one), (-y, x), (x, y))], axis=1)
    left = offsets[:, :2].ravel() - moves @ np.linalg.lstsq(moves, offsets[:, :2].ravel(), rcond=None)[0]
    assert np.sqrt(np.mean((found.ravel() - left) ** 2)) < 0.25 * 0.08
    assert max(np.abs(list(in_deviations(solution, truth).values()))) < 4


def printed(wide: float, high: float, recipe: Recipe = SMALL) -> Recipe:
    """The same with a print that is so many times as wide and as high as it says."""
    return replace(recipe, stretched=(wide, high))


def expected(recipe: Recipe) -> ExpectedError:
    return expected_error(solved(recipe)[0], made(recipe)[0])


def actual_mm(solution: Solution, stated: ExpectedError, truth: Calibration) -> float:
    """Rms along the first camera's rays of what is measured with a calibration, after the best rigid motion."""
    camera, places = truth.cameras["left"], stated.grid_mm
    assert truth.projector is not None
    assert solution.calibration.projector is not None
    at, lit = pixels(camera, places), pixels(truth.projector, places)[:, 0]
    own = solution.calibration.cameras["left"], solution.calibration.projector
    found = aligned(met_with_projector(*own, at, lit, places, 0), places)
    ray = places - camera.centre_mm
    along = np.einsum("ni,ni->n", found - places, ray / np.linalg.norm(ray, axis=1, keepdims=True))
    return float(np.sqrt((along**2).mean()))


def test_a_board_that_is_as_it_says_has_no_stretch() -> None:
    size, stated = solved(SMALL)[0].size, expected(SMALL)
    assert abs(size.stretch) < 3.5 * size.stretch_sigma
    assert size.stretch_sigma < 3e-4
    assert size.scale_sigma == pytest.approx(CHESSBOARD.square_sigma / np.sqrt(2))
    assert 0.5 < stated.board_mm / stated.point_mm < 1


@pytest.mark.slow
@pytest.mark.parametrize(("wide", "high"), [(1.002, 1.0), (1.0, 1.004), (0.9995, 1.0005)])
def test_a_stretched_print_is_found_and_its_error_stated(wide: float, high: float) -> None:
    (solution, truth), stated = solved(printed(wide, high)), expected(printed(wide, high))
    size, stretch = solution.size, wide / high - 1
    assert size.stretch == pytest.approx(stretch, abs=3.5 * size.stretch_sigma)
    assert solution.board_shape_mm is None, "the stretch was taken for a bend"
    # Which of the two is wrong no pose tells: the mean size is off by half of it, and that is what is stated.
    assert actual_mm(solution, stated, truth) < 2.5 * stated.point_mm
    if abs(stretch) > 1e-3:
        assert 0.7 < stated.point_mm / actual_mm(solution, stated, truth) < 1.4
        assert [each.figure for each in grade_board_size(solution, None)] == ["stretch"]
    found = in_deviations(solution, truth, exact_board=False)
    assert max(np.abs(list(found.values()))) < 3.5, found


@pytest.mark.slow
def test_a_stretched_board_may_be_bowed_as_well() -> None:
    solution, truth = solved(printed(1.002, 1.0, replace(SMALL, poses=12, bow_mm=1.0)))
    assert solution.bow is not None
    assert solution.bow.solved
    assert solution.size.stretch == pytest.approx(0.002, abs=3.5 * solution.size.stretch_sigma)
    assert max(np.abs(list(in_deviations(solution, truth, exact_board=False).values()))) < 3.5


@pytest.mark.slow
def test_a_ruler_makes_a_wrong_print_right() -> None:
    across, down = CHESSBOARD.rulers_mm
    recipe = printed(0.98, 0.99)
    observations, truth = made(recipe)
    told = CHESSBOARD.as_measured(round(0.98 * across, 1), round(0.99 * down, 1))
    read = Observations(told, observations.cameras, observations.projector, observations.poses)
    solution = solve(read)
    stated = expected_error(solution, read)
    assert abs(solution.size.stretch) < 2.5e-3
    assert actual_mm(solution, stated, truth) < 2.5 * stated.point_mm
    found = in_deviations(solution, truth, exact_board=False)
    assert max(np.abs(list(found.values()))) < 3.5, found


# ---- Poses that are held out, and the odd and even half of a solve: what each says without the others


def problem_of(recipe: Recipe) -> AdjustmentProblem:
    _, seen = true_geometry(recipe)
    names = tuple(f"pose {number}" for number in range(recipe.poses))
    return AdjustmentProblem(("left",), names, False, seen.select_poses(np.ones(recipe.poses, np.bool_), matches=False))


def test_each_pose_is_held_out_once() -> None:
    problem = problem_of(Recipe(poses=13, projector=False, side=4))
    folds = make_folds(problem)
    assert len(folds) == 5
    np.testing.assert_array_equal(np.sum(folds, axis=0), 1)


def test_three_poses_are_too_few_to_hold_any_out() -> None:
    assert make_folds(problem_of(Recipe(poses=3, projector=False, side=4))) == []


@pytest.mark.parametrize(
    ("ratios", "factor"),
    [((1.02, 4.5), 4.5), ((0.98, 0.9), 1.0), ((np.nan, np.nan), 1.0), ((1.5, np.nan), 1.5)],
)
def test_deviations_allow_for_the_residuals_of_held_out_poses(ratios: tuple[float, float], factor: float) -> None:
    devices = 15 * len(ratios)
    random = np.random.default_rng(1).normal(size=(devices, devices))
    covariance = random @ random.T
    no_map = np.zeros((CELLS, CELLS))
    residuals = [
        DeviceResiduals(0.2, 0.2, 0.2 * ratio, 100, 0, {}, no_map, np.zeros((CELLS, CELLS, 2)), no_map.astype(np.int32))
        for ratio in ratios
    ]
    allowed = inflate_by_held_out(covariance, residuals)
    np.testing.assert_allclose(np.sqrt(np.diagonal(allowed)), factor * np.sqrt(np.diagonal(covariance)))
    # Correlations stay: devices that err together are a small error between them.
    np.testing.assert_allclose(allowed / covariance, factor**2)


def whole(poses: int) -> tuple[AdjustmentProblem, Fit]:
    geometry, seen = true_geometry(Recipe(poses=poses, side=12, seed=2))
    problem = AdjustmentProblem(("left", "projector"), tuple(f"pose {number}" for number in range(poses)), True, seen)
    return problem, fit_geometry(problem, geometry, correlated=True)


def test_a_half_is_what_its_poses_give_from_wherever_it_starts() -> None:
    problem, fit = whole(9)
    halves = solve_halves(problem, fit, None, ())
    assert [half.poses for half in halves] == [tuple(f"pose {n}" for n in range(first, 9, 2)) for first in (0, 1)]
    for first, half in enumerate(halves):
        others = np.arange(9) % 2 != first
        moved = fit.geometry.devices.copy()
        moved[:, :4] *= 1.002
        alone = fit_geometry(problem.exclude_poses(others), replace(fit.geometry, devices=moved), correlated=True)
        change = device_difference(alone.geometry.devices, fit.geometry.devices).ravel()
        sigma = np.sqrt(np.diagonal(half.covariance))
        known = sigma > 0
        # They settle on which observations are outlying by themselves.
        assert np.abs((half.change - change)[known] / sigma[known]).max() < 0.2


def test_a_half_sees_nothing_of_the_other() -> None:
    problem, fit = whole(8)
    m = problem.measurements
    even = m.corner_where[:, 1] % 2 == 1
    wrong = replace(problem, measurements=replace(m, corner_px=m.corner_px + 3.0 * even[:, None]))
    before, after = (solve_halves(each, fit, None, ()) for each in (problem, wrong))
    np.testing.assert_array_equal(before[0].change, after[0].change)
    np.testing.assert_array_equal(before[0].covariance, after[0].covariance)
    assert np.abs(after[1].change - before[1].change).max() > 1


def test_too_few_poses_are_not_halved() -> None:
    problem, fit = whole(MIN_HALVED_POSES)
    assert len(solve_halves(problem, fit, None, ())) == 2
    left_out = np.arange(MIN_HALVED_POSES) == 3
    assert solve_halves(problem.exclude_poses(left_out), fit, None, ()) == ()

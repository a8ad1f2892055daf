"""A print that is wider or higher than it says, against boards that OpenCV projected, and what then is stated in mm."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from slrig.calibration.judging.board_size import check_scale, judged_size
from slrig.calibration.judging.expected_error import expected_error
from slrig.calibration.observations import Observations
from slrig.calibration.solution import ExpectedError, Solution
from slrig.calibration.solving.solve import solve
from slrig.model import Calibration
from tests.unit.calibration.perturbed import aligned, met_with_projector, pixels
from tests.unit.calibration.solving.against_truth import in_deviations
from tests.unit.calibration.synthetic import CHESSBOARD, Recipe, made

SMALL = Recipe(poses=8, side=12)


def printed(wide: float, high: float, recipe: Recipe = SMALL) -> Recipe:
    """The same with a print that is so many times as wide and as high as it says."""
    return replace(recipe, offsets_mm=CHESSBOARD.points_mm * [wide - 1, high - 1, 0.0])


def solved(recipe: Recipe) -> tuple[Solution, ExpectedError, Calibration]:
    observations, truth = made(recipe)
    solution = solve(observations)
    return solution, expected_error(solution, observations), truth


@cache
def plain() -> tuple[Solution, ExpectedError, Calibration]:
    return solved(SMALL)


def actual_mm(solution: Solution, expected: ExpectedError, truth: Calibration) -> float:
    """Rms along the first camera's rays of what is measured with a calibration, after the best rigid motion."""
    camera, places = truth.cameras["left"], expected.grid_mm
    assert truth.projector is not None
    assert solution.calibration.projector is not None
    at, lit = pixels(camera, places), pixels(truth.projector, places)[:, 0]
    own = solution.calibration.cameras["left"], solution.calibration.projector
    found = aligned(met_with_projector(*own, at, lit, places, 0), places)
    ray = places - camera.centre_mm
    along = np.einsum("ni,ni->n", found - places, ray / np.linalg.norm(ray, axis=1, keepdims=True))
    return float(np.sqrt((along**2).mean()))


def test_a_board_that_is_as_it_says_has_no_stretch() -> None:
    solution, expected, _ = plain()
    size = solution.size
    assert abs(size.stretch) < 3.5 * size.stretch_sigma
    assert size.stretch_sigma < 3e-4
    assert size.scale_sigma == pytest.approx(CHESSBOARD.square_sigma / np.sqrt(2))
    assert 0.5 < expected.board_mm / expected.point_mm < 1


@pytest.mark.slow
@pytest.mark.parametrize(("wide", "high"), [(1.002, 1.0), (1.0, 1.004), (0.9995, 1.0005)])
def test_a_stretched_print_is_found_and_its_error_stated(wide: float, high: float) -> None:
    solution, expected, truth = solved(printed(wide, high))
    size, stretch = solution.size, wide / high - 1
    assert size.stretch == pytest.approx(stretch, abs=3.5 * size.stretch_sigma)
    assert solution.board_shape_mm is None, "the stretch was taken for a bend"
    # Which of the two is wrong no pose tells: the mean size is off by half of it, and that is what is stated.
    assert actual_mm(solution, expected, truth) < 2.5 * expected.point_mm
    if abs(stretch) > 1e-3:
        assert 0.7 < expected.point_mm / actual_mm(solution, expected, truth) < 1.4
        assert [each.figure for each in judged_size(solution, None)] == ["stretch"]
    found = in_deviations(solution, truth, exact_board=False)
    assert max(np.abs(list(found.values()))) < 3.5, found


@pytest.mark.slow
def test_a_stretched_board_may_be_bowed_as_well() -> None:
    solution, _, truth = solved(printed(1.002, 1.0, replace(SMALL, poses=12, bow_mm=1.0)))
    assert solution.bow is not None
    assert solution.bow.solved
    assert solution.size.stretch == pytest.approx(0.002, abs=3.5 * solution.size.stretch_sigma)
    assert max(np.abs(list(in_deviations(solution, truth, exact_board=False).values()))) < 3.5


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.01, -0.005])
def test_a_wrong_square_is_told_against_an_earlier_calibration_only(share: float) -> None:
    observations, truth = made(printed(1 / (1 + share), 1 / (1 + share)))
    wrong = solve(observations)
    assert not [*judged_size(wrong, None)]
    found = check_scale(wrong, plain()[0].calibration, CHESSBOARD)
    assert found.share == pytest.approx(share, abs=4 * found.sigma + 1e-4)
    assert f"the board's squares measure {CHESSBOARD.square_mm / (1 + found.share):.5g} mm" in found.words[0]
    assert not check_scale(plain()[0], truth, CHESSBOARD).words


@pytest.mark.slow
def test_a_ruler_makes_a_wrong_print_right() -> None:
    across, down = CHESSBOARD.rulers_mm
    recipe = printed(0.98, 0.99)
    observations, truth = made(recipe)
    told = CHESSBOARD.as_read(round(0.98 * across, 1), round(0.99 * down, 1))
    read = Observations(told, observations.cameras, observations.projector, observations.poses)
    solution = solve(read)
    expected = expected_error(solution, read)
    assert abs(solution.size.stretch) < 2.5e-3
    assert actual_mm(solution, expected, truth) < 2.5 * expected.point_mm
    found = in_deviations(solution, truth, exact_board=False)
    assert max(np.abs(list(found.values()))) < 3.5, found

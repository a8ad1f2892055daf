"""What is said of a board's size: its scale against an earlier calibration, its stretch, and who may put it in use."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slrig.calibration.judging.board_size import ScaleCheck, check_scale, judged_size, unattended_faults
from slrig.calibration.judging.grades import Grade
from slrig.calibration.solution import PROJECTOR, BoardSize, Solution, scale_mode
from slrig.model import Calibration, FloatArray
from tests.unit.calibration.posed_boards import CHESSBOARD, two_cameras_and_projector

_SIGMA = np.tile([0.8, 0.8, 0.9, 0.9, 1e-3, 5e-3, 1e-4, 1e-4, 0.0, 4e-6, 4e-6, 4e-6, 0.01, 0.01, 0.01], 3)


def _solution(covariance: FloatArray | None = None) -> Solution:
    devices = two_cameras_and_projector()
    calibration = Calibration({name: devices[name] for name in ("left", "right")}, devices[PROJECTOR])
    return Solution(calibration, np.diag(_SIGMA**2) if covariance is None else covariance, {}, {}, {}, {})


def _enlarged(calibration: Calibration, factor: float) -> Calibration:
    cameras = {
        name: replace(each, translation_mm=factor * each.translation_mm) for name, each in calibration.cameras.items()
    }
    assert calibration.projector is not None
    projector = replace(calibration.projector, translation_mm=factor * calibration.projector.translation_mm)
    return Calibration(cameras, projector)


@pytest.mark.parametrize("factor", [1 / 0.96, 1.01, 0.991, 1.002])
def test_a_wrong_square_size_is_named_with_the_size_that_the_squares_have(factor: float) -> None:
    solution = _solution()
    found = check_scale(
        replace(solution, calibration=_enlarged(solution.calibration, factor)), solution.calibration, CHESSBOARD
    )
    assert found.share == pytest.approx(factor - 1, rel=1e-6)
    (words,) = found.words
    assert f"everything is {abs(factor - 1):.2%} {'larger' if factor > 1 else 'smaller'}" in words
    assert f"squares measure {12 / factor:.5g} mm instead of 12 mm" in words
    assert "measure both rulers" in words
    (judged,) = judged_size(solution, found)
    assert (judged.grade, judged.figure) == (Grade.USABLE, "scale")


def test_a_tenth_of_a_per_cent_is_what_a_rig_may_do_by_itself() -> None:
    solution = _solution()
    slightly = replace(solution, calibration=_enlarged(solution.calibration, 1.0009))
    found = check_scale(slightly, solution.calibration, CHESSBOARD)
    assert (found.checked, found.words) == (True, ())
    assert found.share == pytest.approx(9e-4, rel=1e-6)
    assert 0 < found.sigma < 3e-4


def test_a_scale_that_the_solve_itself_does_not_know_is_not_blamed_on_the_board() -> None:
    solution = _solution()
    wrong = replace(solution, calibration=_enlarged(solution.calibration, 1.01))
    assert check_scale(wrong, solution.calibration, CHESSBOARD).words
    unsure = replace(wrong, covariance=wrong.covariance * 60.0**2)
    assert check_scale(unsure, solution.calibration, CHESSBOARD).words == ()


def test_how_sure_a_board_s_size_is_hides_no_change_of_it() -> None:
    # The deviation by the board's own size is in the covariance, and is as large as the change that is looked for.
    solution = _solution()
    wrong = replace(solution, calibration=_enlarged(solution.calibration, 1.01), size=BoardSize(0.01))
    mode = 0.01 * scale_mode(wrong.calibration)
    unsure = replace(wrong, covariance=wrong.covariance + np.outer(mode, mode))
    found = check_scale(unsure, solution.calibration, CHESSBOARD)
    assert found.words
    assert found.sigma == pytest.approx(check_scale(wrong, solution.calibration, CHESSBOARD).sigma, abs=2e-4)


def test_the_deviation_of_a_distance_is_that_of_drawn_devices() -> None:
    random = np.random.default_rng(2)
    root = random.normal(size=(45, 45)) * 1e-3
    solution = _solution(root @ root.T)
    found = check_scale(solution, solution.calibration, CHESSBOARD)
    drawn = []
    devices = [*solution.calibration.cameras.values(), solution.calibration.projector]
    for _ in range(4000):
        step = (root @ random.normal(size=45)).reshape(3, 15)
        centres = []
        for device, change in zip(devices, step, strict=True):
            assert device is not None
            x, y, z = change[9:12]
            turn = np.eye(3) + np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            centres.append(-(turn @ device.rotation).T @ (device.translation_mm + change[12:]))
        drawn.append([np.linalg.norm(centres[a] - centres[b]) for a, b in ((0, 1), (0, 2), (1, 2))])
    shares = np.std(drawn, axis=0) / np.mean(drawn, axis=0)
    assert found.sigma == pytest.approx(shares.max(), rel=0.06)


def test_a_rebuilt_rig_is_not_taken_for_a_wrong_square_size() -> None:
    solution = _solution()
    projector = solution.calibration.projector
    assert projector is not None
    moved = replace(projector, translation_mm=projector.translation_mm * 1.1)
    rebuilt = Calibration(solution.calibration.cameras, moved)
    (words,) = check_scale(replace(solution, calibration=rebuilt), solution.calibration, CHESSBOARD).words
    assert "the rig was rebuilt, or a device was bumped" in words
    assert "camera 'left' to the projector" in words


def test_without_a_common_distance_the_scale_is_not_checked() -> None:
    solution = _solution()
    assert solution.calibration.projector is not None
    other = Calibration({"middle": solution.calibration.projector}, None)
    found = check_scale(solution, other, CHESSBOARD)
    assert not found.checked
    assert "the scale is not checked: that takes two devices which the earlier calibration has too, found no" in str(
        found.words
    )


@pytest.mark.parametrize(("stretch", "words"), [(0.002, "0.20% ± 0.01% wider than it is high"), (-0.002, "higher")])
def test_a_stretched_print_is_named(stretch: float, words: str) -> None:
    solution = replace(_solution(), size=BoardSize(0.001, stretch, 1e-4))
    (judged,) = judged_size(solution, None)
    assert judged.grade is Grade.USABLE
    assert words in judged.words
    assert "measure both rulers" in judged.words
    small = replace(solution, size=BoardSize(0.001, stretch / 2.1, 1e-4))
    unsure = replace(solution, size=BoardSize(0.001, stretch, 5e-4))
    assert not [*judged_size(small, None), *judged_size(unsure, None)]


def test_a_schedule_puts_a_calibration_in_use_only_if_its_scale_is_vouched_for() -> None:
    solution, agrees = _solution(), ScaleCheck(True, 1e-4, 1e-4, ())
    assert unattended_faults(solution, CHESSBOARD, agrees) == ()
    (words,) = unattended_faults(solution, CHESSBOARD, None)
    assert "nothing vouches for the scale" in words
    certified = replace(CHESSBOARD, square_sigma=1e-4)
    assert unattended_faults(solution, certified, None) == ()
    assert unattended_faults(solution, CHESSBOARD.as_read(*CHESSBOARD.rulers_mm), None) == ()
    wrong = ScaleCheck(True, 0.009, 1e-4, ("everything is 0.90% larger",))
    assert unattended_faults(solution, certified, wrong) == ("everything is 0.90% larger",)
    stretched = replace(solution, size=BoardSize(0.001, 0.002, 1e-4))
    assert "wider" in str(unattended_faults(stretched, certified, agrees))

"""Errors of shape of uncalibrated scans against those stated: `pytest -s tests/bench/test_self_calibration.py`."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from slrig.calibration.board import BoardShape
from slrig.calibration.solving.solve import solve
from slrig.errors import SolveRefusedError
from slrig.model import Axis, Calibration, FloatArray
from slrig.reconstruction import DeviceGuess, PixelPairs, guessed_calibration, self_calibrate
from slrig.reconstruction.self_calibration import MAX_SHAPE_ERROR, similarity_rms, triangulate
from tests.unit.calibration.synthetic import Recipe, inside, made, seen
from tests.unit.calibration.synthetic import rig as board_rig
from tests.unit.reconstruction.test_self_calibration import (
    BASELINE_MM,
    KINDS,
    guessed,
    rig,
    shape_error,
    shared,
    surface,
)

SEEDS = 8


@pytest.mark.parametrize("wrong", [0.1, 0.02, 0.005])
def test_shapes_of_uncalibrated_scans_are_as_right_as_they_state(wrong: float) -> None:
    found = []
    for kind in KINDS:
        for seed in range(SEEDS):
            chance = np.random.default_rng([seed, len(kind)])
            truth = rig(chance, lens_shift_px=400 * (-1) ** seed)
            points = surface(kind, chance, 20_000)
            pairs, _ = shared(truth, points, chance)
            solved = self_calibrate(
                *guessed(truth, wrong, chance), [{"left": pairs}], baseline_mm=BASELINE_MM, most_error=1.0
            )
            found.append((shape_error(solved, truth, points), solved.shape_error))
    errors, stated = np.array(found).T
    ratio, made = errors / stated, stated <= MAX_SHAPE_ERROR
    sys.stdout.write(
        f"\nfocal lengths {wrong:.1%} wrong: error {np.sqrt(np.mean(errors**2)):.3%} rms, 68 % within "
        f"{np.percentile(ratio, 68):.2f}, 95 % within {np.percentile(ratio, 95):.2f} of the stated; {made.sum()} of "
        f"{len(errors)} let through, largest error of these {errors[made].max(initial=0):.3%}\n"
    )
    assert np.percentile(ratio, 68) < 1.25
    assert np.mean(ratio < 2) >= 0.95
    assert (errors[made] <= 2 * stated[made]).all()


@pytest.mark.parametrize("wrong", [0.1, 0.005])
def test_no_flat_scene_is_let_through(wrong: float) -> None:
    for seed in range(20):
        chance = np.random.default_rng(seed)
        truth = rig(chance, lens_shift_px=400 * (-1) ** seed)
        pairs, _ = shared(truth, surface("plane", chance, 10_000), chance)
        with pytest.raises(SolveRefusedError):
            self_calibrate(*guessed(truth, wrong, chance), [{"left": pairs}], baseline_mm=BASELINE_MM, most_error=1.0)


def test_ten_scans_are_better_than_one() -> None:
    errors = []
    for seed in range(4):
        chance = np.random.default_rng(seed)
        truth = rig(chance, lens_shift_px=300)
        guess, scans, points = guessed(truth, 0.1, chance), [], []
        for kind in KINDS * 2:
            points.append(surface(kind, chance, 8_000) + chance.normal(0, 20, 3))
            scans.append({"left": shared(truth, points[-1], chance)[0]})
        solved = [
            self_calibrate(*guess, scans[:count], baseline_mm=BASELINE_MM, most_error=1.0) for count in (1, 3, 10)
        ]
        errors.append([shape_error(each, truth, np.concatenate(points)) for each in solved])
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    sys.stdout.write("\nerror of shape by 1, 3 and 10 scans: " + ", ".join(f"{each:.3%}" for each in rms) + "\n")
    assert rms[2] < rms[1] < rms[0]


def test_poses_of_a_board_and_scans_improve_a_calibration_by_a_scan() -> None:
    """Shape errors of one scan, of few poses of a board with and without scans, and of a full calibration."""
    errors = []
    for seed in range(6):
        chance = np.random.default_rng([seed, 9])
        truth = board_rig(Recipe(lens_shift=seed % 2 == 0))
        assert truth.projector is not None
        guesses = [
            DeviceGuess(each.size, float(each.matrix[0, 0] * (1 + 0.1 * chance.choice([-1, 1]))), 0.1)
            for each in (truth.cameras["left"], truth.projector)
        ]
        surfaces = [at_the_board(kind, chance) for kind in KINDS * 2]
        everywhere = np.concatenate(surfaces)
        scans = [{"left": pairs_by(truth, points, chance)} for points in surfaces]
        length = float(np.linalg.norm(truth.projector.centre_mm))
        guess = guessed_calibration({"left": guesses[0]}, guesses[1])
        alone = self_calibrate(*guess, scans[:1], baseline_mm=length, most_error=1.0)
        found = [error_by(alone.calibration, truth, everywhere)]
        for poses in (3, 15):
            solution = solve(made(Recipe(seed=seed + 100, poses=poses), truth)[0], board_shape=BoardShape.FLAT)
            found.append(error_by(solution.calibration, truth, everywhere))
            for count in (1, 10):
                refined = self_calibrate(solution.calibration, solution.covariance, scans[:count], most_error=np.inf)
                found.append(error_by(refined.calibration, truth, everywhere))
        errors.append(found)
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    words = ("1 scan", "3 poses", "and 1 scan", "and 10", "15 poses", "and 1 scan", "and 10")
    figures = ", ".join(f"{word} {each:.4%}" for word, each in zip(words, rms, strict=True))
    sys.stdout.write(f"\nerror of shape: {figures}; 3 poses and 10 scans over 15 poses: {rms[3] / rms[4]:.2f}\n")
    assert rms[1] < rms[0] / 10
    assert rms[2] < 1.05 * rms[1]
    assert rms[3] < 1.05 * rms[1]


def at_the_board(kind: str, chance: np.random.Generator) -> FloatArray:
    """Points of a scene where the board is shown, mm."""
    return surface(kind, chance, 8_000) + chance.normal((0, 0, -110), (15, 15, 20))


def pairs_by(truth: Calibration, points_mm: FloatArray, chance: np.random.Generator | None) -> PixelPairs:
    """The pixels that the camera and the projector share; with noise unless chance is None."""
    assert truth.projector is not None
    here, there = seen(truth.cameras["left"], points_mm), seen(truth.projector, points_mm)
    both = inside(here, truth.cameras["left"].size) & inside(there, truth.projector.size)
    noise = 0.0 if chance is None else chance.normal(0, 0.05, there[both].shape)
    return PixelPairs(here[both], there[both] + noise, np.full(int(both.sum()), 0.05), Axis.COLUMN)


def error_by(found: Calibration, truth: Calibration, points_mm: FloatArray) -> float:
    """Rms error of the points' shape over their extent, noise aside."""
    assert found.projector is not None
    assert truth.projector is not None
    pairs = pairs_by(truth, points_mm, None)
    true = triangulate(truth.cameras["left"], truth.projector, pairs)
    also = triangulate(found.cameras["left"], found.projector, pairs)
    return similarity_rms(true, also) / float(np.linalg.norm(np.ptp(true, axis=0)))

"""Errors of shape of uncalibrated scans against those stated: `pytest -s tests/bench/test_self_calibration.py`."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from slrig.errors import SolveRefusedError
from slrig.reconstruction import self_calibrate
from slrig.reconstruction.self_calibration import MAX_SHAPE_ERROR
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

"""Two halves of a solve against each other: in millimetres, without their rigid motion, against what they state."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from slrig.calibration.judging.expected_error import volume_of
from slrig.calibration.judging.grades import Grade
from slrig.calibration.judging.odd_even import odd_even
from slrig.calibration.judging.verdict import verdict
from slrig.calibration.solution import Half, Solution
from slrig.model import FloatArray, Pinhole
from tests.unit.calibration.judging.test_expected_error import BOARD, along_rays, solved
from tests.unit.calibration.judging.test_verdict import EXPECTED
from tests.unit.calibration.perturbed import (
    aligned,
    changed,
    covariance_by_known_points,
    draws,
    left_camera,
    light_source,
    met_with_projector,
    pixels,
)


@cache
def whole() -> tuple[Solution, FloatArray]:
    """A solution of a camera and a projector, and some forty places in its volume."""
    solution, observations = solved({"left": left_camera()}, light_source())
    _, places = volume_of(solution, observations)
    return solution, places[:: len(places) // 40]


def halved(odd: FloatArray, even: FloatArray, covariance: FloatArray) -> tuple[Solution, FloatArray]:
    """The same with halves that are off by so much."""
    solution, places = whole()
    names = tuple(solution.poses)
    halves = (Half(names[::2], odd, covariance), Half(names[1::2], even, covariance))
    return replace(solution, halves=halves), places


def covariance() -> FloatArray:
    return covariance_by_known_points([left_camera(), light_source()], 1, 0.05, 1)


def test_halves_that_are_off_as_they_state_differ_by_what_is_stated() -> None:
    spread = covariance()
    off = draws(spread, 500, 5)
    found = []
    for odd, even in zip(off[::2], off[1::2], strict=True):
        made = odd_even(*halved(odd, even, spread))
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
    found = odd_even(solution, places)
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
    found = odd_even(*halved(moved, np.zeros(30), covariance()))
    assert found is not None
    assert found.difference_mm < 1e-6
    assert found.motion.turn_deg == pytest.approx(np.degrees(2e-5), rel=1e-3)
    assert found.motion.shift_mm == pytest.approx(np.linalg.norm(shift), rel=0.2)
    assert found.fits


def test_a_difference_beyond_chance_is_a_reason_against_good() -> None:
    spread = covariance()
    odd, even = draws(spread, 2, 3)
    plain, large = (odd_even(*halved(times * odd, times * even, spread)) for times in (1, 6))
    assert plain is not None
    assert large is not None
    assert large.stated_mm == pytest.approx(plain.stated_mm)
    assert large.difference_mm == pytest.approx(6 * plain.difference_mm)
    assert plain.fits
    assert not large.fits
    solution = halved(odd, even, spread)[0]
    assert large.words in verdict(solution, EXPECTED, None, large, board=BOARD).reasons
    assert plain.words not in verdict(solution, EXPECTED, None, plain, board=BOARD).reasons
    judged = {each.figure: each for each in verdict(solution, EXPECTED, None, large, board=BOARD).judged}
    assert judged["odd_even"].grade is Grade.USABLE
    assert judged["odd_even"].value == large.ratio
    assert f"reckon with {large.difference_mm / 2:.2g} mm for the error of a point" in large.words
    assert "more than chance" in large.words


def test_without_halves_nothing_is_said() -> None:
    solution, places = halved(np.zeros(30), np.zeros(30), covariance())
    assert odd_even(replace(solution, halves=()), places) is None
    assert "odd_even" not in {each.figure for each in verdict(solution, EXPECTED, board=BOARD).judged}

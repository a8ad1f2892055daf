"""The prescribed positions of an acceptance test, its limits, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slrig.accept.evaluation import error_uncertainty
from slrig.accept.plan import (
    AcceptancePlan,
    Artefact,
    Artefacts,
    Certified,
    Limits,
    Quantity,
    acceptance_plan,
    rig_volume_mm,
    turn_deg,
    usual_limits,
)
from slrig.errors import InvalidInputError
from slrig.model import Calibration, Pinhole, Size

VOLUME = np.array([[-100.0, -75.0, -40.0], [100.0, 75.0, 40.0]])
GOOD = Artefacts(
    Certified(30.0, 0.001), Certified(110.0, 0.002), (160.0, 110.0), sphere_form_mm=0.001, plane_form_mm=0.002
)


def device(*, turned: np.ndarray | None = None) -> Pinhole:
    matrix = np.array([[1000.0, 0, 500], [0, 1000.0, 400], [0, 0, 1]])
    rotation = np.eye(3) if turned is None else turned
    return Pinhole(Size(1000, 800), matrix, np.zeros(5), rotation, np.array([0.0, 0.0, 600.0]))


def plan_of(artefacts: Artefacts = GOOD, *, turned: np.ndarray | None = None, rendered: bool = False) -> AcceptancePlan:
    camera = device(turned=turned)
    return acceptance_plan(Calibration({"left": camera}, camera), VOLUME, artefacts, rendered=rendered)


def test_there_are_as_many_positions_as_are_prescribed_and_each_is_another() -> None:
    plan = plan_of()
    counts = {artefact: sum(step.artefact is artefact for step in plan.steps) for artefact in Artefact}
    assert counts == {Artefact.SPHERE: 10, Artefact.BAR: 7, Artefact.PLANE: 6}
    assert len({step.words for step in plan.steps}) == len({step.name for step in plan.steps}) == 23
    lies = {(*step.centre_mm.round(3), *step.axis.round(3)) for step in plan.steps}
    assert len(lies) == 23


def test_balls_lie_wholly_inside_the_volume_and_fill_it() -> None:
    plan = plan_of()
    balls = [(step.centre_mm, 15.0) for step in plan.steps if step.artefact is Artefact.SPHERE]
    for step in plan.steps:
        if step.artefact is Artefact.BAR:
            assert np.linalg.norm(step.axis) == pytest.approx(1)
            balls += [(step.centre_mm + side * 55.0 * step.axis, 15.0) for side in (-1, 1)]
    centres = np.array([centre for centre, _ in balls])
    assert (centres - 15 >= VOLUME[0] - 1e-9).all()
    assert (centres + 15 <= VOLUME[1] + 1e-9).all()
    spheres = centres[:10]
    assert np.allclose(np.ptp(spheres, axis=0), VOLUME[1] - VOLUME[0] - 30)


def test_bars_lie_along_all_four_diagonals_an_edge_a_face_and_the_depth() -> None:
    bars = [step for step in plan_of().steps if step.artefact is Artefact.BAR]
    signs = {tuple(np.sign(step.axis[1:] * np.sign(step.axis[0]))) for step in bars[:4]}
    assert signs == {(1, 1), (1, -1), (-1, 1), (-1, -1)}
    assert bars[4].axis.tolist() == [1, 0, 0]
    assert bars[5].axis[2] == 0
    # As deep as the volume lets it.
    assert 110 * bars[6].axis[2] == pytest.approx(min(0.8 * 110, 80 - 30))
    assert "from the upper left front to the lower right back" in bars[0].words


def test_planes_face_the_rig_and_tilted_ones_stay_within_the_depth() -> None:
    planes = [step for step in plan_of().steps if step.artefact is Artefact.PLANE]
    for step in planes:
        assert step.axis[2] < -0.8
        tilt = np.arccos(-step.axis[2])
        assert 80 * np.sin(tilt) <= 40 + 1e-9
    assert {round(float(step.centre_mm[2])) for step in planes} == {-32, 0, 32}


def test_words_follow_the_camera_however_the_world_stands() -> None:
    upside_down = Rotation.from_rotvec([0, 0, np.pi]).as_matrix()
    upright, turned = plan_of().steps, plan_of(turned=upside_down).steps
    assert "upper left front" in upright[1].words
    assert "lower right front" in turned[1].words
    assert np.array_equal(upright[1].centre_mm, turned[1].centre_mm)


def test_a_pose_turns_an_artefact_into_its_position() -> None:
    own = {Artefact.BAR: [1.0, 0.0, 0.0], Artefact.PLANE: [0.0, 0.0, -1.0]}
    for step in plan_of().steps:
        if step.artefact in own:
            turn = Rotation.from_euler("xyz", turn_deg(step), degrees=True)
            assert turn.apply(own[step.artefact]) == pytest.approx(step.axis, abs=1e-12)


def test_the_first_position_of_each_artefact_is_measured_again() -> None:
    plan = replace(plan_of(), repeats=3)
    assert len(plan.takes) == 23 + 3 * 2
    again = [(step.name, take) for step, take in plan.takes if take]
    assert again == [(f"{artefact}-1", take) for artefact in ("sphere", "bar", "plane") for take in (1, 2)]


def test_usual_limits_follow_the_diagonal_or_what_is_wanted() -> None:
    diagonal = float(np.linalg.norm(VOLUME[1] - VOLUME[0]))
    usual = {quantity: plan_of().limits.limit_mm(quantity) for quantity in Quantity}
    lengths = {Quantity.SIZE: diagonal / 5000, Quantity.SPACING: diagonal / 5000}
    assert usual == pytest.approx({**lengths, Quantity.FORM: diagonal / 2500, Quantity.FLATNESS: diagonal / 2500})
    assert usual_limits(VOLUME, 0.02) == Limits(form_mm=0.04, size_mm=0.02, spacing_mm=0.02, flatness_mm=0.04)


def test_a_warm_bar_is_longer_and_known_less_well_the_less_its_temperature_is() -> None:
    told = replace(GOOD, temperature_c=24.0)
    assert told.expanded_mm(told.distance) - 110.0 == pytest.approx(110 * 11.5e-6 * 4)
    assert GOOD.expanded_mm(GOOD.distance) == 110.0
    # By hand, half widths over the root of three: 110 mm * 11.5e-6/K * 1 K = 1.265 µm, 110 mm * 4 K * 1e-6/K = 0.44 µm.
    found = error_uncertainty(Quantity.SPACING, told)
    assert found.temperature_mm == pytest.approx(2 * np.hypot(1.265e-3, 0.44e-3) / np.sqrt(3))
    assert error_uncertainty(Quantity.SPACING, GOOD).temperature_mm == pytest.approx(2 * 5 * 1.265e-3 / np.sqrt(3))
    assert found.expanded_mm == pytest.approx(np.hypot(0.002, found.temperature_mm))


def test_each_error_has_the_uncertainty_of_its_own_artefact() -> None:
    still = replace(GOOD, expansion_per_k=0.0)
    found = {quantity: error_uncertainty(quantity, still).expanded_mm for quantity in Quantity}
    # Form; diameter and form; distance; form.
    assert list(found.values()) == pytest.approx([0.001, np.hypot(0.001, 0.001), 0.002, 0.002])
    loose = replace(still, fixture_mm=0.01)
    assert all(
        error_uncertainty(each, loose).expanded_mm == pytest.approx(np.hypot(known, 0.01))
        for each, known in found.items()
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"diameter": Certified(4.0, 0.001)}, "expected a diameter of 5.2 to 52.5 mm"),
        ({"diameter": Certified(-30.0, 0.001)}, "expected a length above 0 mm, found -30 mm"),
        ({"diameter": Certified(30.0, -1.0)}, "the uncertainty of the sphere's diameter: expected 0 mm or more"),
        ({"diameter": Certified(30.0)}, "uncertainty of the sphere's diameter is not stated"),
        ({"expansion_per_k": 11.5}, "expected 0 to 0.001 per kelvin, as steel has 1.15e-05, found 11.5"),
        ({"fixture_mm": -1.0}, "the uncertainty of the fixture: expected 0 mm or more, found -1 mm"),
        ({"distance": Certified(60.0, 0.001)}, "expected 78.7 mm or more between the balls"),
        ({"distance": Certified(180.0, 0.001)}, "expected 170.0 mm or less between the balls"),
        ({"distance": Certified(float("nan"), 0.001)}, "the bar's distance: expected a length above 0 mm, found nan"),
        ({"plane_mm": (100.0, 60.0)}, "expected 131.2 mm or more in length"),
        ({"plane_mm": (160.0, 40.0)}, "50 mm in width, found 160 x 40 mm"),
    ],
)
def test_artefacts_that_do_not_suit_the_volume_are_refused(change: dict[str, object], words: str) -> None:
    with pytest.raises(InvalidInputError) as refused:
        plan_of(replace(GOOD, **change))  # type: ignore[arg-type]
    assert words in str(refused.value)


def test_a_refusal_lists_all_faults() -> None:
    with pytest.raises(InvalidInputError) as refused:
        plan_of(replace(GOOD, diameter=Certified(4.0), plane_mm=(100.0, 60.0)))
    assert all(words in str(refused.value) for words in ("the sphere:", "the plane:", "is not stated"))
    camera = device()
    rig = Calibration({"left": camera}, camera)
    with pytest.raises(InvalidInputError, match="least corner and then of the greatest"):
        acceptance_plan(rig, VOLUME[::-1], GOOD, rendered=False)
    with pytest.raises(InvalidInputError, match="repeats: expected 1 or more, found 0"):
        acceptance_plan(rig, VOLUME, GOOD, rendered=False, repeats=0)


def test_the_volume_of_a_rig_without_a_stated_one_is_what_all_devices_see() -> None:
    camera = device()
    volume = rig_volume_mm(Calibration({"left": camera}, camera))
    # Near the front the view is narrowest: there the corners touch the margin, 3 % of the image.
    near = 600 + volume[0, 2]
    assert 1000 * volume[1, 0] / near == pytest.approx(470, rel=0.01) or (
        1000 * volume[1, 1] / near == pytest.approx(376, rel=0.01)
    )
    # Devices that look past one another have none.
    away = replace(camera, translation_mm=np.array([5000.0, 0.0, 600.0]))
    with pytest.raises(InvalidInputError, match="no common view"):
        rig_volume_mm(Calibration({"left": camera}, away))

"""What is done where the points of several cameras contradict each other."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from slrig.errors import CalibrationError
from slrig.model import Axis, Calibration, FloatArray, Pinhole
from slrig.reconstruction import evaluate_redundancy, triangulate_camera_projector
from slrig.reconstruction.identification import StripeEnsemble
from slrig.scan.agreement import Agreement, check_agreement, drop_contradicting_areas
from tests.unit.reconstruction.builders import CAMERA, OTHER_CAMERA, PROJECTOR, looking, seen_on_ball
from tests.unit.reconstruction.test_redundancy import turned

pytestmark = pytest.mark.slow  # kernels that only scans by two cameras need

COLUMNS = np.arange(90.0, 230.0, 10.0).tolist()
ROWS = np.arange(40.0, 200.0, 1.3)
GAP_PX = 4.0
NOISE_PX = 0.02
THIRD_CAMERA = looking(
    (-60.0, 60.0, -540.0), (0.0, 0.0, 0.0), size=CAMERA.size, focal_px=(1390.0, 1390.0), distortion=(0.0,) * 5
)
TRUE = {"left": CAMERA, "right": OTHER_CAMERA}


def stripes_of(cameras: Mapping[str, Pinhole], rows: FloatArray = ROWS) -> list[StripeEnsemble]:
    return [
        seen_on_ball(camera, COLUMNS, rows + 0.3 * number, sigma_px=NOISE_PX, noise_px=NOISE_PX, seed=number)
        for number, camera in enumerate(cameras.values())
    ]


def agreement(
    stripes: list[StripeEnsemble],
    believed: Mapping[str, Pinhole],
    *,
    projector: Pinhole = PROJECTOR,
    second_axis: Mapping[str, float] | None = None,
) -> Agreement:
    parts = [
        triangulate_camera_projector(each, camera, projector, Axis.COLUMN)[0]
        for each, camera in zip(stripes, believed.values(), strict=True)
    ]
    return check_agreement(
        list(believed), stripes, parts, Calibration(believed, projector), projector, Axis.COLUMN,
        widest_gap_px=GAP_PX, second_axis=second_axis,
    )  # fmt: skip


def wavy(stripes: StripeEnsemble) -> StripeEnsemble:
    """Stripes as through a pane of bad glass: no pose makes up for it."""
    x, y = stripes.points_px.T
    wave = 0.5 * np.sin(x / 50) * np.sin(y / 50)
    return stripes._replace(points_px=np.stack([x + wave, y], axis=1))


def test_cameras_that_agree_change_nothing() -> None:
    found = agreement(stripes_of(TRUE), TRUE)
    assert found.calibration.cameras == TRUE
    assert found.usable == (True, True)
    assert found.distance_mm == 0
    assert (found.notes, found.report, found.pose_error) == ((), None, None)


@pytest.mark.parametrize("name", ["left", "right", "projector"])
def test_a_device_that_was_bumped_is_named_and_its_pose_refined(name: str) -> None:
    true = {**TRUE, "projector": PROJECTOR}
    *believed, projector = (turned(d, degrees=(0.4, 0.9, -0.3)) if n == name else d for n, d in true.items())
    found = agreement(stripes_of(TRUE), dict(zip(TRUE, believed, strict=True)), projector=projector)
    (note,) = found.notes
    assert found.usable == (True, True)
    assert found.report is not None
    assert found.report["decision"] == "pose refined"
    named = "the projector" if name == "projector" else f"camera '{name}'"
    assert note.startswith(f"{named} was turned by ")
    assert note.endswith("Calibrate again")
    assert found.pose_error is not None


def test_where_other_devices_fit_as_well_they_are_named_and_the_difference_widens_the_deviations() -> None:
    found = agreement(stripes_of(TRUE), {**TRUE, "right": turned(OTHER_CAMERA, degrees=(0.0, 0.02, 0.0))})
    assert found.report is not None
    assert found.report["could_be_instead"]
    assert found.distance_mm > 0.02
    assert "moved instead" in found.notes[0]


def test_cameras_that_no_move_reconciles_are_not_both_used() -> None:
    stripes = stripes_of(TRUE)
    stripes[1] = wavy(stripes[1])
    found = agreement(stripes, TRUE)
    assert found.calibration.cameras["right"] is OTHER_CAMERA
    assert sorted(found.usable) == [False, True]
    assert found.distance_mm > 0
    assert "were left out" in found.notes[0]
    right = agreement(stripes, TRUE, second_axis={"left": 1.1, "right": 30.0})
    assert right.usable == (True, False)
    assert right.distance_mm == 0
    assert "second axis" in right.notes[0]


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("far", "moved too far"),
        ("exchanged", "cameras 'left' and 'right' are exchanged"),
        ("mirrored", "the picture of camera 'right' is mirrored"),
    ],
)
def test_a_calibration_that_the_cameras_refute_gives_no_mesh(kind: str, words: str) -> None:
    stripes, believed = stripes_of(TRUE), dict(TRUE)
    if kind == "far":
        believed["right"] = turned(OTHER_CAMERA, degrees=(0.0, 6.0, 0.0))
    elif kind == "exchanged":
        believed = {"left": OTHER_CAMERA, "right": CAMERA}
    else:
        pixels = stripes[1].points_px * [-1.0, 1.0] + [OTHER_CAMERA.size.width_px - 1.0, 0.0]
        stripes[1] = stripes[1]._replace(points_px=pixels)
    with pytest.raises(CalibrationError, match=words) as raised:
        agreement(stripes, believed)
    assert "px (median)" in str(raised.value)


def test_of_three_cameras_the_odd_one_is_left_out() -> None:
    true = {**TRUE, "third": THIRD_CAMERA}
    stripes = stripes_of(true)
    stripes[1] = wavy(stripes[1])
    found = agreement(stripes, true)
    assert found.usable == (True, False, True)
    assert found.distance_mm == 0
    assert "camera 'right' were left out, and those of camera 'left' and camera 'third' used" in found.notes[0]


def test_an_area_that_two_cameras_see_differently_is_taken_from_one() -> None:
    stripes = stripes_of(TRUE)
    pixels = stripes[1].points_px.copy()
    rows = np.tile(ROWS, len(COLUMNS))
    column = np.repeat(COLUMNS, len(ROWS))
    other = (rows > 96) & (rows < 144) & (column > 128) & (column < 192)
    pixels[other, 0] += 6.0
    stripes[1] = stripes[1]._replace(points_px=pixels)
    parts = [
        triangulate_camera_projector(each, camera, PROJECTOR, Axis.COLUMN)[0]
        for each, camera in zip(stripes, TRUE.values(), strict=True)
    ]
    redundancy = evaluate_redundancy(parts, TRUE, Axis.COLUMN, widest_gap_px=GAP_PX)
    assert not redundancy.pairs[0].is_contradicted
    used, notes = drop_contradicting_areas(list(TRUE), parts, redundancy, (True, True))
    lost = [1 - float(each.mean()) for each in used]
    assert max(lost) == pytest.approx(other.mean(), rel=0.6)
    assert min(lost) == 0
    assert "different surfaces in" in notes[0]

"""Test of a calibration by light of both axes, on points that OpenCV projects."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import griddata
from scipy.spatial.transform import Rotation

from slrig.model import Axis, FloatArray, Gray, LineShift, Pinhole, Size
from slrig.reconstruction import (
    CalibrationCheck,
    CalibrationFit,
    DeviceNames,
    PixelPairs,
    check_calibration,
    find_camera_pairs,
    find_cross_line_pairs,
)
from slrig.reconstruction.identification import StripeEnsemble
from tests.core import parametrize_core

CODES = Gray(Axis.COLUMN, 0, 10), Gray(Axis.ROW, 0, 9)
Turn = tuple[float, float, float]
Case = tuple[Pinhole, Pinhole, PixelPairs]
NOISE_PX = 0.05


def device(
    size: Size, focal_px: float, turn_deg: tuple[float, float, float], centre_mm: FloatArray, k1: float
) -> Pinhole:
    rotation = Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix()
    matrix = np.array([[focal_px, 0, size.width_px / 2 + 3], [0, focal_px * 1.001, size.height_px / 2 - 4], [0, 0, 1]])
    return Pinhole(size, matrix, np.array([k1, 0.02, 3e-4, -2e-4, 0.0]), rotation, -rotation @ centre_mm)


CAMERA = device(Size(640, 512), 1375.0, (0, 0, 0), np.zeros(3), -0.08)
PROJECTOR = device(Size(800, 500), 1450.0, (1, 18, 0.5), np.array([210.0, -12.0, 8.0]), 0.03)


def opencv_pixels(each: Pinhole, points_mm: FloatArray) -> FloatArray:
    vector, _ = cv2.Rodrigues(each.rotation)
    pixels, _ = cv2.projectPoints(points_mm, vector, each.translation_mm, each.matrix, each.distortion)
    return np.asarray(pixels[:, 0], dtype=np.float64)


@pytest.fixture(scope="module")
def pairs() -> PixelPairs:
    """Pixels of a wavy surface 600 mm away that both devices image, with noise of the row."""
    random = np.random.default_rng(7)
    x, y = random.uniform(-130, 130, 3000), random.uniform(-100, 100, 3000)
    points = np.column_stack([x, y, 620 + 25 * np.sin(x / 40) * np.cos(y / 30)])
    camera, light = opencv_pixels(CAMERA, points), opencv_pixels(PROJECTOR, points)
    inside = (light > 1).all(axis=1) & (light < (798, 498)).all(axis=1) & (camera > 1).all(axis=1)
    inside &= (camera < (638, 510)).all(axis=1)
    light[:, 1] += random.normal(0, NOISE_PX, len(light))
    assert inside.sum() > 2000
    return PixelPairs(camera[inside], light[inside], np.full(inside.sum(), NOISE_PX), Axis.COLUMN)


def turned(each: Pinhole, degrees: Turn) -> Pinhole:
    rotation = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix() @ each.rotation
    return replace(each, rotation=rotation, translation_mm=-rotation @ each.centre_mm)


def inverse_pose(each: Pinhole) -> Pinhole:
    return replace(each, rotation=each.rotation.T, translation_mm=-each.rotation.T @ each.translation_mm)


def checked(case: Case) -> CalibrationCheck:
    found = check_calibration(*case, CODES)
    assert found is not None
    return found


def test_right_calibration_agrees(pairs: PixelPairs) -> None:
    found = checked((CAMERA, PROJECTOR, pairs))

    assert not found.is_refuted
    assert found.median_px < 2 * NOISE_PX
    assert found.systematic_px < 0.01
    assert not found.is_significant


@pytest.mark.parametrize(
    "degrees",
    [(0, 0.05, 0), (0, 0, 0.2), *(pytest.param(each, marks=pytest.mark.slow) for each in ((0, 0.15, 0), (0.1, 0, 0)))],
)
def test_small_turn_of_projector_is_measured(pairs: PixelPairs, degrees: Turn) -> None:
    found = checked((CAMERA, turned(PROJECTOR, degrees), pairs))

    assert not found.is_refuted
    assert found.is_significant
    assert found.explained is not None
    assert found.explained.turned_deg == pytest.approx(max(degrees), rel=0.15)
    assert found.explained.residual_px < 2 * NOISE_PX


def test_displacement_is_that_of_the_true_surface(pairs: PixelPairs) -> None:
    wrong = turned(PROJECTOR, (0, 0.1, 0))
    found = checked((CAMERA, wrong, pairs))
    # Points by the wrong calibration: where the camera ray meets the sheet of light of the wrong projector.
    x, y = np.meshgrid(np.linspace(-80, 80, 9), np.linspace(-60, 60, 7))
    truth = np.column_stack([x.ravel(), y.ravel(), 620 + 25 * np.sin(x / 40).ravel() * np.cos(y / 30).ravel()])
    column = opencv_pixels(PROJECTOR, truth)[:, 0]
    near, far = np.full(len(truth), 0.7), np.full(len(truth), 1.3)
    rising = opencv_pixels(wrong, truth * far[:, None])[:, 0] > opencv_pixels(wrong, truth * near[:, None])[:, 0]
    for _ in range(60):
        middle = (near + far) / 2
        beyond = (opencv_pixels(wrong, truth * middle[:, None])[:, 0] > column) == rising
        near, far = np.where(beyond, near, middle), np.where(beyond, middle, far)
    measured = truth * near[:, None]

    assert found.explained is not None
    implied = found.explained.displacement_mm(measured, Axis.COLUMN)

    error_mm = np.linalg.norm(measured - truth, axis=1)
    assert np.median(error_mm) > 1
    assert np.linalg.norm(measured + implied - truth, axis=1).max() < 0.15 * np.median(error_mm)


def mirrored(pairs: PixelPairs) -> FloatArray:
    return np.column_stack([639 - pairs.camera_px[:, 0], pairs.camera_px[:, 1]])


def exchanged_bits(pairs: PixelPairs) -> FloatArray:
    """Bits 3 and 6 of 10 of the columns."""
    column = np.floor(pairs.projector_px[:, 0] + 0.5).astype(int)
    word = column ^ (column >> 1)
    a, b = 1 << 7, 1 << 4
    word = np.where(((word & a) > 0) != ((word & b) > 0), word ^ (a | b), word)
    for shift in (1, 2, 4, 8):
        word ^= word >> shift
    return np.column_stack([word, pairs.projector_px[:, 1]])


MIDDLE = np.array([399.5, 249.5])


MISTAKES: dict[str, tuple[Callable[[PixelPairs], Case], str]] = {
    "inverse pose": (lambda p: (CAMERA, inverse_pose(PROJECTOR), p), "the inverse pose"),
    "lenses exchanged": (
        lambda p: (
            replace(CAMERA, matrix=PROJECTOR.matrix, distortion=PROJECTOR.distortion),
            replace(PROJECTOR, matrix=CAMERA.matrix, distortion=CAMERA.distortion),
            p,
        ),
        "the lenses of camera and projector are exchanged",
    ),
    "projector turned": (lambda p: (CAMERA, turned(PROJECTOR, (2, 1, -2)), p), "another pose relative to the camera"),
    "picture mirrored": (lambda p: (CAMERA, PROJECTOR, replace(p, camera_px=mirrored(p))), "mirrored left to right"),
    "picture upside down": (
        lambda p: (CAMERA, PROJECTOR, replace(p, camera_px=np.array([639, 511]) - p.camera_px)),
        "turned by 180°",
    ),
    "picture halved": (
        lambda p: (CAMERA, PROJECTOR, replace(p, camera_px=(p.camera_px + 0.5) / 2 - 0.5)),
        "another resolution than its matrix: × 0.500",
    ),
    "picture cropped": (
        lambda p: (CAMERA, PROJECTOR, replace(p, camera_px=p.camera_px - np.array([60, 35]))),
        "shifted by -60, -35 px",
    ),
    "code with an offset": (
        lambda p: (CAMERA, PROJECTOR, replace(p, projector_px=p.projector_px + np.array([112, 6]))),
        "projected code is shifted by 112, 6 px",
    ),
    "overscan": (
        lambda p: (CAMERA, PROJECTOR, replace(p, projector_px=(p.projector_px - MIDDLE) / 1.05 + MIDDLE)),
        "shows its picture × 1.050 as large about its middle: overscan",
    ),
    "bits exchanged": (
        lambda p: (CAMERA, PROJECTOR, replace(p, projector_px=exchanged_bits(p))),
        "bits 3 and 6 of 10 of the column code are exchanged",
    ),
}


@parametrize_core("mistake", MISTAKES)
def test_mistake_refutes_the_calibration_and_is_named(pairs: PixelPairs, mistake: str) -> None:
    make, cause = MISTAKES[mistake]

    found = checked(make(pairs))

    assert found.is_refuted
    assert cause in found.cause


@pytest.mark.slow
def test_unrelated_pixels_are_refuted_without_a_cause(pairs: PixelPairs) -> None:
    order = np.random.default_rng(1).permutation(len(pairs))

    found = checked((CAMERA, PROJECTOR, replace(pairs, projector_px=pairs.projector_px[order])))

    assert found.is_refuted
    assert found.cause == ""


def test_few_pixels_say_nothing(pairs: PixelPairs) -> None:
    assert check_calibration(CAMERA, PROJECTOR, pairs.take(slice(0, 50)), CODES) is None


LINES = LineShift(Axis.ROW, 0, 32, 16)


@pytest.fixture(scope="module")
def crossed_stripes() -> tuple[StripeEnsemble, NDArray[np.float32]]:
    """Stripes of every tenth column on a slanted plane, and the image of lines along the rows, from -1 to 1."""
    columns, rows = np.arange(40.0, 760, 10), np.arange(20.0, 480, 0.8)
    light = np.stack(np.meshgrid(columns, rows, indexing="ij"), axis=-1).reshape(-1, 2)
    rays = cv2.undistortPoints(light[:, None], PROJECTOR.matrix, PROJECTOR.distortion)[:, 0]
    rays = np.column_stack([rays, np.ones(len(rays))]) @ PROJECTOR.rotation
    normal, centre = np.array([0.2, -0.1, 1.0]), PROJECTOR.centre_mm
    points = centre + rays * ((620 - normal @ centre) / (rays @ normal))[:, None]
    pixels = opencv_pixels(CAMERA, points)
    inside = ((pixels > 4) & (pixels < (635, 507))).all(axis=1)
    light, pixels = light[inside], pixels[inside]
    y, x = np.mgrid[:512, :640]
    row = griddata(pixels, light[:, 1], (x, y), method="linear")
    image = np.nan_to_num(np.tanh(3 * np.sin(np.pi * (row + 0.5) / 16))).astype(np.float32)
    counts = np.array([np.count_nonzero(light[:, 0] == each) for each in columns])
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    count, nothing = len(pixels), np.zeros(len(pixels))
    stripes = StripeEnsemble(
        offsets, columns, pixels, np.zeros((count, 2)), nothing, nothing.astype(np.int32), nothing > 0
    )  # fmt: skip
    return stripes, image


def checked_by_one_frame(
    stripes: tuple[StripeEnsemble, NDArray[np.float32]], projector: Pinhole
) -> tuple[PixelPairs, CalibrationCheck]:
    found = find_cross_line_pairs(*stripes, LINES, CAMERA, projector)
    check = check_calibration(CAMERA, projector, found, CODES[:1])
    assert check is not None
    return found, check


def test_one_frame_of_rows_agrees_with_the_right_calibration(
    crossed_stripes: tuple[StripeEnsemble, NDArray[np.float32]],
) -> None:
    found, check = checked_by_one_frame(crossed_stripes, PROJECTOR)

    assert len(found) > 1000
    assert not check.is_refuted
    assert not check.is_significant
    assert check.median_px < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wrong", "cause"),
    [
        pytest.param(inverse_pose(PROJECTOR), "the inverse pose", marks=pytest.mark.slow),
        (turned(PROJECTOR, (2, 1, -2)), "another pose relative to the camera"),
    ],
    ids=["inverse pose", "turned"],
)
def test_one_frame_of_rows_refutes_a_wrong_calibration(
    crossed_stripes: tuple[StripeEnsemble, NDArray[np.float32]], wrong: Pinhole, cause: str
) -> None:
    _, check = checked_by_one_frame(crossed_stripes, wrong)

    assert check.is_refuted
    assert cause in check.cause


def test_one_frame_of_rows_shows_a_small_turn(crossed_stripes: tuple[StripeEnsemble, NDArray[np.float32]]) -> None:
    _, check = checked_by_one_frame(crossed_stripes, turned(PROJECTOR, (0, 0.15, 0)))

    assert not check.is_refuted
    assert check.is_significant


def test_an_error_that_the_rows_do_not_determine_refutes_nothing() -> None:
    devices = CAMERA, PROJECTOR
    fit = CalibrationFit(
        devices, *devices, turned_deg=10.4, shifted_mm=8.3, residual_px=0.22, coded_error_px=434.0,
        coded_sigma_px=453.0, is_significant=True,
    )  # fmt: skip
    found = CalibrationCheck(devices, Axis.COLUMN, 200_000, 0.47, 0.7, 0.1, fit)

    assert not found.is_refuted
    assert found.coded_error_px == 0.47
    assert replace(found, fit=replace(fit, coded_sigma_px=20.0)).is_refuted


# ---- two cameras, and a projector without a calibration

SECOND = device(Size(640, 512), 1390.0, (-1, 15, 1), np.array([180.0, 6.0, 12.0]), -0.07)
NAMES = DeviceNames.of_cameras("left", "right")


def of_a_code(camera: Pinhole, rows: FloatArray) -> PixelPairs:
    """Pixels that show a wavy surface, on stripes one projector pixel apart. rows : (n,), along each of them."""
    column, row = (each.ravel() for each in np.meshgrid(np.arange(60) + 0.5, rows, indexing="ij"))
    x, y = (column - 30) * 3, (row - 40) * 2
    pixels = opencv_pixels(camera, np.column_stack([x, y, 620 + 25 * np.sin(x / 40) * np.cos(y / 30)]))
    pixels += np.random.default_rng(3).normal(0, 0.03, pixels.shape)
    return PixelPairs(pixels, np.column_stack([column, row]), np.full(len(pixels), 0.03), Axis.COLUMN)


def pair_check(second: Pinhole, rows: FloatArray, *, is_mirrored: bool = False) -> CalibrationCheck:
    """Test a second camera, as the calibration has it, by pictures that it mirrored left to right, or not."""
    first, other = of_a_code(CAMERA, np.arange(10.0, 70.0, dtype=np.float64) + 0.5), of_a_code(SECOND, rows)
    if is_mirrored:
        other = replace(other, camera_px=mirrored(other))
    check = check_calibration(CAMERA, second, find_camera_pairs(first, other, (CAMERA, second)), (), names=NAMES)
    assert check is not None
    return check


@pytest.mark.parametrize("rows", [np.arange(80) + 0.5, np.arange(0, 80, 0.37)], ids=["crossings", "all points"])
def test_two_cameras_that_agree_need_no_calibrated_projector(rows: FloatArray) -> None:
    found = pair_check(SECOND, rows)
    assert not found.is_refuted
    assert found.pairs == 60 * 60
    assert found.median_px < 0.1


@pytest.mark.parametrize(
    ("second", "is_mirrored", "words"),
    [
        pytest.param(
            inverse_pose(SECOND),
            False,
            "the inverse pose (rotation and translation from camera 'right' to",
            marks=pytest.mark.slow,
        ),
        (turned(SECOND, (1.0, 0, 0)), False, "camera 'right' has another pose relative to camera 'left'"),
        pytest.param(SECOND, True, "the picture of camera 'right' is mirrored left to right", marks=pytest.mark.slow),
    ],
)
def test_two_cameras_refute_a_wrong_calibration_and_name_its_mistake(
    second: Pinhole, *, is_mirrored: bool, words: str
) -> None:
    found = pair_check(second, np.arange(80.0, dtype=np.float64) + 0.5, is_mirrored=is_mirrored)
    assert found.is_refuted
    assert words in found.cause
    assert "projector" not in found.cause


def test_a_residual_of_a_tenth_of_a_pixel_refutes_nothing(pairs: PixelPairs) -> None:
    """However much it means for the columns: clipped frames displace edges by so much."""
    found = checked((CAMERA, turned(PROJECTOR, (0, 0.1, 0)), pairs))
    assert found.fit is not None
    implied = replace(found.fit, coded_error_px=6.0, coded_sigma_px=0.6, is_significant=True)

    small = replace(found, median_px=0.1, systematic_px=0.02, sigma_px=0.036, fit=implied, cause="")

    assert not small.is_refuted
    assert replace(small, systematic_px=0.2).is_refuted

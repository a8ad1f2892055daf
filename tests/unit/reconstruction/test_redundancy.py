"""Redundancy of two cameras, against projections by OpenCV and a plain walk along the curves."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from slrig.model import Axis, Calibration, FloatArray, Pinhole, Size, SolveRecord, Source
from slrig.reconstruction.redundancy import (
    MAP_CELLS,
    MIN_PAIRS,
    PairRedundancy,
    StripeResiduals,
    evaluate_redundancy,
    stripe_residuals,
    summarise_pair,
)
from slrig.reconstruction.triangulation import SheetCurves, triangulate_camera_projector
from tests.unit.reconstruction.builders import (
    BALL,
    CAMERA,
    OTHER_CAMERA,
    PROJECTOR,
    ensemble_of,
    lit_rows,
    opencv_pixels,
    opencv_rays,
    seen_on_ball,
)

by_kernel = pytest.mark.slow  # which only scans by two cameras need

COLUMNS = [100.0, 120.0, 140.0, 160.0, 180.0, 200.0]
ROWS = np.arange(50.0, 190.0, 0.8)
GAP_PX = 4.0


def turned(device: Pinhole, *, degrees: tuple[float, float, float]) -> Pinhole:
    """The device turned about its own centre, by angles about its own axes."""
    x, y, z = np.radians(degrees)
    about_x = np.array([[1, 0, 0], [0, math.cos(x), -math.sin(x)], [0, math.sin(x), math.cos(x)]])
    about_y = np.array([[math.cos(y), 0, math.sin(y)], [0, 1, 0], [-math.sin(y), 0, math.cos(y)]])
    about_z = np.array([[math.cos(z), -math.sin(z), 0], [math.sin(z), math.cos(z), 0], [0, 0, 1]])
    rotation = about_x @ about_y @ about_z @ device.rotation
    return replace(device, rotation=rotation, translation_mm=-rotation @ device.centre_mm)


def normals_along(pixels: FloatArray) -> FloatArray:
    """(n, 2): across a curve, to its left as one walks it on a screen (rows go down)."""
    tangent = np.gradient(pixels, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    return np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)


def seen(
    camera: Pinhole, *, believed: Pinhole | None = None, rows: FloatArray = ROWS, noise_px: float = 0.0, seed: int = 0
) -> SheetCurves:
    """What a camera triangulates of the ball with the pose it is believed to have."""
    stripes = seen_on_ball(camera, COLUMNS, rows, sigma_px=noise_px or 0.01, noise_px=noise_px, seed=seed)
    return triangulate_camera_projector(stripes, believed or camera, PROJECTOR, Axis.COLUMN)[0]


def both(first: SheetCurves, second: SheetCurves, *, other: Pinhole = OTHER_CAMERA) -> StripeResiduals:
    return stripe_residuals(first, second, other, Axis.COLUMN, widest_gap_px=GAP_PX)


@by_kernel
def test_the_residual_of_a_good_calibration_is_its_stated_noise() -> None:
    rows = ROWS + 0.001
    spare = both(seen(CAMERA, noise_px=0.03, seed=1), seen(OTHER_CAMERA, rows=rows, noise_px=0.05, seed=2))
    count = len(spare.residual_px)
    assert abs(spare.residual_px.mean()) < 4 * spare.residual_px.std() / math.sqrt(count)
    # Rows all but meet, so that a point of the other camera is one point, not the mean of two.
    assert np.sqrt(np.mean((spare.residual_px / spare.sigma_px) ** 2)) == pytest.approx(1.0, abs=0.06)
    assert (spare.sigma_px > 0.05).all()


@by_kernel
@pytest.mark.parametrize("degrees", [(0.0, 0.05, 0.0), (0.0, 0.0, 0.05), (0.05, 0.0, 0.0)])
def test_a_turned_second_camera_shows_as_the_shift_of_its_image(degrees: tuple[float, float, float]) -> None:
    # The oracle: where truth is seen, less where the turned camera is believed to see it, across the stripe.
    believed = turned(OTHER_CAMERA, degrees=degrees)
    spare = both(seen(CAMERA), seen(OTHER_CAMERA, believed=believed), other=believed)
    wanted = []
    for column in COLUMNS:
        truth = lit_rows(column, ROWS, BALL)
        found, expected = opencv_pixels(OTHER_CAMERA, truth), opencv_pixels(believed, truth)
        wanted.append(((found - expected) * normals_along(found)).sum(axis=1))
    predicted = np.concatenate(wanted)
    assert spare.residual_px.mean() == pytest.approx(predicted.mean(), rel=0.02, abs=2e-3)
    assert spare.residual_px.std() == pytest.approx(predicted.std(), rel=0.1, abs=5e-3)


@by_kernel
def test_the_sign_is_that_of_rising_columns_however_the_stripes_were_found() -> None:
    # A second camera on its side: its stripes lie along its rows, and columns rise upwards or downwards.
    for roll in (90.0, 180.0, -90.0):
        rolled = turned(OTHER_CAMERA, degrees=(0.0, 0.0, roll))
        lifted = turned(rolled, degrees=(0.0, 0.05, 0.0) if abs(roll) == 180 else (0.05, 0.0, 0.0))
        spare = both(seen(CAMERA), seen(rolled, believed=lifted), other=lifted)
        middle = lit_rows(150.0, np.array([120.0]), BALL)
        higher = lit_rows(151.0, np.array([120.0]), BALL)
        rising = (opencv_pixels(rolled, higher) - opencv_pixels(rolled, middle))[0]
        shift = (opencv_pixels(rolled, middle) - opencv_pixels(lifted, middle))[0]
        assert np.sign(spare.residual_px.mean()) == np.sign(rising @ shift)
        assert abs(spare.residual_px.mean()) > 0.8


@by_kernel
def test_rows_of_light_count_towards_higher_rows() -> None:
    columns = [60.0, 100.0, 140.0]
    along = np.arange(60.0, 200.0, 0.8)
    above = turned(OTHER_CAMERA, degrees=(0.05, 0.0, 0.0))

    def rows_seen(camera: Pinhole, believed: Pinhole) -> SheetCurves:
        lit = [lit_row(row, along) for row in columns]
        pixels = [opencv_pixels(camera, each) for each in lit]
        return triangulate_camera_projector(
            ensemble_of(pixels, columns, normal=(0.0, 1.0)), believed, PROJECTOR, Axis.ROW
        )[0]

    spare = stripe_residuals(
        rows_seen(CAMERA, CAMERA), rows_seen(OTHER_CAMERA, above), above, Axis.ROW, widest_gap_px=GAP_PX
    )
    point = lit_row(100.0, along[:1])
    shift = (opencv_pixels(OTHER_CAMERA, point) - opencv_pixels(above, point))[0]
    # Rows rise downwards in the image, as y does.
    assert spare.residual_px.mean() == pytest.approx(shift[1], rel=0.1)


def lit_row(row_px: float, columns_px: FloatArray) -> FloatArray:
    """(n, 3) float64: points of the ball lit by one projector row."""
    pixels = np.column_stack([columns_px, np.full(len(columns_px), row_px)])
    return BALL.seen_along(PROJECTOR.centre_mm, opencv_rays(PROJECTOR, pixels))


@by_kernel
def test_points_on_a_gap_of_the_other_camera_have_no_partner() -> None:
    gap = (ROWS > 100) & (ROWS < 120)
    spare = both(seen(CAMERA), seen(OTHER_CAMERA, rows=ROWS[~gap]))
    whole = both(seen(CAMERA), seen(OTHER_CAMERA))
    assert len(whole.residual_px) - len(spare.residual_px) == pytest.approx(len(COLUMNS) * gap.sum(), abs=12)
    assert np.abs(spare.residual_px).max() < 1e-3


@by_kernel
def test_sheets_of_a_single_camera_are_left_out() -> None:
    first, second = seen(CAMERA), seen(OTHER_CAMERA)
    apart = replace(second, position_px=second.position_px + 1)
    assert len(both(first, apart).residual_px) == 0
    found = evaluate_redundancy(
        [first, apart], {"left": CAMERA, "right": OTHER_CAMERA}, Axis.COLUMN, widest_gap_px=GAP_PX
    )
    assert found.pairs == ()
    assert found.reason == "the cameras share no point of any light sheet"


def figures(residual: FloatArray, pixels: FloatArray, sigma: float = 0.02) -> PairRedundancy:
    return summarise_pair(residuals_of(residual, pixels, sigma), "left", "right", Size(600, 480))


def residuals_of(residual: FloatArray, pixels: FloatArray, sigma: float = 0.02) -> StripeResiduals:
    """Residuals where the projector's pixels are the camera's."""
    count = len(residual)
    return StripeResiduals(
        residual, np.full(count, sigma), pixels, pixels, np.arange(count), np.tile([1.0, 0.0], (count, 1))
    )


def test_the_map_has_each_cell_of_the_reference_image() -> None:
    rng = np.random.default_rng(5)
    pixels = rng.uniform([-0.5, -0.5], [599.5, 479.5], (20_000, 2))
    cell = np.stack([(pixels[:, 1] + 0.5) // 80, (pixels[:, 0] + 0.5) // 100], axis=1).astype(int)
    residual = 0.1 * cell[:, 0] + 0.01 * cell[:, 1] + rng.normal(0, 0.02, len(cell))
    kept = ~((cell[:, 0] == 2) & (cell[:, 1] == 3)) | (np.cumsum((cell == (2, 3)).all(axis=1)) < MIN_PAIRS)
    made = figures(residual[kept], pixels[kept])
    assert made.outlying == 0
    for row in range(MAP_CELLS):
        for column in range(MAP_CELLS):
            mine = residual[kept & (cell == (row, column)).all(axis=1)]
            assert made.map_pairs[row, column] == len(mine)
            if (row, column) == (2, 3):
                assert len(mine) == MIN_PAIRS - 1
                assert np.isnan(made.map_mean_px[row, column])
                assert np.isnan(made.map_rms_px[row, column])
            else:
                assert made.map_mean_px[row, column] == pytest.approx(mine.mean())
                assert made.map_rms_px[row, column] == pytest.approx(np.sqrt((mine**2).mean()))
    assert made.pairs == made.map_pairs.sum() == kept.sum()
    assert made.mean_px == pytest.approx(residual[kept].mean())
    assert made.rms_px == pytest.approx(np.sqrt((residual[kept] ** 2).mean()))
    assert made.median_absolute_px == pytest.approx(np.median(np.abs(residual[kept])))
    assert made.stated_rms_px == pytest.approx(0.02)


def test_points_of_two_different_things_are_counted_and_left_out() -> None:
    rng = np.random.default_rng(6)
    residual = rng.normal(0.5, 0.02, 1000)
    residual[:7] = 3.0
    made = figures(residual, np.tile([300.0, 200.0], (1000, 1)))
    assert (made.outlying, made.pairs) == (7, 993)
    assert made.mean_px == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(
    ("noise_px", "offset_px", "calibration_px", "contradicted"),
    [
        (0.02, 0.0, 0.0, False),
        (0.2, 0.0, 0.0, False),  # noise that is ten times as large as stated is no contradiction
        (0.02, 0.1, 0.0, True),
        (0.2, 0.1, 0.0, False),  # and an offset far below it makes no difference
        (0.2, 1.0, 0.0, True),
        (0.02, 0.1, 0.1, False),  # nor one that the calibration states
        (3.0, 40.0, 0.0, True),  # what scatters by more than half a pixel is not noise
    ],
)
def test_cameras_contradict_each_other_by_the_median_of_areas(
    noise_px: float, offset_px: float, calibration_px: float, contradicted: bool
) -> None:
    rng = np.random.default_rng(3)
    pixels = rng.uniform(0, 200, (20_000, 2))
    # The offset changes its sign over the image, so that the mean of all shows nothing.
    residual = rng.normal(0, noise_px, len(pixels)) + offset_px * np.where(pixels[:, 0] > 100, 1.0, -1.0)
    found = summarise_pair(
        residuals_of(residual, pixels), "left", "right", Size(200, 200), calibration_px=calibration_px
    )
    assert found.is_contradicted == contradicted
    stated = np.hypot(0.02, calibration_px)
    assert found.over_stated == pytest.approx(1.4826 * np.median(np.abs(residual)) / stated)


def test_few_common_points_contradict_nothing() -> None:
    assert figures(np.full(99, 5.0), np.full((99, 2), 8.0)).contradiction == 0
    assert figures(np.full(101, 5.0), np.full((101, 2), 8.0)).is_contradicted


@by_kernel
def test_the_calibrations_part_of_a_residual_is_that_of_its_covariance() -> None:
    # The second camera's place and the projector's focal length, each with its oracle: the residuals with that
    # parameter changed by its standard deviation.
    sigmas = {15 + 12: 0.3, 30: 0.7}
    covariance = np.diag([sigmas.get(index, 0.0) ** 2 for index in range(45)])
    box = np.array([[-60.0, -60.0, -10.0], [60.0, 60.0, 40.0]])
    solved = SolveRecord("it", "2026-01-01T00:00:00+00:00", covariance, box, 0.1)
    devices = {"left": CAMERA, "right": OTHER_CAMERA}
    found = evaluate_redundancy(
        [seen(CAMERA), seen(OTHER_CAMERA)], devices, Axis.COLUMN, widest_gap_px=GAP_PX,
        calibration=Calibration(devices, PROJECTOR, solved),
    ).pairs[0]  # fmt: skip
    moved = replace(OTHER_CAMERA, translation_mm=OTHER_CAMERA.translation_mm + np.array([0.3, 0.0, 0.0]))
    zoomed = replace(PROJECTOR, matrix=PROJECTOR.matrix + np.diag([0.7, 0.0, 0.0]))
    through_zoomed = (
        triangulate_camera_projector(seen_on_ball(camera, COLUMNS, ROWS), camera, zoomed, Axis.COLUMN)[0]
        for camera in (CAMERA, OTHER_CAMERA)
    )
    changed = [
        both(seen(CAMERA), seen(OTHER_CAMERA), other=moved),
        both(*through_zoomed),
    ]
    wanted = math.hypot(*(float(np.median(np.abs(each.residual_px))) for each in changed))
    assert wanted > 0.3
    assert found.calibration_px == pytest.approx(wanted, rel=0.1)


@by_kernel
def test_without_redundancy_the_reason_is_stated() -> None:
    part = seen(CAMERA)
    alone = evaluate_redundancy([part], {"left": CAMERA}, Axis.COLUMN, widest_gap_px=GAP_PX)
    assert alone.pairs == ()
    assert "one camera" in (alone.reason or "")
    stereo = replace(part, source=np.full(len(part.source), Source.CAMERA_CAMERA, dtype=np.uint8))
    devices = {"left": CAMERA, "right": OTHER_CAMERA}
    spent = evaluate_redundancy([stereo], devices, Axis.COLUMN, widest_gap_px=GAP_PX)
    assert spent.pairs == ()
    assert "projector is not calibrated" in (spent.reason or "")


@by_kernel
def test_three_cameras_make_three_pairs() -> None:
    third = turned(CAMERA, degrees=(0.0, 0.0, 3.0))
    devices = {"left": CAMERA, "right": OTHER_CAMERA, "third": third}
    parts = [seen(device) for device in devices.values()]
    found = evaluate_redundancy(parts, devices, Axis.COLUMN, widest_gap_px=GAP_PX)
    assert [(pair.reference, pair.camera) for pair in found.pairs] == [
        ("left", "right"), ("left", "third"), ("right", "third"),
    ]  # fmt: skip
    assert found.reason is None
    for pair in found.pairs:
        assert abs(pair.mean_px) < 1e-3
        assert pair.rms_px < 1e-3

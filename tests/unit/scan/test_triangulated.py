"""Which pair of cameras is triangulated without a projector, and what is said of points that are left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slrig.model import Axis, FloatArray, Pinhole, Refusal
from slrig.reconstruction.camera import CameraCurves
from slrig.reconstruction.linking import StripeEnsemble
from slrig.reconstruction.noise import NoiseModel
from slrig.scan.stream import CameraResult
from slrig.scan.triangulated import triangulated, widest_gap_px
from tests.unit.reconstruction.builders import (
    CAMERA,
    OTHER_CAMERA,
    PROJECTOR,
    Sphere,
    ensemble_of,
    lit_rows,
    looking,
    opencv_pixels,
)

ABOVE = looking(
    (-85.0, 240.0, -480.0), (0.0, 0.0, 0.0), size=CAMERA.size, focal_px=(1380.0, 1390.0),
    distortion=(-0.15, 0.05, -5e-4, 6e-4, 0.0),
)  # fmt: skip
BALL = Sphere()
COLUMNS = [140.0, 150.0, 160.0, 170.0]


def curves_in(camera: Pinhole, rows: FloatArray, projector: Pinhole = PROJECTOR) -> StripeEnsemble:
    """Columns on the ball at some rows, with the normals that they have in this image."""
    pixels, ahead = (
        [opencv_pixels(camera, lit_rows(column, lit, BALL, projector=projector)) for column in COLUMNS]
        for lit in (rows, rows + 0.01)
    )
    tangents = np.concatenate(ahead) - np.concatenate(pixels)
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    normals = np.stack([tangents[:, 1], -tangents[:, 0]], axis=1)
    return ensemble_of(pixels, COLUMNS)._replace(normals=normals)


def seen(name: str, device: Pinhole, ensemble: StripeEnsemble) -> CameraResult:
    curves = CameraCurves(
        ensemble=ensemble,
        refusal=np.zeros(device.size.shape, dtype=np.uint8),
        noise=NoiseModel(1.0, 0.0),
        scale_px=1.0,
        decoded_pixels=1,
        stripe_points=len(ensemble.points_px),
        stripe_count=len(COLUMNS),
        refined=True,
        disagreement_px=np.zeros(0),
    )
    white, contrast, clipped = (np.zeros(device.size.shape, dtype=kind) for kind in (np.uint16, np.float32, np.bool_))
    return CameraResult(name, device, curves, white, contrast, clipped, 255.0)


FEW, MANY = np.arange(100.0, 140.0, 1.5), np.arange(80.0, 160.0, 1.5)


def test_a_pair_along_the_stripes_is_passed_over_however_many_points_it_gives() -> None:
    first = seen("first", CAMERA, curves_in(CAMERA, MANY))
    beside = seen("beside", OTHER_CAMERA, curves_in(OTHER_CAMERA, FEW))
    above = seen("above", ABOVE, curves_in(ABOVE, MANY))
    found = triangulated([first, above, beside], None, Axis.COLUMN)
    assert found.second == 2
    assert found.share_across > 0.9
    assert np.abs(BALL.distance_mm(found.joined.curves.points_mm)).max() < 0.01
    assert triangulated([first, above], None, Axis.COLUMN).share_across < 0.2


def test_of_pairs_across_the_stripes_the_one_with_most_points_is_used() -> None:
    first = seen("first", CAMERA, curves_in(CAMERA, MANY))
    few = seen("few", OTHER_CAMERA, curves_in(OTHER_CAMERA, FEW))
    many = seen("many", OTHER_CAMERA, curves_in(OTHER_CAMERA, MANY))
    assert triangulated([first, few, many], None, Axis.COLUMN).second == 2
    assert triangulated([first, many, few], None, Axis.COLUMN).second == 1


def test_points_left_out_are_refused_pixels_with_their_own_cause() -> None:
    rows = np.arange(60.0, 180.0, 5.0)
    straight = replace(PROJECTOR, distortion=np.zeros(5))
    ensemble = curves_in(CAMERA, rows, straight)
    off = rows >= 120 + 2
    ahead = int(np.count_nonzero(~off))
    # A column far to the wrong side, in a pixel away from all others.
    aside = ensemble.points_px[:1] + np.array([[-150.0, 0.0]])
    with_behind = ensemble_of(
        [*np.split(ensemble.points_px, ensemble.offsets[1:-1]), aside], [*COLUMNS, 2500.0]
    )  # fmt: skip
    cut = replace(straight, size=replace(straight.size, height_px=121))
    found = triangulated([seen("only", CAMERA, with_behind)], cut, Axis.COLUMN)
    (camera,) = found.cameras
    assert len(found.joined.curves.points_mm) == len(COLUMNS) * ahead
    refusal = camera.curves.refusal
    columns, lines = np.rint(aside).astype(int).T
    assert refusal[lines, columns].tolist() == [Refusal.BEHIND_DEVICE]
    columns, lines = np.rint(ensemble.points_px).astype(int).T
    expected = np.tile(np.where(off, Refusal.OFF_PROJECTOR, Refusal.NONE), len(COLUMNS))
    assert refusal[lines, columns].tolist() == expected.tolist()
    assert np.count_nonzero(refusal) == 1 + np.count_nonzero(expected)


@pytest.mark.parametrize("first", ["above", "beside"])
def test_a_camera_that_sees_the_sheets_edge_on_is_left_out(first: str) -> None:
    x, y, z = PROJECTOR.centre_mm
    above = looking(
        (x + 5.0, y - 240.0, z), (0.0, 0.0, 0.0), size=CAMERA.size, focal_px=(1380.0, 1390.0), distortion=(0.0,) * 5
    )
    cameras = [seen("above", above, curves_in(above, MANY)), seen("beside", CAMERA, curves_in(CAMERA, FEW))]
    found = triangulated(cameras if first == "above" else cameras[::-1], PROJECTOR, Axis.COLUMN)
    assert len(found.joined.curves.points_mm) == len(FEW) * len(COLUMNS)
    assert np.abs(BALL.distance_mm(found.joined.curves.points_mm)).max() < 0.01
    refused = {each.name: set(np.unique(each.curves.refusal)) for each in found.cameras}
    assert refused == {"above": {Refusal.NONE, Refusal.SHEET_SEEN_ALONG}, "beside": {Refusal.NONE}}
    (alone,) = triangulated(cameras[:1], PROJECTOR, Axis.COLUMN).cameras
    assert not alone.curves.refusal.any()


@pytest.mark.parametrize("axis", list(Axis))
def test_with_a_projector_the_crossing_is_that_of_the_calibration(axis: Axis) -> None:
    found = triangulated([seen("only", CAMERA, curves_in(CAMERA, FEW))], PROJECTOR, axis)
    beside, above, _ = PROJECTOR.rotation @ (CAMERA.centre_mm - PROJECTOR.centre_mm)
    across = beside if axis is Axis.COLUMN else above
    assert found.share_across == pytest.approx(abs(across) / np.hypot(beside, above))


@pytest.mark.parametrize(("axis", "gap_px"), [(Axis.COLUMN, 8.0), (Axis.ROW, 4.0)])
def test_a_gap_is_as_wide_on_the_surface_where_rows_are_finer(axis: Axis, gap_px: float) -> None:
    fine_rows = replace(PROJECTOR, matrix=np.array([[700.0, 0, 160], [0, 1400.0, 240], [0, 0, 1]]))
    assert widest_gap_px(fine_rows, axis) == gap_px
    square = replace(PROJECTOR, matrix=np.array([[700.0, 0, 160], [0, 700.0, 120], [0, 0, 1]]))
    assert widest_gap_px(square, axis) == 4.0

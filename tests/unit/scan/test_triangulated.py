"""Which cameras are triangulated, what is said of points that are left out, and how the others are coloured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slrig.meshing.surface import compact_mesh
from slrig.model import AlbedoMark, Axis, Calibration, FloatArray, Mesh, NoiseModel, Pinhole, Refusal, Size
from slrig.reconstruction.identification import StripeEnsemble
from slrig.reconstruction.pipeline import CameraCurves
from slrig.reconstruction.triangulation import triangulate_camera_projector
from slrig.scan.measured import Triangulated, triangulate_cameras, widest_gap_px
from slrig.scan.pictures import Coloured, albedo_report, coloured
from slrig.scan.reconstruct import covered_share, with_uncovered_refused
from slrig.scan.stream import CameraResult
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


def triangulate(cameras: list[CameraResult], projector: Pinhole | None, axis: Axis) -> Triangulated:
    return triangulate_cameras(cameras, Calibration({each.name: each.device for each in cameras}, projector), axis)


FEW, MANY = np.arange(100.0, 140.0, 1.5), np.arange(80.0, 160.0, 1.5)


def test_the_gap_that_counts_as_seen_is_wider_where_a_camera_pixel_covers_many_rows() -> None:
    def gap_px(row_px: float) -> float:
        part, _ = triangulate_camera_projector(
            curves_in(CAMERA, np.arange(80.0, 160.0, row_px)), CAMERA, PROJECTOR, Axis.COLUMN
        )
        return widest_gap_px(PROJECTOR, Axis.COLUMN, [part])

    assert gap_px(1.5) == pytest.approx(widest_gap_px(PROJECTOR, Axis.COLUMN, []))
    assert gap_px(12.0) == pytest.approx(30.0, rel=0.05)


def test_decoded_pixels_outside_the_mesh_are_refused_for_that() -> None:
    at = Size(40, 30)
    device = looking((0.0, 0.0, -500.0), (0.0, 0.0, 0.0), size=at, focal_px=(100.0, 100.0), distortion=(0,) * 5)
    camera = seen("left", device, curves_in(CAMERA, FEW))
    refusal = np.zeros(at.shape, dtype=np.uint8)
    refusal[:, :10] = Refusal.NOT_LIT
    refusal[10:20, 15:25] = Refusal.SHADOW_EDGE
    camera = replace(camera, curves=replace(camera.curves, refusal=refusal))
    corners = np.array([[-500.0, -500.0, 0.0], [0.0, -500.0, 0.0], [0.0, 500.0, 0.0], [-500.0, 500.0, 0.0]])
    unseen = np.zeros((4, 3), dtype=np.float32)
    mesh = compact_mesh(
        np.array([[0, 2, 1], [0, 3, 2]], dtype=np.int32), corners, unseen, unseen.astype(np.uint8),
        np.zeros(4, dtype=np.uint8), np.ones(4), np.array([0, 4], dtype=np.int32), np.zeros(1),
    )  # fmt: skip
    marked = with_uncovered_refused(mesh, camera)
    expected = refusal.copy()
    right = np.arange(at.width_px) > 19.5
    expected[:, right] = np.where(refusal[:, right] == Refusal.NONE, Refusal.NO_SURFACE, refusal[:, right])
    np.testing.assert_array_equal(marked.curves.refusal, expected)
    assert covered_share(marked) == (expected == Refusal.NONE).sum() / (refusal == Refusal.NONE).sum()
    nothing = replace(camera, curves=replace(camera.curves, refusal=np.full_like(refusal, Refusal.NOT_LIT)))
    assert covered_share(nothing) is None


@pytest.mark.slow
def test_a_pair_along_the_stripes_is_passed_over_however_many_points_it_gives() -> None:
    first = seen("first", CAMERA, curves_in(CAMERA, MANY))
    beside = seen("beside", OTHER_CAMERA, curves_in(OTHER_CAMERA, FEW))
    above = seen("above", ABOVE, curves_in(ABOVE, MANY))
    found = triangulate([first, above, beside], None, Axis.COLUMN)
    assert found.second == 2
    assert found.baseline_sine > 0.9
    assert np.abs(BALL.distance_mm(found.merged.curves.points_mm)).max() < 0.01
    assert triangulate([first, above], None, Axis.COLUMN).baseline_sine < 0.2


@pytest.mark.slow
def test_of_pairs_across_the_stripes_the_one_with_most_points_is_used() -> None:
    first = seen("first", CAMERA, curves_in(CAMERA, MANY))
    few = seen("few", OTHER_CAMERA, curves_in(OTHER_CAMERA, FEW))
    many = seen("many", OTHER_CAMERA, curves_in(OTHER_CAMERA, MANY))
    assert triangulate([first, few, many], None, Axis.COLUMN).second == 2
    assert triangulate([first, many, few], None, Axis.COLUMN).second == 1


@pytest.mark.slow
def test_points_without_a_partner_in_the_other_camera_have_their_cause() -> None:
    first = seen("first", CAMERA, curves_in(CAMERA, MANY))
    found = triangulate([first, seen("other", OTHER_CAMERA, curves_in(OTHER_CAMERA, FEW))], None, Axis.COLUMN)
    columns, lines = np.rint(first.curves.ensemble.points_px).astype(int).T
    inside = np.tile((FEW[0] + 3 < MANY) & (FEW[-1] - 3 > MANY), len(COLUMNS))
    outside = np.tile((FEW[0] - 3 > MANY) | (FEW[-1] + 3 < MANY), len(COLUMNS))
    causes = found.cameras[0].curves.refusal[lines, columns]
    assert set(causes[inside].tolist()) == {Refusal.NONE}
    assert set(causes[outside].tolist()) == {Refusal.ONE_CAMERA_ONLY}
    (note,) = found.notes
    assert "of the points of camera 'first' have no partner in camera 'other'" in note


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
    found = triangulate([seen("only", CAMERA, with_behind)], cut, Axis.COLUMN)
    (camera,) = found.cameras
    assert len(found.merged.curves.points_mm) == len(COLUMNS) * ahead
    refusal = camera.curves.refusal
    columns, lines = np.rint(aside).astype(int).T
    assert refusal[lines, columns].tolist() == [Refusal.BEHIND_DEVICE]
    columns, lines = np.rint(ensemble.points_px).astype(int).T
    expected = np.tile(np.where(off, Refusal.OFF_PROJECTOR, Refusal.NONE), len(COLUMNS))
    assert refusal[lines, columns].tolist() == expected.tolist()
    assert np.count_nonzero(refusal) == 1 + np.count_nonzero(expected)


@pytest.mark.slow
@pytest.mark.parametrize("first", ["above", "beside"])
def test_a_camera_that_sees_the_sheets_edge_on_is_left_out(first: str) -> None:
    x, y, z = PROJECTOR.centre_mm
    above = looking(
        (x + 5.0, y - 240.0, z), (0.0, 0.0, 0.0), size=CAMERA.size, focal_px=(1380.0, 1390.0), distortion=(0.0,) * 5
    )
    cameras = [seen("above", above, curves_in(above, MANY)), seen("beside", CAMERA, curves_in(CAMERA, FEW))]
    found = triangulate(cameras if first == "above" else cameras[::-1], PROJECTOR, Axis.COLUMN)
    assert len(found.merged.curves.points_mm) == len(FEW) * len(COLUMNS)
    assert np.abs(BALL.distance_mm(found.merged.curves.points_mm)).max() < 0.01
    refused = {each.name: set(np.unique(each.curves.refusal)) for each in found.cameras}
    assert refused == {"above": {Refusal.NONE, Refusal.SHEET_SEEN_ALONG}, "beside": {Refusal.NONE}}
    (alone,) = triangulate(cameras[:1], PROJECTOR, Axis.COLUMN).cameras
    assert not alone.curves.refusal.any()


@pytest.mark.parametrize("axis", list(Axis))
def test_with_a_projector_the_crossing_is_that_of_the_calibration(axis: Axis) -> None:
    found = triangulate([seen("only", CAMERA, curves_in(CAMERA, FEW))], PROJECTOR, axis)
    beside, above, _ = PROJECTOR.rotation @ (CAMERA.centre_mm - PROJECTOR.centre_mm)
    across = beside if axis is Axis.COLUMN else above
    assert found.baseline_sine == pytest.approx(abs(across) / np.hypot(beside, above))


@pytest.mark.parametrize(("axis", "gap_px"), [(Axis.COLUMN, 8.0), (Axis.ROW, 4.0)])
def test_a_gap_is_as_wide_on_the_surface_where_rows_are_finer(axis: Axis, gap_px: float) -> None:
    fine_rows = replace(PROJECTOR, matrix=np.array([[700.0, 0, 160], [0, 1400.0, 240], [0, 0, 1]]))
    assert widest_gap_px(fine_rows, axis, []) == gap_px
    square = replace(PROJECTOR, matrix=np.array([[700.0, 0, 160], [0, 700.0, 120], [0, 0, 1]]))
    assert widest_gap_px(square, axis, []) == 4.0


# What is made of the albedo of the points: colours, marks at the border of the projector, words in the report


def lit(name: str, device: Pinhole, projector: Pinhole = PROJECTOR) -> CameraResult:
    """A camera before the ball that sees the same contrast everywhere, in a frame without a clipped pixel."""
    found = seen(name, device, curves_in(device, MANY, projector))
    return replace(found, contrast=np.full((*device.size.shape, 1), 100, dtype=np.float32))


def normals_of(found: Triangulated) -> FloatArray:
    outward = found.merged.curves.points_mm - np.array(BALL.centre_mm)
    return np.asarray(outward / np.linalg.norm(outward, axis=1, keepdims=True), dtype=np.float32)


def colours_of(cameras: list[CameraResult], projector: Pinhole | None) -> tuple[Coloured, Triangulated]:
    found = triangulate(cameras, projector, Axis.COLUMN)
    return coloured(cameras, found.merged, normals_of(found).astype(np.float32), projector, Axis.COLUMN), found


def mesh_of(made: Coloured, found: Triangulated) -> Mesh:
    curves, count = found.merged.curves, len(made.mark)
    faces = np.arange(count - count % 3, dtype=np.int32).reshape(-1, 3)
    return compact_mesh(
        faces, curves.points_mm, normals_of(found).astype(np.float32), made.colour, made.mark, np.zeros(count),
        curves.offsets, curves.position_px,
    )  # fmt: skip


def test_what_is_as_bright_and_farther_away_has_the_lighter_colour() -> None:
    camera = lit("camera", CAMERA)
    made, found = colours_of([camera], PROJECTOR)
    towards = PROJECTOR.centre_mm - found.merged.curves.points_mm
    distance = np.linalg.norm(towards, axis=1)
    cosine = (normals_of(found) * towards).sum(axis=1) / distance
    expected = distance**2 / cosine
    expected *= 0.8 / np.percentile(expected, 98)
    srgb = 255 * (1.055 * np.minimum(expected, 1) ** (1 / 2.4) - 0.055)
    assert np.abs(made.colour - srgb[:, None]).max() < 0.6
    assert not made.mark.any()
    report = albedo_report(made, mesh_of(made, found), [camera], lit=True, mapped=True)
    assert str(report["is"]).startswith("albedo")
    assert report["marked_vertices"] == {"saturated": 0, "grazing": 0, "border": 0, "unknown": 0, "shaded": 0}
    assert report["camera_gains"] == {"camera": {"gain": [1.0], "points": 0}}


def test_without_a_calibrated_projector_the_colour_is_brightness_and_says_so() -> None:
    cameras = [lit("left", CAMERA), lit("right", OTHER_CAMERA)]
    made, found = colours_of(cameras, None)
    assert (made.mark == AlbedoMark.SHADED).all()
    assert (made.colour == made.colour[0]).all()
    report = albedo_report(made, mesh_of(made, found), cameras, lit=False, mapped=False)
    assert str(report["is"]).startswith("brightness")
    assert report["marked_vertices"] == {
        "saturated": 0, "grazing": 0, "border": 0, "unknown": 0, "shaded": len(made.mark) - len(made.mark) % 3
    }  # fmt: skip


@pytest.mark.parametrize(("width_px", "height_px"), [(172, 240), (320, 161)])
def test_points_in_the_outermost_pixels_of_the_projector_are_marked(width_px: int, height_px: int) -> None:
    projector = replace(PROJECTOR, size=Size(width_px, height_px))
    made, found = colours_of([lit("camera", CAMERA)], projector)
    curves = found.merged.curves
    beyond = (np.repeat(curves.position_px, np.diff(curves.offsets)) > width_px - 3) | (curves.along_px > height_px - 3)
    assert max(COLUMNS) > 172 - 3
    assert 0 < beyond.mean() < 0.4
    assert np.array_equal(made.mark == AlbedoMark.BORDER, beyond)


def test_a_point_without_a_normal_is_neither_dark_nor_light() -> None:
    camera = lit("camera", CAMERA)
    found = triangulate([camera], PROJECTOR, Axis.COLUMN)
    normals = normals_of(found).astype(np.float32)
    normals[3] = np.nan
    made = coloured([camera], found.merged, normals, PROJECTOR, Axis.COLUMN)
    assert made.colour[3].tolist() == [128, 128, 128]
    assert np.flatnonzero(made.mark).tolist() == [3]
    assert made.mark[3] == AlbedoMark.UNKNOWN

"""What a scan makes of the albedo of its points: colours, marks at the projector's border, and words in the report."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slrig.meshing.vertices import compact_mesh
from slrig.model import AlbedoMark, Axis, FloatArray, Mesh, Pinhole, Size
from slrig.scan.colouring import Coloured, albedo_report, coloured
from slrig.scan.stream import CameraResult
from slrig.scan.triangulated import Triangulated, triangulated
from tests.unit.reconstruction.builders import CAMERA, OTHER_CAMERA, PROJECTOR
from tests.unit.scan.test_triangulated import BALL, COLUMNS, MANY, curves_in, seen


def lit(name: str, device: Pinhole, projector: Pinhole = PROJECTOR) -> CameraResult:
    """A camera before the ball that sees the same contrast everywhere, in a frame without a clipped pixel."""
    found = seen(name, device, curves_in(device, MANY, projector))
    return replace(found, contrast=np.full((*device.size.shape, 1), 100, dtype=np.float32))


def normals_of(found: Triangulated) -> FloatArray:
    outward = found.joined.curves.points_mm - np.array(BALL.centre_mm)
    return np.asarray(outward / np.linalg.norm(outward, axis=1, keepdims=True), dtype=np.float32)


def colours_of(cameras: list[CameraResult], projector: Pinhole | None) -> tuple[Coloured, Triangulated]:
    found = triangulated(cameras, projector, Axis.COLUMN)
    return coloured(cameras, found.joined, normals_of(found).astype(np.float32), projector, Axis.COLUMN), found


def mesh_of(made: Coloured, found: Triangulated) -> Mesh:
    curves, count = found.joined.curves, len(made.mark)
    faces = np.arange(count - count % 3, dtype=np.int32).reshape(-1, 3)
    return compact_mesh(
        faces, curves.points_mm, normals_of(found).astype(np.float32), made.colour, made.mark, np.zeros(count),
        curves.offsets, curves.position_px,
    )  # fmt: skip


def test_what_is_as_bright_and_farther_away_has_the_lighter_colour() -> None:
    camera = lit("camera", CAMERA)
    made, found = colours_of([camera], PROJECTOR)
    towards = PROJECTOR.centre_mm - found.joined.curves.points_mm
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
    curves = found.joined.curves
    beyond = (np.repeat(curves.position_px, np.diff(curves.offsets)) > width_px - 3) | (curves.along_px > height_px - 3)
    assert max(COLUMNS) > 172 - 3
    assert 0 < beyond.mean() < 0.4
    assert np.array_equal(made.mark == AlbedoMark.BORDER, beyond)


def test_a_point_without_a_normal_is_neither_dark_nor_light() -> None:
    camera = lit("camera", CAMERA)
    found = triangulated([camera], PROJECTOR, Axis.COLUMN)
    normals = normals_of(found).astype(np.float32)
    normals[3] = np.nan
    made = coloured([camera], found.joined, normals, PROJECTOR, Axis.COLUMN)
    assert made.colour[3].tolist() == [128, 128, 128]
    assert np.flatnonzero(made.mark).tolist() == [3]
    assert made.mark[3] == AlbedoMark.UNKNOWN

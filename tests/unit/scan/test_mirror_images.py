"""What becomes of the points and pixels of mirror images."""

from __future__ import annotations

import numpy as np
import pytest

from slrig.meshing import SurfaceMesh
from slrig.model import Axis, IntArray, Refusal, Size
from slrig.reconstruction import SheetCurves
from slrig.scan.losses import (
    MirrorImages,
    mirror_image_notes,
    refuse_mirror_images,
    without_mirror_images,
    without_surface,
)
from slrig.scan.measured import Triangulated
from tests.unit.meshing.test_initial import COLUMNS, ROWS, ridge
from tests.unit.reconstruction.builders import CAMERA, PROJECTOR, looking
from tests.unit.scan.test_triangulated import MANY, curves_in, seen, triangulate

NO_FACES = np.zeros((0, 3), dtype=np.int32)


def triangles_between(first: int, second: int) -> IntArray:
    """Faces between two of the curves, in points of all."""
    count = len(MANY)
    upper = np.arange(count - 1)
    a, b = first * count + upper, second * count + upper
    return np.concatenate([np.stack([a, a + 1, b], axis=1), np.stack([b, a + 1, b + 1], axis=1)]).astype(np.int32)


def scene(faces: IntArray, mirror_faces: IntArray) -> tuple[Triangulated, SurfaceMesh]:
    found = triangulate([seen("left", CAMERA, curves_in(CAMERA, MANY))], PROJECTOR, Axis.COLUMN)
    normals = np.zeros((len(found.merged.curves.points_mm), 3), dtype=np.float32)
    return found, SurfaceMesh(faces, mirror_faces, normals, (), {})


def test_points_and_pixels_of_mirror_images_are_left_out_with_their_cause() -> None:
    found, surface = scene(triangles_between(0, 1), triangles_between(2, 3))
    (camera,), joined, rest = without_mirror_images(found.cameras, found.merged, surface, MirrorImages())
    points = found.merged.curves
    np.testing.assert_array_equal(joined.curves.points_mm, points.points_mm[: 2 * len(MANY)])
    np.testing.assert_array_equal(joined.curves.points_mm[rest.faces], points.points_mm[surface.faces])
    assert np.diff(joined.curves.offsets).tolist() == [len(MANY), len(MANY), 0, 0]
    assert len(joined.camera) == 2 * len(MANY)
    refusal = camera.curves.refusal
    columns, rows = np.rint(points.pixels_px).astype(int).T
    assert (refusal[rows, columns] == np.repeat([0, 0, 15, 15], len(MANY))).all()
    # Pixels between the columns are of the same image.
    assert np.count_nonzero(refusal == Refusal.MIRROR_IMAGE) > 2 * 2 * len(MANY)
    figures = rest.steps["mirror_images"]
    assert (figures["triangles"], figures["points"]) == (len(surface.mirror_faces), 2 * len(MANY))
    assert figures["area_share"] == pytest.approx(0.5, abs=0.1)
    (note,) = mirror_image_notes(rest, [camera], PROJECTOR)
    assert note.startswith("mirror images: ")
    assert f"{np.count_nonzero(refusal == Refusal.MIRROR_IMAGE):,} pixels of camera 'left'" in note


def test_a_scan_without_mirror_images_stays_as_it_is() -> None:
    found, surface = scene(triangles_between(0, 1), NO_FACES)
    cameras, joined, rest = without_mirror_images(found.cameras, found.merged, surface, MirrorImages())
    assert (cameras, joined) == (found.cameras, found.merged)
    assert rest.steps["mirror_images"] == {"triangles": 0, "points": 0, "area_share": 0.0}
    assert mirror_image_notes(rest, cameras, PROJECTOR) == []


def test_a_scan_of_mirror_images_only_says_so() -> None:
    _, surface = scene(NO_FACES, triangles_between(0, 1))
    assert "all triangles face only one of camera and projector" in without_surface(surface, PROJECTOR)
    assert "the two cameras" in without_surface(surface, None)
    _, surface = scene(NO_FACES, NO_FACES)
    assert without_surface(surface, PROJECTOR) == "no two neighbouring stripes could be meshed"


def test_a_camera_loses_its_mirror_images_before_its_points_meet_those_of_another() -> None:
    points, offsets, position = ridge(4.0)
    count = len(points)
    aside, above, lamp = (
        looking(position_mm, (5.0, 7.0, 10.0), size=Size(320, 240), focal_px=(focal, focal), distortion=(0.0,) * 5)
        for position_mm, focal in (
            ((-300.0, 5.0, -100.0), 300.0),
            ((5.0, 5.0, -400.0), 400.0),
            ((90.0, 5.0, -400.0), 3200.0),
        )
    )
    across, down = np.meshgrid(10.0 * np.arange(COLUMNS), 10.0 * np.arange(ROWS), indexing="ij")
    part = SheetCurves(
        offsets=offsets,
        position_px=position,
        points_mm=points,
        deviation_mm=np.full((count, 3), 1e-4),
        along_px=np.tile(np.arange(ROWS, dtype=np.float64), COLUMNS),
        pixels_px=np.stack([across, down], axis=-1).reshape(-1, 2),
        stripe=np.repeat(np.arange(COLUMNS, dtype=np.int32), ROWS),
        bridge_after=np.zeros(count, dtype=np.bool_),
        source=np.zeros(count, dtype=np.uint8),
    )
    both = [seen(name, device, curves_in(CAMERA, MANY)) for name, device in (("aside", aside), ("above", above))]
    parts, cameras, found = refuse_mirror_images([part, part], both, lamp, Axis.COLUMN)
    # The sixth curve has the last real triangles.
    np.testing.assert_array_equal(parts[0].points_mm, points[: 6 * ROWS])
    assert found.points == count - 6 * ROWS
    assert found.triangles == 6 * (2 * ROWS - 2)
    assert (len(parts[1].points_mm), cameras[1]) == (count, both[1])
    refusal = cameras[0].curves.refusal
    assert set(refusal[:141:10, 60:111:10].ravel()) == {Refusal.MIRROR_IMAGE}
    assert np.count_nonzero(refusal[:, :50]) == 0

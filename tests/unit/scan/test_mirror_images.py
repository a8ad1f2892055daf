"""What becomes of the points and pixels of mirror images."""

from __future__ import annotations

import numpy as np
import pytest

from slrig.meshing import SurfaceMesh
from slrig.model import Axis, IntArray, Refusal
from slrig.scan.mirror_images import mirror_image_notes, without_mirror_images, without_surface
from slrig.scan.triangulated import Triangulated, triangulated
from tests.unit.reconstruction.builders import CAMERA, PROJECTOR
from tests.unit.scan.test_triangulated import MANY, curves_in, seen

NO_FACES = np.zeros((0, 3), dtype=np.int32)


def triangles_between(first: int, second: int) -> IntArray:
    """Faces between two of the curves, in points of all."""
    count = len(MANY)
    upper = np.arange(count - 1)
    a, b = first * count + upper, second * count + upper
    return np.concatenate([np.stack([a, a + 1, b], axis=1), np.stack([b, a + 1, b + 1], axis=1)]).astype(np.int32)


def scene(faces: IntArray, mirror_faces: IntArray) -> tuple[Triangulated, SurfaceMesh]:
    found = triangulated([seen("left", CAMERA, curves_in(CAMERA, MANY))], PROJECTOR, Axis.COLUMN)
    normals = np.zeros((len(found.joined.curves.points_mm), 3), dtype=np.float32)
    return found, SurfaceMesh(faces, mirror_faces, normals, (), {})


def test_points_and_pixels_of_mirror_images_are_left_out_with_their_cause() -> None:
    found, surface = scene(triangles_between(0, 1), triangles_between(2, 3))
    (camera,), joined, rest = without_mirror_images(found.cameras, found.joined, surface)
    points = found.joined.curves
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
    cameras, joined, rest = without_mirror_images(found.cameras, found.joined, surface)
    assert (cameras, joined) == (found.cameras, found.joined)
    assert rest.steps["mirror_images"] == {"triangles": 0, "points": 0, "area_share": 0.0}
    assert mirror_image_notes(rest, cameras, PROJECTOR) == []


def test_a_scan_of_mirror_images_only_says_so() -> None:
    _, surface = scene(NO_FACES, triangles_between(0, 1))
    assert "all triangles face only one of camera and projector" in without_surface(surface, PROJECTOR)
    assert "the two cameras" in without_surface(surface, None)
    _, surface = scene(NO_FACES, NO_FACES)
    assert without_surface(surface, PROJECTOR) == "no two neighbouring stripes could be meshed"

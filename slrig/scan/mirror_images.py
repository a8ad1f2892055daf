"""Mirror images: what a shiny part shows of another one, left out of a scan with a cause of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from slrig.meshing import SurfaceMesh, rasterise, used_vertices
from slrig.model import FloatArray, IntArray, Pinhole, Refusal, Size
from slrig.reconstruction import MergedCurves, select_points
from slrig.scan.stream import CameraResult

_MIN_SHARE = 0.001
"""Of the area; less are folds beside depth edges."""


def without_mirror_images(
    cameras: Sequence[CameraResult], joined: MergedCurves, surface: SurfaceMesh
) -> tuple[list[CameraResult], MergedCurves, SurfaceMesh]:
    """The cameras, points and surface without the points that only mirror images use.

    Pixels that the mirror images cover are refused, not only those with a point. The surface's steps have the figures.
    """
    points, images = joined.curves, surface.mirror_faces
    count = len(points.points_mm)
    figures = {"triangles": len(images), "points": 0, "area_share": 0.0}
    if len(images) == 0:
        return list(cameras), joined, replace(surface, steps={**surface.steps, "mirror_images": figures})
    phantom = used_vertices(images, count) & ~used_vertices(surface.faces, count)
    areas_mm2 = [_area_mm2(points.points_mm, faces) for faces in (images, surface.faces)]
    figures |= {"points": int(np.count_nonzero(phantom)), "area_share": areas_mm2[0] / max(sum(areas_mm2), 1e-12)}
    surface = replace(surface, steps={**surface.steps, "mirror_images": figures})
    refused = []
    for index, seen in enumerate(cameras):
        mine = joined.camera == index
        faces = images[mine[images].all(axis=1)]
        refusal = _with_phantom(seen.curves.refusal, points.pixels_px, faces, phantom & mine, mine & ~phantom)
        refused.append(replace(seen, curves=replace(seen.curves, refusal=refusal)))
    rest = replace(joined, curves=select_points(points, ~phantom), camera=joined.camera[~phantom])
    return refused, rest, surface.among_points(~phantom)


def mirror_image_notes(surface: SurfaceMesh, cameras: Sequence[CameraResult], projector: Pinhole | None) -> list[str]:
    """One sentence if mirror images are more than a thousandth of the area. cameras : with all their refusals."""
    share = surface.steps["mirror_images"]["area_share"]
    if not isinstance(share, float) or share < _MIN_SHARE:
        return []
    pixels = " and ".join(
        f"{np.count_nonzero(seen.curves.refusal == Refusal.MIRROR_IMAGE):,} pixels of camera '{seen.name}'"
        for seen in cameras
    )
    return [
        f"mirror images: {share:.1%} of the area, {pixels}, faces only one of {_devices(projector)}, as what a shiny "
        "part shows of another one does. It is not in the mesh. Spray the shiny part matt, or turn the object"
    ]


def without_surface(surface: SurfaceMesh, projector: Pinhole | None) -> str:
    """Why no triangle is left."""
    if len(surface.mirror_faces) == 0:
        return "no two neighbouring stripes could be meshed"
    return (
        f"all triangles face only one of {_devices(projector)}, as mirror images do. Unless the whole object is "
        "shiny, the calibration is not that of this rig, or a picture is mirrored against it"
    )


def _devices(projector: Pinhole | None) -> str:
    return "the two cameras" if projector is None else "camera and projector"


def _area_mm2(points_mm: FloatArray, faces: IntArray) -> float:
    a, b, c = (points_mm[faces[:, corner]] for corner in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def _with_phantom(
    refusal: NDArray[np.uint8],
    pixels_px: FloatArray,
    faces: IntArray,
    phantom: NDArray[np.bool_],
    others: NDArray[np.bool_],
) -> NDArray[np.uint8]:
    """The refusals of a camera, (H, W), with the pixels of mirror images among them.

    pixels_px : (n, 2) of all points; faces : (M, 3) into them; phantom, others : (n,) bool, this camera's points.
    """
    placed = np.column_stack([pixels_px, np.ones(len(pixels_px))]).astype(np.float32)
    height, width = refusal.shape
    covered = rasterise(placed, faces, Size(width, height)).face >= 0
    columns, rows = np.rint(pixels_px).astype(np.intp).T
    covered[rows[phantom], columns[phantom]] = True
    covered[rows[others], columns[others]] = False
    return np.where(covered & (refusal == Refusal.NONE), np.uint8(Refusal.MIRROR_IMAGE), refusal)

"""Mirror images: what a shiny part shows of another one, left out of a scan with a cause of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slrig.meshing import SurfaceMesh, Viewpoints, initial_mesh, rasterise, used_vertices
from slrig.model import Axis, FloatArray, IntArray, Pinhole, Refusal, Size
from slrig.reconstruction import MergedCurves, SheetCurves, sampling_mm, select_points
from slrig.scan.plan import ReconstructionPlan
from slrig.scan.stream import CameraResult

_MIN_SHARE = 0.001
"""Of the area; less are folds beside depth edges."""


@dataclass(frozen=True, slots=True)
class MirrorImages:
    """Triangles and area of mirror images, and the points that only they use."""

    triangles: int = 0
    points: int = 0
    area_mm2: float = 0.0


NO_MIRROR_IMAGES = MirrorImages()


def refuse_mirror_images(
    parts: Sequence[SheetCurves], cameras: Sequence[CameraResult], projector: Pinhole, axis: Axis
) -> tuple[list[SheetCurves], list[CameraResult], MirrorImages]:
    """The points of each camera, and the cameras, without mirror images, so that none meets what another camera sees.

    A part of the surface may be a mirror image for one camera, and for another not. Where there are any, points of
    which a camera alone makes no surface are left out, too.
    """
    found, refused, own = NO_MIRROR_IMAGES, list(cameras), []
    for index, (part, seen) in enumerate(zip(parts, cameras, strict=True)):
        count = len(part.points_mm)
        filled = part.position_px[np.diff(part.offsets) > 0]
        if len(filled) < 2:
            own.append(np.ones(count, dtype=np.bool_))
            continue
        step_px = float(np.median(np.diff(filled)))
        sampling = sampling_mm(part.points_mm, seen.device, projector, axis, step_px)
        initial = initial_mesh(
            part.points_mm, part.offsets, part.position_px, part.bridge_after,
            np.hypot(sampling, np.linalg.norm(part.deviation_mm, axis=1)),
            Viewpoints(
                np.zeros(count, dtype=np.int32), seen.device.centre_mm[None], projector.centre_mm, part.deviation_mm
            ),
            widest_step_px=step_px, depth_edge_ratio=ReconstructionPlan().depth_edge_ratio, keep_holes=False,
        )  # fmt: skip
        own.append(used_vertices(initial.faces, count))
        phantom = used_vertices(initial.mirror_faces, count) & ~own[-1]
        found = _added(found, part.points_mm, initial.mirror_faces, phantom)
        if phantom.any():
            refusal = _with_phantom(seen.curves.refusal, part.pixels_px, initial.mirror_faces, phantom, ~phantom)
            refused[index] = replace(seen, curves=replace(seen.curves, refusal=refusal))
    if found.points == 0:
        return list(parts), list(cameras), NO_MIRROR_IMAGES
    # Scraps of mirror images face this way or that: without a surface of its own, a point may be of one.
    remaining = [select_points(part, each) for part, each in zip(parts, own, strict=True)]
    return remaining, refused, found


def without_mirror_images(
    cameras: Sequence[CameraResult], joined: MergedCurves, surface: SurfaceMesh, earlier: MirrorImages
) -> tuple[list[CameraResult], MergedCurves, SurfaceMesh]:
    """The cameras, points and surface without the points that only mirror images use.

    Pixels that the mirror images cover are refused, not only those with a point. The surface's steps have the figures,
    those of `earlier` included.
    """
    points, images = joined.curves, surface.mirror_faces
    phantom = _only_used_by(images, surface.faces, len(points.points_mm))
    found = _added(earlier, points.points_mm, images, phantom)
    area_share = 0.0
    if found.area_mm2 > 0:
        area_share = found.area_mm2 / (found.area_mm2 + _area_mm2(points.points_mm, surface.faces))
    figures = {"triangles": found.triangles, "points": found.points, "area_share": area_share}
    surface = replace(surface, steps={**surface.steps, "mirror_images": figures})
    if not phantom.any():
        return list(cameras), joined, surface
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
    counts = {seen.name: np.count_nonzero(seen.curves.refusal == Refusal.MIRROR_IMAGE) for seen in cameras}
    pixels = " and ".join(f"{count:,} pixels of camera '{name}'" for name, count in counts.items() if count)
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


def _only_used_by(images: IntArray, faces: IntArray, count: int) -> NDArray[np.bool_]:
    """(count,) bool: the points that mirror images use, and no other face."""
    if len(images) == 0:
        return np.zeros(count, dtype=np.bool_)
    return used_vertices(images, count) & ~used_vertices(faces, count)


def _added(found: MirrorImages, points_mm: FloatArray, images: IntArray, phantom: NDArray[np.bool_]) -> MirrorImages:
    return MirrorImages(
        found.triangles + len(images),
        found.points + int(np.count_nonzero(phantom)),
        found.area_mm2 + _area_mm2(points_mm, images),
    )


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

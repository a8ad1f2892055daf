"""Where a scan loses its pixels, light, code, geometry or mesh, and which of its points are mirror images.

The first stage that loses most of the pixels is the cause. Light: the projector lights a pixel. Code: the pixel is
decoded and its stripe numbered. Geometry: ray and light sheet intersect in front of both devices and on the projector's
image. Mesh: triangles cover the pixel.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slrig.errors import NothingToReconstructError, setting
from slrig.meshing import SurfaceMesh, Viewpoints, initial_mesh, rasterise, used_vertices
from slrig.model import Axis, FloatArray, Gray, IntArray, Pattern, Pinhole, Refusal, Size
from slrig.reconstruction import MergedCurves, SheetCurves, sampling_mm, select_points, triangulate_camera_projector
from slrig.scan.plan import ReconstructionPlan
from slrig.scan.report import lit_pixels
from slrig.scan.stream import CameraResult

FAIR_SHARE = 0.6
"""Of the decoded pixels under the mesh. Sound scans of real rigs have 0.8 and more, refused borders of two pixels
included."""
_LOST = 0.05
"""A stage that keeps less of what it was given has lost all."""
_NO_LIGHT = 1e-3
"""Of the image. Less than this is noise or light from elsewhere."""
_ALL_BUT_NONE = 0.02
"""With less of the decoded pixels under the mesh, there is no scan."""

_MAX_BEYOND = 0.05
_NOTED_BEYOND = 0.005
"""Of the pixels whose code was read, those that name a place that the projector has not."""
_MAX_OFF = 0.3
_NOTED_OFF = 0.01
"""Of the points whose code was read, those without an intersection. Right calibrations have none."""
_FITS = 0.98
"""Of the points that intersect, with a changed pose that explains the frames."""
_CUT_CURVES = 16
_CUT_SHARE = 0.5

_OFF_GEOMETRY = {
    Refusal.OFF_PROJECTOR: "meet the light where the projector has no pixel",
    Refusal.BEHIND_DEVICE: "meet it behind a device",
    Refusal.NO_INTERSECTION: "do not meet it",
}
_CODE_REMEDIES = {
    Refusal.SATURATED: "the frames are at the camera's limit: expose for a shorter time",
    Refusal.AMBIGUOUS_BIT: "bits and their inverses differ too little: look whether the images are in the order of "
    "their patterns, both devices are in focus, and no other light is brighter than the projector's",
}
_UNSTEADY_CODE = (
    "the code changes from pixel to pixel: look whether the images are in the order of their patterns, and whether "
    "anything moved"
)
_MESH_REMEDIES = {
    Refusal.AMBIGUOUS_LINE: "the code does not tell neighbouring lines apart: play wider cells, "
    f"{setting('gray_cell_px')}",
    Refusal.SHORT_STRIPE: "stripes are in pieces too short to be trusted: look at the focus of both devices, and at "
    "the order of the images",
    Refusal.STRAY_CODE: "codes differ along a stripe: look at the order of the images",
    Refusal.SHADOW_EDGE: "most of it is beside shadows: give the object more light, or turn it",
    Refusal.DEPTH_EDGE: "the code jumps nearly everywhere: look whether the images are in the order of their patterns, "
    "or both devices are in focus",
}


class LossStage(StrEnum):
    """A stage of a scan that can lose what it is given."""

    LIGHT = "light"
    CODE = "code"
    GEOMETRY = "geometry"
    MESH = "mesh"


def stage_shares(cameras: Sequence[CameraResult], *, covered: float | None = None) -> dict[LossStage, float]:
    """Return the share, 0 to 1, that each stage kept of what it was given, of all cameras together, in their order.

    covered : share of the decoded pixels under the mesh; None if there is no mesh yet. A stage that was given nothing
    is left out.
    """
    counts = _counts(cameras)
    asked = counts.sum() - counts[Refusal.OUTSIDE_REGION]
    lit = asked - counts[Refusal.NOT_LIT]
    decoded = sum(seen.curves.decoded_pixels for seen in cameras)
    coded = sum(len(seen.curves.ensemble.bridge_after) for seen in cameras)
    given = {
        LossStage.LIGHT: (lit, asked),
        LossStage.CODE: (decoded if coded else 0, lit),
        LossStage.GEOMETRY: (coded - sum(counts[cause] for cause in _OFF_GEOMETRY), coded),
    }
    shares = {stage: float(np.clip(kept / of, 0, 1)) for stage, (kept, of) in given.items() if of}
    return shares if covered is None else shares | {LossStage.MESH: covered}


def losing_stage(shares: Mapping[LossStage, float]) -> LossStage:
    """Return the first stage that lost all; if none did, the one that kept least, light aside: objects may be small."""
    lost = next((stage for stage, share in shares.items() if share < _LOST and stage is not LossStage.LIGHT), None)
    if shares.get(LossStage.LIGHT, 0.0) < _NO_LIGHT:
        return LossStage.LIGHT
    return lost or min((stage for stage in shares if stage is not LossStage.LIGHT), key=shares.__getitem__)


def require_surface(
    holds: bool, folder: Path, what: str, cameras: Sequence[CameraResult], *, stage: LossStage | None = None
) -> None:
    """Refuse a scan without a surface, with its figures, the cause and the remedy.

    stage : the one that lost all; None for `losing_stage`. Raises NothingToReconstructError.
    """
    if not holds:
        stage = stage or losing_stage(stage_shares(cameras))
        message = f"{folder}: {what}. {_figures(cameras)}. {remedy(stage, cameras)}"
        raise NothingToReconstructError(message)


def require_code_on_projector(folder: Path, cameras: Sequence[CameraResult], gray: Gray, projector: Size) -> None:
    """Refuse a scan whose code names many positions that the projector has not. gray : a bit of the code.

    With fewer than `_MAX_BEYOND` of such pixels, they may be light from elsewhere. Raises NothingToReconstructError.
    """
    beyond = sum(seen.curves.beyond_pixels for seen in cameras)
    share = beyond / max(beyond + sum(seen.curves.decoded_pixels for seen in cameras), 1)
    if share >= _MAX_BEYOND:
        message = f"{folder}: {_beyond_words(cameras, gray, projector, share)}. {_figures(cameras)}"
        raise NothingToReconstructError(message)


def _figures(cameras: Sequence[CameraResult]) -> str:
    return "; ".join(
        f"camera '{seen.name}': white {seen.white.mean():.0f} of {seen.full_scale:.0f} on average, at most "
        f"{seen.contrast.max():.0f} above black, {lit_pixels(seen.curves).mean():.1%} of the image lit, "
        f"{seen.curves.decoded_pixels} pixels decoded, {len(seen.curves.ensemble.bridge_after)} points on stripes"
        f"{_outside(seen)}"
        for seen in cameras
    )


def _outside(seen: CameraResult) -> str:
    share = float((seen.curves.refusal == Refusal.OUTSIDE_REGION).mean())
    return f", {share:.1%} of the image outside the region that was asked for" if share else ""


def remedy(stage: LossStage, cameras: Sequence[CameraResult]) -> str:
    """Return what most likely caused the loss of a stage, and what to do."""
    counts = _counts(cameras)
    if stage is LossStage.LIGHT:
        if all(seen.white.mean() > 0.9 * seen.full_scale for seen in cameras):
            return (
                "White is at the camera's limit, and black too: expose for a shorter time, and look whether other "
                "light is brighter than the projector's"
            )
        return (
            "Look whether the projector lit the object, the lens cap is off, and the exposure leaves white well above "
            "black"
        )
    if stage is LossStage.CODE:
        cause = max(_CODE_REMEDIES, key=lambda each: counts[each])
        decoded = sum(seen.curves.decoded_pixels for seen in cameras)
        words = _CODE_REMEDIES[cause] if counts[cause] >= decoded else _UNSTEADY_CODE
        return f"The light is there, but the code is not: {words}"
    if stage is LossStage.GEOMETRY:
        if counts[Refusal.OUTSIDE_REGION] and not any(counts[cause] for cause in _OFF_GEOMETRY):
            return "The points are outside the region that was asked for: widen it"
        return f"Light and code are there, but not the geometry: {_geometry_words(counts)}"
    cause = max(_MESH_REMEDIES, key=lambda each: counts[each])
    decoded = sum(seen.curves.decoded_pixels for seen in cameras)
    if counts[cause] > 0.2 * decoded:
        return f"Light, code and geometry are there, but few points: {_MESH_REMEDIES[cause]}"
    return (
        "Light, code and geometry are there, but few triangles: the finest patterns may not resolve (wider cells: "
        f"{setting('gray_cell_px')}; wider lines: {setting('line_width_px')}), or the limit at depth edges be too low: "
        f"{setting('depth_edge_ratio')}"
    )


def _geometry_words(counts: NDArray[np.int64]) -> str:
    """Counts : (causes,), pixels by `Refusal`."""
    ways = ", ".join(f"{counts[cause]} {words}" for cause, words in _OFF_GEOMETRY.items() if counts[cause])
    return (
        f"of the rays, {ways or 'none meet the light'}. The calibration does not fit these frames: its pose may be of "
        "the inverse direction, camera and projector be exchanged, images be mirrored, turned or cropped since, or a "
        "device have moved"
    )


def _counts(cameras: Sequence[CameraResult]) -> NDArray[np.int64]:
    """(causes,) int64: pixels of all cameras by `Refusal`."""
    return sum(
        (np.bincount(seen.curves.refusal.ravel(), minlength=len(Refusal)) for seen in cameras),
        np.zeros(len(Refusal), dtype=np.int64),
    )


def coverage_notes(cameras: Sequence[CameraResult], covered: float | None) -> list[str]:
    """Return one sentence if the mesh covers much less than the first camera decoded. covered : see `stage_shares`."""
    if covered is None or covered >= FAIR_SHARE:
        return []
    words = remedy(_stage_after_code(cameras, covered), cameras)
    what = f"the mesh covers {covered:.0%} of what camera '{cameras[0].name}' decoded"
    return [f"{what}: look at the picture of causes. {words}"]


def require_coverage(folder: Path, cameras: Sequence[CameraResult], covered: float | None) -> None:
    """Refuse a mesh that covers next to nothing of what was decoded. Raises NothingToReconstructError."""
    if covered is not None and covered < _ALL_BUT_NONE:
        what = f"the mesh covers {covered:.1%} of what camera '{cameras[0].name}' decoded"
        require_surface(False, folder, what, cameras, stage=_stage_after_code(cameras, covered))


def _stage_after_code(cameras: Sequence[CameraResult], covered: float) -> LossStage:
    shares = stage_shares(cameras, covered=covered)
    return min((LossStage.GEOMETRY, LossStage.MESH), key=lambda stage: shares.get(stage, 0.0))


def code_extent_notes(cameras: Sequence[CameraResult], gray: Gray, projector: Size) -> list[str]:
    """Return a sentence for each camera whose code goes beyond the projector a little, or ends short of its border."""
    notes = []
    for seen in cameras:
        share = seen.curves.beyond_pixels / max(seen.curves.beyond_pixels + seen.curves.decoded_pixels, 1)
        if share >= _NOTED_BEYOND:
            notes.append(_beyond_words([seen], gray, projector, share))
        last = _sharp_end(seen.curves.ensemble.position_px, np.diff(seen.curves.ensemble.offsets))
        extent = projector.along(gray.axis)
        if last is not None and last < extent - 1 - 4 * gray.cell_px:
            notes.append(
                f"camera '{seen.name}': its code begins with the projector's first {gray.axis} and ends sharply at "
                f"{gray.axis} {last:.0f} of the {extent} that the projector is said to have. If the light ends there, "
                f"too, the projector has {last + 1:.0f}: correct its size"
            )
    return notes


def _beyond_words(cameras: Sequence[CameraResult], gray: Gray, projector: Size, share: float) -> str:
    extent = projector.along(gray.axis)
    cells = [seen.curves.furthest_cell for seen in cameras if seen.curves.beyond_pixels]
    named = [cell * gray.cell_px - gray.offset_px for cell in (min(cells), max(cells))]
    last = max(named[1] + gray.cell_px, extent) - 1
    return (
        f"the code names {gray.axis}s {min(named[0], 0)} to {last}, the projector has {extent} ({projector}): "
        f"{share:.1%} of the pixels whose code was read are beyond it. Correct the projector's size or the offset of "
        "the code; if they are right, look for a bit that is inverted or in another's place"
    )


def _sharp_end(position_px: FloatArray, points: FloatArray) -> float | None:
    """Return the last position of curves that begin at the projector's border and end as suddenly as light at a border.

    position_px : (n,) float64, sorted; points : (n,) int, of each curve. None if they begin elsewhere or fade out.
    """
    if len(position_px) < 3 * _CUT_CURVES:
        return None
    step_px = float(np.median(np.diff(position_px)))
    usual = float(np.median(points))
    begins = position_px[0] < 4 * step_px and points[:4].max() >= _CUT_SHARE * usual
    ends = points[-3:].max() >= _CUT_SHARE * float(np.median(points[-_CUT_CURVES:]))
    return float(position_px[-1]) if begins and ends and points[-1] >= _CUT_SHARE * usual else None


def geometry_fault(
    found: Sequence[CameraResult], before: Sequence[CameraResult], projector: Pinhole | None, axis: Axis
) -> str | None:
    """Return what is wrong if too many rays do not meet the light; None if they do.

    found : the cameras after triangulation; before : with their points.
    """
    share = _share_off(found)
    if projector is None or share < _MAX_OFF:
        return None
    words = f"{share:.0%} of the points have no place"
    fitting = fitting_poses(before, projector, axis)
    return words if not fitting else f"{words}; nearly all have one with {' or '.join(fitting)}"


def _share_off(cameras: Sequence[CameraResult]) -> float:
    """Share of the points without an intersection."""
    low, high = min(_OFF_GEOMETRY), max(_OFF_GEOMETRY)
    off = sum(np.count_nonzero((seen.curves.refusal >= low) & (seen.curves.refusal <= high)) for seen in cameras)
    return min(off / max(sum(len(seen.curves.ensemble.bridge_after) for seen in cameras), 1), 1.0)


def geometry_notes(cameras: Sequence[CameraResult]) -> list[str]:
    """Return a sentence if more than a few rays do not meet the light."""
    share = _share_off(cameras)
    if share < _NOTED_OFF:
        return []
    return [f"{share:.1%} of the points have no place: {_geometry_words(_counts(cameras))}"]


def fitting_poses(cameras: Sequence[CameraResult], projector: Pinhole, axis: Axis) -> list[str]:
    """Return which usual mistakes in a pose explain why rays do not meet the light: without them nearly all do.

    The pose is X_projector = R X_camera + t for the first camera.
    """
    seen = cameras[0]
    camera, ensemble = seen.device, seen.curves.ensemble
    rotation = projector.rotation @ camera.rotation.T
    shift_mm = projector.translation_mm - rotation @ camera.translation_mm
    changed = {
        "the inverse of the pose (R, t)": (rotation.T, -rotation.T @ shift_mm),
        "R transposed": (rotation.T, shift_mm),
        "t negated": (rotation, -shift_mm),
    }
    fitting = []
    for words, (turn, shift) in changed.items():
        device = replace(
            projector, rotation=turn @ camera.rotation, translation_mm=turn @ camera.translation_mm + shift
        )
        _, cause = triangulate_camera_projector(ensemble, camera, device, axis)
        if np.mean(cause == Refusal.NONE) >= _FITS:
            fitting.append(words)
    return fitting


def code_of(patterns: Collection[Pattern], axis: Axis) -> Gray:
    """Return a bit of the code of an axis; of sinusoids that number themselves, one of cells of one position."""
    return next((each for each in patterns if isinstance(each, Gray) and each.axis is axis), Gray(axis, 0, 1))


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
                np.stack([seen.device.centre_mm, projector.centre_mm]), np.zeros(count, dtype=np.int32),
                np.ones(count, dtype=np.int32), part.deviation_mm,
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
    rest = replace(
        joined, curves=select_points(points, ~phantom), camera=joined.camera[~phantom], seen_by=joined.seen_by[~phantom]
    )
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

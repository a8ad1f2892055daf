"""The second half of a scan, walked: the one file where the rooms of its mathematics meet.

A live scan is recorded as a bundle first (`slrig.scan.acquisition`), so that what was measured can always be computed
again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slrig.bundle import read_bundle, read_calibration, read_truth
from slrig.bundle.description import read_description
from slrig.bundle.health import read_health
from slrig.bundle.reading import CALIBRATION
from slrig.bundle.refused import read_refused
from slrig.capture.exposure import check_exposures
from slrig.errors import CalibrationError, NothingToReconstructError, PatternError, ScanCancelledError
from slrig.meshing.quality import mesh_figures, score
from slrig.meshing.surface import MeshingLimits, Stage, finished_mesh
from slrig.meshing.vertices import brightness, compact_mesh
from slrig.model import Axis, Calibration, FloatArray, IntArray, Mesh, Pinhole, PointCurves, Refusal
from slrig.reconstruction.calibration_share import calibration_modes, calibration_sigma, stripe_tangents
from slrig.reconstruction.camera import CameraCurves
from slrig.reconstruction.merging import MergedCurves, merged
from slrig.reconstruction.redundancy import Redundancy, redundancy
from slrig.reconstruction.triangulation import SheetCurves, camera_camera, camera_projector
from slrig.reconstruction.uncertainty import sampling_mm, sigma_along_normal
from slrig.scan.artefacts import write_mesh, write_points, write_report
from slrig.scan.calibration_report import calibration_report
from slrig.scan.outline import Outline
from slrig.scan.output import REPORT, staged_folder
from slrig.scan.pictures import preview, rejection_picture, write_png
from slrig.scan.plan import Progress, ReconstructionPlan
from slrig.scan.report import (
    Stopwatch,
    calibration_id,
    camera_report,
    capture_report,
    mesh_report,
    redundancy_report,
    with_seconds,
)
from slrig.scan.stream import LiveScan, ScanStream, Seen, step_px

_WIDEST_GAP_PX = 4.0
_STAGES = ("decode", "locate stripes", "refine stripes", "identify stripes", "link stripes")


@dataclass(frozen=True, slots=True)
class _Walked:
    """What the frames told: the curves of every camera, and their part of the report."""

    devices: Calibration
    axis: Axis
    seen: list[Seen]
    step_px: float
    sections: dict[str, object]


@dataclass(frozen=True, slots=True)
class _Triangulated:
    """The curves of all cameras, what they say of one another, and the cameras with the points that fell off the
    projector among their refusals. second : index of the camera that the first is paired with, without a projector.
    """

    joined: MergedCurves
    spare: Redundancy
    cameras: list[Seen]
    second: int = 1


@dataclass(frozen=True, slots=True)
class _Meshed:
    """The mesh and its points, the cameras with all their refusals, and what the report says.

    share_mm : (n,) float64, the calibration's part of each point's standard deviation, and mesh_share_mm : (V,) of each
    vertex's; None where the calibration does not state its error.
    """

    mesh: Mesh
    curves: PointCurves
    share_mm: FloatArray | None
    mesh_share_mm: FloatArray | None
    cameras: list[Seen]
    stages: tuple[Stage, ...]
    figures: Mapping[str, object]
    redundancy: Mapping[str, object]


def reconstruct_bundle(
    bundle: Path,
    output: Path,
    *,
    plan: ReconstructionPlan,
    calibration: Path | None = None,
    progress: Progress,
    cancelled: Callable[[], bool],
    live: LiveScan | None = None,
) -> dict[str, object]:
    """Reconstruct a recorded bundle into `output` and return the report.

    `live` has taken the frames already while they were captured; where it is of this bundle they are not read again.

    Writes mesh.ply, mesh.glb, points.ply, report.json, preview.png and a picture of the refused pixels per
    camera. `output` appears whole or not at all; results of an earlier run there are replaced.

    Raises
    ------
    BundleError, CalibrationError, PatternError
        The bundle cannot be used as it is.
    NothingToReconstructError
        The frames hold no surface.
    ScanCancelledError
        `cancelled()` became true.
    """
    watch = Stopwatch() if live is None else live.watch

    def entered(stage: str, fraction: float, detail: str) -> None:
        if cancelled():
            message = f"the scan was cancelled before '{stage}'"
            raise ScanCancelledError(message)
        watch.enter(stage)
        progress(stage, fraction, detail)

    with staged_folder(output) as staging:
        entered("read bundle", 0.0, str(bundle))
        walked = _walked(bundle, calibration, live, entered)
        devices, axis, seen, step = walked.devices, walked.axis, walked.seen, walked.step_px
        _require(any(each.curves.decoded_pixels > 0 for each in seen), bundle, "no pixel could be decoded", seen)
        _require(any(each.curves.stripe_count > 0 for each in seen), bundle, "no stripe was found", seen)
        entered("triangulate", 0.6, "")
        meshed = _meshed(bundle, seen, devices, axis, plan, step, entered)
        mesh, cameras = meshed.mesh, meshed.cameras
        entered("write mesh", 0.75, f"{len(mesh.faces)} triangles")
        write_points(meshed.curves, staging / "points.ply", sigma_calibration_mm=meshed.share_mm)
        write_mesh(mesh, staging, sigma_calibration_mm=meshed.mesh_share_mm)
        entered("pictures", 0.85, "")
        _write_pictures(mesh, cameras, staging)
        known = _compared_with_truth(bundle, mesh, cameras[0].device, entered)
        entered("write report", 0.98, "")
        figures = {**meshed.figures, "figures": mesh_figures(mesh.vertices_mm, mesh.faces)}
        seconds = watch.finished()
        report = {
            **walked.sections,
            "calibration": calibration_report(devices, bundle, mesh.sigma_mm, meshed.mesh_share_mm),
            "health": read_health(bundle),
            "plan": asdict(plan),
            "cameras": {each.name: camera_report(each.curves, each.exposures) for each in cameras},
            "redundancy": dict(meshed.redundancy),
            "mesh": {**figures, "stages": with_seconds(meshed.stages, seconds)},
            **known,
            "stages_s": seconds,
        }
        write_report(report, staging / REPORT)
    progress("done", 1.0, f"{len(mesh.faces)} triangles")
    return report


def _require_calibration(folder: Path, names: list[str], found: Calibration | None) -> Calibration:
    if found is None:
        message = (
            f"{folder}: no calibration.json beside the frames, and without one nothing can be measured; "
            "put one there, or name one with --calibration FILE"
        )
        raise CalibrationError(message)
    missing = [name for name in names if name not in found.cameras]
    if missing:
        message = (
            f"{folder}: the calibration knows cameras {sorted(found.cameras)}, the frames are of {names}; "
            f"calibrate {missing}, or use the names of the calibration"
        )
        raise CalibrationError(message)
    if found.projector is None and len(names) < 2:
        message = (
            f"{folder}: the calibration has no projector, and the bundle one camera ('{names[0]}'): one of "
            "them is needed as the second ray; calibrate the projector, or add a camera"
        )
        raise CalibrationError(message)
    return found


def _walked(
    folder: Path, calibration_file: Path | None, live: LiveScan | None, entered: Callable[[str, float, str], None]
) -> _Walked:
    """Frames to curves: those that came while the scan was captured, or else those of the bundle."""
    names: list[str] = []
    last = ""

    def stage_entered(stage: str, name: str) -> None:
        nonlocal last
        if last != stage + name:
            last = stage + name
            share = (names.index(name) + _STAGES.index(stage) / len(_STAGES)) / len(names)
            entered(stage, 0.1 + 0.5 * share, f"camera '{name}'")

    if live is not None and live.evidence is not None and _is_of(live, folder, calibration_file):
        names += live.stream.outline.cameras
        devices, stream, evidence = live.calibration, live.stream, live.evidence
        _require_calibration(folder, names, devices)
        seen = live.finish(stage_entered)
    else:
        recorded = read_bundle(folder, calibration_file=calibration_file)
        names += recorded.capture.cameras
        devices = _require_calibration(folder, names, recorded.calibration)
        try:
            stream = ScanStream(Outline.of(recorded.capture), devices, entered=stage_entered)
            for name in names:
                for shot in recorded.capture.shots:
                    if shot.camera == name:
                        stream.take(shot)
            seen = stream.finish()
        except PatternError as cause:
            message = f"{folder}: {cause}"
            raise PatternError(message) from cause
        entered("check frames", 0.58, "")
        evidence = check_exposures(recorded.capture, read_refused(folder))
    sections = capture_report(stream.capture, stream.axis, evidence)
    return _Walked(devices, stream.axis, seen, step_px(stream.outline.shown, stream.axis), sections)


def _is_of(live: LiveScan, folder: Path, calibration_file: Path | None) -> bool:
    """Whether the frames taken live are those that the bundle lists, for the calibration that it is measured by."""
    description = read_description(folder)
    listed = Outline(
        description.projector_size(), description.pattern_list(), description.camera_formats(),
        tuple((frame.pattern, frame.camera) for frame in description.frames),
    )  # fmt: skip
    path = folder / CALIBRATION if calibration_file is None else calibration_file
    return (
        Outline.of(live.stream.capture) == listed
        and path.exists()
        and calibration_id(read_calibration(path)) == calibration_id(live.calibration)
    )


def _triangulated(cameras: list[Seen], projector: Pinhole | None, axis: Axis) -> _Triangulated:
    devices = {seen.name: seen.device for seen in cameras}
    if projector is not None:
        parts = [camera_projector(seen.curves.ensemble, seen.device, projector, axis) for seen in cameras]
        told = [
            replace(seen, curves=replace(seen.curves, refusal=_with_dropped(seen.curves, part)))
            for seen, part in zip(cameras, parts, strict=True)
        ]
        spare = redundancy(parts, devices, axis, widest_gap_px=_WIDEST_GAP_PX)
        return _Triangulated(merged(parts, projector.centre_mm, widest_gap_px=_WIDEST_GAP_PX), spare, told)
    first, *others = cameras
    parts = [camera_camera(first.curves.ensemble, seen.curves.ensemble, first.device, seen.device) for seen in others]
    # Without a projector the light sheet has no rows to merge by; the pair that gives most is used.
    second = max(range(len(parts)), key=lambda index: len(parts[index].points_mm))
    best = parts[second]
    spare = redundancy([best], devices, axis, widest_gap_px=_WIDEST_GAP_PX)
    joined = merged([best], first.device.centre_mm, widest_gap_px=_WIDEST_GAP_PX)
    return _Triangulated(joined, spare, cameras, 1 + second)


def _with_dropped(curves: CameraCurves, triangulated: SheetCurves) -> NDArray[np.uint8]:
    """The refusals with those points among them that met their light sheet where the projector has no pixel."""
    points_px = curves.ensemble.points_px
    if len(triangulated.pixels_px) == len(points_px):
        return curves.refusal
    stays = np.zeros(curves.refusal.shape, dtype=bool)
    columns, rows = np.rint(triangulated.pixels_px).astype(int).T
    stays[rows, columns] = True
    columns, rows = np.rint(points_px).astype(int).T
    off = ~stays[rows, columns]
    refusal = curves.refusal.copy()
    refusal[rows[off], columns[off]] = Refusal.OFF_PROJECTOR
    return refusal


def _meshed(
    folder: Path,
    cameras: list[Seen],
    calibration: Calibration,
    axis: Axis,
    plan: ReconstructionPlan,
    step_px: float,
    entered: Callable[[str, float, str], None],
) -> _Meshed:
    """Triangulate and mesh."""
    first, projector = cameras[0], calibration.projector
    found = _triangulated(cameras, projector, axis)
    cameras, joined_curves = found.cameras, found.joined
    points = joined_curves.curves
    _require(len(points.points_mm) > 0, folder, "no stripe could be triangulated", cameras)
    count = f"{len(points.points_mm)} points"
    surface = finished_mesh(
        points.points_mm, points.offsets, points.position_px, points.bridge_after,
        sampling_mm(points.points_mm, first.device, projector, step_px), first.device.centre_mm,
        MeshingLimits(
            widest_step_px=step_px * plan.max_code_gap,
            depth_edge_ratio=plan.depth_edge_ratio,
            keep_holes=plan.keep_holes,
            flip_rule=plan.flip_rule,
            smooth_boundary=plan.smooth_boundary,
        ),
        entered=lambda stage: entered(stage, 0.68, count),
    )  # fmt: skip
    _require(len(surface.faces) > 0, folder, "no two neighbouring stripes could be meshed", cameras)
    entered("vertices", 0.72, count)
    sigma = sigma_along_normal(points.deviation_mm, surface.normals)
    share = _calibration_share(calibration, found, axis, surface.normals)
    if share is not None:
        sigma = np.hypot(sigma, share)
    grey = brightness(
        points.pixels_px, joined_curves.camera,
        [seen.white for seen in cameras], [float(seen.full_scale) for seen in cameras],
    )  # fmt: skip
    curves = PointCurves(
        offsets=points.offsets,
        column_px=points.position_px,
        points_mm=points.points_mm,
        sigma_mm=sigma,
        bridge_after=points.bridge_after,
        source=points.source,
        grey=grey,
    )
    mesh = compact_mesh(
        surface.faces, points.points_mm, surface.normals, grey, sigma, points.offsets, points.position_px
    )
    return _Meshed(
        mesh=mesh,
        curves=curves,
        share_mm=share,
        mesh_share_mm=None if share is None else share[_used(surface.faces, len(share))],
        cameras=cameras,
        stages=surface.stages,
        figures=mesh_report(surface, mesh, curves),
        redundancy=redundancy_report(joined_curves, points.source, found.spare),
    )


def _used(faces: IntArray, count: int) -> NDArray[np.bool_]:
    """(count,) bool: the points that a triangle uses, which are the vertices of the mesh in the same order."""
    used = np.zeros(count, dtype=np.bool_)
    used[faces] = True
    return used


def _calibration_share(
    calibration: Calibration, found: _Triangulated, axis: Axis, normals: NDArray[np.float32]
) -> FloatArray | None:
    """(n,) float64: the calibration's part of each point's standard deviation; None where it states no error."""
    modes = calibration_modes(calibration, [seen.name for seen in found.cameras], axis, second=found.second)
    if modes is None:
        return None
    points = found.joined.curves
    tangents = stripe_tangents(points.points_mm, points.offsets, points.bridge_after)
    return calibration_sigma(modes, points.points_mm, normals, points.source, found.joined.camera, tangents)


def _write_pictures(mesh: Mesh, cameras: list[Seen], staging: Path) -> None:
    first = cameras[0]
    write_png(staging / "preview.png", preview(mesh, first.device, first.white, int(first.full_scale)))
    for seen in cameras:
        picture = rejection_picture(seen.curves.refusal, seen.white, int(seen.full_scale))
        write_png(staging / f"rejected-{seen.name}.png", picture)


def _compared_with_truth(
    bundle: Path, mesh: Mesh, camera: Pinhole, entered: Callable[[str, float, str], None]
) -> dict[str, object]:
    """The report's section on truth, for bundles that bring it."""
    truth = read_truth(bundle)
    if truth is None:
        return {}
    entered("compare with truth", 0.9, "")
    return {"truth": score(mesh, truth.surface, truth.visible_points_mm, camera.centre_mm).as_dict()}


def _require(holds: bool, folder: Path, what: str, cameras: list[Seen]) -> None:
    """Refuse a scan that holds no surface, with the figures that tell why."""
    if holds:
        return
    figures = "; ".join(
        f"camera '{seen.name}': white {seen.white.mean():.0f} of {seen.full_scale:.0f} on average, at most "
        f"{seen.largest_contrast:.0f} above black, {(seen.curves.refusal != Refusal.NOT_LIT).mean():.1%} of the image "
        f"lit, {seen.curves.decoded_pixels} pixels decoded"
        for seen in cameras
    )
    message = (
        f"{folder}: {what}. {figures}. Look whether the projector lit the object, the lens cap is off, and the "
        "exposure leaves white below full scale and well above black"
    )
    raise NothingToReconstructError(message)

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

from slrig.bundle import Bundle, read_bundle, read_truth
from slrig.capture.evidence import check_capture
from slrig.errors import CalibrationError, NothingToReconstructError, PatternError, ScanCancelledError
from slrig.meshing.initial import initial_mesh
from slrig.meshing.quality import mesh_figures, score
from slrig.meshing.topology import compact
from slrig.model import Axis, Calibration, Gray, LineShift, Mesh, Pattern, Pinhole, Pixels, PointCurves, Refusal
from slrig.patterns.positions import cell_positions, edge_positions, index_of_word, line_positions
from slrig.reconstruction.camera import CameraCurves, CodeTables, Limits, camera_curves
from slrig.reconstruction.frames import AxisFrames, axis_frames
from slrig.reconstruction.merging import MergedCurves, merged
from slrig.reconstruction.triangulation import SheetCurves, camera_camera, camera_projector
from slrig.reconstruction.uncertainty import sampling_mm, sigma_along_normal
from slrig.scan.artefacts import write_mesh, write_points, write_report
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
)

_WIDEST_GAP_PX = 4.0


@dataclass(frozen=True, slots=True)
class _Seen:
    """One camera: its calibration, its curves, and of its frames what the results still need.

    white : (H, W) uint16, the white frame in camera units; refusal : (H, W) uint8, `Refusal`.
    """

    name: str
    device: Pinhole
    curves: CameraCurves
    white: Pixels
    largest_contrast: float
    full_scale: float


@dataclass(frozen=True, slots=True)
class _Meshed:
    """The mesh, the cameras with all their refusals, and what the report says of mesh and redundancy."""

    mesh: Mesh
    cameras: list[_Seen]
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
) -> dict[str, object]:
    """Reconstruct a recorded bundle into `output` and return the report.

    Writes mesh.ply, mesh.glb, mesh.stl, points.ply, report.json, preview.png and a picture of the refused pixels per
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
    watch = Stopwatch()

    def entered(stage: str, fraction: float, detail: str) -> None:
        if cancelled():
            message = f"the scan was cancelled before '{stage}'"
            raise ScanCancelledError(message)
        watch.enter(stage)
        progress(stage, fraction, detail)

    with staged_folder(output) as staging:
        entered("read bundle", 0.0, str(bundle))
        recorded = read_bundle(bundle, calibration_file=calibration)
        devices = _require_calibration(recorded)
        axis = _axis(recorded, devices)
        sections = _sections(recorded, devices, axis)
        seen = _seen(recorded, devices, axis, entered)
        step_px = _step_px(recorded, axis)
        # The frames have told all they know; what follows needs their memory.
        del recorded
        entered("triangulate", 0.6, "")
        meshed = _meshed(bundle, seen, devices.projector, axis, plan, step_px, staging, entered)
        mesh, cameras = meshed.mesh, meshed.cameras
        entered("write mesh", 0.75, f"{len(mesh.faces)} triangles")
        write_mesh(mesh, staging)
        entered("pictures", 0.85, "")
        _write_pictures(mesh, cameras, staging)
        known = _compared_with_truth(bundle, mesh, cameras[0].device, entered)
        entered("write report", 0.98, "")
        report = {
            **sections,
            "plan": asdict(plan),
            "cameras": {camera.name: camera_report(camera.curves) for camera in cameras},
            "redundancy": dict(meshed.redundancy),
            "mesh": {**meshed.figures, "figures": mesh_figures(mesh.vertices_mm, mesh.faces)},
            **known,
            "stages_s": watch.finished(),
        }
        write_report(report, staging / REPORT)
    progress("done", 1.0, f"{len(mesh.faces)} triangles")
    return report


def _sections(recorded: Bundle, devices: Calibration, axis: Axis) -> dict[str, object]:
    """The parts of the report that the frames themselves tell."""
    return capture_report(recorded.capture, axis, check_capture(recorded.capture)) | {
        "calibration": {"id": calibration_id(devices)}
    }


def _require_calibration(recorded: Bundle) -> Calibration:
    names = list(recorded.capture.cameras)
    found = recorded.calibration
    if found is None:
        message = (
            f"{recorded.folder}: no calibration.json beside the frames, and without one nothing can be measured; "
            "put one there, or name one with --calibration FILE"
        )
        raise CalibrationError(message)
    missing = [name for name in names if name not in found.cameras]
    if missing:
        message = (
            f"{recorded.folder}: the calibration knows cameras {sorted(found.cameras)}, the frames are of {names}; "
            f"calibrate {missing}, or use the names of the calibration"
        )
        raise CalibrationError(message)
    if found.projector is None and len(names) < 2:
        message = (
            f"{recorded.folder}: the calibration has no projector, and the bundle one camera ('{names[0]}'): one of "
            "them is needed as the second ray; calibrate the projector, or add a camera"
        )
        raise CalibrationError(message)
    return found


def _axis(recorded: Bundle, devices: Calibration) -> Axis:
    """The axis to triangulate by: of those shown, the one that the first camera stands to the side of.

    A light sheet that contains the camera's centre is seen edge on and tells no depth.
    """
    shown = {pattern.axis for pattern in _shown(recorded) if isinstance(pattern, Gray)}
    if len(shown) == 1:
        return shown.pop()
    if devices.projector is None:
        return Axis.COLUMN
    camera = devices.cameras[next(iter(recorded.capture.cameras))]
    beside, above, _ = devices.projector.rotation @ camera.centre_mm + devices.projector.translation_mm
    return Axis.COLUMN if abs(beside) >= abs(above) else Axis.ROW


def _tables(recorded: Bundle, frames: AxisFrames) -> CodeTables:
    size = recorded.capture.projector
    lines = frames.line_patterns
    return CodeTables(
        index_of_word=index_of_word(frames.gray),
        cell_position=cell_positions(frames.gray, size),
        position_of=line_positions(lines, frames.gray, size) if lines else edge_positions(frames.gray, size),
    )


def _step_px(recorded: Bundle, axis: Axis) -> float:
    """Greatest distance between neighbouring curves: of lines where there are any, of code edges otherwise."""
    shown = _shown(recorded)
    lines = sorted((p for p in shown if isinstance(p, LineShift) and p.axis is axis), key=lambda p: p.shift)
    if lines:
        shifts = [p.shift for p in lines]
        return float(np.diff([*shifts, shifts[0] + lines[0].period_px]).max())
    return float(next(p.cell_px for p in shown if isinstance(p, Gray) and p.axis is axis))


def _shown(recorded: Bundle) -> set[Pattern]:
    """The patterns of which there are frames; a description may list more."""
    return {recorded.capture.patterns[shot.pattern] for shot in recorded.capture.shots}


def _seen(
    recorded: Bundle, devices: Calibration, axis: Axis, entered: Callable[[str, float, str], None]
) -> list[_Seen]:
    cameras = []
    share = 0.5 / len(recorded.capture.cameras)
    stages = ("decode", "locate stripes", "identify stripes", "link stripes")
    for index, name in enumerate(recorded.capture.cameras):
        start = 0.1 + index * share

        def stage_entered(stage: str, name: str = name, start: float = start) -> None:
            entered(stage, start + share * stages.index(stage) / len(stages), f"camera '{name}'")

        try:
            frames = axis_frames(recorded.capture, name, axis)
            tables = _tables(recorded, frames)
        except PatternError as cause:
            message = f"{recorded.folder}: {cause}"
            raise PatternError(message) from cause
        curves = camera_curves(frames, tables, Limits(), entered=stage_entered)
        cameras.append(
            _Seen(
                name=name,
                device=devices.cameras[name],
                curves=curves,
                white=np.clip(np.rint(frames.white), 0, np.iinfo(np.uint16).max).astype(np.uint16),
                largest_contrast=float(frames.contrast.max()),
                full_scale=frames.full_scale,
            )
        )
    folder = recorded.folder
    _require(any(seen.curves.decoded_pixels > 0 for seen in cameras), folder, "no pixel could be decoded", cameras)
    _require(any(seen.curves.stripe_count > 0 for seen in cameras), folder, "no stripe was found", cameras)
    return cameras


def _triangulated(cameras: list[_Seen], projector: Pinhole | None, axis: Axis) -> tuple[MergedCurves, list[_Seen]]:
    """The curves of all cameras, and the cameras with the points that fell off the projector among their refusals."""
    if projector is not None:
        parts = [camera_projector(seen.curves.ensemble, seen.device, projector, axis) for seen in cameras]
        told = [
            replace(seen, curves=replace(seen.curves, refusal=_with_dropped(seen.curves, part)))
            for seen, part in zip(cameras, parts, strict=True)
        ]
        return merged(parts, projector.centre_mm, widest_gap_px=_WIDEST_GAP_PX), told
    first, *others = cameras
    parts = [camera_camera(first.curves.ensemble, seen.curves.ensemble, first.device, seen.device) for seen in others]
    # Without a projector the light sheet has no rows to merge by; the pair that gives most is used.
    best = max(parts, key=lambda part: len(part.points_mm))
    return merged([best], first.device.centre_mm, widest_gap_px=_WIDEST_GAP_PX), cameras


def _with_dropped(curves: CameraCurves, triangulated: SheetCurves) -> NDArray[np.uint8]:
    """The refusals with those points among them that met their light sheet where the projector has no pixel."""
    before, after = (x + 1j * y for x, y in (curves.ensemble.points_px.T, triangulated.pixels_px.T))
    columns, rows = np.rint(curves.ensemble.points_px[~np.isin(before, after)]).astype(int).T
    refusal = curves.refusal.copy()
    refusal[rows, columns] = Refusal.OFF_PROJECTOR
    return refusal


def _meshed(
    folder: Path,
    cameras: list[_Seen],
    projector: Pinhole | None,
    axis: Axis,
    plan: ReconstructionPlan,
    step_px: float,
    staging: Path,
    entered: Callable[[str, float, str], None],
) -> _Meshed:
    """Triangulate, mesh, and write the points."""
    first = cameras[0]
    joined_curves, cameras = _triangulated(cameras, projector, axis)
    points = joined_curves.curves
    _require(len(points.points_mm) > 0, folder, "no stripe could be triangulated", cameras)
    entered("mesh", 0.68, f"{len(points.points_mm)} points")
    surface = initial_mesh(
        points.points_mm, points.offsets, points.position_px, points.bridge_after,
        sampling_mm(points.points_mm, first.device, projector, step_px), first.device.centre_mm,
        widest_step_px=step_px * plan.max_code_gap, depth_edge_ratio=plan.depth_edge_ratio, keep_holes=plan.keep_holes,
    )  # fmt: skip
    _require(len(surface.faces) > 0, folder, "no two neighbouring stripes could be meshed", cameras)
    sigma = sigma_along_normal(points.deviation_mm, surface.normals)
    grey = _grey(joined_curves, cameras)
    curves = PointCurves(
        offsets=points.offsets,
        column_px=points.position_px,
        points_mm=points.points_mm,
        sigma_mm=sigma,
        bridge_after=points.bridge_after,
        source=points.source,
        grey=grey,
    )
    write_points(curves, staging / "points.ply")
    kept = compact(surface.faces, vertex_count=len(points.points_mm))
    used = kept.kept
    mesh = Mesh(
        vertices_mm=points.points_mm[used].astype(np.float32),
        faces=kept.faces,
        normals=surface.normals[used],
        grey=grey[used],
        sigma_mm=sigma[used].astype(np.float32),
        stripe=np.floor(points.position_px[points.curve_of_point()[used]]).astype(np.int32),
    )
    return _Meshed(mesh, cameras, mesh_report(surface, mesh, curves), redundancy_report(joined_curves, points.source))


def _grey(joined_curves: MergedCurves, cameras: list[_Seen]) -> NDArray[np.uint8]:
    """(n,) uint8: brightness of each point in the white frame of the camera whose pixel it has."""
    pixels = joined_curves.curves.pixels_px
    grey = np.zeros(len(pixels), dtype=np.uint8)
    for index, seen in enumerate(cameras):
        mine = joined_curves.camera == index
        columns, rows = np.rint(pixels[mine]).astype(int).T
        grey[mine] = np.clip(np.rint(seen.white[rows, columns] * (255 / seen.full_scale)), 0, 255)
    return grey


def _write_pictures(mesh: Mesh, cameras: list[_Seen], staging: Path) -> None:
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


def _require(holds: bool, folder: Path, what: str, cameras: list[_Seen]) -> None:
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

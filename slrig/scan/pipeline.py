"""A scan, walked: the one file where its layers meet.

`capture_bundle` plays and records, `reconstruct_bundle` turns a recorded bundle into a mesh; a live scan is one after
the other, so that what was measured can always be computed again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from slrig.bundle import Bundle, BundleWriter, read_bundle, read_truth, write_truth
from slrig.capture.evidence import check_capture
from slrig.capture.sequencer import capture
from slrig.devices import Rig
from slrig.errors import CalibrationError, NothingToReconstructError, PatternError, ScanCancelledError
from slrig.meshing.initial import InitialMesh, initial_mesh
from slrig.meshing.quality import score
from slrig.meshing.topology import compact
from slrig.model import Axis, Calibration, Gray, Mesh, Pinhole, Pixels, PointCurves
from slrig.patterns.positions import cell_positions, edge_positions, index_of_word, line_positions
from slrig.reconstruction.camera import CameraCurves, CodeTables, Limits, camera_curves
from slrig.reconstruction.frames import AxisFrames, Image, axis_frames
from slrig.reconstruction.merging import MergedCurves, merged
from slrig.reconstruction.triangulation import SheetCurves, camera_camera, camera_projector
from slrig.reconstruction.uncertainty import sampling_mm, sigma_along_normal
from slrig.scan.artefacts import write_mesh, write_points, write_report
from slrig.scan.holding import pattern_sequence
from slrig.scan.output import staged_folder
from slrig.scan.pictures import preview, rejection_picture, write_png
from slrig.scan.plan import ReconstructionPlan, ScanPlan
from slrig.scan.report import Stopwatch, camera_report, mesh_report, redundancy_report, scan_report

_WIDEST_GAP_PX = 4.0


class Progress(Protocol):
    """Told how far a scan is: the stage, the fraction done (0 to 1) of the whole call, and a few words."""

    def __call__(self, stage: str, fraction: float, detail: str, /) -> None:
        """Take note."""
        ...


@dataclass(frozen=True, slots=True)
class _Seen:
    """One camera: its frames, its calibration, its curves."""

    name: str
    device: Pinhole
    frames: AxisFrames
    curves: CameraCurves


def capture_bundle(
    rig: Rig, plan: ScanPlan, folder: Path, *, progress: Progress, cancelled: Callable[[], bool]
) -> None:
    """Play the plan's patterns on the rig and record a bundle in `folder`, which must not exist.

    Raises
    ------
    PatternError
        The plan does not fit the projector.
    DeviceError, ScanEvidenceError
        The rig failed, or the frames contradict the patterns.
    ScanCancelledError
        `cancelled()` became true.
    StorageError
        The disk refused. In every case nothing is left in `folder` and the projector is dark.
    """
    sequence = pattern_sequence(plan.patterns, rig.projector.info.size)
    if plan.exposure_s is not None:
        asked = plan.exposure_s
        rig = replace(rig, settings={name: replace(each, exposure_s=asked) for name, each in rig.settings.items()})
    formats = {name: camera.info.format for name, camera in rig.cameras.items()}
    total = len(sequence) * len(formats)
    with BundleWriter(folder, rig.projector.info.size, sequence.patterns, formats, rig.calibration) as writer:
        for count, shot in enumerate(capture(rig, sequence, cancelled=cancelled), start=1):
            writer.add(shot)
            progress("capture", count / total, f"frame {count} of {total}")
    truth = rig.truth()
    if truth is not None:
        write_truth(folder, truth)


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

    Writes mesh.ply, mesh.glb, mesh.stl, points.ply, report.json, preview.png and a picture of the refused
    pixels per camera. `output` appears whole or not at all; results of an earlier run there are replaced.

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
        evidence = check_capture(recorded.capture)
        axis = _axis(recorded)
        cameras = _seen(recorded, devices, axis, entered)
        entered("triangulate", 0.6, "")
        step_px = _tables(recorded, cameras[0].frames).step_px
        joined_curves = _curves(cameras, devices.projector, axis)
        points = joined_curves.curves
        _require(len(points.points_mm) > 0, recorded, "no stripe could be triangulated", cameras)
        entered("mesh", 0.68, f"{len(points.points_mm)} points")
        first = cameras[0]
        sampling = sampling_mm(points.points_mm, first.device, devices.projector, step_px)
        surface = initial_mesh(
            points.points_mm, points.offsets, points.position_px, points.bridge_after, sampling, first.device.centre_mm,
            widest_step_px=step_px * plan.max_code_gap, depth_edge_ratio=plan.depth_edge_ratio,
            keep_holes=plan.keep_holes,
        )  # fmt: skip
        _require(len(surface.faces) > 0, recorded, "no two neighbouring stripes could be meshed", cameras)
        mesh, curves = _finished(points, surface, joined_curves, cameras)
        entered("write mesh", 0.75, f"{len(mesh.faces)} triangles")
        write_mesh(mesh, staging)
        write_points(curves, staging / "points.ply")
        entered("pictures", 0.85, "")
        white = _displayable(first.frames.white)
        write_png(staging / "preview.png", preview(mesh, first.device, white, int(first.frames.full_scale)))
        for seen in cameras:
            write_png(
                staging / f"rejected-{seen.name}.png",
                rejection_picture(seen.curves.refusal, _displayable(seen.frames.white), int(seen.frames.full_scale)),
            )
        truth = read_truth(bundle)
        known: Mapping[str, object] | None = None
        if truth is not None:
            entered("compare with truth", 0.9, "")
            known = score(mesh, truth.surface, truth.visible_points_mm, first.device.centre_mm).as_dict()
        entered("write report", 0.98, "")
        report = scan_report(
            recorded=recorded,
            plan=plan,
            axis=axis,
            line_shift=len(first.frames.lines) > 0,
            evidence=evidence,
            cameras={seen.name: camera_report(seen.curves) for seen in cameras},
            redundancy=redundancy_report(joined_curves, points.source),
            mesh=mesh_report(surface, mesh, curves),
            truth=known,
            stages=watch.finished(),
        )
        write_report(report, staging / "report.json")
    progress("done", 1.0, f"{len(mesh.faces)} triangles")
    return report


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


def _axis(recorded: Bundle) -> Axis:
    axes = {pattern.axis for pattern in recorded.capture.patterns if isinstance(pattern, Gray)}
    return Axis.ROW if axes == {Axis.ROW} else Axis.COLUMN


def _tables(recorded: Bundle, frames: AxisFrames) -> CodeTables:
    size = recorded.capture.projector
    lines = frames.line_patterns
    return CodeTables(
        index_of_word=index_of_word(frames.gray),
        cell_position=cell_positions(frames.gray, size),
        position_of=line_positions(lines, frames.gray, size) if lines else edge_positions(frames.gray, size),
        step_px=lines[0].period_px / len(lines) if lines else float(frames.gray.cell_px),
    )


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
        cameras.append(_Seen(name, devices.cameras[name], frames, curves))
    _require(any(seen.curves.decoded_pixels > 0 for seen in cameras), recorded, "no pixel could be decoded", cameras)
    _require(any(seen.curves.stripe_count > 0 for seen in cameras), recorded, "no stripe was found", cameras)
    return cameras


def _curves(cameras: list[_Seen], projector: Pinhole | None, axis: Axis) -> MergedCurves:
    if projector is not None:
        parts = [camera_projector(seen.curves.ensemble, seen.device, projector, axis) for seen in cameras]
        return merged(parts, projector.centre_mm, widest_gap_px=_WIDEST_GAP_PX)
    first, *others = cameras
    parts = [camera_camera(first.curves.ensemble, seen.curves.ensemble, first.device, seen.device) for seen in others]
    # Without a projector the light sheet has no rows to merge by; the pair that gives most is used.
    best = max(parts, key=lambda part: len(part.points_mm))
    return merged([best], first.device.centre_mm, widest_gap_px=_WIDEST_GAP_PX)


def _finished(
    points: SheetCurves, surface: InitialMesh, joined_curves: MergedCurves, cameras: list[_Seen]
) -> tuple[Mesh, PointCurves]:
    sigma = sigma_along_normal(points.deviation_mm, surface.normals)
    grey = np.zeros(len(points.points_mm), dtype=np.uint8)
    for index, seen in enumerate(cameras):
        mine = joined_curves.camera == index
        columns, rows = np.rint(points.pixels_px[mine]).astype(int).T
        grey[mine] = np.clip(np.rint(seen.frames.white[rows, columns] * (255 / seen.frames.full_scale)), 0, 255)
    curves = PointCurves(
        offsets=points.offsets,
        column_px=points.position_px,
        points_mm=points.points_mm,
        sigma_mm=sigma,
        bridge_after=points.bridge_after,
        source=points.source,
        grey=grey,
    )
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
    return mesh, curves


def _displayable(image: Image) -> Pixels:
    """(H, W) uint16: a frame averaged or fused as float32, back in camera units."""
    return np.clip(np.rint(image), 0, np.iinfo(np.uint16).max).astype(np.uint16)


def _require(holds: bool, recorded: Bundle, what: str, cameras: list[_Seen]) -> None:
    """Refuse a scan that holds no surface, with the figures that tell why."""
    if holds:
        return
    figures = []
    for seen in cameras:
        contrast = seen.frames.contrast
        lit = float((seen.curves.refusal != 1).mean())
        figures.append(
            f"camera '{seen.name}': white {seen.frames.white.mean():.0f}, black {seen.frames.black.mean():.0f} of "
            f"{seen.frames.full_scale:.0f} on average, largest difference {contrast.max():.0f}, {lit:.1%} of the image "
            f"lit, {seen.curves.decoded_pixels} pixels decoded"
        )
    message = (
        f"{recorded.folder}: {what}. {'; '.join(figures)}. Look whether the projector lit the object, the lens cap is "
        "off, and the exposure leaves white below full scale and well above black"
    )
    raise NothingToReconstructError(message)

"""The second half of a scan, walked: the one file where the rooms of its mathematics meet.

A live scan is recorded as a bundle first (`slrig.scan.acquisition`), so that what was measured can always be computed
again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slrig.bundle import read_health, read_notes, read_truth, read_turntable_angle, write_file
from slrig.capture import EvidenceSummary
from slrig.errors import NothingToReconstructError, ScanCancelledError
from slrig.jobs.frame_feed import FedFrames
from slrig.jobs.versions import computed
from slrig.kernels import KernelCount, report_compilations, trim_malloc
from slrig.meshing import MeshingLimits, MeshStage, Viewpoints, build_surface, compact_mesh, mesh_figures, score
from slrig.model import FloatArray, IntArray, Mesh, PointCurves, Region, Source
from slrig.reconstruction import (
    MergedCurves,
    project,
    sampling_mm,
    sigma_along_normal,
)
from slrig.scan.artefacts import MESH, REPORT, encode_mesh_ply, encode_points_ply, encode_report, staged_folder
from slrig.scan.axis_agreement import agreement_report, axis_test
from slrig.scan.colouring import albedo_report, coloured
from slrig.scan.coverage import covered_share, layered_share, with_uncovered_refused
from slrig.scan.limited import marked, within
from slrig.scan.losses import LossStage, coverage_notes, require_coverage, require_surface
from slrig.scan.measured import Walked, measured
from slrig.scan.mesh_formats import encode_mesh_glb
from slrig.scan.mirror_images import mirror_image_notes, without_mirror_images, without_surface
from slrig.scan.offered import agreement_picture as agreement_name
from slrig.scan.offered import causes_picture, rejected_picture
from slrig.scan.pictures import (
    agreement_picture,
    described_causes,
    encode_png,
    preview,
    rejection_picture,
    rejection_size,
)
from slrig.scan.plan import ProgressCallback, ReconstructionPlan
from slrig.scan.preparation import prepare_kernels
from slrig.scan.report import (
    Stopwatch,
    calibration_report,
    camera_report,
    mesh_report,
    redundancy_report,
    sigma_words,
    view_report,
    with_seconds,
)
from slrig.scan.soundness import fault_notes, layer_notes, truth_notes
from slrig.scan.stream import CameraResult, LiveScan
from slrig.scan.triangulated import Triangulated, calibration_sigma_mm, curve_spacing, disagreement_sigma_mm

_BETWEEN = frozenset({"read bundle", "check frames"})
"""What is done with each frame between other stages."""


@dataclass(frozen=True, slots=True)
class _Meshed:
    """The mesh and its points, the cameras with all their refusals, and what the report says.

    calibration_sigma_mm : (n,) float64, the calibration's part of each point's standard deviation, and
    mesh_calibration_sigma_mm : (V,) of each vertex's; None where the calibration does not state its error. normals :
    (n, 3) float32 of the points, NaN beside the mesh. notes : for the report.
    """

    mesh: Mesh
    curves: PointCurves
    normals: NDArray[np.float32]
    calibration_sigma_mm: FloatArray | None
    mesh_calibration_sigma_mm: FloatArray | None
    cameras: list[CameraResult]
    stages: tuple[MeshStage, ...]
    figures: Mapping[str, object]
    redundancy: Mapping[str, object]
    albedo: Mapping[str, object]
    notes: tuple[str, ...]


def reconstruct_bundle(
    bundle: Path,
    output: Path,
    *,
    plan: ReconstructionPlan,
    calibration: Path | None = None,
    progress: ProgressCallback,
    cancelled: Callable[[], bool],
    live: LiveScan | None = None,
) -> dict[str, object]:
    """Reconstruct a recorded bundle into `output`, as `reconstruct_into` does, and return the report. `output` appears
    whole or not at all; results of an earlier run there are replaced.

    Raises
    ------
    InvalidInputError
        `output` holds something else.
    BundleError, CalibrationError, PatternError, NothingToReconstructError, ScanCancelledError, StorageError
        See `reconstruct_into`.
    """
    with staged_folder(output) as staging:
        return reconstruct_into(
            bundle, staging, plan=plan, calibration=calibration, progress=progress, cancelled=cancelled, live=live
        )


def reconstruct_into(
    bundle: Path,
    folder: Path,
    *,
    plan: ReconstructionPlan,
    calibration: Path | None = None,
    progress: ProgressCallback,
    cancelled: Callable[[], bool],
    made: Callable[[str], None] = lambda _: None,
    where: Mapping[str, str] | None = None,
    live: LiveScan | None = None,
    judged: EvidenceSummary | None = None,
) -> dict[str, object]:
    """Reconstruct a recorded bundle into a folder that only its maker knows yet, and return the report.

    `live` has taken the frames already while they were captured; where it is of this bundle they are not read again.
    judged : what the frames proved as they were captured, so that they need not be judged again.
    where : `slrig.jobs.worker_process.Task.where`, for the report.

    Writes mesh.ply first, then mesh.glb and points.ply, then preview.png, two pictures of the refused pixels
    per camera, and report.json. Each file appears whole, and `made` is told its name; whoever keeps the folder has to
    bring it to disk.

    Raises
    ------
    BundleError, CalibrationError, PatternError
        The bundle cannot be used as it is.
    NothingToReconstructError
        The frames hold no surface.
    ScanCancelledError
        `cancelled()` became true.
    StorageError
        The disk refused.
    """
    watch = Stopwatch() if live is None else live.watch

    at = ("", 0.0, "")

    def entered(stage: str, fraction: float, detail: str) -> None:
        nonlocal at
        if cancelled():
            message = f"the scan was cancelled before '{stage}'"
            raise ScanCancelledError(message)
        watch.enter(stage)
        # Frames are read and checked one after another while those before them are decoded: that is no step back.
        if (stage, fraction, detail) != at and not (at[0] and stage in _BETWEEN):
            at = (stage, fraction, detail)
            trim_malloc()
            progress(stage, fraction, detail)

    def compiling(kernel: str) -> None:
        # What only some scans need is compiled when the first one comes.
        progress(*at[:2], f"preparing kernels, first time only: {kernel}")

    def place(name: str, data: bytes | bytearray) -> None:
        write_file(folder / name, data, durable=False)
        made(name)

    with report_compilations(compiling), ThreadPoolExecutor(1, thread_name_prefix="slrig-pictures") as beside:
        entered("read bundle", 0.0, str(bundle))
        walked, found = measured(
            bundle, calibration, live, entered, axis=plan.axis, region=plan.region, judged=judged,
            drop_finest_bits=plan.drop_finest_bits,
        )  # fmt: skip
        meshed = _meshed(bundle, found, walked, plan, entered)
        mesh, cameras = meshed.mesh, meshed.cameras
        cameras = [with_uncovered_refused(mesh, seen) for seen in cameras]
        covered = covered_share(cameras[0])
        require_coverage(bundle, cameras, covered)
        entered("write mesh", 0.75, f"{len(mesh.faces)} triangles")
        # One at a time: each is as large as the mesh.
        place(MESH, encode_mesh_ply(mesh, sigma_calibration_mm=meshed.mesh_calibration_sigma_mm))
        # The mesh is what somebody waits for; what is left is shared by two threads.
        pictures = beside.submit(_encoded_pictures, mesh, cameras)
        place("mesh.glb", encode_mesh_glb(mesh))
        place(
            "points.ply",
            encode_points_ply(meshed.curves, meshed.normals, sigma_calibration_mm=meshed.calibration_sigma_mm),
        )
        sizes = mesh_figures(mesh.vertices_mm, mesh.faces)
        figures = {**meshed.figures, "figures": sizes}
        entered("pictures", 0.85, "")
        for name, picture in pictures.result().items():
            place(name, picture)
        known = _compared_with_truth(bundle, mesh, cameras, plan.region, entered)
        if (turntable := read_turntable_angle(bundle)) is not None:
            known["turntable"] = turntable.document()
        entered("write report", 0.98, "")
        seconds = watch.finished()
        report = {
            **walked.sections,
            "notes": [
                *read_notes(bundle),
                *coverage_notes(cameras, covered),
                *walked.notes,
                *meshed.notes,
                *fault_notes(sizes),
                *truth_notes(known.get("truth", {})),
            ],
            "calibration": calibration_report(walked.devices, bundle, mesh.sigma_mm, meshed.mesh_calibration_sigma_mm),
            "health": read_health(bundle),
            "plan": asdict(plan),
            "computed": computed(where or {"where": "local"}),
            "causes": described_causes(),
            "cameras": {
                each.name: {
                    **camera_report(each.curves, each.exposures),
                    **view_report(each.device, rejection_size(each.device.size)),
                }
                for each in cameras
            },
            "redundancy": dict(meshed.redundancy),
            "albedo": dict(meshed.albedo),
            "mesh": {**figures, "covers_of_decoded": covered, "stages": with_seconds(meshed.stages, seconds)},
            **known,
            "stages_s": seconds,
        }
        place(REPORT, encode_report(report))
    progress("done", 1.0, f"{len(mesh.faces)} triangles")
    return report


def frame_receiver() -> FedFrames:
    """What takes the frames of a capture while they come: see `slrig.jobs.worker_process.serve`."""
    return FedFrames(LiveScan)


def warm_kernels(told: Callable[[KernelCount], None]) -> None:
    """Load every kernel that a usual scan needs; see `slrig.scan.preparation.prepare_kernels`."""
    prepare_kernels(reconstruct_bundle, told)


def _meshed(
    folder: Path,
    found: Triangulated,
    walked: Walked,
    plan: ReconstructionPlan,
    entered: Callable[[str, float, str], None],
) -> _Meshed:
    """From points to the mesh."""
    axis, step_px = walked.axis, walked.step_px
    cameras, merged, devices = found.cameras, found.merged, found.agreement.calibration
    points = merged.curves
    require_surface(
        len(points.points_mm) > 0, folder, "no stripe could be triangulated", cameras, stage=LossStage.GEOMETRY
    )
    count = f"{len(points.points_mm)} points"
    projector, first = devices.projector, cameras[0]
    spacing = curve_spacing(
        cameras, merged, step_px, walked.cell_px, max_gap=plan.max_code_gap, widest_gap_px=found.widest_gap_px
    )
    sampling = sampling_mm(points.points_mm, first.device, projector, axis, spacing.at_points_px)
    second = cameras[found.second].device if projector is None else projector
    views = Viewpoints(
        merged.camera,
        np.stack([camera.device.centre_mm for camera in cameras]),
        second.centre_mm,
        points.deviation_mm,
    )
    surface = build_surface(
        points.points_mm, points.offsets, points.position_px, points.bridge_after,
        # Two points of one place are as far apart as noise has them.
        np.hypot(sampling, np.linalg.norm(points.deviation_mm, axis=1)), views,
        MeshingLimits(
            widest_step_px=step_px * plan.max_code_gap,
            depth_edge_ratio=plan.depth_edge_ratio,
            keep_holes=plan.keep_holes,
            flip_rule=plan.flip_rule,
            smooth_boundary=plan.smooth_boundary,
        ),
        on_step=lambda stage: entered(stage, 0.68, count),
        runs=spacing.runs,
    )  # fmt: skip
    require_surface(len(surface.faces) > 0, folder, without_surface(surface, projector), cameras, stage=LossStage.MESH)
    entered("vertices", 0.72, count)
    cameras, merged, surface = without_mirror_images(cameras, merged, surface, found.mirror_images)
    found, points = replace(found, cameras=cameras, merged=merged), merged.curves
    sigma = sigma_along_normal(points.deviation_mm, surface.normals)
    share = calibration_sigma_mm(found, walked.devices, surface.normals, axis)
    if share is not None:
        sigma = np.hypot(sigma, share)
    disagreement = disagreement_sigma_mm(found, surface.normals, axis)
    if disagreement is not None:
        sigma = np.hypot(sigma, disagreement)
    tested = axis_test(walked.agreement, merged, [each.name for each in cameras], surface.normals, sigma)
    sigma = np.hypot(sigma, tested.sigma_mm)
    limit_mm = None if plan.region is None else plan.region.max_sigma_mm
    if limit_mm is not None:
        known = sigma <= limit_mm
        surface = surface.with_points(known, "sigma_limit")
        cameras = [_where_known(seen, merged, index, known) for index, seen in enumerate(cameras)]
        if len(surface.faces) == 0:
            message = (
                f"{folder}: no surface is known to {limit_mm:g} mm, half of the points to {np.nanmedian(sigma):.2g} "
                "mm; raise max_sigma_mm, or give the scan more light"
            )
            raise NothingToReconstructError(message)
    light = walked.devices.light
    colours = coloured(cameras, merged, surface.normals, projector, axis, light)
    curves = PointCurves(
        offsets=points.offsets,
        column_px=points.position_px,
        points_mm=points.points_mm,
        sigma_mm=sigma,
        bridge_after=points.bridge_after,
        source=points.source,
        colour=colours.colour,
        mark=colours.mark,
    )
    apart_mm = plan.depth_edge_ratio * float(np.median(sampling))
    alone = points.source != Source.ALL
    layered = {
        seen.name: layered_share(seen, points, alone & (merged.camera == index), surface.faces, apart_mm)
        for index, seen in enumerate(cameras)
    }
    mesh = compact_mesh(
        surface.faces, points.points_mm, surface.normals, colours.colour, colours.mark, sigma, points.offsets,
        points.position_px,
    )  # fmt: skip
    holds = sigma_words(tested.result, has_calibration=share is not None)
    return _Meshed(
        mesh=mesh,
        curves=curves,
        normals=surface.normals,
        calibration_sigma_mm=share,
        mesh_calibration_sigma_mm=None if share is None else share[_used(surface.faces, len(share))],
        cameras=cameras,
        stages=surface.stages,
        figures={**mesh_report(surface, mesh, curves, holds), "layered": layered},
        redundancy={
            **redundancy_report(merged, points.source, found.agreement.redundancy, found.agreement.report),
            **agreement_report(walked.agreement),
        },
        albedo=albedo_report(colours, mesh, cameras, lit=projector is not None, mapped=light is not None),
        notes=(
            *mirror_image_notes(surface, cameras, projector),
            *layer_notes(layered),
            *found.notes,
            *tested.notes,
        ),
    )


def _where_known(seen: CameraResult, merged: MergedCurves, index: int, known: NDArray[np.bool_]) -> CameraResult:
    """A camera with those of its points among its refusals that are not `known`, (n,) bool, well enough."""
    mine = merged.camera == index
    refusal = marked(seen.curves.refusal, merged.curves.pixels_px[mine], known[mine])
    return replace(seen, curves=replace(seen.curves, refusal=refusal))


def _used(faces: IntArray, count: int) -> NDArray[np.bool_]:
    """(count,) bool: the points that a triangle uses, which are the vertices of the mesh in the same order."""
    used = np.zeros(count, dtype=np.bool_)
    used[faces] = True
    return used


def _encoded_pictures(mesh: Mesh, cameras: list[CameraResult]) -> dict[str, bytes]:
    """PNG of each picture by its name."""
    first = cameras[0]
    encoded = {"preview.png": encode_png(preview(mesh, first.device, first.white, int(first.full_scale)))}
    for seen in cameras:
        if seen.second is not None and seen.second.residual_px is not None:
            residuals = agreement_picture(seen.second.residual_px, "projector px", seen.white, int(seen.full_scale))
            encoded[agreement_name(seen.name)] = encode_png(residuals)
        picture = rejection_picture(seen.curves.refusal, seen.white, int(seen.full_scale))
        encoded[rejected_picture(seen.name)] = encode_png(picture)
        encoded[causes_picture(seen.name)] = encode_png(seen.curves.refusal)
    return encoded


def _compared_with_truth(
    bundle: Path,
    mesh: Mesh,
    cameras: list[CameraResult],
    region: Region | None,
    entered: Callable[[str, float, str], None],
) -> dict[str, Mapping[str, object]]:
    """The report's section on truth, for bundles that bring it; it is of the first camera."""
    truth = read_truth(bundle)
    if truth is None:
        return {}
    entered("compare with truth", 0.9, "")
    seen, visible = cameras[0], truth.visible_points_mm
    if region is not None:
        # What nobody asked for is not missing.
        pixels = np.clip(project(seen.device, visible), 0, np.array(seen.curves.refusal.shape[::-1]) - 1)
        visible = visible[within(region, visible, pixels, seen.curves.refusal, seen.device)]
    return {"truth": score(mesh, truth.surface, visible, *(each.device.centre_mm for each in cameras)).as_dict()}

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
from slrig.errors import ScanCancelledError
from slrig.jobs.frame_feed import FedFrames
from slrig.jobs.versions import computed
from slrig.kernels import KernelCount, report_compilations, trim_malloc
from slrig.meshing import MeshingLimits, MeshStage, build_surface, compact_mesh, mesh_figures, score
from slrig.model import Axis, Calibration, FloatArray, IntArray, Mesh, PointCurves, Region
from slrig.reconstruction import (
    MergedCurves,
    calibration_modes,
    calibration_sigma,
    find_disagreement,
    project,
    sampling_mm,
    sigma_along_normal,
    stripe_tangents,
)
from slrig.scan.artefacts import MESH, REPORT, encode_mesh_ply, encode_points_ply, encode_report, staged_folder
from slrig.scan.colouring import albedo_report, coloured
from slrig.scan.coverage import coverage_notes, covered_share, require_surface
from slrig.scan.limited import marked, within
from slrig.scan.measured import Walked, measured
from slrig.scan.mesh_formats import encode_mesh_glb
from slrig.scan.offered import causes_picture, rejected_picture
from slrig.scan.pictures import described_causes, encode_png, preview, rejection_picture, rejection_size
from slrig.scan.plan import ProgressCallback, ReconstructionPlan
from slrig.scan.preparation import prepare_kernels
from slrig.scan.report import (
    Stopwatch,
    calibration_report,
    camera_report,
    mesh_report,
    redundancy_report,
    view_report,
    with_seconds,
)
from slrig.scan.stream import CameraResult, LiveScan
from slrig.scan.triangulated import Triangulated, steps, widest_gap_px

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
        walked, found = measured(bundle, calibration, live, entered, axis=plan.axis, region=plan.region, judged=judged)
        meshed = _meshed(bundle, found, walked, plan, entered)
        mesh, cameras = meshed.mesh, meshed.cameras
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
        covered = covered_share(mesh, cameras[0])
        figures = {**meshed.figures, "figures": mesh_figures(mesh.vertices_mm, mesh.faces)}
        entered("pictures", 0.85, "")
        for name, picture in pictures.result().items():
            place(name, picture)
        known = _compared_with_truth(bundle, mesh, cameras[0], plan.region, entered)
        if (turntable := read_turntable_angle(bundle)) is not None:
            known["turntable"] = turntable.document()
        entered("write report", 0.98, "")
        seconds = watch.finished()
        report = {
            **walked.sections,
            "notes": [*read_notes(bundle), *walked.notes, *meshed.notes, *coverage_notes(cameras[0].name, covered)],
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
    first, axis, step_px = walked.seen[0], walked.axis, walked.step_px
    cameras, joined_curves = found.cameras, found.joined
    points = joined_curves.curves
    require_surface(len(points.points_mm) > 0, folder, "no stripe could be triangulated", cameras)
    count = f"{len(points.points_mm)} points"
    projector = walked.devices.projector
    gap_px = widest_gap_px(projector, axis)
    beside = steps(cameras, joined_curves, step_px, walked.cell_px, max_gap=plan.max_code_gap, widest_gap_px=gap_px)
    sampling = sampling_mm(points.points_mm, first.device, projector, axis, beside.at_points_px)
    surface = build_surface(
        points.points_mm, points.offsets, points.position_px, points.bridge_after,
        # Two points of one place are as far apart as noise has them.
        np.hypot(sampling, np.linalg.norm(points.deviation_mm, axis=1)), first.device.centre_mm,
        MeshingLimits(
            widest_step_px=step_px * plan.max_code_gap,
            depth_edge_ratio=plan.depth_edge_ratio,
            keep_holes=plan.keep_holes,
            flip_rule=plan.flip_rule,
            smooth_boundary=plan.smooth_boundary,
        ),
        on_step=lambda stage: entered(stage, 0.68, count),
        runs=beside.runs,
    )  # fmt: skip
    require_surface(len(surface.faces) > 0, folder, "no two neighbouring stripes could be meshed", cameras)
    entered("vertices", 0.72, count)
    sigma = sigma_along_normal(points.deviation_mm, surface.normals)
    share = _calibration_share(walked.devices, found, axis, surface.normals)
    if share is not None:
        sigma = np.hypot(sigma, share)
    apart = find_disagreement(joined_curves, share)
    if apart is not None:
        sigma = np.hypot(sigma, apart.sigma_mm)
    limit_mm = None if plan.region is None else plan.region.max_sigma_mm
    if limit_mm is not None:
        known = sigma <= limit_mm
        surface = surface.with_points(known, "sigma_limit")
        cameras = [_where_known(seen, joined_curves, index, known) for index, seen in enumerate(cameras)]
        require_surface(len(surface.faces) > 0, folder, f"no surface is known to {limit_mm:g} mm", cameras)
    light = walked.devices.light
    colours = coloured(cameras, joined_curves, surface.normals, projector, axis, light)
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
    mesh = compact_mesh(
        surface.faces, points.points_mm, surface.normals, colours.colour, colours.mark, sigma, points.offsets,
        points.position_px,
    )  # fmt: skip
    return _Meshed(
        mesh=mesh,
        curves=curves,
        normals=surface.normals,
        calibration_sigma_mm=share,
        mesh_calibration_sigma_mm=None if share is None else share[_used(surface.faces, len(share))],
        cameras=cameras,
        stages=surface.stages,
        figures=mesh_report(surface, mesh, curves, has_calibration=share is not None),
        redundancy=redundancy_report(joined_curves, points.source, found.spare),
        albedo=albedo_report(colours, mesh, cameras, lit=projector is not None, mapped=light is not None),
        notes=() if apart is None else (str(apart),),
    )


def _where_known(seen: CameraResult, joined: MergedCurves, index: int, known: NDArray[np.bool_]) -> CameraResult:
    """A camera with those of its points among its refusals that are not `known`, (n,) bool, well enough."""
    mine = joined.camera == index
    refusal = marked(seen.curves.refusal, joined.curves.pixels_px[mine], known[mine])
    return replace(seen, curves=replace(seen.curves, refusal=refusal))


def _used(faces: IntArray, count: int) -> NDArray[np.bool_]:
    """(count,) bool: the points that a triangle uses, which are the vertices of the mesh in the same order."""
    used = np.zeros(count, dtype=np.bool_)
    used[faces] = True
    return used


def _calibration_share(
    calibration: Calibration, found: Triangulated, axis: Axis, normals: NDArray[np.float32]
) -> FloatArray | None:
    """(n,) float64: the calibration's part of each point's standard deviation; None where it states no error."""
    modes = calibration_modes(calibration, [seen.name for seen in found.cameras], axis, second=found.second)
    if modes is None:
        return None
    points = found.joined.curves
    tangents = stripe_tangents(points.points_mm, points.offsets, points.bridge_after)
    return calibration_sigma(modes, points.points_mm, normals, points.source, found.joined.camera, tangents)


def _encoded_pictures(mesh: Mesh, cameras: list[CameraResult]) -> dict[str, bytes]:
    """PNG of each picture by its name."""
    first = cameras[0]
    encoded = {"preview.png": encode_png(preview(mesh, first.device, first.white, int(first.full_scale)))}
    for seen in cameras:
        picture = rejection_picture(seen.curves.refusal, seen.white, int(seen.full_scale))
        encoded[rejected_picture(seen.name)] = encode_png(picture)
        encoded[causes_picture(seen.name)] = encode_png(seen.curves.refusal)
    return encoded


def _compared_with_truth(
    bundle: Path, mesh: Mesh, seen: CameraResult, region: Region | None, entered: Callable[[str, float, str], None]
) -> dict[str, object]:
    """The report's section on truth, for bundles that bring it. seen : the first camera."""
    truth = read_truth(bundle)
    if truth is None:
        return {}
    entered("compare with truth", 0.9, "")
    visible = truth.visible_points_mm
    if region is not None:
        # What nobody asked for is not missing.
        pixels = np.clip(project(seen.device, visible), 0, np.array(seen.curves.refusal.shape[::-1]) - 1)
        visible = visible[within(region, visible, pixels, seen.curves.refusal, seen.device)]
    return {"truth": score(mesh, truth.surface, visible, seen.device.centre_mm).as_dict()}

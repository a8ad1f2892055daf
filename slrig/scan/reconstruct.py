"""Reconstruction of a scan from its bundle: the order of the steps, from frames to the files of the result.

A live scan is recorded as a bundle first (`slrig.scan.acquisition`), so that what was measured can always be computed
again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.bundle import (
    CALIBRATION,
    read_capture,
    read_health,
    read_notes,
    read_truth,
    read_turntable_angle,
    write_calibration,
    write_file,
)
from slrig.capture import EvidenceSummary
from slrig.disk import storage_errors
from slrig.errors import CalibrationError, NothingToReconstructError, PatternError, setting
from slrig.jobs.listener import SILENT, Listener
from slrig.jobs.records import computed
from slrig.kernels import KernelCount, report_compilations, trim_malloc
from slrig.meshing import (
    MeshingLimits,
    MeshStage,
    Viewpoints,
    build_surface,
    compact_mesh,
    covered_pixels,
    depth_ranges,
    mesh_figures,
    score,
)
from slrig.model import (
    AlbedoMark,
    Axis,
    Calibration,
    Capture,
    FloatArray,
    Gray,
    IntArray,
    LightMap,
    Mesh,
    NoiseModel,
    PointCurves,
    Refusal,
    Region,
    Sine,
    Size,
    Source,
    light_map_coordinates,
    trim_incomplete_codes,
)
from slrig.patterns import cell_positions, index_of_word, require_numbered
from slrig.reconstruction import (
    AxisFrames,
    DecodingLimits,
    MergedCurves,
    SheetCurves,
    axis_frames,
    decode_edges,
    decode_sinusoids,
    estimate_noise,
    exposure_count,
    fuse_exposures,
    lit_pixels,
    optical_depths_mm,
    position_map,
    project,
    sampling_mm,
    sigma_along_normal,
)
from slrig.scan.agreement import agreement_report, axis_test
from slrig.scan.artefacts import (
    MESH,
    REPORT,
    REPORT_FORMAT,
    FileAxes,
    encode_mesh_ply,
    encode_points_ply,
    encode_report,
    fault_notes,
    layer_notes,
    staged_folder,
    truth_notes,
    write_report,
)
from slrig.scan.formats import agreement_picture as agreement_name
from slrig.scan.formats import causes_picture, encode_mesh_glb, rejected_picture
from slrig.scan.losses import (
    LossStage,
    coverage_notes,
    mirror_image_notes,
    require_coverage,
    require_surface,
    without_mirror_images,
    without_surface,
)
from slrig.scan.measured import (
    Entered,
    Triangulated,
    Walked,
    calibration_sigma_mm,
    curve_spacing,
    disagreement_sigma_mm,
    measured,
)
from slrig.scan.pictures import (
    agreement_picture,
    albedo_report,
    coloured,
    described_causes,
    encode_png,
    placed_vertices,
    places_px,
    preview,
    rejection_picture,
    rejection_size,
)
from slrig.scan.plan import ReconstructionPlan, length_unit
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
from slrig.scan.stream import CameraResult, LiveScan, marked, within

_PICTURE_PX = 480
"""Wide enough for a share, and a tenth of the work at full size."""


def with_uncovered_refused(mesh: Mesh, seen: CameraResult) -> CameraResult:
    """The camera with the decoded pixels that no triangle of the mesh covers among its refusals."""
    covered = covered_pixels(placed_vertices(mesh.vertices_mm, seen.device), mesh.faces, seen.device.size)
    refusal = seen.curves.refusal
    bare = (refusal == Refusal.NONE) & ~covered
    return replace(seen, curves=replace(seen.curves, refusal=np.where(bare, np.uint8(Refusal.NO_SURFACE), refusal)))


def covered_share(seen: CameraResult) -> float | None:
    """The share of the pixels without another cause that the mesh covers; None without such pixels. seen : a result of
    `with_uncovered_refused`.
    """
    covered, bare = (np.count_nonzero(seen.curves.refusal == each) for each in (Refusal.NONE, Refusal.NO_SURFACE))
    return covered / (covered + bare) if covered + bare else None


def _sampled_every(width_px: int) -> int:
    return max(1, -(-width_px // _PICTURE_PX))


def layered_share(
    seen: CameraResult, curves: SheetCurves, mine: NDArray[np.bool_], faces: IntArray, least_mm: float
) -> float:
    """The share of a mesh's image in a camera where two of its triangles lie one behind the other.

    Counted on a picture of at most 480 pixels' width. mine : (n,) bool, the points that this camera alone measured
    (others are moved in its image): triangles with others do not count. faces : (F, 3) int32 into the points.
    least_mm : smaller distances are folds of noise.
    """
    size = seen.device.size
    step = _sampled_every(size.width_px)
    faces = faces if mine.all() else faces[mine[faces].all(axis=1)]
    placed = np.column_stack((curves.pixels_px / step, optical_depths_mm(seen.device, curves.points_mm)))
    nearest, furthest = depth_ranges(placed, faces, Size(size.width_px // step, size.height_px // step))
    covered = int(np.count_nonzero(nearest <= furthest))
    return int(np.count_nonzero(furthest - nearest > least_mm)) / max(covered, 1)


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
    listener: Listener = SILENT,
    *,
    plan: ReconstructionPlan,
    calibration: Path | None = None,
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
        return reconstruct_into(bundle, staging, listener, plan=plan, calibration=calibration, live=live)


def reconstruct_into(
    bundle: Path,
    folder: Path,
    listener: Listener = SILENT,
    *,
    plan: ReconstructionPlan,
    calibration: Path | None = None,
    where: Mapping[str, str] | None = None,
    live: LiveScan | None = None,
    judged: EvidenceSummary | None = None,
) -> dict[str, object]:
    """Reconstruct a recorded bundle into a folder that only its maker knows yet, and return the report.

    `live` has taken the frames already while they were captured; where it is of this bundle they are not read again.
    judged : what the frames proved as they were captured, so that they need not be judged again.
    where : `slrig.jobs.worker.Task.where`, for the report.

    Writes mesh.ply first (of an uncalibrated rig calibration.json before it), then mesh.glb and points.ply, then
    preview.png, two pictures of the refused pixels per camera, and report.json. Each file appears whole, and the
    listener is told its name; whoever keeps the folder has to bring it to disk.

    Raises
    ------
    BundleError, CalibrationError, PatternError
        The bundle cannot be used as it is.
    NothingToReconstructError
        The frames hold no surface.
    SolveRefusedError
        The plan has no calibration, and the scan determines none.
    ScanCancelledError
        The listener had it cancelled.
    StorageError
        The disk refused.
    """
    watch = Stopwatch() if live is None else live.watch
    axes = FileAxes.of(plan.mesh_axes, plan.rig_in_base)

    at = ("", 0.0, "")

    def entered(stage: str, fraction: float, detail: str) -> None:
        nonlocal at
        listener.check(f"the scan was cancelled before '{stage}'")
        watch.enter(stage)
        # Frames are read and checked one after another while those before them are decoded: that is no step back.
        if (stage, fraction, detail) != at and not (at[0] and stage in _BETWEEN):
            at = (stage, fraction, detail)
            trim_malloc()
            listener.report(stage, fraction, detail)

    def compiling(kernel: str) -> None:
        # What only some scans need is compiled when the first one comes.
        listener.report(*at[:2], f"preparing kernels, first time only: {kernel}")

    def place(name: str, data: bytes | bytearray) -> None:
        write_file(folder / name, data, durable=False)
        listener.file_ready(name)

    with report_compilations(compiling), ThreadPoolExecutor(1, thread_name_prefix="slrig-pictures") as beside:
        entered("read bundle", 0.0, str(bundle))
        walked, found = measured(
            bundle, calibration, live, entered, axis=plan.axis, region=plan.region, judged=judged,
            drop_finest_bits=plan.drop_finest_bits, uncalibrated=plan.uncalibrated,
        )  # fmt: skip
        if plan.uncalibrated is not None:
            write_calibration(folder / CALIBRATION, walked.devices)
            listener.file_ready(CALIBRATION)
        meshed = _meshed(bundle, found, walked, plan, entered)
        mesh, cameras = meshed.mesh, meshed.cameras
        cameras = [with_uncovered_refused(mesh, seen) for seen in cameras]
        covered = covered_share(cameras[0])
        require_coverage(bundle, cameras, covered)
        entered("write mesh", 0.75, f"{len(mesh.faces)} triangles")
        # One at a time: each is as large as the mesh.
        place(MESH, encode_mesh_ply(mesh, sigma_calibration_mm=meshed.mesh_calibration_sigma_mm, axes=axes))
        # The mesh is what somebody waits for; what is left is shared by two threads.
        pictures = beside.submit(_encoded_pictures, mesh, cameras, length_unit(plan.uncalibrated))
        place("mesh.glb", encode_mesh_glb(mesh))
        place(
            "points.ply",
            encode_points_ply(
                meshed.curves, meshed.normals, sigma_calibration_mm=meshed.calibration_sigma_mm, axes=axes
            ),
        )
        sizes = mesh_figures(mesh.vertices_mm, mesh.faces)
        figures = {**meshed.figures, "figures": sizes}
        entered("pictures", 0.85, "")
        for name, picture in pictures.result().items():
            place(name, picture)
        # Without a calibration nothing is known of the scale.
        is_own = plan.uncalibrated is not None
        known = {} if is_own else _compared_with_truth(bundle, mesh, cameras, walked.devices, plan.region, entered)
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
    listener.report("done", 1.0, f"{len(mesh.faces)} triangles")
    return report


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
    centres_mm = [
        *(camera.device.centre_mm for camera in cameras),
        *([] if projector is None else [projector.centre_mm]),
    ]
    # Without a projector, the other camera is the last that measured the point.
    second = np.full(len(merged.camera), len(cameras)) if projector is not None else np.frexp(merged.seen_by)[1] - 1
    views = Viewpoints(np.stack(centres_mm), merged.camera, second.astype(np.int32), points.deviation_mm)
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


def _encoded_pictures(mesh: Mesh, cameras: list[CameraResult], unit: str) -> dict[str, bytes]:
    """PNG of each picture by its name."""
    first = cameras[0]
    encoded = {"preview.png": encode_png(preview(mesh, first.device, first.white, int(first.full_scale), unit=unit))}
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
    calibration: Calibration,
    region: Region | None,
    entered: Callable[[str, float, str], None],
) -> dict[str, Mapping[str, object]]:
    """The report's section on truth, for bundles that bring it; it is of the first camera."""
    truth = read_truth(bundle)
    if truth is None:
        return {}
    entered("compare with truth", 0.9, "")
    seen, (surface, visible) = cameras[0], truth.in_world_of(calibration)
    if region is not None:
        # What nobody asked for is not missing.
        pixels = np.clip(project(seen.device, visible), 0, np.array(seen.curves.refusal.shape[::-1]) - 1)
        visible = visible[within(region, visible, pixels, seen.curves.refusal, seen.device)]
    return {"truth": score(mesh, surface, visible, *(each.device.centre_mm for each in cameras)).as_dict()}


_FEW, _MANY = 0.05, 0.25


@dataclass(frozen=True, slots=True)
class Decoded:
    """One camera and axis. Shares: lit, of the image; decoded, saturated, ambiguous and unresolved (the finest bit), of
    what is lit. contrast : median of white less black over full scale, of what is lit.
    """

    camera: str
    axis: Axis
    lit: float
    decoded: float
    saturated: float
    ambiguous: float
    unresolved: float
    contrast: float

    def __str__(self) -> str:
        lit = f"camera '{self.camera}', {self.axis.value}s: {self.lit:.0%} of the image is lit"
        return f"{lit}, {self.decoded:.0%} of that decoded"

    @property
    def advice(self) -> list[str]:
        """What to change, one sentence each."""
        told = []
        if self.lit < _FEW:
            told.append("hardly anything is lit: do camera and projector look at the same place? Lengthen the exposure")
        elif self.contrast < _FEW:
            told.append("the light is weak: lengthen the exposure, open the lens, or darken the room")
        if self.saturated > _FEW:
            told.append(
                f"{self.saturated:.0%} is saturated: shorten the exposure, or scan with "
                f"several: {setting('exposures_s')}"
            )
        if self.unresolved > _FEW:
            told.append(
                f"the finest bit does not resolve on {self.unresolved:.0%}: look at the focus of camera and projector, "
                f"or play wider cells: {setting('gray_cell_px')}"
            )
        if self.ambiguous > _MANY:
            told.append(
                f"bits are ambiguous on {self.ambiguous:.0%}: something moved, light is reflected from part to part, "
                "or the surface is translucent or dark"
            )
        return told


def decode_bundle(bundle: Path, output: Path) -> tuple[list[Decoded], tuple[str, ...]]:
    """Decode a recorded bundle into `output`, which appears whole or not at all. With words for codes cut short.

    Raises
    ------
    BundleError, PatternError
        The frames cannot be read or decoded.
    InvalidInputError, StorageError
        `output` holds something else, or the disk refused.
    """
    capture, cut_short = trim_incomplete_codes(read_capture(bundle))
    axes = [axis for axis in Axis if any(isinstance(p, Gray | Sine) and p.axis is axis for p in capture.patterns)]
    if not axes:
        message = f"{bundle}: no frames of Gray code or sinusoids: nothing can be decoded"
        raise PatternError(message)
    with staged_folder(output) as staging:
        found = [_decoded(capture, camera, axis, staging) for camera in capture.cameras for axis in axes]
        report: Mapping[str, object] = {
            "format": REPORT_FORMAT,
            "version": 1,
            "method": "decoding only",
            "notes": list(cut_short),
            "decoded": [asdict(each) | {"axis": each.axis.value, "advice": each.advice} for each in found],
        }
        write_report(report, staging / REPORT)
    return found, cut_short


def _decoded(capture: Capture, camera: str, axis: Axis, folder: Path) -> Decoded:
    from tifffile import imwrite

    frames, noise = _frames(capture, camera, axis)
    limits = DecodingLimits()
    lit = lit_pixels(frames, noise, limits)
    words = index_of_word(frames.gray)
    if frames.sine_patterns:
        if not len(frames.bits):
            require_numbered(frames.sine_patterns, capture.projector)
        found = decode_sinusoids(frames, noise, words, capture.projector.along(axis), limits)
        code, position, unresolved = found.code, found.measured.position, np.zeros(lit.shape, dtype=np.uint8)
    else:
        cells = cell_positions(frames.gray, capture.projector)
        code, unresolved = decode_edges(frames, noise, words, len(cells), limits)
        position = position_map(frames, noise, code, cells).position
    name = f"{camera}-{axis.value}"
    with storage_errors(folder):
        imwrite(folder / f"position-{name}.tiff", position)
    coloured = encode_png(_coloured(position, capture.projector.along(axis)))
    write_file(folder / f"position-{name}.png", coloured)
    white = np.clip(np.rint(frames.white), 0, np.iinfo(np.uint16).max).astype(np.uint16)
    refused = encode_png(rejection_picture(code.refusal, white, int(frames.clipped_at)))
    write_file(folder / f"rejected-{name}.png", refused)
    count = max(int(lit.sum()), 1)
    return Decoded(
        camera=camera,
        axis=axis,
        lit=float(lit.mean()),
        decoded=float((code.refusal == Refusal.NONE).sum() / count),
        saturated=float((lit & (frames.white >= frames.clipped_at)).sum() / count),
        ambiguous=float((code.refusal == Refusal.AMBIGUOUS_BIT).sum() / count),
        unresolved=float((lit & (unresolved > 0)).sum() / count),
        contrast=float(np.median(frames.contrast[lit]) / frames.full_scale) if lit.any() else 0.0,
    )


def _frames(capture: Capture, camera: str, axis: Axis) -> tuple[AxisFrames, NoiseModel]:
    if exposure_count({shot.exposure_s for shot in capture.shots if shot.camera == camera}) > 1:
        fused = fuse_exposures(capture, camera, axis)
        return fused.frames, fused.noise
    frames = axis_frames(capture, camera, axis)
    return frames, estimate_noise(frames)


def _coloured(position: NDArray[np.float32], extent_px: int) -> NDArray[np.uint8]:
    """(H, W, 3) uint8, blue, green, red: from blue at the projector's first position to red at its last."""
    known = np.isfinite(position)
    grey = np.where(known, np.clip(np.nan_to_num(position) / extent_px, 0, 1) * 255, 0).astype(np.uint8)
    picture = cv2.applyColorMap(grey, cv2.COLORMAP_TURBO)
    picture[~known] = 0
    return np.asarray(picture, dtype=np.uint8)


_CELLS = 24  # along each side of the image: light is smooth over one, and noise and paper's grain are not
_LEAST_POINTS = 10
_MOST_SATURATED, _MOST_BENT, _MOST_UNSEEN, _MOST_UNEVEN = 0.02, 0.02, 0.75, 0.02
_DEGREE = 4


def with_light_map(bundle: Path, entered: Entered) -> Calibration:
    """The calibration of a scan of a plain white board, with the projector's light as the board shows it.

    What the board sends back, over cosine and squared distance, is the light's share; its logarithm is fitted by a
    polynomial over the image, in each channel that the scan has. Between channels that makes the board white.

    Raises
    ------
    CalibrationError
        The scan has no calibrated projector, or is of no board: not flat, not even, overexposed, or it covers too
        little of the projector's image. Further as `measured`.
    """
    walked, found = measured(bundle, None, None, entered, axis=None)
    projector, curves = found.agreement.calibration.projector, found.merged.curves
    if projector is None:
        message = f"{bundle}: expected a scan by a calibrated projector, found none; calibrate the rig with it"
        raise CalibrationError(message)
    away = curves.points_mm - curves.points_mm.mean(axis=0)
    extents, axes = np.linalg.eigh(away.T @ away)
    normals = np.tile(axes[:, 0] * np.sign(axes[:, 0] @ (projector.centre_mm - curves.points_mm[0])), (len(away), 1))
    seen = coloured(found.cameras, found.merged, normals.astype(np.float32), projector, walked.axis)
    places = places_px(curves, walked.axis)
    value, good = seen.found.value, (seen.mark == AlbedoMark.NONE) & (seen.found.value > 0).all(axis=1)
    # Of each cell of the image: the mean place, and the mean logarithm of what the board sends back.
    column, row = (np.clip((light_map_coordinates(places[good], projector.size) + 1) / 2, 0, 0.9999) * _CELLS).astype(
        int
    )
    cell = row * _CELLS + column
    counts = np.bincount(cell, minlength=_CELLS**2)
    known = counts >= _LEAST_POINTS
    middles, logs = (
        np.stack([np.bincount(cell, each, _CELLS**2)[known] / counts[known] for each in values[good].T], axis=1)
        for values in (places, np.log(np.maximum(value, 1e-9)))
    )
    powers = np.array([(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)])
    terms = np.prod(light_map_coordinates(middles, projector.size).T[:, None] ** powers, axis=2)
    fitted = np.linalg.lstsq(terms, logs, rcond=None)[0]
    uneven = float(np.sqrt(((logs - terms @ fitted) ** 2).mean())) if known.any() else np.inf
    saturated = float((seen.mark == AlbedoMark.SATURATED).mean())
    bent, unseen = float(np.sqrt(max(extents[0], 0) / extents[2])), 1 - float(known.mean())
    for much, most, words in (
        (saturated, _MOST_SATURATED, "is saturated: expose for less"),
        (bent, _MOST_BENT, "stands out of a plane: show a flat board alone"),
        (unseen, _MOST_UNSEEN, "of the projector's image shows no board: use a larger or a nearer one"),
        (uneven, _MOST_UNEVEN, "is left of a smooth fit: the board is stained, shines, or is not plain white"),
    ):
        if not much <= most:
            message = f"{bundle}: expected a plain white board, found that {much:.1%} {words}; {most:.0%} may"
            raise CalibrationError(message)
    coefficients = np.zeros((logs.shape[1], _DEGREE + 1, _DEGREE + 1))
    coefficients[:, powers[:, 0], powers[:, 1]] = fitted.T
    coefficients[:, 0, 0] -= logs.mean()
    light = LightMap(coefficients, np.array([middles.min(axis=0), middles.max(axis=0)]))
    return replace(walked.devices, light=light)

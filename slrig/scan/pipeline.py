"""The second half of a scan, walked: the one file where the rooms of its mathematics meet.

A live scan is recorded as a bundle first (`slrig.scan.acquisition`), so that what was measured can always be computed
again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
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
from slrig.kernels import Prepared, compilations_told
from slrig.meshing.quality import mesh_figures, score
from slrig.meshing.surface import MeshingLimits, Stage, finished_mesh
from slrig.meshing.vertices import brightness, compact_mesh
from slrig.model import Axis, Calibration, FloatArray, IntArray, Mesh, Pinhole, PointCurves, without_missing_bits
from slrig.reconstruction.agreement import disagreement
from slrig.reconstruction.calibration_share import calibration_modes, calibration_sigma, stripe_tangents
from slrig.reconstruction.uncertainty import sampling_mm, sigma_along_normal
from slrig.scan.artefacts import write_mesh, write_points, write_report
from slrig.scan.calibration_report import calibration_report
from slrig.scan.coverage import coverage_notes, covered_share, require_surface
from slrig.scan.light_axis import FAIR_SHARE, LEAST_SHARE, weakness
from slrig.scan.offered import rejected_picture
from slrig.scan.outline import Outline
from slrig.scan.output import REPORT, staged_folder
from slrig.scan.pictures import preview, rejection_picture, write_png
from slrig.scan.plan import Progress, ReconstructionPlan
from slrig.scan.preparation import prepare_kernels
from slrig.scan.report import (
    Stopwatch,
    calibration_id,
    camera_report,
    capture_notes,
    capture_report,
    mesh_report,
    redundancy_report,
    with_seconds,
)
from slrig.scan.resolved import steps, unresolved_notes
from slrig.scan.stream import LiveScan, ScanStream, Seen, step_px
from slrig.scan.triangulated import Triangulated, triangulated, widest_gap_px

_STAGES = ("decode", "locate stripes", "refine stripes", "identify stripes", "link stripes")


@dataclass(frozen=True, slots=True)
class _Walked:
    """What the frames told: the curves of every camera, and their part of the report."""

    devices: Calibration
    axis: Axis
    shown: frozenset[Axis]
    seen: list[Seen]
    step_px: float
    sections: dict[str, object]
    notes: list[str]


@dataclass(frozen=True, slots=True)
class _Meshed:
    """The mesh and its points, the cameras with all their refusals, and what the report says.

    share_mm : (n,) float64, the calibration's part of each point's standard deviation, and mesh_share_mm : (V,) of each
    vertex's; None where the calibration does not state its error. notes : for the report.
    """

    mesh: Mesh
    curves: PointCurves
    share_mm: FloatArray | None
    mesh_share_mm: FloatArray | None
    cameras: list[Seen]
    stages: tuple[Stage, ...]
    figures: Mapping[str, object]
    redundancy: Mapping[str, object]
    notes: tuple[str, ...]


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

    at = ("", 0.0)

    def entered(stage: str, fraction: float, detail: str) -> None:
        nonlocal at
        if cancelled():
            message = f"the scan was cancelled before '{stage}'"
            raise ScanCancelledError(message)
        watch.enter(stage)
        at = (stage, fraction)
        progress(stage, fraction, detail)

    def compiling(kernel: str) -> None:
        # What only some scans need is compiled when the first one comes.
        progress(*at, f"preparing kernels, first time only: {kernel}")

    with compilations_told(compiling), staged_folder(output) as staging:
        entered("read bundle", 0.0, str(bundle))
        walked = _walked(bundle, calibration, live, entered, axis=plan.axis)
        found = _triangulated(walked, bundle, entered)
        (other,) = set(Axis) - {walked.axis}
        if plan.axis is None and found.share_across < FAIR_SHARE and other in walked.shown:
            # The projector does not stand as was assumed: its stripes run the other way.
            walked = _walked(bundle, calibration, None, entered, axis=other)
            found = _triangulated(walked, bundle, entered)
        depth = _told_depth(found, walked, bundle)
        meshed = _meshed(bundle, found, walked, plan, entered)
        mesh, cameras = meshed.mesh, meshed.cameras
        entered("write mesh", 0.75, f"{len(mesh.faces)} triangles")
        write_points(meshed.curves, staging / "points.ply", sigma_calibration_mm=meshed.share_mm)
        write_mesh(mesh, staging, sigma_calibration_mm=meshed.mesh_share_mm)
        entered("pictures", 0.85, "")
        _write_pictures(mesh, cameras, staging)
        covered = covered_share(mesh, cameras[0])
        known = _compared_with_truth(bundle, mesh, cameras[0].device, entered)
        entered("write report", 0.98, "")
        figures = {**meshed.figures, "figures": mesh_figures(mesh.vertices_mm, mesh.faces)}
        seconds = watch.finished()
        report = {
            **walked.sections,
            "notes": [*walked.notes, *depth, *meshed.notes, *coverage_notes(cameras[0].name, covered)],
            "calibration": calibration_report(walked.devices, bundle, mesh.sigma_mm, meshed.mesh_share_mm),
            "health": read_health(bundle),
            "plan": asdict(plan),
            "cameras": {each.name: camera_report(each.curves, each.exposures) for each in cameras},
            "redundancy": dict(meshed.redundancy),
            "mesh": {**figures, "covers_of_decoded": covered, "stages": with_seconds(meshed.stages, seconds)},
            **known,
            "stages_s": seconds,
        }
        write_report(report, staging / REPORT)
    progress("done", 1.0, f"{len(mesh.faces)} triangles")
    return report


def warm_kernels(told: Callable[[Prepared], None]) -> None:
    """Load every kernel that a usual scan needs; see `slrig.scan.preparation.prepare_kernels`."""
    prepare_kernels(reconstruct_bundle, told)


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
    folder: Path,
    calibration_file: Path | None,
    live: LiveScan | None,
    entered: Callable[[str, float, str], None],
    *,
    axis: Axis | None = None,
) -> _Walked:
    """Frames to curves: those that came while the scan was captured, or else those of the bundle, along `axis`."""
    names: list[str] = []
    cut_short: tuple[str, ...] = ()
    last = ""

    def stage_entered(stage: str, name: str) -> None:
        nonlocal last
        if last != stage + name:
            last = stage + name
            share = (names.index(name) + _STAGES.index(stage) / len(_STAGES)) / len(names)
            entered(stage, 0.1 + 0.5 * share, f"camera '{name}'")

    if (
        live is not None
        and live.evidence is not None
        and axis in (None, live.stream.axis)
        and _is_of(live, folder, calibration_file)
    ):
        names += live.stream.outline.cameras
        devices, stream, evidence = live.calibration, live.stream, live.evidence
        _require_calibration(folder, names, devices)
        seen = live.finish(stage_entered)
    else:
        recorded = read_bundle(folder, calibration_file=calibration_file)
        capture, cut_short = without_missing_bits(recorded.capture)
        names += capture.cameras
        devices = _require_calibration(folder, names, recorded.calibration)
        try:
            stream = ScanStream(Outline.of(capture), devices, entered=stage_entered, axis=axis)
            for name in names:
                for shot in capture.shots:
                    if shot.camera == name:
                        stream.take(shot)
            seen = stream.finish()
        except PatternError as cause:
            message = f"{folder}: {cause}"
            raise PatternError(message) from cause
        entered("check frames", 0.58, "")
        evidence = check_exposures(capture, read_refused(folder))
    sections = capture_report(stream.capture, stream.axis, evidence)
    step = step_px(stream.outline.shown, stream.axis)
    notes = [*cut_short, *capture_notes(stream.capture, stream.axis, evidence), *unresolved_notes(seen, step)]
    return _Walked(devices, stream.axis, stream.outline.axes, seen, step, sections, notes)


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


def _triangulated(walked: _Walked, folder: Path, entered: Callable[[str, float, str], None]) -> Triangulated:
    seen = walked.seen
    require_surface(any(each.curves.decoded_pixels > 0 for each in seen), folder, "no pixel could be decoded", seen)
    require_surface(any(each.curves.stripe_count > 0 for each in seen), folder, "no stripe was found", seen)
    entered("triangulate", 0.6, "")
    return triangulated(seen, walked.devices.projector, walked.axis)


def _told_depth(found: Triangulated, walked: _Walked, folder: Path) -> tuple[str, ...]:
    """A note on light that crosses the baseline obliquely. Light along it is refused."""
    words = weakness(walked.axis, walked.shown, found.share_across)
    if words is not None and found.share_across < LEAST_SHARE:
        message = f"{folder}: {words}"
        raise NothingToReconstructError(message)
    return () if words is None else (words,)


def _meshed(
    folder: Path,
    found: Triangulated,
    walked: _Walked,
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
    beside = steps(cameras, joined_curves, step_px, max_gap=plan.max_code_gap, widest_gap_px=gap_px)
    sampling = sampling_mm(points.points_mm, first.device, projector, axis, beside.at_points_px)
    surface = finished_mesh(
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
        entered=lambda stage: entered(stage, 0.68, count),
        runs=beside.runs,
    )  # fmt: skip
    require_surface(len(surface.faces) > 0, folder, "no two neighbouring stripes could be meshed", cameras)
    entered("vertices", 0.72, count)
    sigma = sigma_along_normal(points.deviation_mm, surface.normals)
    share = _calibration_share(walked.devices, found, axis, surface.normals)
    if share is not None:
        sigma = np.hypot(sigma, share)
    apart = disagreement(joined_curves, share)
    if apart is not None:
        sigma = np.hypot(sigma, apart.sigma_mm)
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
        notes=() if apart is None else (str(apart),),
    )


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


def _write_pictures(mesh: Mesh, cameras: list[Seen], staging: Path) -> None:
    first = cameras[0]
    write_png(staging / "preview.png", preview(mesh, first.device, first.white, int(first.full_scale)))
    for seen in cameras:
        picture = rejection_picture(seen.curves.refusal, seen.white, int(seen.full_scale))
        write_png(staging / rejected_picture(seen.name), picture)


def _compared_with_truth(
    bundle: Path, mesh: Mesh, camera: Pinhole, entered: Callable[[str, float, str], None]
) -> dict[str, object]:
    """The report's section on truth, for bundles that bring it."""
    truth = read_truth(bundle)
    if truth is None:
        return {}
    entered("compare with truth", 0.9, "")
    return {"truth": score(mesh, truth.surface, truth.visible_points_mm, camera.centre_mm).as_dict()}

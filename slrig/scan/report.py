"""The report of a scan: what was done, in figures, and what was refused, by cause."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import datetime
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.bundle import read_description, read_health
from slrig.capture import EvidenceSummary
from slrig.meshing import MeshStage, SurfaceMesh
from slrig.model import (
    Axis,
    Calibration,
    CaptureHeader,
    FloatArray,
    Gray,
    LineShift,
    Mesh,
    Pinhole,
    PointCurves,
    Refusal,
    Sine,
    Size,
    SolveRecord,
    Source,
    rig_layout,
    units_sentence,
)
from slrig.reconstruction import CameraCurves, ExposureUse, MergedCurves, PairRedundancy, Redundancy
from slrig.scan.artefacts import REPORT_FORMAT

GRAY_ONLY = "Gray-only"
_MOST_OFF = 0.1


class Stopwatch:
    """Seconds per stage, by a monotonic clock; a stage entered again adds up."""

    def __init__(self) -> None:
        self._seconds: dict[str, float] = {}
        self._stage: str | None = None
        self._since = 0.0

    def enter(self, stage: str) -> None:
        """End the stage under way and begin this one."""
        now = time.perf_counter()
        if self._stage is not None:
            self._seconds[self._stage] = self._seconds.get(self._stage, 0.0) + now - self._since
        self._stage, self._since = stage, now

    def finished(self) -> dict[str, float]:
        """End the last stage; seconds per stage in the order of first entry."""
        if self._stage is not None:
            self.enter(self._stage)
        self._stage = None
        return {stage: round(seconds, 4) for stage, seconds in self._seconds.items()}


def camera_report(curves: CameraCurves, exposures: Sequence[ExposureUse] = ()) -> dict[str, object]:
    """One camera's part: pixels by cause, stripes, noise; and what each exposure of a bracket gave to good pixels."""
    counts = np.bincount(curves.refusal.ravel(), minlength=max(Refusal) + 1)
    bracket: dict[str, object] = {"exposures": [asdict(each) for each in exposures]} if exposures else {}
    if any(abs(each.light - 1) > _MOST_OFF for each in exposures):
        bracket["exposures_note"] = (
            "the light does not follow the exposure times (`light` would be 1): a video projector needs whole refresh "
            "periods, or the camera does not expose as it says. The frames are fused by the light as measured"
        )
    return bracket | {
        "decoded_pixels": curves.decoded_pixels,
        "measured_pixels": int(counts[Refusal.NONE]),
        "refused_pixels": {cause.name.lower(): int(counts[cause]) for cause in Refusal if cause is not Refusal.NONE},
        "clipped_pixels": {"white": curves.clipped_white, "code": curves.clipped_code},
        "samples": {"step": curves.sample_step, "full_scale": curves.full_scale},
        "lit_by_unresolved_bits": share_by_bits(curves),
        "lit_without_lines": round(lit_share(curves, curves.unresolved_lines), 4),
        "noise": {
            "read_variance": curves.noise.read_variance,
            "slope": curves.noise.slope,
            "compression_dn": curves.compression_dn,
            "shared_by_neighbours": curves.noise_correlation,
        },
        "gamma": round(curves.gamma, 2),
        "light_from_other_surfaces": dict(zip(("p50", "p95"), curves.light_from_surfaces, strict=True)),
        "stripe_scale_px": curves.scale_px,
        "stripe_points_found": curves.stripe_points,
        "stripe_points_coded": len(curves.ensemble.bridge_after),
        "stripes": curves.stripe_count,
        "curves": len(curves.ensemble.position_px),
        "bridges": int(curves.ensemble.bridge_after.sum()),
        "refined_by_all_lines": curves.refined,
        "frame_disagreement_px": curves.disagreement_px.tolist(),
        "bits_displaced_px": curves.bits_displaced_px.tolist(),
    }


def view_report(camera: Pinhole, picture: Size) -> dict[str, object]:
    """Where a camera stood, X_cam = R (X - centre), and which part of its picture of refused pixels is its image."""
    return {
        "centre_mm": camera.centre_mm.tolist(),
        "rotation": camera.rotation.tolist(),
        "rejected_png_px": [picture.width_px, picture.height_px],
    }


def share_by_bits(curves: CameraCurves) -> list[float] | None:
    """Of the lit pixels, the shares where every bit of the code resolves, all but the finest, and so on; None where
    bits only number lines.
    """
    if curves.unresolved is None:
        return None
    counts = np.bincount(curves.unresolved[lit_pixels(curves)], minlength=1)
    return [round(float(each), 4) for each in counts / max(counts.sum(), 1)]


def lit_pixels(curves: CameraCurves) -> NDArray[np.bool_]:
    """(H, W) bool: the pixels that are lit, of those that the scan was asked for."""
    return np.asarray((curves.refusal != Refusal.NOT_LIT) & (curves.refusal != Refusal.OUTSIDE_REGION))


def lit_share(curves: CameraCurves, where: NDArray[np.bool_] | None) -> float:
    """The share of the lit pixels that `where`, (H, W), marks; None marks none."""
    if where is None:
        return 0.0
    lit = lit_pixels(curves)
    return float((lit & where).sum() / max(lit.sum(), 1))


def redundancy_report(
    curves: MergedCurves,
    source: NDArray[np.uint8],
    spare: Redundancy,
    disagreement: Mapping[str, object] | None,
) -> dict[str, object]:
    """What several cameras say of one another: points by source, and how far their points of one ray are apart.

    `residual_px` has one entry per pair of cameras, or is null, and then `residual_px_absent` says why. It is of the
    calibration as stated; `disagreement` says what was done where it exceeds that.
    """
    counts = np.bincount(source, minlength=len(Source))
    report: dict[str, object] = {"points_by_source": {kind.name.lower(): int(counts[kind]) for kind in Source}}
    report["residual_px"] = [_pair_report(pair) for pair in spare.pairs] or None
    if disagreement is not None:
        report["disagreement"] = dict(disagreement)
    if spare.reason is not None:
        report["residual_px_absent"] = spare.reason
    if len(curves.residual_mm):
        report["residual_mm"] = {
            "pairs": len(curves.residual_mm),
            "mean": float(curves.residual_mm.mean()),
            "rms": float(np.sqrt((curves.residual_mm**2).mean())),
            "median_absolute": float(np.median(np.abs(curves.residual_mm))),
        }
        report["residual_over_sigma_median_absolute"] = float(np.median(np.abs(curves.residual_sigma)))
    return report


def _pair_report(pair: PairRedundancy) -> dict[str, object]:
    """Pixels are those of `camera`; the map has the rows and columns of cells of the image of `reference`."""
    return {
        "reference": pair.reference,
        "camera": pair.camera,
        "pairs": pair.pairs,
        "outlying": pair.outlying,
        "mean": pair.mean_px,
        "rms": pair.rms_px,
        "median_absolute": pair.median_absolute_px,
        "stated_rms": pair.stated_rms_px,
        "stated_calibration": pair.calibration_px,
        "over_stated": pair.over_stated,
        "contradiction": pair.contradiction,
        "map": {
            "mean": pair.map_mean_px.tolist(),
            "rms": pair.map_rms_px.tolist(),
            "pairs": pair.map_pairs.tolist(),
        },
    }


def sigma_words(second_axis: str | None = None, *, has_calibration: bool) -> str:
    """What the stated standard deviations hold.

    second_axis : what the other axis shows of the calibration, None if it was not played. has_calibration : True if the
    calibration states its error.
    """
    if has_calibration:
        words = "noise, and the error that the calibration states"
    elif second_axis is None:
        return "noise only: this calibration states no error, and this scan cannot test it"
    else:
        words = "noise; this calibration states no error"
    return words if second_axis is None else f"{words}; {second_axis}"


def mesh_report(surface: SurfaceMesh, mesh: Mesh, curves: PointCurves, sigma_holds: str) -> dict[str, object]:
    """What each step did to the mesh, and its stated error; sigma_holds : result of `sigma_words`."""
    sigma = np.percentile(mesh.sigma_mm, (5, 50, 95))
    return {
        "points": len(curves.points_mm),
        "curves": len(curves.column_px),
        **surface.steps,
        "sigma_mm": {"p5": float(sigma[0]), "p50": float(sigma[1]), "p95": float(sigma[2])},
        "sigma_holds": sigma_holds,
    }


def with_seconds(stages: Sequence[MeshStage], seconds: Mapping[str, float]) -> list[dict[str, object]]:
    """The paper's Table 1: each meshing stage with its triangles, boundary points and time."""
    return [{**asdict(stage), "seconds": seconds.get(stage.name)} for stage in stages]


def capture_report(capture: CaptureHeader, axis: Axis, evidence: EvidenceSummary) -> dict[str, object]:
    """What was shown and taken, and what the frames prove of themselves."""
    return {
        "format": REPORT_FORMAT,
        "version": 1,
        "method": _method(capture, axis),
        "identity": str(evidence),
        "axis": axis.value,
        "frames": {
            "patterns": len(capture.patterns),
            "shots": len(capture.frames),
            "projector_px": [capture.projector.width_px, capture.projector.height_px],
            "cameras_px": {n: [c.size.width_px, c.size.height_px] for n, c in capture.cameras.items()},
        },
        "evidence": {
            "patterns_verified": f"{evidence.verified}/{evidence.patterns}",
            "shot_again": evidence.shot_again,
            "shot_again_because": list(evidence.causes),
            "light_drift": dict(evidence.light_drift),
            "light": {
                name: {kind: asdict(factor) for kind, factor in kinds.items()} for name, kinds in evidence.light.items()
            },
            "contradictions": list(evidence.faults),
            "wrong_frames": {name: sorted(each) for name, each in evidence.wrong.items()},
        },
    }


def _method(capture: CaptureHeader, axis: Axis) -> str:
    kinds = {type(pattern) for pattern in capture.displayed_patterns if getattr(pattern, "axis", None) is axis}
    if LineShift in kinds:
        return "Gray code and line shift"
    if Sine in kinds:
        return "Gray code and phase shift" if Gray in kinds else "phase shift"
    return GRAY_ONLY


def capture_notes(
    capture: CaptureHeader,
    axis: Axis,
    evidence: EvidenceSummary,
    not_used: str | None = None,
    *,
    is_evened: bool = False,
) -> list[str]:
    """What a person should know of the frames, one sentence each. not_used : which wrong frames are not used.
    is_evened : light that changed between a bit and its inverse, or between line frames, was undone.
    """
    notes = []
    if _method(capture, axis) == GRAY_ONLY:
        notes.append(
            "Gray-only: no line-shift frames, so points lie on the edges of the Gray code, located to sub-pixel"
        )
    notes += [f"an exposure was left out: {cause}" for cause in evidence.left_out]
    # Wrong frames come first, and what became of them is said with them.
    fates = [f"; {not_used}"] if not_used is not None else []
    notes += [
        f"the frames contradict their patterns: {fault}{fate}"
        for fault, fate in zip_longest(evidence.faults, fates[: len(evidence.faults)], fillvalue="")
    ]
    unsteady = [
        f"camera '{name}': {', '.join(f'{kind} {factor}' for kind, factor in of.items())}"
        for name, of in evidence.light.items()
        if not all(factor.is_steady for factor in of.values())
    ]
    if unsteady:
        notes.append(
            f"the light is not the same in all frames ({'; '.join(unsteady)} the light of white): the projector's lamp "
            "follows the picture (dynamic contrast) or flickers, or the camera sets its exposure by itself. Each frame "
            f"was checked after one factor for its light{', and brought to the light of white' * is_evened}; switch "
            "off what changes the light for the least error"
        )
    return notes


def layout_notes(calibration: Calibration) -> list[str]:
    """Ask for the unit of a calibration of unknown origin whose devices do not stand as those of a bench do."""
    layout = rig_layout(calibration)
    if calibration.solved is not None or layout is None or layout.is_of_a_bench("mm"):
        return []
    return [
        f"{layout}. If that is not so, all lengths are in another unit, which no frame can show. "
        f"{units_sentence(layout)}"
    ]


_SECONDS_PER_DAY = 86_400.0


def calibration_report(
    calibration: Calibration, bundle: Path, sigma_mm: NDArray[np.float32], calibration_sigma_mm: FloatArray | None, /
) -> dict[str, object]:
    """The report's section on the calibration.

    sigma_mm : (V,), standard deviation of each vertex; calibration_sigma_mm : (V,), the calibration's part of it, None
    where the calibration does not state its error. Then only `id` is known, a digest of its numbers, and `absent` says
    why.

    `expected_error_mm` is that of the solve, or what it was when the scan was made (see `scan_error_mm`).
    `sigma_share` is the calibration's fraction of a vertex's variance, the median. `age_days` counts from the solve to
    the capture, and is null where one of the two instants is not known.
    """
    solved = calibration.solved
    if solved is None or calibration_sigma_mm is None:
        return {
            "id": calibration.digest,
            "solved_at": None,
            "age_days": None,
            "expected_error_mm": None,
            "sigma_share": None,
            "absent": "the calibration says nothing of its own error: it was written by hand, imported, or is exact",
        }
    with np.errstate(invalid="ignore", divide="ignore"):
        share = (calibration_sigma_mm / sigma_mm.astype(np.float64)) ** 2
    known = np.isfinite(share)
    age_days, words = _age(solved, bundle)
    health = read_health(bundle) or {}
    then_mm = health.get("expected_error_mm") if health.get("calibration") == solved.id else None
    report: dict[str, Any] = {
        "id": solved.id,
        "solved_at": solved.solved_at,
        "age_days": age_days,
        "expected_error_mm": then_mm or solved.expected_error_mm,
        "sigma_share": float(np.median(share[known])) if known.any() else None,
        "sigma_calibration_mm": float(np.median(calibration_sigma_mm[known])) if known.any() else None,
    }
    return report if words is None else {**report, "age_absent": words}


def _age(solved: SolveRecord, bundle: Path) -> tuple[float | None, str | None]:
    """Days from the solve to the capture, or None with the reason."""
    captured_at = read_description(bundle).captured_at
    if captured_at is None:
        return None, "the bundle does not say when it was captured"
    try:
        solved_at = datetime.fromisoformat(solved.solved_at)
    except ValueError:
        return None, f"the calibration says '{solved.solved_at}' where the date of its solve should be"
    if solved_at.tzinfo is None:
        return None, "the calibration gives the time of its solve without the offset from UTC"
    return round((captured_at - solved_at).total_seconds() / _SECONDS_PER_DAY, 4), None

"""The report of a scan: what was done, in figures, and what was refused, by cause."""

from __future__ import annotations

import hashlib
import json
import time

import numpy as np
from numpy.typing import NDArray

from slrig.capture.evidence import EvidenceSummary
from slrig.meshing.initial import InitialMesh
from slrig.model import Axis, Calibration, Capture, LineShift, Mesh, Pinhole, PointCurves, Refusal, Source
from slrig.reconstruction.camera import CameraCurves
from slrig.reconstruction.merging import MergedCurves
from slrig.scan.output import REPORT_FORMAT


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


def calibration_id(calibration: Calibration) -> str:
    """Twelve hexadecimal digits that change with any number of the calibration."""
    devices: dict[str, Pinhole | None] = {**calibration.cameras, "projector": calibration.projector}
    text = json.dumps(
        {
            name: None
            if device is None
            else [
                device.size.shape,
                *(a.tolist() for a in (device.matrix, device.distortion, device.rotation, device.translation_mm)),
            ]
            for name, device in devices.items()
        },
        sort_keys=True,
    )
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def camera_report(curves: CameraCurves) -> dict[str, object]:
    """One camera's part: pixels by cause, stripes, noise."""
    counts = np.bincount(curves.refusal.ravel(), minlength=len(Refusal))
    return {
        "decoded_pixels": curves.decoded_pixels,
        "refused_pixels": {cause.name.lower(): int(counts[cause]) for cause in Refusal if cause is not Refusal.NONE},
        "noise": {"read_variance": curves.noise.read_variance, "slope": curves.noise.slope},
        "stripe_scale_px": curves.scale_px,
        "stripe_points_found": curves.stripe_points,
        "stripe_points_coded": len(curves.ensemble.points_px),
        "stripes": curves.stripe_count,
        "curves": len(curves.ensemble.position_px),
        "bridges": int(curves.ensemble.bridge_after.sum()),
    }


def redundancy_report(curves: MergedCurves, source: NDArray[np.uint8]) -> dict[str, object]:
    """What several cameras say of one another: points by source, and the distance between their points of one ray."""
    counts = np.bincount(source, minlength=len(Source))
    report: dict[str, object] = {"points_by_source": {kind.name.lower(): int(counts[kind]) for kind in Source}}
    if len(curves.residual_mm):
        report["residual_mm"] = {
            "pairs": len(curves.residual_mm),
            "mean": float(curves.residual_mm.mean()),
            "rms": float(np.sqrt((curves.residual_mm**2).mean())),
            "median_absolute": float(np.median(np.abs(curves.residual_mm))),
        }
        report["residual_over_sigma_median_absolute"] = float(np.median(np.abs(curves.residual_sigma)))
    return report


def mesh_report(surface: InitialMesh, mesh: Mesh, curves: PointCurves) -> dict[str, object]:
    """The mesh by stage (the paper's Table 1 as far as it is built), and its stated error."""
    sigma = np.percentile(mesh.sigma_mm, (5, 50, 95))
    return {
        "points": len(curves.points_mm),
        "curves": len(curves.column_px),
        "initial": {
            "strips": surface.strip_pairs,
            "strip_triangles": surface.strip_triangles,
            "dropped_at_depth_edges": surface.dropped_at_depth_edges,
            "dropped_at_bridges": surface.dropped_at_bridges,
            "dropped_as_dust": surface.dropped_as_dust,
            "dropped_triangles": surface.dropped_triangles,
            "triangles": len(surface.faces),
        },
        "sigma_mm": {"p5": float(sigma[0]), "p50": float(sigma[1]), "p95": float(sigma[2])},
    }


def capture_report(capture: Capture, axis: Axis, evidence: EvidenceSummary) -> dict[str, object]:
    """What was shown and taken, and what the frames prove of themselves."""
    line_shift = any(
        isinstance(pattern := capture.patterns[shot.pattern], LineShift) and pattern.axis is axis
        for shot in capture.shots
    )
    return {
        "format": REPORT_FORMAT,
        "version": 1,
        "method": "Gray code and line shift" if line_shift else "Gray-only",
        "notes": _notes(line_shift, evidence),
        "axis": axis.value,
        "frames": {
            "patterns": len(capture.patterns),
            "shots": len(capture.shots),
            "projector_px": [capture.projector.width_px, capture.projector.height_px],
            "cameras_px": {n: [c.size.width_px, c.size.height_px] for n, c in capture.cameras.items()},
        },
        "evidence": {
            "patterns_verified": f"{evidence.verified}/{evidence.patterns}",
            "light_drift": dict(evidence.light_drift),
            "contradictions": list(evidence.faults),
        },
    }


def _notes(line_shift: bool, evidence: EvidenceSummary) -> list[str]:
    notes = []
    if not line_shift:
        notes.append(
            "Gray-only: no line-shift frames, so points lie on the edges of the Gray code, located to sub-pixel"
        )
    notes += [f"the frames contradict their patterns: {fault}" for fault in evidence.faults]
    return notes

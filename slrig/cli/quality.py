"""What a person is told of a scan when it is over."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def quality_lines(summary: Mapping[str, Any]) -> list[str]:
    """What a report's summary says about the frames, the mesh and its error, one line each."""
    lines = []
    if summary.get("identity") is not None:
        lines.append(f"{'frames':<10}{summary['identity']}")
    mesh = summary.get("mesh") or {}
    figures = mesh.get("figures") or {}
    if figures.get("triangles") is not None:
        lines.append(f"{'size':<10}{figures['vertices']:,} vertices, {figures['triangles']:,} triangles")
    sigma = (mesh.get("sigma_mm") or {}).get("p50")
    if sigma is not None:
        holds = mesh.get("sigma_holds")
        words = "" if holds is None else f"; {holds}"
        lines.append(f"{'stated':<10}standard deviation of a point {sigma:.4f} mm (median){words}")
    truth = summary.get("truth") or {}
    if truth:
        lines.append(f"{'error':<10}{_error(truth)}")
    return lines + [f"{'note':<10}{words}" for words in summary.get("notes") or []]


def _error(truth: Mapping[str, Any]) -> str:
    """The error against the known truth: of what is near it, and how much is not."""
    rms_mm, beyond, complete = (truth.get(name) for name in ("rms_mm", "gross_fraction", "complete_0.3mm"))
    words = "nothing within 1 mm of the known truth"
    if rms_mm is not None:
        words = f"rms {rms_mm:.4f} mm against the known truth"
        # Reports of earlier versions have the error alone.
        words += (
            "" if beyond is None else f", of the {1 - beyond:.1%} of the area within 1 mm; {beyond:.1%} beyond 1 mm"
        )
    return words if complete is None else f"{words}, {complete:.1%} of the visible surface within 0.3 mm"

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
    if truth.get("rms_mm") is not None:
        complete = truth.get("complete_0.3mm")
        covered = "" if complete is None else f", {complete:.1%} of the visible surface within 0.3 mm"
        lines.append(f"{'error':<10}rms {truth['rms_mm']:.4f} mm against the known truth{covered}")
    return lines + [f"{'note':<10}{words}" for words in summary.get("notes") or []]

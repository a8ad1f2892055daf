"""How much of what a camera decoded the mesh covers. A scan that lost most of it says so; one that lost all fails."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from slrig.errors import NothingToReconstructError, setting
from slrig.meshing import covered_pixels
from slrig.model import Mesh, Refusal
from slrig.scan.placing import placed_vertices
from slrig.scan.report import lit_pixels
from slrig.scan.stream import CameraResult

FAIR_SHARE = 0.6
"""Sound scans of real rigs have 0.8 and more, borders of two pixels that are refused included."""


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


def coverage_notes(name: str, share: float | None) -> list[str]:
    """One sentence if the mesh covers much less than was decoded."""
    if share is None or share >= FAIR_SHARE:
        return []
    return [
        f"the mesh covers {share:.0%} of what camera '{name}' decoded. Look at the picture of causes: the finest "
        f"patterns may not resolve (wider cells: {setting('gray_cell_px')}; wider lines: {setting('line_width_px')}), "
        f"or the limit at depth edges be too low: {setting('depth_edge_ratio')}"
    ]


def require_surface(holds: bool, folder: Path, what: str, cameras: Sequence[CameraResult]) -> None:
    """Refuse a scan that holds no surface (NothingToReconstructError), with the figures that tell why."""
    if holds:
        return
    figures = "; ".join(
        f"camera '{seen.name}': white {seen.white.mean():.0f} of {seen.full_scale:.0f} on average, at most "
        f"{seen.contrast.max():.0f} above black, {lit_pixels(seen.curves).mean():.1%} of the image lit, "
        f"{seen.curves.decoded_pixels} pixels decoded{_outside(seen)}"
        for seen in cameras
    )
    message = (
        f"{folder}: {what}. {figures}. Look whether the projector lit the object, the lens cap is off, and the "
        "exposure leaves white below full scale and well above black"
    )
    raise NothingToReconstructError(message)


def _outside(seen: CameraResult) -> str:
    share = float((seen.curves.refusal == Refusal.OUTSIDE_REGION).mean())
    return f", {share:.1%} of the image outside the region that was asked for" if share else ""

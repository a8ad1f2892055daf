"""What follows where a camera does not resolve the finest patterns: wider steps between curves, and only there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slrig.errors import setting
from slrig.meshing.runs import parts_of_curves
from slrig.model import FloatArray, IntArray
from slrig.reconstruction.camera import CameraCurves
from slrig.reconstruction.merging import MergedCurves
from slrig.scan.report import lit_share
from slrig.scan.stream import CameraResult

_WORTH_TELLING = 0.02
_WIDEST_BRIDGES = 2.5
"""Of the gaps up to which a curve counts as seen: what strips still bridge at the usual limit of a depth edge."""


@dataclass(frozen=True, slots=True)
class Steps:
    """at_points_px : (n,) float64, distance of neighbouring curves where each point lies, or one for all; runs : the
    parts of curves to be joined, None where they are whole curves.
    """

    at_points_px: FloatArray | float
    runs: IntArray | None


def steps(
    cameras: Sequence[CameraResult],
    joined: MergedCurves,
    step_px: float,
    cell_px: float,
    *,
    max_gap: int,
    widest_gap_px: float,
) -> Steps:
    """How far apart curves lie, and which are neighbours.

    step_px : where all that was shown resolves. cell_px : of the code. max_gap : neighbours are at most so many steps
    apart. widest_gap_px : along a curve, up to which it is there between two points.
    """
    maps = [_steps_px(seen.curves, step_px, cell_px) for seen in cameras]
    if all(each is None for each in maps):
        return Steps(step_px, None)
    curves = joined.curves
    columns, rows = np.rint(curves.pixels_px).astype(int).T
    at_points = np.full(len(rows), step_px)
    for index, each in enumerate(maps):
        mine = joined.camera == index
        if each is not None:
            at_points[mine] = each[rows[mine], columns[mine]]
    # A curve may have a neighbour that another camera does not resolve.
    widest_px = max(float(each.max()) for each in maps if each is not None)
    runs = parts_of_curves(
        curves.position_px, curves.offsets, curves.along_px,
        widest_step_px=max(step_px * max_gap, widest_px), widest_gap_px=_WIDEST_BRIDGES * widest_gap_px,
    )  # fmt: skip
    return Steps(at_points, runs)


def _steps_px(curves: CameraCurves, step_px: float, cell_px: float) -> NDArray[np.float32] | None:
    """(H, W): how far apart curves lie at each pixel; None if as usual everywhere."""
    if curves.unresolved is None:
        return None
    edges_px = np.float32(cell_px) * np.exp2(curves.unresolved, dtype=np.float32)
    if curves.lost_lines is not None:
        return np.where(curves.lost_lines, edges_px, np.float32(step_px))
    return edges_px if curves.unresolved.any() else None


def unresolved_notes(cameras: Sequence[CameraResult], step_px: float, cell_px: float) -> list[str]:
    """One sentence for each camera that does not resolve the finest patterns on a part of what is lit."""
    notes = []
    for seen in cameras:
        share = lit_share(seen.curves, seen.curves.lost_lines)
        if share >= _WORTH_TELLING:
            notes.append(
                f"camera '{seen.name}' does not resolve the shifted lines on {share:.0%} of what is lit: the edges of "
                f"the code stand for them there, every {cell_px:g} projector pixels or wider instead of every "
                f"{step_px:g}. Look at focus and resolution, or play lines further apart: "
                f"{setting('line_shift_period_px')}"
            )
        elif seen.curves.unresolved is not None and seen.curves.lost_lines is None:
            share = lit_share(seen.curves, seen.curves.unresolved > 0)
            if share >= _WORTH_TELLING:
                notes.append(
                    f"camera '{seen.name}' does not resolve the finest Gray bit on {share:.0%} of what is lit: "
                    f"it is left out there, and the surface is sampled every {2 * step_px:g} projector pixels or "
                    f"wider. Look at focus and resolution, or play wider cells: {setting('gray_cell_px')}"
                )
    return notes

"""What follows where a camera does not resolve the finest bits: wider steps between curves, there and only there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slrig.meshing.runs import parts_of_curves
from slrig.model import FloatArray, IntArray
from slrig.reconstruction.merging import MergedCurves
from slrig.scan.report import share_by_bits
from slrig.scan.stream import Seen

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
    cameras: Sequence[Seen], joined: MergedCurves, step_px: float, *, max_gap: int, widest_gap_px: float
) -> Steps:
    """How far apart curves lie, and which are neighbours.

    step_px : where all bits resolve. max_gap : neighbours are at most so many steps apart. widest_gap_px : along a
    curve, up to which it is there between two points.
    """
    finest = [seen.curves.unresolved for seen in cameras]
    curves = joined.curves
    if all(each is None or not each.any() for each in finest):
        return Steps(step_px, None)
    columns, rows = np.rint(curves.pixels_px).astype(int).T
    bits = np.zeros(len(rows), dtype=np.uint8)
    for index, unresolved in enumerate(finest):
        mine = joined.camera == index
        if unresolved is not None:
            bits[mine] = unresolved[rows[mine], columns[mine]]
    # A curve may have a neighbour that another camera does not resolve.
    most = max(int(each.max()) for each in finest if each is not None)
    runs = parts_of_curves(
        curves.position_px, curves.offsets, curves.along_px,
        widest_step_px=step_px * max(max_gap, 2**most), widest_gap_px=_WIDEST_BRIDGES * widest_gap_px,
    )  # fmt: skip
    return Steps(step_px * np.exp2(bits), runs)


def unresolved_notes(cameras: Sequence[Seen], step_px: float) -> list[str]:
    """One sentence for each camera that does not resolve the finest bits on a part of what is lit that is worth it."""
    notes = []
    for seen in cameras:
        _, *less = share_by_bits(seen.curves) or [1.0]
        if sum(less) >= _WORTH_TELLING:
            notes.append(
                f"camera '{seen.name}' does not resolve the finest Gray bit on {sum(less):.0%} of what is lit: "
                f"it is left out there, and the surface is sampled every {2 * step_px:g} projector pixels or wider. "
                "Look at focus and resolution, or play wider cells (--gray-cell-px)"
            )
    return notes

"""Triangulated curves, one per light sheet, and their order along it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel
from slrig.model import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class SheetCurves:
    """Triangulated curves, one per light sheet, seen by one reference camera. Curve i: offsets[i]:offsets[i + 1].

    offsets : (c + 1,) int32; position_px : (c,) float64; points_mm : (n, 3) float64, world.
    deviation_mm : (n, 3) float64, displacement of the point for one standard deviation of the stripe position.
    along_px : (n,) float64, the coordinate along the sheet that orders the curve: projector row (column for row
    patterns), or where the projector is not calibrated the reference camera's row (column for stripes that run rather
    across its image than down).
    pixels_px : (n, 2) float64, (x, y) in the reference camera; stripe : (n,) int32, the stripe each point came from;
    bridge_after : (n,) bool, True where the step to the next point joins two stripes; source : (n,) uint8, `Source`.
    """

    offsets: IntArray
    position_px: FloatArray
    points_mm: FloatArray
    deviation_mm: FloatArray
    along_px: FloatArray
    pixels_px: FloatArray
    stripe: IntArray
    bridge_after: NDArray[np.bool_]
    source: NDArray[np.uint8]

    def curve_of_point(self) -> IntArray:
        """(n,) int32: the curve each point belongs to."""
        return np.repeat(np.arange(len(self.position_px), dtype=np.int32), np.diff(self.offsets))

    def taken(
        self, index: NDArray[np.intp] | NDArray[np.bool_], *, offsets: IntArray, bridge_after: NDArray[np.bool_]
    ) -> SheetCurves:
        """The points at `index`, in its order, under these offsets and bridges."""
        where = np.flatnonzero(index) if index.dtype == np.bool_ else index
        return SheetCurves(
            offsets=offsets,
            position_px=self.position_px,
            points_mm=np.take(self.points_mm, where, axis=0),
            deviation_mm=np.take(self.deviation_mm, where, axis=0),
            along_px=np.take(self.along_px, where, axis=0),
            pixels_px=np.take(self.pixels_px, where, axis=0),
            stripe=np.take(self.stripe, where, axis=0),
            bridge_after=bridge_after,
            source=np.take(self.source, where, axis=0),
        )


def selected(curves: SheetCurves, keep: NDArray[np.bool_], /) -> SheetCurves:
    """The curves without the points where `keep` is False; a step over such points inherits their bridges."""
    if keep.all():
        return curves
    counts = np.concatenate([[0], np.cumsum(keep)])
    # A bridge belongs to the last kept point at or before it.
    carried = np.add.reduceat(curves.bridge_after, np.flatnonzero(keep)) > 0 if keep.any() else np.zeros(0, dtype=bool)
    offsets = counts[curves.offsets].astype(np.int32)
    # What follows the bridge is gone to the end of the curve: no step is left that would cross it.
    carried[offsets[1:][np.diff(offsets) > 0] - 1] = False
    return curves.taken(keep, offsets=offsets, bridge_after=carried)


def ordered_along_sheet(curves: SheetCurves, /) -> SheetCurves:
    """The same curves, the stripes of each in the order of rising `along_px`, each running that way.

    In the image the order of stripes has to be guessed from angles and distances, and a cliff misleads the guess. On
    the light sheet it is known: every projector row meets the surface once, so stripes of one code follow one another
    by row. Points keep their order within a stripe.
    """
    count = len(curves.stripe)
    order, bridge_after = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.bool_)
    given = curves.offsets, curves.stripe, curves.along_px
    in_bands(_sheet_order_kernel, len(curves.position_px), *given, order, bridge_after)
    return curves.taken(order, offsets=curves.offsets, bridge_after=bridge_after)


@kernel
def _sheet_order_kernel(begin: int, end: int, offsets: Any, stripe: Any, along: Any, order: Any, bridge: Any) -> None:
    """Fill in the order of the points, and which of the steps between them join two stripes."""
    for curve in range(begin, end):
        a, b = offsets[curve], offsets[curve + 1]
        runs = 0
        for i in range(a, b):
            runs += i == a or stripe[i] != stripe[i - 1]
        first = np.zeros(runs + 1, dtype=np.int64)
        middle = np.zeros(runs)
        turned = np.zeros(runs, dtype=np.bool_)
        run = 0
        for i in range(a, b):
            if i == a or stripe[i] != stripe[i - 1]:
                first[run] = i
                run += 1
        first[runs] = b
        for r in range(runs):
            count = first[r + 1] - first[r]
            for i in range(first[r], first[r + 1]):
                middle[r] += along[i] / count
            # A stripe runs upwards when row and rank fall together.
            drift = 0.0
            for i in range(first[r], first[r + 1]):
                drift += (along[i] - middle[r]) * (i - first[r] - 0.5 * (count - 1))
            turned[r] = drift < 0
        filled = a
        for _ in range(runs):
            # Few stripes make up a sheet: the next by its middle, the first of equals, is looked for.
            r = 0
            for other in range(1, runs):
                if middle[other] < middle[r]:
                    r = other
            middle[r] = np.inf
            for k in range(first[r + 1] - first[r]):
                order[filled] = first[r + 1] - 1 - k if turned[r] else first[r] + k
                filled += 1
            if filled < b:
                bridge[filled - 1] = True

"""Triangulated curves, one per light sheet, and their order along it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from slrig.model import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class SheetCurves:
    """Triangulated curves, one per light sheet, seen by one reference camera. Curve i: offsets[i]:offsets[i + 1].

    offsets : (c + 1,) int32; position_px : (c,) float64; points_mm : (n, 3) float64, world.
    deviation_mm : (n, 3) float64, displacement of the point for one standard deviation of the stripe position.
    along_px : (n,) float64, the coordinate along the sheet that orders the curve: projector row (column for row
    patterns), or the reference camera's row where the projector is not calibrated.
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
        points, deviation, along, pixels, stripe, source = _gather_kernel(
            where, self.points_mm, self.deviation_mm, self.along_px, self.pixels_px, self.stripe, self.source
        )
        return SheetCurves(
            offsets=offsets,
            position_px=self.position_px,
            points_mm=points,
            deviation_mm=deviation,
            along_px=along,
            pixels_px=pixels,
            stripe=stripe,
            bridge_after=bridge_after,
            source=source,
        )


@njit(cache=True, nogil=True, parallel=True)
def _gather_kernel(where: Any, points: Any, deviation: Any, along: Any, pixels: Any, stripe: Any, source: Any) -> Any:
    count = len(where)
    points_out = np.zeros((count, 3))
    deviation_out = np.zeros((count, 3))
    along_out = np.zeros(count)
    pixels_out = np.zeros((count, 2))
    stripe_out = np.zeros(count, dtype=stripe.dtype)
    source_out = np.zeros(count, dtype=source.dtype)
    for i in prange(count):
        k = where[i]
        for c in range(3):
            points_out[i, c] = points[k, c]
            deviation_out[i, c] = deviation[k, c]
        along_out[i] = along[k]
        pixels_out[i, 0], pixels_out[i, 1] = pixels[k, 0], pixels[k, 1]
        stripe_out[i] = stripe[k]
        source_out[i] = source[k]
    return points_out, deviation_out, along_out, pixels_out, stripe_out, source_out


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
    order, bridge_after = _sheet_order_kernel(curves.offsets, curves.stripe, curves.along_px)
    return curves.taken(order, offsets=curves.offsets, bridge_after=bridge_after)


@njit(cache=True, nogil=True, parallel=True)
def _sheet_order_kernel(offsets: Any, stripe: Any, along: Any) -> Any:
    """The order of the points, and which of the steps between them join two stripes."""
    order = np.zeros(len(stripe), dtype=np.int64)
    bridge = np.zeros(len(stripe), dtype=np.bool_)
    for curve in prange(len(offsets) - 1):
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
        for r in np.argsort(middle, kind="mergesort"):
            for k in range(first[r + 1] - first[r]):
                order[filled] = first[r + 1] - 1 - k if turned[r] else first[r] + k
                filled += 1
            if filled < b:
                bridge[filled - 1] = True
    return order, bridge

"""From linked stripes to curves in space: camera ray with light sheet, and camera ray with the same code elsewhere."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from slrig.model import Axis, FloatArray, IntArray, Pinhole, Source
from slrig.reconstruction.linking import StripeEnsemble
from slrig.reconstruction.optics import distort, normalised_from_pixel, packed, project, rays, to_device, world_ray

_NEWTON_STEPS = 25
_CONVERGED_PX = 1e-9
_PROBE_PX = 1e-3
_BORDER_PX = 2.0


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
        return replace(
            self,
            offsets=offsets,
            points_mm=self.points_mm[index],
            deviation_mm=self.deviation_mm[index],
            along_px=self.along_px[index],
            pixels_px=self.pixels_px[index],
            stripe=self.stripe[index],
            bridge_after=bridge_after,
            source=self.source[index],
        )


def camera_projector(ensemble: StripeEnsemble, camera: Pinhole, projector: Pinhole, axis: Axis, /) -> SheetCurves:
    """Intersect each point's ray with its light sheet.

    The sheet of a distorted column is curved, so the depth s along the ray solves column(project(o + s d)) = c by
    Newton's method on the whole distorted projection. Points behind a device, or met where the projector has no pixel,
    are left out.
    """
    curve = np.repeat(np.arange(len(ensemble.position_px)), np.diff(ensemble.offsets))
    points, deviation, along, good = _sheet_kernel(
        packed(camera), packed(projector), camera.centre_mm, ensemble.points_px, ensemble.normals, ensemble.sigma_px,
        ensemble.position_px[curve], axis is Axis.ROW,
    )  # fmt: skip
    other = Axis.ROW if axis is Axis.COLUMN else Axis.COLUMN
    good &= (along > -_BORDER_PX) & (along < projector.size.along(other) - 1 + _BORDER_PX)
    made = SheetCurves(
        offsets=ensemble.offsets,
        position_px=ensemble.position_px,
        points_mm=points,
        deviation_mm=deviation,
        along_px=along,
        pixels_px=ensemble.points_px,
        stripe=ensemble.stripe,
        bridge_after=ensemble.bridge_after,
        source=np.full(len(points), Source.CAMERA_PROJECTOR, dtype=np.uint8),
    )
    return ordered_along_sheet(selected(made, good))


def camera_camera(first: StripeEnsemble, second: StripeEnsemble, camera: Pinhole, other: Pinhole, /) -> SheetCurves:
    """Triangulate points of `first` with the curve of the same code in `second`; no projector calibration is used.

    The epipolar line of each point is crossed with the other camera's curve between two consecutive points that no
    bridge separates; the two rays then meet in the least-squares sense.
    """
    shared, mine, theirs = np.intersect1d(first.position_px, second.position_px, return_indices=True)
    del shared
    partner = np.full(len(first.position_px), -1, dtype=np.int32)
    partner[mine] = theirs
    points, deviation, good = _stereo_kernel(
        packed(camera), packed(other), camera.centre_mm, other.centre_mm,
        first.offsets, first.points_px, first.normals, first.sigma_px, partner,
        second.offsets, second.points_px, second.normals, second.sigma_px, second.bridge_after,
    )  # fmt: skip
    made = SheetCurves(
        offsets=first.offsets,
        position_px=first.position_px,
        points_mm=points,
        deviation_mm=deviation,
        along_px=first.points_px[:, 1].copy(),
        pixels_px=first.points_px,
        stripe=first.stripe,
        bridge_after=first.bridge_after,
        source=np.full(len(points), Source.CAMERA_CAMERA, dtype=np.uint8),
    )
    return ordered_along_sheet(selected(made, good))


def selected(curves: SheetCurves, keep: NDArray[np.bool_], /) -> SheetCurves:
    """The curves without the points where `keep` is False; a step over such points inherits their bridges."""
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
    curve = curves.curve_of_point()
    stripes, member = np.unique(curves.stripe, return_inverse=True)
    count = np.bincount(member, minlength=len(stripes))
    middle = np.bincount(member, weights=curves.along_px, minlength=len(stripes)) / np.maximum(count, 1)
    rank = _rank_within(member)
    # A stripe runs upwards when row and rank fall together.
    drift = np.bincount(member, weights=(curves.along_px - middle[member]) * (rank - (count[member] - 1) / 2))
    rank = np.where(drift[member] < 0, count[member] - 1 - rank, rank)
    order = np.lexsort((rank, member, middle[member], curve))
    stripe = curves.stripe[order]
    changes = np.append(stripe[1:] != stripe[:-1], False)
    last_of_curve = np.zeros(len(order), dtype=bool)
    last_of_curve[curves.offsets[1:][np.diff(curves.offsets) > 0] - 1] = True
    return curves.taken(order, offsets=curves.offsets, bridge_after=changes & ~last_of_curve)


def _rank_within(member: NDArray[np.intp]) -> NDArray[np.int64]:
    """Position of each entry among the entries of its own group, in the order given."""
    order = np.argsort(member, kind="stable")
    counts = np.bincount(member)
    firsts = np.cumsum(counts) - counts
    rank = np.zeros(len(member), dtype=np.int64)
    rank[order] = np.arange(len(member)) - firsts[member[order]]
    return rank


@njit(cache=True, nogil=True, inline="always")
def _position(p: Any, x: float, y: float, z: float, row: bool) -> Any:
    """Projector position of a world point along the coded axis, and along the other one; z_p tells behind."""
    xp, yp, zp = to_device(p, x, y, z)
    xn, yn = xp / zp, yp / zp
    xd, yd, a, b, c, e = distort(p, xn, yn)
    u, v = p[0] * xd + p[1] * yd + p[2], p[3] * yd + p[4]
    if row:
        return v, u, zp, xn, yn, p[3] * c, p[3] * e
    return u, v, zp, xn, yn, p[0] * a + p[1] * c, p[0] * b + p[1] * e


@njit(cache=True, nogil=True)
def _depth_on_sheet(p: Any, o: Any, d: Any, position: float, row: bool, s: float) -> float:
    """The s with position(o + s d) = position, from a start; NaN when it does not settle."""
    dx = p[10] * d[0] + p[11] * d[1] + p[12] * d[2]
    dy = p[13] * d[0] + p[14] * d[1] + p[15] * d[2]
    dz = p[16] * d[0] + p[17] * d[1] + p[18] * d[2]
    for _ in range(_NEWTON_STEPS):
        got, _v, zp, xn, yn, gx, gy = _position(p, o[0] + s * d[0], o[1] + s * d[1], o[2] + s * d[2], row)
        slope = (gx * (dx - xn * dz) + gy * (dy - yn * dz)) / zp
        if slope == 0 or not np.isfinite(slope):
            return np.nan
        step = (got - position) / slope
        s -= step
        if abs(got - position) < _CONVERGED_PX:
            return s
    return np.nan


@njit(cache=True, nogil=True)
def _start_depth(p: Any, o: Any, d: Any, position: float, row: bool) -> float:
    """Depth on the plane that touches the sheet at the projector's principal point: a start for Newton's method."""
    if row:
        n = normalised_from_pixel(p, p[2], position)[1]
        base = 13
    else:
        n = normalised_from_pixel(p, position, p[4])[0]
        base = 10
    ox, oy, oz = to_device(p, o[0], o[1], o[2])
    oc = ox if base == 10 else oy
    dc = p[base] * d[0] + p[base + 1] * d[1] + p[base + 2] * d[2]
    dz = p[16] * d[0] + p[17] * d[1] + p[18] * d[2]
    denominator = dc - n * dz
    if denominator == 0:
        return np.nan
    return float((n * oz - oc) / denominator)


@njit(cache=True, nogil=True, parallel=True)
def _sheet_kernel(
    camera: Any, projector: Any, centre: Any, points: Any, normals: Any, sigma: Any, position: Any, row: bool
) -> Any:
    count = len(points)
    out = np.full((count, 3), np.nan)
    deviation = np.full((count, 3), np.nan)
    along = np.full(count, np.nan)
    good = np.zeros(count, dtype=np.bool_)
    for i in prange(count):
        d = np.zeros(3)
        world_ray(camera, points[i, 0], points[i, 1], d)
        s = _depth_on_sheet(
            projector, centre, d, position[i], row, _start_depth(projector, centre, d, position[i], row)
        )
        if not s > 0:
            continue
        for k in range(3):
            out[i, k] = centre[k] + s * d[k]
        _, v, zp, _, _, _, _ = _position(projector, out[i, 0], out[i, 1], out[i, 2], row)
        if zp <= 0:
            continue
        along[i] = v
        # The point of the same sheet for a stripe found a little aside.
        aside = np.zeros(3)
        world_ray(camera, points[i, 0] + _PROBE_PX * normals[i, 0], points[i, 1] + _PROBE_PX * normals[i, 1], aside)
        moved = _depth_on_sheet(projector, centre, aside, position[i], row, s)
        for k in range(3):
            deviation[i, k] = (centre[k] + moved * aside[k] - out[i, k]) / _PROBE_PX * sigma[i]
        good[i] = np.isfinite(deviation[i, 0])
    return out, deviation, along, good


@njit(cache=True, nogil=True)
def _meeting(o1: Any, d1: Any, o2: Any, d2: Any, out: Any) -> bool:
    """Fill out with the point nearest to two rays (midpoint of the common perpendicular); False if behind either."""
    a = b = c = e = f = 0.0
    for k in range(3):
        w = o1[k] - o2[k]
        a += d1[k] * d1[k]
        b += d1[k] * d2[k]
        c += d2[k] * d2[k]
        e += d1[k] * w
        f += d2[k] * w
    det = a * c - b * b
    if det <= 1e-18 * a * c:
        return False
    s, t = (b * f - c * e) / det, (a * f - b * e) / det
    for k in range(3):
        out[k] = (o1[k] + s * d1[k] + o2[k] + t * d2[k]) / 2
    return s > 0 and t > 0


@njit(cache=True, nogil=True)
def _side(normal: Any, d: Any) -> float:
    return float(normal[0] * d[0] + normal[1] * d[1] + normal[2] * d[2])


@njit(cache=True, nogil=True)
def _across(a: Any, b: Any) -> Any:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@njit(cache=True, nogil=True)
def _crossed(device: Any, normal: Any, u0: float, v0: float, u1: float, v1: float, out: Any) -> bool:
    """Fill out with the ray at which the line through two pixels crosses a plane through the centre."""
    world_ray(device, u0, v0, out)
    f = _side(normal, out)
    world_ray(device, u1, v1, out)
    g = _side(normal, out)
    if f == g:
        return False
    share = f / (f - g)
    world_ray(device, u0 + share * (u1 - u0), v0 + share * (v1 - v0), out)
    return True


@njit(cache=True, nogil=True, parallel=True)
def _stereo_kernel(
    camera: Any, other: Any, o1: Any, o2: Any,
    offsets: Any, points: Any, normals: Any, sigma: Any, partner: Any,
    offsets2: Any, points2: Any, normals2: Any, sigma2: Any, bridge2: Any,
) -> Any:  # fmt: skip
    count = len(points)
    out = np.full((count, 3), np.nan)
    deviation = np.full((count, 3), np.nan)
    good = np.zeros(count, dtype=np.bool_)
    for curve in prange(len(offsets) - 1):
        match = partner[curve]
        if match < 0:
            continue
        a, b = offsets2[match], offsets2[match + 1]
        d2 = np.zeros((b - a, 3))
        for k in range(a, b):
            world_ray(other, points2[k, 0], points2[k, 1], d2[k - a])
        baseline = o2 - o1
        hint = 0
        d = np.zeros(3)
        d_aside = np.zeros(3)
        crossing = np.zeros(3)
        aside = np.zeros(3)
        for i in range(offsets[curve], offsets[curve + 1]):
            world_ray(camera, points[i, 0], points[i, 1], d)
            # Normal of the epipolar plane; the other camera's rays change side where the curve crosses it.
            n = _across(baseline, d)
            at = -1
            last = b - a - 2
            for reach in range(b - a):
                for k in (hint + reach, hint - reach):
                    if at < 0 and 0 <= k <= last and not bridge2[a + k]:
                        f, g = _side(n, d2[k]), _side(n, d2[k + 1])
                        if f * g <= 0 and f != g:
                            at = k
                if at >= 0 or (hint + reach > last and hint - reach < 0):
                    break
            if at < 0:
                continue
            hint = at
            j = a + at
            u0, v0, u1, v1 = points2[j, 0], points2[j, 1], points2[j + 1, 0], points2[j + 1, 1]
            if not _crossed(other, n, u0, v0, u1, v1, crossing) or not _meeting(o1, d, o2, crossing, out[i]):
                continue
            # Two independent errors, across the stripe in either camera. Each moves the place at which the epipolar
            # line crosses the other curve, the more the more obliquely it does.
            du, dv = _PROBE_PX * normals[i, 0], _PROBE_PX * normals[i, 1]
            world_ray(camera, points[i, 0] + du, points[i, 1] + dv, d_aside)
            if not _crossed(other, _across(baseline, d_aside), u0, v0, u1, v1, crossing):
                continue
            _meeting(o1, d_aside, o2, crossing, aside)
            first = np.zeros(3)
            for k in range(3):
                first[k] = (aside[k] - out[i, k]) / _PROBE_PX * sigma[i]
            du, dv = _PROBE_PX * normals2[j, 0], _PROBE_PX * normals2[j, 1]
            if not _crossed(other, n, u0 + du, v0 + dv, u1 + du, v1 + dv, crossing):
                continue
            _meeting(o1, d, o2, crossing, aside)
            squares = square = 0.0
            for k in range(3):
                second = (aside[k] - out[i, k]) / _PROBE_PX * sigma2[j]
                squares += second * second
                square += first[k] * first[k]
            # Both displace the point along much the same line; their variances add.
            scale = np.sqrt(1 + squares / max(square, 1e-30))
            for k in range(3):
                deviation[i, k] = first[k] * scale
            good[i] = True
    return out, deviation, good


__all__ = ["SheetCurves", "camera_camera", "camera_projector", "ordered_along_sheet", "project", "rays", "selected"]

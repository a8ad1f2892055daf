"""Triangulation: camera rays, curved light sheets, their intersections, and epipolar matches between cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import Axis, FloatArray, IntArray, Pinhole, Refusal, Source
from slrig.model.lens_kernels import MAX_STEPS, distort, undistort, undistort_step
from slrig.reconstruction.identification import StripeEnsemble

_MIN_POINTS = 1024  # least number for one call of a kernel
CONVERGED = 1e-7  # in normalised coordinates: a shorter step ends the iteration that undistorts a point

_STEPS = 25  # two to four suffice, for strong lenses, too; more is a start that does not converge
_CONVERGED_PX = 1e-5  # before the last step of Newton's method, which leaves about the square of it
_NONE, _BEHIND_DEVICE = int(Refusal.NONE), int(Refusal.BEHIND_DEVICE)

_BLOCK = 256  # points; chosen: 128 and 512 are not faster
# Starts of rows: the point in the camera, distorted; the normal of the stripe; x and y of the ray, undistorted; the ray
# in the projector's frame; the depth s along it; the flag that iteration continues; the point, from the camera's
# centre; its displacement for a pixel across the stripe; the coordinate along the sheet; the depth in the projector.
_XD, _YD, _NX, _NY, _X, _Y, _DX, _DY, _DZ, _S, _GOES_ON, _PX, _PY, _PZ, _MX, _MY, _MZ, _ALONG, _DEPTH = (
    row * _BLOCK for row in range(19)
)
_ROWS = 19

_MAX_POINTS = 20_000  # their median is known to a hundredth of their scatter
_STEP = 1e-3  # of the baseline: far above rounding, and an epipolar line is straight over so short a distance

_AGAIN = 2.5  # times the usual distance to the nearest point of the other camera, and of neighbours along a stripe
_PROBE_PX = 1e-3  # far above rounding, and a point moves straight over so short a distance
_BORDER_PX = 2.0  # beyond the projector's image; chosen: 0 and 4 make no difference


def pack_device(device: Pinhole) -> FloatArray:
    """(22,) float64: parameters of a device for kernels."""
    m = device.matrix
    return np.concatenate(
        [
            [m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2]],
            device.distortion,
            device.rotation.ravel(),
            device.translation_mm,
        ]
    ).astype(np.float64)


def pixel_rays(device: Pinhole, points_px: FloatArray) -> FloatArray:
    """(n, 3) float64: world direction of each pixel (n, 2), scaled to depth 1 in the device."""
    points, out = np.ascontiguousarray(points_px, dtype=np.float64), np.zeros((len(points_px), 3))
    in_bands(_rays_kernel, len(points), pack_device(device), points, out, rows_at_least=_MIN_POINTS)
    return out


def project(device: Pinhole, points_mm: FloatArray) -> FloatArray:
    """(n, 2) float64 pixels of world points (n, 3); NaN for points behind the device."""
    points, out = np.ascontiguousarray(points_mm, dtype=np.float64), np.full((len(points_mm), 2), np.nan)
    in_bands(_project_kernel, len(points), pack_device(device), points, out, rows_at_least=_MIN_POINTS)
    return out


def optical_depths_mm(device: Pinhole, points_mm: FloatArray) -> FloatArray:
    """(n,) float64: depth of world points (n, 3) along the device's optical axis, mm."""
    return np.asarray(points_mm @ device.rotation[2] + device.translation_mm[2])


@kernel_part(inline="always")
def distorted_from_pixel(d: Any, u: float, v: float) -> Any:
    """Normalised coordinates of a pixel, distorted."""
    yd = (v - d[4]) / d[3]
    return (u - d[2] - d[1] * yd) / d[0], yd


@kernel_part
def normalised_from_pixel(d: Any, u: float, v: float) -> Any:
    """Undistorted normalised coordinates of a pixel, NaN if the lens cannot image it."""
    xd, yd = distorted_from_pixel(d, u, v)
    return undistort(d[5:10], xd, yd, xd, yd, CONVERGED)


@kernel_part
def world_ray(d: Any, u: float, v: float, out: Any) -> None:
    """Fill out (3,) with the world direction of a pixel: Rᵀ (x, y, 1)."""
    x, y = normalised_from_pixel(d, u, v)
    for k in range(3):
        out[k] = d[10 + k] * x + d[13 + k] * y + d[16 + k]


@kernel_part(inline="always")
def to_device(d: Any, px: float, py: float, pz: float) -> Any:
    """World point to device coordinates, mm: R X + t."""
    return (
        d[10] * px + d[11] * py + d[12] * pz + d[19],
        d[13] * px + d[14] * py + d[15] * pz + d[20],
        d[16] * px + d[17] * py + d[18] * pz + d[21],
    )


@kernel(in_every_scan=False)
def _rays_kernel(first: int, last: int, d: Any, points: Any, out: Any) -> None:
    for i in range(first, last):
        world_ray(d, points[i, 0], points[i, 1], out[i])


@kernel(in_every_scan=False)
def _project_kernel(first: int, last: int, d: Any, points: Any, out: Any) -> None:
    for i in range(first, last):
        px, py, pz = to_device(d, points[i, 0], points[i, 1], points[i, 2])
        if pz > 0:
            xd, yd, _, _, _ = distort(d[5:10], px / pz, py / pz)
            out[i, 0] = d[0] * xd + d[1] * yd + d[2]
            out[i, 1] = d[3] * yd + d[4]


def intersect_light_sheets(
    ensemble: StripeEnsemble, camera: Pinhole, projector: Pinhole, axis: Axis, /
) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.uint8]]:
    """Intersect the ray of each point with its light sheet.

    Returns points and deviations (n, 3) float64, mm, and the projector's coordinate along the sheet (n,) float64, px,
    as in `SheetCurves`; and (n,) uint8, `Refusal`: other values of refused points are undefined.

    The sheet of a distorted column is curved, so the depth s along the ray solves column(project(o + s d)) = c by
    Newton's method on the whole distorted projection, from the plane tangent to the sheet at the projector's principal
    point.
    """
    count = len(ensemble.points_px)
    points, deviation = np.zeros((count, 3)), np.zeros((count, 3))
    along, cause = np.zeros(count), np.full(count, Refusal.NO_INTERSECTION, dtype=np.uint8)
    # The projector in the frame of the camera.
    camera_to_projector = pack_device(projector)
    camera_to_projector[10:19] = (projector.rotation @ camera.rotation.T).ravel()
    camera_to_projector[19:] = projector.rotation @ camera.centre_mm + projector.translation_mm
    # Tuples, not arrays: the compiler knows that results do not overwrite them.
    in_bands(
        _sheet_kernel, len(ensemble.position_px), tuple(pack_device(camera)), tuple(camera_to_projector),
        camera.centre_mm, ensemble.points_px, ensemble.normals, ensemble.sigma_px, ensemble.offsets,
        ensemble.position_px, axis is Axis.ROW, points, deviation, along, cause,
    )  # fmt: skip
    return points, deviation, along, cause


@kernel_part
def _undistort_rays(w: Any, count: int, camera: Any) -> None:
    """Fill in x and y of a block's undistorted rays, NaN where the lens cannot image them."""
    for _ in range(MAX_STEPS):
        unfinished = 0
        for i in range(count):
            x, y, goes_on = w[_X + i], w[_Y + i], w[_GOES_ON + i] > 0
            dx, dy = undistort_step(camera[5:10], w[_XD + i], w[_YD + i], x, y)
            w[_X + i] = x + (dx if goes_on else 0.0)
            w[_Y + i] = y + (dy if goes_on else 0.0)
            goes_on = goes_on and dx * dx + dy * dy >= CONVERGED * CONVERGED  # False for NaN
            w[_GOES_ON + i] = 1.0 if goes_on else 0.0
            unfinished += goes_on
        if unfinished == 0:
            break


@kernel_part
def _solve_depths(w: Any, count: int, p: Any, coded: Any, position: float) -> None:
    """Fill in the depths s at which the rays of a block have the coded position, NaN if there is none."""
    for _ in range(_STEPS):
        unfinished = 0
        for i in range(count):
            s, dx, dy, dz, goes_on = w[_S + i], w[_DX + i], w[_DY + i], w[_DZ + i], w[_GOES_ON + i] > 0
            scale = 1 / (p[21] + s * dz)
            x, y = (p[19] + s * dx) * scale, (p[20] + s * dy) * scale
            xd, yd, a, b, c = distort(p[5:10], x, y)
            gx, gy = coded[0] * a + coded[1] * b, coded[0] * b + coded[1] * c
            slope = (gx * (dx - x * dz) + gy * (dy - y * dz)) * scale
            error = coded[0] * xd + coded[1] * yd + coded[2] - position
            step = error / slope if slope != 0 else np.nan
            w[_S + i] = s - (step if goes_on else 0.0)
            goes_on = goes_on and abs(error) >= _CONVERGED_PX  # False for NaN
            w[_GOES_ON + i] = 1.0 if goes_on else 0.0
            unfinished += goes_on
        if unfinished == 0:
            break


@kernel_part
def _complete_block(w: Any, count: int, camera: Any, p: Any, coded: Any, other: Any) -> None:
    """Fill in the points of a block, their displacement for a pixel across the stripe, and the projector pixels."""
    for i in range(count):
        x, y, dx, dy, dz = w[_X + i], w[_Y + i], w[_DX + i], w[_DY + i], w[_DZ + i]
        s = np.nan if w[_GOES_ON + i] > 0 else w[_S + i]
        depth = p[21] + s * dz
        scale = 1 / depth
        xn, yn = (p[19] + s * dx) * scale, (p[20] + s * dy) * scale
        xd, yd, a, b, c = distort(p[5:10], xn, yn)
        w[_S + i], w[_DEPTH + i], w[_ALONG + i] = s, depth, other[0] * xd + other[1] * yd + other[2]
        is_regular = a * c - b * b > 0  # where the distortion of the projector is monotonic
        gx, gy = coded[0] * a + coded[1] * b, coded[0] * b + coded[1] * c
        # For a displaced stripe on the same sheet: position(o + s d) stays, so with the direction of the ray its depth
        # changes by ds = -s ∇position · dd / ∇position · d.
        _, _, a, b, c = distort(camera[5:10], x, y)
        scale = s / (a * c - b * b) if is_regular else np.nan
        across, down = (w[_NX + i] - camera[1] / camera[3] * w[_NY + i]) / camera[0], w[_NY + i] / camera[3]
        mx, my = (c * across - b * down) * scale, (a * down - b * across) * scale
        aside = gx * (p[10] * mx + p[11] * my - xn * (p[16] * mx + p[17] * my))
        aside += gy * (p[13] * mx + p[14] * my - yn * (p[16] * mx + p[17] * my))
        mz = -aside / (gx * (dx - xn * dz) + gy * (dy - yn * dz))
        w[_PX + i], w[_PY + i], w[_PZ + i] = _rotate_to_world(camera, s * x, s * y, s)
        w[_MX + i], w[_MY + i], w[_MZ + i] = _rotate_to_world(camera, mx + mz * x, my + mz * y, mz)


@kernel_part(inline="always")
def _rotate_to_world(d: Any, x: float, y: float, z: float) -> Any:
    """Rotate a direction from the device's frame to the world: Rᵀ (x, y, z)."""
    return (d[10] * x + d[13] * y + d[16] * z, d[11] * x + d[14] * y + d[17] * z, d[12] * x + d[15] * y + d[18] * z)


@kernel
def _sheet_kernel(
    first: int, last: int, camera: Any, p: Any, centre: Any, points: Any, normals: Any, sigma: Any,
    offsets: Any, positions: Any, row: bool, out: Any, deviation: Any, along: Any, cause: Any,
) -> None:  # fmt: skip
    w = np.zeros(_ROWS * _BLOCK)
    columns, rows = (p[0], p[1], p[2]), (0.0, p[3], p[4])
    coded, other = (rows, columns) if row else (columns, rows)
    for curve in range(first, last):
        position = positions[curve]
        xp, yp = normalised_from_pixel(p, p[2] if row else position, position if row else p[4])
        for begin in range(offsets[curve], offsets[curve + 1], _BLOCK):
            count = min(_BLOCK, offsets[curve + 1] - begin)
            for i in range(count):
                x, y = distorted_from_pixel(camera, points[begin + i, 0], points[begin + i, 1])
                w[_XD + i], w[_YD + i], w[_X + i], w[_Y + i], w[_GOES_ON + i] = x, y, x, y, 1.0
                w[_NX + i], w[_NY + i] = normals[begin + i, 0], normals[begin + i, 1]
            _undistort_rays(w, count, camera)
            for i in range(count):
                x, y = np.nan if w[_GOES_ON + i] > 0 else w[_X + i], w[_Y + i]
                dx = p[10] * x + p[11] * y + p[12]
                dy = p[13] * x + p[14] * y + p[15]
                dz = p[16] * x + p[17] * y + p[18]
                start = (yp * p[21] - p[20]) / (dy - yp * dz) if row else (xp * p[21] - p[19]) / (dx - xp * dz)
                w[_DX + i], w[_DY + i], w[_DZ + i], w[_S + i], w[_GOES_ON + i] = dx, dy, dz, start, 1.0
            _solve_depths(w, count, p, coded, position)
            _complete_block(w, count, camera, p, coded, other)
            for i in range(count):
                at = begin + i
                for k in range(3):
                    out[at, k] = centre[k] + w[_PX + k * _BLOCK + i]
                    deviation[at, k] = w[_MX + k * _BLOCK + i] * sigma[at]
                along[at] = w[_ALONG + i]
                if w[_S + i] <= 0 or w[_DEPTH + i] <= 0:
                    cause[at] = _BEHIND_DEVICE
                elif np.isfinite(deviation[at, 0]):
                    cause[at] = _NONE


@dataclass(frozen=True, slots=True)
class SheetCurves:
    """Triangulated curves, one per light sheet, of one reference camera. Curve i: offsets[i]:offsets[i + 1].

    offsets : (c + 1,) int32; position_px : (c,) float64; points_mm : (n, 3) float64, world. deviation_mm : (n, 3)
    float64, displacement of the point for one standard deviation of the stripe position. along_px : (n,) float64, the
    coordinate along the sheet that orders the curve: projector row (column for row patterns), or without a calibrated
    projector the reference camera's row (column for stripes that run rather across its image than down). pixels_px :
    (n, 2) float64, (x, y) in the reference camera; stripe : (n,) int32, stripe of each point; bridge_after : (n,) bool,
    True where the step to the next point joins two stripes; source : (n,) uint8, `Source`.
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
        """(n,) int32: curve of each point."""
        return np.repeat(np.arange(len(self.position_px), dtype=np.int32), np.diff(self.offsets))

    def take(
        self, index: NDArray[np.intp] | NDArray[np.bool_], *, offsets: IntArray, bridge_after: NDArray[np.bool_]
    ) -> SheetCurves:
        """Return the points at `index`, in its order, with these offsets and bridges."""
        indices = np.flatnonzero(index) if index.dtype == np.bool_ else index
        return SheetCurves(
            offsets=offsets,
            position_px=self.position_px,
            points_mm=np.take(self.points_mm, indices, axis=0),
            deviation_mm=np.take(self.deviation_mm, indices, axis=0),
            along_px=np.take(self.along_px, indices, axis=0),
            pixels_px=np.take(self.pixels_px, indices, axis=0),
            stripe=np.take(self.stripe, indices, axis=0),
            bridge_after=bridge_after,
            source=np.take(self.source, indices, axis=0),
        )


def select_points(curves: SheetCurves, keep: NDArray[np.bool_], /) -> SheetCurves:
    """Return the curves without the points where `keep` is False; a step over such points inherits their bridges."""
    if keep.all():
        return curves
    counts = np.concatenate([[0], np.cumsum(keep)])
    # A bridge belongs to the last selected point at or before it.
    bridge_after = (
        np.add.reduceat(curves.bridge_after, np.flatnonzero(keep)) > 0 if keep.any() else np.zeros(0, dtype=bool)
    )
    offsets = counts[curves.offsets].astype(np.int32)
    # The last point of a curve has no step that crosses a bridge.
    bridge_after[offsets[1:][np.diff(offsets) > 0] - 1] = False
    return curves.take(keep, offsets=offsets, bridge_after=bridge_after)


def order_along_sheet(curves: SheetCurves, /) -> SheetCurves:
    """Order the stripes of each curve by rising `along_px`, each in that direction.

    In the image the order of stripes is guessed from angles and distances, and a cliff can mislead it. On the light
    sheet it is known: every projector row meets the surface once, so stripes of one position follow each other by row.
    Points keep their order within a stripe.
    """
    count = len(curves.stripe)
    order, bridge_after = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.bool_)
    arguments = curves.offsets, curves.stripe, curves.along_px
    in_bands(_sheet_order_kernel, len(curves.position_px), *arguments, order, bridge_after)
    return curves.take(order, offsets=curves.offsets, bridge_after=bridge_after)


@kernel
def _sheet_order_kernel(begin: int, end: int, offsets: Any, stripe: Any, along: Any, order: Any, bridge: Any) -> None:
    """Fill in the order of the points, and True for steps that join two stripes."""
    for curve in range(begin, end):
        a, b = offsets[curve], offsets[curve + 1]
        runs = 0
        for i in range(a, b):
            runs += i == a or stripe[i] != stripe[i - 1]
        first = np.zeros(runs + 1, dtype=np.int64)
        middle = np.zeros(runs)
        is_reversed = np.zeros(runs, dtype=np.bool_)
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
            # A stripe runs upwards if rows fall with rank.
            drift = 0.0
            for i in range(first[r], first[r + 1]):
                drift += (along[i] - middle[r]) * (i - first[r] - 0.5 * (count - 1))
            is_reversed[r] = drift < 0
        filled = a
        for _ in range(runs):
            # A sheet has few stripes: search the next by its middle, the first of equals.
            r = 0
            for other in range(1, runs):
                if middle[other] < middle[r]:
                    r = other
            middle[r] = np.inf
            for k in range(first[r + 1] - first[r]):
                order[filled] = first[r + 1] - 1 - k if is_reversed[r] else first[r] + k
                filled += 1
            if filled < b:
                bridge[filled - 1] = True


def stripe_crossing(ensemble: StripeEnsemble, camera: Pinhole, other: Pinhole, /) -> float:
    """Median sine of the angle between stripes of `camera` and epipolar lines, 0 to 1; 1 without a point.

    The epipolar line of a pixel is the image of the plane of its ray and the baseline. A step from a point of the ray
    along the baseline leads along it, lens distortion included.
    """
    sample = slice(None, None, max(1, len(ensemble.points_px) // _MAX_POINTS))
    pixels, normals = ensemble.points_px[sample], ensemble.normals[sample]
    baseline = other.centre_mm - camera.centre_mm
    points = camera.centre_mm + np.linalg.norm(baseline) * pixel_rays(camera, pixels)
    along = project(camera, points + _STEP * baseline) - pixels
    length = np.linalg.norm(along, axis=1)
    valid = length > 0
    if not valid.any():
        return 1.0
    return float(np.median(np.abs(np.einsum("ni,ni->n", along[valid], normals[valid])) / length[valid]))


def runs_down(ensemble: StripeEnsemble, /) -> bool:
    """True if the stripes run rather down the image than across it."""
    across, down = np.abs(ensemble.normals).sum(axis=0)
    return bool(across >= down)


def triangulate_camera_projector(
    ensemble: StripeEnsemble, camera: Pinhole, projector: Pinhole, axis: Axis, /
) -> tuple[SheetCurves, NDArray[np.uint8]]:
    """Intersect each point's ray with its light sheet.

    Left out are points behind a device, and points where the projector has no pixel or the distortion of its lens is
    not monotonic. Also returns (n,) uint8, `Refusal`: the cause for every point of the ensemble that is left out.
    """
    points, deviation, along, cause = intersect_light_sheets(ensemble, camera, projector, axis)
    outside = ~((along > -_BORDER_PX) & (along < projector.size.along(axis.other) - 1 + _BORDER_PX))
    cause[outside & (cause == Refusal.NONE)] = Refusal.OFF_PROJECTOR
    curves = SheetCurves(
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
    return order_along_sheet(select_points(curves, cause == Refusal.NONE)), cause


def triangulate_camera_pair(
    first: StripeEnsemble, second: StripeEnsemble, camera: Pinhole, other: Pinhole, /
) -> tuple[SheetCurves, NDArray[np.bool_]]:
    """As `triangulate_camera_pairs` with one other camera. Also returns (n,) bool: points of the ensemble that have a
    partner.
    """
    curves, _, valid = triangulate_camera_pairs(first, camera, [(second, other)])
    return curves, valid


def triangulate_camera_pairs(
    first: StripeEnsemble, camera: Pinhole, others: Sequence[tuple[StripeEnsemble, Pinhole]], /
) -> tuple[SheetCurves, NDArray[np.int32], NDArray[np.bool_]]:
    """Triangulate points of `first` with the curves of the same position in others, without projector calibration.

    The epipolar line of each point is intersected with the other camera's curve between two consecutive points that no
    bridge separates. The two rays then meet in the least-squares sense. Curves run by the rows of `camera`, or by its
    columns if the stripes run rather across the image than down.

    A point is matched with the camera that matches most points for their standard deviation, or else with the next: the
    mean of two would share the error of its own pixel. Also returns (m,) int32: index of the other camera of each
    point; and (n,) bool: points of the ensemble that have a partner.
    """
    met = [_match_curves(first, second, camera, other) for second, other in others]
    partner = np.full(len(first.points_px), -1, dtype=np.int32)
    points, deviation = (np.full((len(partner), 3), np.nan) for _ in range(2))
    for index in sorted(range(len(met)), key=lambda index: -_worth(*met[index][1:])):
        points_mm, deviation_mm, valid = met[index]
        new = valid & (partner < 0)
        new &= _is_matched_back(points_mm, new, first, camera, *others[index])
        points[new], deviation[new], partner[new] = points_mm[new], deviation_mm[new], index
    curves = SheetCurves(
        offsets=first.offsets,
        position_px=first.position_px,
        points_mm=points,
        deviation_mm=deviation,
        along_px=first.points_px[:, 1 if runs_down(first) else 0].copy(),
        pixels_px=first.points_px,
        stripe=first.stripe,
        bridge_after=first.bridge_after,
        source=partner.astype(np.uint8),  # takes part in the order
    )
    curves = order_along_sheet(select_points(curves, partner >= 0))
    pair = np.full(len(curves.source), Source.CAMERA_CAMERA, dtype=np.uint8)
    return replace(curves, source=pair), curves.source.astype(np.int32), partner >= 0


def _worth(deviation_mm: FloatArray, valid: NDArray[np.bool_]) -> float:
    """Number of points over their usual standard deviation."""
    return (
        np.count_nonzero(valid) / float(np.median(np.linalg.norm(deviation_mm[valid], axis=1))) if valid.any() else 0.0
    )


def _is_matched_back(
    points_mm: FloatArray, new: NDArray[np.bool_], first: StripeEnsemble, camera: Pinhole, second: StripeEnsemble,
    other: Pinhole,
) -> NDArray[np.bool_]:  # fmt: skip
    """(n,) bool: points that the other camera finds again when its own are matched with the first's.

    A point hidden from the other camera may match a part of the stripe on another surface.
    """
    # Half a second to load, and few scans need it.
    from scipy.spatial import cKDTree

    back_mm, _, valid = _match_curves(second, first, other, camera)
    found = np.zeros(len(points_mm), dtype=np.bool_)
    if valid.any() and new.any():
        back_mm = back_mm[valid]
        apart_mm, _ = cKDTree(back_mm).query(points_mm[new])
        steps_mm = np.linalg.norm(np.diff(back_mm, axis=0), axis=1)
        found[new] = apart_mm <= _AGAIN * np.median(np.concatenate([apart_mm, steps_mm]))
    return found


def _match_curves(
    first: StripeEnsemble, second: StripeEnsemble, camera: Pinhole, other: Pinhole
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """(n, 3) points of `first`, (n, 3) displacement for one standard deviation, and (n,) bool: True where matched."""
    shared, own_index, other_index = np.intersect1d(first.position_px, second.position_px, return_indices=True)
    del shared
    partner = np.full(len(first.position_px), -1, dtype=np.int32)
    partner[own_index] = other_index
    count = len(first.points_px)
    points, deviation = np.full((count, 3), np.nan), np.full((count, 3), np.nan)
    valid = np.zeros(count, dtype=np.bool_)
    in_bands(
        _stereo_kernel, len(partner), pack_device(camera), pack_device(other), camera.centre_mm, other.centre_mm,
        first.offsets, first.points_px, first.normals, first.sigma_px, partner,
        second.offsets, second.points_px, second.normals, second.sigma_px, second.bridge_after,
        points, deviation, valid,
    )  # fmt: skip
    return points, deviation, valid


@kernel_part
def _nearest_point(o1: Any, d1: Any, o2: Any, d2: Any, out: Any) -> bool:
    """Fill out with the point closest to two rays (midpoint of the common perpendicular); False if behind either."""
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


@kernel_part
def _dot(normal: Any, d: Any) -> float:
    return float(normal[0] * d[0] + normal[1] * d[1] + normal[2] * d[2])


@kernel_part
def _cross_product(a: Any, b: Any) -> Any:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@kernel_part
def _intersect_plane(device: Any, normal: Any, u0: float, v0: float, u1: float, v1: float, out: Any) -> bool:
    """Fill out with the ray at which the line through two pixels crosses a plane through the centre."""
    world_ray(device, u0, v0, out)
    f = _dot(normal, out)
    world_ray(device, u1, v1, out)
    g = _dot(normal, out)
    if f == g:
        return False
    share = f / (f - g)
    world_ray(device, u0 + share * (u1 - u0), v0 + share * (v1 - v0), out)
    return True


@kernel(in_every_scan=False)
def _stereo_kernel(
    begin: int, end: int, camera: Any, other: Any, o1: Any, o2: Any,
    offsets: Any, points: Any, normals: Any, sigma: Any, partner: Any,
    offsets2: Any, points2: Any, normals2: Any, sigma2: Any, bridge2: Any,
    out: Any, deviation: Any, valid: Any,
) -> None:  # fmt: skip
    for curve in range(begin, end):
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
        displaced_ray = np.zeros(3)
        crossing = np.zeros(3)
        displaced = np.zeros(3)
        for i in range(offsets[curve], offsets[curve + 1]):
            world_ray(camera, points[i, 0], points[i, 1], d)
            # Normal of the epipolar plane; the rays of the other camera change side where the curve crosses it.
            n = _cross_product(baseline, d)
            at = -1
            last = b - a - 2
            for reach in range(b - a):
                for k in (hint + reach, hint - reach):
                    if at < 0 and 0 <= k <= last and not bridge2[a + k]:
                        f, g = _dot(n, d2[k]), _dot(n, d2[k + 1])
                        if f * g <= 0 and f != g:
                            at = k
                if at >= 0 or (hint + reach > last and hint - reach < 0):
                    break
            if at < 0:
                continue
            hint = at
            j = a + at
            u0, v0, u1, v1 = points2[j, 0], points2[j, 1], points2[j + 1, 0], points2[j + 1, 1]
            if not _intersect_plane(other, n, u0, v0, u1, v1, crossing) or not _nearest_point(
                o1, d, o2, crossing, out[i]
            ):
                continue
            # Two independent errors, across the stripe in either camera. Each moves the intersection of the epipolar
            # line with the other curve, more if they cross obliquely.
            du, dv = _PROBE_PX * normals[i, 0], _PROBE_PX * normals[i, 1]
            world_ray(camera, points[i, 0] + du, points[i, 1] + dv, displaced_ray)
            if not _intersect_plane(other, _cross_product(baseline, displaced_ray), u0, v0, u1, v1, crossing):
                continue
            _nearest_point(o1, displaced_ray, o2, crossing, displaced)
            first = np.zeros(3)
            for k in range(3):
                first[k] = (displaced[k] - out[i, k]) / _PROBE_PX * sigma[i]
            du, dv = _PROBE_PX * normals2[j, 0], _PROBE_PX * normals2[j, 1]
            if not _intersect_plane(other, n, u0 + du, v0 + dv, u1 + du, v1 + dv, crossing):
                continue
            _nearest_point(o1, d, o2, crossing, displaced)
            squares = square = 0.0
            for k in range(3):
                second = (displaced[k] - out[i, k]) / _PROBE_PX * sigma2[j]
                squares += second * second
                square += first[k] * first[k]
            # Both displace the point along about the same line; their variances add.
            scale = np.sqrt(1 + squares / max(square, 1e-30))
            for k in range(3):
                deviation[i, k] = first[k] * scale
            valid[i] = True

"""From linked stripes to curves in space: camera ray with light sheet, and camera ray with the same code elsewhere."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import Axis, Pinhole, Refusal, Source
from slrig.reconstruction.epipolar import runs_down
from slrig.reconstruction.light_sheet import on_light_sheets
from slrig.reconstruction.linking import StripeEnsemble
from slrig.reconstruction.optics import packed, project, rays, world_ray
from slrig.reconstruction.sheet_curves import SheetCurves, ordered_along_sheet, selected

_PROBE_PX = 1e-3  # far above rounding, and a point moves straight over so little
_BORDER_PX = 2.0  # beyond the projector's image; chosen, 0 and 4 give the same figures of a rendered vase


def camera_projector(
    ensemble: StripeEnsemble, camera: Pinhole, projector: Pinhole, axis: Axis, /
) -> tuple[SheetCurves, NDArray[np.uint8]]:
    """Intersect each point's ray with its light sheet.

    Points behind a device, or met where the projector has no pixel or its lens has turned back, are left out. Also
    returns (n,) uint8, `Refusal`: for every point of the ensemble why it was left out, if it was.
    """
    points, deviation, along, cause = on_light_sheets(ensemble, camera, projector, axis)
    other = Axis.ROW if axis is Axis.COLUMN else Axis.COLUMN
    outside = ~((along > -_BORDER_PX) & (along < projector.size.along(other) - 1 + _BORDER_PX))
    cause[outside & (cause == Refusal.NONE)] = Refusal.OFF_PROJECTOR
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
    return ordered_along_sheet(selected(made, cause == Refusal.NONE)), cause


def camera_camera(first: StripeEnsemble, second: StripeEnsemble, camera: Pinhole, other: Pinhole, /) -> SheetCurves:
    """Triangulate points of `first` with the curve of the same code in `second`; no projector calibration is used.

    The epipolar line of each point is crossed with the other camera's curve between two consecutive points that no
    bridge separates; the two rays then meet in the least-squares sense. Curves run by the rows of `camera`, or by its
    columns where the stripes run rather across the image than down.
    """
    shared, mine, theirs = np.intersect1d(first.position_px, second.position_px, return_indices=True)
    del shared
    partner = np.full(len(first.position_px), -1, dtype=np.int32)
    partner[mine] = theirs
    count = len(first.points_px)
    points, deviation = np.full((count, 3), np.nan), np.full((count, 3), np.nan)
    good = np.zeros(count, dtype=np.bool_)
    in_bands(
        _stereo_kernel, len(partner), packed(camera), packed(other), camera.centre_mm, other.centre_mm,
        first.offsets, first.points_px, first.normals, first.sigma_px, partner,
        second.offsets, second.points_px, second.normals, second.sigma_px, second.bridge_after,
        points, deviation, good,
    )  # fmt: skip
    made = SheetCurves(
        offsets=first.offsets,
        position_px=first.position_px,
        points_mm=points,
        deviation_mm=deviation,
        along_px=first.points_px[:, 1 if runs_down(first) else 0].copy(),
        pixels_px=first.points_px,
        stripe=first.stripe,
        bridge_after=first.bridge_after,
        source=np.full(len(points), Source.CAMERA_CAMERA, dtype=np.uint8),
    )
    return ordered_along_sheet(selected(made, good))


@kernel_part
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


@kernel_part
def _side(normal: Any, d: Any) -> float:
    return float(normal[0] * d[0] + normal[1] * d[1] + normal[2] * d[2])


@kernel_part
def _across(a: Any, b: Any) -> Any:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@kernel_part
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


@kernel(in_every_scan=False)
def _stereo_kernel(
    begin: int, end: int, camera: Any, other: Any, o1: Any, o2: Any,
    offsets: Any, points: Any, normals: Any, sigma: Any, partner: Any,
    offsets2: Any, points2: Any, normals2: Any, sigma2: Any, bridge2: Any,
    out: Any, deviation: Any, good: Any,
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


__all__ = ["SheetCurves", "camera_camera", "camera_projector", "ordered_along_sheet", "project", "rays", "selected"]

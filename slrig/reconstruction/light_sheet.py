"""Where camera rays meet the light sheets of a projector, for blocks of points at a time.

The numbers of a block are the rows of one flat array, at distances that the compiler knows, and loops over its points
choose between values instead of branching: the compiler then makes instructions that take several points at once.
Newton's method goes on for a whole block until its last point settles. A point that has settled stays as it is, so what
becomes of it does not depend on those beside it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import Axis, FloatArray, Pinhole, Refusal
from slrig.model.lens_kernels import STEPS, distorted, step_back
from slrig.reconstruction.linking import StripeEnsemble
from slrig.reconstruction.optics import SETTLED, distorted_from_pixel, normalised_from_pixel, packed

_STEPS = 25  # two to four, of sheets of strong lenses as well; more is a start that does not settle
_CONVERGED_PX = 1e-5  # before the last step of Newton's method, which leaves about the square of it
_NONE, _BEHIND_DEVICE = int(Refusal.NONE), int(Refusal.BEHIND_DEVICE)

_BLOCK = 256  # points; chosen, 128 and 512 are no faster
# Where the rows begin: the point in the camera, distorted; the stripe's normal; x and y of the ray, undistorted; the
# ray in the projector's frame; the depth s along it; whether Newton's method goes on; the point, from the camera's
# centre; how far it moves for a pixel across the stripe; the coordinate along the sheet; the depth in the projector.
_XD, _YD, _NX, _NY, _X, _Y, _DX, _DY, _DZ, _S, _GOES_ON, _PX, _PY, _PZ, _MX, _MY, _MZ, _ALONG, _DEPTH = (
    row * _BLOCK for row in range(19)
)
_ROWS = 19


def on_light_sheets(
    ensemble: StripeEnsemble, camera: Pinhole, projector: Pinhole, axis: Axis, /
) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.uint8]]:
    """Where each point's ray meets its light sheet, how far that moves with its stripe, and which pixel lit it.

    Returns points and deviations (n, 3) float64, mm, and the projector's coordinate along the sheet (n,) float64, px,
    as in `SheetCurves`; and (n,) uint8, `Refusal`: of what is refused, the other values mean nothing.

    The sheet of a distorted column is curved, so the depth s along the ray solves column(project(o + s d)) = c by
    Newton's method on the whole distorted projection, from the plane that touches the sheet at the projector's
    principal point.
    """
    count = len(ensemble.points_px)
    points, deviation = np.zeros((count, 3)), np.zeros((count, 3))
    along, cause = np.zeros(count), np.full(count, Refusal.NO_INTERSECTION, dtype=np.uint8)
    seen = packed(projector)  # from the camera, as if that were the world
    seen[10:19] = (projector.rotation @ camera.rotation.T).ravel()
    seen[19:] = projector.rotation @ camera.centre_mm + projector.translation_mm
    # Numbers, not arrays: the compiler knows that no result is written over them.
    in_bands(
        _sheet_kernel, len(ensemble.position_px), tuple(packed(camera)), tuple(seen), camera.centre_mm,
        ensemble.points_px, ensemble.normals, ensemble.sigma_px, ensemble.offsets, ensemble.position_px,
        axis is Axis.ROW, points, deviation, along, cause,
    )  # fmt: skip
    return points, deviation, along, cause


@kernel_part
def _settle_rays(w: Any, count: int, camera: Any) -> None:
    """Fill in x and y of a block's undistorted rays, NaN for those that the lens cannot light."""
    for _ in range(STEPS):
        unsettled = 0
        for i in range(count):
            x, y, goes_on = w[_X + i], w[_Y + i], w[_GOES_ON + i] > 0
            dx, dy = step_back(camera[5:10], w[_XD + i], w[_YD + i], x, y)
            w[_X + i] = x + (dx if goes_on else 0.0)
            w[_Y + i] = y + (dy if goes_on else 0.0)
            goes_on = goes_on and dx * dx + dy * dy >= SETTLED * SETTLED  # not where that is NaN
            w[_GOES_ON + i] = 1.0 if goes_on else 0.0
            unsettled += goes_on
        if unsettled == 0:
            break


@kernel_part
def _settle_depths(w: Any, count: int, p: Any, coded: Any, position: float) -> None:
    """Fill in the depths s of a block at which its rays are lit by the coded position, NaN where there is none."""
    for _ in range(_STEPS):
        unsettled = 0
        for i in range(count):
            s, dx, dy, dz, goes_on = w[_S + i], w[_DX + i], w[_DY + i], w[_DZ + i], w[_GOES_ON + i] > 0
            scale = 1 / (p[21] + s * dz)
            x, y = (p[19] + s * dx) * scale, (p[20] + s * dy) * scale
            xd, yd, a, b, c = distorted(p[5:10], x, y)
            gx, gy = coded[0] * a + coded[1] * b, coded[0] * b + coded[1] * c
            slope = (gx * (dx - x * dz) + gy * (dy - y * dz)) * scale
            missed = coded[0] * xd + coded[1] * yd + coded[2] - position
            step = missed / slope if slope != 0 else np.nan
            w[_S + i] = s - (step if goes_on else 0.0)
            goes_on = goes_on and abs(missed) >= _CONVERGED_PX  # not where that is NaN
            w[_GOES_ON + i] = 1.0 if goes_on else 0.0
            unsettled += goes_on
        if unsettled == 0:
            break


@kernel_part
def _finish(w: Any, count: int, camera: Any, p: Any, coded: Any, other: Any) -> None:
    """Fill in the points of a block, how far they move for a pixel across the stripe, and what lit them."""
    for i in range(count):
        x, y, dx, dy, dz = w[_X + i], w[_Y + i], w[_DX + i], w[_DY + i], w[_DZ + i]
        s = np.nan if w[_GOES_ON + i] > 0 else w[_S + i]
        depth = p[21] + s * dz
        scale = 1 / depth
        xn, yn = (p[19] + s * dx) * scale, (p[20] + s * dy) * scale
        xd, yd, a, b, c = distorted(p[5:10], xn, yn)
        w[_S + i], w[_DEPTH + i], w[_ALONG + i] = s, depth, other[0] * xd + other[1] * yd + other[2]
        lit = a * c - b * b > 0  # where the projector's lens has not turned back
        gx, gy = coded[0] * a + coded[1] * b, coded[0] * b + coded[1] * c
        # On the same sheet, for a stripe found a little aside: position(o + s d) stays, so along with the ray's
        # direction its depth changes by ds = -s ∇position · dd / ∇position · d.
        _, _, a, b, c = distorted(camera[5:10], x, y)
        scale = s / (a * c - b * b) if lit else np.nan
        across, down = (w[_NX + i] - camera[1] / camera[3] * w[_NY + i]) / camera[0], w[_NY + i] / camera[3]
        mx, my = (c * across - b * down) * scale, (a * down - b * across) * scale
        aside = gx * (p[10] * mx + p[11] * my - xn * (p[16] * mx + p[17] * my))
        aside += gy * (p[13] * mx + p[14] * my - yn * (p[16] * mx + p[17] * my))
        mz = -aside / (gx * (dx - xn * dz) + gy * (dy - yn * dz))
        w[_PX + i], w[_PY + i], w[_PZ + i] = _turned_back(camera, s * x, s * y, s)
        w[_MX + i], w[_MY + i], w[_MZ + i] = _turned_back(camera, mx + mz * x, my + mz * y, mz)


@kernel_part(inline="always")
def _turned_back(d: Any, x: float, y: float, z: float) -> Any:
    """A direction in the device's frame, in the world's: Rᵀ (x, y, z)."""
    return (
        d[10] * x + d[13] * y + d[16] * z,
        d[11] * x + d[14] * y + d[17] * z,
        d[12] * x + d[15] * y + d[18] * z,
    )


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
            _settle_rays(w, count, camera)
            for i in range(count):
                x, y = np.nan if w[_GOES_ON + i] > 0 else w[_X + i], w[_Y + i]
                dx = p[10] * x + p[11] * y + p[12]
                dy = p[13] * x + p[14] * y + p[15]
                dz = p[16] * x + p[17] * y + p[18]
                start = (yp * p[21] - p[20]) / (dy - yp * dz) if row else (xp * p[21] - p[19]) / (dx - xp * dz)
                w[_DX + i], w[_DY + i], w[_DZ + i], w[_S + i], w[_GOES_ON + i] = dx, dy, dz, start, 1.0
            _settle_depths(w, count, p, coded, position)
            _finish(w, count, camera, p, coded, other)
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

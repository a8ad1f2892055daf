"""Check that the numbers of a calibration can be those of a structured-light rig: lenses, fields of view, distances.

The limits are those of optics and of benches, far beyond real rigs: from microscopes with a baseline of a few
millimetres to rooms. Numbers inside the limits can still be wrong; only the frames of a scan can show that.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.errors import CalibrationError, setting
from slrig.model.geometry import Calibration, FloatArray, Pinhole, Size
from slrig.model.lens import distort

LengthUnit = Literal["mm", "cm", "m", "inch"]
MM_PER_UNIT: Mapping[LengthUnit, float] = {"mm": 1.0, "cm": 10.0, "inch": 25.4, "m": 1000.0}
_UNIT_WORDS: Mapping[LengthUnit, str] = {"mm": "Millimetres", "cm": "Centimetres", "inch": "Inches", "m": "Metres"}

_GRID = 15  # pixels to examine along each side of the image, the border included
_PATH_STEPS = 16  # from the principal point to a pixel
_NEWTON_STEPS = 2  # for each step of the path, which is short
_MIN_IMAGED = 0.85
"""Least share of the image that a lens images. Polynomials of real wide lenses fold in the corners, which no board
reached; there a scan has no points."""
_MAX_PINCUSHION = 1.2
"""Distorted radius over undistorted radius; pincushion lenses have up to 1.1."""
_MAX_BELOW_FISHEYE = 0.15
"""The same ratio is cos θ for the strongest fisheye, the orthographic one, at the angle θ; no lens has so much less."""

_FOCAL_PER_SIDE = (0.1, 200.0)
"""Focal length over the longer side of the image: fields of view of 157° and 0.3°."""
_CAMERA_ASPECTS = ((0.8, 1.25), (0.45, 0.55), (1.8, 2.2))
"""fx / fy of cameras: square pixels, those of analogue sensors, and pixels binned along one axis."""
_PROJECTOR_ASPECTS = ((0.4, 2.5),)
"""fx / fy of projectors: a diamond array of mirrors has 0.5 or 2, a picture that is scaled to the panel others."""
_MAX_OUTSIDE = 0.5
"""Distance of the principal point from the image, in sides of the image, beyond which it must be near the axis."""
_MAX_OFF_AXIS = np.tan(np.deg2rad(35.0))
"""Angle from the optical axis to the middle of the image, beyond `_MAX_OUTSIDE`. Shifted projectors have a principal
point near their image, and cropped images one at a small angle."""
_MAX_OUTSIDE_CROPPED = 4.0
"""As `_MAX_OUTSIDE`, at any angle."""

_BASELINE_MM = (2.0, 15_000.0)
_BENCH_BASELINE_MM = (40.0, 3_000.0)
_BENCH_DISTANCE_MM = (100.0, 6_000.0)
_MIN_CONVERGENCE = np.sin(np.deg2rad(3.0))


def calibration_faults(calibration: Calibration, /) -> list[str]:
    """Return the impossible numbers of a calibration, one sentence each, beginning with the device."""
    faults = [
        fault for name, device in calibration.cameras.items() for fault in device_faults(device, f"cameras.{name}")
    ]
    if calibration.projector is not None:
        faults += device_faults(calibration.projector, "projector", is_projector=True)
    layout = rig_layout(calibration)
    if layout is not None and not _BASELINE_MM[0] <= layout.baseline_mm <= _BASELINE_MM[1]:
        faults.append(
            f"translation_mm: expected devices {_BASELINE_MM[0]:g} to {_BASELINE_MM[1]:g} mm apart, found: {layout}. "
            f"{units_sentence(layout)}"
        )
    return faults


def require_plausible(calibration: Calibration, source: str) -> None:
    """Check the numbers of a calibration. source : its origin, for messages.
    Raises CalibrationError, with all faults: see `calibration_faults`.
    """
    faults = calibration_faults(calibration)
    if faults:
        lines = "\n".join(f"  {fault}" for fault in faults)
        message = f"{source}: no rig has these numbers; correct them, or calibrate again:\n{lines}"
        raise CalibrationError(message)


UNSCALED = "unscaled-"
"""Beginning of the solve id of a calibration whose lengths are hundredths of its baseline."""


def require_millimetres(calibration: Calibration, source: str) -> None:
    """Check that the lengths of a calibration are known in mm, before scans use it. Raises CalibrationError."""
    if calibration.solved is not None and calibration.solved.id.startswith(UNSCALED):
        message = (
            f"{source}: expected lengths in mm, found hundredths of the baseline: the scan that gave this calibration "
            "knew no length. Compute that scan again with the distance from the first camera to the projector "
            f"({setting('baseline_mm')}), or with one that follows from a known length of the object"
        )
        raise CalibrationError(message)


def device_faults(device: Pinhole, place: str, *, is_projector: bool = False) -> list[str]:
    """Return the impossible numbers of a lens. place : the device, for messages."""
    sides = np.array([device.size.width_px, device.size.height_px], dtype=np.float64)
    focal = np.array([device.matrix[0, 0], device.matrix[1, 1]])
    principal = device.matrix[:2, 2]
    faults = []
    low, high = _FOCAL_PER_SIDE
    if not low <= focal.min() / sides.max() or not focal.max() / sides.max() <= high:
        faults.append(
            f"{place}.matrix: expected focal lengths of {low * sides.max():g} to {high * sides.max():g} px for an "
            f"image of {device.size}, found {focal[0]:g} and {focal[1]:g}. Are they in millimetres? Divide by the "
            "size of a pixel"
        )
    aspect, aspects = focal[0] / focal[1], _PROJECTOR_ASPECTS if is_projector else _CAMERA_ASPECTS
    if not any(least <= aspect <= most for least, most in aspects):
        faults.append(
            f"{place}.matrix: expected fx / fy of a pixel, {' or '.join(f'{a:g} to {b:g}' for a, b in aspects)}, found "
            f"{aspect:.3g} (fx {focal[0]:g}, fy {focal[1]:g}). A calibration from too few or parallel views has such "
            "numbers"
        )
    beyond = np.maximum(np.maximum(-0.5 - principal, principal - (sides - 0.5)), 0) / sides
    off_axis = np.linalg.norm((principal - (sides - 1) / 2) / focal)
    if beyond.max() > _MAX_OUTSIDE_CROPPED or (beyond.max() > _MAX_OUTSIDE and off_axis > _MAX_OFF_AXIS):
        faults.append(
            f"{place}.matrix: expected the principal point in or near the image of {device.size}, found it at "
            f"({principal[0]:g}, {principal[1]:g}), {np.rad2deg(np.arctan(off_axis)):.0f}° off its middle"
        )
    if not faults:
        imaged = imaged_share(device)
        if imaged < _MIN_IMAGED:
            faults.append(
                f"{place}.distortion: expected a lens that images all of {device.size}, found one that folds within "
                f"it, or bends rays more than any lens: {1 - imaged:.0%} of the image is beyond "
                f"({', '.join(f'{term:g}' for term in device.distortion)}). A calibration from too few views has such "
                "numbers: solve with fewer terms, or with views that reach the corners"
            )
    return faults


def imaged_share(device: Pinhole, /) -> float:
    """Return the share of the image that the lens images, of a grid of pixels that includes the border."""
    points = _grid(device.size)
    return 1.0 if _is_weak_lens(device, points) else float(imaged_pixels(device, points).mean())


def _is_weak_lens(device: Pinhole, points_px: FloatArray) -> bool:
    """Return True if bounds of the distortion suffice to show that the lens images all pixels.

    Where the derivatives are at least 0.7 up to 1.5 times the largest distorted radius, they are so up to the largest
    undistorted one, and the radius changes by half of the bound of their change at the most.
    """
    xd, yd = _distorted(device, points_px)
    radius = 1.5 * float(np.hypot(xd, yd).max())
    k1, k2, p1, p2, k3 = np.abs(device.distortion)
    change = 3 * k1 * radius**2 + 5 * k2 * radius**4 + 7 * k3 * radius**6 + 6 * (p1 + p2) * radius
    return bool(change < 0.3)


def _distorted(device: Pinhole, points_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return x and y, (n,) each, of pixels (n, 2) in the plane at depth 1, distorted."""
    matrix = device.matrix
    yd = (points_px[:, 1] - matrix[1, 2]) / matrix[1, 1]
    return (points_px[:, 0] - matrix[0, 2] - matrix[0, 1] * yd) / matrix[0, 0], yd


def imaged_pixels(device: Pinhole, points_px: FloatArray, /) -> NDArray[np.bool_]:
    """(n,) bool: True for pixels (n, 2) that the lens images by the branch of the distortion that begins at the axis.

    The path from the principal point to the pixel is followed in short steps, each by Newton's method. It ends where
    the determinant of the derivatives is no longer positive: there the lens folds, and no ray arrives beyond. A pixel
    is not imaged either if its ray is bent more than by any lens (`_MAX_PINCUSHION`, `_MAX_BELOW_FISHEYE`).
    """
    xd, yd = _distorted(device, points_px)
    x, y = np.zeros_like(xd), np.zeros_like(yd)
    with np.errstate(all="ignore"):
        for step in range(1, _PATH_STEPS + 1):
            share = step / _PATH_STEPS
            for _ in range(_NEWTON_STEPS):
                gx, gy, a, b, c = distort(device.distortion, x, y)
                det = a * c - b * b
                scale = np.where(det > 0, 1 / det, np.nan)
                ex, ey = share * xd - gx, share * yd - gy
                x, y = x + (c * ex - b * ey) * scale, y + (a * ey - b * ex) * scale
        gx, gy, a, b, c = distort(device.distortion, x, y)
        near = np.hypot(gx - xd, gy - yd) * min(device.matrix[0, 0], device.matrix[1, 1]) < 1.0
        radius = np.hypot(x, y)
        ratio = np.where(radius > 1e-9, np.hypot(xd, yd) / radius, 1.0)
        is_lens = (ratio <= _MAX_PINCUSHION) & (ratio >= 1 / np.sqrt(1 + radius**2) - _MAX_BELOW_FISHEYE)
        return np.asarray(near & (a * c - b * b > 0) & is_lens)


def _grid(size: Size) -> FloatArray:
    columns, rows = (np.linspace(0, side - 1, _GRID) for side in (size.width_px, size.height_px))
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)


class RigLayout(NamedTuple):
    """Layout of the devices of a calibration.

    first, second : names of the two devices that are farthest apart; baseline_mm : their distance. distance_mm :
    distance from the first device to the place that both point at, by the rays of the middles of their images; None if
    these rays hardly converge.
    """

    first: str
    second: str
    baseline_mm: float
    distance_mm: float | None

    def __str__(self) -> str:
        return self.in_unit("mm")

    def in_unit(self, unit: LengthUnit) -> str:
        """Describe the layout if its numbers are in this unit."""
        scale = MM_PER_UNIT[unit]
        text = f"{self.first} and {self.second} are {scale * self.baseline_mm:.3g} mm apart"
        if self.distance_mm is None:
            return text
        return f"{text} and point at a place {scale * self.distance_mm:.3g} mm away"

    def is_of_a_bench(self, unit: LengthUnit) -> bool:
        """Return True if the distances are usual for a bench with its numbers in this unit."""
        scale = MM_PER_UNIT[unit]
        low, high = _BENCH_BASELINE_MM
        if not low <= scale * self.baseline_mm <= high:
            return False
        low, high = _BENCH_DISTANCE_MM
        return self.distance_mm is None or low <= scale * self.distance_mm <= high


def rig_layout(calibration: Calibration, /) -> RigLayout | None:
    """Return the layout of the two devices that are farthest apart; None for one device, or all in one place."""
    devices = {f"camera '{name}'": device for name, device in calibration.cameras.items()}
    if calibration.projector is not None:
        devices["the projector"] = calibration.projector
    pairs = [
        (float(np.linalg.norm(devices[a].centre_mm - devices[b].centre_mm)), a, b) for a, b in combinations(devices, 2)
    ]
    if not pairs:
        return None
    baseline_mm, first, second = max(pairs)
    if baseline_mm == 0:
        return None
    return RigLayout(first, second, baseline_mm, _meeting_distance_mm(devices[first], devices[second]))


def _meeting_distance_mm(first: Pinhole, second: Pinhole) -> float | None:
    """Distance from the first device to the place where its middle ray is closest to that of the second."""
    rays = [_middle_ray(device) for device in (first, second)]
    normal = np.cross(rays[0], rays[1])
    square = normal @ normal
    if square < _MIN_CONVERGENCE**2:
        return None
    between = second.centre_mm - first.centre_mm
    along = [float(np.cross(between, ray) @ normal / square) for ray in reversed(rays)]
    return along[0] if min(along) > 0 else None


def _middle_ray(device: Pinhole) -> FloatArray:
    """(3,) float64: unit direction in the world of the middle of the image, without distortion."""
    middle = (np.array([device.size.width_px, device.size.height_px]) - 1) / 2
    ray = device.rotation.T @ np.linalg.solve(device.matrix, np.append(middle, 1.0))
    return np.asarray(ray / np.linalg.norm(ray))


def units_sentence(layout: RigLayout) -> str:
    """Return which other units make a bench of the layout, and how to state one."""
    units = [unit for unit in MM_PER_UNIT if unit != "mm" and layout.is_of_a_bench(unit)]
    likely = "".join(f"{_UNIT_WORDS[unit]}? Then {layout.in_unit(unit)} (--unit {unit}). " for unit in units)
    return (
        f"{likely}State the unit of a file: slrig import, slrig calibrate import and slrig "
        f"calibrate export have --unit {', '.join(MM_PER_UNIT)}; send millimetres to the service"
    )

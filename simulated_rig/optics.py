"""Lenses of the simulated rig: pinhole with Brown distortion, both ways (to pixels and to rays), and defocus.

x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²), y' likewise with p1 (r² + 2 y²) + 2 p2 x y (Brown 1966,
in the form and order of OpenCV). This code belongs to the simulator alone: the reconstruction has its own.

A lens focused at f images a point at distance d as a disc as wide as |1/f - 1/d|. The disc is approximated by a
Gaussian of standard deviation σ = s |1 - f/d|; s is that of an infinitely distant point. Images are rendered at a few
levels of σ, and each pixel is interpolated between two of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import kernel, kernel_part
from slrig.model import FloatArray, Pinhole

LEVELS_PX = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0)
"""Chosen so that the mean of two neighbouring Gaussians is within 3 % of white of one Gaussian, also for a line of 1
px."""


LensArray = NDArray[np.float64]
"""(9,) float64: fx, fy, cx, cy, k1, k2, p1, p2, k3."""
_NEWTON_STEPS = 12
_CONVERGED = 1e-13
_MARGIN = 1.05


@dataclass(frozen=True, slots=True)
class Focus:
    """Focus of a lens. sharp_mm : distance of the sharp plane. far_px : spread of an infinitely distant point."""

    sharp_mm: float = 1.0
    far_px: float = 0.0

    def spread_px(self, distance_mm: FloatArray) -> FloatArray:
        """Standard deviation at these distances, px, same shape; 0 where the distance is NaN."""
        spread = self.far_px * np.abs(1 - self.sharp_mm / distance_mm)
        return np.asarray(np.nan_to_num(spread).clip(max=LEVELS_PX[-1]))


ALWAYS_SHARP = Focus()


def level_weights(spread_px: FloatArray) -> dict[int, NDArray[np.float32]]:
    """Interpolation weight of each level in use, (H, W) float32 by its index. The weights of a pixel sum to 1."""
    levels = np.array(LEVELS_PX)
    above = np.searchsorted(levels, spread_px, side="left").clip(1, len(levels) - 1)
    share = (spread_px - levels[above - 1]) / (levels[above] - levels[above - 1])
    weights = {}
    for index in range(len(levels)):
        weight = np.where(above == index, share, 0) + np.where(above - 1 == index, 1 - share, 0)
        if weight.any():
            weights[index] = weight.astype(np.float32)
    return weights


def lens_array(device: Pinhole) -> LensArray:
    """Return the parameters of a lens in the layout that the kernels take."""
    k = device.matrix
    return np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2], *device.distortion], np.float64)


@kernel_part
def distort(x: float, y: float, lens: LensArray) -> tuple[float, float]:
    """Apply the distortion to the normalised point (x, y)."""
    k1, k2, p1, p2, k3 = lens[4], lens[5], lens[6], lens[7], lens[8]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    )


@kernel_part
def undistort(xd: float, yd: float, lens: LensArray) -> tuple[float, float]:
    """Invert `distort` by Newton's method on both equations."""
    k1, k2, p1, p2, k3 = lens[4], lens[5], lens[6], lens[7], lens[8]
    x, y = xd, yd
    for _ in range(_NEWTON_STEPS):
        fx, fy = distort(x, y, lens)
        ex, ey = fx - xd, fy - yd
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
        jxx = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        jyy = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        jxy = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
        determinant = jxx * jyy - jxy * jxy
        if determinant == 0.0:
            break
        x -= (jyy * ex - jxy * ey) / determinant
        y -= (jxx * ey - jxy * ex) / determinant
        if ex * ex + ey * ey < _CONVERGED * _CONVERGED:
            break
    return x, y


@kernel(in_every_scan=False)
def world_directions(
    u: NDArray[np.float64], v: NDArray[np.float64], lens: LensArray, rotation: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Unit directions in the world, (n, 3) float64, of the rays through the pixel positions u, v ((n,) float64)."""
    out = np.zeros((len(u), 3))
    for i in range(len(u)):
        x, y = undistort((u[i] - lens[2]) / lens[0], (v[i] - lens[3]) / lens[1], lens)
        scale = 1.0 / np.sqrt(x * x + y * y + 1.0)
        for axis in range(3):
            out[i, axis] = scale * (rotation[0, axis] * x + rotation[1, axis] * y + rotation[2, axis])
    return out


def field_radius(device: Pinhole) -> float:
    """Return the largest undistorted radius of a point within the image, with a small margin.

    Points beyond it are not imaged: a distortion polynomial may fold back there and give a false pixel.
    """
    width, height = device.size.width_px, device.size.height_px
    along, down = np.linspace(-0.5, width - 0.5, 65), np.linspace(-0.5, height - 0.5, 65)
    u = np.concatenate([along, along, np.full(65, -0.5), np.full(65, width - 0.5)])
    v = np.concatenate([np.full(65, -0.5), np.full(65, height - 0.5), down, down])
    rays = world_directions(u, v, lens_array(device), np.eye(3))
    return float(np.hypot(rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]).max()) * _MARGIN


def look_at(position_mm: FloatArray, target_mm: FloatArray, down: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (rotation, translation_mm), world to device, of a device that points at a target.

    `down` is the world direction that points down in the image, as nearly as the viewing direction allows. Raises
    ValueError when position and target coincide or the device points along `down`.
    """
    forward = target_mm - position_mm
    distance = float(np.linalg.norm(forward))
    right = np.cross(down, forward)
    spread = float(np.linalg.norm(right))
    if distance == 0.0 or spread <= 1e-9 * distance * float(np.linalg.norm(down)):
        message = (
            f"a device at {position_mm.tolist()} cannot point at {target_mm.tolist()} with {down.tolist()} pointing "
            "down: the two directions must differ"
        )
        raise ValueError(message)
    z, x = forward / distance, right / spread
    rotation = np.stack([x, np.cross(z, x), z])
    return rotation, -rotation @ position_mm


def vignetting(
    column_px: NDArray[Any], row_px: NDArray[Any], projector: Pinhole, fall_off: tuple[float, float]
) -> NDArray[Any]:
    """Factor of the projector's lens on the light at these positions: see `SimulatedProjectorOptions.fall_off`."""
    power, corner = fall_off
    (fx, _, cx), (_, fy, cy), _ = projector.matrix
    square = ((column_px - cx) / fx) ** 2 + ((row_px - cy) / fy) ** 2
    width, height = projector.size.width_px, projector.size.height_px
    farthest = (max(cx, width - cx) / fx) ** 2 + (max(cy, height - cy) / fy) ** 2
    return np.asarray((1 + square) ** (-power / 2) * np.maximum(1 - corner * square / farthest, 0))


def image_positions(points_mm: FloatArray, device: Pinhole) -> FloatArray:
    """Pixel positions, (n, 2) float64, of world points in front of a device, (n, 3); they may be outside its image."""
    at = points_mm @ device.rotation.T + device.translation_mm
    x, y = at[:, 0] / at[:, 2], at[:, 1] / at[:, 2]
    lens = lens_array(device)
    xd, yd = distort.py_func(x, y, lens)
    return np.column_stack([lens[0] * xd + lens[2], lens[1] * yd + lens[3]])

"""A plane before camera and projector, photographed by formulas of its own: no code under test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slrig.model import Calibration, Gray, LineShift, Pattern, Pinhole, Sine, Size, to_gray

Floats = NDArray[np.float64]
CAMERA, PROJECTOR = Size(240, 180), Size(640, 400)
FRAME_S, EXPOSURE_S = 0.05, 0.02
BLUR_PX = 0.9
_PER_PX = 10


def _device(size: Size, focal_px: float, x_mm: float, turn_deg: float) -> Pinhole:
    turn = np.radians(turn_deg)
    rotation = np.array([[np.cos(turn), 0, -np.sin(turn)], [0, 1, 0], [np.sin(turn), 0, np.cos(turn)]])
    matrix = np.array([[focal_px, 0, size.width_px / 2], [0, focal_px, size.height_px / 2], [0, 0, 1]])
    return Pinhole(size, matrix, np.zeros(5), rotation, -rotation @ np.array([x_mm, 0.0, -600.0]))


def calibration() -> Calibration:
    """Camera "left" and a projector that meet 600 mm in front of them."""
    return Calibration({"left": _device(CAMERA, 900.0, -100.0, 9.5)}, _device(PROJECTOR, 2400.0, 100.0, -9.5))


@dataclass(frozen=True)
class Plane:
    """A plane through (0, 0, z) with this normal; it moves along z by `speed_mm_s`. still_share : of the camera's
    columns, on the left, that show it as it was at the start.
    """

    normal: tuple[float, float, float] = (0.15, -0.1, -1.0)
    speed_mm_s: float = 0.0
    still_share: float = 0.0

    def depth_mm(self, camera: Pinhole, t_s: float) -> Floats:
        """(H, W) depth along the camera's axis at a time."""
        rays, normal = _rays(camera), np.array(self.normal)
        moved = np.full(camera.size.width_px, self.speed_mm_s * t_s)
        moved[: round(self.still_share * camera.size.width_px)] = 0
        point = np.zeros((camera.size.width_px, 3))
        point[:, 2] = moved
        return np.asarray(((point - camera.centre_mm) @ normal)[None, :] / (rays @ normal))


def _rays(camera: Pinhole) -> Floats:
    rows, columns = np.mgrid[0 : camera.size.height_px, 0 : camera.size.width_px].astype(float)
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1)
    return np.asarray(pixels @ np.linalg.inv(camera.matrix).T @ camera.rotation)


def light(pattern: Pattern, u: Floats, gamma: float) -> Floats:
    """Light of a pattern at projector columns u, from 0 to 1: a projector of this gamma, out of focus by `BLUR_PX`."""
    fine = np.arange(0, PROJECTOR.width_px * _PER_PX) / _PER_PX - 0.5
    at = np.rint(fine).astype(int)
    if isinstance(pattern, Sine):
        value = (0.5 + 0.5 * np.cos(2 * np.pi * (at / pattern.period_px - pattern.shift / pattern.steps))) ** gamma
    elif isinstance(pattern, LineShift):
        value = ((at - pattern.shift) % pattern.period_px < pattern.line_width_px).astype(float)
    else:
        assert isinstance(pattern, Gray)
        word = to_gray((at + pattern.offset_px) // pattern.cell_px)
        value = ((word >> (pattern.bits - 1 - pattern.bit)) & 1).astype(float)
    reach = np.arange(-5 * _PER_PX, 5 * _PER_PX + 1) / _PER_PX
    spread = np.exp(-(reach**2) / (2 * BLUR_PX**2))
    return np.asarray(np.interp(u, fine, np.convolve(value, spread / spread.sum(), "same")))


@dataclass
class Photographer:
    """Takes pictures of the plane. noise : read variance and slope, DN². The texture is grey from 0.4 to 1."""

    plane: Plane
    patterns: Sequence[Pattern]
    gamma: float = 1.0
    read: float = 1.0
    slope: float = 0.02
    seed: int = 0

    def __post_init__(self) -> None:
        devices = calibration()
        assert devices.projector is not None
        self.camera, self.projector = devices.cameras["left"], devices.projector
        self.rng = np.random.default_rng(self.seed)

    def texture(self, shape: tuple[int, ...]) -> Floats:
        rows, columns = np.mgrid[0 : shape[0], 0 : shape[1]]
        return np.asarray(0.7 + 0.3 * np.sin(columns / 23.0) * np.cos(rows / 17.0))

    def column_px(self, t_s: float) -> Floats:
        """(H, W) projector column that each pixel sees."""
        points = self.camera.centre_mm + _rays(self.camera) * self.plane.depth_mm(self.camera, t_s)[..., None]
        seen = points @ self.projector.rotation.T + self.projector.translation_mm
        return np.asarray(self.projector.matrix[0, 0] * seen[..., 0] / seen[..., 2] + self.projector.matrix[0, 2])

    def frame(self, pattern: int, t_s: float) -> NDArray[np.uint8]:
        u = self.column_px(t_s)
        lit = light(self.patterns[pattern], u, self.gamma) * ((u > 0) & (u < self.projector.size.width_px - 1))
        mean = 8 + 200 * self.texture(u.shape) * lit
        noisy = mean + self.rng.standard_normal(u.shape) * np.sqrt(self.read + self.slope * mean)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def bound_mm(photographer: Photographer, fine: Sequence[int], t_s: float) -> Floats:
    """(H, W) least standard deviation of depth by the fine frames: Fisher information of phase, level and modulation
    (numerical), times the change of depth per projector column (finite difference).
    """
    u = np.clip(photographer.column_px(t_s), 5.0, PROJECTOR.width_px - 6.0)
    reflected = 200 * photographer.texture(u.shape)
    information = np.zeros((*u.shape, 3, 3))
    for index in fine:
        pattern, step = photographer.patterns[index], 0.05
        shape = light(pattern, u, photographer.gamma)
        change = reflected * (light(pattern, u + step, photographer.gamma) - shape) / step
        jacobian = np.stack([change, np.ones_like(u), shape], axis=-1)
        variance = photographer.read + photographer.slope * (8 + reflected * shape) + 1 / 12
        information += jacobian[..., :, None] * jacobian[..., None, :] / variance[..., None, None]
    sigma_u = np.sqrt(np.linalg.inv(information)[..., 0, 0])
    plane, camera = photographer.plane, photographer.camera
    moved = Photographer(Plane(plane.normal, speed_mm_s=1.0), photographer.patterns)
    per_mm = (moved.column_px(0.5) - moved.column_px(-0.5)) / (
        moved.plane.depth_mm(camera, 0.5) - moved.plane.depth_mm(camera, -0.5)
    )
    return np.asarray(sigma_u / np.abs(per_mm))

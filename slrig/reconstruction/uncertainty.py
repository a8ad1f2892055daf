"""What the errors of stripe points mean in space."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel
from slrig.model import Axis, FloatArray, Pinhole
from slrig.reconstruction.optics import to_depths


def sigma_along_normal(deviation_mm: FloatArray, normals: NDArray[np.float32]) -> FloatArray:
    """(n,) float64: standard deviation along the surface normal, mm.

    deviation_mm : (n, 3), displacement for one standard deviation; normals : (n, 3), unit. Where no triangle gives a
    normal the whole displacement stands: an upper bound.
    """
    sigma = np.zeros(len(deviation_mm))
    in_bands(_along_normal, len(sigma), deviation_mm, normals, sigma)
    return sigma


def sampling_mm(
    points_mm: FloatArray, camera: Pinhole, projector: Pinhole | None, axis: Axis, step_px: float | FloatArray
) -> FloatArray:
    """(n,) float64: how far apart the rig samples a surface that faces it, mm.

    The larger of a camera pixel at the point's depth and, with a projector, of `step_px` of its columns, or rows where
    `axis` says so; (n,) where it varies. Each is measured along that axis: an array of mirrors may be addressed twice
    as finely in one.
    """
    k = 0 if axis is Axis.COLUMN else 1
    pixel = to_depths(camera, points_mm) / camera.matrix[k, k]
    if projector is None:
        return np.asarray(pixel * step_px)
    return np.asarray(np.maximum(pixel, step_px * to_depths(projector, points_mm) / projector.matrix[k, k]))


@kernel
def _along_normal(first: int, last: int, deviation: Any, normals: Any, sigma: Any) -> None:
    for point in range(first, last):
        x, y, z = deviation[point, 0], deviation[point, 1], deviation[point, 2]
        along = abs(x * normals[point, 0] + y * normals[point, 1] + z * normals[point, 2])
        sigma[point] = along if np.isfinite(along) else np.sqrt(x * x + y * y + z * z)

"""How a triangulated point moves with the numbers of the devices that found it, for kernels.

Of a point X found from three equations h(X, θ) = m, its pixel in a camera and one more, a change of the parameters θ
moves the part along a direction n by -wᵀ ∂h/∂θ dθ, with wᵀ = nᵀ (∂h/∂X)⁻¹ (the implicit function theorem). Devices are
packed as in `slrig.reconstruction.optics`; their 15 parameters are those of a calibration's covariance.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from slrig.kernels import kernel_part
from slrig.model import DEVICE_PARAMETERS
from slrig.model.lens_kernels import by_terms, distorted
from slrig.reconstruction.optics import to_device


@kernel_part
def gradient(d: Any, a: float, b: float, x: float, y: float, z: float, out: Any) -> None:
    """Fill out (3,) with ∂(a u + b v)/∂X, X in the world."""
    xc, yc, zc = to_device(d, x, y, z)
    xn, yn = xc / zc, yc / zc
    _, _, xx, xy, yy = distorted(d[5:10], xn, yn)
    by_x, by_y = a * d[0], a * d[1] + b * d[3]
    gx, gy = (by_x * xx + by_y * xy) / zc, (by_x * xy + by_y * yy) / zc
    gz = -(gx * xn + gy * yn)
    for k in range(3):
        out[k] = d[10 + k] * gx + d[13 + k] * gy + d[16 + k] * gz


@kernel_part
def add_parameters(d: Any, a: float, b: float, x: float, y: float, z: float, out: Any) -> None:
    """Add the derivatives of a u + b v by the device's 15 parameters to out (15,)."""
    xc, yc, zc = to_device(d, x, y, z)
    xn, yn = xc / zc, yc / zc
    xd, yd, xx, xy, yy = distorted(d[5:10], xn, yn)
    by_x, by_y = a * d[0], a * d[1] + b * d[3]
    out[0] += a * xd
    out[1] += b * yd
    out[2] += a
    out[3] += b
    k1, k2, p1, p2, k3 = by_terms(by_x, by_y, xn, yn)
    out[4] += k1
    out[5] += k2
    out[6] += p1
    out[7] += p2
    out[8] += k3
    gx, gy = (by_x * xx + by_y * xy) / zc, (by_x * xy + by_y * yy) / zc
    gz = -(gx * xn + gy * yn)
    # R' X = R X + turn x (R X).
    wx, wy, wz = xc - d[19], yc - d[20], zc - d[21]
    out[9] += wy * gz - wz * gy
    out[10] += wz * gx - wx * gz
    out[11] += wx * gy - wy * gx
    out[12] += gx
    out[13] += gy
    out[14] += gz


@kernel_part
def pixel_squares(d: Any, size: Any, x: float, y: float, z: float, direction: Any, g: Any) -> float:
    """How far, in pixels, squared, the image of a point moves when it moves along a direction; 0 out of the image."""
    xc, yc, zc = to_device(d, x, y, z)
    if zc <= 0:
        return 0.0
    xd, yd, xx, xy, yy = distorted(d[5:10], xc / zc, yc / zc)
    u, v = d[0] * xd + d[1] * yd + d[2], d[3] * yd + d[4]
    # Beyond the radius at which its distortion turns back a lens sees nothing.
    if not (-0.5 < u < size[0] - 0.5 and -0.5 < v < size[1] - 0.5 and xx * yy - xy * xy > 0):
        return 0.0
    total = 0.0
    for k in range(2):
        gradient(d, 1.0 - k, 1.0 * k, x, y, z, g)
        along = g[0] * direction[0] + g[1] * direction[1] + g[2] * direction[2]
        total += along * along
    return total


@kernel_part
def add_row(
    devices: Any, camera: int, other: int, a: float, b: float, share: float, point: Any, normal: Any, g: Any, out: Any
) -> bool:
    """Add to out (15 d,) how the point moves along the normal by each parameter; False if nothing determines it.

    The third equation is a u + b v of the device `other`. g : (3, 3), to work in.
    """
    x, y, z = point[0], point[1], point[2]
    gradient(devices[camera], 1.0, 0.0, x, y, z, g[0])
    gradient(devices[camera], 0.0, 1.0, x, y, z, g[1])
    gradient(devices[other], a, b, x, y, z, g[2])
    r, s, t = g[0], g[1], g[2]
    st0, st1, st2 = s[1] * t[2] - s[2] * t[1], s[2] * t[0] - s[0] * t[2], s[0] * t[1] - s[1] * t[0]
    tr0, tr1, tr2 = t[1] * r[2] - t[2] * r[1], t[2] * r[0] - t[0] * r[2], t[0] * r[1] - t[1] * r[0]
    rs0, rs1, rs2 = r[1] * s[2] - r[2] * s[1], r[2] * s[0] - r[0] * s[2], r[0] * s[1] - r[1] * s[0]
    det = r[0] * st0 + r[1] * st1 + r[2] * st2
    if det == 0 or not np.isfinite(det):
        return False
    scale = -share / det
    u = scale * (normal[0] * st0 + normal[1] * st1 + normal[2] * st2)
    v = scale * (normal[0] * tr0 + normal[1] * tr1 + normal[2] * tr2)
    w = scale * (normal[0] * rs0 + normal[1] * rs1 + normal[2] * rs2)
    add_parameters(devices[camera], u, v, x, y, z, out[camera * DEVICE_PARAMETERS : (camera + 1) * DEVICE_PARAMETERS])
    add_parameters(
        devices[other], w * a, w * b, x, y, z, out[other * DEVICE_PARAMETERS : (other + 1) * DEVICE_PARAMETERS]
    )
    return True


@kernel_part
def across(devices: Any, second: int, point: Any, tangent: Any, g: Any) -> Any:
    """The direction across the stripe in the second camera's image, a unit vector.

    Without a tangent, along the epipolar line of the first camera's ray.
    """
    d = devices[0]
    epipolar = not np.isfinite(tangent[0])
    x = tangent[0]
    y = tangent[1]
    z = tangent[2]
    if epipolar:
        # From the first camera's centre, -Rᵀ t, to the point.
        x = point[0] + d[10] * d[19] + d[13] * d[20] + d[16] * d[21]
        y = point[1] + d[11] * d[19] + d[14] * d[20] + d[17] * d[21]
        z = point[2] + d[12] * d[19] + d[15] * d[20] + d[18] * d[21]
    gradient(devices[second], 1.0, 0.0, point[0], point[1], point[2], g[0])
    gradient(devices[second], 0.0, 1.0, point[0], point[1], point[2], g[1])
    u = g[0, 0] * x + g[0, 1] * y + g[0, 2] * z
    v = g[1, 0] * x + g[1, 1] * y + g[1, 2] * z
    length = np.sqrt(u * u + v * v)
    if epipolar:
        return u / length, v / length
    return v / length, -u / length


@kernel_part
def shares_of_mean(devices: Any, sizes: Any, point: Any, ray: Any, g: Any, shares: Any) -> float:
    """Fill shares with each camera's part in the mean of all that see a point; their sum before, 0 if none does."""
    p = devices[len(devices) - 1]
    for k in range(3):
        # From the projector's centre, -Rᵀ t, to the point.
        ray[k] = point[k] + p[10 + k] * p[19] + p[13 + k] * p[20] + p[16 + k] * p[21]
    total = 0.0
    for index in range(len(shares)):
        shares[index] = pixel_squares(devices[index], sizes[index], point[0], point[1], point[2], ray, g[0])
        total += shares[index]
    for index in range(len(shares)):
        shares[index] = shares[index] / total if total > 0 else 0.0
    return total

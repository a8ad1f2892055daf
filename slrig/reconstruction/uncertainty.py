"""Last steps of the standard deviation of points: its part along the normal, and the calibration's part.

The σ of a vertex consists of, added in squares:

1. noise of the pixels (`camera_response.estimate_noise`, with correlation and compression), over the gradient of the
   position (`surface_fit`), or the filter's own σ (`stripes`), joined by `refinement`;
2. mixed light near depth steps (`phase.step_sigma_px`), brightness gradients (`phase.centroid_residual_px`), and
   light from other surfaces that makes lines asymmetric (`phase.asymmetry_sigma_px`); of code edges, light that spreads
   to one side (`decoded_image.code_edge_points`), and bits that contradict one another (`bit_agreement`);
3. both moved through the triangulation, which gives millimetres (`triangulation`, fused by `merging`), and projected
   onto the normal (`sigma_along_normal`);
4. the calibration's covariance, if it states one (`calibration_sigma`);
5. the disagreement of cameras beyond the stated σ (`redundancy`), and the covariance of a pose refined from them
   (`pose_refinement`).

`slrig.scan.reconstruct` adds 3 to 5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.errors import CalibrationError
from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import DEVICE_PARAMETERS, Axis, Calibration, FloatArray, IntArray, Pinhole, Source
from slrig.model.lens_kernels import distort, distortion_by_terms
from slrig.reconstruction.triangulation import optical_depths_mm, pack_device, to_device

_EACH = DEVICE_PARAMETERS
_NODES = 10  # along each side of the volume
_MIN_NODES = 8  # 24 displacements, to remove a rigid motion of six parameters
_MAX_DROPPED = 0.002  # of the variance, anywhere in the volume
_REACH = 2  # points either way, for the direction of a curve
_CAMERA_CAMERA, _ALL = int(Source.CAMERA_CAMERA), int(Source.ALL)


@kernel_part
def coordinate_gradient(d: Any, a: float, b: float, x: float, y: float, z: float, out: Any) -> None:
    """Fill out (3,) with ∂(a u + b v)/∂X, X in the world."""
    xc, yc, zc = to_device(d, x, y, z)
    xn, yn = xc / zc, yc / zc
    _, _, xx, xy, yy = distort(d[5:10], xn, yn)
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
    xd, yd, xx, xy, yy = distort(d[5:10], xn, yn)
    by_x, by_y = a * d[0], a * d[1] + b * d[3]
    out[0] += a * xd
    out[1] += b * yd
    out[2] += a
    out[3] += b
    k1, k2, p1, p2, k3 = distortion_by_terms(by_x, by_y, xn, yn)
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
def squared_image_motion(d: Any, size: Any, x: float, y: float, z: float, direction: Any, g: Any) -> float:
    """Squared motion of the image of a point, px², for a motion of the point along a direction; 0 outside the image."""
    xc, yc, zc = to_device(d, x, y, z)
    if zc <= 0:
        return 0.0
    xd, yd, xx, xy, yy = distort(d[5:10], xc / zc, yc / zc)
    u, v = d[0] * xd + d[1] * yd + d[2], d[3] * yd + d[4]
    # Beyond the radius at which its distortion stops rising, a lens images nothing.
    if not (-0.5 < u < size[0] - 0.5 and -0.5 < v < size[1] - 0.5 and xx * yy - xy * xy > 0):
        return 0.0
    total = 0.0
    for k in range(2):
        coordinate_gradient(d, 1.0 - k, 1.0 * k, x, y, z, g)
        along = g[0] * direction[0] + g[1] * direction[1] + g[2] * direction[2]
        total += along * along
    return total


@kernel_part
def add_sensitivity(
    devices: Any, camera: int, other: int, a: float, b: float, share: float, point: Any, normal: Any, g: Any, out: Any
) -> bool:
    """Add to out (15 d,) the motion of the point along the normal by each parameter; False if nothing determines it.

    The third equation is a u + b v of the device `other`. g : (3, 3) working memory.
    """
    x, y, z = point[0], point[1], point[2]
    coordinate_gradient(devices[camera], 1.0, 0.0, x, y, z, g[0])
    coordinate_gradient(devices[camera], 0.0, 1.0, x, y, z, g[1])
    coordinate_gradient(devices[other], a, b, x, y, z, g[2])
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
def stripe_normal(devices: Any, second: int, point: Any, tangent: Any, g: Any) -> Any:
    """Direction across the stripe in the second camera's image, a unit vector.

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
    coordinate_gradient(devices[second], 1.0, 0.0, point[0], point[1], point[2], g[0])
    coordinate_gradient(devices[second], 0.0, 1.0, point[0], point[1], point[2], g[1])
    u = g[0, 0] * x + g[0, 1] * y + g[0, 2] * z
    v = g[1, 0] * x + g[1, 1] * y + g[1, 2] * z
    length = np.sqrt(u * u + v * v)
    if epipolar:
        return u / length, v / length
    return v / length, -u / length


@kernel_part
def camera_weights(devices: Any, sizes: Any, point: Any, ray: Any, g: Any, weights: Any) -> float:
    """Fill weights with the share of each camera in the mean of all that see a point; return their sum before, 0 for
    none.
    """
    p = devices[len(devices) - 1]
    for k in range(3):
        # From the projector's centre, -Rᵀ t, to the point.
        ray[k] = point[k] + p[10 + k] * p[19] + p[13 + k] * p[20] + p[16 + k] * p[21]
    total = 0.0
    for index in range(len(weights)):
        weights[index] = squared_image_motion(devices[index], sizes[index], point[0], point[1], point[2], ray, g[0])
        total += weights[index]
    for index in range(len(weights)):
        weights[index] = weights[index] / total if total > 0 else 0.0
    return total


@dataclass(frozen=True, slots=True)
class CalibrationModes:
    """Independent modes of the error of a calibration.

    devices : (d, 22) float64, cameras of the scan in order, then the projector, if it is calibrated (`projector`);
    sizes_px : (d, 2) float64, width and height of each. modes : (15 d + 6, r) float64, change of every parameter by one
    standard deviation of each mode, then the rigid motion to remove: a translation, mm, and a rotation about
    `middle_mm`, (3,), rad. row : True if light is numbered by rows. second : camera that the first one is paired with
    if the projector is not calibrated.
    """

    devices: FloatArray
    sizes_px: FloatArray
    modes: FloatArray
    middle_mm: FloatArray
    row: bool
    second: int
    projector: bool


def calibration_modes(
    calibration: Calibration, names: Sequence[str], axis: Axis, /, *, second: int = 1
) -> CalibrationModes | None:
    """Modes of a calibration for a scan with the cameras `names`; None if it states no covariance.

    axis : axis of triangulation; second : index of the second camera, without a projector.

    Raises
    ------
    CalibrationError
        The devices see nothing of the volume that the calibration names.
    """
    solved = calibration.solved
    if solved is None:
        return None
    calibrated = list(calibration.cameras)
    order = [calibrated.index(name) for name in names]
    pinholes = [calibration.cameras[name] for name in names]
    if calibration.projector is not None:
        order.append(len(calibrated))
        pinholes.append(calibration.projector)
    parameters = np.concatenate([np.arange(_EACH * index, _EACH * (index + 1)) for index in order])
    changes = _covariance_modes(solved.covariance[np.ix_(parameters, parameters)])
    without_modes = CalibrationModes(
        devices=np.stack([pack_device(each) for each in pinholes]),
        sizes_px=np.array([[each.size.width_px, each.size.height_px] for each in pinholes], dtype=np.float64),
        modes=np.zeros((len(changes) + 6, 0)),
        middle_mm=solved.volume_mm.mean(axis=0),
        row=axis is Axis.ROW,
        second=second,
        projector=calibration.projector is not None,
    )
    places, moves = _sample_volume(without_modes, solved.volume_mm)
    rigid = np.zeros((len(places), 3, 6))
    rigid[:, :, :3] = np.eye(3)
    for k in range(3):
        rigid[:, :, 3 + k] = np.cross(np.eye(3)[k], places - without_modes.middle_mm)
    fields = (moves @ changes).reshape(3 * len(places), -1)
    motion = np.linalg.lstsq(rigid.reshape(-1, 6), fields, rcond=None)[0]
    fields = fields - rigid.reshape(-1, 6) @ motion
    # Principal components: the last ones have little of the variance and are dropped.
    components = np.linalg.svd(fields, full_matrices=False)[2].T
    variance = ((fields @ components) ** 2).reshape(len(places), 3, -1).sum(axis=1)
    remaining = np.cumsum(variance[:, ::-1], axis=1)[:, ::-1]
    # With several cameras the places show the motion of the mean of their points, but not of each or of a stripe.
    dropped = _MAX_DROPPED if len(names) == 1 else 0.0
    count = int((remaining > dropped * remaining[:, :1]).any(axis=0).sum())
    modes = np.concatenate([changes, -motion]) @ components[:, :count]
    return replace(without_modes, modes=np.ascontiguousarray(modes))


def calibration_sigma(
    modes: CalibrationModes,
    points_mm: FloatArray,
    normals: NDArray[np.float32],
    source: NDArray[np.uint8],
    camera: NDArray[np.int32],
    seen_by: NDArray[np.int64],
    tangents: FloatArray,
    /,
) -> FloatArray:
    """(n,) float64: standard deviation along the surface normal by the calibration, mm.

    points_mm : (n, 3); normals : (n, 3), unit; source : (n,) `Source`; camera : (n,), index of the camera of the point.
    seen_by : (n,), one bit for each camera that measured it, for points of several; without a projector, for the first
    camera and the one that it was paired with.
    tangents : (n, 3), direction of the stripe in space, needed for points of two cameras only; without it the stripe is
    assumed perpendicular to the epipolar line. Without a normal, the standard deviation along the viewing ray is
    returned, practically an upper bound.
    """
    sigma = np.zeros(len(points_mm))
    in_bands(
        _sigma_kernel, len(sigma), modes.devices, modes.sizes_px, modes.modes, modes.middle_mm, modes.row, modes.second,
        points_mm, normals, source, camera, seen_by, tangents, sigma,
    )  # fmt: skip
    return sigma


def stripe_tangents(points_mm: FloatArray, offsets: IntArray, bridge_after: NDArray[np.bool_], /) -> FloatArray:
    """(n, 3) float64: direction of each curve at its points, over two points either way; not a unit vector.

    NaN for a point that only bridges join to another one.
    """
    tangents = np.full((len(points_mm), 3), np.nan)
    in_bands(_tangent_kernel, len(offsets) - 1, points_mm, offsets, bridge_after, tangents)
    return tangents


def _covariance_modes(covariance: FloatArray) -> FloatArray:
    """(p, k): M with M Mᵀ = covariance, computed from correlations: focal lengths and angles differ by many orders."""
    deviation = np.sqrt(np.clip(np.diagonal(covariance), 0, None))
    scale = np.where(deviation > 0, deviation, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    positive = values > 0
    return np.asarray(deviation[:, None] * vectors[:, positive] * np.sqrt(values[positive]))


def _sample_volume(modes: CalibrationModes, volume_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Places (n, 3) in the volume that the devices see, and their motion by each parameter, (n, 3, 15 d)."""
    shares = (np.arange(_NODES) + 0.5) / _NODES
    axes = [low + shares * (high - low) for low, high in volume_mm.T]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    moves = np.zeros((len(places), 3, len(modes.modes) - 6))
    visible = np.zeros(len(places), dtype=np.bool_)
    _sample_kernel(modes.devices, modes.sizes_px, modes.row, modes.second, modes.projector, places, moves, visible)
    if np.count_nonzero(visible) < _MIN_NODES:
        low, high = (", ".join(f"{value:.0f}" for value in corner) for corner in volume_mm)
        message = (
            f"solved.volume_mm: expected a box that the devices see, found ({low}) to ({high}) mm, of which they see "
            "nothing; calibrate again, or leave `solved` out"
        )
        raise CalibrationError(message)
    return places[visible], moves[visible]


@kernel(in_every_scan=False)
def _sample_kernel(
    devices: Any, sizes: Any, row: bool, second: int, projector: bool, places: Any, moves: Any, visible: Any
) -> None:
    last = len(devices) - 1
    g = np.zeros((3, 3))
    ray = np.zeros(3)
    weights = np.zeros(last)
    axis = np.zeros(3)
    first_axis = np.zeros(3)
    first_axis[0] = 1.0
    no_tangent = np.full(3, np.nan)
    a, b = 0.0 if row else 1.0, 1.0 if row else 0.0
    for i in range(len(places)):
        point = places[i]
        if projector:
            lit = squared_image_motion(devices[last], sizes[last], point[0], point[1], point[2], first_axis, g[0]) > 0
            visible[i] = lit and camera_weights(devices, sizes, point, ray, g, weights) > 0
        else:
            visible[i] = squared_image_motion(devices[0], sizes[0], point[0], point[1], point[2], first_axis, g[0]) > 0
            visible[i] &= (
                squared_image_motion(devices[second], sizes[second], point[0], point[1], point[2], first_axis, g[0]) > 0
            )
            if visible[i]:
                a, b = stripe_normal(devices, second, point, no_tangent, g)
        if not visible[i]:
            continue
        for k in range(3):
            axis[:] = 0.0
            axis[k] = 1.0
            if not projector:
                visible[i] &= add_sensitivity(devices, 0, second, a, b, 1.0, point, axis, g, moves[i, k])
                continue
            for camera in range(last):
                if weights[camera] > 0:
                    visible[i] &= add_sensitivity(
                        devices, camera, last, a, b, weights[camera], point, axis, g, moves[i, k]
                    )


@kernel(in_every_scan=False)
def _sigma_kernel(
    begin: int, end: int, devices: Any, sizes: Any, modes: Any, middle: Any, row: bool, second: int,
    points: Any, normals: Any, source: Any, camera: Any, seen_by: Any, tangents: Any, sigma: Any,
) -> None:  # fmt: skip
    last = len(devices) - 1
    parameters = _EACH * len(devices)
    g = np.zeros((3, 3))
    ray = np.zeros(3)
    weights = np.zeros(last)
    normal = np.zeros(3)
    line = np.zeros(parameters + 6)
    total = np.zeros(modes.shape[1])
    for i in range(begin, end):
        point = points[i]
        d = devices[camera[i]]
        length = 0.0
        for k in range(3):
            normal[k] = normals[i, k]
            ray[k] = point[k] + d[10 + k] * d[19] + d[13 + k] * d[20] + d[16 + k] * d[21]
            length += ray[k] * ray[k]
        if not np.isfinite(normal[0] + normal[1] + normal[2]):
            for k in range(3):
                normal[k] = ray[k] / np.sqrt(length)
        line[:] = 0.0
        valid = True
        if source[i] == _CAMERA_CAMERA:
            partner = second
            for index in range(1, len(devices)):
                if (seen_by[i] >> index) & 1:
                    partner = index
            a, b = stripe_normal(devices, partner, point, tangents[i], g)
            valid = add_sensitivity(devices, 0, partner, a, b, 1.0, point, normal, g, line)
        else:
            a, b = 0.0 if row else 1.0, 1.0 if row else 0.0
            measured = 0.0
            if source[i] == _ALL and camera_weights(devices, sizes, point, ray, g, weights) > 0:
                for index in range(last):
                    # A camera may have the point in its image, and something before it.
                    weights[index] *= (seen_by[i] >> index) & 1
                    measured += weights[index]
            if measured > 0:
                for index in range(last):
                    if weights[index] > 0:
                        share = weights[index] / measured
                        valid &= add_sensitivity(devices, index, last, a, b, share, point, normal, g, line)
            else:
                valid = add_sensitivity(devices, camera[i], last, a, b, 1.0, point, normal, g, line)
        x, y, z = point[0] - middle[0], point[1] - middle[1], point[2] - middle[2]
        for k in range(3):
            line[parameters + k] = normal[k]
        line[parameters + 3] = y * normal[2] - z * normal[1]
        line[parameters + 4] = z * normal[0] - x * normal[2]
        line[parameters + 5] = x * normal[1] - y * normal[0]
        total[:] = 0.0
        for p in range(parameters + 6):
            if line[p] != 0:
                for k in range(len(total)):
                    total[k] += line[p] * modes[p, k]
        squares = 0.0
        for k in range(len(total)):
            squares += total[k] * total[k]
        sigma[i] = np.sqrt(squares) if valid else np.nan


@kernel(in_every_scan=False)
def _tangent_kernel(first: int, last: int, points: Any, offsets: Any, bridge: Any, tangents: Any) -> None:
    for curve in range(first, last):
        for i in range(offsets[curve], offsets[curve + 1]):
            before = after = i
            for _ in range(_REACH):
                if before > offsets[curve] and not bridge[before - 1]:
                    before -= 1
                if after + 1 < offsets[curve + 1] and not bridge[after]:
                    after += 1
            if after > before:
                for k in range(3):
                    tangents[i, k] = points[after, k] - points[before, k]


def sigma_along_normal(deviation_mm: FloatArray, normals: NDArray[np.float32]) -> FloatArray:
    """(n,) float64: standard deviation along the surface normal, mm.

    deviation_mm : (n, 3), displacement for one standard deviation; normals : (n, 3), unit. Without a normal the whole
    displacement is returned, an upper bound.
    """
    sigma = np.zeros(len(deviation_mm))
    in_bands(_along_normal, len(sigma), deviation_mm, normals, sigma)
    return sigma


def sampling_mm(
    points_mm: FloatArray, camera: Pinhole, projector: Pinhole | None, axis: Axis, step_px: float | FloatArray
) -> FloatArray:
    """(n,) float64: distance between samples of a surface that faces the rig, mm.

    The larger of a camera pixel at the depth of the point and, with a projector, of `step_px` of its columns, or rows
    for that axis; (n,) if it varies. Each is measured along that axis: mirror arrays may have twice the resolution in
    one.
    """
    k = 0 if axis is Axis.COLUMN else 1
    pixel = optical_depths_mm(camera, points_mm) / camera.matrix[k, k]
    if projector is None:
        return np.asarray(pixel * step_px)
    return np.asarray(np.maximum(pixel, step_px * optical_depths_mm(projector, points_mm) / projector.matrix[k, k]))


@kernel
def _along_normal(first: int, last: int, deviation: Any, normals: Any, sigma: Any) -> None:
    for point in range(first, last):
        x, y, z = deviation[point, 0], deviation[point, 1], deviation[point, 2]
        along = abs(x * normals[point, 0] + y * normals[point, 1] + z * normals[point, 2])
        sigma[point] = along if np.isfinite(along) else np.sqrt(x * x + y * y + z * z)

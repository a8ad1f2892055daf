"""How far the error of its calibration moves each point of a scan along the surface normal.

A point X is found from three equations h(X, θ) = m: its pixel in a camera, and the projector's column (or row), or the
second camera's stripe. With the measured m fixed, a change of the devices' parameters θ moves it by
dX = -(∂h/∂X)⁻¹ ∂h/∂θ dθ, and the surface along its normal n by -wᵀ ∂h/∂θ dθ with wᵀ = nᵀ (∂h/∂X)⁻¹.

The calibration's covariance C = M Mᵀ splits the error into independent modes, the columns of M. Motions of everything
together are no error of a measurement: of each mode, the rigid motion that is nearest to its displacements throughout
the calibrated volume is taken out. The modes are then turned into the principal components of what is left in that
volume, of which a few hold nearly all; the variance of a point is the sum of the squares of those.

In the mean of several cameras' points each has the share that its inverse variance gives it, equal noise in all cameras
assumed: the square of how far, in pixels, it sees the point move along the projector's ray.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.errors import CalibrationError
from slrig.kernels import in_bands, kernel
from slrig.model import DEVICE_PARAMETERS, Axis, Calibration, FloatArray, IntArray, Source
from slrig.reconstruction.optics import packed
from slrig.reconstruction.sensitivity import across, add_row, pixel_squares, shares_of_mean

_EACH = DEVICE_PARAMETERS
_NODES = 10  # along each side of the volume
_FEWEST_NODES = 8  # 24 displacements, to take a rigid motion of six numbers out of
_DROPPED = 0.002  # of the variance, at any place in the volume
_REACH = 2  # points either way, for the direction of a curve
_CAMERA_CAMERA, _ALL = int(Source.CAMERA_CAMERA), int(Source.ALL)


@dataclass(frozen=True, slots=True)
class CalibrationModes:
    """The independent ways in which a calibration may be wrong, ready for the points of a scan.

    devices : (d, 22) float64, the scan's cameras in order, then the projector, if it is calibrated (`projector`);
    sizes_px : (d, 2) float64, width and height of each. modes : (15 d + 6, r) float64, the change of every parameter by
    one standard deviation of each mode, then the rigid motion that is taken out: a translation, mm, and a turn about
    `middle_mm`, (3,), rad. row : whether light is numbered by rows. second : the camera that the first one is paired
    with where the projector is not calibrated.
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
    """The modes of a calibration for a scan with the cameras `names`; None if it states no covariance.

    axis : the axis that points are triangulated by; second : index of the second camera, without a projector.

    Raises
    ------
    CalibrationError
        The devices see nothing of the volume that the calibration names.
    """
    solved = calibration.solved
    if solved is None:
        return None
    known = list(calibration.cameras)
    order = [known.index(name) for name in names]
    pinholes = [calibration.cameras[name] for name in names]
    if calibration.projector is not None:
        order.append(len(known))
        pinholes.append(calibration.projector)
    taken = np.concatenate([np.arange(_EACH * index, _EACH * (index + 1)) for index in order])
    changes = _modes_of(solved.covariance[np.ix_(taken, taken)])
    bare = CalibrationModes(
        devices=np.stack([packed(each) for each in pinholes]),
        sizes_px=np.array([[each.size.width_px, each.size.height_px] for each in pinholes], dtype=np.float64),
        modes=np.zeros((len(changes) + 6, 0)),
        middle_mm=solved.volume_mm.mean(axis=0),
        row=axis is Axis.ROW,
        second=second,
        projector=calibration.projector is not None,
    )
    places, moves = _sampled(bare, solved.volume_mm)
    rigid = np.zeros((len(places), 3, 6))
    rigid[:, :, :3] = np.eye(3)
    for k in range(3):
        rigid[:, :, 3 + k] = np.cross(np.eye(3)[k], places - bare.middle_mm)
    fields = (moves @ changes).reshape(3 * len(places), -1)
    motion = np.linalg.lstsq(rigid.reshape(-1, 6), fields, rcond=None)[0]
    fields = fields - rigid.reshape(-1, 6) @ motion
    # Principal components: the last ones hold little of the variance, and those that matter nowhere go.
    turn = np.linalg.svd(fields, full_matrices=False)[2].T
    variance = ((fields @ turn) ** 2).reshape(len(places), 3, -1).sum(axis=1)
    left = np.cumsum(variance[:, ::-1], axis=1)[:, ::-1]
    # With several cameras the places tell how the mean of their points moves, and not how each one's or a stripe does.
    dropped = _DROPPED if len(names) == 1 else 0.0
    count = int((left > dropped * left[:, :1]).any(axis=0).sum())
    modes = np.concatenate([changes, -motion]) @ turn[:, :count]
    return CalibrationModes(
        bare.devices, bare.sizes_px, np.ascontiguousarray(modes), bare.middle_mm, bare.row, bare.second, bare.projector
    )


def calibration_sigma(
    modes: CalibrationModes,
    points_mm: FloatArray,
    normals: NDArray[np.float32],
    source: NDArray[np.uint8],
    camera: NDArray[np.int32],
    tangents: FloatArray,
    /,
) -> FloatArray:
    """(n,) float64: standard deviation along the surface normal that the calibration makes, mm.

    points_mm : (n, 3); normals : (n, 3), unit; source : (n,) `Source`; camera : (n,), index of the camera that has the
    point. tangents : (n, 3), the direction of the stripe in space, needed of points of two cameras only; without one
    the stripe is taken to run straight across the epipolar line. Where no triangle gives a normal, the standard
    deviation along the viewing ray stands, which is an upper bound but for a small part.
    """
    sigma = np.zeros(len(points_mm))
    in_bands(
        _sigma_kernel, len(sigma), modes.devices, modes.sizes_px, modes.modes, modes.middle_mm, modes.row, modes.second,
        points_mm, normals, source, camera, tangents, sigma,
    )  # fmt: skip
    return sigma


def stripe_tangents(points_mm: FloatArray, offsets: IntArray, bridge_after: NDArray[np.bool_], /) -> FloatArray:
    """(n, 3) float64: the direction of each curve at its points, over two points either way; not a unit vector.

    NaN for a point that no step but bridges joins to another one.
    """
    tangents = np.full((len(points_mm), 3), np.nan)
    in_bands(_tangent_kernel, len(offsets) - 1, points_mm, offsets, bridge_after, tangents)
    return tangents


def _modes_of(covariance: FloatArray) -> FloatArray:
    """(p, k): M with M Mᵀ = covariance, by way of correlations: focal lengths and angles differ by many orders."""
    deviation = np.sqrt(np.clip(np.diagonal(covariance), 0, None))
    scale = np.where(deviation > 0, deviation, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = values > 0
    return np.asarray(deviation[:, None] * vectors[:, kept] * np.sqrt(values[kept]))


def _sampled(modes: CalibrationModes, volume_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Places (n, 3) in the volume that the devices see, and by how much each parameter moves them, (n, 3, 15 d)."""
    shares = (np.arange(_NODES) + 0.5) / _NODES
    axes = [low + shares * (high - low) for low, high in volume_mm.T]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    moves = np.zeros((len(places), 3, len(modes.modes) - 6))
    seen = np.zeros(len(places), dtype=np.bool_)
    _sample_kernel(modes.devices, modes.sizes_px, modes.row, modes.second, modes.projector, places, moves, seen)
    if np.count_nonzero(seen) < _FEWEST_NODES:
        low, high = (", ".join(f"{value:.0f}" for value in corner) for corner in volume_mm)
        message = (
            f"solved.volume_mm: expected a box that the devices see, found ({low}) to ({high}) mm, of which they see "
            "nothing; calibrate again, or leave `solved` out"
        )
        raise CalibrationError(message)
    return places[seen], moves[seen]


@kernel(in_every_scan=False)
def _sample_kernel(
    devices: Any, sizes: Any, row: bool, second: int, projector: bool, places: Any, moves: Any, seen: Any
) -> None:
    last = len(devices) - 1
    g = np.zeros((3, 3))
    ray = np.zeros(3)
    shares = np.zeros(last)
    axis = np.zeros(3)
    one = np.zeros(3)
    one[0] = 1.0
    none = np.full(3, np.nan)
    a, b = 0.0 if row else 1.0, 1.0 if row else 0.0
    for i in range(len(places)):
        point = places[i]
        if projector:
            lit = pixel_squares(devices[last], sizes[last], point[0], point[1], point[2], one, g[0]) > 0
            seen[i] = lit and shares_of_mean(devices, sizes, point, ray, g, shares) > 0
        else:
            seen[i] = pixel_squares(devices[0], sizes[0], point[0], point[1], point[2], one, g[0]) > 0
            seen[i] &= pixel_squares(devices[second], sizes[second], point[0], point[1], point[2], one, g[0]) > 0
            if seen[i]:
                a, b = across(devices, second, point, none, g)
        if not seen[i]:
            continue
        for k in range(3):
            axis[:] = 0.0
            axis[k] = 1.0
            if not projector:
                seen[i] &= add_row(devices, 0, second, a, b, 1.0, point, axis, g, moves[i, k])
                continue
            for camera in range(last):
                if shares[camera] > 0:
                    seen[i] &= add_row(devices, camera, last, a, b, shares[camera], point, axis, g, moves[i, k])


@kernel(in_every_scan=False)
def _sigma_kernel(
    begin: int, end: int, devices: Any, sizes: Any, modes: Any, middle: Any, row: bool, second: int,
    points: Any, normals: Any, source: Any, camera: Any, tangents: Any, sigma: Any,
) -> None:  # fmt: skip
    last = len(devices) - 1
    parameters = _EACH * len(devices)
    g = np.zeros((3, 3))
    ray = np.zeros(3)
    shares = np.zeros(last)
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
        good = True
        if source[i] == _CAMERA_CAMERA:
            a, b = across(devices, second, point, tangents[i], g)
            good = add_row(devices, 0, second, a, b, 1.0, point, normal, g, line)
        else:
            a, b = 0.0 if row else 1.0, 1.0 if row else 0.0
            if source[i] == _ALL and shares_of_mean(devices, sizes, point, ray, g, shares) > 0:
                for index in range(last):
                    if shares[index] > 0:
                        good &= add_row(devices, index, last, a, b, shares[index], point, normal, g, line)
            else:
                good = add_row(devices, camera[i], last, a, b, 1.0, point, normal, g, line)
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
        sigma[i] = np.sqrt(squares) if good else np.nan


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

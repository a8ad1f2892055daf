"""Factory calibration of an OAK device, converted to millimetres and five Brown coefficients.

The device stores a lens as up to fourteen coefficients (rational, thin prism, tilt) or as a fisheye's four. If more
than Brown's five (k1, k2, p1, p2, k3) are used, focal lengths, centre and those five are fitted to the stored model
over the whole image. A lens that they cannot follow to a tenth of a pixel everywhere is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from drivers.depthai.device import open_device
from drivers.depthai.library import load_depthai
from slrig.errors import CalibrationError
from slrig.model import Calibration, FloatArray, Pinhole, Size

MAX_RESIDUAL_PX = 0.1

_BROWN = 5
_GRID = 25
_MOST_STEPS = 50
_STEP_PX = 1e-6
_INVERSE_STEPS = 200
_FIT_STEPS = 30


@dataclass(frozen=True, slots=True)
class Lens:
    """One camera of a device in a rig. size : of its frames; the sensor's size if None."""

    socket: str
    size: Size | None = None


@dataclass(frozen=True, slots=True)
class FactoryCalibration:
    """Factory calibration of a device. The world is the first camera's frame.

    residual_px : by camera, the largest distance over the image between the stored lens model and the converted one.
    lens_position : by camera, the focus at calibration; None for a fixed lens.
    """

    calibration: Calibration
    residual_px: Mapping[str, float]
    lens_position: Mapping[str, int | None]


def read_calibration(device: str, cameras: Mapping[str, Lens] | None = None) -> Calibration:
    """Return the factory calibration of a device's cameras; see `read_factory_calibration`."""
    return read_factory_calibration(device, cameras).calibration


def read_factory_calibration(device: str, cameras: Mapping[str, Lens] | None = None) -> FactoryCalibration:
    """Read the factory calibration of a device, opening it unless this process has it open.

    Parameters
    ----------
    device
        Its id, as in a rig file.
    cameras
        Socket and frame size by name in the rig. If None, every camera of the device under its socket's name.

    Raises
    ------
    CalibrationError
        One of the cameras has no calibration, or its lens cannot be converted to five coefficients.
    LibraryMissingError, DeviceBusyError, DeviceGoneError, DeviceError
        See `drivers.depthai.device.open_device`.
    """
    vendor = load_depthai()
    oak = open_device(device)
    try:
        handler = oak.factory_calibration()
        wanted = cameras or {
            socket: Lens(socket)
            for socket in oak.sensors
            if handler.hasCameraCalibration(getattr(vendor.CameraBoardSocket, socket))
        }
        sized = {
            name: (
                lens.socket,
                lens.size or (oak.sensors[lens.socket].size if lens.socket in oak.sensors else None),
            )
            for name, lens in wanted.items()
        }
        focusing = {socket for socket, sensor in oak.sensors.items() if sensor.autofocus}
        return convert_calibration(handler, sized, focusing, vendor)
    finally:
        oak.close_unless_used()


def convert_calibration(
    handler: Any, cameras: Mapping[str, tuple[str, Size | None]], focusing: set[str], vendor: Any
) -> FactoryCalibration:
    """Convert the library's calibration, a `CalibrationHandler`.

    cameras : by name, socket and size of the frames (None: of the calibration). focusing : sockets of cameras with
    autofocus. vendor : the library. Raises CalibrationError, see `read_factory_calibration`.
    """
    if not cameras:
        message = "the device stores no calibration of any of its cameras; calibrate the rig with a board"
        raise CalibrationError(message)
    sockets = {name: getattr(vendor.CameraBoardSocket, socket) for name, (socket, _) in cameras.items()}
    missing = [name for name, socket in sockets.items() if not handler.hasCameraCalibration(socket)]
    if missing:
        message = f"the device stores no calibration of {', '.join(missing)}; calibrate the rig with a board"
        raise CalibrationError(message)
    first = next(iter(sockets.values()))
    pinholes, residual_px = {}, {}
    for name, (_, requested) in cameras.items():
        socket = sockets[name]
        _, width_px, height_px = handler.getDefaultIntrinsics(socket)
        size = requested or Size(width_px, height_px)
        matrix = np.array(handler.getCameraIntrinsics(socket, size.width_px, size.height_px), dtype=np.float64)
        stored = np.array(handler.getDistortionCoefficients(socket), dtype=np.float64)
        fisheye = handler.getDistortionModel(socket) == vendor.CameraModel.Fisheye
        if not fisheye and handler.getDistortionModel(socket) != vendor.CameraModel.Perspective:
            message = (
                f"camera '{name}': its lens is stored as {handler.getDistortionModel(socket).name}, which cannot be "
                "read; calibrate the rig with a board"
            )
            raise CalibrationError(message)
        matrix, distortion, residual_px[name] = fit_brown_lens(matrix, stored, size, fisheye=fisheye)
        if residual_px[name] > MAX_RESIDUAL_PX:
            message = (
                f"camera '{name}': its lens is stored with {len(stored)} distortion coefficients, which five follow to "
                f"{residual_px[name]:.2f} px only; {MAX_RESIDUAL_PX} px are allowed. Calibrate the rig with a board"
            )
            raise CalibrationError(message)
        pose = np.eye(4)
        if socket != first:
            # The default unit is centimetres.
            pose = np.array(handler.getCameraExtrinsics(first, socket, False, vendor.LengthUnit.MILLIMETER))
        pinholes[name] = Pinhole(
            size=size,
            matrix=matrix,
            distortion=distortion,
            rotation=np.asarray(pose[:3, :3], dtype=np.float64),
            translation_mm=np.asarray(pose[:3, 3], dtype=np.float64),
        )
    return FactoryCalibration(
        calibration=Calibration(pinholes, None),
        residual_px=residual_px,
        lens_position={
            name: handler.getLensPosition(sockets[name]) if socket in focusing else None
            for name, (socket, _) in cameras.items()
        },
    )


def fit_brown_lens(
    matrix: FloatArray, stored: FloatArray, size: Size, *, fisheye: bool = False
) -> tuple[FloatArray, FloatArray, float]:
    """Convert a lens to five coefficients.

    Parameters
    ----------
    matrix
        (3, 3) float64, px.
    stored
        (n,) float64: OpenCV's k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 τx τy as far as given, or a fisheye's four.
    size
        Of the image.
    fisheye
        True for a fisheye model.

    Returns
    -------
    matrix : (3, 3) float64; distortion : (5,) float64; residual_px : the largest distance between both models over a
    grid on the image, infinite if the stored model cannot be inverted.
    """
    if not fisheye and not np.any(stored[_BROWN:]):
        return matrix, np.pad(stored[:_BROWN], (0, _BROWN - len(stored[:_BROWN]))), 0.0
    columns, rows = np.meshgrid(np.linspace(0, size.width_px - 1, _GRID), np.linspace(0, size.height_px - 1, _GRID))
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    rays = _rays(pixels, matrix, stored, fisheye=fisheye)
    if rays is None:
        return matrix, np.zeros(_BROWN), float("inf")
    fitted, distortion = _fit_lens(rays, pixels, matrix)
    off_px = np.linalg.norm(_project(rays, fitted, distortion) - pixels, axis=1)
    worst_px = float(off_px.max())
    return fitted, distortion, worst_px if np.isfinite(worst_px) else float("inf")


def _rays(pixels: FloatArray, matrix: FloatArray, stored: FloatArray, *, fisheye: bool) -> FloatArray | None:
    """Rays (x/z, y/z) of the pixels by the stored model, (n, 2) float64; None if it cannot be inverted."""
    end = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _INVERSE_STEPS, 1e-12)
    given = pixels.reshape(-1, 1, 2)
    if fisheye:
        rays = cv2.fisheye.undistortPoints(given, matrix, stored[:4], criteria=end).reshape(-1, 2)
        again = cv2.fisheye.distortPoints(rays.reshape(-1, 1, 2), matrix, stored[:4]).reshape(-1, 2)
    else:
        rays = cv2.undistortPoints(given, matrix, stored, criteria=end).reshape(-1, 2)
        again = _project(rays, matrix, stored)
    off_px = np.linalg.norm(again - pixels, axis=1)
    return rays if np.isfinite(rays).all() and float(off_px.max()) < MAX_RESIDUAL_PX / 100 else None


def _fit_lens(rays: FloatArray, pixels: FloatArray, matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fit fx, fy, cx, cy, k1, k2, p1, p2, k3 by Gauss-Newton, with OpenCV's derivatives."""
    matrix, distortion = matrix.copy(), np.zeros(_BROWN)
    points = np.column_stack([rays, np.ones(len(rays))])
    for _ in range(_FIT_STEPS):
        projected, jacobian = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)
        # Columns: rotation 3, translation 3, focal lengths 2, centre 2, distortion.
        step = np.linalg.lstsq(jacobian[:, 6 : 10 + _BROWN], (pixels - projected.reshape(-1, 2)).ravel(), rcond=None)[0]
        matrix[0, 0], matrix[1, 1] = matrix[0, 0] + step[0], matrix[1, 1] + step[1]
        matrix[0, 2], matrix[1, 2] = matrix[0, 2] + step[2], matrix[1, 2] + step[3]
        distortion = distortion + step[4:]
        if not np.isfinite(step).all() or float(np.abs(step).max()) < _STEP_PX:
            break
    return matrix, distortion


def _project(rays: FloatArray, matrix: FloatArray, distortion: FloatArray) -> FloatArray:
    points = np.column_stack([rays, np.ones(len(rays))])
    projected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)
    return np.asarray(projected, dtype=np.float64).reshape(-1, 2)

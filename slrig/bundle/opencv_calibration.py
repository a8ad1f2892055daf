"""Calibrations as OpenCV FileStorage (YAML or XML), to exchange with other programs.

One file, one map per device, named as the camera or `projector`; the keys inside are those of OpenCV's own calibration
samples, with the pose beside them:

    left:
       image_width: 1280
       image_height: 1024
       camera_matrix: !!opencv-matrix ...            3 x 3, pixels
       distortion_coefficients: !!opencv-matrix ...  k1, k2, p1, p2 and, where there is one, k3
       rotation: !!opencv-matrix ...                 3 x 3, world to device
       translation_mm: !!opencv-matrix ...           3, world to device
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NoReturn

import cv2
import numpy as np

from slrig.bundle.faults import read_text
from slrig.bundle.storage import write_file
from slrig.errors import CalibrationError
from slrig.model import Calibration, FloatArray, Pinhole, Size

MOST_FILE_BYTES = 4 * 2**20
PROJECTOR = "projector"
NODE_NAME = re.compile(r"^[A-Za-z_][A-Za-z0-9_-]*$")
DEVICE_KEYS = (
    "image_width",
    "image_height",
    "camera_matrix",
    "distortion_coefficients",
    "rotation",
    "translation_mm",
)


def read_opencv_calibration(path: Path) -> Calibration:
    """Return the calibration in an OpenCV FileStorage file; the map `projector` is the projector, others are cameras.

    Raises
    ------
    CalibrationError
        The file is missing, cut, has an unknown key, a number that is not finite, or distortion terms beyond k3.
    """
    text = read_text(path, MOST_FILE_BYTES, CalibrationError)
    try:
        storage = cv2.FileStorage(text, cv2.FileStorage_READ | cv2.FileStorage_MEMORY)
    except (cv2.error, SystemError) as cause:
        message = f"{path}: expected OpenCV FileStorage (YAML or XML), found text it cannot parse; export it again"
        raise CalibrationError(message) from cause
    try:
        root = storage.root()
        names = list(root.keys()) if root.isMap() else []
        devices = {name: _read_device(root.getNode(name), path, name) for name in names}
    finally:
        storage.release()
    cameras = {name: device for name, device in devices.items() if name != PROJECTOR}
    if not cameras:
        _refuse(path, "one map per device", f"{', '.join(names) or 'nothing'}", "name each camera and its six keys")
    return Calibration(cameras, devices.get(PROJECTOR))


def write_opencv_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration as OpenCV FileStorage, whole or not at all; the name ends in yml, yaml or xml.

    Raises
    ------
    CalibrationError
        The ending is another one, or a camera has a name that FileStorage or this layout cannot hold.
    StorageError
        The disk refused.
    """
    ending = path.suffix.lower()
    if ending not in {".yml", ".yaml", ".xml"}:
        _refuse(path, "a name that ends in .yml, .yaml or .xml", f"'{path.name}'", "choose one of these endings")
    for name in calibration.cameras:
        if name == PROJECTOR or not NODE_NAME.match(name):
            _refuse(
                path,
                "camera names that begin with a letter and are not 'projector'",
                f"'{name}'",
                "rename the camera or keep the calibration as JSON",
            )
    storage = cv2.FileStorage(ending, cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    for name, pinhole in calibration.cameras.items():
        _write_device(storage, name, pinhole)
    if calibration.projector is not None:
        _write_device(storage, PROJECTOR, calibration.projector)
    text: str = storage.releaseAndGetString()
    write_file(path, text.encode())


def _refuse(path: Path, expected: str, found: str, remedy: str) -> NoReturn:
    message = f"{path}: expected {expected}, found {found}; {remedy}"
    raise CalibrationError(message)


def _read_device(node: Any, path: Path, name: str) -> Pinhole:
    keys = set(node.keys()) if node.isMap() else set()
    if keys != set(DEVICE_KEYS):
        wrong = [f"no {key}" for key in DEVICE_KEYS if key not in keys]
        wrong += [f"the unknown key {key}" for key in sorted(keys - set(DEVICE_KEYS))]
        _refuse(path, f"{', '.join(DEVICE_KEYS)} in '{name}'", ", ".join(wrong), "write one map per device")
    extent = [node.getNode(key) for key in ("image_width", "image_height")]
    if not all(part.isInt() and part.real() >= 1 for part in extent):
        _refuse(path, f"whole numbers as extent of '{name}'", "something else", "correct image_width and image_height")
    distortion = _matrix(node, "distortion_coefficients", path, name).ravel()
    if distortion.size < 4 or distortion[5:].any():
        _refuse(
            path,
            f"k1, k2, p1, p2 and at most k3 as distortion of '{name}'",
            f"{distortion.tolist()}",
            "calibrate without the rational, thin prism and tilt models",
        )
    five = np.zeros(5)
    five[: min(distortion.size, 5)] = distortion[:5]
    try:
        return Pinhole(
            Size(*(int(part.real()) for part in extent)),
            _matrix(node, "camera_matrix", path, name),
            five,
            _matrix(node, "rotation", path, name),
            _matrix(node, "translation_mm", path, name).ravel(),
        )
    except CalibrationError as cause:
        message = f"{path}: {name}.{cause}"
        raise CalibrationError(message) from cause


def _matrix(node: Any, key: str, path: Path, name: str) -> FloatArray:
    try:
        found = node.getNode(key).mat()
    except cv2.error as cause:
        message = f"{path}: {name}.{key}: expected an !!opencv-matrix, found something else; export it again"
        raise CalibrationError(message) from cause
    if found is None:
        _refuse(path, f"an !!opencv-matrix at {name}.{key}", "something else", "export it again")
    return np.asarray(found, dtype=np.float64)


def _write_device(storage: Any, name: str, pinhole: Pinhole) -> None:
    storage.startWriteStruct(name, cv2.FileNode_MAP)
    storage.write("image_width", pinhole.size.width_px)
    storage.write("image_height", pinhole.size.height_px)
    storage.write("camera_matrix", pinhole.matrix)
    storage.write("distortion_coefficients", pinhole.distortion)
    storage.write("rotation", pinhole.rotation)
    storage.write("translation_mm", pinhole.translation_mm)
    storage.endWriteStruct()

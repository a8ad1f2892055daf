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

A calibration that states its own error has one more map, `solved`, which other programs pass over:

    solved:
       id: "..."
       solved_at: "..."                              ISO 8601 with the offset from UTC
       covariance: !!opencv-matrix ...               15 d x 15 d, see `slrig.model.Solved`
       volume_mm: !!opencv-matrix ...                2 x 3
       expected_error_mm: 0.0071

Its devices are numbered in the order of their maps, the projector last.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

import cv2
import numpy as np

from slrig.bundle.faults import read_text
from slrig.bundle.storage import write_file
from slrig.errors import CalibrationError
from slrig.model import Calibration, FloatArray, Pinhole, Size, Solved

MOST_FILE_BYTES = 4 * 2**20
PROJECTOR = "projector"
SOLVED = "solved"
NODE_NAME = re.compile(r"^[A-Za-z_][A-Za-z0-9_-]*$")
DEVICE_KEYS = (
    "image_width",
    "image_height",
    "camera_matrix",
    "distortion_coefficients",
    "rotation",
    "translation_mm",
)
SOLVED_KEYS = ("id", "solved_at", "covariance", "volume_mm", "expected_error_mm")


def read_opencv_calibration(path: Path) -> Calibration:
    """Return the calibration in an OpenCV FileStorage file.

    The map `projector` is the projector, `solved` what the calibration says of its own error, others are cameras.
    Raises CalibrationError: the file is missing, cut, has an unknown key, a number that is not finite, or distortion
    terms beyond k3.
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
        devices = {name: _read_device(root.getNode(name), path, name) for name in names if name != SOLVED}
        solved = _read_solved(root.getNode(SOLVED), path) if SOLVED in names else None
    finally:
        storage.release()
    cameras = {name: device for name, device in devices.items() if name != PROJECTOR}
    if not cameras:
        _refuse(path, "one map per device", f"{', '.join(names) or 'nothing'}", "name each camera and its six keys")
    try:
        return Calibration(cameras, devices.get(PROJECTOR), solved)
    except CalibrationError as cause:
        raise CalibrationError(f"{path}: {SOLVED}.{cause}") from cause


def write_opencv_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration as OpenCV FileStorage, whole or not at all; the name ends in yml, yaml or xml.
    Raises CalibrationError: the ending is another one, or a camera has a name that FileStorage or this layout cannot
    hold; StorageError: the disk refused.
    """
    ending = path.suffix.lower()
    if ending not in {".yml", ".yaml", ".xml"}:
        _refuse(path, "a name that ends in .yml, .yaml or .xml", f"'{path.name}'", "choose one of these endings")
    for name in calibration.cameras:
        if name in {PROJECTOR, SOLVED} or not NODE_NAME.match(name):
            _refuse(
                path,
                "camera names that begin with a letter and are not 'projector' or 'solved'",
                f"'{name}'",
                "rename the camera or keep the calibration as JSON",
            )
    storage = cv2.FileStorage(ending, cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    for name, pinhole in calibration.cameras.items():
        _write_device(storage, name, pinhole)
    if calibration.projector is not None:
        _write_device(storage, PROJECTOR, calibration.projector)
    if calibration.solved is not None:
        _write_map(storage, SOLVED, {key: getattr(calibration.solved, key) for key in SOLVED_KEYS})
    text: str = storage.releaseAndGetString()
    write_file(path, text.encode())


def _refuse(path: Path, expected: str, found: str, remedy: str) -> NoReturn:
    raise CalibrationError(f"{path}: expected {expected}, found {found}; {remedy}")


def _require_keys(node: Any, wanted: tuple[str, ...], path: Path, name: str, remedy: str) -> None:
    keys = set(node.keys()) if node.isMap() else set()
    if keys != set(wanted):
        wrong = [f"no {key}" for key in wanted if key not in keys]
        wrong += [f"the unknown key {key}" for key in sorted(keys - set(wanted))]
        _refuse(path, f"{', '.join(wanted)} in '{name}'", ", ".join(wrong), remedy)


def _read_device(node: Any, path: Path, name: str) -> Pinhole:
    _require_keys(node, DEVICE_KEYS, path, name, "write one map per device")
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
        raise CalibrationError(f"{path}: {name}.{cause}") from cause


def _read_solved(node: Any, path: Path) -> Solved:
    _require_keys(node, SOLVED_KEYS, path, SOLVED, "leave the whole map out")
    words = [node.getNode(key) for key in ("id", "solved_at")]
    number = node.getNode("expected_error_mm")
    if not all(each.isString() and each.string() for each in words) or not (number.isReal() or number.isInt()):
        _refuse(path, f"text as id and solved_at of '{SOLVED}' and a number as expected_error_mm", "something else",
                "export it again, or leave the whole map out")  # fmt: skip
    error_mm = number.real()
    if not 0 <= error_mm < np.inf:
        _refuse(path, f"{SOLVED}.expected_error_mm of 0 or more", f"{error_mm}", "export it again")
    covariance = _matrix(node, "covariance", path, SOLVED)
    volume_mm = _matrix(node, "volume_mm", path, SOLVED)
    try:
        return Solved(words[0].string(), words[1].string(), covariance, volume_mm, error_mm)
    except (CalibrationError, ValueError) as cause:
        raise CalibrationError(f"{path}: {SOLVED}.{cause}") from cause


def _matrix(node: Any, key: str, path: Path, name: str) -> FloatArray:
    try:
        found = node.getNode(key).mat()
    except cv2.error as cause:
        message = f"{path}: {name}.{key}: expected an !!opencv-matrix, found something else; export it again"
        raise CalibrationError(message) from cause
    if found is None:
        _refuse(path, f"an !!opencv-matrix at {name}.{key}", "something else", "export it again")
    return np.asarray(found, dtype=np.float64)


def _write_device(storage: Any, name: str, device: Pinhole) -> None:
    extent = (device.size.width_px, device.size.height_px)
    numbers = (*extent, device.matrix, device.distortion, device.rotation, device.translation_mm)
    _write_map(storage, name, dict(zip(DEVICE_KEYS, numbers, strict=True)))


def _write_map(storage: Any, name: str, values: Mapping[str, Any]) -> None:
    storage.startWriteStruct(name, cv2.FileNode_MAP)
    for key, value in values.items():
        storage.write(key, value)
    storage.endWriteStruct()

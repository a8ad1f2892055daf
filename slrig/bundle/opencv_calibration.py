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
from datetime import datetime
from pathlib import Path
from typing import Any, NoReturn, TypeGuard

import cv2
import numpy as np

from slrig.bundle.description import CAMERA_NAME, MOST_SIDE_PX, PROJECTOR
from slrig.bundle.faults import MOST_FAULTS, read_text, shorten
from slrig.bundle.file_storage import Value, read_file_storage
from slrig.bundle.storage import write_file
from slrig.errors import CalibrationError
from slrig.model import Calibration, FloatArray, Pinhole, Size, Solved

MOST_FILE_BYTES = 4 * 2**20
SOLVED = "solved"
MOST_ID_LENGTH = 64
NODE_NAME = re.compile(r"^[A-Za-z_][A-Za-z0-9_-]*$")
DEVICE_KEYS = (
    "image_width",
    "image_height",
    "camera_matrix",
    "distortion_coefficients",
    "rotation",
    "translation_mm",
)
SOLVED_KEYS = ("id", "solved_at", "covariance", "volume_mm", "expected_error_mm", "scale_sigma")


def read_opencv_calibration(path: Path) -> Calibration:
    """Return the calibration in an OpenCV FileStorage file.

    The map `projector` is the projector, `solved` what the calibration says of its own error, others are cameras.
    Raises CalibrationError: the file is missing, cut, has an unknown key, a number that is not finite, or distortion
    terms beyond k3.
    """
    root = read_file_storage(read_text(path, MOST_FILE_BYTES, CalibrationError), path)
    devices = {name: _read_device(found, path, name) for name, found in root.items() if name != SOLVED}
    solved = _read_solved(root[SOLVED], path) if SOLVED in root else None
    cameras = {name: device for name, device in devices.items() if name != PROJECTOR}
    if not cameras:
        _refuse(path, "one map per device", f"{', '.join(root) or 'nothing'}", "name each camera and its six keys")
    for name in cameras:
        if not re.match(CAMERA_NAME, name):
            _refuse(path, "camera names that begin with a letter or digit", f"'{name}'", "rename the camera")
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


def _require_keys(found: Value, wanted: tuple[str, ...], path: Path, name: str, remedy: str) -> dict[str, Value]:
    entries = found if isinstance(found, dict) else {}
    if set(entries) != set(wanted):
        wrong = [f"no {key}" for key in wanted if key not in entries]
        wrong += [f"the unknown key {key}" for key in sorted(set(entries) - set(wanted))]
        _refuse(path, f"{', '.join(wanted)} in '{name}'", ", ".join(wrong[:MOST_FAULTS]), remedy)
    return entries


def _read_device(found: Value, path: Path, name: str) -> Pinhole:
    entries = _require_keys(found, DEVICE_KEYS, path, name, "write one map per device")
    width_px, height_px = entries["image_width"], entries["image_height"]
    if not _is_side(width_px) or not _is_side(height_px):
        _refuse(path, f"whole numbers as extent of '{name}', from 1 to {MOST_SIDE_PX}", "something else",
                "correct image_width and image_height")  # fmt: skip
    five = five_terms(_matrix(entries, "distortion_coefficients", path, name), path, name)
    try:
        return Pinhole(
            Size(width_px, height_px),
            _matrix(entries, "camera_matrix", path, name),
            five,
            _matrix(entries, "rotation", path, name),
            _matrix(entries, "translation_mm", path, name).ravel(),
        )
    except CalibrationError as cause:
        raise CalibrationError(f"{path}: {name}.{cause}") from cause


def five_terms(distortion: FloatArray, path: Path, name: str) -> FloatArray:
    """(5,) float64: k1, k2, p1, p2 and k3 of OpenCV's coefficients, 4 or more.
    Raises CalibrationError: there are fewer, or one beyond k3 is not 0.
    """
    found = distortion.ravel()
    if found.size < 4 or found[5:].any():
        _refuse(
            path,
            f"k1, k2, p1, p2 and at most k3 as distortion of '{name}'",
            shorten(found[:14].tolist()),
            "calibrate without the rational, thin prism and tilt models",
        )
    five = np.zeros(5)
    five[: min(found.size, 5)] = found[:5]
    return five


def _is_side(value: Value) -> TypeGuard[int]:
    return isinstance(value, int) and 1 <= value <= MOST_SIDE_PX


def _read_solved(found: Value, path: Path) -> Solved:
    entries = _require_keys(found, SOLVED_KEYS, path, SOLVED, "leave the whole map out")
    name, solved_at = entries["id"], entries["solved_at"]
    error_mm, scale_sigma = entries["expected_error_mm"], entries["scale_sigma"]
    if not isinstance(name, str) or not isinstance(solved_at, str):
        _refuse(path, f"text as id and solved_at of '{SOLVED}'", "something else",
                "export it again, or leave the whole map out")  # fmt: skip
    if not isinstance(error_mm, int | float) or not isinstance(scale_sigma, int | float):
        _refuse(path, f"numbers as expected_error_mm and scale_sigma of '{SOLVED}'", "something else",
                "export it again, or leave the whole map out")  # fmt: skip
    if not 1 <= len(name) <= MOST_ID_LENGTH:
        _refuse(path, f"a text of 1 to {MOST_ID_LENGTH} characters as {SOLVED}.id", shorten(name), "export it again")
    if not _is_moment(solved_at):
        _refuse(path, f"ISO 8601 with the offset from UTC as {SOLVED}.solved_at", shorten(solved_at), "correct it")
    if not 0 <= error_mm < np.inf:
        _refuse(path, f"{SOLVED}.expected_error_mm of 0 or more", f"{error_mm}", "export it again")
    if not 0 <= scale_sigma <= 1:
        _refuse(path, f"{SOLVED}.scale_sigma from 0 to 1", f"{scale_sigma}", "export it again")
    covariance = _matrix(entries, "covariance", path, SOLVED)
    volume_mm = _matrix(entries, "volume_mm", path, SOLVED)
    if not np.isfinite(volume_mm).all():
        _refuse(path, f"finite numbers in {SOLVED}.volume_mm", "others", "export it again")
    try:
        return Solved(name, solved_at, covariance, volume_mm, float(error_mm), float(scale_sigma))
    except (CalibrationError, ValueError) as cause:
        raise CalibrationError(f"{path}: {SOLVED}.{cause}") from cause


def _is_moment(text: str) -> bool:
    try:
        return datetime.fromisoformat(text).tzinfo is not None
    except ValueError:
        return False


def _matrix(entries: dict[str, Value], key: str, path: Path, name: str) -> FloatArray:
    found = entries[key]
    if not isinstance(found, np.ndarray):
        _refuse(path, f"an !!opencv-matrix at {name}.{key}", "something else", "export it again")
    return found


def _write_device(storage: Any, name: str, device: Pinhole) -> None:
    extent = (device.size.width_px, device.size.height_px)
    numbers = (*extent, device.matrix, device.distortion, device.rotation, device.translation_mm)
    _write_map(storage, name, dict(zip(DEVICE_KEYS, numbers, strict=True)))


def _write_map(storage: Any, name: str, values: Mapping[str, Any]) -> None:
    storage.startWriteStruct(name, cv2.FileNode_MAP)
    for key, value in values.items():
        # OpenCV 5 writes an array of one dimension as an opencv-nd-matrix, which few programs read.
        storage.write(key, value[:, None] if isinstance(value, np.ndarray) and value.ndim == 1 else value)
    storage.endWriteStruct()

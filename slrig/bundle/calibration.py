"""Calibration files: slrig's calibration.json, and the same as OpenCV's FileStorage (YAML, XML)."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, TypeGuard

import cv2
import numpy as np
from pydantic import Field

from slrig.bundle.description import CAMERA_NAME, MAX_SIDE_PX, PROJECTOR, CameraName, Extent
from slrig.bundle.file_storage import MAX_STORAGE_BYTES, Value, read_file_storage
from slrig.bundle.storage import json_bytes, write_file
from slrig.bundle.validation import MAX_FAULTS, AwareMoment, Strict, read_json_model, read_text, shorten
from slrig.errors import CalibrationError
from slrig.model import (
    DEVICE_PARAMETERS,
    Calibration,
    FloatArray,
    LightMap,
    Pinhole,
    Size,
    SolveRecord,
    require_plausible,
)

SOLVED = "solved"
MAX_ID_LENGTH = 64
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

MAX_CALIBRATION_BYTES = 4 * 2**20
MAX_DEVICES = 16


def read_opencv_calibration(path: Path) -> Calibration:
    """Return the calibration in an OpenCV FileStorage file.

    The map `projector` is the projector, `solved` the calibration's statement of its error, all others are cameras.
    Raises CalibrationError: the file is missing, cut, has an unknown key, a number that is not finite, or distortion
    terms beyond k3.
    """
    root = read_file_storage(read_text(path, MAX_STORAGE_BYTES, CalibrationError), path)
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
    """Write a calibration as OpenCV FileStorage, completely or not at all; the name ends in yml, yaml or xml.
    Raises CalibrationError: the ending is another one, or FileStorage or this layout cannot hold the name of a camera;
    StorageError: the disk refused.
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


def _require_keys(value: Value, keys: tuple[str, ...], path: Path, name: str, remedy: str) -> dict[str, Value]:
    entries = value if isinstance(value, dict) else {}
    if set(entries) != set(keys):
        wrong = [f"no {key}" for key in keys if key not in entries]
        wrong += [f"the unknown key {key}" for key in sorted(set(entries) - set(keys))]
        _refuse(path, f"{', '.join(keys)} in '{name}'", ", ".join(wrong[:MAX_FAULTS]), remedy)
    return entries


def _read_device(value: Value, path: Path, name: str) -> Pinhole:
    entries = _require_keys(value, DEVICE_KEYS, path, name, "write one map per device")
    width_px, height_px = entries["image_width"], entries["image_height"]
    if not _is_side(width_px) or not _is_side(height_px):
        _refuse(path, f"whole numbers as extent of '{name}', from 1 to {MAX_SIDE_PX}", "something else",
                "correct image_width and image_height")  # fmt: skip
    five = five_distortion_terms(_matrix(entries, "distortion_coefficients", path, name), path, name)
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


def five_distortion_terms(distortion: FloatArray, path: Path, name: str) -> FloatArray:
    """(5,) float64: k1, k2, p1, p2 and k3 of OpenCV's coefficients, 4 or more.
    Raises CalibrationError: there are fewer, or one beyond k3 is not 0.
    """
    terms = distortion.ravel()
    if terms.size < 4 or terms[5:].any():
        _refuse(
            path,
            f"k1, k2, p1, p2 and at most k3 as distortion of '{name}'",
            shorten(terms[:14].tolist()),
            "calibrate without the rational, thin prism and tilt models",
        )
    five = np.zeros(5)
    five[: min(terms.size, 5)] = terms[:5]
    return five


def _is_side(value: Value) -> TypeGuard[int]:
    return isinstance(value, int) and 1 <= value <= MAX_SIDE_PX


def _read_solved(value: Value, path: Path) -> SolveRecord:
    entries = _require_keys(value, SOLVED_KEYS, path, SOLVED, "leave the whole map out")
    name, solved_at = entries["id"], entries["solved_at"]
    error_mm, scale_sigma = entries["expected_error_mm"], entries["scale_sigma"]
    if not isinstance(name, str) or not isinstance(solved_at, str):
        _refuse(path, f"text as id and solved_at of '{SOLVED}'", "something else",
                "export it again, or leave the whole map out")  # fmt: skip
    if not isinstance(error_mm, int | float) or not isinstance(scale_sigma, int | float):
        _refuse(path, f"numbers as expected_error_mm and scale_sigma of '{SOLVED}'", "something else",
                "export it again, or leave the whole map out")  # fmt: skip
    if not 1 <= len(name) <= MAX_ID_LENGTH:
        _refuse(path, f"a text of 1 to {MAX_ID_LENGTH} characters as {SOLVED}.id", shorten(name), "export it again")
    if not _is_aware_time(solved_at):
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
        return SolveRecord(name, solved_at, covariance, volume_mm, float(error_mm), float(scale_sigma))
    except (CalibrationError, ValueError) as cause:
        raise CalibrationError(f"{path}: {SOLVED}.{cause}") from cause


def _is_aware_time(text: str) -> bool:
    try:
        return datetime.fromisoformat(text).tzinfo is not None
    except ValueError:
        return False


def _matrix(entries: dict[str, Value], key: str, path: Path, name: str) -> FloatArray:
    value = entries[key]
    if not isinstance(value, np.ndarray):
        _refuse(path, f"an !!opencv-matrix at {name}.{key}", "something else", "export it again")
    return value


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


Vector3 = Annotated[list[float], Field(min_length=3, max_length=3)]
Matrix3 = Annotated[list[Vector3], Field(min_length=3, max_length=3)]
Distortion = Annotated[list[float], Field(min_length=5, max_length=5, description="k1, k2, p1, p2, k3")]
Five, Two = Field(min_length=5, max_length=5), Field(min_length=2, max_length=2)


class DeviceEntry(Strict):
    """One camera or projector: pinhole, lens, and pose in the world."""

    size_px: Extent
    matrix: Matrix3
    distortion: Distortion
    rotation: Matrix3
    translation_mm: Vector3


class SolvedEntry(Strict):
    """Origin and error of the calibration: see `slrig.model.SolveRecord`. Absent if the error is unknown."""

    id: Annotated[str, Field(min_length=1, max_length=64)]
    solved_at: Annotated[AwareMoment, Field(description="ISO 8601 with the offset from UTC")]
    covariance: Annotated[
        list[list[float]],
        Field(
            max_length=MAX_DEVICES * DEVICE_PARAMETERS,
            description="of fx, fy, cx, cy, k1, k2, p1, p2, k3, a small turn (rad) and the translation (mm) of each "
            "device: cameras in order, then the projector",
        ),
    ]
    volume_mm: Annotated[list[Vector3], Field(min_length=2, max_length=2)]
    expected_error_mm: Annotated[float, Field(ge=0)]
    scale_sigma: Annotated[
        float, Field(ge=0, le=1, description="deviation of the scale, a share, by the size of the board alone")
    ] = 0.0


class LightEntry(Strict):
    """The projector's light over its image, measured on a white board: see `slrig.model.LightMap`."""

    coefficients: Annotated[
        list[Annotated[list[Annotated[list[float], Five]], Five]],
        Field(min_length=1, max_length=3, description="c_ij of white, or of red, green and blue"),
    ]
    covered_px: Annotated[list[Annotated[list[float], Two]], Two]


class CalibrationEntry(Strict):
    """The whole of calibration.json. Without a projector only pairs of cameras can be triangulated."""

    format: Literal["slrig-calibration"]
    version: Literal[1]
    cameras: Annotated[dict[CameraName, DeviceEntry], Field(min_length=1)]
    projector: DeviceEntry | None = None
    solved: SolvedEntry | None = None
    light: LightEntry | None = None


def read_calibration(path: Path) -> Calibration:
    """Return the calibration in a file: slrig's JSON, or OpenCV FileStorage if the name ends in yml, yaml or xml.
    Raises CalibrationError: as `parse_calibration`, or its numbers cannot be those of a rig (`calibration_faults`).
    """
    calibration = parse_calibration(path)
    require_plausible(calibration, str(path))
    return calibration


def parse_calibration(path: Path) -> Calibration:
    """Return the calibration in a file as `read_calibration` does, even if its numbers are those of no rig.
    Raises CalibrationError: the file is missing, cut, has an unknown key or a number that is not finite; all faults in
    one message.
    """
    if path.suffix.lower() in {".yml", ".yaml", ".xml"}:
        return read_opencv_calibration(path)
    entry = read_json_model(
        path, CalibrationEntry, "calibration", max_bytes=MAX_CALIBRATION_BYTES, error=CalibrationError
    )
    cameras = {name: _build_pinhole(device, path, f"cameras.{name}") for name, device in entry.cameras.items()}
    projector = None if entry.projector is None else _build_pinhole(entry.projector, path, "projector")
    try:
        return Calibration(cameras, projector, _build_solved(entry.solved), _build_light_map(entry.light))
    except (CalibrationError, ValueError) as cause:
        raise CalibrationError(f"{path}: solved.{cause}") from cause


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration as slrig's JSON, completely or not at all. Raises StorageError: the disk refused."""
    data: dict[str, Any] = {
        "format": "slrig-calibration",
        "version": 1,
        "cameras": {name: _device_document(pinhole) for name, pinhole in calibration.cameras.items()},
    }
    if calibration.projector is not None:
        data["projector"] = _device_document(calibration.projector)
    for name, known in (("solved", calibration.solved), ("light", calibration.light)):
        if known is not None:
            data[name] = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in asdict(known).items()}
    write_file(path, json_bytes(data))


def check_calibration(calibration: Calibration, projector: Size, cameras: Mapping[str, Size], source: str) -> None:
    """Compare a calibration with the devices that it will be used for. source : its origin, for messages.
    Raises CalibrationError: it was made for devices of another size, or has none of the cameras.
    """
    faults = [
        f"cameras.{name}: expected {size} as the camera's frames are, found {calibration.cameras[name].size}"
        f"{_scale_words(calibration.cameras[name].size, size)}"
        for name, size in cameras.items()
        if name in calibration.cameras and calibration.cameras[name].size != size
    ]
    if calibration.projector is not None and calibration.projector.size != projector:
        found = calibration.projector.size
        faults.append(
            f"projector: expected {projector} as the projector is, found {found}{_scale_words(found, projector)}"
        )
    if not set(cameras) & set(calibration.cameras):
        faults.append(f"cameras: expected {', '.join(cameras)}, found {', '.join(calibration.cameras)}")
    if faults:
        lines = "\n".join(f"  {fault}" for fault in faults)
        message = f"{source}: the calibration is for other devices; calibrate these or name the right file:\n{lines}"
        raise CalibrationError(message)


def _scale_words(found: Size, wanted: Size) -> str:
    """Return what turns a matrix of one size into that of another size of the same shape; nothing for another shape."""
    scale = wanted.width_px / found.width_px
    if abs(found.height_px * scale - wanted.height_px) > 1:
        return ""
    return (
        f", the same shape {1 / scale:.4g} times as large. If nothing was cropped, multiply fx and fy by {scale:.4g}, "
        f"and set cx to {scale:.4g} (cx + 0.5) - 0.5, cy likewise"
    )


def require_two_rays(calibration: Calibration, cameras: Collection[str], source: str) -> None:
    """Check that with these cameras the calibration has two rays for each point. source : its origin, for messages.
    Raises CalibrationError: it has no projector, and only one of the cameras.
    """
    known = [name for name in cameras if name in calibration.cameras]
    if calibration.projector is None and len(known) < 2:
        owner = f"camera '{known[0]}'" if known else "none of these cameras"
        raise CalibrationError(
            f"{source}: expected a calibration with two rays for each point, found that of {owner} alone, without a "
            "projector: it has no depth, and cannot scan; calibrate the camera together with the projector or with a "
            "second camera"
        )


def _build_solved(entry: SolvedEntry | None) -> SolveRecord | None:
    if entry is None:
        return None
    covariance, volume_mm = (np.array(each, dtype=np.float64) for each in (entry.covariance, entry.volume_mm))
    return SolveRecord(
        entry.id, entry.solved_at.isoformat(), covariance, volume_mm, entry.expected_error_mm, entry.scale_sigma
    )


def _build_light_map(entry: LightEntry | None) -> LightMap | None:
    if entry is None:
        return None
    return LightMap(*(np.array(each, dtype=np.float64) for each in (entry.coefficients, entry.covered_px)))


def _build_pinhole(device: DeviceEntry, path: Path, place: str) -> Pinhole:
    numbers = (device.matrix, device.distortion, device.rotation, device.translation_mm)
    try:
        return Pinhole(Size(*device.size_px), *(np.array(each, dtype=np.float64) for each in numbers))
    except CalibrationError as cause:
        raise CalibrationError(f"{path}: {place}.{cause}") from cause


def _device_document(pinhole: Pinhole) -> dict[str, Any]:
    numbers = {key: getattr(pinhole, key).tolist() for key in ("matrix", "distortion", "rotation", "translation_mm")}
    return {"size_px": [pinhole.size.width_px, pinhole.size.height_px], **numbers}

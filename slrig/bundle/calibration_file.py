"""calibration.json: where the devices of a rig stand, read, written, and held against the devices of a capture."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from slrig.bundle.description import CameraName, Extent
from slrig.bundle.faults import Strict, read_description_of
from slrig.bundle.moments import AwareMoment
from slrig.bundle.opencv_calibration import read_opencv_calibration
from slrig.bundle.storage import json_bytes, write_file
from slrig.errors import CalibrationError
from slrig.model import DEVICE_PARAMETERS, Calibration, LightMap, Pinhole, Size, Solved

MOST_CALIBRATION_BYTES = 4 * 2**20
MOST_DEVICES = 16

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
    """How the calibration was found: see `slrig.model.Solved`. Absent where it says nothing of its own error."""

    id: Annotated[str, Field(min_length=1, max_length=64)]
    solved_at: Annotated[AwareMoment, Field(description="ISO 8601 with the offset from UTC")]
    covariance: Annotated[
        list[list[float]],
        Field(
            max_length=MOST_DEVICES * DEVICE_PARAMETERS,
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
    """The whole of calibration.json. Without a projector only cameras can be triangulated with each other."""

    format: Literal["slrig-calibration"]
    version: Literal[1]
    cameras: Annotated[dict[CameraName, DeviceEntry], Field(min_length=1)]
    projector: DeviceEntry | None = None
    solved: SolvedEntry | None = None
    light: LightEntry | None = None


def read_calibration(path: Path) -> Calibration:
    """Return the calibration in a file: slrig's JSON, or OpenCV FileStorage where the name ends in yml, yaml or xml.
    Raises CalibrationError: the file is missing, cut, has an unknown key or a number that is not finite; all faults in
    one message.
    """
    if path.suffix.lower() in {".yml", ".yaml", ".xml"}:
        return read_opencv_calibration(path)
    entry = read_description_of(
        path, CalibrationEntry, "calibration", most_bytes=MOST_CALIBRATION_BYTES, error=CalibrationError
    )
    cameras = {name: _pinhole(device, path, f"cameras.{name}") for name, device in entry.cameras.items()}
    projector = None if entry.projector is None else _pinhole(entry.projector, path, "projector")
    try:
        return Calibration(cameras, projector, _solved(entry.solved), _light(entry.light))
    except (CalibrationError, ValueError) as cause:
        raise CalibrationError(f"{path}: solved.{cause}") from cause


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration as slrig's JSON, whole or not at all. Raises StorageError: the disk refused."""
    data: dict[str, Any] = {
        "format": "slrig-calibration",
        "version": 1,
        "cameras": {name: _device(pinhole) for name, pinhole in calibration.cameras.items()},
    }
    if calibration.projector is not None:
        data["projector"] = _device(calibration.projector)
    for name, known in (("solved", calibration.solved), ("light", calibration.light)):
        if known is not None:
            data[name] = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in asdict(known).items()}
    write_file(path, json_bytes(data))


def check_calibration(calibration: Calibration, projector: Size, cameras: Mapping[str, Size], source: str) -> None:
    """Hold a calibration against the devices that it will be used for. `source` says where it came from.
    Raises CalibrationError: it was made for devices of another size, or knows none of the cameras.
    """
    faults = [
        f"cameras.{name}: expected {size} as the camera's frames are, found {calibration.cameras[name].size}"
        for name, size in cameras.items()
        if name in calibration.cameras and calibration.cameras[name].size != size
    ]
    if calibration.projector is not None and calibration.projector.size != projector:
        faults.append(f"projector: expected {projector} as the projector is, found {calibration.projector.size}")
    if not set(cameras) & set(calibration.cameras):
        faults.append(f"cameras: expected {', '.join(cameras)}, found {', '.join(calibration.cameras)}")
    if faults:
        lines = "\n".join(f"  {fault}" for fault in faults)
        message = f"{source}: the calibration is for other devices; calibrate these or name the right file:\n{lines}"
        raise CalibrationError(message)


def check_rays(calibration: Calibration, cameras: Collection[str], source: str) -> None:
    """See that with these cameras the calibration has two rays for each point. `source` says where it came from.
    Raises CalibrationError: it has no projector, and one of the cameras.
    """
    known = [name for name in cameras if name in calibration.cameras]
    if calibration.projector is None and len(known) < 2:
        whose = f"camera '{known[0]}'" if known else "none of these cameras"
        raise CalibrationError(
            f"{source}: expected a calibration with two rays for each point, found that of {whose} alone, without a "
            "projector: it tells no depth, and cannot scan; calibrate the camera together with the projector or with a "
            "second camera"
        )


def _solved(entry: SolvedEntry | None) -> Solved | None:
    if entry is None:
        return None
    covariance, volume_mm = (np.array(each, dtype=np.float64) for each in (entry.covariance, entry.volume_mm))
    return Solved(
        entry.id, entry.solved_at.isoformat(), covariance, volume_mm, entry.expected_error_mm, entry.scale_sigma
    )


def _light(entry: LightEntry | None) -> LightMap | None:
    if entry is None:
        return None
    return LightMap(*(np.array(each, dtype=np.float64) for each in (entry.coefficients, entry.covered_px)))


def _pinhole(device: DeviceEntry, path: Path, place: str) -> Pinhole:
    numbers = (device.matrix, device.distortion, device.rotation, device.translation_mm)
    try:
        return Pinhole(Size(*device.size_px), *(np.array(each, dtype=np.float64) for each in numbers))
    except CalibrationError as cause:
        raise CalibrationError(f"{path}: {place}.{cause}") from cause


def _device(pinhole: Pinhole) -> dict[str, Any]:
    numbers = {key: getattr(pinhole, key).tolist() for key in ("matrix", "distortion", "rotation", "translation_mm")}
    return {"size_px": [pinhole.size.width_px, pinhole.size.height_px], **numbers}

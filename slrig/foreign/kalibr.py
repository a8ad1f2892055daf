"""Calibrations as Kalibr's camchain YAML: cam0, cam1 …, each posed by T_cn_cnm1 from the one before, in metres.

A device's name is the first part of its rostopic (/left/image_raw: left); of `projector` it is the projector. Where
these are no names, or two are equal, devices are called cam0, cam1 … The world is the frame of cam0. Kalibr's radtan is
k1, k2, p1, p2: a lens with k3 cannot be written, and its other lenses cannot be read.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from slrig.bundle.description import CAMERA_NAME
from slrig.bundle.storage import write_file
from slrig.bundle.validation import Strict, checked
from slrig.errors import CalibrationError
from slrig.foreign.ros import Side
from slrig.foreign.yaml_text import read_yaml, yaml_bytes
from slrig.model import Calibration, Pinhole, Size
from slrig.ros_messages import PROJECTOR

_MM_PER_M = 1000.0
Four = Annotated[list[float], Field(min_length=4, max_length=4)]


class ChainEntry(Strict):
    """One camera of the chain."""

    camera_model: str
    intrinsics: Annotated[list[float], Field(max_length=8, description="fu, fv, pu, pv")]
    distortion_model: str
    distortion_coeffs: Annotated[list[float], Field(max_length=8)]
    resolution: Annotated[list[Side], Field(min_length=2, max_length=2)]
    rostopic: str = ""
    T_cn_cnm1: Annotated[list[Four], Field(min_length=4, max_length=4)] | None = None
    T_cam_imu: object = None
    timeshift_cam_imu: object = None
    cam_overlaps: object = None


def read_kalibr(path: Path) -> Calibration:
    """Return the calibration in a camchain file.
    Raises CalibrationError: it is cut, a lens model is another one, or the chain has a gap.
    """
    data = read_yaml(path)
    if not isinstance(data, dict) or not data or list(data) != [f"cam{number}" for number in range(len(data))]:
        found = ", ".join(map(str, list(data)[:5])) if isinstance(data, dict) and data else "no map"
        raise CalibrationError(
            f"{path}: expected Kalibr's cam0, cam1 … in this order, found {found}; of ROS name the folder"
        )
    chain = [_entry(path, key, entry) for key, entry in data.items()]
    rotation, translation_mm = np.eye(3), np.zeros(3)
    devices = {}
    for name, key, entry in zip(_names(chain), data, chain, strict=True):
        if (entry.T_cn_cnm1 is None) != (key == "cam0"):
            message = (
                f"{path}: {key}.T_cn_cnm1: expected one for each but cam0, found otherwise; calibrate them together"
            )
            raise CalibrationError(message)
        if entry.T_cn_cnm1 is not None:
            step = np.array(entry.T_cn_cnm1, dtype=np.float64)
            rotation = step[:3, :3] @ rotation
            translation_mm = step[:3, :3] @ translation_mm + step[:3, 3] * _MM_PER_M
        (fx, fy, cx, cy), size = entry.intrinsics, Size(*entry.resolution)
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        try:
            devices[name] = Pinhole(size, matrix, np.array([*entry.distortion_coeffs, 0.0]), rotation, translation_mm)
        except CalibrationError as cause:
            raise CalibrationError(f"{path}: {key}.{cause}") from cause
    projector = devices.pop(PROJECTOR, None)
    if not devices:
        raise CalibrationError(f"{path}: expected a camera, found the projector alone; add it")
    return Calibration(devices, projector)


def _entry(path: Path, key: str, data: object) -> ChainEntry:
    entry = checked(ChainEntry, data, f"{path}: {key}", error=CalibrationError)
    models = (entry.camera_model, entry.distortion_model)
    if models != ("pinhole", "radtan") or (len(entry.intrinsics), len(entry.distortion_coeffs)) != (4, 4):
        raise CalibrationError(
            f"{path}: {key}: expected pinhole-radtan with 4 intrinsics and 4 coefficients, found {'-'.join(models)} "
            f"with {len(entry.intrinsics)} and {len(entry.distortion_coeffs)}; slrig has no other lens: calibrate with "
            "--models pinhole-radtan"
        )
    return entry


def _names(chain: list[ChainEntry]) -> list[str]:
    names = [entry.rostopic.strip("/").split("/")[0] for entry in chain]
    usable = len(set(names)) == len(names) and all(re.fullmatch(CAMERA_NAME, name) for name in names)
    return names if usable else [f"cam{number}" for number in range(len(chain))]


def write_kalibr(path: Path, calibration: Calibration) -> None:
    """Write a calibration as a camchain, the projector last. The first camera's frame becomes the world.
    Raises CalibrationError: a lens has k3 or skew, which the format has not; StorageError.
    """
    devices = dict(calibration.cameras)
    if calibration.projector is not None:
        devices[PROJECTOR] = calibration.projector
    lossy = [name for name, each in devices.items() if each.distortion[4] or each.matrix[0, 1]]
    if lossy:
        raise CalibrationError(
            f"{path}: expected lenses without k3 and skew, which Kalibr's radtan does not have, found them in "
            f"{', '.join(lossy)}; export to ros or opencv"
        )
    chain: dict[str, Any] = {}
    before: Pinhole | None = None
    for number, (name, device) in enumerate(devices.items()):
        entry: dict[str, Any] = {}
        if before is not None:
            step = np.eye(4)
            step[:3, :3] = device.rotation @ before.rotation.T
            step[:3, 3] = (device.translation_mm - step[:3, :3] @ before.translation_mm) / _MM_PER_M
            entry["T_cn_cnm1"] = step.tolist()
        matrix = device.matrix
        entry |= {
            "camera_model": "pinhole",
            "distortion_coeffs": device.distortion[:4].tolist(),
            "distortion_model": "radtan",
            "intrinsics": [float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])],
            "resolution": [device.size.width_px, device.size.height_px],
            "rostopic": f"/{name}/image_raw",
        }
        chain[f"cam{number}"], before = entry, device
    write_file(path, yaml_bytes(chain))

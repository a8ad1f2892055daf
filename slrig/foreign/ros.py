"""Calibrations as ROS has them: a folder with the camera_info of each device, and transforms.yaml for where it stands.

NAME.yaml is what camera_calibration writes for a camera; projector.yaml is the same for the projector. transforms.yaml
is a list of geometry_msgs/TransformStamped, metres and quaternions, each from a frame to a device's optical frame: the
child's pose in its parent. A device's frame is called as the device, or as that with _optical_frame behind it. Devices
whose transforms have one root are in one world, that of the root.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from slrig.bundle.description import MOST_SIDE_PX
from slrig.bundle.storage import sync_folder, write_durably
from slrig.bundle.validation import Strict, checked
from slrig.disk import refusals_of, staging_name
from slrig.errors import CalibrationError
from slrig.foreign.yaml_text import read_yaml, yaml_bytes
from slrig.model import Calibration, FloatArray, Pinhole, Size
from slrig.ros_messages import FRAME, MM_PER_M, PROJECTOR, WORLD, lens, pose

TRANSFORMS = "transforms.yaml"

Side = Annotated[int, Field(ge=1, le=MOST_SIDE_PX)]


class Matrix(Strict):
    """Numbers row by row."""

    rows: Annotated[int, Field(ge=1, le=16)]
    cols: Annotated[int, Field(ge=1, le=16)]
    data: Annotated[list[float], Field(max_length=256)]

    def array(self, place: str) -> FloatArray:
        """(rows, cols) float64. Raises CalibrationError: there are more or fewer numbers."""
        if len(self.data) != self.rows * self.cols:
            message = f"{place}: expected {self.rows * self.cols} numbers, found {len(self.data)}; export it again"
            raise CalibrationError(message)
        return np.array(self.data, dtype=np.float64).reshape(self.rows, self.cols)


class CameraInfo(Strict):
    """What camera_calibration writes. What follows from the other numbers is passed over."""

    image_width: Side
    image_height: Side
    camera_name: str = ""
    camera_matrix: Matrix
    distortion_model: str
    distortion_coefficients: Matrix
    rectification_matrix: object = None
    projection_matrix: object = None


class Vector(Strict):
    """Metres."""

    x: float
    y: float
    z: float


class Quaternion(Vector):
    """A rotation."""

    w: float


class Pose(Strict):
    """A child's pose in its parent."""

    translation: Vector
    rotation: Quaternion


class Header(Strict):
    """Whose frame the pose is told in."""

    frame_id: str
    stamp: object = None
    seq: object = None


class Transform(Strict):
    """geometry_msgs/TransformStamped."""

    header: Header
    child_frame_id: str
    transform: Pose


class Transforms(Strict):
    """tf2_msgs/TFMessage."""

    transforms: Annotated[list[Transform], Field(min_length=1, max_length=64)]


def read_ros(folder: Path) -> Calibration:
    """Return the calibration in a folder of camera_info files.
    Raises CalibrationError: a file is missing or wrong, a lens model is another one, a device has no transform.
    """
    files = {each.stem: each for each in sorted(folder.glob("*.yaml")) if each.name != TRANSFORMS}
    if not files or not (folder / TRANSFORMS).is_file():
        found = ", ".join(sorted(each.name for each in folder.iterdir())[:8]) or "nothing"
        raise CalibrationError(
            f"{folder}: expected NAME.yaml of each device, camera_info as camera_calibration writes it, and "
            f"{TRANSFORMS} with where they stand, found {found}"
        )
    poses = _poses(folder / TRANSFORMS)
    devices = {name: _device(path, poses, name) for name, path in files.items()}
    projector = devices.pop(PROJECTOR, None)
    if not devices:
        raise CalibrationError(f"{folder}: expected a camera, found the projector alone; add its NAME.yaml")
    return Calibration(devices, projector)


def _device(path: Path, poses: dict[str, tuple[FloatArray, FloatArray]], name: str) -> Pinhole:
    info = checked(CameraInfo, read_yaml(path), str(path), error=CalibrationError)
    terms = info.distortion_coefficients.array(f"{path}: distortion_coefficients").ravel()
    if info.distortion_model not in ("plumb_bob", "rational_polynomial") or terms[5:].any() or len(terms) < 4:
        raise CalibrationError(
            f"{path}: expected the distortion plumb_bob (k1, k2, p1, p2, k3), found {info.distortion_model} with "
            f"{len(terms)} numbers; slrig has no other lens: calibrate with plumb_bob"
        )
    frame = next((each for each in (name, name + FRAME) if each in poses), None)
    if frame is None:
        known = ", ".join(poses)
        raise CalibrationError(
            f"{path}: expected a transform to the frame {name} or {name}{FRAME}, found {known}; add it"
        )
    rotation, translation_mm = poses[frame]
    five = np.zeros(5)
    five[: min(len(terms), 5)] = terms[:5]
    matrix = info.camera_matrix.array(f"{path}: camera_matrix")
    try:
        return Pinhole(Size(info.image_width, info.image_height), matrix, five, rotation, translation_mm)
    except CalibrationError as cause:
        raise CalibrationError(f"{path}: {cause}") from cause


def _poses(path: Path) -> dict[str, tuple[FloatArray, FloatArray]]:
    """World to frame of each frame: rotation, and translation in mm. Raises CalibrationError."""
    listed = checked(Transforms, read_yaml(path), str(path), error=CalibrationError).transforms
    parents = {each.child_frame_id: each for each in listed}
    if len(parents) < len(listed):
        raise CalibrationError(f"{path}: expected one parent for each frame, found two; keep one of them")
    roots = {each.header.frame_id for each in listed} - set(parents)
    if len(roots) != 1:
        found = ", ".join(sorted(roots)) or "a circle"
        raise CalibrationError(f"{path}: expected one frame that all others hang on, found {found}; join them")
    (root,) = roots
    poses: dict[str, tuple[FloatArray, FloatArray]] = {root: (np.eye(3), np.zeros(3))}
    for frame in parents:
        rotation, translation, at = np.eye(3), np.zeros(3), frame
        for _ in range(len(parents)):
            if at == root:
                break
            step = parents[at].transform
            turn = step.rotation
            quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
            if not abs(np.linalg.norm(quaternion) - 1) < 1e-3:
                raise CalibrationError(f"{path}: {at}: expected a quaternion of length 1, found {quaternion.tolist()}")
            # x_child = Rᵀ (x_parent - t), then on to what comes before.
            back = Rotation.from_quat(quaternion).as_matrix().T
            offset = np.array([step.translation.x, step.translation.y, step.translation.z])
            translation = translation - rotation @ back @ offset
            rotation, at = rotation @ back, parents[at].header.frame_id
        if at != root:
            raise CalibrationError(f"{path}: expected a way from {frame} to {root}, found a circle; join them")
        poses[frame] = (rotation, translation * MM_PER_M)
    return poses


def write_ros(folder: Path, calibration: Calibration) -> None:
    """Write a calibration as camera_info of each device and their transforms, the whole folder or nothing.
    Raises CalibrationError: a camera is called projector or transforms, or the folder is there already; StorageError.
    """
    if folder.exists() or {PROJECTOR, "transforms"} & set(calibration.cameras):
        raise CalibrationError(f"{folder}: expected a new folder, and no camera of the name {PROJECTOR} or transforms")
    devices = dict(calibration.cameras)
    if calibration.projector is not None:
        devices[PROJECTOR] = calibration.projector
    transforms: list[dict[str, Any]] = []
    texts: dict[str, bytes] = {}
    for name, device in devices.items():
        texts[f"{name}.yaml"] = yaml_bytes(_info(name, device))
        place, turn = pose(device.rotation, device.translation_mm)
        stands = {
            "translation": dict(zip("xyz", place, strict=True)),
            "rotation": dict(zip("xyzw", turn, strict=True)),
        }
        transforms.append({"header": {"frame_id": WORLD}, "child_frame_id": name + FRAME, "transform": stands})
    texts[TRANSFORMS] = yaml_bytes({"transforms": transforms})
    staging = staging_name(folder)
    with refusals_of(folder):
        try:
            staging.mkdir()
            for file, text in texts.items():
                write_durably(staging / file, text)
            sync_folder(staging)
            staging.rename(folder)
            sync_folder(folder.parent)
        finally:
            shutil.rmtree(staging, ignore_errors=True)


def _info(name: str, device: Pinhole) -> dict[str, Any]:
    def matrix(array: FloatArray) -> dict[str, Any]:
        return {"rows": array.shape[0], "cols": array.shape[1], "data": array.ravel().tolist()}

    sees = lens(device.matrix, device.distortion)
    return {
        "image_width": device.size.width_px,
        "image_height": device.size.height_px,
        "camera_name": name,
        "camera_matrix": matrix(sees["k"]),
        "distortion_model": sees["distortion_model"],
        "distortion_coefficients": matrix(sees["d"][None]),
        "rectification_matrix": matrix(sees["r"]),
        "projection_matrix": matrix(sees["p"]),
    }

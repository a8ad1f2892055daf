"""Calibration files of slrig, OpenCV, ROS, Kalibr and several scanning programs."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import Field
from scipy.spatial.transform import Rotation

from slrig.bundle import (
    CAMERA_NAME,
    MAX_SIDE_PX,
    MAX_STORAGE_BYTES,
    Strict,
    parse_calibration,
    read_file_storage,
    read_opencv_calibration,
    read_text,
    sync_folder,
    validate,
    write_calibration,
    write_durably,
    write_file,
    write_opencv_calibration,
)
from slrig.disk import staging_name, storage_errors
from slrig.errors import CalibrationError
from slrig.importers.coded_images import CodedImages
from slrig.importers.documents import DOCUMENT_SUFFIXES, Leaf, Name, read_document, read_yaml
from slrig.importers.lenses import as_lens
from slrig.importers.recognition import PROJECTOR, Keys, Recognition, is_centred, parse_keys
from slrig.model import (
    MM_PER_UNIT,
    Axis,
    Calibration,
    FloatArray,
    Gray,
    LengthUnit,
    Pinhole,
    Size,
    require_millimetres,
    require_plausible,
    rig_layout,
    units_sentence,
)
from slrig.patterns import gray_bits
from slrig.ros_messages import FRAME, MM_PER_M, WORLD, lens, pose

CalibrationFormat = Literal["slrig", "opencv", "ros", "kalibr"]
FORMAT_BY_SUFFIX: Mapping[str, CalibrationFormat] = {".json": "slrig", ".yml": "opencv", ".xml": "opencv"}

TRANSFORMS = "transforms.yaml"

_PROGRAMS = {
    "scan3d-capture": ("cam_K", "cam_kc", "proj_K", "proj_kc", "R", "T"),
    "SLStudio": ("Kc", "kc", "Kp", "kp", "Rp", "Tp"),
    "procam-calibration": ("cam_int", "cam_dist", "proj_int", "proj_dist", "rotation", "translation"),
    "procam-calibration's sample": ("cam_int", "cam_dist", "proj_int", "proj_dist", "roration", "translation"),
    "sltk": ("cam_K", "cam_kc", "pro_K", "pro_kc", "R", "T"),
    "OpenCV's sample of stereo calibration": ("M1", "D1", "M2", "D2", "R", "T"),
}
"""Names by which a program's file is known: matrix and distortion of both devices, rotation and translation."""


def yaml_bytes(data: object) -> bytes:
    """Return data as YAML in its own order, with lists of numbers on one line."""
    text: str = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=2**16, allow_unicode=True)
    return text.encode()


Side = Annotated[int, Field(ge=1, le=MAX_SIDE_PX)]


class RosMatrix(Strict):
    """A matrix, row by row."""

    rows: Annotated[int, Field(ge=1, le=16)]
    cols: Annotated[int, Field(ge=1, le=16)]
    data: Annotated[list[float], Field(max_length=256)]

    def array(self, key: str) -> FloatArray:
        """(rows, cols) float64. Raises CalibrationError: there are more or fewer numbers."""
        if len(self.data) != self.rows * self.cols:
            message = f"{key}: expected {self.rows * self.cols} numbers, found {len(self.data)}; export it again"
            raise CalibrationError(message)
        return np.array(self.data, dtype=np.float64).reshape(self.rows, self.cols)


class RosCameraInfo(Strict):
    """A file of camera_calibration. Fields that follow from others are ignored."""

    image_width: Side
    image_height: Side
    camera_name: str = ""
    camera_matrix: RosMatrix
    distortion_model: str
    distortion_coefficients: RosMatrix
    rectification_matrix: object = None
    projection_matrix: object = None


class RosVector(Strict):
    """A vector in metres."""

    x: float
    y: float
    z: float


class RosQuaternion(RosVector):
    """A rotation as a quaternion."""

    w: float


class RosTransform(Strict):
    """Pose of a child frame in its parent."""

    translation: RosVector
    rotation: RosQuaternion


class RosHeader(Strict):
    """Header with the parent frame."""

    frame_id: str
    stamp: object = None
    seq: object = None


class TransformStamped(Strict):
    """geometry_msgs/TransformStamped."""

    header: RosHeader
    child_frame_id: str
    transform: RosTransform


class TfMessage(Strict):
    """tf2_msgs/TFMessage."""

    transforms: Annotated[list[TransformStamped], Field(min_length=1, max_length=64)]


def read_ros(folder: Path) -> tuple[Calibration, list[str]]:
    """Return the calibration in a folder of camera_info files, and notes on lenses that were fitted.

    The poses are those of transforms.yaml, or without it those that the rectification of a stereo pair implies.
    Raises CalibrationError: a file is missing or invalid, a lens model is not supported, or a device has no transform.
    """
    files = {each.stem: each for each in sorted(folder.glob("*.yaml")) if each.name != TRANSFORMS}
    infos = {
        name: validate(RosCameraInfo, read_yaml(path), str(path), error=CalibrationError)
        for name, path in files.items()
    }
    has_transforms = (folder / TRANSFORMS).is_file()
    rectified = {} if has_transforms else _rectified_poses(infos)
    if not files or not (has_transforms or rectified):
        found = ", ".join(sorted(each.name for each in folder.iterdir())[:8]) or "nothing"
        raise CalibrationError(
            f"{folder}: expected NAME.yaml of each device, camera_info as camera_calibration writes it, and "
            f"{TRANSFORMS} with their poses (or two with the projection_matrix of a stereo pair), found {found}; add "
            "the missing files"
        )
    poses = rectified or _read_ros_poses(folder / TRANSFORMS)
    # Devices have the order of their transforms: the first camera is the reference.
    frames = [frame.removesuffix(FRAME) for frame in poses]
    names = sorted(infos, key=lambda name: frames.index(name) if name in frames else len(frames))
    notes: list[str] = []
    devices = {name: _build_ros_device(files[name], infos[name], poses, name, notes) for name in names}
    projector = devices.pop(PROJECTOR, None)
    if not devices:
        raise CalibrationError(f"{folder}: expected a camera, found the projector alone; add its NAME.yaml")
    return Calibration(devices, projector), notes


def _build_ros_device(
    path: Path, info: RosCameraInfo, poses: dict[str, tuple[FloatArray, FloatArray]], name: str, notes: list[str]
) -> Pinhole:
    # Its writer states 5 columns for any number of terms.
    terms = np.array(info.distortion_coefficients.data, dtype=np.float64)
    is_equidistant = info.distortion_model in ("equidistant", "fisheye")
    if not is_equidistant and info.distortion_model not in ("plumb_bob", "rational_polynomial", "thin_prism_fisheye"):
        raise CalibrationError(
            f"{path}: expected the distortion plumb_bob (k1, k2, p1, p2, k3), found {info.distortion_model} with "
            f"{len(terms)} numbers; slrig supports no other lens: calibrate with plumb_bob"
        )
    frame = next((each for each in (name, name + FRAME) if each in poses), None)
    if frame is None:
        known = ", ".join(poses)
        raise CalibrationError(
            f"{path}: expected a transform to the frame {name} or {name}{FRAME}, found {known}; add it"
        )
    rotation, translation_mm = poses[frame]
    matrix, size = info.camera_matrix.array(f"{path}: camera_matrix"), Size(info.image_width, info.image_height)
    lens = as_lens(matrix, terms, size, f"{path}: distortion_coefficients", equidistant=is_equidistant)
    notes += [f"{name}: {lens.note}"] if lens.note else []
    try:
        return Pinhole(size, lens.matrix, lens.distortion, rotation, translation_mm)
    except CalibrationError as cause:
        raise CalibrationError(f"{path}: {cause}") from cause


def _rectified_poses(infos: Mapping[str, RosCameraInfo]) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return rotation and translation, mm, from the first of two cameras to each; empty if they are no stereo pair.

    The rectified cameras have one matrix K', and R_2 x_2 = R_1 x_1 + t, with K' t the last column of the second's
    projection (sensor_msgs/CameraInfo, less that of the first).
    """
    if len(infos) != 2:
        return {}
    straight, shifts = [], []
    for info in infos.values():
        try:
            turn = validate(RosMatrix, info.rectification_matrix, "", error=CalibrationError).array("")
            projection = validate(RosMatrix, info.projection_matrix, "", error=CalibrationError).array("")
            shifts.append(np.linalg.solve(projection[:, :3], projection[:, 3]))
        except (CalibrationError, ValueError, np.linalg.LinAlgError):
            return {}
        straight.append(turn)
    shift = shifts[1] - shifts[0]
    if not np.isfinite(shift).all() or not shift.any() or any(turn.shape != (3, 3) for turn in straight):
        return {}
    first, second = infos
    moved = straight[1].T @ straight[0], straight[1].T @ shift * MM_PER_M
    return {first: (np.eye(3), np.zeros(3)), second: moved}


def _read_ros_poses(path: Path) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return rotation and translation, mm, from the world to each frame. Raises CalibrationError."""
    listed = validate(TfMessage, read_yaml(path), str(path), error=CalibrationError).transforms
    parents = {each.child_frame_id: each for each in listed}
    if len(parents) < len(listed):
        raise CalibrationError(f"{path}: expected one parent for each frame, found two; keep one of them")
    roots = {each.header.frame_id for each in listed} - set(parents)
    if len(roots) != 1:
        found = ", ".join(sorted(roots)) or "a cycle"
        raise CalibrationError(f"{path}: expected one root frame of all others, found {found}; connect them")
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
            # x_child = Rᵀ (x_parent - t), then continue with the parent.
            inverse = Rotation.from_quat(quaternion).as_matrix().T
            offset = np.array([step.translation.x, step.translation.y, step.translation.z])
            translation = translation - rotation @ inverse @ offset
            rotation, at = rotation @ inverse, parents[at].header.frame_id
        if at != root:
            raise CalibrationError(f"{path}: expected a path from {frame} to {root}, found a cycle; connect them")
        poses[frame] = (rotation, translation * MM_PER_M)
    return poses


def write_ros(folder: Path, calibration: Calibration) -> None:
    """Write camera_info of each device and the transforms to a new folder, which appears only when it is complete.
    Raises CalibrationError: a camera is named projector or transforms, or the folder exists; StorageError.
    """
    if folder.exists() or {PROJECTOR, "transforms"} & set(calibration.cameras):
        raise CalibrationError(f"{folder}: expected a new folder, and no camera of the name {PROJECTOR} or transforms")
    devices = dict(calibration.cameras)
    if calibration.projector is not None:
        devices[PROJECTOR] = calibration.projector
    transforms: list[dict[str, Any]] = []
    texts: dict[str, bytes] = {}
    for name, device in devices.items():
        texts[f"{name}.yaml"] = yaml_bytes(_camera_info(name, device))
        translation, quaternion = pose(device.rotation, device.translation_mm)
        transform = {
            "translation": dict(zip("xyz", translation, strict=True)),
            "rotation": dict(zip("xyzw", quaternion, strict=True)),
        }
        transforms.append({"header": {"frame_id": WORLD}, "child_frame_id": name + FRAME, "transform": transform})
    texts[TRANSFORMS] = yaml_bytes({"transforms": transforms})
    staging = staging_name(folder)
    with storage_errors(folder):
        try:
            staging.mkdir()
            for file, text in texts.items():
                write_durably(staging / file, text)
            sync_folder(staging)
            staging.rename(folder)
            sync_folder(folder.parent)
        finally:
            shutil.rmtree(staging, ignore_errors=True)


def _camera_info(name: str, device: Pinhole) -> dict[str, Any]:
    def matrix(array: FloatArray) -> dict[str, Any]:
        return {"rows": array.shape[0], "cols": array.shape[1], "data": array.ravel().tolist()}

    info = lens(device.matrix, device.distortion)
    return {
        "image_width": device.size.width_px,
        "image_height": device.size.height_px,
        "camera_name": name,
        "camera_matrix": matrix(info["k"]),
        "distortion_model": info["distortion_model"],
        "distortion_coefficients": matrix(info["d"][None]),
        "rectification_matrix": matrix(info["r"]),
        "projection_matrix": matrix(info["p"]),
    }


Four = Annotated[list[float], Field(min_length=4, max_length=4)]


class KalibrCamera(Strict):
    """One camera of a camchain file."""

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


def read_kalibr(path: Path) -> tuple[Calibration, list[str]]:
    """Return the calibration in a camchain file, and notes on lenses that were fitted.
    Raises CalibrationError: the file is truncated, a lens model is not supported, or the chain has a gap.
    """
    data = read_yaml(path)
    if not isinstance(data, dict) or not data or list(data) != [f"cam{number}" for number in range(len(data))]:
        found = ", ".join(map(str, list(data)[:5])) if isinstance(data, dict) and data else "no map"
        raise CalibrationError(
            f"{path}: expected Kalibr's cam0, cam1 … in this order, found {found}; for ROS, give the folder"
        )
    chain = [_check_kalibr_camera(path, key, entry) for key, entry in data.items()]
    rotation, translation_mm = np.eye(3), np.zeros(3)
    devices, notes = {}, []
    for name, key, entry in zip(_kalibr_camera_names(chain), data, chain, strict=True):
        if (entry.T_cn_cnm1 is None) != (key == "cam0"):
            message = (
                f"{path}: {key}.T_cn_cnm1: expected one for each except cam0, found otherwise; calibrate them together"
            )
            raise CalibrationError(message)
        if entry.T_cn_cnm1 is not None:
            step = np.array(entry.T_cn_cnm1, dtype=np.float64)
            rotation = step[:3, :3] @ rotation
            translation_mm = step[:3, :3] @ translation_mm + step[:3, 3] * MM_PER_M
        (fx, fy, cx, cy), size = entry.intrinsics, Size(*entry.resolution)
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        terms, is_equidistant = np.array(entry.distortion_coeffs), entry.distortion_model == "equidistant"
        lens = as_lens(matrix, terms, size, f"{path}: {key}.distortion_coeffs", equidistant=is_equidistant)
        notes += [f"{name}: {lens.note}"] if lens.note else []
        try:
            devices[name] = Pinhole(size, lens.matrix, lens.distortion, rotation, translation_mm)
        except CalibrationError as cause:
            raise CalibrationError(f"{path}: {key}.{cause}") from cause
    projector = devices.pop(PROJECTOR, None)
    if not devices:
        raise CalibrationError(f"{path}: expected a camera, found the projector alone; add it")
    return Calibration(devices, projector), notes


def _check_kalibr_camera(path: Path, key: str, data: object) -> KalibrCamera:
    entry = validate(KalibrCamera, data, f"{path}: {key}", error=CalibrationError)
    models = (entry.camera_model, entry.distortion_model)
    known = {("pinhole", "radtan"), ("pinhole", "equidistant")}
    if models not in known or (len(entry.intrinsics), len(entry.distortion_coeffs)) != (4, 4):
        raise CalibrationError(
            f"{path}: {key}: expected pinhole-radtan or pinhole-equi with 4 intrinsics and 4 coefficients, found "
            f"{'-'.join(models)} with {len(entry.intrinsics)} and {len(entry.distortion_coeffs)}; slrig supports no "
            "other lens: calibrate with --models pinhole-radtan"
        )
    return entry


def _kalibr_camera_names(chain: list[KalibrCamera]) -> list[str]:
    names = [entry.rostopic.strip("/").split("/")[0] for entry in chain]
    usable = len(set(names)) == len(names) and all(re.fullmatch(CAMERA_NAME, name) for name in names)
    return names if usable else [f"cam{number}" for number in range(len(chain))]


def write_kalibr(path: Path, calibration: Calibration) -> None:
    """Write a calibration as a camchain, the projector last. The first camera's frame becomes the world.
    Raises CalibrationError: a lens has k3 or skew, which the format lacks; StorageError.
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
    previous: Pinhole | None = None
    for number, (name, device) in enumerate(devices.items()):
        entry: dict[str, Any] = {}
        if previous is not None:
            step = np.eye(4)
            step[:3, :3] = device.rotation @ previous.rotation.T
            step[:3, 3] = (device.translation_mm - step[:3, :3] @ previous.translation_mm) / MM_PER_M
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
        chain[f"cam{number}"], previous = entry, device
    write_file(path, yaml_bytes(chain))


def _known_program(leaves: Mapping[Name, Leaf], cameras: Mapping[str, Size]) -> tuple[str, Keys | None]:
    """Return the program of `_PROGRAMS` that wrote a file, and what its names mean; no name for another one."""
    for program, names in _PROGRAMS.items():
        if {(name,) for name in names} <= set(leaves):
            # OpenCV's sample is of two cameras, and used for a camera and a projector.
            both = list(cameras)[:2] if program.startswith("OpenCV") and len(cameras) == 2 else []
            first, second = both or [next(iter(cameras), "cam0"), PROJECTOR]
            return program, Keys({first: names[:2], second: names[2:4]}, names[4:])
    return "", None


def _scale_cells_to_pixels(matrix: FloatArray, projector: Size, bits: Mapping[Axis, Gray]) -> FloatArray:
    """Convert a projector's matrix from cells of scan3d-capture's code to pixels.

    The program centres the projector in its code, and counts cells of the finest bit that it shows: with cells of
    c = 2^k px, cell x of n >> k begins at position c (x + offset of cells) - offset of pixels. A capture whose code is
    not centred is of another program: the calibration is then of all pixels (`ProjectorWidget::make_pattern` and
    `sl::convert_pattern` of scan3d-capture).
    """
    scaled = np.array(matrix, dtype=np.float64)
    offsets_px = {axis: centring_offset_px(projector.along(axis)) for axis in Axis}
    if scaled.shape != (3, 3) or any(bit.offset_px != offsets_px[axis] for axis, bit in bits.items()):
        return scaled
    for row, axis in enumerate(Axis):
        if axis not in bits:
            continue
        cell_px = bits[axis].cell_px
        cells = projector.along(axis) // cell_px
        first_cell = (2 ** bits[axis].bits - cells) // 2
        scaled[row] *= cell_px
        scaled[row, 2] += cell_px * first_cell - offsets_px[axis] + (cell_px - 1) / 2
    return scaled


def centring_offset_px(extent_px: int) -> int:
    """Return the offset that centres so many positions in a code with cells of 1 px."""
    return int((2 ** gray_bits(extent_px, 1, 0) - extent_px) // 2)


_SAME_SHARE = 0.1
_MIN_SHARE = 1 / 32  # of images; less is a matrix in millimetres


def _require_matrix_of_image(device: Pinhole, path: Path, name: str) -> None:
    """Check a camera whose file does not state the size of its images, by the place of the principal point.
    Raises CalibrationError: it is that of larger or smaller images of the same shape.
    """
    sides = np.array([device.size.width_px, device.size.height_px])
    shares = (device.matrix[:2, 2] + 0.5) / sides
    if not is_centred(device) and np.ptp(shares) < _SAME_SHARE * shares.mean() and shares.mean() > _MIN_SHARE:
        cx, cy = device.matrix[:2, 2]
        raise CalibrationError(
            f"{path}: camera '{name}': expected a principal point near the middle of images of {device.size}, found "
            f"({cx:g}, {cy:g}), the middle of images about {2 * shares.mean():.2g} times as large; scale fx, fy, cx "
            "and cy to the size of these images, or import images of the size that was calibrated"
        )


def _require_unit(calibration: Calibration, path: Path) -> None:
    """Check a calibration whose file does not state the unit of its translations.
    Raises CalibrationError: in millimetres, it is not of a bench.
    """
    layout = rig_layout(calibration)
    if layout is not None and not layout.is_of_a_bench("mm"):
        raise CalibrationError(
            f"{path}: its translation has no unit. In millimetres {layout} (--unit mm). {units_sentence(layout)}"
        )


def _in_unit(calibration: Calibration, scale: float) -> Calibration:
    """Return the calibration with all translations multiplied, without the statement of its error."""

    def scaled(device: Pinhole) -> Pinhole:
        return replace(device, translation_mm=scale * device.translation_mm)

    projector = calibration.projector
    return replace(
        calibration,
        cameras={name: scaled(device) for name, device in calibration.cameras.items()},
        projector=None if projector is None else scaled(projector),
        solved=None,
    )


@dataclass(frozen=True, slots=True)
class ImportedCalibration:
    """A calibration of another program. notes : what was taken for what, and what was done to it."""

    calibration: Calibration
    notes: tuple[str, ...] = ()


def import_calibration(
    path: Path,
    *,
    cameras: Mapping[str, Size] | None = None,
    projector: Size | None = None,
    bits: Mapping[Axis, Gray] | None = None,
    capture: CodedImages[Any] | None = None,
    unit: LengthUnit | None = None,
    keys: Sequence[str] = (),
) -> ImportedCalibration:
    """Return the calibration in a file or a folder, of any program.

    cameras, projector : extents of the capture that it comes with, for files that lack them. bits : a bit of the code
    of each axis; scan3d-capture counts projector pixels in cells of its finest bit. capture : decides what names leave
    open. unit : that of the file's translations; None for the one that it states, metres for ROS and Kalibr, otherwise
    mm. keys : words as `slrig.importers.recognition.parse_keys` reads them.

    Raises CalibrationError: the format is unknown, the file is invalid, something is missing or to be asked, its
    numbers cannot be those of a rig (`slrig.model.calibration_faults`), its lengths are not known in mm, or it states
    no unit and in mm it would not be of a bench.
    """
    calibration, stated, notes = _read(path, cameras or {}, projector, bits or {}, capture, parse_keys(keys))
    if unit is None and stated is None:
        _require_unit(calibration, path)
    scale = MM_PER_UNIT[unit or stated or "mm"] / MM_PER_UNIT[stated or "mm"]
    if scale != 1:
        calibration = _in_unit(calibration, scale)
    require_plausible(calibration, str(path))
    require_millimetres(calibration, str(path))
    return ImportedCalibration(calibration, tuple(notes))


def _format(path: Path) -> CalibrationFormat | None:
    """Return the format that a file or a folder has, or that it has with faults; None for one of another program."""
    if path.is_dir():
        with storage_errors(path):
            names = [each for each in path.iterdir() if each.suffix.lower() in DOCUMENT_SUFFIXES]
            infos = [each for each in names if each.suffix == ".yaml" and b"distortion_model:" in each.read_bytes()]
        return "ros" if infos or not names or (path / TRANSFORMS).is_file() else None
    try:
        text = read_text(path, MAX_STORAGE_BYTES, CalibrationError).removeprefix("\ufeff")
    except CalibrationError:
        return None
    if text.startswith(("%YAML", "<")):
        root = read_file_storage(text, path)
        is_own = any(isinstance(each, dict) and "translation_mm" in each for each in root.values())
        return "opencv" if is_own or not root else None
    if path.suffix.lower() in (".yml", ".yaml"):
        return "kalibr" if re.search(r"(?m)^cam\d+:", text) and "intrinsics" in text else None
    return "slrig" if not text.strip() or re.search(r'"(format|size_px)"\s*:', text) else None


def _read(
    path: Path,
    cameras: Mapping[str, Size],
    projector: Size | None,
    bits: Mapping[Axis, Gray],
    capture: CodedImages[Any] | None,
    keys: Keys | None,
) -> tuple[Calibration, LengthUnit | None, Sequence[str]]:
    """Return the calibration in mm, the unit that its format states (None for none: mm were assumed), and notes."""
    if keys is None:
        form = _format(path)
        if form in ("ros", "kalibr"):
            calibration, fits = read_ros(path) if form == "ros" else read_kalibr(path)
            return calibration, "m", fits
        if form in ("slrig", "opencv"):
            return (parse_calibration if form == "slrig" else read_opencv_calibration)(path), "mm", ()
    leaves = read_document(path)
    program, known = _known_program(leaves, cameras) if keys is None else ("", None)
    found = Recognition(leaves, path, keys or known, cameras, projector, capture, program).found()
    calibration, scaled = found.calibration, found.calibration.projector
    if program == "scan3d-capture" and scaled is not None:
        matrix = _scale_cells_to_pixels(scaled.matrix, scaled.size, bits)
        calibration = replace(calibration, projector=replace(scaled, matrix=matrix))
    for name, device in calibration.cameras.items():
        if name not in found.sized:
            _require_matrix_of_image(device, path, name)
    # Without a unit of its own, translations count as millimetres until `_require_unit` has looked at them.
    scale = MM_PER_UNIT[found.unit or "mm"]
    notes = [*found.notes, *([f"a file as {program} writes it"] if program else [])]
    return _in_unit(calibration, scale) if scale != 1 else calibration, found.unit, notes


def write_any_calibration(path: Path, calibration: Calibration, form: CalibrationFormat | None = None) -> None:
    """Write a calibration in a format, or in that of the suffix of `path`. The ROS format is a new folder.
    Raises CalibrationError: the suffix is unknown, or the format cannot store the calibration; StorageError.
    """
    form = form or FORMAT_BY_SUFFIX.get(path.suffix.lower())
    if form is None:
        raise CalibrationError(
            f"{path}: expected a name that ends in .json, .yml or .xml, found '{path.suffix}'; rename it, or give --to"
        )
    writers = {"slrig": write_calibration, "opencv": write_opencv_calibration, "ros": write_ros, "kalibr": write_kalibr}
    writers[form](path, calibration)

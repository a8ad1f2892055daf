"""A calibration in whatever form it comes: slrig's, OpenCV's, ROS's, Kalibr's, or that of a scanning program."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
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
    Value,
    five_distortion_terms,
    read_calibration,
    read_file_storage,
    read_opencv_calibration,
    write_calibration,
    write_opencv_calibration,
)
from slrig.bundle.storage import sync_folder, write_durably, write_file
from slrig.bundle.validation import Strict, read_text, validate
from slrig.disk import staging_name, storage_errors
from slrig.errors import CalibrationError
from slrig.model import Axis, Calibration, FloatArray, Gray, Pinhole, Size
from slrig.ros_messages import FRAME, MM_PER_M, PROJECTOR, WORLD, lens, pose

MOST_BYTES = 2**18
MOST_DEPTH = 12


_Loader: Any = type("_Loader", (yaml.SafeLoader,), {})
# YAML 1.1 asks for a point in a number with an exponent; other programs write 1e-05.
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+[eE][-+]?[0-9]+$"), list("-+0123456789")
)


def read_yaml(path: Path) -> Any:
    """Return the data of a YAML file. Raises CalibrationError, with the line: it is cut, too large, too deep, or has
    anchors, which can make a short file an endless one.
    """
    text = read_text(path, MOST_BYTES, CalibrationError)
    depth = 0
    try:
        # Events are read one by one: nothing is built before the whole was looked at.
        for event in yaml.parse(text, _Loader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > MOST_DEPTH or isinstance(event, yaml.AliasEvent):
                mark: Any = event.start_mark
                message = f"{path}: expected YAML without anchors, and maps not deep in each other, found otherwise"
                raise CalibrationError(f"{message} at line {mark.line + 1}; export it again")
        _require_single_keys(yaml.compose(text, _Loader), path)
        return yaml.load(text, _Loader)  # noqa: S506 - a safe loader
    except (yaml.YAMLError, ValueError) as cause:
        mark = getattr(cause, "problem_mark", None)
        where = "" if mark is None else f" at line {mark.line + 1}"
        what = getattr(cause, "problem", None) or str(cause)
        raise CalibrationError(f"{path}: expected YAML, found {what}{where}; correct it") from cause


def _require_single_keys(node: Any, path: Path) -> None:
    """Refuse a key that is twice in one map: PyYAML would keep the last."""
    if isinstance(node, yaml.MappingNode):
        keys = [str(key.value) for key, _ in node.value]
        if len(set(keys)) < len(keys):
            line = node.start_mark.line + 1
            raise CalibrationError(f"{path}: expected each key once, found one twice in the map at line {line}")
    for part in node.value if isinstance(node, yaml.CollectionNode) else ():
        for each in part if isinstance(part, tuple) else (part,):
            _require_single_keys(each, path)


def yaml_bytes(data: object) -> bytes:
    """A YAML text in the order of the data, lists of numbers in a line; numbers are written so that they read back."""
    text: str = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=2**16, allow_unicode=True)
    return text.encode()


TRANSFORMS = "transforms.yaml"

Side = Annotated[int, Field(ge=1, le=MAX_SIDE_PX)]


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
    info = validate(CameraInfo, read_yaml(path), str(path), error=CalibrationError)
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
    listed = validate(Transforms, read_yaml(path), str(path), error=CalibrationError).transforms
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
    entry = validate(ChainEntry, data, f"{path}: {key}", error=CalibrationError)
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


PAIRS = {
    "scan3d-capture": ("cam_K", "cam_kc", "proj_K", "proj_kc", "R", "T"),
    "SLStudio": ("Kc", "kc", "Kp", "kp", "Rp", "Tp"),
    "procam-calibration": ("cam_int", "cam_dist", "proj_int", "proj_dist", "rotation", "translation"),
    "OpenCV's sample of stereo calibration": ("M1", "D1", "M2", "D2", "R", "T"),
}


def program_of(root: Mapping[str, Value]) -> str | None:
    """Whose file this is; None where it is nobody's of these."""
    return next((program for program, keys in PAIRS.items() if set(keys) <= set(root)), None)


def read_pair(
    root: Mapping[str, Value],
    path: Path,
    *,
    cameras: Mapping[str, Size],
    projector: Size | None,
    shown: Mapping[Axis, Gray],
) -> Calibration:
    """Return the calibration of the first of `cameras`, and of the projector or, with two cameras, of the second.

    shown : a bit of the code of each axis: scan3d-capture counts the projector's pixels in cells of its finest bit.
    Raises CalibrationError: a matrix is missing or of another shape, or the extents are not known.
    """
    program = str(program_of(root))
    found: list[FloatArray] = []
    for key in PAIRS[program]:
        value = root[key]
        if not isinstance(value, np.ndarray):
            raise CalibrationError(
                f"{path}: expected an !!opencv-matrix at {key}, found something else; export it again"
            )
        found.append(value)
    first, first_lens, second, second_lens, rotation, translation = found
    if not cameras or projector is None:
        raise CalibrationError(
            f"{path}: expected a calibration that says the extents of its images, found one of {program}, which does "
            "not; import a capture with it: slrig import --calibration"
        )
    names, sizes = list(cameras), list(cameras.values())
    both_cameras = program.startswith("OpenCV") and len(cameras) == 2
    other = sizes[1] if both_cameras else projector
    if program == "scan3d-capture":
        second = _in_pixels(second, projector, shown)
    try:
        here = Pinhole(
            sizes[0], first, five_distortion_terms(first_lens, path, PAIRS[program][1]), np.eye(3), np.zeros(3)
        )
        lens = five_distortion_terms(second_lens, path, PAIRS[program][3])
        there = Pinhole(other, second, lens, rotation, translation.ravel())
    except CalibrationError as cause:
        raise CalibrationError(f"{path}: {cause}") from cause
    if both_cameras:
        return Calibration({names[0]: here, names[1]: there}, None)
    return Calibration({names[0]: here}, there)


def _in_pixels(matrix: FloatArray, projector: Size, shown: Mapping[Axis, Gray]) -> FloatArray:
    """The matrix of a projector whose pixels are cells of the code, as one of its true pixels.

    With cells of c = 2^k px, cell x of n >> k begins at position c (x + offset of cells) - offset of pixels.
    """
    found = np.array(matrix, dtype=np.float64)
    for row, axis in enumerate(Axis):
        if axis not in shown or found.shape != (3, 3):
            continue
        cell_px, offset_px, bits = shown[axis].cell_px, shown[axis].offset_px, shown[axis].bits
        cells = projector.along(axis) // cell_px
        first_cell = (2**bits - cells) // 2
        found[row] *= cell_px
        found[row, 2] += cell_px * first_cell - offset_px + (cell_px - 1) / 2
    return found


Form = Literal["slrig", "opencv", "ros", "kalibr"]
ENDINGS: Mapping[str, Form] = {".json": "slrig", ".yml": "opencv", ".xml": "opencv"}


def read_any_calibration(
    path: Path,
    *,
    cameras: Mapping[str, Size] | None = None,
    projector: Size | None = None,
    shown: Mapping[Axis, Gray] | None = None,
) -> Calibration:
    """Return the calibration in a file, or in a folder as ROS has it.

    cameras, projector, shown : what some programs' files do not say of the devices: see `read_pair`.
    Raises CalibrationError: it is of no kind that is known, or wrong.
    """
    if path.is_dir():
        return read_ros(path)
    if path.suffix.lower() not in {".yml", ".yaml", ".xml"}:
        return read_calibration(path)
    text = read_text(path, MAX_STORAGE_BYTES, CalibrationError)
    if not text.removeprefix("\ufeff").startswith(("%YAML", "<")):
        return read_kalibr(path)
    root = read_file_storage(text, path)
    if program_of(root) is None:
        return read_opencv_calibration(path)
    return read_pair(root, path, cameras=cameras or {}, projector=projector, shown=shown or {})


def write_any_calibration(path: Path, calibration: Calibration, form: Form | None = None) -> None:
    """Write a calibration in one of the forms, by the ending of `path` where none is named; ROS's is a new folder.
    Raises CalibrationError: the ending says none, or the form cannot hold it; StorageError: the disk refused.
    """
    form = form or ENDINGS.get(path.suffix.lower())
    if form is None:
        raise CalibrationError(
            f"{path}: expected a name that ends in .json, .yml or .xml, or --to; found '{path.suffix}'"
        )
    writers = {"slrig": write_calibration, "opencv": write_opencv_calibration, "ros": write_ros, "kalibr": write_kalibr}
    writers[form](path, calibration)

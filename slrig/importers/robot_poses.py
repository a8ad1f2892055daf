"""Poses of a robot's flange in its base, as controllers and ROS write them: CSV, JSON, YAML.

Every file says what its numbers are: names of columns hold unit and convention, and what they leave open is refused.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from slrig.bundle import orthonormalise_pose, read_json, read_text
from slrig.calibration.hand_eye import EulerOrder, RobotPoses
from slrig.errors import CalibrationError
from slrig.importers.documents import read_yaml
from slrig.model import FloatArray

_MAX_BYTES = 2**22
_MAX_POSES = 300
_UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}
_ANGLES: Mapping[tuple[str, str, str], EulerOrder | None] = {
    ("a", "b", "c"): "ZYX",
    ("w", "p", "r"): "xyz",
    ("rx", "ry", "rz"): None,
}
"""Names of three angles and their order as scipy's Rotation has it: those of KUKA, of FANUC, and any other."""
_QUATERNIONS = (("qx", "qy", "qz", "qw"), ("q2", "q3", "q4", "q1"))
"""Names of x, y, z, w: the second are ABB's."""
ORDERS = ("rotvec", *get_args(EulerOrder))
"""What rx, ry, rz may be: a rotation vector, or angles in an order."""
_FORMS = (
    "give x_mm, y_mm, z_mm (or _m) and qx, qy, qz, qw; or rx_deg, ry_deg, rz_deg (or _rad) with --rotation; or a_deg, "
    "b_deg, c_deg (KUKA); w_deg, p_deg, r_deg (FANUC); q1, q2, q3, q4 (ABB); or in JSON matrix_mm, 4 x 4"
)


def read_robot_poses(path: Path, rotation: str | None = None) -> RobotPoses:
    """The poses in a file, in its order; those without a name are called by their number from 1.

    rotation : of rx, ry, rz, one of `ORDERS`.

    Raises CalibrationError if the file cannot be read, or leaves open what its numbers are.
    """
    rows = _rows(path)
    if not 1 <= len(rows) <= _MAX_POSES:
        message = f"{path}: expected 1 to {_MAX_POSES} poses, found {len(rows)}"
        raise CalibrationError(message)
    names = tuple(str(row.get("name", number)) for number, row in enumerate(rows, 1))
    if len(set(names)) < len(names):
        message = f"{path}: expected a name for each pose, found {next(n for n in names if names.count(n) > 1)!r} twice"
        raise CalibrationError(message)
    poses = np.stack([_pose(row, f"{path}, pose '{name}'", rotation) for name, row in zip(names, rows, strict=True)])
    angles = [
        order or rotation for keys, order in _ANGLES.items() if {f"{keys[0]}_deg", f"{keys[0]}_rad"} & set(rows[0])
    ]
    return RobotPoses(names, poses, next((cast("EulerOrder", order) for order in angles if order != "rotvec"), None))


def _rows(path: Path) -> list[Mapping[str, Any]]:
    if path.suffix.lower() in (".yml", ".yaml"):
        documents = read_yaml(path, several=True)
        found = documents[0] if len(documents) == 1 else documents
    else:
        text = read_text(path, _MAX_BYTES, CalibrationError)
        if path.suffix.lower() == ".json":
            found = read_json(text, path, CalibrationError)
        else:
            rows = list(csv.reader(io.StringIO(text.lstrip("\ufeff")), skipinitialspace=True))
            rows = [[cell.strip() for cell in row] for row in rows if row and not row[0].startswith("#")]
            head = [cell.lower() for cell in rows[0]] if rows else []
            uneven = next((row for row in rows if len(row) != len(head)), None)
            if not head or uneven is not None or len(set(head)) < len(head) or _is_number(head[0]):
                found_there = "nothing" if not head else str(uneven or head)
                message = f"{path}: expected a line of names, and rows as long, found {found_there}: {_FORMS}"
                raise CalibrationError(message)
            found = [dict(zip(head, row, strict=True)) for row in rows[1:]]
    if isinstance(found, Mapping):
        found = found.get("poses", found.get("views", [found]))
    if not isinstance(found, Sequence) or not all(isinstance(row, Mapping) for row in found):
        message = f"{path}: expected a list of poses, each with names for its numbers: {_FORMS}"
        raise CalibrationError(message)
    return list(found)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _pose(row: Mapping[str, Any], where: str, rotation: str | None) -> FloatArray:
    """(4, 4) of a row. A message of ROS is in metres."""
    for place, turn in (("position", "orientation"), ("translation", "rotation")):
        message = next((each for each in (row, row.get("pose"), row.get("transform")) if _has(each, place, turn)), None)
        if message is not None:
            row = {f"{axis}_m": value for axis, value in message[place].items()}
            row |= {f"q{axis}": value for axis, value in message[turn].items()}
    pose = np.eye(4)
    for key, factor in (("matrix_mm", 1.0), ("matrix_m", 1000.0), ("pose", 1.0)):
        if key in row:
            matrix = _numbers(row[key], (4, 4), f"{where}: {key}")
            # Rounded numbers are made a rotation again, others are refused where they are used.
            axes = matrix[:3, :3]
            pose = orthonormalise_pose(matrix.tolist()) if np.allclose(axes @ axes.T, np.eye(3), atol=0.01) else matrix
            pose[:3, 3] *= factor
            return pose
    for unit, factor in _UNITS.items():
        if f"x_{unit}" in row:
            pose[:3, 3] = factor * _numbers([row.get(f"{axis}_{unit}") for axis in "xyz"], (3,), f"{where}: position")
            break
    else:
        message = f"{where}: expected a position with its unit, found {', '.join(map(str, row))}: {_FORMS}"
        raise CalibrationError(message)
    pose[:3, :3] = _rotation(row, where, rotation).as_matrix()
    return pose


def _has(found: object, place: str, turn: str) -> bool:
    return isinstance(found, Mapping) and all(isinstance(found.get(key), Mapping) for key in (place, turn))


def _rotation(row: Mapping[str, Any], where: str, rotation: str | None) -> Rotation:
    for names in _QUATERNIONS:
        if names[0] in row:
            numbers = _numbers([row.get(name) for name in names], (4,), f"{where}: quaternion")
            if not abs(float(np.linalg.norm(numbers)) - 1) < 0.01:
                message = f"{where}: expected a quaternion of length 1, found {numbers.tolist()}"
                raise CalibrationError(message)
            return Rotation.from_quat(numbers)
    for keys, usual in _ANGLES.items():
        for unit, factor in (("deg", np.pi / 180), ("rad", 1.0)):
            if f"{keys[0]}_{unit}" not in row:
                continue
            angles = factor * _numbers([row.get(f"{key}_{unit}") for key in keys], (3,), f"{where}: angles")
            order = usual or cast("EulerOrder | Literal['rotvec'] | None", rotation)
            if order is None:
                message = (
                    f"{where}: {', '.join(keys)} may be a rotation vector (Universal Robots) or angles in many orders: "
                    f"say which by --rotation, one of {', '.join(ORDERS)}; capitals turn about axes that turn along"
                )
                raise CalibrationError(message)
            return Rotation.from_rotvec(angles) if order == "rotvec" else Rotation.from_euler(order, angles)
    message = f"{where}: expected a rotation with its convention, found {', '.join(map(str, row))}: {_FORMS}"
    raise CalibrationError(message)


def _numbers(found: Any, shape: tuple[int, ...], where: str) -> FloatArray:
    try:
        numbers = np.array(found, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.full(1, np.nan)
    if numbers.shape != shape or not np.isfinite(numbers).all() or np.abs(numbers).max() > 1e6:
        message = f"{where}: expected {' x '.join(map(str, shape))} numbers, found {str(found)[:120]}"
        raise CalibrationError(message)
    return numbers

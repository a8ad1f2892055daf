"""A calibration in whatever form it comes: slrig's, OpenCV's, ROS's, Kalibr's, or that of a scanning program."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from slrig.bundle.calibration import (
    MOST_FILE_BYTES,
    read_calibration,
    read_file_storage,
    read_opencv_calibration,
    write_calibration,
    write_opencv_calibration,
)
from slrig.bundle.validation import read_text
from slrig.errors import CalibrationError
from slrig.foreign.kalibr import read_kalibr, write_kalibr
from slrig.foreign.pairs import program_of, read_pair
from slrig.foreign.ros import read_ros, write_ros
from slrig.model import Axis, Calibration, Gray, Size

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
    text = read_text(path, MOST_FILE_BYTES, CalibrationError)
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

"""What calibrations lose in the formats of other programs, and empty ones to fill by hand."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slrig.bundle import json_bytes, write_file
from slrig.errors import CalibrationError
from slrig.importers.calibrations import FORMAT_BY_SUFFIX, CalibrationFormat
from slrig.model import Calibration

_YAML_HEAD = """%YAML:1.0
---
# A calibration for slrig in OpenCV's form. Replace each .Nan. All matrices are 3 x 3, row by row.
# camera_matrix: fx 0 cx, 0 fy cy, 0 0 1 in pixels; the centre of the top left pixel is (0, 0).
# distortion_coefficients: k1 k2 p1 p2 k3 in OpenCV's order; 0 for what is not known.
# rotation R, translation_mm t, in millimetres: a point X of the world has the device's coordinates R X + t.
# The world here is the frame of the first camera: x right, y down, z forward. The projector is an inverse camera.
"""
_YAML_DEVICE = """{name}:
   image_width: .Nan
   image_height: .Nan
   camera_matrix: !!opencv-matrix
      rows: 3
      cols: 3
      dt: d
      data: [ .Nan, 0., .Nan,
          0., .Nan, .Nan,
          0., 0., 1. ]
   distortion_coefficients: !!opencv-matrix
      rows: 5
      cols: 1
      dt: d
      data: [ .Nan, .Nan, .Nan, .Nan, .Nan ]
   rotation: !!opencv-matrix
      rows: 3
      cols: 3
      dt: d
      data: [ {rotation} ]
   translation_mm: !!opencv-matrix
      rows: 3
      cols: 1
      dt: d
      data: [ {translation} ]
"""


def lost_in_format(calibration: Calibration, path: Path, form: CalibrationFormat | None = None) -> list[str]:
    """Return what a file of this format, or of the suffix of `path`, cannot hold of a calibration, in words."""
    form = form or FORMAT_BY_SUFFIX.get(path.suffix.lower())
    lost = []
    if calibration.light is not None and form != "slrig":
        lost.append("the projector's light over its image")
    if calibration.solved is not None and form in ("ros", "kalibr"):
        lost.append("identity, date and error of the solve")
    name, first = next(iter(calibration.cameras.items()))
    if form == "kalibr" and (first.translation_mm.any() or not np.array_equal(first.rotation, np.eye(3))):
        lost.append(f"the world, which becomes the frame of {name}")
    return lost


def write_template(path: Path, cameras: Sequence[str]) -> None:
    """Write a calibration without numbers, explained, for some cameras and the projector, as slrig's .json or OpenCV's
    .yml. Raises CalibrationError: another suffix; StorageError.
    """
    match path.suffix.lower():
        case ".json":
            data = _json_template(cameras)
        case ".yml":
            data = _yaml_template(cameras)
        case suffix:
            raise CalibrationError(f"{path}: expected a name that ends in .json or .yml, found '{suffix}'; rename it")
    write_file(path, data)


def _json_template(cameras: Sequence[str]) -> bytes:
    """Return JSON whose values are texts that tell what belongs there: JSON has no comments."""
    lens = {
        "size_px": "fill in: [columns, rows]",
        "matrix": "fill in: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], pixels; the centre of the top left pixel is (0, 0)",
        "distortion": "fill in: [k1, k2, p1, p2, k3] in OpenCV's order; 0 for what is not known",
    }
    pose = {
        "rotation": "fill in: R, 3 x 3 by rows; a point X of the world has the coordinates R X + t here. The world is "
        "the frame of the first camera: x right, y down, z forward",
        "translation_mm": "fill in: t, [x, y, z] in millimetres",
    }
    world = {"rotation": np.eye(3).tolist(), "translation_mm": [0.0, 0.0, 0.0]}
    devices = {name: lens | (pose if number else world) for number, name in enumerate(cameras)}
    return json_bytes({"format": "slrig-calibration", "version": 1, "cameras": devices, "projector": lens | pose})


def _yaml_template(cameras: Sequence[str]) -> bytes:
    empty = ", ".join([".Nan"] * 9), ", ".join([".Nan"] * 3)
    known = "1., 0., 0., 0., 1., 0., 0., 0., 1.", "0., 0., 0."
    blocks = [
        _YAML_DEVICE.format(name=name, rotation=rotation, translation=translation)
        for name, (rotation, translation) in zip((*cameras, "projector"), (known, *[empty] * len(cameras)), strict=True)
    ]
    return "".join((_YAML_HEAD, *blocks)).encode()

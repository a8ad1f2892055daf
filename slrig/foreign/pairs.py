"""Calibrations of a camera and a projector as one OpenCV FileStorage file with two lenses and one pose.

The first device's frame is the world; R and T take points from it to the second device, in the unit of the board, which
is taken for millimetres. Most of these files say no extent: it is that of the images, and of the projector.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from slrig.bundle.calibration import Value, five_terms
from slrig.errors import CalibrationError
from slrig.model import Axis, Calibration, FloatArray, Gray, Pinhole, Size

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
        here = Pinhole(sizes[0], first, five_terms(first_lens, path, PAIRS[program][1]), np.eye(3), np.zeros(3))
        lens = five_terms(second_lens, path, PAIRS[program][3])
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

"""Frozen values that the rooms exchange, checked once, on construction.

Conventions: arrays are (row, column); extents only as `Size`; pixel centres at integer coordinates (OpenCV);
world to device `X_dev = R @ X_world + t_mm`; millimetres; unmeasured is NaN.
"""

from slrig.model.arrays import FloatArray, IntArray, Pixels
from slrig.model.frames import (
    FEWEST_EXPOSURES,
    MOST_EXPOSURES,
    CameraFormat,
    Capture,
    Frame,
    Shot,
    bracket_fault,
    exposure_groups,
)
from slrig.model.light_axis import LEAST_SHARE, share_across, told_depth, triangulated_axis
from slrig.model.missing_bits import without_missing_bits
from slrig.model.patterns import (
    Black,
    Gray,
    LineShift,
    Pattern,
    PatternSequence,
    Primary,
    SequenceName,
    White,
    coarse_bits,
    divides_period,
    telling_bits,
    telling_lines,
)
from slrig.model.region import Region
from slrig.model.rig import DEVICE_PARAMETERS, Axis, Calibration, LightMap, Pinhole, Size, Solved
from slrig.model.stage import MeasuredAxis, PlaneKind, StageAxis, StagePlane
from slrig.model.surfaces import (
    AlbedoMark,
    CameraTruth,
    FlipRule,
    Mesh,
    PointCurves,
    Refusal,
    Source,
    Surface,
    Truth,
)

__all__ = [
    "DEVICE_PARAMETERS",
    "FEWEST_EXPOSURES",
    "LEAST_SHARE",
    "MOST_EXPOSURES",
    "AlbedoMark",
    "Axis",
    "Black",
    "Calibration",
    "CameraFormat",
    "CameraTruth",
    "Capture",
    "FlipRule",
    "FloatArray",
    "Frame",
    "Gray",
    "IntArray",
    "LightMap",
    "LineShift",
    "MeasuredAxis",
    "Mesh",
    "Pattern",
    "PatternSequence",
    "Pinhole",
    "Pixels",
    "PlaneKind",
    "PointCurves",
    "Primary",
    "Refusal",
    "Region",
    "SequenceName",
    "Shot",
    "Size",
    "Solved",
    "Source",
    "StageAxis",
    "StagePlane",
    "Surface",
    "Truth",
    "White",
    "bracket_fault",
    "coarse_bits",
    "divides_period",
    "exposure_groups",
    "share_across",
    "telling_bits",
    "telling_lines",
    "told_depth",
    "triangulated_axis",
    "without_missing_bits",
]

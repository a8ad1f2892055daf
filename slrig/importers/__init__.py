"""Conversion of captures and calibrations from and to the formats of other programs. Only the command line uses it."""

from slrig.importers.calibrations import import_calibration, write_any_calibration
from slrig.importers.captures import ImageNaming, ProjectorCode, import_capture, parse_size

__all__ = [
    "ImageNaming",
    "ProjectorCode",
    "import_calibration",
    "import_capture",
    "parse_size",
    "write_any_calibration",
]

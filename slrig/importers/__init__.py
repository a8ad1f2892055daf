"""Conversion of captures and calibrations from and to the formats of other programs. Only the command line uses it."""

from slrig.importers.calibrations import import_calibration, write_any_calibration
from slrig.importers.captures import ImageNaming, ProjectorCode, import_capture, parse_size
from slrig.importers.exports import lost_in_format, write_template

__all__ = [
    "ImageNaming",
    "ProjectorCode",
    "import_calibration",
    "import_capture",
    "lost_in_format",
    "parse_size",
    "write_any_calibration",
    "write_template",
]

"""Conversion of captures and calibrations from and to the formats of other programs. Only the command line uses it."""

from slrig.importers.calibrations import import_calibration, write_any_calibration
from slrig.importers.captures import ImageNaming, assign_images, import_capture, parse_size, write_list
from slrig.importers.exports import lost_in_format, write_template
from slrig.importers.folders import UnderstoodFolder, write_contact_sheet
from slrig.importers.orders import ProjectorCode
from slrig.importers.robot_poses import read_robot_poses

__all__ = [
    "ImageNaming",
    "ProjectorCode",
    "UnderstoodFolder",
    "assign_images",
    "import_calibration",
    "import_capture",
    "lost_in_format",
    "parse_size",
    "read_robot_poses",
    "write_any_calibration",
    "write_contact_sheet",
    "write_list",
    "write_template",
]

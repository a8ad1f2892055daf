"""Luxonis OAK cameras through DepthAI: one camera, or several of one device, exposed together. Extra: `depthai`."""

from drivers.depthai.calibration import FactoryCalibration, Lens, read_calibration, read_factory_calibration
from drivers.depthai.camera import OakCamera, open_camera
from drivers.depthai.device import find_devices
from drivers.depthai.library import OakOptions

__all__ = [
    "FactoryCalibration",
    "Lens",
    "OakCamera",
    "OakOptions",
    "find_devices",
    "open_camera",
    "read_calibration",
    "read_factory_calibration",
]

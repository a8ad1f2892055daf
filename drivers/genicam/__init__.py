"""Cameras that speak GenICam, GigE Vision or USB3 Vision, through Aravis. Extra: `genicam`.

Tried on a GigE Vision camera over loopback. USB3 Vision goes the same way through Aravis, and was not tried.
"""

from drivers.genicam.camera import GenicamCamera, open_camera
from drivers.genicam.finder import find_devices
from drivers.genicam.options import GenicamOptions

__all__ = ["GenicamCamera", "GenicamOptions", "find_devices", "open_camera"]

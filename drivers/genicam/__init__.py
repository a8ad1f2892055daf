"""Cameras that speak GenICam, through one of two libraries.

`genicam`: GigE Vision and USB3 Vision through Aravis; extra `genicam`. Tested with a GigE Vision camera over loopback;
USB3 Vision takes the same path through Aravis and is untested.

`gentl`: cameras behind a vendor's GenTL producer (GigE Vision, USB3 Vision, CoaXPress, Camera Link and others) through
harvesters; extra `gentl`. Tested with our own producer.
"""

from drivers.genicam.aravis import find_devices
from drivers.genicam.camera import GenicamCamera, open_camera, open_gentl_camera
from drivers.genicam.connection import GenicamOptions, GentlOptions
from drivers.genicam.gentl import find_gentl_devices

__all__ = [
    "GenicamCamera",
    "GenicamOptions",
    "GentlOptions",
    "find_devices",
    "find_gentl_devices",
    "open_camera",
    "open_gentl_camera",
]

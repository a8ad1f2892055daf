"""Cameras of a Raspberry Pi, through libcamera's Python library picamera2.

Extra `picamera2`, over the system's `python3-libcamera`. Read only: written from the code of picamera2 0.3.38 and
libcamera's documents, and tried on a stand-in that behaves as these say; no Raspberry Pi was at hand.

- https://github.com/raspberrypi/picamera2 (`Picamera2`, `CompletedRequest`, `Job`)
- https://libcamera.org/api-html/namespacelibcamera_1_1controls.html (controls and metadata)
"""

from drivers.picamera2.camera import PiCamera, find_devices, open_camera
from drivers.picamera2.options import PiCameraOptions

__all__ = ["PiCamera", "PiCameraOptions", "find_devices", "open_camera"]

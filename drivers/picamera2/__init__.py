"""Cameras of a Raspberry Pi, through libcamera's Python library picamera2.

Needs the extra `picamera2` and the system's `python3-libcamera`. Written from the code of picamera2 0.3.38 and
libcamera's documentation, and tested with a stand-in for the library, not yet on a Raspberry Pi.

- https://github.com/raspberrypi/picamera2 (`Picamera2`, `CompletedRequest`, `Job`)
- https://www.raspberrypi.com/documentation/accessories/camera.html (external trigger of the GS camera)
- https://libcamera.org/api-html/namespacelibcamera_1_1controls.html (controls and metadata)
"""

from drivers.picamera2.camera import PiCamera, PiCameraOptions, find_devices, open_camera

__all__ = ["PiCamera", "PiCameraOptions", "find_devices", "open_camera"]

"""What slrig asks of a camera, a projector and a rig: protocols and the values they exchange."""

from slrig.devices.camera import AppliedSettings, Camera, CameraInfo, CameraSettings, Trigger
from slrig.devices.projector import Projector, ProjectorInfo, Shown
from slrig.devices.rig import FoundDevice, Head, Rig

__all__ = [
    "AppliedSettings",
    "Camera",
    "CameraInfo",
    "CameraSettings",
    "FoundDevice",
    "Head",
    "Projector",
    "ProjectorInfo",
    "Rig",
    "Shown",
    "Trigger",
]

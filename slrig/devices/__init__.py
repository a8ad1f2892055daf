"""What slrig asks of a camera, a projector and a rig: protocols and the values they exchange."""

from slrig.devices.camera import AppliedSettings, Camera, CameraInfo, CameraSettings, Trigger
from slrig.devices.camera_state import CameraState
from slrig.devices.clock import Clock, KeepsTime, SystemClock
from slrig.devices.limits import COMPUTED, USUAL, CallLimits, progress_heard, progress_reporter
from slrig.devices.positioner import Positioner, Positions
from slrig.devices.projector import Projector, ProjectorInfo, Shown
from slrig.devices.projector_state import ProjectorState
from slrig.devices.rig import FoundDevice, Head, Rig, Synchronisation

__all__ = [
    "COMPUTED",
    "USUAL",
    "AppliedSettings",
    "CallLimits",
    "Camera",
    "CameraInfo",
    "CameraSettings",
    "CameraState",
    "Clock",
    "FoundDevice",
    "Head",
    "KeepsTime",
    "Positioner",
    "Positions",
    "Projector",
    "ProjectorInfo",
    "ProjectorState",
    "Rig",
    "Shown",
    "Synchronisation",
    "SystemClock",
    "Trigger",
    "progress_heard",
    "progress_reporter",
]

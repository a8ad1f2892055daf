"""Protocols of camera, projector, positioner and rig, and the values that they exchange."""

from slrig.devices.camera import AppliedSettings, Camera, CameraInfo, CameraSettings, CameraState, Trigger
from slrig.devices.clock import Clock, KeepsTime, SystemClock
from slrig.devices.limits import COMPUTED, USUAL, CallLimits, progress_heard, progress_reporter
from slrig.devices.positioner import AnyAngle, Positioner, Positions, Turntable
from slrig.devices.projector import FlashedProjector, Projector, ProjectorInfo, ProjectorState, Shown, UnprovenLight
from slrig.devices.rig import FoundDevice, Head, Rig, Synchronisation

__all__ = [
    "COMPUTED",
    "USUAL",
    "AnyAngle",
    "AppliedSettings",
    "CallLimits",
    "Camera",
    "CameraInfo",
    "CameraSettings",
    "CameraState",
    "Clock",
    "FlashedProjector",
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
    "Turntable",
    "UnprovenLight",
    "progress_heard",
    "progress_reporter",
]

"""Poses of a board: acceptance of each, coverage by all, and advice on the next one."""

from slrig.calibration.poses.checks import check_pose, check_same_devices, draw_coverage, draw_pose
from slrig.calibration.poses.guidance import Advice, Coverage, advise_pose, attitude, coverage, describe_place
from slrig.calibration.poses.initial import estimate_rig, projector_view

__all__ = [
    "Advice",
    "Coverage",
    "advise_pose",
    "attitude",
    "check_pose",
    "check_same_devices",
    "coverage",
    "describe_place",
    "draw_coverage",
    "draw_pose",
    "estimate_rig",
    "projector_view",
]

"""Several meshes of one object: registration, markers, turntable, fusion."""

from slrig.multiview.fusion import FusedModel, PoseErrors, concatenate_views, fuse_views
from slrig.multiview.markers import MarkerFit, MarkerObservation, MarkerObservations, marker_poses
from slrig.multiview.registration import Registration, register_views
from slrig.multiview.turntable import (
    MIN_POSES,
    BoardAxis,
    TurntableAxis,
    axis_from_board,
    cut_view,
    find_turntable_planes,
    fit_plane,
    register_on_turntable,
)
from slrig.multiview.unknown_poses import find_start_poses

__all__ = [
    "MIN_POSES",
    "BoardAxis",
    "FusedModel",
    "MarkerFit",
    "MarkerObservation",
    "MarkerObservations",
    "PoseErrors",
    "Registration",
    "TurntableAxis",
    "axis_from_board",
    "concatenate_views",
    "cut_view",
    "find_start_poses",
    "find_turntable_planes",
    "fit_plane",
    "fuse_views",
    "marker_poses",
    "register_on_turntable",
    "register_views",
]

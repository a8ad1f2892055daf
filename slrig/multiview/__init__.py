"""Several meshes of one object: registration, markers, turntable, fusion."""

from slrig.multiview.fusion import (
    FusedModel,
    fused,
    put_together,
    registered_poses,
)
from slrig.multiview.markers import (
    MarkerFit,
    MarkersSeen,
    SeenMarker,
    marker_poses,
)
from slrig.multiview.registration import (
    Registration,
    registered,
)
from slrig.multiview.turntable import (
    FAR_MM,
    MOST_SIGMAS,
    BoardAxis,
    FoundAxis,
    Noted,
    board_axis,
    cut,
    fitted_plane,
    noted,
    registered_on_stage,
    stage_planes,
)
from slrig.multiview.unknown_poses import (
    found_starts,
)

__all__ = [
    "FAR_MM",
    "MOST_SIGMAS",
    "BoardAxis",
    "FoundAxis",
    "FusedModel",
    "MarkerFit",
    "MarkersSeen",
    "Noted",
    "Registration",
    "SeenMarker",
    "board_axis",
    "cut",
    "fitted_plane",
    "found_starts",
    "fused",
    "marker_poses",
    "noted",
    "put_together",
    "registered",
    "registered_on_stage",
    "registered_poses",
    "stage_planes",
]

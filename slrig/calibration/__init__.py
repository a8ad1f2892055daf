"""The mathematics of calibration: boards, poses, the solve, its accuracy, drift.

What loads no compiled kernel is exported here. `accuracy`, `judgement` and `printing` load OpenCV, and the packages
`detection`, `health`, `poses` and `solving` export their own: light code imports none of these.
"""

from slrig.calibration.artefacts import (
    MAX_REJECTED_FRACTION,
    ArtefactPoints,
    Decision,
    FittedPlane,
    FittedSphere,
    decide,
    dispersion_mm,
    find_balls,
    find_plane,
    fit_plane,
    fit_sphere,
)
from slrig.calibration.board import (
    COLUMN,
    DEFAULT_BOARD,
    PRINT_SIGMA,
    ROW,
    Board,
    BoardKind,
    BoardShape,
    BoardView,
    Correspondences,
    Observations,
    PoseObservation,
    ViewQuality,
)
from slrig.calibration.solution import (
    CELLS,
    MIN_HALVED_POSES,
    PARAMETERS,
    PROJECTOR,
    BoardPose,
    DeviceResiduals,
    ExpectedError,
    Solution,
    device_title,
)

__all__ = [
    "CELLS",
    "COLUMN",
    "DEFAULT_BOARD",
    "MAX_REJECTED_FRACTION",
    "MIN_HALVED_POSES",
    "PARAMETERS",
    "PRINT_SIGMA",
    "PROJECTOR",
    "ROW",
    "ArtefactPoints",
    "Board",
    "BoardKind",
    "BoardPose",
    "BoardShape",
    "BoardView",
    "Correspondences",
    "Decision",
    "DeviceResiduals",
    "ExpectedError",
    "FittedPlane",
    "FittedSphere",
    "Observations",
    "PoseObservation",
    "Solution",
    "ViewQuality",
    "decide",
    "device_title",
    "dispersion_mm",
    "find_balls",
    "find_plane",
    "fit_plane",
    "fit_sphere",
]

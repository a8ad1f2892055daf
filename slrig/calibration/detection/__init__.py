"""Detection of calibration boards and markers in images."""

from slrig.calibration.detection.corners import (
    MAX_SIGMA_PX,
    SIGMA_FLOOR_PX,
    GreyImage,
    PointFit,
    fit_corners,
    patch_offsets,
)
from slrig.calibration.detection.detection import (
    board_mask,
    find_board,
    interior_mask,
    measure_blur_px,
    paper_mask,
    refine_view,
)
from slrig.calibration.detection.diagnosis import detect_markers

__all__ = [
    "MAX_SIGMA_PX",
    "SIGMA_FLOOR_PX",
    "GreyImage",
    "PointFit",
    "board_mask",
    "detect_markers",
    "find_board",
    "fit_corners",
    "interior_mask",
    "measure_blur_px",
    "paper_mask",
    "patch_offsets",
    "refine_view",
]

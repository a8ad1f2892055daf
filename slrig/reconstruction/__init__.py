"""From camera frames to curves in space.

`pipeline` runs the steps of one camera: noise, decoding, stripes, refinement, identification and links. Then follow
`triangulation`, comparison (`redundancy`) and `merging` of cameras, and `uncertainty`. `fusion` comes before for
several exposures, `albedo` after.
"""

from slrig.reconstruction.albedo import (
    BRIGHT_ALBEDO,
    BRIGHT_PERCENT,
    Albedo,
    AlbedoSamples,
    Illumination,
    estimate_albedo,
)
from slrig.reconstruction.calibration_check import (
    CalibrationCheck,
    CalibrationFit,
    PixelPairs,
    check_calibration,
    disagreement_px,
    find_correspondences,
    find_cross_line_pairs,
    share_in_front,
)
from slrig.reconstruction.camera_response import estimate_noise
from slrig.reconstruction.correspondence import CorrespondenceLimits, ProjectorPositions, projector_positions
from slrig.reconstruction.decoded_image import CodeTables, ReconstructionLimits
from slrig.reconstruction.decoding import DecodingLimits, RegionMask, decode_edges, lit_pixels
from slrig.reconstruction.frames import (
    NEAR_SATURATION,
    AxisFrames,
    AxisPatterns,
    FrameStacks,
    Image,
    axis_frames,
    axis_patterns,
    exposure_count,
    linearise,
    mean_image,
    reference_repeats,
    sample_format,
    used_frames,
    used_shots,
)
from slrig.reconstruction.fusion import ExposureUse, FusedFrames, exposure_use, fuse_colour, fuse_exposures
from slrig.reconstruction.identification import StripeEnsemble
from slrig.reconstruction.merging import (
    MergedCurves,
    merge_curves,
)
from slrig.reconstruction.phase import has_phase, position_map
from slrig.reconstruction.pipeline import CameraCurves, CameraStream, camera_curves
from slrig.reconstruction.pose_refinement import MAX_SHIFT, MAX_TURN_DEG, RefinedPose, refine_pose
from slrig.reconstruction.redundancy import (
    OUTLIER_SIGMA,
    PairRedundancy,
    Redundancy,
    StripeResiduals,
    cell_medians,
    cell_numbers,
    evaluate_redundancy,
    noise_px,
    sheet_coordinates,
)
from slrig.reconstruction.second_axis import AxisPositions, axis_residuals, decode_second_axis
from slrig.reconstruction.triangulation import (
    CONVERGED,
    SheetCurves,
    distorted_from_pixel,
    intersect_light_sheets,
    optical_depths_mm,
    pack_device,
    pixel_rays,
    project,
    select_points,
    stripe_crossing,
    triangulate_camera_pair,
    triangulate_camera_projector,
)
from slrig.reconstruction.uncertainty import (
    calibration_modes,
    calibration_sigma,
    sampling_mm,
    sigma_along_normal,
    stripe_tangents,
)

__all__ = [
    "BRIGHT_ALBEDO",
    "BRIGHT_PERCENT",
    "CONVERGED",
    "MAX_SHIFT",
    "MAX_TURN_DEG",
    "NEAR_SATURATION",
    "OUTLIER_SIGMA",
    "Albedo",
    "AlbedoSamples",
    "AxisFrames",
    "AxisPatterns",
    "AxisPositions",
    "CalibrationCheck",
    "CalibrationFit",
    "CameraCurves",
    "CameraStream",
    "CodeTables",
    "CorrespondenceLimits",
    "DecodingLimits",
    "ExposureUse",
    "FrameStacks",
    "FusedFrames",
    "Illumination",
    "Image",
    "MergedCurves",
    "PairRedundancy",
    "PixelPairs",
    "ProjectorPositions",
    "ReconstructionLimits",
    "Redundancy",
    "RefinedPose",
    "RegionMask",
    "SheetCurves",
    "StripeEnsemble",
    "StripeResiduals",
    "axis_frames",
    "axis_patterns",
    "axis_residuals",
    "calibration_modes",
    "calibration_sigma",
    "camera_curves",
    "cell_medians",
    "cell_numbers",
    "check_calibration",
    "decode_edges",
    "decode_second_axis",
    "disagreement_px",
    "distorted_from_pixel",
    "estimate_albedo",
    "estimate_noise",
    "evaluate_redundancy",
    "exposure_count",
    "exposure_use",
    "find_correspondences",
    "find_cross_line_pairs",
    "fuse_colour",
    "fuse_exposures",
    "has_phase",
    "intersect_light_sheets",
    "linearise",
    "lit_pixels",
    "mean_image",
    "merge_curves",
    "noise_px",
    "optical_depths_mm",
    "pack_device",
    "pixel_rays",
    "position_map",
    "project",
    "projector_positions",
    "reference_repeats",
    "refine_pose",
    "sample_format",
    "sampling_mm",
    "select_points",
    "share_in_front",
    "sheet_coordinates",
    "sigma_along_normal",
    "stripe_crossing",
    "stripe_tangents",
    "triangulate_camera_pair",
    "triangulate_camera_projector",
    "used_frames",
    "used_shots",
]

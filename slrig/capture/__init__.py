"""Capture of pattern sequences on a rig, with verification of the frames."""

from slrig.capture.exposure import (
    MIN_CONTRAST_DN,
    MIN_CONTRAST_TO_NOISE,
    ExposureFault,
    ExposureSamples,
    ExposureVerdict,
    bracket_summary,
    check_exposures,
    detect_movement,
    judge_exposure,
    round_to_refresh_s,
)
from slrig.capture.frame_checks import NEAR_SATURATION, NOISE_FLOOR_DN, Contradiction, SampleMask, Samples
from slrig.capture.frame_light import FrameLight
from slrig.capture.frame_order import describe_indices
from slrig.capture.verifier import Evidence, EvidenceSummary, LightFactor, Sampler, checked_frames

__all__ = [
    "MIN_CONTRAST_DN",
    "MIN_CONTRAST_TO_NOISE",
    "NEAR_SATURATION",
    "NOISE_FLOOR_DN",
    "Contradiction",
    "Evidence",
    "EvidenceSummary",
    "ExposureFault",
    "ExposureSamples",
    "ExposureVerdict",
    "FrameLight",
    "LightFactor",
    "SampleMask",
    "Sampler",
    "Samples",
    "bracket_summary",
    "check_exposures",
    "checked_frames",
    "describe_indices",
    "detect_movement",
    "judge_exposure",
    "round_to_refresh_s",
]

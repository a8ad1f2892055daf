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
from slrig.capture.latency import (
    DEFAULT_SEARCH_S,
    DEFAULT_TRIALS,
    STEADY_TOLERANCE,
    CameraLatency,
    LatencyMeasurement,
    measure_latency,
    stable_from_ns,
)
from slrig.capture.pulses import measure_trigger_period
from slrig.capture.sequencer import capture, choose_triggers
from slrig.capture.streaming import earliest_change_s
from slrig.capture.triggering import SETTINGS_TOLERANCE, differs_from_request
from slrig.capture.verifier import Evidence, EvidenceSummary, LightFactor, Sampler, checked_frames

__all__ = [
    "DEFAULT_SEARCH_S",
    "DEFAULT_TRIALS",
    "MIN_CONTRAST_DN",
    "MIN_CONTRAST_TO_NOISE",
    "NEAR_SATURATION",
    "NOISE_FLOOR_DN",
    "SETTINGS_TOLERANCE",
    "STEADY_TOLERANCE",
    "CameraLatency",
    "Contradiction",
    "Evidence",
    "EvidenceSummary",
    "ExposureFault",
    "ExposureSamples",
    "ExposureVerdict",
    "FrameLight",
    "LatencyMeasurement",
    "LightFactor",
    "SampleMask",
    "Sampler",
    "Samples",
    "bracket_summary",
    "capture",
    "check_exposures",
    "checked_frames",
    "choose_triggers",
    "describe_indices",
    "detect_movement",
    "differs_from_request",
    "earliest_change_s",
    "judge_exposure",
    "measure_latency",
    "measure_trigger_period",
    "round_to_refresh_s",
    "stable_from_ns",
]

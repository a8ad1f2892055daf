"""Playing a pattern sequence on a rig and taking the frames that show it."""

from slrig.capture.exposure import (
    LEAST_CLEAR,
    LEAST_CLEAR_DN,
    ExposedSamples,
    Unfit,
    Verdict,
    bracket_summary,
    check_exposures,
    movement_between,
    verdict,
    whole_refreshes_s,
)
from slrig.capture.frame_checks import (
    NEARLY_FULL,
    NOISE_FLOOR_DN,
    Chosen,
    Samples,
)
from slrig.capture.hardware_trigger import (
    SETTINGS_TOLERANCE,
    differ,
)
from slrig.capture.latency import (
    STEADY,
    USUAL_SEARCH_S,
    CameraLatency,
    LatencyMeasurement,
    measure_latency,
    stable_from_ns,
)
from slrig.capture.sequencer import (
    capture,
    choose_triggers,
)
from slrig.capture.streaming import (
    earliest_change_s,
)
from slrig.capture.verifier import (
    Evidence,
    EvidenceSummary,
    Sampler,
    judged_frames,
)

__all__ = [
    "LEAST_CLEAR",
    "LEAST_CLEAR_DN",
    "NEARLY_FULL",
    "NOISE_FLOOR_DN",
    "SETTINGS_TOLERANCE",
    "STEADY",
    "USUAL_SEARCH_S",
    "CameraLatency",
    "Chosen",
    "Evidence",
    "EvidenceSummary",
    "ExposedSamples",
    "LatencyMeasurement",
    "Sampler",
    "Samples",
    "Unfit",
    "Verdict",
    "bracket_summary",
    "capture",
    "check_exposures",
    "choose_triggers",
    "differ",
    "earliest_change_s",
    "judged_frames",
    "measure_latency",
    "movement_between",
    "stable_from_ns",
    "verdict",
    "whole_refreshes_s",
]

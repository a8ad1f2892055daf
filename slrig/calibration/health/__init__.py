"""Health of a calibration: verifications, detection of changed devices, and the state that follows.

Only values are exported: computations load compiled kernels and are imported from their modules.
"""

from slrig.calibration.health.state import (
    THRESHOLDS,
    DriftEstimate,
    Health,
    HealthState,
    PairFigures,
    Thresholds,
    Verification,
    judge_health,
    scan_error_mm,
    verification_from_document,
    verification_from_scan,
)

__all__ = [
    "THRESHOLDS",
    "DriftEstimate",
    "Health",
    "HealthState",
    "PairFigures",
    "Thresholds",
    "Verification",
    "judge_health",
    "scan_error_mm",
    "verification_from_document",
    "verification_from_scan",
]

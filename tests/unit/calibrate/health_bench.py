"""Looks and records that stand for verifications, without any capture."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

from slrig.calibration.health import DriftEstimate, PairFigures, Verification

START = datetime(2026, 11, 20, 8, 0, tzinfo=UTC)


def a_verification(
    ratio: float = 1.0, *, mean_px: float = 0.01, rms_px: float = 0.05, evidence: float = 0.0
) -> Verification:
    """A look at a board whose expected error is `ratio` times the stated 0.01 mm."""
    cells = [[0.01] * 6 for _ in range(6)]
    pair = PairFigures("left", "projector", 2000, mean_px, rms_px, 0.04, 0.002, cells, cells, [[9] * 6] * 6)
    words = "camera 'left' turned by 0.050 ± 0.004° about its vertical axis"
    drifts = (DriftEstimate("left", "turned", evidence, evidence**0.5, 1.0, words),) if evidence else ()
    remedy = "check the mount of camera 'left', and calibrate again" if evidence else None
    return Verification(
        "board", (pair,), 0.01, 0.006, 0.012, 0.01 * ratio, 0.01, 0.01 * (ratio - 1), evidence**0.5, evidence, drifts,
        None, remedy,
    )  # fmt: skip


def hours(count: float) -> datetime:
    """So many hours after the start."""
    return START + timedelta(hours=count)

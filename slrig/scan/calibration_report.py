"""What a report says of the calibration that a scan was measured by: which, how old, and its part of the error."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.bundle.description import read_description
from slrig.model import Calibration, FloatArray, Solved

_SECONDS_PER_DAY = 86_400.0


def calibration_report(
    calibration: Calibration, bundle: Path, sigma_mm: NDArray[np.float32], share_mm: FloatArray | None, /
) -> dict[str, object]:
    """The report's section on the calibration.

    sigma_mm : (V,), standard deviation of each vertex; share_mm : (V,), the calibration's part of it, None where the
    calibration does not state its error. Then only `id` is known, a digest of its numbers, and `absent` says why.

    `sigma_share` is the calibration's fraction of a vertex's variance, the median. `age_days` counts from the solve to
    the capture, and is null where one of the two instants is not known.
    """
    solved = calibration.solved
    if solved is None or share_mm is None:
        return {
            "id": calibration.digest,
            "solved_at": None,
            "age_days": None,
            "expected_error_mm": None,
            "sigma_share": None,
            "absent": "the calibration says nothing of its own error: it was written by hand, imported, or is exact",
        }
    with np.errstate(invalid="ignore", divide="ignore"):
        share = (share_mm / sigma_mm.astype(np.float64)) ** 2
    known = np.isfinite(share)
    age_days, words = _age(solved, bundle)
    report: dict[str, Any] = {
        "id": solved.id,
        "solved_at": solved.solved_at,
        "age_days": age_days,
        "expected_error_mm": solved.expected_error_mm,
        "sigma_share": float(np.median(share[known])) if known.any() else None,
        "sigma_calibration_mm": float(np.median(share_mm[known])) if known.any() else None,
    }
    return report if words is None else {**report, "age_absent": words}


def _age(solved: Solved, bundle: Path) -> tuple[float | None, str | None]:
    """Days from the solve to the capture, or None with the reason."""
    captured_at = read_description(bundle).captured_at
    if captured_at is None:
        return None, "the bundle does not say when it was captured"
    try:
        solved_at = datetime.fromisoformat(solved.solved_at)
    except ValueError:
        return None, f"the calibration says '{solved.solved_at}' where the date of its solve should be"
    if solved_at.tzinfo is None:
        return None, "the calibration gives the time of its solve without the offset from UTC"
    return round((captured_at - solved_at).total_seconds() / _SECONDS_PER_DAY, 4), None

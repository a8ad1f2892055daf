"""What one verification of a calibration found, as numbers and words that are kept and sent."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class PairFigures:
    """A pair's spare equation in numbers, px of `second`'s image. predicted_px : the rms that noise and the
    calibration's covariance predict; mean_sigma_px : of the mean. Maps are (6, 6) rows over `first`'s image, None where
    nothing was seen.
    """

    first: str
    second: str
    count: int
    mean_px: float
    rms_px: float
    predicted_px: float
    mean_sigma_px: float
    map_mean_px: Sequence[Sequence[float | None]] = ()
    map_rms_px: Sequence[Sequence[float | None]] = ()
    map_count: Sequence[Sequence[int]] = ()


@dataclass(frozen=True, slots=True)
class Drift:
    """One explanation of what is seen. evidence : 2 ln over that of no change; significance : in σ; weight : its
    probability; words : the change with its size.
    """

    device: str
    kind: str
    evidence: float
    significance: float
    weight: float
    words: str


@dataclass(frozen=True, slots=True)
class Verification:
    """What one verification found: numbers and words, JSON values throughout; NaN is None.

    scale_percent, scale_mm : by how much the board measures larger than it is, and that over its diagonal; None of a
    scan. expected_mm : of a point along the viewing ray, now; stated_mm : the same as the calibration states it.
    drift_mm : the change's own part. drifts : likeliest first, nothing where nothing changed. open : what the geometry
    leaves open. remedy : what to do about the first. unseen : devices that nothing was learned of: cameras that did not
    see the board, and the projector if no camera saw its light there.
    """

    kind: str
    pairs: Sequence[PairFigures]
    scale_percent: float | None = None
    scale_sigma_percent: float | None = None
    scale_mm: float | None = None
    expected_mm: float | None = None
    stated_mm: float | None = None
    drift_mm: float | None = None
    significance: float = 0.0
    evidence: float = 0.0
    drifts: Sequence[Drift] = ()
    open: str | None = None
    remedy: str | None = None
    unseen: Sequence[str] = ()

    def document(self) -> dict[str, Any]:
        """As JSON values."""
        return asdict(self)


def verification_from_document(document: Mapping[str, Any], /) -> Verification:
    """The verification that `Verification.document` gave."""
    given = dict(document)
    given["pairs"] = tuple(PairFigures(**each) for each in given["pairs"])
    given["drifts"] = tuple(Drift(**each) for each in given["drifts"])
    # Looks on record from before it was told have none.
    given["unseen"] = tuple(given.get("unseen", ()))
    return Verification(**given)


def health_of_scan(pairs: Sequence[Mapping[str, Any]], /) -> Verification | None:
    """Judge by the redundancy of a scan: `residual_px` of that section of its report; None where it has no pair.

    The spare equation of two cameras tells that a calibration does not hold, and neither which device changed nor by
    how many millimetres a scan is off: the figures for those are None.
    """
    found = tuple(
        PairFigures(
            first=str(pair["reference"]), second=str(pair["camera"]), count=int(pair["pairs"]),
            mean_px=float(pair["mean"]), rms_px=float(pair["rms"]), predicted_px=float(pair["stated_rms"]),
            mean_sigma_px=float(pair["stated_rms"]) / math.sqrt(int(pair["pairs"])),
            map_mean_px=pair["map"]["mean"], map_rms_px=pair["map"]["rms"], map_count=pair["map"]["pairs"],
        )
        for pair in pairs
        if pair["pairs"]
    )  # fmt: skip
    return Verification(kind="scan", pairs=found) if found else None

"""State of a calibration's health, from the verifications since it was made.

The service imports this module; the computations of a verification are in `slrig.calibration.health.verification`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from slrig.calibration.solution import device_title
from slrig.model import SolveRecord

_RECENT = 3
_CHANCE_SIGMAS = 4.0
_AVERAGED = 8  # verifications at the beginning, and at the end, that a trend is estimated from
_MIN_AVERAGED = 4
_MIN_CREEP_PX = 0.02


class HealthState(StrEnum):
    """State of a rig's calibration."""

    UNKNOWN = "unknown"
    GOOD = "good"
    WATCH = "watch"
    STALE = "stale"


_Reasons = list[tuple[HealthState, str]]


@dataclass(frozen=True, slots=True)
class PairFigures:
    """Epipolar residuals of a pair of devices, px in `second`'s image.

    predicted_px : rms predicted by noise and the calibration's covariance; mean_sigma_px : deviation of the mean. Maps
    are (6, 6) rows over `first`'s image, None where nothing was observed.
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
class DriftEstimate:
    """One explanation of the residuals. evidence : 2 ln over that of no change; significance : in σ; weight : its
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
    """Result of one verification, with JSON values throughout; NaN is None.

    scale_percent, scale_mm : excess of the board's measured size over its true one, and that of its diagonal; None for
    a scan. expected_mm : current error of a point along the viewing ray, and stated_mm : after the calibration, both
    without the board's size, which would hide a change (see `scan_error_mm`); drift_mm : from the change alone.
    drifts : likeliest first, empty if nothing changed. open : explanations that the geometry cannot rule out. remedy :
    what to do about the first. unseen : devices without observations: cameras that did not see the board, and the
    projector if no camera saw its light there.
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
    drifts: Sequence[DriftEstimate] = ()
    open: str | None = None
    remedy: str | None = None
    unseen: Sequence[str] = ()

    @property
    def error_ratio(self) -> float | None:
        """The current error over that after the calibration, both without the board's size; None if unknown."""
        return self.expected_mm / self.stated_mm if self.expected_mm is not None and self.stated_mm else None

    def document(self) -> dict[str, Any]:
        """Fields as JSON values."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class Thresholds:
    """Thresholds from which a calibration is to be watched, or is stale.

    mean : mean epipolar residual of a pair, px. rms_ratio : rms residual over that after the calibration. error_ratio :
    expected error over the stated one, for a change with watch_evidence. sure_error_ratio : the same for a change that
    is certain by sure_sigmas. watch_evidence : of a change too small to matter yet (6 is 20 times likelier than none).
    trend_chance : probability below which a creep of the board's measured size, or of a pair's mean, is reported.
    jump_evidence : of a single verification that counts at once (100 is 10 σ), jump_mean_sigmas the same for a pair's
    mean.
    """

    watch_mean_px: float = 0.1
    stale_mean_px: float = 0.3
    watch_rms_ratio: float = 2.0
    stale_rms_ratio: float = 4.0
    watch_error_ratio: float = 1.4
    stale_error_ratio: float = 3.0
    sure_error_ratio: float = 2.0
    sure_sigmas: float = 4.5
    watch_evidence: float = 6.0
    trend_chance: float = 4e-4
    jump_evidence: float = 100.0
    jump_mean_sigmas: float = 10.0


THRESHOLDS = Thresholds()


@dataclass(frozen=True, slots=True)
class Health:
    """State of a rig's calibration, the reasons, and the remedy; None if no action is needed."""

    state: HealthState
    reasons: tuple[str, ...]
    remedy: str | None = None


def verification_from_document(document: Mapping[str, Any], /) -> Verification:
    """Restore a verification from `Verification.document`."""
    fields = dict(document)
    fields["pairs"] = tuple(PairFigures(**each) for each in fields["pairs"])
    fields["drifts"] = tuple(DriftEstimate(**each) for each in fields["drifts"])
    # Old records have no such field.
    fields["unseen"] = tuple(fields.get("unseen", ()))
    return Verification(**fields)


def verification_from_scan(pairs: Sequence[Mapping[str, Any]], /) -> Verification | None:
    """Verification from the redundancy section of a scan's report, `residual_px`; None without a pair.

    Residuals between two cameras show that a calibration no longer holds, but neither which device changed nor the
    error of a scan in mm: those figures are None.
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


def scan_error_mm(solved: SolveRecord | None, found: Verification | None, /) -> float | None:
    """The expected error of a scanned point now, mm: that of the solve, the board's size included, with the changes
    since, by the last verification with the board. None where the calibration states no error.
    """
    if solved is None:
        return None
    now_mm, stated_mm = (found.expected_mm, found.stated_mm) if found is not None else (None, None)
    grown = 0.0 if now_mm is None or stated_mm is None else max(now_mm**2 - stated_mm**2, 0.0)
    return math.sqrt(solved.expected_error_mm**2 + grown)


def judge_health(verifications: Sequence[Verification], /) -> Health:
    """Judge a calibration by all verifications since it was made, oldest first."""
    if not verifications:
        return Health(
            HealthState.UNKNOWN, ("nothing was verified since the calibration",), "shoot a verification of the board"
        )
    found = _error_reasons(verifications)
    pairs = {}
    for key in _recent_pairs(verifications):
        pairs[key] = [pair for each in verifications for pair in each.pairs if (pair.first, pair.second) == key]
    found += [reason for each in pairs.values() for reason in _mean_reasons(each)]
    found += [reason for each in pairs.values() for reason in _rms_reasons(each)]
    board = [each for each in verifications if each.kind == "board"]
    if len(board) >= _RECENT and _recent_median([each.evidence for each in board]) >= THRESHOLDS.watch_evidence:
        found.append((HealthState.WATCH, "the last verifications agree that a device changed"))
    found += _trend_reasons([each.scale_percent for each in verifications if each.scale_percent is not None], pairs)
    if not found:
        return Health(HealthState.GOOD, (_describe_good(verifications[-1]),))
    found.sort(key=lambda each: each[0] is not HealthState.STALE)
    state, reasons = found[0][0], [reason for _, reason in found]
    last = board[-1] if board else verifications[-1]
    if last.drifts:
        reasons += [last.drifts[0].words, *([last.open] if last.open else [])]
    reasons += _describe_unseen(last)
    if state is HealthState.STALE:
        remedy = last.remedy or "verify with the board to learn which device changed, and calibrate again"
    else:
        remedy = "verify again soon; calibrate again before it gets worse"
    return Health(state, tuple(reasons), remedy)


def _error_reasons(verifications: Sequence[Verification]) -> _Reasons:
    limits, known = THRESHOLDS, [each for each in verifications if each.error_ratio is not None]
    if not known:
        return []
    ratio, jumped = _recent_value(
        [each.error_ratio or 0.0 for each in known], jumps=known[-1].evidence > limits.jump_evidence
    )
    counted = known[-1:] if jumped else known
    evidence, sigmas = (
        _recent_median([each.evidence for each in counted]),
        _recent_median([each.significance for each in counted]),
    )
    reason = (
        "something changed since the calibration: without the board's size, the expected error of a scan is "
        f"{ratio:.1f} times as large"
    )
    likely, certain = evidence > limits.watch_evidence, sigmas > limits.sure_sigmas
    if (ratio > limits.stale_error_ratio and likely) or (ratio > limits.sure_error_ratio and certain):
        return [(HealthState.STALE, reason)]
    # A large ratio may come from explanations none of which is likelier than that nothing changed.
    changed = evidence > 0 or ratio > limits.sure_error_ratio
    return [(HealthState.WATCH, reason)] if ratio > limits.watch_error_ratio and changed else []


def _mean_reasons(figures: Sequence[PairFigures]) -> _Reasons:
    limits, last = THRESHOLDS, figures[-1]
    jumps = abs(last.mean_px) > limits.jump_mean_sigmas * last.mean_sigma_px
    value, _ = _recent_value([abs(pair.mean_px) for pair in figures], jumps=jumps)
    if value <= max(limits.watch_mean_px, _CHANCE_SIGMAS * last.mean_sigma_px):
        return []
    state = HealthState.STALE if value > limits.stale_mean_px else HealthState.WATCH
    return [(state, f"'{last.first}' and '{last.second}' disagree by {value:.2f} px in the mean, expected about 0")]


def _rms_reasons(figures: Sequence[PairFigures]) -> _Reasons:
    limits, last = THRESHOLDS, figures[-1]
    after = max(figures[0].predicted_px, min(pair.rms_px for pair in figures[:_RECENT]))
    value = _recent_median([pair.rms_px for pair in figures])
    if value <= limits.watch_rms_ratio * after:
        return []
    reason = f"'{last.first}' and '{last.second}' disagree by {value:.2f} px rms, {after:.2f} px after the calibration"
    return [(HealthState.STALE if value > limits.stale_rms_ratio * after else HealthState.WATCH, reason)]


def _trend_reasons(sizes: Sequence[float], pairs: Mapping[tuple[str, str], Sequence[PairFigures]]) -> _Reasons:
    reasons = []
    creep, chance = _estimate_creep(sizes)
    if chance < THRESHOLDS.trend_chance:
        reasons.append(f"the board's measured size has crept by {creep:+.3f} %")
    for (first, second), figures in pairs.items():
        creep, chance = _estimate_creep([pair.mean_px for pair in figures])
        if chance < THRESHOLDS.trend_chance and abs(creep) > _MIN_CREEP_PX:
            reasons.append(f"'{first}' and '{second}' have crept apart by {creep:+.3f} px")
    return [(HealthState.WATCH, f"{each} since the first verifications, and not by chance") for each in reasons]


def _estimate_creep(values: Sequence[float]) -> tuple[float, float]:
    """Mean of the last verifications minus that of the first ones, and the probability of as much by chance.

    The deviation is estimated from differences of neighbours (von Neumann 1941), so that a slow trend does not enter
    it. Its square has about two thirds as many degrees of freedom as there are differences.
    """
    # Imported here: scipy takes long to load and is rarely needed.
    from scipy.special import stdtr

    count = min(len(values) // 2, _AVERAGED)
    if count < _MIN_AVERAGED:
        return 0.0, 1.0
    series = np.asarray(values, dtype=np.float64)
    scatter = float(np.sqrt((np.diff(series) ** 2).mean() / 2))
    creep = float(series[-count:].mean() - series[:count].mean())
    size = abs(creep) / max(scatter * np.sqrt(2 / count), 1e-12)
    return creep, float(2 * stdtr(2 * (len(values) - 1) / 3, -size))


def _recent_median(values: Sequence[float]) -> float:
    """The median of the last three."""
    return float(np.median(values[-_RECENT:]))


def _recent_value(values: Sequence[float], *, jumps: bool) -> tuple[float, bool]:
    """The median of the last three, or a larger last value if it jumps; and whether it is the last."""
    median = _recent_median(values)
    return (values[-1], True) if values[-1] > median and jumps else (median, False)


def _recent_pairs(verifications: Sequence[Verification]) -> dict[tuple[str, str], None]:
    """Pairs of the last three verifications, in order."""
    return dict.fromkeys((pair.first, pair.second) for each in verifications[-_RECENT:] for pair in each.pairs)


def _describe_good(verification: Verification) -> str:
    worst = max((abs(pair.mean_px) for pair in verification.pairs), default=float("nan"))
    description = f"devices agree within {worst:.2f} px in the mean"
    if verification.error_ratio is not None:
        description = "a change too small to matter was found" if verification.drift_mm else "no change was found"
    return f"the calibration holds: {'; '.join([description, *_describe_unseen(verification)])}"


def _describe_unseen(verification: Verification) -> list[str]:
    return [
        f"{device_title(name)} was not observed in the last verification, and its state is unknown"
        for name in verification.unseen
    ]
